"""Pictures of sweeps of one or two axes: lines, planes, or points where the values are random; drawn by xarray."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from afm_jax.plots.dynamics import label_of
from afm_jax.plots.picture_style import label_axes, new_panels

if TYPE_CHECKING:
    import xarray

_MOST = 1000
"""Values along an axis that a picture shows."""
_MOST_ROWS = 4


def sweep_figure(found: "xarray.Dataset", names: Sequence[str]) -> Figure:
    """Return variables of a sweep one below the other; what has further values at each point has a panel for each.

    Args:
        found: the results, along one or two axes.
        names: of the variables.

    Raises:
        ValueError: if there are more axes.
    """
    axes = [str(name) for name in found["computed"].dims]
    if len(axes) > 2:
        raise ValueError(f"a picture shows one or two axes, but these are {', '.join(axes)}: slice the results first")
    shown = found.isel({name: slice(None, None, -(-found.sizes[name] // _MOST)) for name in axes})
    shown = shown.sortby([name for name in axes if name in shown.coords])
    swept = [str(name) for name, each in shown.coords.items() if "parameter" in each.attrs and each.dims]
    # values over two parameters are a plane, its last axis across
    plane = axes[::-1] if set(swept) == set(axes) else swept[:2]
    is_plane = len(axes) == 2 or len(swept) == 2
    layers = [
        (name, layer) for name in names for layer in (_layers(shown[[name]], axes) if is_plane else [shown[[name]]])
    ]
    figure, panels = new_panels(7.0, 3.2 * len(layers), len(layers), squeeze=False)
    for panel, (name, layer) in zip(panels[:, 0], layers, strict=True):
        _draw(panel, layer, name, plane if is_plane else plane[:1])
    return figure


def _is_geometric(values: np.ndarray) -> bool:
    """Say whether values have equal ratios; few values, and those at equal distances, have none to speak of."""
    values = np.unique(values)
    return bool(values.size > 2 and values[0] > 0.0 and np.ptp(np.diff(np.log(values))) < 1e-6)


def _layers(found: "xarray.Dataset", axes: Sequence[str]) -> "list[xarray.Dataset]":
    """Return what there is of a variable over the axes, a data set for each of its further values."""
    further = next((name for name in found.dims if name not in axes), None)
    if further is None:
        return [found]
    return [found.isel({further: place}) for place in range(min(found.sizes[further], _MOST_ROWS))]


def _draw(panel: Axes, found: "xarray.Dataset", name: str, swept: Sequence[str]) -> None:
    """Draw one variable against a parameter, or over two of them: cells of a grid, or points."""
    x, *others = swept
    labels = [label_of(found[each].attrs["parameter"]) for each in swept] + [label_of(name)]
    # cells have neighbours
    on_axes = all(found.sizes.get(each, 1) > 1 for each in swept)
    scales: Any = {
        f"{side}scale": "log" for side, each in zip("xy", swept, strict=False) if _is_geometric(found[each].values)
    }
    colours: Any = {"cmap": "cividis", "cbar_kwargs": {"label": labels[-1]}}
    if not others:
        found[name].plot.line(ax=panel, x=x, marker=".", ms=3.0, lw=0.8 if on_axes else 0.0)
        panel.set(**scales)
    elif on_axes:
        found[name].plot.pcolormesh(ax=panel, x=x, y=others[0], rasterized=True, **colours, **scales)
    else:
        found.plot.scatter(ax=panel, x=x, y=others[0], hue=name, s=12.0, **colours)
        panel.set(**scales)
    label_axes(panel, x=labels[0], y=labels[1], grid=not others)
    for side, each in zip("xy", swept, strict=False):
        low, high = found[each].values.min(), found[each].values.max()
        # all that was swept, also where there is no result
        panel.update_datalim([(low, low), (high, high)], updatex=side == "x", updatey=side == "y")
    panel.autoscale_view()
