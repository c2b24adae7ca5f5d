"""Pictures of the amplitude against the offset, as in figure 9: a curve for each coefficient of restitution."""

from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.ticker import MultipleLocator

from afm_jax.plots.picture_style import GRID, label_axes, new_figure, save
from afm_jax.study.offset_amplitude import OffsetAmplitudes

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
