"""A calibration as a person reads it: sections, the files of --out, and the picture of the scan with the fit."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from afm_jax.plots.picture_style import ACCENT, DARK, GRID, label_axes, new_figure
from afm_jax.words import interval, known, value_alone, with_error
from fitting.calibration.result import CalibratedValue, Calibration
from fitting.calibration.stiffness import WORTH, Stiffness, budget, doubts, uncalibrated
from fitting.instruments.curve import MeasuredCurve
from fitting.report.files import write_with_picture
from fitting.report.sections import Bullets, Report, ReportSection, Table, Text

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


def calibration_report(result: Calibration, found: Sequence[Stiffness] = ()) -> Report:
    """Return the calibration as sections: the values, their comparison, goodness of fit, notes, spring constants.

    Args:
        result: of frequency and quality factor.
        found: spring constants of the lever.
    """
    what = {"phase": "amplitude and phase", "power": "thermal spectrum"}.get(result.model, "amplitude")
    doubt = uncalibrated(found)
    verdict = "VALID" if result.valid else "NOT VALID: the numbers below are not a calibration."
    if result.valid and doubt is not None:
        verdict = "NOT VALID: frequency and quality factor are calibrated, the spring constant is not."
    head = ["", "value", "std. error", "95 % interval"]
    values = [
        _value_cells("frequency_khz", result.frequency_khz, "  kHz"),
        _value_cells("quality_factor", result.quality_factor, ""),
    ]
    compared, sections = _comparison_lines(result), []
    if compared:
        sections.append(ReportSection("Comparison", [_lines(compared)]))
    sections.append(ReportSection("Goodness of fit", [_lines([_goodness_line(result)])]))
    if result.warnings:
        sections.append(ReportSection("Notes", [Bullets(result.warnings, "Notes:")], "Notes"))
    if result.valid:
        comments = ["For the top of an amplitude table:", *result.table_comments]
        sections.append(ReportSection("For an amplitude table", [_lines(comments)], "Table"))
    return Report(
        title=f"Free resonance of {result.sweep.source} ({result.sweep.points} points, {what})",
        about=[f"background '{result.background}': {_BACKGROUNDS[result.model, result.background]}"],
        valid=result.valid and doubt is None,
        verdict=verdict,
        reasons=[*result.reasons, *([] if doubt is None else [doubt])],
        sections=[
            ReportSection("Values", [Table("Of the free cantilever", head, values, words=head[3:])], "Values"),
            *sections,
            *(stiffness_sections(result, found) if found else []),
        ],
    )


def _lines(lines: Sequence[str]) -> Text:
    return Text("\n".join(lines), "lines")


def stiffness_sections(calibration: Calibration, found: Sequence[Stiffness]) -> list[ReportSection]:
    """Return spring constants with what they rest on, doubts about them, a table's line, and what each is worth."""
    stated, parts = calibration.sweep.instrument.get("spring_constant_n_per_m"), []
    for one in found:
        parts += [Text(f"{one.method}: {_in_words(one.value, 'N/m')}"), Bullets(one.assumed)]
        if stated is not None:
            apart = 100.0 * (one.value.value / stated - 1.0)
            parts.append(Text(f"  The instrument says {stated:g} N/m: this {apart:+.1f} %."))
    sections = [ReportSection("Spring constant", [Text("Spring constant:"), *parts], "Spring constant")]
    if doubts(found):
        sections.append(ReportSection("Doubts", [_lines(doubts(found))]))
    last = found[-1].value
    if last.standard_error is not None:
        line = f"# spring_constant_n_per_m = {with_error(last.value, last.standard_error)}"
        sections.append(ReportSection("For a table", [_lines(["For the top of a table:", line])]))
    return [*sections, _budget_section(calibration, found)]


def slope_report(curves: Sequence[MeasuredCurve], found: Stiffness) -> Report:
    """Return the sensitivity that force curves give as sections: what it rests on, and what it is worth."""
    return Report(
        title=f"deflection_nm_per_volt: {_in_words(found.value, 'nm/V')}, from {curves[0].source}",
        valid=True,
        verdict="VALID",
        reasons=(),
        sections=[ReportSection("Assumptions", [Bullets(found.assumed, "Assumed:")]), _budget_section(None, [found])],
    )


