"""Pictures of continuations: branches with their special points and bands, and curves in two parameters."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes

from afm_jax.dynamics.bands import WITHIN_95
from afm_jax.dynamics.continuation import Branch, Continuation
from afm_jax.impact.orbits import contracts
from afm_jax.plots.picture_style import ACCENT, BLUE, DARK, GRID, label_axes, new_figure, save

_MARKS = {
    "fold": ("o", ACCENT),
    "period_doubling": ("s", "#009E73"),
    "torus": ("D", "#CC79A7"),
    "grazing": ("^", "#56B4E9"),
    "capture": ("v", DARK),
}
"""Shape and colour of each kind: either tells them apart (colours of Okabe and Ito)."""
_NAMES = {
    "platform.reduced_frequency": r"reduced drive frequency  $n = \omega/2\Omega$",
    "platform.frequency_khz": r"drive frequency  $\omega/2\pi$ (kHz)",
    "platform.amplitude_nm": r"drive amplitude  $\beta$ (nm)",
    "platform.offset_nm": r"tip-sample offset  $\sigma$ (nm)",
    "interaction.r": r"restitution  $r$",
    "interaction.epsilon": r"adhesion  $\epsilon$ (nm$^2$/µs$^2$)",
    "interaction.viscous_loss": "viscous loss (nm/µs)",
    "cantilever.quality_factor": r"quality factor  $Q$",
}
_UNITS = {"nm": "nm", "khz": "kHz", "nn": "nN", "deg": "deg", "ng": "ng"}


def axis_name(path: str) -> str:
    """Return what an axis of a parameter is called, with its unit."""
    if path in _NAMES:
        return _NAMES[path]
    words = path.replace(".", " ").split("_")
    unit = _UNITS.get(words[-1])
    return " ".join(words) if unit is None else f"{' '.join(words[:-1])} ({unit})"


def draw_continuation(
    found: Continuation,
    path: Path,
    *,
    bands: Sequence[Float[np.ndarray, " points"]] | None = None,
    errors: Float[np.ndarray, " special"] | None = None,
) -> None:
    """Draw peak amplitude against the parameter: stable solid, unstable dashed, not admissible dotted and light.

    Args:
        found: what is shown.
        path: PDF, SVG or PNG file, by its suffix.
        bands: standard errors of the amplitude, an array a branch: shaded to 95 %.
        errors: standard errors of the special points: bars to 95 %.
    """
    figure = new_figure(7.0, 4.6)
    axes = figure.subplots()
    labels: set[str] = set()
    for number, branch in enumerate(found.branches):
        _draw_branch(axes, branch, labels)
        if bands is not None:
            _draw_band(axes, branch, bands[number])
    for index, point in enumerate(found.special):
        if not point.admissible:
            continue
        half = None if errors is None else WITHIN_95 * float(errors[index])
        marker, colour = _MARKS[point.kind]
        height = float(point.reading.peak_amplitude_nm)
        axes.errorbar(
            point.parameter,
            height,
            xerr=half,
            fmt=marker,
            color=colour,
            markersize=7,
            markeredgecolor="white",
            capsize=3,
            zorder=4,
            label=_once(point.kind.replace("_", " "), labels),
        )
    label_axes(axes, x=axis_name(found.range.path), y="peak amplitude (nm)")
    axes.set_title(f"({found.impacts}, {found.order}) orbits", fontsize=12, loc="left")
    axes.grid(color=GRID, alpha=0.25)
    axes.margins(x=0.02)
    if labels:
        axes.legend(fontsize=10, frameon=False)
    save(figure, path)


def _once(label: str, labels: set[str]) -> str | None:
    if label in labels:
        return None
    labels.add(label)
    return label


def _draw_branch(axes: Axes, branch: Branch, labels: set[str]) -> None:
    stable = np.asarray(contracts(branch.reading.trace, branch.reading.determinant))
    state = np.where(branch.reading.admissible, np.where(stable, 2, 1), 0)
    styles = ((":", GRID, "passes through the sample"), ("--", BLUE, "unstable"), ("-", BLUE, "stable"))
    height = branch.reading.peak_amplitude_nm
    begin = 0
    for end in [*(np.flatnonzero(np.diff(state)) + 1).tolist(), len(state)]:
        line, colour, name = styles[int(state[begin])]
        # to the first point of the next piece, so that there is no gap
        piece = slice(begin, end + 1)
        axes.plot(branch.parameter[piece], height[piece], line, color=colour, linewidth=1.8, label=_once(name, labels))
        begin = end


def _draw_band(axes: Axes, branch: Branch, error: Float[np.ndarray, " points"]) -> None:
    """Shade where the amplitude may lie; not where a fold is so near that a held parameter says nothing."""
    height = branch.reading.peak_amplitude_nm
    half = WITHIN_95 * error
    shown = np.isfinite(half) & (half < 0.3 * np.abs(height)) & branch.reading.admissible
    begin = 0
    for end in [*(np.flatnonzero(np.diff(shown.astype(int))) + 1).tolist(), len(shown)]:
        if shown[begin] and end - begin > 1:
            piece = slice(begin, end)
            low, high = height[piece] - half[piece], height[piece] + half[piece]
            axes.fill_between(branch.parameter[piece], low, high, color=BLUE, alpha=0.2, linewidth=0.0)
        begin = end


def draw_curves(found: Continuation, path: Path) -> None:
    """Draw the curves of special points in two parameters, with cusps and meetings marked.

    Args:
        found: what is shown.
        path: PDF, SVG or PNG file, by its suffix.

    Raises:
        ValueError: if nothing was followed in two parameters.
    """
    if found.second is None:
        raise ValueError("there are no curves: no second parameter was followed")
    figure = new_figure(7.0, 4.6)
    axes = figure.subplots()
    labels: set[str] = set()
    for curve in found.curves:
        _, colour = _MARKS[curve.kind]
        for flown, line in ((True, "-"), (False, ":")):
            shown = np.where(curve.admissible == flown, curve.second, np.nan)
            if np.isfinite(shown).any():
                name = curve.kind.replace("_", " ") + ("" if flown else ", passes through the sample")
                axes.plot(curve.parameter, shown, line, color=colour, linewidth=1.8, label=_once(name, labels))
        for one in curve.meetings:
            marker = "*" if one.kind == "cusp" else "X"
            name = "cusp" if one.kind == "cusp" else "meeting"
            axes.plot(one.parameter, one.second, marker, color="black", markersize=9, label=_once(name, labels))
    label_axes(axes, x=axis_name(found.range.path), y=axis_name(found.second.path))
    axes.set_title(f"({found.impacts}, {found.order}) orbits", fontsize=12, loc="left")
    axes.grid(color=GRID, alpha=0.25)
    axes.set(xlim=(found.range.low, found.range.high), ylim=(found.second.low, found.second.high))
    if labels:
        axes.legend(fontsize=10, frameon=False)
    save(figure, path)
