"""A direct inversion as a person reads it: text for the terminal, files for the drawer (JSON, CSV, PNG)."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from fitting.inverse.fitted_law import SavedLaw
from fitting.inverse.inversion_result import Coefficient, Inversion, RegressedLaw

ROW_COLUMNS = (
    "line",
    "order",
    "drive_frequency_khz",
    "drive_amplitude_nm",
    "offset_nm",
    "approach_speed_nm_per_us",
    "approach_speed_error_nm_per_us",
    "approach_speed_systematic_nm_per_us",
    "rebound_speed_nm_per_us",
    "rebound_speed_error_nm_per_us",
    "rebound_speed_systematic_nm_per_us",
    "collision_delay_us",
    "collision_delay_error_us",
    "collision_delay_systematic_us",
    "speed_correlation",
    "chi2",
    "regressed",
    "note",
)
LAW_COLUMNS = (
    "approach_speed_nm_per_us",
    "rebound_speed_viscous_nm_per_us",
    "rebound_speed_viscous_error_nm_per_us",
    "rebound_speed_restitution_nm_per_us",
    "rebound_speed_restitution_error_nm_per_us",
    "collision_delay_us",
    "collision_delay_error_us",
)
_FORMULAS = {
    "viscous": "u_out^2 = u_in^2 - epsilon - viscous_loss u_in",
    "restitution": "u_out^2 = r^2 u_in^2 - epsilon  (eq. 6)",
    "delay": "tau = hertz u_in^(-1/5) - lead_nm (1/u_out - 1/u_in) - offset_nm/u_in",
}
NS_PER_US = 1e3
Table = Callable[[str, list[dict[str, Any]], tuple[str, ...]], None]


def inversion_summary(result: Inversion) -> str:
    """Return the inversion as text: verdict, laws, the rows, the paper's reading on resonance, notes."""
    inverted = int(result.rows.inverted.sum())
    lines = [
        f"Direct inversion of {result.table.source}: {inverted} of {result.table.rows} rows",
        _heading(result),
        *(f"  - {reason}" for reason in result.reasons),
        "",
    ]
    if inverted:
        lines += [f"{result.verdict[0].upper()}{result.verdict[1:]}.", ""]
        for law in (*result.laws.values(), *([result.delay] if result.delay else [])):
            lines += _law_lines(law)
        lines += ["", *_row_lines(result)]
    lines += _resonance_lines(result)
    if result.warnings:
        lines += ["", "Notes:", *(f"  - {warning}" for warning in result.warnings)]
    return "\n".join(lines)


def _heading(result: Inversion) -> str:
    if not result.valid:
        return "NOT VALID: the numbers below determine no law."
    if result.rows.inverted.any():
        return "VALID"
    return "READ ON AN ASSUMPTION: the phase was not measured but assumed, so that the numbers below are no law."


def write_inversion(
    result: Inversion, folder: Path, write_table: Table, *, fitted: SavedLaw | None = None
) -> list[Path]:
    """Write invert.txt, invert.json, invert.png, invert.csv and law.csv into a folder.

    Args:
        result: the inversion.
        folder: an existing folder; files of these names are replaced.
        write_table: called with a file name, records and columns for the CSV files.
        fitted: a law that a fit found, drawn over the rows.

    Returns:
        The files written here (the tables are `write_table`'s).

    Raises:
        OSError: if a file cannot be written.
    """
    from afm_jax.plots.picture_style import png_of  # noqa: PLC0415
    from fitting.inverse.inversion_plot import inversion_figure  # noqa: PLC0415
    from fitting.reporting.report import write_report_files  # noqa: PLC0415

    text, data, picture = inversion_summary(result), result.to_dict(), png_of(inversion_figure(result, fitted=fitted))
    written = write_report_files(folder, "invert", text=text, data=data, picture=picture)
    write_table("invert.csv", result.records(), ROW_COLUMNS)
    write_table("law.csv", result.law_records(), LAW_COLUMNS)
    return written


