"""Readings of traces as a person reads them: text for the terminal, files for the drawer (JSON, CSV, PNG).

The picture shows the trace folded onto its response period, and the spectrum with the drive's fractions.
"""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from afm_jax.plots.picture_style import ACCENT, BLUE, DARK, GRID, label_axes, new_figure, save
from afm_jax.scenefile.tables import printable
from afm_jax.whole_files import write_whole
from afm_jax.words import with_error
from fitting.tables.table import AmplitudeTable, csv_of
from fitting.traces.lockin import FORMAT_VERSION, LockinResult


def lockin_payload(results: Sequence[LockinResult], table_fault: str | None) -> dict[str, Any]:
    """Return the JSON object of a call.

    Args:
        results: of all traces.
        table_fault: why there is no amplitude table; None if there is one.
    """
    return {
        "format": "afm-jax lockin",
        "format_version": FORMAT_VERSION,
        "traces": [result.to_dict() for result in results],
        "steady": sum(result.steady for result in results),
        "table_reason": table_fault,
    }


def lockin_summary(result: LockinResult) -> str:
    """Return one reading as text: verdict first, then the values, then notes."""
    trace = result.trace
    size = f"{trace.samples} samples, {1.0 / trace.step_us:.6g} MHz, {trace.drive_periods:.5g} drive periods"
    lines = [
        f"{trace.source}: {'STEADY' if result.steady else 'FLAGGED'}: {result.verdict}",
        f"  {size} of {trace.drive_frequency_khz:.7g} kHz, noise {result.noise_nm:.3g} nm a sample",
    ]
    if result.peak_amplitude_nm is not None:
        order = result.order or 1
        response = f"nm at the {'drive' if order == 1 else 'response'}'s {trace.drive_frequency_khz / order:.7g} kHz"
        values = (
            ("peak amplitude", result.peak_amplitude_nm, result.peak_amplitude_error_nm, "nm"),
            ("lock-in amplitude", result.lockin_amplitude_nm, result.lockin_amplitude_error_nm, response),
            ("phase", result.phase_deg, result.phase_error_deg, f"degrees, modulo {360.0 / (result.order or 1):g}"),
        )
        lines += [f"  {name:<18}{with_error(value, error)} {unit}" for name, value, error, unit in values]
    if result.order != 1 and result.drive_lockin_amplitude_nm is not None:
        read = with_error(result.drive_lockin_amplitude_nm, result.drive_lockin_amplitude_error_nm)
        phase = with_error(result.drive_lockin_phase_deg, result.drive_lockin_phase_error_deg)
        lines.append(f"  at the drive's {trace.drive_frequency_khz:.7g} kHz a lock-in reads {read} nm, {phase} degrees")
    if result.free_frequency_khz is not None and result.free_frequency_origin == "trace":
        frequency = f"{result.free_frequency_khz:.4g} kHz"
        lines.append(f"  {'free frequency':<18}{frequency} (from the bending at the top, for counting impacts only)")
    return "\n".join([*lines, *(f"  - {warning}" for warning in result.warnings)])


def write_lockin(
    results: Sequence[LockinResult], folder: Path, table: AmplitudeTable | None, table_fault: str | None
) -> list[Path]:
    """Write lockin.json, a picture of every trace and, if there is a table, amplitudes.csv into a folder.

    Args:
        results: of all traces.
        folder: an existing folder; files of these names are replaced.
        table: of the steady ones, or None.
        table_fault: why there is none.

    Returns:
        The files.

    Raises:
        OSError: if a file cannot be written.
    """
    data = folder / "lockin.json"
    text = json.dumps(lockin_payload(results, table_fault), indent=1, allow_nan=False)
    write_whole(data, text + "\n")
    written = [data]
    for name, result in zip(_picture_names(results), results, strict=True):
        save(lockin_figure(result), folder / name)
        written.append(folder / name)
    if table is not None:
        write_whole(folder / "amplitudes.csv", csv_of(table))
        written.append(folder / "amplitudes.csv")
    return written


def _picture_names(results: Sequence[LockinResult]) -> list[str]:
    """Return a file name for each trace; traces of the same name in different folders are numbered."""
    names: list[str] = []
    for result in results:
        stem = Path(result.trace.source).stem or "trace"
        name, number = f"lockin_{stem}.png", 2
        while name in names:
            name, number = f"lockin_{stem}_{number}.png", number + 1
        names.append(name)
    return names


