"""A direct inversion as a person reads it: text for the terminal, files for the drawer (JSON, CSV, PNG).

The picture shows the loss and the delay point by point, over the laws regressed on them.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import ArrayLike, Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

from afm_jax.impact.law import Law, errors_of
from afm_jax.plots.picture_style import ACCENT, BLUE, DARK, GRID, label_axes, new_figure, with_zero_line
from afm_jax.scenefile.law_files import save_law_csv
from afm_jax.units import TWO_SIDED_95
from afm_jax.words import decimals, known, with_error
from fitting.inversion.result import Coefficient, Inversion, RegressedLaw
from fitting.parameters import LAWS
from fitting.report.sections import Bullets, Part, Report, ReportSection, Table, Text, text_of

_FORMULAS = {
    "viscous": LAWS["viscous"].formula,
    "restitution": f"{LAWS['law'].formula}  (eq. 6)",
    "delay": "tau = hertz u_in^(-1/5) - lead_nm (1/u_out - 1/u_in) - offset_nm/u_in",
}


def inversion_summary(result: Inversion) -> str:
    """Return the inversion as text: verdict, laws, the rows, the paper's reading on resonance, notes."""
    return text_of(inversion_report(result))


def inversion_report(result: Inversion) -> Report:
    """Return the inversion as sections: verdict, laws, the rows, the paper's reading on resonance, notes."""
    inverted = int(result.rows.inverted.sum())
    sections = []
    if inverted:
        laws = [line for law in (*result.laws.values(), result.delay) if law is not None for line in _law_lines(law)]
        sections = [
            ReportSection("Verdict", [Text(f"{result.verdict[0].upper()}{result.verdict[1:]}.")]),
            ReportSection("Laws", [Text("\n".join(laws), "lines")], "Laws"),
            ReportSection("Rows", _rows(result), "Rows"),
        ]
    if len(result.resonance.row):
        sections.append(ReportSection("The paper's reading on resonance", _resonance(result), "Resonance"))
    if result.warnings:
        sections.append(ReportSection("Notes", [Bullets(result.warnings, "Notes:")], "Notes"))
    return Report(
        title=f"Direct inversion of {result.table.source}: {inverted} of {result.table.rows} rows",
        valid=result.valid,
        verdict=_heading(result),
        reasons=result.reasons,
        sections=sections,
    )


def _heading(result: Inversion) -> str:
    if not result.valid:
        return "NOT VALID: the numbers below determine no law."
    if result.rows.inverted.any():
        return "VALID"
    return "READ ON AN ASSUMPTION: the phase was not measured but assumed, so that the numbers below are no law."


def write_inversion(
    result: Inversion, folder: Path, write_table: Callable[[str, list[dict[str, Any]], tuple[str, ...]], None]
) -> list[Path]:
    """Write invert.html, .txt, .json, .png and .csv and, where a law is regressed, law.csv into a folder.

    Args:
        result: the inversion.
        folder: an existing folder; files of these names are replaced.
        write_table: called with a file name, records and columns for the CSV files.

    Returns:
        The files written here (the tables are `write_table`'s).

    Raises:
        OSError: if a file cannot be written.
    """
    from fitting.report.files import write_with_picture  # noqa: PLC0415

    report, figure = inversion_report(result), inversion_figure(result)
    shows = "Loss and delay of every row over the approach speed, with the laws that were regressed on them."
    written = write_with_picture(folder, "invert", report, figure, shows, result.to_dict())
    records = result.records()
    write_table("invert.csv", records, tuple(records[0]))
    if result.law is None:
        return written
    law = folder / "law.csv"
    save_law_csv(result.law, law)
    return [*written, law]


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


def _rows(result: Inversion) -> list[Part]:
    """Return the rows as a table, speeds in nm/us, delays in ns."""
    rows, records = result.rows, result.records()
    head = ["line", "N", "kHz", "nm", "u_in", "+-", "u_out", "+-", "tau", "+-", "loss"]
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
        loss = with_error(u - w, lost) + (f" ({note})" if note else "")
        pairs = [(u, du), (w, dw), (_NS_PER_US * tau, _NS_PER_US * dtau)]
        cells.append([*start, *(word for pair in pairs for word in with_error(*pair).split(" +- ")), loss])
    table = Table("Every row by itself", head, cells, words=head[-1:], numbered=True)
    parts: list[Part] = [table, Text("  Speeds in nm/us, tau in ns; loss: u_in - u_out.")]
    if rows.shared_names:
        names = " and ".join(rows.shared_names)
        said = (
            f"  Errors are those of each row; the systematic ones, of {names}, stand in invert.csv and the JSON object."
        )
        parts.append(Text(said))
    return parts


