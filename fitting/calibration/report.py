"""A calibration as a person reads it: text for the terminal, files for the drawer (JSON, CSV, PNG).

The picture shows the sweep with the fit, and the residuals below.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from afm_jax.plots.picture_style import ACCENT, DARK, GRID, label_axes, new_figure
from afm_jax.words import bullets, interval, known, text_table, value_alone, with_error
from fitting.calibration.result import CalibratedValue, Calibration
from fitting.calibration.stiffness import Stiffness
from fitting.instruments.curve import MeasuredCurve

POINT_COLUMNS = (
    "line",
    "frequency_khz",
    "measured_amplitude",
    "fitted_amplitude",
    "amplitude_misfit",
    "measured_phase_deg",
    "fitted_phase_deg",
    "phase_misfit_deg",
)
_BACKGROUNDS = {
    ("phase", "none"): "z = A L",
    ("phase", "constant"): "z = A L + B",
    ("phase", "linear"): "z = A L + B + C x",
    ("amplitude", "none"): "|z|^2 = a |L|^2",
    ("amplitude", "floor"): "|z|^2 = a |L|^2 + b",
    ("amplitude", "constant"): "|z|^2 = a |L|^2 + b + c Re L",
    ("power", "none"): "S = a |L|^2",
    ("power", "floor"): "S = a |L|^2 + b",
    ("power", "constant"): "S = a |L|^2 + b + c Re L",
}


def calibration_summary(result: Calibration, stiffness: str | None = None) -> str:
    """Return the calibration as text: verdict first, then the values, their comparison, goodness of fit, notes.

    Args:
        result: of frequency and quality factor.
        stiffness: why the spring constant is not calibrated; None: it is, or there is none.
    """
    what = {"phase": "amplitude and phase", "power": "thermal spectrum"}.get(result.model, "amplitude")
    values = [
        _value_cells("frequency_khz", result.frequency_khz, "  kHz"),
        _value_cells("quality_factor", result.quality_factor, ""),
    ]
    verdict = "VALID" if result.valid else "NOT VALID: the numbers below are not a calibration."
    if result.valid and stiffness is not None:
        verdict = "NOT VALID: frequency and quality factor are calibrated, the spring constant is not."
    lines = [
        f"Free resonance of {result.sweep.source} ({result.sweep.points} points, {what}):",
        f"  background '{result.background}': {_BACKGROUNDS[result.model, result.background]}",
        "",
        verdict,
        *(f"  - {reason}" for reason in (*result.reasons, *([] if stiffness is None else [stiffness]))),
        "",
        *text_table(["", "value", "std. error", "95 % interval"], values, words=(0, 3)),
        *_comparison_lines(result),
        "",
        _goodness_line(result),
    ]
    lines += bullets("Notes:", result.warnings)
    if result.valid:
        lines += ["", "For the top of an amplitude table:", *result.table_comments]
    return "\n".join(lines)


def value_in_words(value: CalibratedValue) -> str:
    """Return '1161.0 +- 3.2', or the bare value with six digits where its error is not known."""
    error = value.standard_error
    return f"{value.value:.6g}" if error is None else with_error(value.value, error)


def point_records(result: Calibration) -> list[dict[str, Any]]:
    """Return a mapping per point, with the columns `POINT_COLUMNS`; what was not measured is missing."""
    sweep, curves = result.sweep, result.curves
    columns = {
        "line": sweep.lines,
        "frequency_khz": sweep.frequency_khz,
        "measured_amplitude": sweep.amplitude,
        "fitted_amplitude": curves.amplitude,
        "amplitude_misfit": curves.amplitude_misfit,
        "measured_phase_deg": sweep.phase_deg,
        "fitted_phase_deg": curves.phase_deg,
        "phase_misfit_deg": curves.phase_misfit_deg,
    }
    known = {name: column.tolist() for name, column in columns.items() if column is not None}
    return [{name: column[i] for name, column in known.items()} for i in range(sweep.points)]


def write_calibration(
    result: Calibration,
    folder: Path,
    write_table: Callable[[str, list[dict[str, Any]], tuple[str, ...]], None],
    text: str,
    data: dict[str, Any],
) -> list[Path]:
    """Write calibration.txt, calibration.json, calibration.png and calibration_points.csv into a folder.

    Args:
        result: the calibration.
        folder: an existing folder; files of these names are replaced.
        write_table: called with a file name, records and columns for the CSV file.
        text: of calibration.txt.
        data: of calibration.json.

    Returns:
        The files written here (the table is `write_table`'s).

    Raises:
        OSError: if a file cannot be written.
    """
    from afm_jax.plots.picture_style import png_of  # noqa: PLC0415
    from fitting.report.report import write_report_files  # noqa: PLC0415

    picture = png_of(calibration_figure(result))
    written = write_report_files(folder, "calibration", text=text, data=data, picture=picture)
    write_table("calibration_points.csv", point_records(result), POINT_COLUMNS)
    return written


def _value_cells(name: str, value: CalibratedValue, unit: str) -> list[str]:
    low, high = value.interval95
    inside = f"none: {value.interval_reason}" if low is None or high is None else interval(low, high)
    shown = value_alone(value.value, value.standard_error, unknown=".6g")
    return [name, shown, known(value.standard_error, ".2g"), f"{inside}{unit}"]


def _comparison_lines(result: Calibration) -> list[str]:
    lines = []
    if result.peak_frequency_khz is not None:
        lower_hz = 1e3 * (result.frequency_khz.value - result.peak_frequency_khz)
        lines.append(f"  The response without background is largest {lower_hz:.3g} Hz below frequency_khz.")
    found = result.sweep.instrument
    if "frequency_khz" in found:
        difference_hz = 1e3 * (result.frequency_khz.value - found["frequency_khz"])
        lines.append(f"  The instrument says {found['frequency_khz']:.8g} kHz: this fit {difference_hz:+.3g} Hz.")
    if "quality_factor" in found:
        share = 100.0 * (result.quality_factor.value / found["quality_factor"] - 1.0)
        lines.append(f"  The instrument says Q = {found['quality_factor']:g}: this fit {share:+.2f} %.")
    for other in result.alternatives:
        error = "" if other.quality_factor_error is None else f" +- {other.quality_factor_error:.2g}"
        values = f"{other.frequency_khz:.8g} kHz, Q {other.quality_factor:.6g}{error}"
        per_freedom = other.chi2 / other.degrees_of_freedom
        lines.append(f"  background '{other.background}' instead: {values}, chi2/dof {per_freedom:.3g}")
    return ["", *lines] if lines else []


def _goodness_line(result: Calibration) -> str:
    errors = result.errors
    probability = f", probability {result.p_value:.2g}" if np.isfinite(result.p_value) else ""
    unit = f" {result.sweep.amplitude_unit}".rstrip()
    noise = f"errors ({errors.origin}): amplitude {errors.amplitude:.3g}{unit}"
    if errors.frequency_jitter_hz is not None:
        noise += f", drive frequency {errors.frequency_jitter_hz:.2g} Hz"
    return (
        f"  chi2/dof = {result.chi2:.1f}/{result.degrees_of_freedom}{probability}; {noise}; "
        f"neighbouring residuals' correlation {result.residual_autocorrelation:+.2f}"
    )


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
    if result.model == "power":
        grid[0, 0].set_yscale("log")
    grid[0, 0].legend(fontsize=_SMALL, loc="upper right")
    _mark_instrument(grid[0, 0], result)
    if result.model == "power":
        _draw_misfit(grid[1, 0], shift, 100.0 * curves.amplitude_misfit / curves.amplitude, "fit - measured\n(%)")
    else:
        _draw_misfit(grid[1, 0], shift, curves.amplitude_misfit, f"fit - measured\n{unit.strip()}".strip())
    if result.sweep.phase_deg is not None and curves.phase_deg is not None and curves.phase_misfit_deg is not None:
        measured = np.rad2deg(np.unwrap(np.deg2rad(result.sweep.phase_deg)))
        _draw_curve(grid[0, 1], result, shift, measured, measured + curves.phase_deg - result.sweep.phase_deg)
        label_axes(grid[0, 1], x="", y="phase (degrees)")
        _draw_misfit(grid[1, 1], shift, curves.phase_misfit_deg, "fit - measured\n(degrees)")
    title = f"f0 = {value_in_words(result.frequency_khz)} kHz,  Q = {value_in_words(result.quality_factor)}"
    title += f"  (background '{result.background}')"
    title = title.replace("+-", "±")
    figure.suptitle(title if result.valid else f"NOT VALID    {title}", color="black" if result.valid else _INVALID)
    return figure


def slope_figure(curves: list[MeasuredCurve], found: Stiffness) -> Figure:
    """Return the figure of force curves, the sensitivity found as a straight line through the end of each."""
    figure = new_figure(7.0, 4.6)
    axes = figure.subplots()
    for curve in curves:
        volts = np.asarray(curve.deflection)
        for branch in dict.fromkeys(curve.branch.tolist()):
            here = curve.branch == branch
            axes.plot(curve.offset_nm[here], volts[here], "-", lw=0.7, color=DARK)
        last = int(np.argmax(curve.offset_nm))
        reach = 0.5 * np.ptp(volts) * found.value.value
        height = curve.offset_nm[last] + np.array([-reach, 0.0])
        axes.plot(height, volts[last] + np.array([-reach, 0.0]) / found.value.value, "--", lw=1.4, color=ACCENT)
    label_axes(axes, x="height of the sample (nm)", y="deflection (V)")
    axes.set_title(f"{value_in_words(found.value)} nm/V".replace("+-", "±"))
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
