"""A fit as a person reads it: text for the terminal, files for the drawer (HTML, JSON, CSV, PNG)."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from afm_jax.saved import saved
from afm_jax.scenefile.law_files import save_law_csv
from afm_jax.words import known, percent
from fitting.infer.comparison import Comparison
from fitting.infer.result import FitResult, FittedParameter, FittedRows
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
    held_in_words,
    interval_in_words,
    losses_in_words,
    nuisances_in_words,
    parting_in_words,
    rows_in_words,
    tables_in_words,
    value_in_words,
)
from fitting.sampling.posterior_result import Posterior
from fitting.tables.several import SeveralTables

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


def summary(result: FitResult, comparison: Comparison | None = None, posterior: Posterior | None = None) -> str:
    """Return the fit as text: verdict first, then the law, then goodness of fit and warnings."""
    return text_of(fit_report(result, comparison, posterior))


def fit_report(result: FitResult, comparison: Comparison | None = None, posterior: Posterior | None = None) -> Report:
    """Return the sections of a fit, with those of other models of its table and of its posterior, if there are any."""
    head = ["parameter", "value", "std. error", "95 % interval"]
    cells = [_parameter_cells(name, parameter) for name, parameter in result.parameters.items()]
    parting = parting_in_words(result) if result.valid else ""
    goodness = [
        f"  {band_in_words(result)}",
        *([f"  {parting}"] if parting else []),
        _goodness_line(result),
    ]
    return Report(
        title=f"Impact law of {result.table.source} ({rows_in_words(result.table.rows)}), model {result.model}:",
        about=[line for line in (*formulas(result), held_in_words(result)) if line],
        valid=result.valid,
        verdict="VALID" if result.valid else "NOT VALID: the numbers below are not a measurement of the law.",
        reasons=result.reasons,
        sections=[
            ReportSection("Parameters", [Table("Fitted parameters", head, cells, words=head[-1:])], "Parameters"),
            ReportSection("Goodness of fit", [Text("\n".join(goodness), "lines")]),
            *_table_sections(result),
            ReportSection("Notes", [Bullets(result.warnings, "Notes:")], "Notes"),
            *([] if comparison is None else [_compared(comparison)]),
            *([] if posterior is None else [_sampled(posterior)]),
        ],
    )


def _parameter_cells(name: str, parameter: FittedParameter) -> list[str]:
    given = "" if parameter.constraint is None else "  (given: {:g} +- {:g})".format(*parameter.constraint)
    tail = interval_in_words(parameter, parameter.unit) + given
    return [name, value_in_words(parameter), known(parameter.standard_error, ".2g"), tail]


def _goodness_line(result: FitResult) -> str:
    probability = f", probability {result.p_value:.2g}" if np.isfinite(result.p_value) else ""
    goodness = f"chi2/dof = {result.chi2:.1f}/{result.degrees_of_freedom}{probability}"
    return f"  {goodness}, AIC {result.aic:.1f}"


def _table_sections(result: FitResult) -> list[ReportSection]:
    """Return each of several tables' pull, what it has to itself, and what an impact takes."""
    parts = []
    if result.tables:
        parts += [Table("Tables", *tables_in_words(result)), Text(f"  {PULLS}.")]
    sections = [ReportSection("Tables", parts)] if parts else []
    head, rows = nuisances_in_words(result)
    if rows:
        sections.append(ReportSection("Nuisances", [Table("Of each table", head, rows, words=(head[1], head[-1]))]))
    losses = losses_in_words(result) if result.valid else []
    if losses:
        head = ["what an impact takes", "95 % interval"]
        sections.append(ReportSection("Losses", [Table("What an impact takes", head, losses, words=head)]))
    return sections


def _compared(comparison: Comparison) -> ReportSection:
    by_distance = "largest_distance" in comparison.rows[0]
    rows = [
        [
            row["model"],
            f"{row['chi2']:.1f}/{row['degrees_of_freedom']}",
            *(
                [known(row.get("largest_distance"), ".2g"), percent_or_none(row.get("largest_relative_distance"))]
                if by_distance
                else [f"{row['aic']:.1f}", f"{row['delta_aic']:.1f}"]
            ),
            "yes" if row["valid"] else "no",
        ]
        for row in comparison.rows
    ]
    said, head = "Models, best first:", ["model", "chi2/dof", "AIC", "above the best", "valid"]
    if by_distance:
        said = "Formulas and the law that was found without them, the closest first:"
        head[2:4] = ["at most off (band half-widths)", "of u_out"]
    return ReportSection("Comparison", [Text(said), Table("Models", head, rows), Text(f"  {comparison.verdict}")])


def percent_or_none(share: float | None) -> str:
    """Return a share in per cent, "-" where it is not known."""
    return "-" if share is None else percent(share)


def _sampled(posterior: Posterior) -> ReportSection:
    rows = [
        [name, f"{posterior.mean[name]:.6g}", *(f"{end:.6g}" for end in ends)]
        for name, ends in posterior.interval95.items()
    ]
    head = ["parameter", "mean", "from", "to"]
    said = "95 % credible intervals (posterior, flat priors):"
    if posterior.method == "gaussian":
        worth = posterior.chains.effective_samples[0]
        said = (
            f"95 % intervals of samples of the Gaussian around the fit (of 120, weighted to chi2, {worth:.0f} count):"
        )
    wrong = [f"Not converged: {reason}" for reason in posterior.reasons]
    return ReportSection("Posterior", [Text(said), Table("By parameter", head, rows), Bullets(wrong)])


def row_records(result: FitResult) -> list[dict[str, Any]]:
    """Return a mapping per row of the table: the columns `ROW_COLUMNS`, and those of a phase or of a driven tip."""
    table, rows = result.table, result.rows
    names = ["free_amplitude_nm" if table.tapping and name == "drive_amplitude_nm" else name for name in ROW_COLUMNS]
    columns = (
        table.lines,
        table.order,
        table.drive_frequency_khz,
        table.excitation_nm,
        table.offset_nm,
        *(column[:, kind] for kind in range(2) for column in (rows.measured_nm, rows.predicted_nm, rows.residual)),
        rows.approach_speed_nm_per_us,
        rows.orbits,
        rows.model_error,
        rows.used,
        rows.set_aside,
    )
    more = phase_columns(rows)
    names += more
    if isinstance(table, SeveralTables):
        names, columns = ["table", *names], (np.array(table.labels)[table.number], *columns)
    cells = zip(*(c.tolist() for c in (*columns, *more.values())), strict=True)
    return [dict(zip(names, row, strict=True)) for row in cells]


def phase_columns(rows: FittedRows) -> dict[str, np.ndarray]:
    """Return what was measured, predicted and left of the phase, none without one."""
    if rows.measured_phase_deg is None or rows.predicted_phase_deg is None:
        return {}
    return {
        "measured_phase_deg": rows.measured_phase_deg,
        "predicted_phase_deg": rows.predicted_phase_deg,
        "phase_residual": rows.residual[:, 2],
    }


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
    """Return the page of a fit: its report with pictures, remarks of the tables, and what the fit was told.

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