def _resonance(result: Inversion) -> list[Part]:
    """Return what the paper's way to read amplitudes on resonance gives, and how far it is off."""
    reading, table = result.resonance, result.table
    speeds = (reading.approach_speed_nm_per_us, reading.rebound_speed_nm_per_us, reading.speed_error_nm_per_us)
    cells = [
        [
            f"{table.lines[row]}",
            known(found[0], f".{decimals(found[2])}f"),
            *with_error(*found[1:]).split(" +- "),
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
        Text(f"The paper's reading assumes: {reading.assumption}."),
        Table("Speeds in nm/µs", ["line", "u_in", "u_out", "+-", "bias"], cells, numbered=True),
        Text(f"  {against[reading.reference]}"),
    ]


_STYLES = {"viscous": (BLUE, "-", r"$\epsilon$, $c$"), "restitution": (ACCENT, "--", r"$r$, $\epsilon$")}
_NS_PER_US = 1e3
_INVALID = "#B00020"
_SMALL = 9
_POINTS = 200


def inversion_figure(result: Inversion) -> Figure:
    """Return the figure: loss u_in - u_out on the left, collision delay on the right, both against u_in.

    Args:
        result: the inversion; without any phase there is no delay to draw.
    """
    inverted = bool(result.rows.inverted.any())
    figure = new_figure(11.0 if inverted else 6.5, 5.4)
    axes = figure.subplots(1, 2 if inverted else 1, squeeze=False)[0]
    _draw_loss(axes[0], result)
    if inverted:
        _draw_delay(axes[1], result)
    title = (
        result.verdict[:1].upper() + result.verdict[1:]
        if inverted
        else "the paper's reading on resonance: phase assumed, bias "
    )
    if not inverted:
        title += "not known" if result.resonance.reference == "none" else "in invert.txt"
    figure.suptitle(
        title if result.valid else f"NOT VALID: {title}", color="black" if result.valid else _INVALID, fontsize=10
    )
    return figure


def _draw_loss(axes: Axes, result: Inversion) -> None:
    rows, speeds = result.rows, result.approach_speed_nm_per_us
    low, high = _frame_of(axes, result)
    for name, law in result.laws.items():
        colour, dashes, symbols = _STYLES[name]
        label = f"{symbols}: $\\chi^2$ {law.chi2:.1f}/{law.degrees_of_freedom}"
        lost = speeds - law.curve
        seen = (lost > low) & (lost < high)
        label += "" if seen.any() else ", outside"
        axes.plot(speeds, lost, dashes, color=colour, lw=1.6, label=label)
        axes.fill_between(speeds, lost - law.curve_error, lost + law.curve_error, color=colour, alpha=0.15, lw=0)
    if result.beside is not None:
        u = _speeds_beside(result, result.beside)
        _curve_beside(axes, u, u - result.beside.rebound_speed(u), errors_of(result.beside, u)[0])
    c = rows.covariance
    error = np.sqrt(np.maximum(c[:, 0, 0] + c[:, 1, 1] - 2.0 * c[:, 0, 1], 0.0))
    _points(axes, result, rows.impact[:, 0] - rows.impact[:, 1], error)
    reading = result.resonance
    if len(reading.row):
        lost = reading.approach_speed_nm_per_us - reading.rebound_speed_nm_per_us
        # where they take all that is lost in the air for the sample's, they are far above the rows
        outside = int(((lost < low) | (lost > high)).sum())
        label = "on resonance (paper)" + (f", {outside} of {len(lost)} outside" if outside else "")
        axes.plot(reading.approach_speed_nm_per_us, lost, "x", ms=5, color=GRID, label=label)
    axes.set_ylim(low, high)
    _speed_axis(axes, r"loss  $u_{in} - u_{out}$ (nm/µs)")


def _frame_of(axes: Axes, result: Inversion) -> tuple[float, float]:
    """Return the losses that are shown, on a logarithmic axis: those of the rows, or all without any."""
    axes.set_yscale("log")
    axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axes.yaxis.set_minor_formatter(NullFormatter())
    rows = result.rows
    lost = (rows.impact[:, 0] - rows.impact[:, 1])[rows.inverted]
    lost = lost[lost > 0.0]
    if not lost.size:
        lost = result.resonance.approach_speed_nm_per_us - result.resonance.rebound_speed_nm_per_us
        lost = lost[lost > 0.0]
    return (0.6 * float(lost.min()), 1.7 * float(lost.max())) if lost.size else axes.get_ylim()


def _speeds_beside(result: Inversion, law: Law) -> Float[np.ndarray, " points"]:
    """Return the speeds of the rows that a law is known for, and some more."""
    speeds = np.concatenate([result.rows.impact[:, 0], result.resonance.approach_speed_nm_per_us])
    speeds = np.geomspace(0.9 * np.nanmin(speeds), 1.1 * np.nanmax(speeds), _POINTS)
    return speeds[~np.asarray(law.extrapolated(speeds) | law.captures(speeds))]


def _curve_beside(axes: Axes, speeds: np.ndarray, values: ArrayLike, errors: np.ndarray) -> None:
    """Draw what a law that is known otherwise says, with its 95 % band."""
    curve, half = np.asarray(values), TWO_SIDED_95 * errors
    axes.plot(speeds, curve, ":", color="black", lw=1.8, zorder=3, label="law given")
    if half.any():
        axes.fill_between(speeds, curve - half, curve + half, color="black", alpha=0.15, lw=0)


def _draw_delay(axes: Axes, result: Inversion) -> None:
    law, speeds = result.delay, result.approach_speed_nm_per_us
    if law is not None:
        curve, band = _NS_PER_US * law.curve, _NS_PER_US * law.curve_error
        label = f"delay law: $\\chi^2$ {law.chi2:.1f}/{law.degrees_of_freedom}"
        axes.plot(speeds, curve, color=BLUE, lw=1.6, label=label)
        axes.fill_between(speeds, curve - band, curve + band, color=BLUE, alpha=0.15, lw=0)
    if result.beside is not None:
        u = _speeds_beside(result, result.beside)
        late, error = result.beside.collision_delay(u), errors_of(result.beside, u)[1]
        _curve_beside(axes, u, _NS_PER_US * late, _NS_PER_US * error)
    _points(axes, result, _NS_PER_US * result.rows.impact[:, 2], _NS_PER_US * result.rows.errors[:, 2])
    with_zero_line(axes)
    _speed_axis(axes, r"collision delay  $\tau$ (ns)")


def _points(axes: Axes, result: Inversion, values: np.ndarray, errors: np.ndarray) -> None:
    rows = result.rows
    for chosen, face, label in (
        (rows.inverted & rows.regressed, DARK, "rows"),
        (rows.inverted & ~rows.regressed, "none", "rows excluded"),
    ):
        if chosen.any():
            axes.errorbar(
                rows.impact[chosen, 0],
                values[chosen],
                errors[chosen],
                fmt="o",
                ms=3.5,
                lw=0.8,
                color=DARK,
                mfc=face,
                label=label,
            )


def _speed_axis(axes: Axes, y: str) -> None:
    axes.set_xscale("log")
    low, high = axes.get_xlim()
    ticks = [tick for tick in (5, 10, 20, 50, 100, 200, 500, 1000, 2000) if low <= tick <= high]
    axes.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
    axes.set_xticks([], minor=True)
    label_axes(axes, x=r"approach speed  $u_{in}$ (nm/µs)", y=y)
    axes.grid(color=GRID, alpha=0.25)
    if axes.get_legend_handles_labels()[0]:
        # above the axes: no place within is free of data for every table
        place = {"loc": "lower left", "bbox_to_anchor": (0.0, 1.0), "frameon": False}
        axes.legend(fontsize=_SMALL, ncols=2, columnspacing=1.0, handletextpad=0.5, **place)
