"""A fit as one HTML file: what the page shows, as plain data; how it looks is in fit.html.jinja."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
from markupsafe import Markup

from afm_jax.words import known, plain_words
from fitting.fits.minimum import TOO_SLOW
from fitting.fits.result import FitResult, FittedRows
from fitting.parameters import NUISANCE_NAMES, PARAMETERS
from fitting.report.page import Table, in_signs, page, pairs, pictures_of
from fitting.report.words import (
    PULLS,
    SHARE_OF_BAND,
    ComparedModels,
    Sampled,
    band_in_words,
    goodness_in_words,
    has_delay,
    held_in_words,
    interval_in_words,
    law_points,
    losses_in_words,
    nuisances_in_words,
    parting_in_words,
    prior_in_words,
    remarks_on,
    rounded_values,
    scatter_in_words,
    tables_in_words,
    value_in_words,
)
from fitting.tables.table import AmplitudeTable

_MOST_ROWS = 1500
"""Rows beyond that stay in the CSV file: the page is for reading."""
_TIED = 0.9
_FAR = 3.0
"""Residual in standard errors from which a row is marked."""
_LONGEST = 12
"""Lists longer than that are samples, not findings."""
_APPROACH = Markup("u<sub>in</sub> (nm/µs)")
_COMPARED = {
    "model": "model",
    "chi2": "chi2",
    "degrees_of_freedom": "dof",
    "aic": "AIC",
    "bic": "BIC",
    "delta_aic": "AIC above the best",
    "law_change": "change of the law",
}
_CHECKS = {
    "converged": "gradient, curvature and distance are those of a minimum",
    "gradient": "largest slope of chi2, per standard error",
    "hessian_eigenvalues": "of chi2/2 in units of standard errors: about 1 each at a good minimum",
    "estimated_distance": "by how much chi2 lies above its minimum",
    "outward": "at a bound, chi2 falls towards the outside only",
}


def fit_page(
    result: FitResult,
    pictures: Sequence[bytes],
    *,
    comparison: ComparedModels | None = None,
    bootstrap: Sampled | None = None,
    posterior: Sampled | None = None,
) -> str:
    """Return the page; it is well-formed XML too.

    Args:
        result: the fit.
        pictures: SVG files of the rows, the law, and the residuals over the speed.
        comparison: other models of the same table, or None.
        bootstrap: intervals from synthetic data sets, or None.
        posterior: credible intervals, or None.
    """
    names = [*result.parameters, *(result.settings.get("fixed") or {})]
    numbers = {name: PARAMETERS[name].symbol or name for name in names}
    if result.valid and result.model != "contact":
        numbers = rounded_values(result)
    samples = {"Bootstrap": bootstrap, "Posterior": posterior}
    return page(
        "fit.html.jinja",
        result=result,
        title=f"Impact law of {result.table.source}",
        prior=prior_in_words(result),
        held=in_signs(held_in_words(result)),
        numbers=numbers,
        lasting=result.model.endswith("+delay"),
        said=_what_the_data_say(result),
        parting=in_signs(parting_in_words(result)),
        digits=f"{100.0 * SHARE_OF_BAND:g}",
        sure=f"{in_signs(band_in_words(result))} {goodness_in_words(result)}",
        comparison=comparison,
        compared=None if comparison is None else _compared(comparison),
        pictures=_pictures(result, pictures),
        points=_points(result),
        losses=_losses(result),
        parameters=_parameters(result),
        goodness=_goodness(result),
        correlations=_correlations(result),
        samples=[_sampled(title, one, list(result.parameters)) for title, one in samples.items() if one is not None],
        rows=_rows(result),
        minimum=_minimum(result),
        tables=_tables(result),
        inputs=[(_instrument(one), one.remarks, _measured(one)) for one in result.table.tables],
        settings=pairs("Options of the fit", ("option", "value"), result.settings),
        versions=pairs("Versions of what computed it", ("package", "version"), result.versions),
    )


def _what_the_data_say(result: FitResult) -> Table:
    own = {name: parameter for name, parameter in result.parameters.items() if name not in NUISANCE_NAMES}
    caption = "What the data say"
    if len(own) < len(result.parameters):
        caption += " (calibration and damping are fitted along, see Parameters)"
    rows = [[name, value_in_words(p), interval_in_words(p), in_signs(p.unit)] for name, p in own.items()]
    return Table(caption, ["parameter", "value", "95 % interval", "unit"], rows, words=("95 % interval", "unit"))


def _tables(result: FitResult) -> list[Table]:
    """Return pulls of several tables, what each has to itself, and the scatter between them; nothing of one."""
    if not result.tables:
        return []
    captions = (PULLS, "Scatter of the law between tables", "What each table has to itself")
    found = zip(captions, (tables_in_words(result), scatter_in_words(result), nuisances_in_words(result)), strict=True)
    return [
        Table(caption, head, [[in_signs(cell) for cell in row] for row in rows], words=("95 % interval", "unit"))
        for caption, (head, rows) in found
        if rows
    ]


def _pictures(result: FitResult, files: Sequence[bytes]) -> list[dict[str, str]]:
    """Return the pictures with what is to be seen."""
    law = "Rebound speed and energy lost over the approach speed, with their 95 % bands."
    if has_delay(result):
        law = "Rebound speed, energy lost and collision delay over the approach speed, with their 95 % bands."
    shows = (
        "Amplitudes of each row, measured and predicted; below, how far apart they are in standard errors.",
        law if result.valid else f"{law} Not a measurement: see the verdict.",
        "What is left of each amplitude over the approach speed, in standard errors: a wrong law leaves a curve here.",
        "The energy that an impact takes over the approach speed, with its 95 % band; dashed, by the formula.",
    )[: len(files)]
    return pictures_of(files, shows)


def _losses(result: FitResult) -> Table | None:
    rows = losses_in_words(result)
    if not (result.valid and rows):
        return None
    cells = [[in_signs(cell) for cell in row] for row in rows]
    return Table("What an impact takes", ["quantity", "value (95 % interval)"], cells, words=("value (95 % interval)",))


def _points(result: FitResult) -> Table | None:
    points = law_points(result)
    if not (result.valid and points):
        return None
    head = [_APPROACH, Markup("u<sub>out</sub> (nm/µs)"), "95 % band", "energy lost (%)"]
    head += ["delay τ (ns)", "95 % band"] if has_delay(result) else []
    return Table("The law at round speeds among the measured ones", head, points)


def _parameters(result: FitResult) -> Table:
    head = ["parameter", "meaning", "value", "std. error", "95 % interval", "unit", "given", "remarks"]
    rows = [
        [
            name,
            PARAMETERS[name].meaning,
            value_in_words(parameter),
            known(parameter.standard_error, ".2g"),
            interval_in_words(parameter),
            in_signs(parameter.unit),
            "-" if parameter.constraint is None else "{:g} ± {:g}".format(*parameter.constraint),
            remarks_on(parameter),
        ]
        for name, parameter in result.parameters.items()
    ]
    caption = "Standard errors from the Fisher information, intervals from the profile of chi2"
    if result.model.endswith("+delay"):
        caption += ", both with what the law leaves out"
    return Table(caption, head, rows, words=("meaning", "95 % interval", "unit", "remarks"))


def _goodness(result: FitResult) -> str:
    goodness = f"AIC {result.aic:.1f}, BIC {result.bic:.1f}"
    if np.isfinite(result.residual_autocorrelation):
        goodness += f"; correlation of neighbouring residuals {result.residual_autocorrelation:+.2f}"
    return f"{goodness}."


def _correlations(result: FitResult) -> Table:
    """Return the matrix of correlations; strong ones stand out."""
    names = list(result.parameters)
    rows = []
    for name, line in zip(names, result.correlations.tolist(), strict=True):
        strong = [_TIED < abs(number) < 1.0 - 1e-12 for number in line]
        cells = [known(number, "+.3f") for number in line]
        bold = Markup("<strong>{}</strong>").format
        rows.append([name, *(bold(cell) if tied else cell for cell, tied in zip(cells, strong, strict=True))])
    return Table(f"Beyond {_TIED:g} in magnitude in bold; - where a variance is not known", ["", *names], rows)


def _compared(comparison: ComparedModels) -> Table:
    others = dict.fromkeys(name for row in comparison.rows for name in row if name not in _COMPARED)
    names = [*(name for name in _COMPARED if any(name in row for row in comparison.rows)), *others]
    rows = [[plain_words(row.get(name)) for name in names] for row in comparison.rows]
    return Table("Models of the same amplitudes", [_COMPARED.get(name, name) for name in names], rows)


def _sampled(title: str, sampled: Sampled, parameters: Sequence[str]) -> dict[str, Any]:
    """Return what a bootstrap or a posterior found: a row for each parameter, and everything else by name.

    Args:
        title: the section's heading.
        sampled: what was found.
        parameters: the fit's parameters; a mapping with these keys is a column.
    """
    found = sampled.to_dict()
    flat = {name: value for name, value in _flat(found, parameters).items() if value is not None and not _long(value)}
    columns = {name: value for name, value in flat.items() if _by_parameter(value, parameters)}
    others = {_title(name): value for name, value in flat.items() if name not in columns}
    rows = [[name, *(_cell(column.get(name)) for column in columns.values())] for name in parameters]
    return {
        "title": title,
        "failed": found.get("converged") is False,
        "by_parameter": Table("By parameter", ["parameter", *map(_title, columns)], rows) if columns else None,
        "besides": pairs("Besides", ("", "value"), others) if others else None,
    }


def _title(name: str) -> str:
    return name.removeprefix("parameters ").replace("interval95", "95 % interval").replace("_", " ")


def _cell(value: Any) -> str:
    """Return a value, or an interval as '0.9 to 0.99'."""
    if isinstance(value, (list, tuple)) and len(value) == 2:
        return " to ".join(map(plain_words, value))
    return "-" if value is None else plain_words(value)


def _flat(found: Mapping[str, Any], parameters: Sequence[str], before: str = "") -> dict[str, Any]:
    """Return what was found with the names of nested mappings joined, down to mappings by parameter."""
    flat = {}
    for name, value in found.items():
        if isinstance(value, Mapping) and value and not _by_parameter(value, parameters):
            flat |= _flat(value, parameters, f"{before}{name} ")
        elif _by_parameter(value, parameters) and all(isinstance(item, Mapping) for item in value.values()):
            inner = dict.fromkeys(key for item in value.values() for key in item)
            flat |= {f"{before}{name} {key}": {p: item.get(key) for p, item in value.items()} for key in inner}
        else:
            flat[f"{before}{name}"] = value
    return flat


def _by_parameter(value: Any, parameters: Sequence[str]) -> bool:
    return isinstance(value, Mapping) and bool(value) and set(value) <= set(parameters)


def _long(value: Any) -> bool:
    """Say whether a value holds more numbers than one reads."""
    if isinstance(value, Mapping):
        return any(map(_long, value.values()))
    if not isinstance(value, (list, tuple)):
        return False
    return len(value) > _LONGEST or any(isinstance(item, (list, tuple)) for item in value)


def _rows(result: FitResult) -> Table:
    """Return every row: drive, approach speed, measured and predicted amplitudes, and what is odd about it."""
    table, rows = result.table, result.rows
    shown = range(min(table.rows, _MOST_ROWS))
    columns: list[tuple[str, np.ndarray, str]] = [
        ("line", table.lines, ".0f"),
        ("N", table.order, ".0f"),
        ("frequency (kHz)", table.drive_frequency_khz, "g"),
        ("free (nm)" if table.tapping else "drive (nm)", table.excitation_nm, "g"),
        ("offset (nm)", table.offset_nm, "g"),
        (_APPROACH, rows.approach_speed_nm_per_us, ".4g"),
    ]
    for kind, name in enumerate(("peak", "lock-in")):
        if np.isfinite(rows.measured_nm[:, kind]).any():
            columns += [
                (f"{name} (nm)", rows.measured_nm[:, kind], ".5g"),
                ("±", rows.error_nm[:, kind], ".2g"),
                ("predicted", rows.predicted_nm[:, kind], ".5g"),
                ("residual", rows.residual[:, kind], "+.2f"),
            ]
    if rows.measured_phase_deg is not None and rows.predicted_phase_deg is not None:
        columns += [
            ("phase (degrees)", rows.measured_phase_deg, ".5g"),
            ("±", np.full(table.rows, np.nan) if rows.phase_error_deg is None else rows.phase_error_deg, ".2g"),
            ("predicted", rows.predicted_phase_deg, ".5g"),
            ("residual", rows.residual[:, 2], "+.2f"),
        ]
    columns.append(("model error (%)", 100.0 * rows.model_error, ".2g"))
    numbers = zip(
        *([known(value, form) for value in column[: len(shown)].astype(float).tolist()] for _, column, form in columns),
        strict=True,
    )
    lines = table.row_names.tolist()
    unseen = np.zeros(table.rows, dtype=bool) if table.no_orbit is None else table.no_orbit > 0
    remarks = [_row_remarks(rows, i, unseen=bool(unseen[i])) for i in shown]
    caption = (
        "Amplitudes in nm, ± with the model's own error, residuals in standard errors. "
        "Shaded: set aside, or otherwise to be looked at"
    )
    return Table(
        caption,
        [*(name for name, _, _ in columns), "remarks"],
        [[line, *cells[1:], words] for line, cells, words in zip(lines[: len(shown)], numbers, remarks, strict=True)],
        words=("remarks",),
        marked={i for i in shown if remarks[i]},
        left_out=_left_out(table.rows, "fit_rows.csv"),
    )


def _left_out(count: int, where: str) -> str:
    if count <= _MOST_ROWS:
        return ""
    return f"The first {_MOST_ROWS} of {count} rows; all of them are in {where}, written beside this page."


def _why_aside(rows: FittedRows, i: int) -> str:
    reason = rows.reasons[i] if rows.reasons else TOO_SLOW
    said = "this impact is too slow for the law to describe it" if reason == TOO_SLOW else reason
    return f"set aside: {said}"


def _row_remarks(rows: FittedRows, i: int, *, unseen: bool) -> str:
    exists = rows.orbits[i] > 0
    said = (
        (rows.set_aside[i], _why_aside(rows, i)),
        (unseen and exists, "nothing steady seen, though an orbit is predicted"),
        (unseen and not exists, "nothing steady seen, as predicted"),
        (not unseen and not exists, "no stable orbit at the fitted law"),
        (rows.orbits[i] > 1, f"{rows.orbits[i]} stable orbits, the closest taken"),
        (rows.near_fold[i], "close to a fold"),
        (np.any(np.abs(rows.residual[i]) > _FAR), f"more than {_FAR:g} errors off"),
    )
    return "; ".join(words for holds, words in said if holds)


def _minimum(result: FitResult) -> Table:
    rows = [[name, plain_words(value), _CHECKS.get(name, "")] for name, value in asdict(result.convergence).items()]
    return Table("Checked whatever the optimiser says", ["", "found", "meaning"], rows, words=("meaning",))


def _instrument(measured: AmplitudeTable) -> Table:
    quality = "none: no air damping" if measured.quality_factor is None else f"{measured.quality_factor:g}"
    if measured.quality_factor is not None and np.isnan(measured.quality_factor):
        quality = "not given"
    if measured.quality_factor_error is not None:
        quality += f" ± {measured.quality_factor_error:g}"
    spread = measured.free_frequency_error_khz
    header = {
        "source": measured.source,
        "drive": measured.drive,
        "free_frequency_khz": f"{measured.free_frequency_khz:g}" + ("" if spread is None else f" ± {spread:g}"),
        "quality_factor": quality,
        "mass_ng": "not given" if measured.mass_ng is None else f"{measured.mass_ng:g}",
    }
    header |= {name: f"{value:g} ± {error:g}" for name, (value, error) in measured.calibration.items()}
    return pairs("What the table says of the instrument", ("", "value"), header)


def _measured(measured: AmplitudeTable) -> Table:
    """Return the table that was fitted; names may be broken after underscores, so that narrow columns hold them."""
    names = [name for name in measured.form.names if getattr(measured, name) is not None]
    columns = [measured.lines, *(getattr(measured, name) for name in names)]
    rows = zip(*(column[:_MOST_ROWS].tolist() for column in columns), strict=True)
    return Table(
        "The table's rows; empty where nothing was measured",
        ["line", *(Markup("_<wbr/>").join(name.split("_")) for name in names)],
        [["" if np.isnan(value) else f"{value:.15g}" for value in row] for row in rows],
        left_out=_left_out(measured.rows, "fit.json"),
    )