def _law_lines(law: RegressedLaw) -> list[str]:
    freedom = law.degrees_of_freedom
    probability = f", probability {law.p_value:.2g}" if np.isfinite(law.p_value) else ""
    lines = [f"  {law.model}: {_FORMULAS[law.model]}", f"    chi2/dof = {law.chi2:.1f}/{freedom}{probability}"]
    lines += [f"    {name:<13}{_coefficient(found)}" for name, found in law.parameters.items()]
    moved = [f"{name} by {pull:+.2f}" for name, pull in law.pulls.items()]
    if moved:
        lines.append(f"    in its standard errors the regression moves {', '.join(moved)}")
    return lines


def _coefficient(found: Coefficient) -> str:
    text = f"{found.value:12.6g}"
    if found.standard_error is not None:
        text += f" +- {found.standard_error:.2g}"
    if found.systematic_error is not None:
        text += f" (of it systematic {found.systematic_error:.2g})"
    return f"{text} {found.unit}".rstrip()


def _row_lines(result: Inversion) -> list[str]:
    """Return the rows as a table, speeds in nm/us, delays in ns."""
    rows, records = result.rows, result.records()
    head = f"  {'line':>4} {'N':>2} {'kHz':>9} {'nm':>6} {'u_in':>9} {'+-':>7} {'u_out':>9} {'+-':>7}"
    lines = [f"{head} {'tau ns':>8} {'+-':>6}  loss u_in - u_out"]
    errors = rows.errors
    for i, row in enumerate(records):
        start = (
            f"  {row['line']:>4} {row['order']:>2} {row['drive_frequency_khz']:>9.7g} {row['drive_amplitude_nm']:>6.4g}"
        )
        if not rows.inverted[i]:
            lines.append(f"{start}  {row['note']}")
            continue
        u, w, tau = rows.impact[i]
        du, dw, dtau = errors[i]
        covariance = rows.covariance[i]
        lost = np.sqrt(max(covariance[0, 0] + covariance[1, 1] - 2.0 * covariance[0, 1], 0.0))
        text = f" {u:>9.3f} {du:>7.3f} {w:>9.3f} {dw:>7.3f}"
        text += f" {NS_PER_US * tau:>8.2f} {NS_PER_US * dtau:>6.2f}  {u - w:7.3f} +- {lost:.3f}"
        lines.append(start + text + (f"  ({row['note']})" if row["note"] else ""))
    if rows.shared_names:
        names = " and ".join(rows.shared_names)
        lines.append(
            f"  Errors are those of each row; the systematic ones, of {names}, stand in invert.csv and --json."
        )
    return lines


def _resonance_lines(result: Inversion) -> list[str]:
    reading = result.resonance
    if not len(reading.row):
        return []
    table = result.table
    lines = [
        "",
        f"The paper's reading assumes: {reading.assumption}.",
        f"  {'line':>4} {'u_in':>9} {'u_out':>9} {'+-':>7}   bias",
    ]
    numbers = table.lines if len(table.lines) else np.arange(1, table.rows + 1)
    for row, u, w, error, bias in zip(
        reading.row,
        reading.approach_speed_nm_per_us,
        reading.rebound_speed_nm_per_us,
        reading.speed_error_nm_per_us,
        reading.bias,
        strict=True,
    ):
        shown = f"{100.0 * bias:+.1f} %" if np.isfinite(bias) else "not known"
        lines.append(f"  {numbers[row]:>4} {u:>9.3f} {w:>9.3f} {error:>7.3f}   {shown}")
    against = {
        "truth": "Bias of u_out against the truth given, at the same approach speed.",
        "law": "Bias of u_out against the law regressed above, at the same approach speed.",
        "none": "The bias is not known: air damping and the collision delay are left out of this reading.",
    }
    return [*lines, f"  {against[reading.reference]}"]
