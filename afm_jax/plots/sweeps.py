"""Pictures of sweeps of one or two axes: lines, planes, or points where the values are random."""

import json
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator

from afm_jax.plots.dynamics import label_of
from afm_jax.plots.picture_style import GRID, cell_edges, label_axes, new_figure
from afm_jax.studies.sweep import dimension_of

if TYPE_CHECKING:
    import xarray

_MOST = 1000
"""Values along an axis that a picture shows."""
_MOST_ROWS = 4
_MARGIN = 0.02
_MOST_IN_BETWEEN = 100.0
"""Ratio of the ends up to which there is room for labels between powers of ten."""


def sweep_figure(found: "xarray.Dataset", names: Sequence[str]) -> Figure:
    """Return variables of a sweep side by side, one below the other what has further values at each point.

    Args:
        found: the results, along one or two axes.
        names: of the variables.

    Raises:
        ValueError: if there are more axes.
    """
    axes = [str(name) for name in found["computed"].dims]
    if len(axes) > 2:
        raise ValueError(f"a picture shows one or two axes, but these are {', '.join(axes)}: slice the results first")
    thin = found.isel({name: slice(None, None, -(-found.sizes[name] // _MOST)) for name in axes})
    thin = thin.sortby([name for name in axes if name in thin.coords])
    for name in map(dimension_of, _logarithmic(found)):
        if name in thin.coords:
            thin[name].attrs["log"] = True
    along = [str(name) for name, c in thin.coords.items() if "parameter" in c.attrs and c.dims[0] in axes]
    flat = len(along) == 2 or len(axes) == 2
    parts = {name: _layers(thin[name], axes) for name in names}
    rows = max(map(len, parts.values())) if flat else 1
    figure = new_figure(6.4 * len(names), 4.4 * rows)
    panels = figure.subplots(rows, len(names), squeeze=False)
    for column, (name, layers) in enumerate(parts.items()):
        label = _label(found[name])
        for row in range(rows):
            panel: Axes = panels[row, column]
            if not flat:
                _lines(panel, thin, along, layers, label)
            elif row < len(layers):
                _plane(figure, panel, thin, along, axes, layers[row], label)
            else:
                panel.set_visible(False)
    return figure


def _logarithmic(found: "xarray.Dataset") -> list[str]:
    """Return the parameters that are spread logarithmically."""
    names: list[str] = []
    for axis in json.loads(found.attrs["input"])["axes"]:
        names += [axis["parameter"]] if "log" in axis else []
        names += [name for name, ends in axis.get("random", {}).items() if isinstance(ends, dict)]
    return names


def _scale(panel: Axes, name: str, coordinate: "xarray.DataArray", *, ends: bool) -> None:
    """Give a side, "x" or "y", the scale of its values and, if asked for, their ends: all that was swept."""
    log = "log" in coordinate.attrs
    low, high = coordinate.values.min(), coordinate.values.max()
    if log:
        panel.set(**{f"{name}scale": "log"})
        side = panel.xaxis if name == "x" else panel.yaxis
        side.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if high < _MOST_IN_BETWEEN * low else (1.0,)))
        side.set_major_formatter("{x:g}")
        side.set_minor_formatter("")
    if ends and low < high:
        factor, step = (high / low) ** _MARGIN if log else 1.0, 0.0 if log else _MARGIN * (high - low)
        panel.set(**{f"{name}lim": (low / factor - step, high * factor + step)})


def _layers(variable: "xarray.DataArray", axes: Sequence[str]) -> list[tuple[str, np.ndarray]]:
    """Return what there is of a variable over the axes, with what tells it apart."""
    further = [str(name) for name in variable.dims if name not in axes]
    if not further:
        return [("", variable.values)]
    name = further[0]
    values = variable[name].values[:_MOST_ROWS]
    return [(f"{name} {value:g}", variable.isel({name: index}).values) for index, value in enumerate(values)]


def _label(variable: "xarray.DataArray") -> str:
    unit, label = variable.attrs.get("units", "1"), label_of(str(variable.name))
    return label if unit == "1" or label.endswith(")") else f"{label} ({unit})"


def _lines(
    panel: Axes, found: "xarray.Dataset", along: Sequence[str], layers: Sequence[tuple[str, np.ndarray]], label: str
) -> None:
    coordinate = found[along[0]]
    style = "." if coordinate.dims[0] != along[0] else ".-"
    for name, values in layers:
        panel.plot(coordinate.values, values, style, ms=3.0, linewidth=0.8, label=name or None)
    if any(name for name, _ in layers):
        panel.legend(frameon=False)
    _scale(panel, "x", coordinate, ends=True)
    panel.grid(color=GRID, alpha=0.25)
    label_axes(panel, x=label_of(coordinate.attrs["parameter"]), y=label)


def _plane(
    figure: Figure,
    panel: Axes,
    found: "xarray.Dataset",
    along: Sequence[str],
    axes: Sequence[str],
    layer: tuple[str, np.ndarray],
    label: str,
) -> None:
    """Draw values over two parameters: cells of a grid, or points."""
    name, values = layer
    cells = len(axes) == 2 and set(along) == set(axes)
    if cells:
        y, x = axes
        edges = _edges(found[x]), _edges(found[y])
        mesh = panel.pcolormesh(*edges, values, cmap="cividis", rasterized=True)
    else:
        x, y = along[:2]
        at = np.broadcast_arrays(*(_spread(found[part], axes) for part in (x, y)))
        mesh = panel.scatter(*(part.ravel() for part in at), c=np.asarray(values).ravel(), s=6.0, cmap="cividis")
    _scale(panel, "x", found[x], ends=not cells)
    _scale(panel, "y", found[y], ends=not cells)
    bar = figure.colorbar(mesh, ax=panel)
    bar.set_label(label)
    panel.set_title(name, fontsize=11)
    label_axes(panel, x=label_of(found[x].attrs["parameter"]), y=label_of(found[y].attrs["parameter"]))


def _edges(coordinate: "xarray.DataArray") -> np.ndarray:
    values = coordinate.values
    return np.exp(cell_edges(np.log(values))) if "log" in coordinate.attrs else cell_edges(values)


def _spread(coordinate: "xarray.DataArray", axes: Sequence[str]) -> np.ndarray:
    """Return a coordinate with all axes of the sweep, of length 1 where it does not change."""
    return coordinate.values.reshape([-1 if name in coordinate.dims else 1 for name in axes])
