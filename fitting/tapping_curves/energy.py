"""The energy of a tap and the virial, row by row, as amplitude and phase give them without any law.

With F_1 = k gamma (Z + A0), the sample's force at the drive's frequency,

    E = -pi Im(F_1 conj Z) - (pi k s/Q) sum_{n >= 2} n^2 |Z_n|^2,      virial = Re(F_1 conj Z)/2.

The first term is what the drive gives less what the air takes at the drive's frequency, for a force on the tip
pi k A (A0 |gamma| sin phi - s A/Q); the sum is what the air takes at the harmonics. Those not measured are taken
as of one brief impact a period, F_n = F_1, a tenth less: on resonance they do not matter, 3 to 10 % above it they
take as much as the tap.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from fitting.tapping_curves.curve import Instrument, Rows, TappingCurve, motion_of

_TRIALS = 361
_HARMONICS = 40
"""The sum of those of a brief impact converges like 1/n; beyond them a contact lasts too long to excite them."""


class Energies(NamedTuple):
    """Energies of a tap in aJ, shape (rows,).

    Attributes:
        energy_aj: E.
        harmonics_aj: what the air takes of it at the harmonics.
        virial_aj: mean of force times height, of the first harmonic.
        amplitude_slope: change with the amplitude read, in aJ/nm.
        lag_slope: change with the lag, in aJ/degree.
        virial_amplitude_slope: change of the virial with the amplitude read, in aJ/nm.
        virial_lag_slope: change of the virial with the lag, in aJ/degree.
    """

    energy_aj: Rows
    harmonics_aj: Rows
    virial_aj: Rows
    amplitude_slope: Rows
    lag_slope: Rows
    virial_amplitude_slope: Rows
    virial_lag_slope: Rows


def energies(curve: TappingCurve, instrument: Instrument) -> Energies:
    """Return the energy of a tap of every row, NaN where there is no phase.

    Args:
        curve: the curve; its spring constant and calibration are those given.
        instrument: what turns its readings into motion.
    """
    motion = motion_of(curve, instrument)
    gamma, z, free = motion.gamma, motion.height, motion.free_amplitude_nm
    scale = curve.spring_constant_n_per_m.value * curve.tip_calibration.value**2
    force = gamma * (z + free)
    first = -np.pi * np.imag(force * np.conj(z))

    def change(dz):
        return scale * (gamma * dz * np.conj(z) + force * np.conj(dz))

    with np.errstate(invalid="ignore", divide="ignore"):
        by_amplitude = change(motion.reading / curve.amplitude_nm)
    by_lag = change(-1j * motion.reading) * np.pi / 180.0
    harmonics = scale * _lost_at_harmonics(curve, instrument, np.abs(force))
    return Energies(
        energy_aj=scale * first - harmonics,
        harmonics_aj=harmonics,
        virial_aj=0.5 * scale * np.real(force * np.conj(z)),
        amplitude_slope=-np.pi * by_amplitude.imag,
        lag_slope=-np.pi * by_lag.imag,
        virial_amplitude_slope=0.5 * by_amplitude.real,
        virial_lag_slope=0.5 * by_lag.real,
    )


def _lost_at_harmonics(curve: TappingCurve, instrument: Instrument, force: Rows) -> Rows:
    """Return what the air takes at the harmonics, over k; measured where they are, else those of a brief impact."""
    q = instrument.quality_factor
    n = np.arange(2, _HARMONICS + 1)[:, None]
    frequencies, row = np.unique(curve.drive_frequency_khz, return_inverse=True)
    s = frequencies / instrument.free_frequency_khz
    parts = max(instrument.harmonics_factor, 0.0) * n**2 / np.abs(1.0 - (n * s) ** 2 + 1j * n * s / q) ** 2
    lost = parts.sum(axis=0)[row] * force**2
    for multiple, measured in curve.harmonic_amplitudes_nm.items():
        here = np.isfinite(measured) & (2 <= multiple <= _HARMONICS)
        lost[here] += multiple**2 * measured[here] ** 2 - (parts[multiple - 2, row] * force**2)[here]
    return np.pi * s[row] / q * lost


def largest_energies(curve: TappingCurve, instrument: Instrument) -> Rows:
    """Return the most that a tap can take at each amplitude, in aJ, whatever the phase and the harmonics.

    As a function of the lag the first harmonic's energy is a constant and a cosine; three lags tell its top.
    """
    at = [energies(replace(curve, lag_deg=np.full(curve.rows, lag)), instrument) for lag in (0.0, 90.0, 180.0)]
    first = [found.energy_aj + found.harmonics_aj for found in at]
    middle = 0.5 * (first[0] + first[2])
    return middle + np.hypot(first[1] - middle, 0.5 * (first[0] - first[2]))


def noise_of(curve: TappingCurve, found: Energies) -> Rows:
    """Return the standard error of each energy from the noise of its own row, in aJ."""
    return np.hypot(found.amplitude_slope * curve.amplitude_error_nm, found.lag_slope * curve.lag_error_deg)


def virial_noise_of(curve: TappingCurve, found: Energies) -> Rows:
    """Return the standard error of each virial from the noise of its own row, in aJ."""
    by_amplitude = found.virial_amplitude_slope * curve.amplitude_error_nm
    return np.hypot(by_amplitude, found.virial_lag_slope * curve.lag_error_deg)


def lags_of(curve: TappingCurve, instrument: Instrument, energy_aj: Rows) -> Rows:
    """Return the lag in degrees at which each row's tap takes an energy, the nearest to that read; NaN where none does.

    Args:
        curve: the curve, with a phase.
        instrument: what turns its readings into motion.
        energy_aj: wanted of each row, NaN where none is.
    """
    turns = np.linspace(-180.0, 180.0, _TRIALS)
    off = np.stack([energies(replace(curve, lag_deg=curve.lag_deg + turn), instrument).energy_aj for turn in turns])
    off -= energy_aj
    found = np.full(curve.rows, np.nan)
    for row in range(curve.rows):
        place = np.flatnonzero(off[:-1, row] * off[1:, row] <= 0.0)
        if place.size:
            before, after = off[place, row], off[place + 1, row]
            crossing = turns[place] + (turns[1] - turns[0]) * before / np.where(before == after, 1.0, before - after)
            found[row] = curve.lag_deg[row] + crossing[np.argmin(np.abs(crossing))]
    return found
