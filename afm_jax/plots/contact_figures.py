"""Pictures of the contact's forces, figures 4 and 5, the paper's numbers marked; 6 and 7 are in `impact_figures`."""

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes

from afm_jax.plots.impact_figures import draw_course, draw_law
from afm_jax.plots.picture_style import ACCENT, BLUE, DARK, GRID, label_axes, new_figure, save, with_zero_line
from afm_jax.study.contact_figures import ContactFigure
from afm_jax.study.contact_statements import PAPER, SMALL_GAP_NM

_LEADER = {"arrowstyle": "-", "color": DARK, "linewidth": 0.8}


def draw_contact_figure(number: str, figure: ContactFigure, path: Path) -> None:
    """Draw figure 4, 5, 6 or 7 as a PNG file."""
    {"4": _forces, "5": _hysteresis, "6": draw_law, "7": draw_course}[number](figure, path)


def _forces(figure: ContactFigure, path: Path) -> None:
    picture = new_figure(7.5, 5.2)
    axes = picture.subplots()
    columns, numbers = figure.columns, figure.numbers
    gap = columns["gap_nm"]
    for name, (style, equation) in _FORCES.items():
        label = f"{name} (eq. {equation})"
        axes.plot(gap, columns[f"{name}_nn"], style, color=BLUE, linewidth=1.8, label=label)
    axes.plot(gap, columns["sum_nn"], color="black", linewidth=2.2, label="sum")
    axes.axvspan(0.0, SMALL_GAP_NM, color=ACCENT, alpha=0.10, linewidth=0)
    axes.annotate(
        f"stiff below about {SMALL_GAP_NM:g} nm,\nrepulsive below {numbers['repulsive_below_nm']:.3f} nm",
        (SMALL_GAP_NM, 64.0),
        (0.55, 64.0),
        color=DARK,
        va="center",
        arrowprops=_LEADER,
    )
    forms = numbers["bridge_forms_nm"]
    axes.axvline(forms, color=DARK, linewidth=1.2, linestyle=(0, (1, 2)))
    axes.annotate(f"bridge forms\nat {forms:g} nm", (forms + 0.06, 64.0), color=DARK, va="center")
    with_zero_line(axes)
    axes.set(xlim=(0.0, 4.5), ylim=(-100.0, 80.0))
    label_axes(axes, x="gap $D$ (nm)", y="force (nN)")
    axes.legend(loc="lower right", fontsize=11, framealpha=1.0)
    axes.set_title("Static forces of the liquid bridge", fontsize=12, loc="left")
    save(picture, path)


_FORCES = {"capillary": ("--", 10), "structural": ("-.", 13), "core": (":", 14)}


def _hysteresis(figure: ContactFigure, path: Path) -> None:
    picture = new_figure(8.0, 5.8)
    axes = picture.subplots()
    gap, force, leg = (figure.columns[name] for name in ("gap_nm", "force_nn", "leg"))
    numbers = figure.numbers
    forms, breaks = numbers["bridge_forms_nm"], numbers["bridge_breaks_nm"]
    # closed along the dry gap between the breaking and the forming of the bridge, where the force is 0
    axes.fill(np.append(gap, [breaks, forms]), np.append(force, [0.0, 0.0]), color=BLUE, alpha=0.12, linewidth=0)
    _ways(axes, figure)
    for place in (forms, breaks):
        axes.plot([place, place], [0.0, force[np.argmin(np.abs(gap - place))]], ":", color=DARK, linewidth=1.4)
    for place, text in ((forms, "forms"), (breaks, "breaks")):
        axes.annotate(f"bridge {text}\nat {place:g} nm", (place, 3.0), color=DARK, ha="center")
    snap_off = int(np.flatnonzero(leg == 2)[-1])
    off = numbers["breaks_gap_nm"]
    axes.plot([off, off], [force[snap_off], force[snap_off + 1]], ":", color=DARK, linewidth=1.4)
    axes.plot(off, force[snap_off], "o", color="black", markersize=5)
    axes.annotate(
        f"JKR instability at {off:.3f} nm", (off, force[snap_off]), (0.85, -97.0), color=DARK, arrowprops=_LEADER
    )
    axes.annotate(
        f"hysteresis (shaded) {numbers['hysteresis_aj']:.2f} aJ (paper: {PAPER['hysteresis_aj']:g} aJ)\n"
        f"bridge {numbers['bridge_hysteresis_aj']:.2f} aJ + junction {numbers['junction_hysteresis_aj']:.2f} aJ",
        (1.6, -72.0),
        color="black",
    )
    with_zero_line(axes)
    axes.set(xlim=(-0.3, 5.4), ylim=(-150.0, 85.0))
    label_axes(axes, x="gap $D$ (nm)", y="static force (nN)")
    axes.legend(loc="lower right", fontsize=11)
    axes.set_title("Loading and unloading", fontsize=12, loc="left")
    _snap_on(axes, figure)
    save(picture, path)


def _ways(axes: Axes, figure: ContactFigure) -> None:
    """Draw loading wide and unloading narrow, so that both show where they coincide."""
    gap, force, leg = (figure.columns[name] for name in ("gap_nm", "force_nn", "leg"))
    for legs, colour, width, label in (((0, 1), BLUE, 4.5, "loading"), ((2, 3), ACCENT, 1.6, "unloading")):
        for part in legs:
            chosen = leg == part
            name = label if part == legs[0] else None
            axes.plot(gap[chosen], force[chosen], color=colour, linewidth=width, label=name)


def _snap_on(axes: Axes, figure: ContactFigure) -> None:
    """Draw the surroundings of the junction's formation larger: there the curves touch, and nothing jumps."""
    numbers = figure.numbers
    place, height = numbers["forms_gap_nm"], numbers["force_at_snap_on_nn"]
    inset = axes.inset_axes((0.19, 0.685, 0.33, 0.295))
    _ways(inset, figure)
    inset.plot(place, height, "o", color="black", markersize=5)
    inset.annotate(
        f"junction forms\nat {place:.4f} nm\n(paper: {PAPER['forms_gap_nm']:g} nm)",
        (place, height),
        (0.142, -4.0),
        color=DARK,
        fontsize=9,
        va="center",
        arrowprops=_LEADER,
    )
    inset.set(xlim=(0.09, 0.2), ylim=(-50.0, 10.0))
    inset.tick_params(labelsize=8)
    inset.grid(color=GRID, alpha=0.25)
    axes.indicate_inset_zoom(inset, edgecolor=DARK, linewidth=0.8)
