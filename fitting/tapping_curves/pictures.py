"""Pictures of a tapping curve: amplitude, phase and energy over height; several curves together."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from afm_jax.plots.picture_style import ACCENT, BLUE, DARK, GRID, label_axes, new_figure
from afm_jax.units import TWO_SIDED_95
from fitting.tapping_curves.branches import side_of, way_of
from fitting.tapping_curves.result import Tapping
from fitting.tapping_curves.together import TappingTogether

_SMALL = 9


def curve_figure(result: Tapping) -> Figure:
    """Return amplitude, phase and energy of a tap over the height of the sample."""
    curve, rows = result.curve, result.rows
    panels = 3 if curve.has_phase else 2
    figure = new_figure(7.5, 0.5 + 3.0 * panels)
    top, *between, bottom = figure.subplots(panels, 1, sharex=True)
    _points(top, result, curve.amplitude_nm, curve.amplitude_error_nm)
    label_axes(top, x="", y="amplitude (nm)")
    top.legend(fontsize=_SMALL, loc="lower left")
    if between:
        middle = between[0]
        _points(middle, result, curve.lag_deg, curve.lag_error_deg)
        label_axes(middle, x="", y="lag (degrees)")
        _points(bottom, result, rows.energy_aj, rows.energy_noise_aj)
        # all points in contact are in the picture, those of the free tip not
        touching = rows.energy_aj[~rows.free & np.isfinite(rows.energy_aj)]
        ends = [0.0, *touching, *_energy_bands(bottom, result)]
        margin = 0.05 * np.ptp(ends)
        bottom.set_ylim(min(ends) - margin, max(ends) + margin)
    else:
        _points(bottom, result, rows.largest_energy_aj, np.zeros(curve.rows))
    label_axes(
        bottom,
        x="height of the sample over the tip's rest position (nm)",
        y=result.in_unit("energy of a tap (aJ)" if curve.has_phase else "at most (aJ)"),
    )
    # a legend in the panel would hide readings
    bottom.legend(fontsize=_SMALL, loc="upper center", bbox_to_anchor=(0.5, -0.2), ncols=4)
    for axes in (top, *between, bottom):
        axes.grid(color=GRID, alpha=0.25)
    return figure


def _points(axes: Axes, result: Tapping, values: np.ndarray, errors: np.ndarray) -> None:
    """Draw rows: filled on approach, squares on retract, hollow where excluded, grey where free."""
    curve, free = result.curve, result.rows.free
    aside = np.array([note.startswith("excluded") for note in result.rows.note])
    for back, marker, colour in ((False, "o", BLUE), (True, "s", ACCENT)):
        for chosen, edge, filled, label in (
            (free, GRID, GRID, "free"),
            (~free & ~aside, colour, colour, way_of(back)),
            (~free & aside, DARK, "none", "excluded"),
        ):
            here = chosen & (curve.retract == back) & np.isfinite(values)
            if here.any():
                style: dict[str, Any] = {"fmt": marker, "ms": 4, "lw": 0.8, "color": edge, "mfc": filled}
                once = None if label in axes.get_legend_handles_labels()[1] else label
                axes.errorbar(curve.offset_nm[here], values[here], errors[here], label=once, **style)


def _energy_bands(axes: Axes, result: Tapping) -> list[float]:
    """Draw the energy along the branches with its 95 % band, and where there is one energy that; return their ends."""
    ends = []
    for branch in result.branches:
        curve = branch.curve
        colour = ACCENT if branch.retract else BLUE
        axes.plot(curve.height_nm, curve.energy_aj, color=colour, lw=1.2)
        axes.fill_between(curve.height_nm, curve.energy_low_aj, curve.energy_high_aj, color=colour, alpha=0.15, lw=0)
        ends += [float(curve.energy_aj.max()), float(np.percentile(curve.energy_high_aj, 90.0))]
    for group in () if result.fit is None or result.why_not_constant else result.fit.groups:
        heights, energy = result.curve.offset_nm[group.rows], [group.energy_aj] * 2
        label = result.in_unit(f"one energy, {side_of(group.repulsive)}: {group.energy_aj:.3g} aJ")
        axes.plot([heights.min(), heights.max()], energy, "--", color=DARK, lw=1.0, label=label)
        ends += group.interval95_aj
    return ends


def together_figure(result: TappingTogether) -> Figure:
    """Return the energies of all curves over the amplitude, a panel a side, with their mean and its common error."""
    sides = [state for state in (False, True) if any(b.repulsive == state for c in result.curves for b in c.branches)]
    figure = new_figure(7.0, 4.6 * max(len(sides), 1))
    for state, axes in zip(sides, np.atleast_1d(figure.subplots(max(len(sides), 1))), strict=False):
        for one in result.curves:
            for branch in one.branches:
                if branch.repulsive == state:
                    colour = ACCENT if branch.retract else BLUE
                    axes.plot(branch.curve.amplitude_ratio, branch.curve.energy_aj, color=colour, lw=0.7, alpha=0.5)
        for scatter in result.scatter:
            if scatter.repulsive == state:
                ratio, mean = scatter.amplitude_ratio, scatter.energy_aj
                colour = ACCENT if scatter.retract else BLUE
                axes.plot(ratio, mean, color=colour, lw=2.0, label=f"{scatter.way}, mean of {scatter.curves}")
                for width, shade in (
                    (TWO_SIDED_95 * scatter.energy_common_error_aj, 0.12),
                    (scatter.energy_scatter_aj, 0.25),
                ):
                    axes.fill_between(ratio, mean - width, mean + width, color=colour, alpha=shade, lw=0)
        axes.set_title(side_of(state), fontsize=_SMALL + 1)
        label_axes(axes, x="amplitude over the free one", y=result.in_unit("energy of a tap (aJ)"))
        axes.grid(color=GRID, alpha=0.25)
        if axes.get_legend_handles_labels()[0]:
            axes.legend(fontsize=_SMALL)
    return figure
