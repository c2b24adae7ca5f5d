"""A fit as a person reads it: text for the terminal, files for the drawer (HTML, JSON, CSV, PNG)."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from afm_jax.columns import rows_of
from afm_jax.saved import saved
from afm_jax.scenefile.law_files import save_law_csv
from afm_jax.words import counted, known, percent
from fitting.infer.comparison import Comparison
from fitting.infer.result import FitResult, FittedParameter
from fitting.report.files import write_report_files
from fitting.report.sections import (
    Bullets,
    Report,
    ReportSection,
    Table,
    Text,
    page_of,
    pairs,
    pictures_of,
    text_of,
)
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


def summary(result: FitResult, comparison: Comparison | None = None, posterior: Posterior | None = None) -> str:
    """Return the fit as text: verdict first, then the law, then goodness of fit and warnings."""
    return text_of(fit_report(result, comparison, posterior))


def fit_report(result: FitResult, comparison: Comparison | None = None, posterior: Posterior | None = None) -> Report:
    """Return the sections of a fit, with those of other models of its table and of its posterior, if there are any."""
    head = ["parameter", "value", "std. error", "95 % interval"]
    cells = [_parameter_cells(name, parameter) for name, parameter in result.parameters.items()]
    parting = parting_in_words(result) if result.valid else ""
    probability = f", probability {result.p_value:.2g}" if np.isfinite(result.p_value) else ""
    chi2 = f"chi2/dof = {result.chi2:.1f}/{result.degrees_of_freedom}{probability}"
    # where impacts last chi2 makes up for what a formula lacks
    chi2 += "" if has_delay(result) else f", AIC {result.aic:.1f}"
    goodness = [f"  {line}" for line in (band_in_words(result), parting, chi2) if line]
    return Report(
        title=f"Impact law of {result.table.source} ({counted(result.table.rows, 'row')}), model {result.model}:",
        about=[line for line in (*formulas(result), held_in_words(result)) if line],
        valid=result.valid,
        verdict="VALID" if result.valid else "NOT VALID: the numbers below are not a measurement of the law.",
        reasons=result.reasons,
        sections=[
            ReportSection("Parameters", [Table("Fitted parameters", head, cells, words=head[-1:])], "Parameters"),
            ReportSection("Goodness of fit", [Text("\n".join(goodness), "lines")]),
            *_table_sections(result),
            *([ReportSection("Notes", [Bullets(result.warnings, "Notes:")], "Notes")] if result.warnings else []),
            *([] if comparison is None else [_compared(comparison)]),
            *([] if posterior is None else [_sampled(posterior)]),
        ],
    )


def _parameter_cells(name: str, parameter: FittedParameter) -> list[str]:
    given = "" if parameter.constraint is None else "  (given: {:g} +- {:g})".format(*parameter.constraint)
    tail = interval_in_words(parameter, parameter.unit) + given
    return [name, value_in_words(parameter), known(parameter.standard_error, ".2g"), tail]


def _table_sections(result: FitResult) -> list[ReportSection]:
    """Return each of several tables' pull, what it has to itself, and the energy lost in an impact."""
    sections, pulls, own = [], [], []
    for one in result.tables:
        pulls.append([one.name, f"{one.used}/{one.rows}", f"{one.chi2:.1f}/{one.readings}", known(one.pull, ".2f")])
        own += [[one.name, *_parameter_cells(name, parameter)] for name, parameter in one.nuisances.items()]
    if pulls:
        head = ["table", "rows used", "chi2/readings", "pull"]
        sections.append(ReportSection("Tables", [Table("Tables", head, pulls), Text(PULLS)]))
    if own:
        head = ["table", "its nuisance", "value", "std. error", "95 % interval"]
        sections.append(ReportSection("Nuisances", [Table("Of each table", head, own, words=(head[1], head[-1]))]))
    losses = losses_in_words(result) if result.valid else []
    if losses:
        head = ["loss of an impact", "95 % interval"]
        sections.append(ReportSection("Losses", [Table("Energy lost in an impact", head, losses, words=head)]))
    return sections


