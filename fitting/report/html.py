"""A fit as one HTML file: what the page shows, section by section."""

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
from markupsafe import Markup

from afm_jax.words import known, plain_words
from fitting.fits.comparison import Comparison
from fitting.fits.minimum import TOO_SLOW
from fitting.fits.result import FitResult, FittedRows
from fitting.parameters import NUISANCE_NAMES, PARAMETERS
from fitting.report.sections import (
    Bullets,
    Part,
    Report,
    ReportSection,
    Table,
    Text,
    page_of,
    pairs,
    pictures_of,
)
from fitting.report.words import (
    PULLS,
    SHARE_OF_BAND,
    band_in_words,
    goodness_in_words,
    has_delay,
    held_in_words,
    interval_in_words,
    law_points,
    losses_in_words,
    nuisances_in_words,
    parting_in_words,
    remarks_on,
    rounded_values,
    tables_in_words,
    trust_in_words,
    value_in_words,
)
from fitting.sampling.posterior_result import Posterior
from fitting.tables.table import AmplitudeTable

_MOST_ROWS = 1500
"""Rows beyond that stay in the CSV file: the page is for reading."""
_TIED = 0.9
_FAR = 3.0
"""Residual in standard errors from which a row is marked."""
_MINUS = "\N{MINUS SIGN}"
_APPROACH = Markup("u<sub>in</sub> (nm/µs)")
_COMPARED = {
    "model": "model",
    "chi2": "chi2",
    "degrees_of_freedom": "dof",
    "aic": "AIC",
    "bic": "BIC",
    "delta_aic": "AIC above the best",
    "law_change": "change of the law",
    "valid": "valid",
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
    comparison: Comparison | None = None,
    posterior: Posterior | None = None,
) -> str:
    """Return the page; it is well-formed XML too.

    Args:
        result: the fit.
        pictures: SVG files of the rows, the law, and the residuals over the speed.
        comparison: other models of the same table, or None.
        posterior: credible intervals, or None.
    """
    tables = _tables(result)
    sections = [
        ReportSection(
            "What to know besides", [Bullets(result.warnings) if result.warnings else Text("None.")], "Notes"
        ),
        ReportSection("Pictures", _pictures_and_law(result, pictures), "Pictures"),
        ReportSection("Parameters", [_parameters(result), Text(_goodness(result))], "Parameters"),
        ReportSection("Correlations", [_correlations(result)]),
        *([ReportSection("Tables", tables, "Tables")] if tables else []),
        *([] if comparison is None else [_compared(comparison)]),
        *([] if posterior is None else [_sampled(posterior)]),
        ReportSection("Rows", [_rows(result)], "Rows"),
        ReportSection("Minimum", [_minimum(result)]),
        ReportSection("Inputs", [part for table in result.table.tables for part in _input(table)], "Inputs"),
        ReportSection(
            "Settings and versions",
            [
                pairs("Options of the fit", ("option", "value"), result.settings),
                pairs("Versions of what computed it", ("package", "version"), result.versions),
            ],
            "Settings",
        ),
    ]
    report = Report(f"Impact law of {result.table.source}", result.valid, "", result.reasons, sections)
    return page_of(report, _lead(result, comparison), trust_in_words(result))


def _lead(result: FitResult, comparison: Comparison | None) -> list[Part]:
    """Return what stands below the verdict: the law in formulas, what the data say of it, and how sure that is."""
    held, parting = held_in_words(result), parting_in_words(result)
    parts: list[Part] = [] if result.valid else [Text("What was tried:")]
    parts += _formulas(result)
    if held:
        parts.append(Text(f"{held}."))
    if result.valid and parting:
        parts.append(Text(parting))
    if result.valid and result.model != "contact":
        parts.append(
            Text(f"The digits are those it takes to be within {100.0 * SHARE_OF_BAND:g} % of the band's half-width.")
        )
    if result.valid:
        parts.append(_what_the_data_say(result))
    parts.append(Text(f"{band_in_words(result)} {goodness_in_words(result)}"))
    if comparison is not None:
        parts.append(Text(f"Against other models: {comparison.verdict}"))
    return parts


def _formulas(result: FitResult) -> list[Part]:
    """Return the law, and the delay of impacts that last, with the fitted numbers in them; symbols if not valid."""
    if result.model == "contact":
        return [Text("The law and the delay of the resolved contact (meniscus and junction).")]
    names = [*result.parameters, *(result.settings.get("fixed") or {})]
    numbers = {name: PARAMETERS[name].symbol or name for name in names}
    if result.valid:
        numbers = rounded_values(result)
    u_in, u_out, square = Markup("u<sub>in</sub>"), Markup("u<sub>out</sub>"), Markup("<sup>2</sup>")

    def less(name: str) -> str:
        number = numbers[name]
        return f" + {number[1:]}" if number.startswith("-") else f" {_MINUS} {number}"

    squared = Markup("({} {}){}").format(numbers["r"], u_in, square) if "r" in numbers else u_in + square
    if result.model.startswith("restitution"):
        law = Markup("{} = {} {}").format(u_out, numbers["r"], u_in)
    elif result.model.startswith("law"):
        law = Markup("{}{} = {}{}").format(u_out, square, squared, less("epsilon"))
    else:
        law = Markup("{}{} = {}{} {}{}").format(u_out, square, squared, less("viscous_loss"), u_in, less("epsilon"))
    parts: list[Part] = [Text(law, "formula")]
    lasting = result.model.endswith("+delay")
    if lasting:
        delay = Markup(
            "τ = {hertz} {u_in}<sup>{minus}1/5</sup>{lead} (1/{u_out} {minus} 1/{u_in}){offset}/{u_in}"
        ).format(
            minus=_MINUS,
            hertz=numbers["delay_hertz"],
            lead=less("delay_lead_nm"),
            offset=less("delay_offset_nm"),
            u_in=u_in,
            u_out=u_out,
        )
        parts.append(Text(delay, "formula"))
    speeds = Markup("Speeds in nm/µs relative to the sample, both positive: approach {}, rebound {}.").format(
        u_in, u_out
    )
    return [*parts, Text(speeds + (" Delay τ in µs." if lasting else ""))]


