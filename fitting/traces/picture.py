"""The picture of a lock-in reading: the amplitude at each order."""

import numpy as np
from matplotlib.figure import Figure

from afm_jax.plots.picture_style import ACCENT, BLUE, label_axes, new_figure
from fitting.traces.lockin import LockinResult


def lockin_figure(result: LockinResult) -> Figure:
    """Return the figure: the amplitude at each order with its error."""
    figure = new_figure(6.0, 3.6)
    lines = figure.subplots()
    colours = [ACCENT if n == result.order else BLUE for n in result.orders]
    place = np.arange(len(result.orders))
    lines.bar(place, result.amplitudes_nm, color=colours, yerr=result.amplitude_errors_nm, capsize=3.0)
    lines.set_xticks(place, [str(n) for n in result.orders])
    label_axes(lines, x="drive frequency over", y="amplitude (nm)")
    figure.suptitle(f"order {result.order}: {'periodic' if result.valid else 'NOT VALID'}")
    return figure
