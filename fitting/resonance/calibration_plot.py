"""The picture of a calibration: the sweep with the fit, and the residuals below."""

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from afm_jax.plots.picture_style import ACCENT, DARK, GRID, label_axes, new_figure
from fitting.resonance.calibration_report import value_in_words
from fitting.resonance.calibration_result import Calibration

_HZ_PER_KHZ = 1e3
_INVALID = "#B00020"
_SMALL = 9


def calibration_figure(result: Calibration) -> Figure:
    """Return the figure: amplitude (and phase) with fit above, what is left below."""
    with_phase = result.curves.phase_deg is not None
    figure = new_figure(11.0 if with_phase else 7.0, 6.2)
    grid = figure.subplots(2, 2 if with_phase else 1, squeeze=False, sharex=True, height_ratios=(2.0, 1.0))
    shift = _HZ_PER_KHZ * (result.sweep.frequency_khz - result.frequency_khz.value)
    unit = f" ({result.sweep.amplitude_unit})" if result.sweep.amplitude_unit else ""
    curves = result.curves
    _draw_curve(grid[0, 0], result, shift, result.sweep.amplitude, curves.amplitude)
    label_axes(grid[0, 0], x="", y=f"amplitude{unit}")
    grid[0, 0].legend(fontsize=_SMALL, loc="upper right")
    _mark_instrument(grid[0, 0], result)
    _draw_misfit(grid[1, 0], shift, curves.amplitude_misfit, f"fit - measured{unit}")
    if result.sweep.phase_deg is not None and curves.phase_deg is not None and curves.phase_misfit_deg is not None:
        measured = np.rad2deg(np.unwrap(np.deg2rad(result.sweep.phase_deg)))
        _draw_curve(grid[0, 1], result, shift, measured, measured + curves.phase_deg - result.sweep.phase_deg)
        label_axes(grid[0, 1], x="", y="phase (degrees)")
        _draw_misfit(grid[1, 1], shift, curves.phase_misfit_deg, "fit - measured (degrees)")
    title = f"f0 = {value_in_words(result.frequency_khz)} kHz,  Q = {value_in_words(result.quality_factor)}"
    title += f"  (background '{result.background}')"
    title = title.replace("+-", "±")
    figure.suptitle(title if result.valid else f"NOT VALID    {title}", color="black" if result.valid else _INVALID)
    return figure


def _draw_curve(
    axes: Axes,
    result: Calibration,
    shift: Float[np.ndarray, " n"],
    measured: Float[np.ndarray, " n"],
    fitted: Float[np.ndarray, " n"],
) -> None:
    half = 0.5 * _HZ_PER_KHZ * result.frequency_khz.value / result.quality_factor.value
    if half < 2.0 * np.ptp(shift):
        axes.axvspan(-half, half, color="0.93", zorder=0, label="half-widths f0/2Q")
    axes.plot(shift, measured, "o", ms=3.5, mfc="none", color=DARK, label="measured")
    axes.plot(shift, fitted, "-", lw=1.6, color=ACCENT, label="fit")


def _mark_instrument(axes: Axes, result: Calibration) -> None:
    """Write what the instrument found beside what the fit found."""
    found = result.sweep.instrument
    lines = []
    if "frequency_khz" in found:
        lines.append(f"f = {found['frequency_khz']:.7g} kHz")
    if "quality_factor" in found:
        lines.append(f"Q = {found['quality_factor']:g}")
    if lines:
        text = "\n".join(["instrument:", *lines])
        axes.text(0.02, 0.97, text, transform=axes.transAxes, va="top", fontsize=_SMALL, color=DARK)


def _draw_misfit(axes: Axes, shift: Float[np.ndarray, " n"], misfit: Float[np.ndarray, " n"], label: str) -> None:
    axes.axhline(0, color=GRID, lw=0.8)
    axes.plot(shift, misfit, "o", ms=2.5, color=DARK)
    label_axes(axes, x="frequency - f0 (Hz)", y=label)
