"""A fit as a person reads it: text for the terminal, files for the drawer (JSON, CSV, PNG)."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from fitting.result import FitResult, FittedParameter

_LAWS = {
    "restitution": "u_out = r u_in",
    "law": "u_out^2 = r^2 u_in^2 - epsilon",
    "viscous": "u_out^2 = u_in^2 - viscous_loss u_in - epsilon",
}
ROW_COLUMNS = (
    "line",
    "order",
    "drive_frequency_khz",
    "drive_amplitude_nm",
    "offset_nm",
    "measured_peak_amplitude_nm",
    "predicted_peak_amplitude_nm",
    "peak_residual",
    "measured_lockin_amplitude_nm",
    "predicted_lockin_amplitude_nm",
    "lockin_residual",
    "approach_speed_nm_per_us",
    "stable_orbits",
)
LAW_COLUMNS = (
    "approach_speed_nm_per_us",
    "rebound_speed_nm_per_us",
    "rebound_low_nm_per_us",
    "rebound_high_nm_per_us",
)


def summary(result: FitResult) -> str:
    """Return the fit as text: verdict first, then the law, then goodness of fit and warnings."""
    lines = [
        f"Impact law of {result.table.source} ({result.table.rows} rows), model {result.model}:",
        f"  {_LAWS[result.model]}",
        "",
        "VALID" if result.valid else "NOT VALID: the numbers below are not a measurement of the law.",
        *(f"  - {reason}" for reason in result.reasons),
        "",
        f"  {'parameter':<16}{'value':>12}{'std. error':>12}   95 % interval",
        *(f"  {_parameter_line(name, parameter)}" for name, parameter in result.parameters.items()),
        "",
        _goodness_line(result),
        *_correlation_lines(result),
    ]
    if result.warnings:
        lines += ["", "Notes:", *(f"  - {warning}" for warning in result.warnings)]
    return "\n".join(lines)


def row_records(result: FitResult) -> list[dict[str, Any]]:
    """Return a mapping per row of the table, with the columns `ROW_COLUMNS`."""
    table, rows = result.table, result.rows
    columns = {
        "line": table.lines,
        "order": table.order,
        "drive_frequency_khz": table.drive_frequency_khz,
        "drive_amplitude_nm": table.drive_amplitude_nm,
        "offset_nm": table.offset_nm,
        "measured_peak_amplitude_nm": rows.measured_nm[:, 0],
        "predicted_peak_amplitude_nm": rows.predicted_nm[:, 0],
        "peak_residual": rows.residual[:, 0],
        "measured_lockin_amplitude_nm": rows.measured_nm[:, 1],
        "predicted_lockin_amplitude_nm": rows.predicted_nm[:, 1],
        "lockin_residual": rows.residual[:, 1],
        "approach_speed_nm_per_us": rows.approach_speed_nm_per_us,
        "stable_orbits": rows.orbits,
    }
    return [{name: column[i].item() for name, column in columns.items()} for i in range(table.rows)]


def law_records(result: FitResult) -> list[dict[str, float]]:
    """Return the law's points, with the columns `LAW_COLUMNS`."""
    columns = [getattr(result.law, name) for name in LAW_COLUMNS]
    return [dict(zip(LAW_COLUMNS, map(float, point), strict=True)) for point in zip(*columns, strict=True)]


def write_report(
    result: FitResult, folder: Path, write_table: Callable[[str, list[dict[str, Any]], tuple[str, ...]], None]
) -> list[Path]:
    """Write fit.txt, fit.json, fit.png and the tables fit_rows.csv and law.csv into a folder.

    Args:
        result: the fit.
        folder: an existing folder; files of these names are replaced.
        write_table: called with a file name, records and columns for each CSV file.

    Returns:
        The files written here (the tables are `write_table`'s).

    Raises:
        OSError: if a file cannot be written.
    """
    from fitting.report_plot import fit_figure  # noqa: PLC0415

    text, data, picture = folder / "fit.txt", folder / "fit.json", folder / "fit.png"
    text.write_text(summary(result) + "\n", encoding="utf-8")
    data.write_text(json.dumps(result.to_dict(), indent=1, allow_nan=False) + "\n", encoding="utf-8")
    fit_figure(result).savefig(picture, dpi=150)
    write_table("fit_rows.csv", row_records(result), ROW_COLUMNS)
    write_table("law.csv", law_records(result), LAW_COLUMNS)
    return [text, data, picture]


def interval_in_words(parameter: FittedParameter) -> str:
    """Return '0.9492 to 0.9508', a one-sided limit, or why there is none."""
    low, high = parameter.interval95
    if low is not None and high is not None:
        digits = _digits(high - low)
        return f"{low:.{digits}f} to {high:.{digits}f}"
    if high is not None:
        return f"< {high:.4g} ({parameter.interval_reason})"
    if low is not None:
        return f"> {low:.6g} ({parameter.interval_reason})"
    return f"none: {parameter.interval_reason}"


def _parameter_line(name: str, parameter: FittedParameter) -> str:
    error = parameter.standard_error
    # Without an error three digits are all that can be claimed.
    value = f"{parameter.value:.3g}" if error is None else f"{parameter.value:.{_digits(4.0 * error)}f}"
    shown = "-" if error is None else f"{error:.2g}"
    unit = f"  {parameter.unit}" if parameter.unit else ""
    given = ""
    if parameter.constraint is not None:
        given = f"  (given: {parameter.constraint[0]:g} +- {parameter.constraint[1]:g})"
    return f"{name:<16}{value:>12}{shown:>12}   {interval_in_words(parameter)}{unit}{given}"


def _digits(width: float) -> int:
    """Return the decimals that show a width to two significant digits."""
    if not np.isfinite(width) or width <= 0.0:
        return 4
    return int(np.clip(1 - np.floor(np.log10(width)), 0, 12))


def _goodness_line(result: FitResult) -> str:
    probability = f", probability {result.p_value:.2g}" if np.isfinite(result.p_value) else ""
    goodness = f"chi2/dof = {result.chi2:.1f}/{result.degrees_of_freedom}{probability}"
    return f"  {goodness}, AIC {result.aic:.1f}, BIC {result.bic:.1f}"


def _correlation_lines(result: FitResult) -> list[str]:
    names = list(result.parameters)
    pairs = [
        f"{names[i]}, {names[j]}: {result.correlations[i, j]:+.3f}"
        for i in range(len(names))
        for j in range(i + 1, len(names))
        if np.isfinite(result.correlations[i, j])
    ]
    return [f"  correlations: {'; '.join(pairs)}"] if pairs else []
