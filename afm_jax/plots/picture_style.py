"""What all pictures share: size, fonts, resolution, without a display and without touching matplotlib's own state."""

import io
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Shaped
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure
from matplotlib.image import imsave

from afm_jax.whole_files import write_whole

DARK = "#3b4a5a"
ACCENT = "#b34700"
"""A dark orange that stands off white, black and DARK for every kind of colour vision."""
BLUE = "#0072B2"
SKY = "#56B4E9"
GRID = "#9aa5b1"
_FONT = 11.0
_DPI = 200.0
_MANY_POINTS = 2000


def new_figure(width_in: float, height_in: float) -> Figure:
    """Return an empty figure of a size in inches."""
    figure = Figure(figsize=(width_in, height_in), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def new_panels(
    width_in: float, height_in: float, rows: int = 1, columns: int = 1, **options: Any
) -> tuple[Figure, Any]:
    """Return an empty figure of a size in inches, and its axes as `Figure.subplots` gives them, with its options."""
    figure = new_figure(width_in, height_in)
    return figure, figure.subplots(rows, columns, **options)


def label_axes(axes: Axes, *, x: str, y: str, grid: bool = True) -> None:
    """Label both axes in the common size, ticks inside the labels' size; draw a light grid where that hides nothing."""
    axes.set_xlabel(x, fontsize=_FONT + 1)
    axes.set_ylabel(y, fontsize=_FONT + 1)
    axes.tick_params(labelsize=_FONT)
    if grid:
        axes.grid(color=GRID, alpha=0.25)


def legend_once(axes: Axes, owner: Axes | Figure | None = None, **style: Any) -> None:
    """Add a legend in which every label stands once, however many lines have it; none without labels.

    Args:
        axes: whose lines it is of.
        owner: the figure whose legend it becomes, where it is not that of the axes.
        style: of the legend.
    """
    named = dict(zip(*reversed(axes.get_legend_handles_labels()), strict=True))
    if named:
        legend = (owner or axes).legend(named.values(), named.keys(), **{"frameon": False, "fontsize": 10} | style)
        for handle in legend.get_lines():
            handle.set(alpha=1.0)
            handle.set_markersize(max(handle.get_markersize(), 8.0))


def save(figure: Figure, path: Path, *, named_by_user: bool = False) -> None:
    """Write a figure, whole or not at all, in the format of its file's suffix: PNG, PDF or SVG.

    Args:
        figure: of matplotlib.
        path: of the file.
        named_by_user: whether the user gave this very path, which may then be a link; see `write_whole`.
    """
    write_whole(path, _bytes_of(figure, path.suffix.removeprefix("."), _DPI), named_by_user=named_by_user)


def png_of(figure: Figure, dpi: float = 150.0) -> bytes:
    """Return a figure as a PNG file."""
    return png_of_pixels(pixels_of(figure, dpi), dpi)


def pixels_of(figure: Figure, dpi: float) -> Shaped[np.ndarray, "height width 4"]:
    """Return a figure's pixels: drawn once, where matplotlib's own saving draws all of it for the layout as well."""
    figure.set_dpi(dpi)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.array(canvas.buffer_rgba())


def png_of_pixels(pixels: Shaped[np.ndarray, "height width 4"], dpi: float) -> bytes:
    """Return pixels as a PNG file."""
    buffer = io.BytesIO()
    imsave(buffer, pixels, format="png", dpi=dpi)
    return buffer.getvalue()


def svg_of(figure: Figure) -> bytes:
    """Return a figure as an SVG file, in the layout in which it was drawn before: a layout costs as much as drawing.

    Lines, marks and meshes of many points are pixels in it, of the resolution in which it was drawn.
    """
    figure.set_layout_engine("none")
    for axes in figure.axes:
        lines = [line for line in axes.lines if np.size(line.get_xdata()) > _MANY_POINTS]
        coloured = [(mesh, mesh.get_array()) for mesh in axes.collections]
        meshes = [mesh for mesh, values in coloured if values is not None and values.size > _MANY_POINTS]
        for artist in (*lines, *meshes):
            artist.set_rasterized(True)
    buffer = io.BytesIO()
    with rc_context({"svg.hashsalt": "afm-jax"}):
        FigureCanvasSVG(figure).print_svg(buffer, metadata={"Date": None})
    return buffer.getvalue()


def _bytes_of(figure: Figure, suffix: str, dpi: float) -> bytes:
    if suffix == "png":
        return png_of(figure, dpi)
    buffer = io.BytesIO()
    figure.savefig(buffer, format=suffix, dpi=dpi)
    return buffer.getvalue()


def cell_edges(centres: Float[np.ndarray, " cells"]) -> Float[np.ndarray, " edges"]:
    """Return the borders of cells, half-way between their centres."""
    if len(centres) == 1:
        return centres[0] + np.array([-0.5, 0.5])
    borders = 0.5 * (centres[1:] + centres[:-1])
    return np.concatenate([[2.0 * centres[0] - borders[0]], borders, [2.0 * centres[-1] - borders[-1]]])
