"""What a fit found, as tables: parameters, their correlations, and the rows with what is odd about each."""

import numpy as np

from fitting.parameters import PARAMETERS
from fitting.report import interval_in_words, value_in_words
from fitting.reporting.report_html_elements import Markup, element, in_signs, section, table
from fitting.result import FitResult, FittedParameter

MOST_ROWS = 1500
"""Rows beyond that stay in the CSV file: the page is for reading."""
_TIED = 0.9
_FAR = 3.0
"""Residual in standard errors from which a row is marked."""
_KINDS = ("peak", "lock-in")


def parameter_section(result: FitResult) -> Markup:
    """Return the parameters with errors, intervals, and what was known beforehand."""
    head = ["parameter", "meaning", "value", "std. error", "95 % interval", "unit", "given", "remarks"]
    rows = [
        [
            name,
            PARAMETERS[name].meaning,
            value_in_words(parameter),
            "-" if parameter.standard_error is None else f"{parameter.standard_error:.2g}",
            interval_in_words(parameter),
            in_signs(parameter.unit),
            "-" if parameter.constraint is None else f"{parameter.constraint[0]:g} ± {parameter.constraint[1]:g}",
            "; ".join(_remarks(parameter)),
        ]
        for name, parameter in result.parameters.items()
    ]
    caption = "Standard errors from the Fisher information, intervals from the profile of chi2"
    goodness = f"AIC {result.aic:.1f}, BIC {result.bic:.1f}"
    if np.isfinite(result.residual_autocorrelation):
        goodness += f"; correlation of neighbouring residuals {result.residual_autocorrelation:+.2f}"
    words = ("meaning", "95 % interval", "unit", "remarks")
    return section(
        "Parameters", table(caption, head, rows, words=words), element("p", f"{goodness}."), name="parameters"
    )


def _remarks(parameter: FittedParameter) -> list[str]:
    said = (
        (parameter.undetermined, "not determined by the data"),
        (parameter.at_bound, "at its bound"),
        (parameter.did_not_move, "did not move from its start"),
    )
    return [words for holds, words in said if holds]


def correlation_section(result: FitResult) -> Markup:
    """Return the matrix of correlations; strong ones stand out."""
    names = list(result.parameters)
    rows = [
        [name, *(_correlation(number) for number in line)]
        for name, line in zip(names, result.correlations.tolist(), strict=True)
    ]
    caption = f"Beyond {_TIED:g} in magnitude in bold; - where a variance is not known"
    return section("Correlations", table(caption, ["", *names], rows), name="correlations")


def _correlation(number: float) -> str:
    if not np.isfinite(number):
        return "-"
    words = f"{number:+.3f}"
    return element("strong", words) if _TIED < abs(number) < 1.0 - 1e-12 else words


def rows_section(result: FitResult) -> Markup:
    """Return every row: drive, approach speed, measured and predicted amplitudes, and what is odd about it."""
    shown = min(result.table.rows, MOST_ROWS)
    kinds = [kind for kind in range(2) if np.isfinite(result.rows.measured_nm[:, kind]).any()]
    head = ["line", "N", "frequency (kHz)", "drive (nm)", "offset (nm)", Markup("u<sub>in</sub> (nm/µs)")]
    for kind in kinds:
        head += [f"{_KINDS[kind]} (nm)", "±", "predicted", "residual"]
    head += ["model error (%)", "remarks"]
    remarks = [_row_remarks(result, i) for i in range(shown)]
    caption = (
        "Amplitudes in nm, ± with the model's own error, residuals in standard errors. "
        "Shaded: set aside, or otherwise to be looked at"
    )
    cells = [[*_row_cells(result, i, kinds), "; ".join(remarks[i])] for i in range(shown)]
    body = table(caption, head, cells, words=("remarks",), marked=[bool(words) for words in remarks])
    return section("Rows", body, left_out(result.table.rows, "fit_rows.csv"), name="rows")


def left_out(count: int, where: str) -> Markup:
    """Return the sentence that says where the rows are that a long table leaves out."""
    if count <= MOST_ROWS:
        return Markup()
    return element("p", f"The first {MOST_ROWS} of {count} rows; all of them are in {where}, written beside this page.")


def _row_cells(result: FitResult, i: int, kinds: list[int]) -> list[str]:
    table_, rows = result.table, result.rows
    cells = [
        f"{table_.lines[i]}",
        f"{table_.order[i]}",
        f"{table_.drive_frequency_khz[i]:g}",
        f"{table_.drive_amplitude_nm[i]:g}",
        f"{table_.offset_nm[i]:g}",
        _number(rows.approach_speed_nm_per_us[i], ".4g"),
    ]
    for kind in kinds:
        cells += [
            _number(rows.measured_nm[i, kind], ".5g"),
            _number(rows.error_nm[i, kind], ".2g"),
            _number(rows.predicted_nm[i, kind], ".5g"),
            _number(rows.residual[i, kind], "+.2f"),
        ]
    return [*cells, f"{100.0 * rows.model_error[i]:.2g}"]


def _number(value: float, form: str) -> str:
    return f"{value:{form}}" if np.isfinite(value) else "-"


def _row_remarks(result: FitResult, i: int) -> list[str]:
    rows = result.rows
    seen = result.table.no_orbit is not None and result.table.no_orbit[i] > 0
    exists = rows.orbits[i] > 0
    residual = rows.residual[i][np.isfinite(rows.residual[i])]
    said = (
        (rows.set_aside[i], "set aside: this impact is too slow for the law to describe it"),
        (seen and exists, "nothing steady seen, though an orbit is predicted"),
        (seen and not exists, "nothing steady seen, as predicted"),
        (not seen and not exists, "no stable orbit at the fitted law"),
        (rows.orbits[i] > 1, f"{rows.orbits[i]} stable orbits, the closest taken"),
        (rows.near_fold[i], "close to a fold"),
        (residual.size and np.abs(residual).max() > _FAR, f"more than {_FAR:g} errors off"),
    )
    return [words for holds, words in said if holds]
