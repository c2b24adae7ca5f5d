"""The picture of a design: the errors to expect against the number of points."""

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from afm_jax.plots.picture_style import label_axes, new_figure
from fitting.experiments.design import Design


def design_figure(result: Design) -> Figure:
    """Return the figure: every parameter's standard error, relative to its size, those that matter with full lines."""
    figure = new_figure(8.0, 5.0)
    axes = figure.subplots()
    shares = 100.0 * np.where(np.isfinite(result.errors), result.errors, np.nan) / result.prior.sizes
    for name, share in zip(result.prior.problem.names, shares.T, strict=True):
        line = "o-" if name in result.interest else ".:"
        axes.plot(np.arange(len(share)), share, line, label="1 - r" if name == "r" else name)
    axes.set_yscale("log")
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    label_axes(axes, x="points measured", y="expected standard error (%)")
    axes.legend()
    verdict = "" if result.valid else "NOT VALID: "
    figure.suptitle(f"{verdict}{len(result.chosen)} points for {', '.join(result.interest)}")
    return figure
