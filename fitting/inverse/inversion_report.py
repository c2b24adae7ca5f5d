"""A direct inversion as a person reads it: text for the terminal, files for the drawer (JSON, CSV, PNG)."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from afm_jax.words import bullets, text_table, with_error
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
    lines += bullets("Notes:", result.warnings)
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
    text = f"{found.value:.6g}"
    if found.standard_error is not None:
        text = with_error(found.value, found.standard_error)
    if found.systematic_error is not None:
        text += f" (of it systematic {found.systematic_error:.2g})"
    return f"{text} {found.unit}".rstrip()


def _row_lines(result: Inversion) -> list[str]:
    """Return the rows as a table, speeds in nm/us, delays in ns."""
    rows, records = result.rows, result.records()
    head = ["line", "N", "kHz", "nm", "u_in", "+-", "u_out", "+-", "tau ns", "+-", "loss u_in - u_out"]
    cells = []
    for i, row in enumerate(records):
        note = row["note"] or ""
        start = [f"{row['line']}", f"{row['order']}", f"{row['drive_frequency_khz']:.7g}"]
        start.append(f"{row['drive_amplitude_nm']:.4g}")
        if not rows.inverted[i]:
            cells.append([*start, *[""] * 6, note])
            continue
        u, w, tau = rows.impact[i]
        du, dw, dtau = rows.errors[i]
        covariance = rows.covariance[i]
        lost = np.sqrt(max(covariance[0, 0] + covariance[1, 1] - 2.0 * covariance[0, 1], 0.0))
        loss = f"{u - w:.3f} +- {lost:.3f}" + (f"  ({note})" if note else "")
        delay = [f"{NS_PER_US * tau:.2f}", f"{NS_PER_US * dtau:.2f}"]
        cells.append([*start, f"{u:.3f}", f"{du:.3f}", f"{w:.3f}", f"{dw:.3f}", *delay, loss])
    lines = text_table(head, cells, words=(10,))
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
    speeds = (reading.approach_speed_nm_per_us, reading.rebound_speed_nm_per_us, reading.speed_error_nm_per_us)
    cells = [
        [
            f"{table.lines[row]}",
            *(f"{speed:.3f}" for speed in found),
            "not known" if np.isnan(bias) else f"{100.0 * bias:+.1f} %",
        ]
        for row, bias, *found in zip(reading.row, reading.bias, *speeds, strict=True)
    ]
    against = {
        "truth": "Bias of u_out against the truth given, at the same approach speed.",
        "law": "Bias of u_out against the law regressed above, at the same approach speed.",
        "none": "The bias is not known: air damping and the collision delay are left out of this reading.",
    }
    return [
        "",
        f"The paper's reading assumes: {reading.assumption}.",
        *text_table(["line", "u_in", "u_out", "+-", "bias"], cells, words=()),
        f"  {against[reading.reference]}",
    ]
