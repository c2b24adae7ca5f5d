"""Pictures of stability charts, as figures 2 and 3, and of the amplitude against the offset, as figure 9.

In a chart it is light where a single-impact orbit is stable, a colour an order; against the offset there is a curve for
each coefficient of restitution.
"""

from pathlib import Path

import matplotlib as mpl
import numpy as np
from jaxtyping import Bool, Float
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.ticker import MultipleLocator
from scipy.ndimage import gaussian_filter

from afm_jax.dynamics.charts import OffsetAmplitudes, StabilityChart
from afm_jax.plots.picture_style import ACCENT, DARK, GRID, label_axes, new_figure, save
from afm_jax.scenefile import presets

_LOST = "#8a97a5"
_PALE = ("#cfe8f7", "#fbe3b5", "#c8ecdf", "#f3d3e5", "#f7f3b2", "#f8d0bd", "#ddd2ee", "#ecd9b8")
"""A colour an order, light enough for labels on them."""


def draw_stability_chart(
    chart: StabilityChart,
    path: Path,
    *,
    title: str,
    compared_with: StabilityChart | None = None,
    limit_nm: Float[np.ndarray, " columns"] | None = None,
) -> None:
    """Draw a stability chart.

    Args:
        chart: what is shown.
        path: PNG file.
        title: of the picture.
        compared_with: a chart on the same grid; what is stable there and no longer here is shaded light.
        limit_nm: a drive amplitude for each column, drawn as a line: below it there is no orbit.
    """
    figure = new_figure(9.0, 5.6)
    axes = figure.subplots()
    edges = cell_edges(chart.x_values), cell_edges(chart.y_values)
    axes.set_facecolor(DARK)
    if compared_with is not None:
        _fill(axes, chart, compared_with.any_stable, _LOST)
    # lower orders over higher ones, as `lowest_stable_order` has it
    for order in range(chart.orders, 0, -1):
        _fill(axes, chart, chart.stable[order - 1], _PALE[(order - 1) % len(_PALE)])
    axes.set(xlim=edges[0][[0, -1]], ylim=edges[1][[0, -1]])
    resonance = r"resonance $\omega = 2N\Omega$"
    for order in range(1, int(edges[0][-1]) + 1):
        axes.axvline(order, color=GRID, linewidth=1.2, linestyle=":", label=resonance if order == 1 else None)
        _label_order(axes, chart, order)
    if limit_nm is not None:
        label = r"$\beta\omega = \sqrt{(1-r^2)\,\epsilon}\,/\,2r$: no orbit below"
        axes.plot(chart.x_values, limit_nm, color=ACCENT, linewidth=2.0, label=label)
    if compared_with is not None:
        axes.plot([], [], color=_LOST, linewidth=8.0, label=r"lost against $\epsilon = 0$")
    figure.legend(loc="outside lower center", ncols=3, fontsize=11, frameon=False)
    _add_frequency_axis(axes)
    label_axes(axes, x=r"reduced drive frequency  $n = \omega/2\Omega$", y=r"drive amplitude  $\beta$ (nm)")
    axes.set_title(title, fontsize=12)
    save(figure, path)


def _fill(axes: Axes, chart: StabilityChart, where: Bool[np.ndarray, "rows columns"], colour: str) -> None:
    """Fill a region with a border that passes between the points: blurred by less than a cell, cut at a half."""
    if where.any():
        share = gaussian_filter(where.astype(float), 0.6, mode="nearest")
        axes.contourf(chart.x_values, chart.y_values, share, levels=[0.5, 2.0], colors=[colour])


def _label_order(axes: Axes, chart: StabilityChart, order: int) -> None:
    """Write the order into its tongue, if there is one at three fifths of the height."""
    row = int(0.6 * len(chart.y_values))
    columns = chart.x_values[chart.tongue(order)[row]] if order <= chart.orders else []
    if len(columns):
        middle = 0.5 * (columns[0] + columns[-1])
        axes.text(
            middle,
            chart.y_values[row],
            f"(1,{order})",
            ha="center",
            va="center",
            fontsize=12,
            bbox={"color": "white", "pad": 1.0},
        )


def _add_frequency_axis(axes: Axes) -> None:
    scale = 2.0 * presets.FREE_FREQUENCY_KHZ
    top = axes.secondary_xaxis("top", functions=(lambda n: np.multiply(n, scale), lambda f: np.divide(f, scale)))
    top.set_xlabel(r"drive frequency  $\omega/2\pi$ (kHz)", fontsize=11)
    top.tick_params(labelsize=10)


def cell_edges(centres: Float[np.ndarray, " cells"]) -> Float[np.ndarray, " edges"]:
    """Return the borders of cells, half-way between their centres."""
    if len(centres) == 1:
        return centres[0] + np.array([-0.5, 0.5])
    borders = 0.5 * (centres[1:] + centres[:-1])
    return np.concatenate([[2.0 * centres[0] - borders[0]], borders, [2.0 * centres[-1] - borders[-1]]])


SHOWN_R = (0.55, 0.6, 0.65, 0.7, 0.75, 0.8, 0.85, 0.9, 0.95, 0.99)


def draw_offset_amplitudes(amplitudes: OffsetAmplitudes, path: Path, *, title: str) -> None:
    """Draw rescaled amplitude against offset, one panel a drive frequency; a curve ends where the stable orbit does.

    Args:
        amplitudes: what is shown, of every r the nearest to one of `SHOWN_R`.
        path: PNG file.
        title: of the picture.
    """
    figure = new_figure(10.0, 4.8)
    panels = figure.subplots(1, len(amplitudes.reduced_frequency), sharex=True, sharey=True, squeeze=False)[0]
    shown = sorted({int(np.argmin(np.abs(amplitudes.r - r))) for r in SHOWN_R})
    # The light end of viridis is lost on white.
    colours = mpl.colormaps["viridis"](np.linspace(0.92, 0.0, len(shown)))
    handles: list[Line2D] = []
    for panel, axes in enumerate(panels):
        handles = [
            axes.plot(
                amplitudes.offset_nm,
                amplitudes.rescaled_amplitude[panel, index],
                color=colour,
                linewidth=2.0,
                label=f"{amplitudes.r[index]:.2f}",
            )[0]
            for index, colour in zip(shown, colours, strict=True)
        ]
        _finish(axes, f"({'abcdef'[panel]})  $n$ = {amplitudes.reduced_frequency[panel]:g}")
    label_axes(panels[0], x=r"tip-sample offset  $\sigma$ (nm)", y=r"peak amplitude / its value at $\sigma = 0$")
    for axes in panels[1:]:
        label_axes(axes, x=r"tip-sample offset  $\sigma$ (nm)", y="")
    panels[0].set(xlim=amplitudes.offset_nm[[0, -1]], ylim=(0.0, None))
    figure.legend(handles=handles[::-1], title="restitution $r$", loc="outside right center", fontsize=11)
    figure.suptitle(title, fontsize=12)
    save(figure, path)


def _finish(axes: Axes, name: str) -> None:
    axes.set_title(name, fontsize=12, loc="left")
    axes.xaxis.set_major_locator(MultipleLocator(0.5))
    axes.axvline(0.0, color=GRID, linewidth=0.8)
    axes.axhline(1.0, color=GRID, linewidth=0.8)
    axes.grid(color=GRID, alpha=0.25)
