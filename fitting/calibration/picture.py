"""The picture of a calibration: the scan with the fit."""

import numpy as np
from matplotlib.figure import Figure

from afm_jax.columns import csv_columns
from afm_jax.plots.picture_style import ACCENT, DARK, label_axes, new_figure
from fitting.calibration.calibrate import Calibration


def calibration_figure(result: Calibration) -> Figure:
    """Return the figure: amplitude (and phase) with the fit, what is left below each."""
    (columns,) = csv_columns(result).values()
    kinds = ["amplitude", *(["phase_deg"] if "measured_phase_deg" in columns else [])]
    figure = new_figure(7.0, 5.0 * len(kinds))
    grid = figure.subplots(2 * len(kinds), sharex=True, height_ratios=(2.0, 1.0) * len(kinds)).reshape(-1, 2)
    shift = 1e3 * (columns["frequency_khz"] - result.frequency_khz.value)
    for (above, below), kind in zip(grid, kinds, strict=True):
        measured, fitted = columns[f"measured_{kind}"], columns[f"fitted_{kind}"]
        left = fitted - measured
        if kind == "phase_deg":
            measured = np.unwrap(measured, period=360.0)
        above.plot(shift, measured, "o", ms=3.5, mfc="none", color=DARK, label="measured")
        above.plot(shift, measured + left, "-", color=ACCENT, label="fit")
        below.plot(shift, left, "o", ms=2.5, color=DARK)
        unit = "degrees" if kind == "phase_deg" else result.sweep.amplitude_unit or "units of the file"
        label_axes(above, x="", y=f"{kind.removesuffix('_deg')} ({unit})")
        label_axes(below, x="frequency - f0 (Hz)", y="fit - measured")
    if result.model == "power":
        grid[0, 0].set_yscale("log")
    grid[0, 0].legend()
    figure.suptitle(f"f0 = {result.frequency_khz.value:.7g} kHz,  Q = {result.quality_factor.value:.5g}")
    return figure
