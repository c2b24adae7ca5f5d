"""The amplitude spectrum of the deflection, with the harmonics and subharmonics of the drive."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from afm_jax.motion.settle import settled, window_of
from afm_jax.motion.trajectory import trajectory
from afm_jax.plots.motion_window import Look
from afm_jax.plots.picture_style import ACCENT, BLUE, DARK, GRID, label_axes, new_figure, save

_MOST_PERIODS = 60
"""Of the drive; each contact in them is integrated once more."""
_SAMPLES_PER_PERIOD = 32
_HIGHEST = 8.0
"""Multiples of the response frequency, or of the impacts' near twice the free one, that are shown at least."""
_DECADES = 1e-6


class Spectrum(NamedTuple):
    """Amplitudes of the waves that a deflection is made of."""

    frequency_khz: Float[np.ndarray, " lines"]
    amplitude_nm: Float[np.ndarray, " lines"]
    response_khz: float
    """Drive frequency over N; the drive's own where nothing repeats."""
    periods: int
    """Response periods in the stretch."""
    repeats: bool


def spectrum_of(look: Look) -> Spectrum:
    """Return the spectrum over the last whole response periods, from equally spaced samples.

    The samples end with the last whole response period, so that a motion that repeats has lines without skirts; one
    that does not is weighted with a Hann window.

    Args:
        look: the motion.
    """
    simulation = look.simulation
    verdict = settled(look.scene, simulation)
    window = window_of(look.scene, simulation, verdict, look.drive)
    repeats = verdict.settled and not verdict.stuck
    response = (verdict.periods or 1) * look.drive.period_us if repeats else look.drive.period_us
    first = float(simulation.start.time_us)
    last = window.to_us if repeats else (look.to_us if verdict.stuck else float(simulation.final.time_us))
    # only what has settled repeats: the last fifth at most
    room = (last - first) * (0.2 if repeats and verdict.contacts else 0.8)
    periods = int(np.clip(room / response, 1, max(1, _MOST_PERIODS // (verdict.periods or 1))))
    span = min(periods * response, last - first)
    samples = periods * _SAMPLES_PER_PERIOD * max(1, round(response / look.drive.period_us))
    step = span / samples
    times = last - span + step * np.arange(samples)
    path = trajectory(look.scene, simulation, times)
    deflection = path.position_nm
    if look.scene.base is not None:
        deflection = deflection - np.asarray(look.scene.base.position_and_velocity(times)[0])
    weight = np.ones(samples) if repeats else np.hanning(samples + 1)[:-1]
    # the window would smear the mean over the lowest lines
    mean = float(np.sum(weight * deflection) / weight.sum())
    amplitude = 2.0 * np.abs(np.fft.rfft((deflection - mean) * weight)) / weight.sum()
    amplitude[0] = abs(mean)
    return Spectrum(1e3 * np.fft.rfftfreq(samples, step), amplitude, 1e3 / response, periods, repeats)


def draw_spectrum(look: Look, path: Path) -> None:
    """Draw the spectrum as a PNG file."""
    found = spectrum_of(look)
    picture = new_figure(9.0, 5.0)
    axes = picture.subplots()
    drive = 1e3 / look.drive.period_us
    slow = min(found.response_khz, 2.0 * float(look.scene.cantilever.frequency_khz))
    top = max(_HIGHEST * slow, 2.2 * drive)
    shown = (found.frequency_khz > 0.0) & (found.frequency_khz <= top * (1.0 + 1e-9))
    frequency, amplitude = found.frequency_khz[shown], found.amplitude_nm[shown]
    floor = max(float(amplitude.max()) * _DECADES, 1e-12)
    if found.repeats:
        axes.vlines(frequency, floor, np.maximum(amplitude, floor), color="black", linewidth=1.2, zorder=3)
    else:
        axes.plot(frequency, np.maximum(amplitude, floor), color="black", linewidth=1.0, zorder=3)
    axes.set_yscale("log")
    right = float(frequency[-1]) if frequency.size else drive
    for multiple in range(1, int(right / drive + 1e-9) + 1):
        label = "drive and its harmonics" if multiple == 1 else None
        axes.axvline(multiple * drive, color=ACCENT, linewidth=5.0, alpha=0.30, label=label)
    if found.repeats and found.response_khz < 0.99 * drive:
        label = f"subharmonics, drive/{round(drive / found.response_khz)}"
        for multiple in range(1, int(right / found.response_khz + 1e-9) + 1):
            axes.axvline(multiple * found.response_khz, color=BLUE, linewidth=1.0, linestyle=":", label=label)
            label = None
    free = float(look.scene.cantilever.frequency_khz)
    if free <= right:
        axes.axvline(free, color=DARK, linewidth=1.4, linestyle="--", label="free frequency")
    axes.set(xlim=(0.0, 1.02 * right), ylim=(floor, float(amplitude.max()) * 30.0))
    label_axes(axes, x="frequency (kHz)", y="amplitude (nm)")
    axes.grid(color=GRID, alpha=0.25)
    axes.legend(loc="upper right", fontsize=10, ncols=3, framealpha=1.0)
    kind = f"{found.periods} response periods" if found.repeats else f"{found.periods} drive periods, nothing repeats"
    axes.set_title(f"Spectrum of the deflection ({kind})", fontsize=12, loc="left")
    save(picture, path)
