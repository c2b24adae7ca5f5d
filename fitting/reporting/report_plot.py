"""The pictures of a fit: measured and predicted amplitudes, residuals, and the law with its band."""

import numpy as np
from matplotlib.figure import Figure

from fitting.models import NUISANCE_NAMES
from fitting.report import interval_in_words
from fitting.reporting.report_plot_law import draw_delay, draw_law, draw_losses
from fitting.reporting.report_plot_rows import ALARM, SMALL, draw_amplitudes, draw_residuals, draw_residuals_by_speed
from fitting.result import FitResult


def fit_figure(result: FitResult) -> Figure:
    """Return the figure of the whole fit: amplitudes and residuals row by row on the left, the law on the right.

    Where impacts last, the law's side shows their delay too.
    """
    lasting = has_delay(result)
    figure = Figure(figsize=(11.0, 8.0 if lasting else 6.6), layout="constrained")
    panels = "AL;AE;RD" if lasting else "AL;RE"
    heights = (1.4, 1.0, 1.0) if lasting else (1.7, 1.0)
    axes = figure.subplot_mosaic(panels, width_ratios=(1.5, 1.0), height_ratios=heights)
    axes["R"].sharex(axes["A"])
    draw_amplitudes(axes["A"], result)
    draw_residuals(axes["R"], result)
    draw_law(axes["L"], result)
    draw_losses(axes["E"], result)
    if lasting:
        draw_delay(axes["D"], result)
    handles, labels = axes["A"].get_legend_handles_labels()
    figure.legend(handles, labels, fontsize=SMALL, ncols=2, loc="outside lower left")
    figure.legend([], [], fontsize=SMALL, loc="outside lower right", title=_law_in_words(result), title_fontsize=SMALL)
    title = f"Impact law from {result.table.rows} rows, model {result.model}, chi²/dof = "
    title += f"{result.chi2:.4g}/{result.degrees_of_freedom}"
    figure.suptitle(
        title if result.valid else f"NOT VALID    {title}", color="black" if result.valid else ALARM, fontsize=12
    )
    return figure


def _law_in_words(result: FitResult) -> str:
    if not result.valid:
        return "not a measurement of the law"
    lines = [
        f"{name}: {interval_in_words(parameter)} {parameter.unit}".rstrip()
        for name, parameter in result.parameters.items()
        if name not in NUISANCE_NAMES
    ]
    return "\n".join(["95 % intervals:", *lines])


def rows_figure(result: FitResult) -> Figure:
    """Return the figure of the rows: amplitudes above, residuals below."""
    figure = Figure(figsize=(10.0, 6.0), layout="constrained")
    above, below = figure.subplots(2, 1, sharex=True, height_ratios=(1.7, 1.0))
    draw_amplitudes(above, result)
    draw_residuals(below, result)
    handles, labels = above.get_legend_handles_labels()
    figure.legend(handles, labels, fontsize=SMALL, ncols=4, loc="outside lower center")
    return figure


def law_figure(result: FitResult) -> Figure:
    """Return the figure of the law: rebound speed, energy lost, and the delay where impacts last."""
    draw = [draw_law, draw_losses, *([draw_delay] if has_delay(result) else [])]
    figure = Figure(figsize=(10.0, 3.6), layout="constrained")
    for panel, axes in zip(draw, figure.subplots(1, len(draw)), strict=True):
        panel(axes, result)
    return figure


def speed_figure(result: FitResult) -> Figure:
    """Return the figure of the residuals against the approach speed."""
    figure = Figure(figsize=(10.0, 3.0), layout="constrained")
    draw_residuals_by_speed(figure.subplots(), result)
    return figure


def has_delay(result: FitResult) -> bool:
    """Say whether the model's impacts last."""
    return bool(np.any(result.law.collision_delay_us != 0.0))