def _budget_section(calibration: Calibration | None, found: Sequence[Stiffness]) -> ReportSection:
    """Return what one standard error of each calibrated number changes of the energy of a tap and of a law."""
    head = ["one standard error of", "is", "of the energy of a tap", "of epsilon", "of 1 - r^2", ""]
    rows = budget(calibration, found)
    cells = [[row["quantity"], *(known(row[key], ".2%") for key in ("share", *WORTH)), row["why"]] for row in rows]
    return ReportSection("What it is worth", [Table("Relative changes", head, cells, words=head[5:])], "Worth")


def _in_words(value: CalibratedValue, unit: str) -> str:
    """Return a value with its error and interval; without error it is no calibration."""
    low, high = value.interval95
    if value.standard_error is None or low is None or high is None:
        return f"{value.value:.3g} {unit}, NOT VALID: no calibration"
    return f"{with_error(value.value, value.standard_error)} {unit} (95 % {interval(low, high)})"


def value_in_words(value: CalibratedValue) -> str:
    """Return '1161.0 +- 3.2', or the bare value with six digits where its error is not known."""
    error = value.standard_error
    return f"{value.value:.6g}" if error is None else with_error(value.value, error)


def _point_columns(result: Calibration) -> dict[str, np.ndarray | None]:
    """Return the points with the fit, by column; None for what was not measured."""
    sweep, curves = result.sweep, result.curves
    return {
        "line": sweep.lines,
        "frequency_khz": sweep.frequency_khz,
        "measured_amplitude": sweep.amplitude,
        "fitted_amplitude": curves.amplitude,
        "amplitude_misfit": curves.amplitude_misfit,
        "measured_phase_deg": sweep.phase_deg,
        "fitted_phase_deg": curves.phase_deg,
        "phase_misfit_deg": curves.phase_misfit_deg,
    }


def write_calibration(
    result: Calibration,
    folder: Path,
    write_table: Callable[[str, list[dict[str, Any]], tuple[str, ...]], None],
    found: Sequence[Stiffness],
    data: dict[str, Any],
) -> list[Path]:
    """Write calibration.html, .txt, .json and .png and calibration_points.csv into a folder.

    Args:
        result: the calibration.
        folder: an existing folder; files of these names are replaced.
        write_table: called with a file name, records and columns for the CSV file.
        found: spring constants of the lever.
        data: of calibration.json.

    Returns:
        The files written here (the table is `write_table`'s).

    Raises:
        OSError: if a file cannot be written.
    """
    shows = "Amplitude (and phase) with the fit; below, the misfit, fit less measured."
    report, figure = calibration_report(result, found), calibration_figure(result)
    written = write_with_picture(folder, "calibration", report, figure, shows, data, link="Picture")
    columns = _point_columns(result)
    known = {name: column.tolist() for name, column in columns.items() if column is not None}
    records = [{name: column[i] for name, column in known.items()} for i in range(result.sweep.points)]
    write_table("calibration_points.csv", records, tuple(columns))
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
        lines.append(f"  Without the background the response peaks {lower_hz:.3g} Hz below frequency_khz.")
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
    return lines


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
        _draw_misfit(grid[1, 0], shift, 100.0 * curves.amplitude_misfit / curves.amplitude, "misfit (%)")
    else:
        _draw_misfit(grid[1, 0], shift, curves.amplitude_misfit, f"misfit{unit}")
    if result.sweep.phase_deg is not None and curves.phase_deg is not None and curves.phase_misfit_deg is not None:
        measured = np.rad2deg(np.unwrap(np.deg2rad(result.sweep.phase_deg)))
        _draw_curve(grid[0, 1], result, shift, measured, measured + curves.phase_deg - result.sweep.phase_deg)
        label_axes(grid[0, 1], x="", y="phase (degrees)")
        _draw_misfit(grid[1, 1], shift, curves.phase_misfit_deg, "misfit (degrees)")
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
