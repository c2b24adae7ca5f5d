"""Pictures of section IV: forces, hysteresis, impact law, one impact; the paper's numbers marked."""

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes

from afm_jax.contact.phases import Phase
from afm_jax.plots.picture_style import ACCENT, DARK, GRID, label_axes, new_figure, save
from afm_jax.study.contact_figures import PAPER, ContactFigure

_BLUE = "#0072B2"


def draw_contact_figure(number: str, figure: ContactFigure, path: Path) -> None:
    """Draw figure 4, 5, 6 or 7 as a PNG file."""
    {"4": _forces, "5": _hysteresis, "6": _law, "7": _course}[number](figure, path)


def _forces(figure: ContactFigure, path: Path) -> None:
    picture = new_figure(7.5, 5.0)
    axes = picture.subplots()
    columns = figure.columns
    gap = columns["gap_nm"]
    styles = {"capillary": "--", "structural": "-.", "core": ":"}
    for name, style in styles.items():
        axes.plot(
            gap, columns[f"{name}_nn"], style, color=_BLUE, linewidth=1.8, label=f"{name} (eq. {_EQUATION[name]})"
        )
    axes.plot(gap, columns["sum_nn"], color="black", linewidth=2.2, label="sum")
    axes.axvline(3.5, color=GRID, linewidth=1.0)
    axes.annotate("bridge forms\nat 3.5 nm", (3.5, 42.0), (3.56, 42.0), color=DARK, va="center")
    _at_zero(axes)
    axes.set(xlim=(0.0, 4.5), ylim=(-100.0, 75.0))
    label_axes(axes, x="gap $D$ (nm)", y="force (nN)")
    axes.legend(loc="lower right", fontsize=11)
    axes.set_title("Static forces of the liquid bridge", fontsize=12, loc="left")
    save(picture, path)


_EQUATION = {"capillary": 10, "structural": 13, "core": 14}


def _hysteresis(figure: ContactFigure, path: Path) -> None:
    picture = new_figure(7.5, 5.2)
    axes = picture.subplots()
    gap, force, leg = (figure.columns[name] for name in ("gap_nm", "force_nn", "leg"))
    numbers = figure.numbers
    # closed along the dry gap between the breaking and the forming of the bridge, where the force is 0
    axes.fill(np.append(gap, [4.7, 3.5]), np.append(force, [0.0, 0.0]), color=_BLUE, alpha=0.10, linewidth=0)
    for legs, colour, width, label in (((0, 1), _BLUE, 4.5, "way in"), ((2, 3), ACCENT, 1.6, "way out")):
        for place, part in enumerate(legs):
            chosen = leg == part
            axes.plot(gap[chosen], force[chosen], color=colour, linewidth=width, label=None if place else label)
    marks = {
        int(np.flatnonzero(leg == 0)[-1]): (
            f"junction forms at {numbers['forms_gap_nm']:.4f} nm\n(paper: {PAPER['snap_on_nm']:g} nm)",
            (0.75, 28.0),
        ),
        int(np.flatnonzero(leg == 2)[-1]): (f"JKR instability at {numbers['breaks_gap_nm']:.4f} nm", (0.95, -93.0)),
    }
    line = {"arrowstyle": "-", "color": GRID}
    for near, (text, where) in marks.items():
        axes.plot(gap[near], force[near], "o", color="black", markersize=5)
        axes.annotate(text, (gap[near], force[near]), where, color=DARK, va="center", arrowprops=line)
    for place, text in ((3.5, "bridge forms"), (4.7, "bridge breaks")):
        axes.plot([place, place], [0.0, force[np.argmin(np.abs(gap - place))]], ":", color=DARK, linewidth=1.2)
        axes.annotate(text, (place, 4.0), color=DARK, ha="center")
    axes.annotate(
        f"hysteresis {numbers['hysteresis_aj']:.2f} aJ (paper: {PAPER['hysteresis_aj']:g} aJ)\n"
        f"bridge {numbers['bridge_hysteresis_aj']:.2f} aJ, junction {numbers['junction_hysteresis_aj']:.2f} aJ",
        (2.0, -60.0),
        color="black",
    )
    _at_zero(axes)
    axes.set(xlim=(-0.3, 5.5), ylim=(-148.0, 60.0))
    label_axes(axes, x="gap $D$ (nm)", y="static force (nN)")
    axes.legend(loc="upper right", fontsize=11)
    axes.set_title("Loading and unloading", fontsize=12, loc="left")
    save(picture, path)


