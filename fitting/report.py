"""A fit as a person reads it: text for the terminal, files for the drawer (JSON, CSV, PNG)."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from fitting.reporting.report_band import band_in_words
from fitting.reporting.report_extras import Comparison, Sampled
from fitting.result import FitResult, FittedParameter

_MANY_PARAMETERS = 3
_WORTH_SAYING = 0.9
"""With more parameters than that, the text names only correlations beyond this magnitude."""
_DELAY = "tau = delay_hertz u_in^(-1/5) - delay_lead_nm (1/u_out - 1/u_in) - delay_offset_nm/u_in"
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
    "model_error",
    "used",
    "set_aside",
)
LAW_COLUMNS = (
    "approach_speed_nm_per_us",
    "rebound_speed_nm_per_us",
    "rebound_low_nm_per_us",
    "rebound_high_nm_per_us",
    "collision_delay_us",
    "delay_low_us",
    "delay_high_us",
)


def summary(result: FitResult) -> str:
    """Return the fit as text: verdict first, then the law, then goodness of fit and warnings."""
    lines = [
        f"Impact law of {result.table.source} ({rows_in_words(result.table.rows)}), model {result.model}:",
        *(f"  {formula}" for formula in formulas(result.model)),
        "",
        "VALID" if result.valid else "NOT VALID: the numbers below are not a measurement of the law.",
        *(f"  - {reason}" for reason in result.reasons),
        "",
        f"  {'parameter':<16}{'value':>12}{'std. error':>12}   95 % interval",
        *(f"  {_parameter_line(name, parameter)}" for name, parameter in result.parameters.items()),
        "",
        f"  {band_in_words(result)}",
        _goodness_line(result),
        *_correlation_lines(result),
    ]
    if result.warnings:
        lines += ["", "Notes:", *(f"  - {warning}" for warning in result.warnings)]
    return "\n".join(lines)


def rows_in_words(count: int) -> str:
    """Return '1 row' or '82 rows'."""
    return f"{count} row" if count == 1 else f"{count} rows"


def formulas(model: str) -> list[str]:
    """Return the model's law in formulas."""
    if model == "contact":
        return ["the law and the delay of the resolved contact (meniscus and JKR junction), by its parameters:"]
    law = _LAWS[model.removesuffix("+delay")]
    return [law, _DELAY] if model.endswith("+delay") else [law]


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
        "model_error": rows.model_error,
        "used": rows.used,
        "set_aside": rows.set_aside,
    }
    return [{name: column[i].item() for name, column in columns.items()} for i in range(table.rows)]


def law_records(result: FitResult) -> list[dict[str, float]]:
    """Return the law's points, with the columns `LAW_COLUMNS`."""
    columns = [getattr(result.law, name) for name in LAW_COLUMNS]
    return [dict(zip(LAW_COLUMNS, map(float, point), strict=True)) for point in zip(*columns, strict=True)]


def write_report(
    result: FitResult,
    folder: Path,
    write_table: Callable[[str, list[dict[str, Any]], tuple[str, ...]], None],
    *,
    comparison: Comparison | None = None,
    bootstrap: Sampled | None = None,
    posterior: Sampled | None = None,
) -> list[Path]:
    """Write fit.html, fit.txt, fit.json, fit.png and the tables fit_rows.csv and law.csv into a folder.

    Args:
        result: the fit.
        folder: an existing folder; files of these names are replaced.
        write_table: called with a file name, records and columns for each CSV file.
        comparison: other models of the same table, for fit.html.
        bootstrap: intervals from synthetic data sets, for fit.html.
        posterior: credible intervals, for fit.html.

    Returns:
        The files written here (the tables are `write_table`'s).

    Raises:
        OSError: if a file cannot be written.
    """
    from fitting.reporting.report_html import fit_page  # noqa: PLC0415
    from fitting.reporting.report_plot import fit_figure  # noqa: PLC0415

    page, text, data, picture = (folder / f"fit.{kind}" for kind in ("html", "txt", "json", "png"))
    markup = fit_page(result, comparison=comparison, bootstrap=bootstrap, posterior=posterior)
    page.write_text(markup, encoding="utf-8", newline="\n")
    # a path that is no valid text must not cost the report
    text.write_text(summary(result) + "\n", encoding="utf-8", errors="backslashreplace")
    data.write_text(json.dumps(result.to_dict(), indent=1, allow_nan=False) + "\n", encoding="utf-8")
    fit_figure(result).savefig(picture, dpi=150)
    write_table("fit_rows.csv", row_records(result), ROW_COLUMNS)
    write_table("law.csv", law_records(result), LAW_COLUMNS)
    return [page, text, data, picture]


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


def value_in_words(parameter: FittedParameter) -> str:
    """Return the value with the digits that its error warrants."""
    # Without an error three digits are all that can be claimed.
    return (
        f"{parameter.value:.3g}"
        if parameter.standard_error is None
        else f"{parameter.value:.{value_digits(parameter)}f}"
    )


def value_digits(parameter: FittedParameter) -> int:
    """Return the decimals that a value's error warrants, or three significant digits where there is none."""
    error = parameter.standard_error
    if error is not None:
        return _digits(4.0 * error)
    return _digits(0.1 * abs(parameter.value))


def _parameter_line(name: str, parameter: FittedParameter) -> str:
    shown = "-" if parameter.standard_error is None else f"{parameter.standard_error:.2g}"
    unit = f"  {parameter.unit}" if parameter.unit else ""
    given = ""
    if parameter.constraint is not None:
        given = f"  (given: {parameter.constraint[0]:g} +- {parameter.constraint[1]:g})"
    return f"{name:<16}{value_in_words(parameter):>12}{shown:>12}   {interval_in_words(parameter)}{unit}{given}"


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
    least = _WORTH_SAYING if len(names) > _MANY_PARAMETERS else 0.0
    pairs = [
        f"{names[i]}, {names[j]}: {result.correlations[i, j]:+.3f}"
        for i in range(len(names))
        for j in range(i + 1, len(names))
        if abs(result.correlations[i, j]) >= least
    ]
    title = f"correlations beyond {_WORTH_SAYING:g}" if least else "correlations"
    return [f"  {title}: {'; '.join(pairs)}"] if pairs else []
