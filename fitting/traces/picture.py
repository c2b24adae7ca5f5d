"""The picture of a lock-in reading: the amplitude at each order, and how it goes on from part to part."""

import numpy as np
from matplotlib.figure import Figure

from afm_jax.plots.picture_style import ACCENT, BLUE, DARK, label_axes, new_figure
from fitting.traces.lockin import LockinResult


def lockin_figure(result: LockinResult) -> Figure:
    """Return the figure: the amplitude at each order with its error, and that of each block at the order asked for."""
    figure = new_figure(9.0, 3.6)
    lines, blocks = figure.subplots(1, 2)
    colours = [ACCENT if n == result.order else BLUE for n in result.orders]
    place = np.arange(len(result.orders))
    lines.bar(place, result.amplitudes_nm, color=colours, yerr=result.amplitude_errors_nm, capsize=3.0)
    lines.set_xticks(place, [str(n) for n in result.orders])
    label_axes(lines, x="drive frequency over", y="amplitude (nm)")
    count = len(result.block_amplitudes_nm)
    blocks.plot(np.arange(1, count + 1), result.block_amplitudes_nm, "o-", color=DARK)
    label_axes(blocks, x=f"part of the trace, at order {result.order}", y="amplitude (nm)")
    figure.suptitle(f"order {result.order}: {'periodic' if result.valid else 'NOT VALID'}")
    return figure