def _what_the_data_say(result: FitResult) -> Table:
    own = {name: parameter for name, parameter in result.parameters.items() if name not in NUISANCE_NAMES}
    caption = "What the data say"
    if len(own) < len(result.parameters):
        caption += " (calibration and damping are fitted along, see Parameters)"
    rows = [[name, value_in_words(p), interval_in_words(p), p.unit] for name, p in own.items()]
    return Table(caption, ["parameter", "value", "95 % interval", "unit"], rows, words=("95 % interval", "unit"))


def _tables(result: FitResult) -> list[Table]:
    """Return pulls of several tables, and what each has to itself; nothing of one."""
    if not result.tables:
        return []
    captions = (PULLS, "What each table has to itself")
    found = zip(captions, (tables_in_words(result), nuisances_in_words(result)), strict=True)
    return [Table(caption, head, rows, words=("95 % interval", "unit")) for caption, (head, rows) in found if rows]


def _pictures_and_law(result: FitResult, files: Sequence[bytes]) -> list[Part]:
    """Return the pictures with what is to be seen, and beside them the law in numbers."""
    law = "Rebound speed and energy lost over the approach speed, with their 95 % bands."
    if has_delay(result):
        law = "Rebound speed, energy lost and collision delay over the approach speed, with their 95 % bands."
    shows = (
        "Amplitudes of each row, measured and predicted; below, how far apart they are in standard errors.",
        law if result.valid else f"{law} Not a measurement: see the verdict.",
        "What is left of each amplitude over the approach speed, in standard errors: a wrong law leaves a curve here.",
        "The energy that an impact takes over the approach speed, with its 95 % band; dashed, by the formula.",
    )[: len(files)]
    rows, law_picture, residuals, *energy = pictures_of(files, shows)
    losses, points = _losses(result), _points(result)
    parts = [rows, law_picture, losses, *energy, points, residuals]
    return [part for part in parts if part is not None]


def _losses(result: FitResult) -> Table | None:
    rows = losses_in_words(result)
    if not (result.valid and rows):
        return None
    return Table("What an impact takes", ["quantity", "value (95 % interval)"], rows, words=("value (95 % interval)",))


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
            parameter.unit,
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


def _compared(comparison: Comparison) -> ReportSection:
    rows = [[plain_words(row[name]) for name in _COMPARED] for row in comparison.rows]
    table = Table("Models of the same amplitudes", list(_COMPARED.values()), rows)
    return ReportSection("Comparison of models", [Text(comparison.verdict), table], "Comparison of models")


def _sampled(posterior: Posterior) -> ReportSection:
    """Return the posterior: a row for each parameter, and everything else by name."""
    found = posterior.to_dict()
    by_parameter, chains = found.pop("parameters"), found.pop("chains")
    diagnostics = {name: chains.pop(name) for name in ("r_hat", "effective_samples")}
    rows = [
        [name, *map(_cell, (*columns.values(), *(each[name] for each in diagnostics.values())))]
        for name, columns in by_parameter.items()
    ]
    head = ["parameter", *map(_title, (*next(iter(by_parameter.values())), *diagnostics))]
    others = found | {f"chains {name}": value for name, value in chains.items()}
    others = {_title(name): value for name, value in others.items()}
    parts: list[Part] = []
    if not posterior.converged:
        parts.append(Text(Markup("<strong>Not converged: do not use these numbers.</strong>")))
    return ReportSection(
        "Posterior", [*parts, Table("By parameter", head, rows), pairs("Besides", ("", "value"), others)]
    )


def _title(name: str) -> str:
    return name.replace("interval95", "95 % interval").replace("_", " ")


def _cell(value: Any) -> str:
    """Return a value, or an interval as '0.9 to 0.99'."""
    if isinstance(value, list):
        return " to ".join(map(plain_words, value))
    return "-" if value is None else plain_words(value)


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
        "Shaded: excluded, or otherwise to be looked at"
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


def _why_excluded(rows: FittedRows, i: int) -> str:
    reason = rows.reasons[i] if rows.reasons else TOO_SLOW
    said = "this impact is too slow for the law to describe it" if reason == TOO_SLOW else reason
    return f"excluded: {said}"


def _row_remarks(rows: FittedRows, i: int, *, unseen: bool) -> str:
    exists = rows.orbits[i] > 0
    said = (
        (rows.set_aside[i], _why_excluded(rows, i)),
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


def _input(measured: AmplitudeTable) -> list[Part]:
    """Return what a table says of the instrument, the remarks in its file, and its rows."""
    remarks: list[Part] = [Text("Remarks in the file:"), Bullets(measured.remarks)] if measured.remarks else []
    return [_instrument(measured), *remarks, _measured(measured)]


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
