"""The picture of any result: its arrays of one length against the first of them, its planes as maps, panels by unit."""

from typing import Any

import numpy as np
from matplotlib.figure import Figure

from afm_jax.plots.picture_style import ACCENT, DARK, label_axes, new_panels
from afm_jax.results import known_columns, known_rows
from afm_jax.units import unit_of, words_of

_MOST_PANELS = 4
_COLOURS = (DARK, ACCENT, "#0072B2", "#009E73", "#CC79A7", "#7a6a00")


def figure_of(result: Any) -> Figure:
    """Return the picture of a result: curves where it has arrays of one length, else maps, else numbers as bars."""
    numbers = {name: array for name, (array, _) in known_columns(result).items() if array.dtype.kind in "biuf"}
    shapes = [array.shape for array in numbers.values() if array.size > 1]
    shape = max(shapes, key=lambda each: (shapes.count(each), each), default=())
    # measured numbers first: the first is the axis of the others
    ranked = sorted(numbers.items(), key=lambda column: column[1].dtype.kind != "f")
    chosen = {name: array.astype(float) for name, array in ranked if array.shape == shape}
    if len(shape) > 1 and sum(each == shape for each in shapes) == 1:
        return _map(*chosen.popitem())
    known = known_rows(result, shape).ravel()
    flat = {name: array.ravel()[known] for name, array in chosen.items()}
    if len(flat) < 2 or not shape:
        flat = {"number": np.flatnonzero(known).astype(float), **flat}
    return _curves(flat)


def _curves(columns: dict[str, np.ndarray]) -> Figure:
    (first, x), *others = columns.items()
    panels: dict[str, list[tuple[str, np.ndarray]]] = {}
    for name, y in others:
        panels.setdefault(unit_of(name), []).append((name, y))
    shown = sorted(panels.items(), key=lambda each: (not each[0], -len(each[1])))[:_MOST_PANELS]
    figure, below = new_panels(8.0, 1.2 + 2.4 * max(len(shown), 1), max(len(shown), 1), squeeze=False)
    marker = "." if x.size > 40 else "o"
    steady = x.size > 1 and bool(np.all(np.diff(x) > 0.0))
    for axes, (unit, curves) in zip(below[:, 0], shown, strict=False):
        for colour, (name, y) in zip(_COLOURS, curves, strict=False):
            axes.plot(x, y, marker, linestyle="-" if steady else "", color=colour, label=words_of(name), markersize=4)
        label_axes(axes, x=_label(first) if axes is below[-1, 0] else "", y=unit)
        axes.legend(frameon=False, fontsize=9, loc="center left", bbox_to_anchor=(1.0, 0.5))
    return figure


def _map(name: str, plane: np.ndarray) -> Figure:
    figure, axes = new_panels(7.0, 5.0)
    image = axes.imshow(plane.reshape(plane.shape[0], -1), origin="lower", aspect="auto", interpolation="nearest")
    label_axes(axes, x="column", y="row", grid=False)
    figure.colorbar(image, label=_label(name))
    return figure


def _label(name: str) -> str:
    unit = unit_of(name)
    return f"{words_of(name)} ({unit})" if unit else words_of(name)