def _law(figure: ContactFigure, path: Path) -> None:
    picture = new_figure(7.5, 6.4)
    axes, below = picture.subplots(2, 1, sharex=True, height_ratios=[2.2, 1.0])
    columns, numbers = figure.columns, figure.numbers
    speed, rebound = columns["approach_speed_nm_per_us"], columns["rebound_speed_nm_per_us"]
    axes.plot(speed, speed, color=GRID, linewidth=1.0, label="no loss")
    axes.plot(speed, rebound, color="black", linewidth=2.2, label="contact model")
    axes.plot(
        speed,
        columns["law_nm_per_us"],
        "--",
        color=ACCENT,
        linewidth=1.6,
        label=rf"eq. 6: r = {numbers['r']:.4f}, $\epsilon$ = {numbers['epsilon']:.0f} "
        f"(paper: {PAPER['r']:g}, {PAPER['epsilon']:g})",
    )
    capture = float(str(numbers["capture_speed_nm_per_us"]))
    axes.annotate(
        f"capture below {capture:.2f} nm/us\n(paper: {PAPER['capture_nm_per_us']:g})",
        (capture, 0.0),
        (30.0, 8.0),
        color=DARK,
        arrowprops={"arrowstyle": "-", "color": GRID},
    )
    label_axes(axes, x="", y="rebound speed (nm/us)")
    axes.legend(loc="upper left", fontsize=11)
    axes.set_title("Impact law of the contact", fontsize=12, loc="left")
    free = speed > 12.0
    for name, colour, style, label in (
        ("law_nm_per_us", ACCENT, "--", "eq. 6"),
        ("linear_loss_nm_per_us", _BLUE, "-", "loss linear in speed"),
    ):
        below.plot(speed[free], columns[name][free] - rebound[free], style, color=colour, linewidth=1.6, label=label)
    _at_zero(below)
    below.set(xlim=(0.0, 150.0))
    label_axes(below, x="approach speed (nm/us)", y="fit - model (nm/us)")
    below.legend(loc="lower right", fontsize=11)
    save(picture, path)


def _course(figure: ContactFigure, path: Path) -> None:
    picture = new_figure(7.5, 5.2)
    axes = picture.subplots()
    columns, numbers = figure.columns, figure.numbers
    time, gap, phase = columns["time_us"], columns["gap_nm"], columns["phase"]
    # the course's time is 0 where the bridge forms; its last point but one is where the bridge breaks
    ends = (0.0, *time[np.flatnonzero(phase == Phase.JUNCTION)[[0, -1]]], time[-2])
    for place, (colour, label) in enumerate(((_BLUE, "liquid bridge"), (ACCENT, "solid junction"), (_BLUE, None))):
        axes.axvspan(ends[place], ends[place + 1], color=colour, alpha=0.12, linewidth=0, label=label)
    axes.plot(time, gap, color="black", linewidth=2.0, label="distance")
    arrival = float(str(numbers["arrival_us"]))
    leaving = arrival + float(str(numbers["collision_delay_us"]))
    end = float(time[-1])
    speed, rebound = (float(str(numbers[name])) for name in ("approach_speed_nm_per_us", "rebound_speed_nm_per_us"))
    first = float(time[0])
    axes.plot(
        [first, arrival, end],
        [speed * (arrival - first), 0.0, rebound * (end - arrival)],
        ":",
        color="black",
        label="instantaneous impact",
    )
    axes.plot(
        [leaving, end], [0.0, rebound * (end - leaving)], "--", color=DARK, linewidth=1.0, label="straight path out"
    )
    axes.annotate(
        f"lag {numbers['lag_us']:.3f} us (paper: 0.11)\nlead {numbers['lead_us']:.3f} us (paper: 0.2)\n"
        f"delay = lag - lead = {numbers['collision_delay_us']:.3f} us",
        (0.40, 0.80),
        xycoords="axes fraction",
        color="black",
        va="top",
    )
    _at_zero(axes)
    axes.set(xlim=(first, end), ylim=(-1.0, 6.5))
    label_axes(axes, x="time (us)", y="distance from the sample (nm)")
    axes.legend(loc="lower right", fontsize=10)
    axes.set_title(f"One impact at {speed:g} nm/us", fontsize=12, loc="left")
    save(picture, path)


def _at_zero(axes: Axes) -> None:
    axes.axhline(0.0, color=GRID, linewidth=0.8)
    axes.grid(color=GRID, alpha=0.25)
