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
    harmonics = scale * _harmonics(curve, instrument, np.abs(force)).lost
    return Energies(
        energy_aj=scale * first - harmonics,
        harmonics_aj=harmonics,
        virial_aj=0.5 * scale * np.real(force * np.conj(z)),
        amplitude_slope=-np.pi * by_amplitude.imag,
        lag_slope=-np.pi * by_lag.imag,
        virial_amplitude_slope=0.5 * by_amplitude.real,
        virial_lag_slope=0.5 * by_lag.real,
    )


class _Harmonics(NamedTuple):
    """What the air takes at the harmonics, over k, of every row.

    Attributes:
        lost: all of it, in nm^2.
        by_force: of those not measured, over |F_1/k|^2; measured ones do not hang on the force.
        by_frequency: change of `lost` with f0 while the force stays, in nm^2/kHz.
        by_quality: likewise with Q.
    """

    lost: Rows
    by_force: Rows
    by_frequency: Rows
    by_quality: Rows


def _harmonics(curve: TappingCurve, instrument: Instrument, force: Rows) -> _Harmonics:
    """Return what the air takes at the harmonics; measured where they are, else those of a brief impact."""
    q, f0 = instrument.quality_factor, instrument.free_frequency_khz
    n = np.arange(2, _HARMONICS + 1)[:, None]
    frequencies, row = _distinct(curve.drive_frequency_khz)
    s = frequencies / f0
    gamma = 1.0 - (n * s) ** 2 + 1j * n * s / q
    parts = max(instrument.harmonics_factor, 0.0) * n**2 / np.abs(gamma) ** 2
    changes = [2.0 * (n * s) ** 2 - 1j * n * s / q, -1j * n * s / q]
    # relative changes of each part with ln f0 and ln Q
    slopes = [-2.0 * np.real(change / gamma) * parts for change in changes]
    factor, square = np.pi * s[row] / q, force**2
    by_force, by_frequency, by_quality = (part.sum(axis=0)[row] for part in (parts, *slopes))
    others = np.zeros(curve.rows)
    for multiple, measured in curve.harmonic_amplitudes_nm.items():
        here = np.isfinite(measured) & (2 <= multiple <= _HARMONICS)
        others[here] += multiple**2 * measured[here] ** 2
        for column, part in zip((by_force, by_frequency, by_quality), (parts, *slopes), strict=True):
            column[here] -= part[min(multiple, _HARMONICS) - 2, row][here]
    lost = factor * (others + by_force * square)
    return _Harmonics(
        lost=lost,
        by_force=factor * by_force,
        by_frequency=(factor * by_frequency * square - lost) / f0,
        by_quality=(factor * by_quality * square - lost) / q,
    )


def _distinct(values: Rows) -> tuple[np.ndarray, np.ndarray]:
    """Return the different values, and which of them each row has; most curves have one."""
    if len(values) and (values == values[0]).all():
        return values[:1], np.zeros(len(values), int)
    return np.unique(values, return_inverse=True)


class InstrumentSlopes(NamedTuple):
    """Changes of energy (aJ), virial (aJ) and the free tip's lag (degrees) of every row, by one unit of something."""

    energy_aj: Rows
    virial_aj: Rows
    free_lag_deg: Rows


def instrument_slopes(curve: TappingCurve, instrument: Instrument) -> dict[str, InstrumentSlopes]:
    """Return the changes of each row's energy and virial by the fields of the instrument, by their names.

    They are the derivatives of `energies`: of gamma, of the phasor read, which turns with arg gamma, and under a base
    of the free amplitude A_free/|1 - gamma|.
    """
    motion = motion_of(curve, instrument)
    gamma, z, free = motion.gamma, motion.height, motion.free_amplitude_nm
    q, f0 = instrument.quality_factor, instrument.free_frequency_khz
    scale = curve.spring_constant_n_per_m.value * curve.tip_calibration.value**2
    force = gamma * (z + free)
    harmonics = _harmonics(curve, instrument, np.abs(force))
    base, nothing = curve.drive == "base", np.zeros(curve.rows)

    def by(dgamma, dreading, dfree, dharmonics=0.0, dlag=nothing) -> InstrumentSlopes:
        dz = dreading - (dgamma * free + gamma * dfree if base else 0.0)
        dforce = dgamma * (z + free) + gamma * (dz + dfree)
        product = dforce * np.conj(z) + force * np.conj(dz)
        lost = dharmonics + 2.0 * harmonics.by_force * np.real(np.conj(force) * dforce)
        return InstrumentSlopes(-scale * (np.pi * np.imag(product) + lost), 0.5 * scale * np.real(product), dlag)

    def by_gamma(dgamma, dharmonics) -> InstrumentSlopes:
        turn, other = np.imag(dgamma / gamma), dgamma / (1.0 - gamma)
        dfree, dlag = (free * np.real(other), turn + np.imag(other)) if base else (nothing, turn)
        return by(dgamma, 1j * turn * motion.reading, dfree, dharmonics, np.rad2deg(dlag))

    s = curve.drive_frequency_khz / f0
    of_force = harmonics.by_force * np.abs(force) ** 2
    factor = instrument.harmonics_factor
    stated = curve.free_amplitude_nm / np.abs(1.0 - gamma) if base else curve.free_amplitude_nm
    return {
        "free_frequency_khz": by_gamma((2.0 * s**2 - 1j * s / q) / f0, harmonics.by_frequency),
        "quality_factor": by_gamma(-1j * s / q**2, harmonics.by_quality),
        "phase_zero_deg": by(0.0, 1j * np.pi / 180.0 * motion.reading, 0.0, dlag=np.ones(curve.rows)),
        "free_amplitude_factor": by(0.0, 0.0, stated),
        "harmonics_factor": InstrumentSlopes(-scale * of_force / factor if factor > 0.0 else nothing, nothing, nothing),
    }


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
