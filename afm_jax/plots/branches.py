"""Pictures of continuations: branches with their special points and bands, and curves in two parameters."""

from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from afm_jax.dynamics.continuation import Continuation
from afm_jax.dynamics.impact_orbits import is_stable, multipliers_of
from afm_jax.dynamics.special_points import OrbitBranch
from afm_jax.plots.dynamics import label_of
from afm_jax.plots.picture_style import ACCENT, BLUE, DARK, GRID, label_axes, legend_once, new_panels
from afm_jax.units import TWO_SIDED_95

_MARKS = {
    "fold": ("o", "black"),
    "period_doubling": ("s", "#009E73"),
    "grazing": ("^", "#56B4E9"),
    "capture": ("v", DARK),
}
"""Shape and colour of each kind: either tells them apart (colours of Okabe and Ito)."""
_HOLLOW: dict[str, Any] = {"ms": 8, "mfc": "none", "mew": 1.8, "capsize": 3, "zorder": 4}


def continuation_figure(found: Continuation) -> Figure:
    """Return peak amplitude against the parameter: stable solid, unstable dashed, not admissible dotted and light.

    Marks of special points are hollow: the branch goes on through them. Where the law has errors, 95 % of the
    amplitudes are within the ground that is coloured, and of the special points within the bars.
    """
    figure, axes = new_panels(7.0, 4.6)
    for number, branch in enumerate(found.branches):
        _draw_branch(axes, branch)
        if found.amplitude_errors is not None:
            _draw_band(axes, branch, found.amplitude_errors[number])
    for index, point in enumerate(found.special):
        if not point.admissible:
            continue
        half = None if found.special_errors is None else TWO_SIDED_95 * float(found.special_errors[index])
        marker, colour = _MARKS[point.kind]
        height = float(point.reading.peak_amplitude_nm)
        style = {"fmt": marker, "color": colour, "label": point.kind.replace("_", " ")}
        axes.errorbar(point.parameter, height, xerr=half, **_HOLLOW, **style)
    label_axes(axes, x=label_of(found.range.path), y="peak amplitude (nm)")
    axes.set_title(f"({found.impacts}, {found.order}) orbits", fontsize=12, loc="left")
    axes.margins(x=0.02)
    legend_once(axes)
    return figure


def _draw_branch(axes: Axes, branch: OrbitBranch) -> None:
    """Draw a branch; where its state changes, the line has the style of the lesser one."""
    stable = is_stable(multipliers_of(np.asarray(branch.reading.trace), np.asarray(branch.reading.determinant)))
    state = np.where(branch.reading.admissible, np.where(stable, 2, 1), 0)
    lines = np.minimum(state[:-1], state[1:])
    styles = ((":", GRID, "passes through the sample"), ("--", ACCENT, "unstable"), ("-", BLUE, "stable"))
    begin = 0
    for end in [*(np.flatnonzero(np.diff(lines)) + 1).tolist(), len(lines)]:
        line, colour, name = styles[int(lines[begin])]
        piece = slice(begin, end + 1)
        height = branch.reading.peak_amplitude_nm[piece]
        axes.plot(branch.parameter[piece], height, line, color=colour, linewidth=1.8, label=name)
        begin = end


def _draw_band(axes: Axes, branch: OrbitBranch, error: Float[np.ndarray, " points"]) -> None:
    """Shade where the amplitude may lie; not where a fold is so near that a held parameter says nothing."""
    height, half = branch.reading.peak_amplitude_nm, TWO_SIDED_95 * error
    shown = np.isfinite(half) & (half < 0.3 * np.abs(height)) & branch.reading.admissible
    low, high = height - half, height + half
    axes.fill_between(branch.parameter, low, high, where=shown, color=BLUE, alpha=0.2, linewidth=0.0)


def curves_figure(found: Continuation) -> Figure:
    """Return the curves of special points in two parameters.

    Args:
        found: what is shown.

    Raises:
        ValueError: if nothing was followed in two parameters.
    """
    if found.second is None:
        raise ValueError("there are no curves: no second parameter was followed")
    figure, axes = new_panels(7.0, 4.6)
    for curve in found.curves:
        _, colour = _MARKS[curve.kind]
        for flown, line in ((True, "-"), (False, ":")):
            here = curve.admissible == flown
            if not flown:
                # up to the next point of the other kind
                here = np.convolve(here, [True, True, True], mode="same")
            shown = np.where(here, curve.second, np.nan)
            if np.isfinite(shown).any():
                name = curve.kind.replace("_", " ") + ("" if flown else ", passes through the sample")
                axes.plot(curve.parameter, shown, line, color=colour, linewidth=1.8, label=name)
    label_axes(axes, x=label_of(found.range.path), y=label_of(found.second.path))
    axes.set_title(f"({found.impacts}, {found.order}) orbits", fontsize=12, loc="left")
    axes.set(xlim=(found.range.low, found.range.high), ylim=(found.second.low, found.second.high))
    legend_once(axes)
    return figure
