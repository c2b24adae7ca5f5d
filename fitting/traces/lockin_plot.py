"""The picture of a reading: the trace folded onto its response period, and the spectrum with the drive's fractions."""

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes

from afm_jax.plots.picture_style import ACCENT, BLUE, DARK, GRID, label_axes, new_figure, save
from fitting.tables.csv_text import printable
from fitting.traces.lockin_result import LockinResult

_FLAGGED = "#B00020"
_MOST_POINTS = 20_000
_SMALL = 9
_HIGHEST = 4.0
"""Multiples of the drive frequency in the spectrum."""
_DECADES = 1e-5


def draw_lockin(result: LockinResult, path: Path) -> None:
    """Draw a reading as a PNG file."""
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
    save(figure, path)


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