def _compared(comparison: Comparison) -> ReportSection:
    by_distance, rows = "largest_distance" in comparison.rows[0], []
    for row in comparison.rows:
        cells = [f"{row[name]:.1f}" for name in ("aic", "delta_aic")] if not by_distance else []
        if by_distance:
            share = row.get("largest_relative_distance")
            cells = [known(row.get("largest_distance"), ".2g"), "-" if share is None else percent(share)]
        chi2 = f"{row['chi2']:.1f}/{row['degrees_of_freedom']}"
        rows.append([row["model"], chi2, *cells, "yes" if row["valid"] else "no"])
    said, head = "Models, best first:", ["model", "chi2/dof", "AIC", "above the best", "valid"]
    if by_distance:
        said = "Formulas and the law that was found without them, the closest first:"
        head[2:4] = ["at most off (band half-widths)", "of u_out"]
    return ReportSection("Comparison", [Text(said), Table("Models", head, rows), Text(f"  {comparison.verdict}")])


def _sampled(posterior: Posterior) -> ReportSection:
    rows = [
        [name, f"{posterior.mean[name]:.6g}", *(f"{end:.6g}" for end in ends)]
        for name, ends in posterior.interval95.items()
    ]
    head = ["parameter", "mean", "from", "to"]
    said = "95 % credible intervals (posterior, flat priors):"
    if posterior.method == "gaussian":
        worth = f"weighted to chi2, {posterior.chains.effective_samples[0]:.0f} of 120 are effective"
        said = f"95 % intervals of samples of the Gaussian around the fit ({worth}):"
    wrong = [f"Not converged: {reason}" for reason in posterior.reasons]
    return ReportSection("Posterior", [Text(said), Table("By parameter", head, rows), Bullets(wrong)])


def row_records(result: FitResult) -> list[dict[str, Any]]:
    """Return a mapping per row of the table: what was set, measured and predicted, and whether it was used."""
    table, rows = result.table, result.rows
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
    return rows_of(of_table | columns)


def write_report(
    result: FitResult,
    folder: Path,
    write_table: Callable[[str, list[dict[str, Any]], tuple[str, ...]], None],
    *,
    comparison: Comparison | None = None,
    posterior: Posterior | None = None,
) -> list[Path]:
    """Write fit.html, fit.txt, fit.json, fit.png, the law as law.csv and the table fit_rows.csv into a folder.

    Args:
        result: the fit; `afm_jax.load` of fit.json gives it back.
        folder: an existing folder; files of these names are replaced.
        write_table: called with a file name, records and columns for each CSV file.
        comparison: other models of the same table, for fit.html and fit.txt.
        posterior: credible intervals, for fit.html and fit.txt.

    Returns:
        The files written here (the tables are `write_table`'s).

    Raises:
        OSError: if a file cannot be written.
    """
    from fitting.report.plots import fit_pictures  # noqa: PLC0415

    picture, *pictures = fit_pictures(result)
    report = fit_report(result, comparison, posterior)
    page = fit_page(result, report, pictures)
    written = write_report_files(folder, "fit", text=text_of(report), data=saved(result), picture=picture, page=page)
    records = row_records(result)
    write_table("fit_rows.csv", records, tuple(records[0]))
    law = folder / "law.csv"
    save_law_csv(result.law, law)
    return [*written, law]


def fit_page(result: FitResult, report: Report, pictures: Sequence[bytes]) -> str:
    """Return the page of a fit: its report with pictures, remarks of the tables, and the fit's options.

    Args:
        result: the fit.
        report: its sections.
        pictures: SVG files of the rows, the law, and the residuals over the speed.
    """
    shows = (
        "Amplitudes of each row, measured and predicted; below, how far apart they are in standard errors.",
        "The law over the approach speed, with its 95 % band.",
        "What is left of each amplitude over the approach speed, in standard errors: a wrong law leaves a curve here.",
    )
    seen = ReportSection("Pictures", pictures_of(pictures, shows), "Pictures")
    inputs = [
        Bullets([remark for table in result.table.tables for remark in table.remarks]),
        pairs("Options of the fit", ("option", "value"), result.settings),
        pairs("Versions of what computed it", ("package", "version"), result.versions),
    ]
    return page_of(replace(report, sections=[seen, *report.sections, ReportSection("Inputs", inputs, "Inputs")]))
