"""A fit as a person reads it: sections of the fit, of a comparison of models, and of a posterior."""

from typing import Any

import numpy as np

from afm_jax.columns import CsvColumns, columns_of, csv_columns
from afm_jax.report import Bullets, Picture, Section, Table, in_words, sections
from afm_jax.words import counted, known, percent
from fitting.infer.comparison import Comparison
from fitting.infer.result import FitResult, FittedParameter
from fitting.report.words import (
    PULLS,
    band_in_words,
    formulas,
    has_delay,
    held_in_words,
    interval_in_words,
    losses_in_words,
    parting_in_words,
    value_in_words,
)
from fitting.sampling.posterior_result import Posterior
from fitting.tables.several import SeveralTables


@sections.register
def _(fit: FitResult) -> list[Section]:
    cells = [_parameter_cells(name, parameter) for name, parameter in fit.parameters.items()]
    parting = parting_in_words(fit) if fit.valid else ""
    probability = f", probability {fit.p_value:.2g}" if np.isfinite(fit.p_value) else ""
    chi2 = f"chi2/dof = {fit.chi2:.1f}/{fit.degrees_of_freedom}{probability}"
    # where impacts last chi2 makes up for what a formula lacks
    chi2 += "" if has_delay(fit) else f", AIC {fit.aic:.1f}"
    chi2 = chi2 if np.isfinite(fit.chi2) else "No orbits were found at the fitted law."
    title = f"Impact law of {fit.table.source} ({counted(fit.table.rows, 'row')}), model {fit.model}:"
    return [
        Section(title, [f"  {line}" for line in (*formulas(fit), held_in_words(fit)) if line]),
        Section("Pictures", [Picture(f"fitting.report.plots:{name}", words) for name, words in _PICTURES.items()]),
        Section("Parameters", [Table("Fitted parameters", _PARAMETER_HEAD, cells)]),
        Section("Goodness of fit", [f"  {line}" for line in (band_in_words(fit), parting, chi2) if line]),
        *_table_sections(fit),
        Section("Inputs", _inputs(fit), page_only=True),
    ]


_PARAMETER_HEAD = ("parameter", "value", "std. error", "95 % interval")
_PICTURES = {
    "rows_figure": (
        "Amplitudes of each row, measured and predicted; below, how far apart they are in standard errors."
    ),
    "law_figure": "The law over the approach speed, with its 95 % band.",
    "speed_figure": (
        "What is left of each amplitude over the approach speed, in standard errors: a wrong law leaves a curve here."
    ),
}


def _inputs(fit: FitResult) -> list[Any]:
    """Return the remarks of the tables, the options of the fit, and what computed it."""
    parts: list[Any] = [Bullets([remark for table in fit.table.tables for remark in table.remarks])]
    named = (("Options of the fit", "option", fit.settings), ("What computed it", "package", fit.versions))
    for caption, name, values in named:
        rows = [[key, value if isinstance(value, str) else in_words(value)] for key, value in values.items()]
        parts.append(Table(caption, [name, "value"], rows))
    return parts


def _parameter_cells(name: str, parameter: FittedParameter) -> list[str]:
    given = "" if parameter.constraint is None else "  (given: {:g} +- {:g})".format(*parameter.constraint)
    tail = interval_in_words(parameter, parameter.unit) + given
    return [name, value_in_words(parameter), known(parameter.standard_error, ".2g"), tail]


def _table_sections(fit: FitResult) -> list[Section]:
    """Return each of several tables' pull, what it has to itself, and the energy lost in an impact."""
    pulls, own = [], []
    for one in fit.tables:
        pulls.append([one.name, f"{one.used}/{one.rows}", f"{one.chi2:.1f}/{one.readings}", known(one.pull, ".2f")])
        own += [[one.name, *_parameter_cells(name, parameter)] for name, parameter in one.nuisances.items()]
    head = ["table", "its nuisance", "value", "std. error", "95 % interval"]
    table = Table("Tables", ["table", "rows used", "chi2/readings", "pull"], pulls)
    losses = losses_in_words(fit) if fit.valid else []
    return [
        Section("Tables", [table, PULLS if pulls else None]),
        Section("Nuisances", [Table("Of each table", head, own)]),
        Section("Losses", [Table("Energy lost in an impact", ["loss of an impact", "95 % interval"], losses)]),
    ]


@sections.register
def _(result: Comparison) -> list[Section]:
    by_distance, rows = "largest_distance" in result.rows[0], []
    for row in result.rows:
        cells = [f"{row[name]:.1f}" for name in ("aic", "delta_aic")] if not by_distance else []
        if by_distance:
            share = row.get("largest_relative_distance")
            cells = [known(row.get("largest_distance"), ".2g"), "-" if share is None else percent(share)]
        chi2 = f"{row['chi2']:.1f}/{row['degrees_of_freedom']}"
        rows.append([row["model"], chi2, *cells, "yes" if row["valid"] else "no"])
    said = "Models, best first:"
    head = ["model", "chi2/dof", "AIC", "above the best", "valid"]
    if by_distance:
        said = "Formulas and the law that was found without them, the closest first:"
        head[2:4] = ["at most off (band half-widths)", "of u_out"]
    return [Section("Comparison", [said, Table("Models", head, rows), f"  {result.verdict}"])]


@csv_columns.register
def _(result: Comparison) -> CsvColumns:
    return {"models.csv": columns_of(result.rows)}


@sections.register
def _(drawn: Posterior) -> list[Section]:
    rows = [
        [name, f"{drawn.mean[name]:.6g}", *(f"{end:.6g}" for end in ends)] for name, ends in drawn.interval95.items()
    ]
    head = ["parameter", "mean", "from", "to"]
    said = "95 % credible intervals (posterior, flat priors):"
    if drawn.method == "gaussian":
        worth = f"weighted to chi2, {drawn.chains.effective_samples[0]:.0f} of 120 are effective"
        said = f"95 % intervals of samples of the Gaussian around the fit ({worth}):"
    wrong = [f"Not converged: {reason}" for reason in drawn.reasons]
    return [Section("Posterior", [said, Table("By parameter", head, rows), Bullets(wrong)])]


@csv_columns.register
def _(fit: FitResult) -> CsvColumns:
    """Return what was set, measured and predicted in each row of the table, and whether it was used."""
    table, rows = fit.table, fit.rows
    columns: dict[str, Any] = {
        "line": table.lines,
        "order": table.order,
        "drive_frequency_khz": table.drive_frequency_khz,
        f"{'free' if table.tapping else 'drive'}_amplitude_nm": table.excitation_nm,
        "offset_nm": table.offset_nm,
    }
    for kind, name in enumerate(("peak", "lockin")):
        columns[f"measured_{name}_amplitude_nm"] = rows.measured_nm[:, kind]
        columns[f"predicted_{name}_amplitude_nm"] = rows.predicted_nm[:, kind]
        columns[f"{name}_residual"] = rows.residual[:, kind]
    columns |= {
        "approach_speed_nm_per_us": rows.approach_speed_nm_per_us,
        "stable_orbits": rows.orbits,
        "model_error": rows.model_error,
        "used": rows.used,
        "set_aside": rows.set_aside,
    }
    if rows.measured_phase_deg is not None:
        columns["measured_phase_deg"] = rows.measured_phase_deg
        columns["predicted_phase_deg"] = rows.predicted_phase_deg
        columns["phase_residual"] = rows.residual[:, 2]
    of_table = {"table": np.array(table.labels)[table.number]} if isinstance(table, SeveralTables) else {}
    return {"fit_rows.csv": of_table | columns}
