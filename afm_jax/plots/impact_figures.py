"""Pictures of what an impact does, figures 6 and 7: the impact law of the contact, and one impact in time."""

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes

from afm_jax.contact.phases import Phase
from afm_jax.plots.picture_style import ACCENT, BLUE, DARK, GRID, label_axes, new_figure, save, with_zero_line
from afm_jax.study.contact_figures import FIT_RANGE, ContactFigure
from afm_jax.study.contact_statements import PAPER


def draw_law(figure: ContactFigure, path: Path) -> None:
    """Draw figure 6 as a PNG file: the impact law with its fit above, the residuals of two fits below."""
    picture = new_figure(7.5, 7.0)
    axes, below = picture.subplots(2, 1, sharex=True, height_ratios=[2.0, 1.0])
    _laws(axes, figure)
    axes.set(xlim=(0.0, FIT_RANGE[1]), ylim=(0.0, FIT_RANGE[1]))
    label_axes(axes, x="", y=r"rebound speed  $u_{out}$ (nm/µs)")
    axes.grid(color=GRID, alpha=0.25)
    axes.legend(loc="upper left", fontsize=11, framealpha=1.0)
    axes.set_title("Impact law of the contact", fontsize=12, loc="left")
    capture = figure.numbers["capture_speed_nm_per_us"]
    _cutoff(axes, figure)
    _residuals(below, figure)
    for panel in (axes, below):
        panel.axvline(capture, color=DARK, linewidth=1.2, linestyle=":")
    save(picture, path)


def _laws(axes: Axes, figure: ContactFigure) -> None:
    columns, numbers = figure.columns, figure.numbers
    speed = columns["approach_speed_nm_per_us"]
    fitted = (
        rf"eq. 6: $r$ = {numbers['r']:.4f}, $\epsilon$ = {numbers['epsilon']:.0f} nm²/µs² "
        f"(paper: {PAPER['r']:g}, {PAPER['epsilon']:g})"
    )
    axes.plot(speed, speed, color=GRID, linewidth=1.2, label="no loss")
    axes.plot(speed, columns["rebound_speed_nm_per_us"], color="black", linewidth=2.4, label="contact model")
    axes.plot(speed, columns["law_nm_per_us"], "--", color=ACCENT, linewidth=1.6, label=fitted)


def _cutoff(axes: Axes, figure: ContactFigure) -> None:
    """Draw the law close to the cutoff larger."""
    capture = figure.numbers["capture_speed_nm_per_us"]
    inset = axes.inset_axes((0.60, 0.09, 0.37, 0.42))
    _laws(inset, figure)
    inset.axvline(capture, color=DARK, linewidth=1.2, linestyle=":")
    inset.annotate(
        f"capture below\n{capture:.2f} nm/µs\n(paper: {PAPER['capture_nm_per_us']:g})",
        (0.04, 0.95),
        xycoords="axes fraction",
        color=DARK,
        fontsize=9,
        va="top",
    )
    inset.set(xlim=(5.0, 25.0), ylim=(0.0, 25.0))
    inset.tick_params(labelsize=8)
    inset.grid(color=GRID, alpha=0.25)
    axes.indicate_inset_zoom(inset, edgecolor=DARK, linewidth=0.8)


def _residuals(axes: Axes, figure: ContactFigure) -> None:
    columns, numbers = figure.columns, figure.numbers
    speed, rebound = columns["approach_speed_nm_per_us"], columns["rebound_speed_nm_per_us"]
    fitted = (speed >= FIT_RANGE[0]) & (speed <= FIT_RANGE[1])
    linear = numbers["linear_loss"]
    share = 100.0 * numbers["worst_error_of_top_speed"]
    labels = {
        "law_nm_per_us": f"eq. 6: at worst {numbers['worst_error_nm_per_us']:.2f} nm/µs, "
        f"{share:.2f} % of the top speed",
        "linear_loss_nm_per_us": rf"$u_{{out}}^2 = u_{{in}}^2 - {linear['viscous_loss']:.2f}\,u_{{in}} - "
        rf"{linear['epsilon']:.0f}$: at worst {linear['worst_error_nm_per_us']:.2f} nm/µs",
    }
    for (name, label), colour, style in zip(labels.items(), (ACCENT, BLUE), ("--", "-"), strict=True):
        residual = columns[name][fitted] - rebound[fitted]
        axes.plot(speed[fitted], residual, style, color=colour, linewidth=1.8, label=label)
    with_zero_line(axes)
    axes.set_ylim(-0.29, 0.1)
    label_axes(axes, x=r"approach speed  $u_{in}$ (nm/µs)", y="fit $-$ model (nm/µs)")
    axes.legend(loc="lower right", fontsize=10, framealpha=1.0)


