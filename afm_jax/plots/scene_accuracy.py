"""The picture of a scene's accuracy study: time against error of its settings, and of ever fuller models."""

from collections.abc import Mapping, Sequence
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from afm_jax.plots.picture_style import ACCENT, BLUE, DARK, GRID, label_axes, new_figure

_WAYS = {"quick": (BLUE, "o"), "careful": (ACCENT, "s"), "map": (BLUE, "o")}
_SMALLEST = 1e-17
"""Errors of exactly 0 have no place on a logarithmic axis; they are left out."""


def scene_accuracy_figure(result: Mapping[str, Any]) -> Figure:
    """Return the figure: errors of the last arrival and of the peak for every setting, and the fidelity ladder.

    Args:
        result: of `contact_accuracy` or `law_accuracy`, with the `ladder` and `model_reference` of `fidelity_ladder`.
    """
    figure = new_figure(16.0, 5.4)
    first, second, third = figure.subplots(1, 3)
    contacts, rows = result["contacts"], result["rows"]
    _settings(first, rows, "arrival_error_us", result["reference_error_us"])
    label_axes(
        first, x=f"error of the arrival of contact {contacts} (us)", y="time of a contact (us), one core, one tip"
    )
    _settings(second, rows, "peak_error_nm", result["reference_error_nm"])
    label_axes(second, x="error of the largest height (nm)", y="")
    _ladder(third, result["ladder"])
    label_axes(third, x=f"error of the amplitude against the {result['model_reference']} (relative)", y="time (s)")
    handles, labels = first.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=4, frameon=False)
    return figure


def _settings(axes: Axes, rows: Sequence[Mapping[str, Any]], column: str, own: float | None) -> None:
    axes.set(xscale="log", yscale="log")
    for way in dict.fromkeys(row["way"] for row in rows):
        points = [row for row in rows if row["way"] == way and (row.get(column) or 0.0) > _SMALLEST]
        colour, marker = _WAYS[way]
        at = [(row[column], row["microseconds_per_contact"]) for row in points]
        if at:
            axes.plot(*zip(*at, strict=True), marker, color=colour, label=way)
        for number, (row, place) in enumerate(zip(points, at, strict=True)):
            _name(axes, row["setting"], place, colour, above=number % 2 == 0)
    if own:
        axes.axvline(own, color=DARK, linestyle=":", linewidth=1.2, label="error of the reference")
    axes.margins(0.25)
    axes.grid(color=GRID, alpha=0.25)


def _ladder(axes: Axes, ladder: Sequence[Mapping[str, Any]]) -> None:
    axes.set(xscale="log", yscale="log")
    known = [row for row in ladder if (row.get("model_error") or 0.0) > _SMALLEST]
    for number, row in enumerate(known):
        place = (row["model_error"], row["seconds"])
        axes.plot(*place, "D", color=BLUE if "delay" in row["model"] else ACCENT)
        _name(axes, row["model"], place, DARK, above=number % 2 == 0)
    true = ladder[-1]
    if true["seconds"] is not None:
        axes.axhline(true["seconds"], color=DARK, linestyle=":", linewidth=1.2)
        axes.text(0.02, true["seconds"], true["model"], transform=axes.get_yaxis_transform(), va="bottom", fontsize=9)
    axes.margins(0.35)
    axes.grid(color=GRID, alpha=0.25)


def _name(axes: Axes, text: str, place: tuple[float, float], colour: str, *, above: bool) -> None:
    axes.annotate(
        text,
        place,
        xytext=(0, 8 if above else -8),
        textcoords="offset points",
        ha="center",
        va="bottom" if above else "top",
        fontsize=8,
        color=colour,
    )
