"""The energy of a tap and the virial of every row.

With F_1 = k gamma (Z + A0), the sample's force at the drive's frequency,

    E = -pi Im(F_1 conj Z) - (pi k s/Q) sum_{n >= 2} n^2 |Z_n|^2,      virial = Re(F_1 conj Z)/2.

The first term is what the drive gives less what the air takes at the drive's frequency, for a force on the tip
pi k A (A0 |gamma| sin phi - s A/Q); the sum is what the air takes at the harmonics. They are taken as of one brief
impact a period, F_n = F_1, a tenth less: on resonance they do not matter, 3 to 10 % above it they take as much as
the tap.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from fitting.tapping_curves.curve import Instrument, Rows, TappingCurve, motion_of

_HARMONICS = 40
"""The sum of those of a brief impact converges like 1/n; beyond them a contact lasts too long to excite them."""
Pairs = Float[np.ndarray, "2 rows"]


class Energies(NamedTuple):
    """Energies of a tap in aJ, shape (rows,).

    Attributes:
        energy_aj: E.
        harmonics_aj: what the air takes of it at the harmonics.
        virial_aj: mean of force times height, of the first harmonic.
        amplitude_slopes: changes of energy and virial with the amplitude read, in aJ/nm, shape (2, rows).
        lag_slopes: changes of energy and virial with the lag, in aJ/degree, shape (2, rows).
    """

    energy_aj: Rows
    harmonics_aj: Rows
    virial_aj: Rows
    amplitude_slopes: Pairs
    lag_slopes: Pairs


def energies(curve: TappingCurve, instrument: Instrument) -> Energies:
    """Return the energy of a tap of every row, NaN where there is no phase.

    Args:
        curve: the curve; its spring constant and calibration are those given.
        instrument: what turns its readings into motion.
    """
    motion = motion_of(curve, instrument)
    scale = curve.spring_constant_n_per_m.value * curve.tip_calibration.value**2
    force, z = motion.gamma * (motion.height + motion.free_amplitude_nm), motion.height

    def energy_and_virial(work):
        return scale * np.stack([-np.pi * np.imag(work), 0.5 * np.real(work)])

    def slopes(dz):
        return energy_and_virial(motion.gamma * dz * np.conj(z) + force * np.conj(dz))

    energy, virial = energy_and_virial(force * np.conj(z))
    harmonics = scale * _lost_at_harmonics(curve, instrument, np.abs(force))
    with np.errstate(invalid="ignore", divide="ignore"):
        by_amplitude = slopes(motion.reading / curve.amplitude_nm)
    return Energies(energy - harmonics, harmonics, virial, by_amplitude, slopes(-1j * np.pi / 180.0 * motion.reading))


def _lost_at_harmonics(curve: TappingCurve, instrument: Instrument, force: Rows) -> Rows:
    """Return what the air takes at the harmonics over k, in nm^2: (pi s/Q) sum n^2 |F_1/k|^2/|gamma(n s)|^2."""
    n, q = np.arange(2, _HARMONICS + 1)[:, None], instrument.quality_factor
    frequencies, row = np.unique(curve.drive_frequency_khz, return_inverse=True)
    s = frequencies / instrument.free_frequency_khz
    each = max(instrument.harmonics_factor, 0.0) * n**2 / np.abs(1.0 - (n * s) ** 2 + 1j * n * s / q) ** 2
    return np.pi * s[row] / q * each.sum(axis=0)[row] * force**2


def largest_energies(curve: TappingCurve, instrument: Instrument) -> Rows:
    """Return the most that a tap can take at each amplitude, in aJ, whatever the phase and the harmonics.

    As a function of the lag the first harmonic's energy is a constant and a cosine; three lags tell its top.
    """
    at = [energies(replace(curve, lag_deg=np.full(curve.rows, lag)), instrument) for lag in (0.0, 90.0, 180.0)]
    first = [found.energy_aj + found.harmonics_aj for found in at]
    middle = 0.5 * (first[0] + first[2])
    return middle + np.hypot(first[1] - middle, 0.5 * (first[0] - first[2]))


def noise_of(curve: TappingCurve, found: Energies) -> Pairs:
    """Return the standard error of each energy and each virial from the noise of its own row, in aJ."""
    return np.hypot(found.amplitude_slopes * curve.amplitude_error_nm, found.lag_slopes * curve.lag_error_deg)