def draw_course(figure: ContactFigure, path: Path) -> None:
    """Draw figure 7 as a PNG file: the distance against time beside that of an instantaneous impact."""
    picture = new_figure(8.0, 5.8)
    axes = picture.subplots()
    columns, numbers = figure.columns, figure.numbers
    time, arrival, rebound = columns["time_us"], numbers["arrival_us"], numbers["rebound_speed_nm_per_us"]
    leaving = arrival + numbers["collision_delay_us"]
    first, end = time[0], time[-1]
    _phases(axes, time, columns["phase"])
    axes.plot(time, columns["gap_nm"], color="black", linewidth=2.2, label="distance of the tip")
    straight = [numbers["approach_speed_nm_per_us"] * (arrival - first), 0.0, rebound * (end - arrival)]
    axes.plot([first, arrival, end], straight, ":", color="black", linewidth=1.6, label="instantaneous impact")
    back = [0.0, rebound * (end - leaving)]
    axes.plot([leaving, end], back, "--", color=ACCENT, linewidth=1.2, label="straight path out, drawn back to 0")
    _times(axes, figure)
    with_zero_line(axes)
    axes.set(xlim=(first, end), ylim=(-2.9, 7.0))
    axes.set_yticks(range(8))
    label_axes(axes, x="time since the bridge formed (µs)", y="distance from the sample (nm)")
    # the order of the curves first; the V leaves no other place free
    axes.legend(loc="upper center", bbox_to_anchor=(0.47, 1.0), fontsize=10, framealpha=1.0)
    axes.set_title(f"One impact at {numbers['approach_speed_nm_per_us']:g} nm/µs", fontsize=12, loc="left")
    save(picture, path)


def _phases(axes: Axes, time: np.ndarray, phase: np.ndarray) -> None:
    """Shade the bridge and the junction."""
    wet, solid = (np.flatnonzero(phase == which) for which in (Phase.BRIDGE, Phase.JUNCTION))
    # of the free flight after contact the first point is where the bridge breaks
    ends = [float(time[place]) for place in (wet[0], solid[0], solid[-1], wet[-1] + 1)]
    for place, (colour, label) in enumerate(((BLUE, "liquid bridge"), (ACCENT, "solid junction"), (BLUE, None))):
        axes.axvspan(ends[place], ends[place + 1], color=colour, alpha=0.12, linewidth=0, label=label)


def _times(axes: Axes, figure: ContactFigure) -> None:
    """Draw lag, lead and delay as arrows below the sample's surface."""
    numbers = figure.numbers
    arrival, lag, lead = (numbers[name] for name in ("arrival_us", "lag_us", "lead_us"))
    delay = numbers["collision_delay_us"]
    arrows = (
        (-1.05, arrival, arrival + lag, f"lag {lag:.3f} µs (paper: {PAPER['lag_us']:g}): time in the junction"),
        (-1.75, arrival + lag, arrival + delay, f"lead {lead:.3f} µs (paper: {PAPER['lead_us']:g})"),
        (-2.45, arrival, arrival + delay, f"delay = lag $-$ lead = ${delay:.3f}$ µs"),
    )
    for height, start, stop, text in arrows:
        arrow = {"arrowstyle": "-|>", "color": ACCENT, "linewidth": 1.6, "shrinkA": 0.0, "shrinkB": 0.0}
        axes.annotate("", (stop, height), (start, height), arrowprops=arrow)
        axes.annotate(text, (arrival + lag + 0.015, height), color="black", va="center")
    for place, top in ((arrival, 0.0), (arrival + delay, 0.0), (arrival + lag, -0.8)):
        axes.plot([place, place], [-2.6, top], color=DARK, linewidth=0.8, linestyle=(0, (2, 2)))