_FLAGGED = "#B00020"
_MOST_POINTS = 20_000
_SMALL = 9
_HIGHEST = 4.0
"""Multiples of the drive frequency in the spectrum."""
_DECADES = 1e-5


def lockin_figure(result: LockinResult) -> Figure:
    """Return the picture of a reading: its response periods on top of each other, and its spectrum."""
    figure = new_figure(12.0, 5.4)
    left, right = figure.subplots(1, 2)
    _draw_folded(left, result)
    _draw_spectrum(right, result)
    name = printable(Path(result.trace.source).name)
    head = f"{name}: {result.verdict}"
    figure.suptitle(
        head if len(head) < 130 else head[:127] + "...",
        fontsize=11,
        color="black" if result.steady else _FLAGGED,
    )
    return figure


def _draw_folded(axes: Axes, result: LockinResult) -> None:
    """Draw all response periods on top of each other, even and odd ones in two colours."""
    folded = result.folded
    every = -(-len(folded.height) // _MOST_POINTS)
    turns = np.mod(folded.angle / (2.0 * np.pi), 1.0) * folded.order
    for parity, colour, label in ((0, DARK, "even response periods"), (1, BLUE, "odd ones")):
        some = np.flatnonzero(folded.cycle % 2 == parity)[::every]
        axes.plot(turns[some], folded.height[some], ".", ms=2.0, color=colour, alpha=0.5, label=label)
    fine = np.linspace(0.0, 1.0, 1200)
    axes.plot(folded.order * fine, folded.waveform(2.0 * np.pi * fine), lw=1.2, color=ACCENT, label="mean waveform")
    if result.peak_amplitude_nm is not None:
        label = f"peak {result.peak_amplitude_nm:.5g} nm"
        axes.axhline(result.peak_amplitude_nm, color=ACCENT, lw=0.9, ls="--", label=label)
    axes.axhline(0.0, color=GRID, lw=0.8)
    title = "best guess of the order" if result.order is None else "response period"
    axes.set_title(f"Folded onto {folded.order} drive periods ({title})", fontsize=11, loc="left")
    label_axes(axes, x="time since phase 0 (drive periods)", y="height above rest (nm)")
    low, high = axes.get_ylim()
    axes.set_ylim(low, high + 0.25 * (high - low))
    axes.legend(fontsize=_SMALL, loc="upper right", ncols=2, markerscale=5.0)


def _draw_spectrum(axes: Axes, result: LockinResult) -> None:
    """Draw the amplitude spectrum of whole response periods, with the drive and its fractions."""
    trace, folded = result.trace, result.folded
    height = folded.height - folded.height.mean()
    weight = np.hanning(len(height) + 2)[1:-1]
    amplitude = 2.0 * np.abs(np.fft.rfft(height * weight)) / weight.sum()
    frequency = np.fft.rfftfreq(len(height), trace.step_us) * 1e3
    drive = trace.drive_frequency_khz
    shown = (frequency > 0.0) & (frequency <= _HIGHEST * drive)
    top = float(max(np.max(amplitude[shown], initial=0.0), 1e-12))
    axes.plot(frequency[shown], np.maximum(amplitude[shown], top * _DECADES), color="black", lw=0.9, zorder=3)
    right = min(_HIGHEST * drive, float(frequency[-1]))
    for multiple in range(1, int(right / drive + 1e-9) + 1):
        label = "drive and its harmonics" if multiple == 1 else None
        axes.axvline(multiple * drive, color=ACCENT, lw=5.0, alpha=0.3, label=label)
    if folded.order > 1:
        label = f"subharmonics, drive/{folded.order}"
        for multiple in range(1, int(right / drive * folded.order + 1e-9) + 1):
            axes.axvline(multiple * drive / folded.order, color=BLUE, lw=1.0, ls=":", label=label)
            label = None
    if result.free_frequency_khz is not None and result.free_frequency_khz < right:
        origin = "" if result.free_frequency_origin == "given" else " (from the top's bending)"
        axes.axvline(result.free_frequency_khz, color=DARK, lw=1.3, ls="--", label=f"free frequency{origin}")
    axes.set_yscale("log")
    axes.set(xlim=(0.0, right), ylim=(top * _DECADES, top * 50.0))
    axes.set_title("Amplitude spectrum (Hann window)", fontsize=11, loc="left")
    label_axes(axes, x="frequency (kHz)", y="amplitude (nm)")
    axes.legend(fontsize=_SMALL, loc="upper right", ncols=2)
