"""A simulated tapping curve as instruments export it, with the defects of real ones.

    python -m fitting.examples.make_raw_curve [FILE]

makes `raw_tapping.txt`, which `afm-jax tapping --example` analyses. Eight columns without a head: Z, deflection,
amplitude and phase, each out and back. Amplitude and deflection are in volts, heights repeat and are not in order, the
free part drifts, the phase has a zero of its own, and an attractive plateau lies before the repulsive slope. What the
energy of a tap is at each amplitude is known: amplitude and lag are prescribed over the height, and
E = pi k A (A0 |gamma| sin lag - s A/Q) follows, gamma = 1 - s^2 + i s/Q.
"""

import sys
from dataclasses import dataclass
from functools import cache

import numpy as np
from jaxtyping import Float
from scipy.interpolate import PchipInterpolator
from scipy.ndimage import gaussian_filter1d

from afm_jax.whole_files import write_whole
from fitting.examples import RAW_CURVE
from fitting.instruments.lag import free_lag_deg

SPRING_CONSTANT, QUALITY_FACTOR, FREE_FREQUENCY_KHZ, DRIVE_KHZ = 44.0, 230.0, 344.604, 344.6
FREE_NM, NM_PER_VOLT, PHASE_ZERO_DEG = 13.4, 42.0, 12.3
_HEIGHTS = (0.0, 30.0, 31.5, 34.0, 37.0, 40.0, 41.0, 41.5, 42.1, 42.7, 43.3)
_RATIOS = (1.0, 1.0, 0.995, 0.98, 0.957, 0.936, 0.922, 0.897, 0.856, 0.812, 0.767)
"""Amplitude over the free one at heights of the sample in nm: a plateau, then 1 nm per nm."""
_LAG_RATIOS = (0.75, 0.80, 0.86, 0.90, 0.912, 0.92, 0.94, 0.955, 0.98, 1.0)
_LAGS = (63.8, 69.9, 77.8, 84.7, 90.0, 94.7, 101.0, 102.2, 95.6, 90.0)
"""Lags at those ratios: the energy is that of curves measured on graphite, 1.6 to 12 aJ."""


@dataclass(frozen=True, eq=False)
class RawCurve:
    """A curve as it is exported, arrays of shape (2, points): out, back.

    Attributes:
        height_nm: as the instrument writes it, growing towards the tip.
        deflection_v: mean deflection.
        amplitude_v: lock-in amplitude.
        phase_deg: the lag and a zero of its own.
        amplitude_nm: without noise and drift.
        energy_aj: of a tap, true.
    """

    height_nm: Float[np.ndarray, "2 points"]
    deflection_v: Float[np.ndarray, "2 points"]
    amplitude_v: Float[np.ndarray, "2 points"]
    phase_deg: Float[np.ndarray, "2 points"]
    amplitude_nm: Float[np.ndarray, "2 points"]
    energy_aj: Float[np.ndarray, "2 points"]

    @property
    def text(self) -> str:
        """The eight columns, separated by tabs."""
        columns = [*self.height_nm, *self.deflection_v, *self.amplitude_v, *self.phase_deg]
        forms = ["%.2f"] * 2 + ["%.4f"] * 2 + ["%.5f"] * 2 + ["%.2f"] * 2
        rows = zip(*columns, strict=True)
        return "".join("\t".join(form % cell for form, cell in zip(forms, row, strict=True)) + "\n" for row in rows)


_ROUNDED_NM, _ROUNDED = 0.3, 0.008
"""Widths that corners of the two shapes are rounded with, in height and in amplitude over the free one."""
_FINE = 20001


@cache
def _shapes() -> tuple[PchipInterpolator, PchipInterpolator]:
    """Return the amplitude over the free one against height, and the lag against that."""
    height = np.linspace(_HEIGHTS[0], _HEIGHTS[-1] + 5.0 * _ROUNDED_NM, _FINE)
    # beyond the nearest height 1 nm per nm goes on
    deeper = np.maximum(height - _HEIGHTS[-1], 0.0) / FREE_NM
    ratio = PchipInterpolator(_HEIGHTS, _RATIOS)(np.minimum(height, _HEIGHTS[-1])) - deeper
    ratio = gaussian_filter1d(ratio, _ROUNDED_NM / (height[1] - height[0]), mode="nearest")
    at = np.linspace(_LAG_RATIOS[0], 2.0 - _LAG_RATIOS[0], _FINE)
    # odd about the free tip, whose lag is 90 degrees
    lag = PchipInterpolator(_LAG_RATIOS, _LAGS)(1.0 - np.abs(at - 1.0)) - 90.0
    lag = gaussian_filter1d(np.where(at > 1.0, -lag, lag), _ROUNDED / (at[1] - at[0]), mode="nearest")
    return PchipInterpolator(height, ratio), PchipInterpolator(at, 90.0 + lag)


def true_lag_deg(ratio: Float[np.ndarray, "..."], *, back: bool = False) -> Float[np.ndarray, "..."]:
    """Return the lag at an amplitude over the free one; on the way back a tap takes a little more."""
    free = free_lag_deg("force", DRIVE_KHZ / FREE_FREQUENCY_KHZ, QUALITY_FACTOR)
    return free + (_shapes()[1](ratio) - 90.0) * (0.985 if back else 1.0)


def true_energy_aj(ratio: Float[np.ndarray, "..."], *, back: bool = False) -> Float[np.ndarray, "..."]:
    """Return the energy of a tap in aJ at an amplitude over the free one, under a force on the tip."""
    s = DRIVE_KHZ / FREE_FREQUENCY_KHZ
    size = np.abs(1.0 - s**2 + 1j * s / QUALITY_FACTOR)
    drive = size * np.sin(np.deg2rad(true_lag_deg(ratio, back=back)))
    return np.pi * SPRING_CONSTANT * ratio * FREE_NM**2 * (drive - s * ratio / QUALITY_FACTOR)


def raw_curve(
    points: int = 1000, *, seed: int = 1, noise: float = 0.002, phase_noise_deg: float = 0.12, drift: float = 0.001
) -> RawCurve:
    """Return a simulated curve with the defects of measured ones.

    Args:
        points: each way.
        seed: of the noise.
        noise: of a reading of the amplitude, of it.
        phase_noise_deg: of a reading of the phase.
        drift: of the free amplitude over the whole curve, of it; that of the phase is 100 degrees times as much.
    """
    random = np.random.default_rng(seed)
    way = np.linspace(_HEIGHTS[0], _HEIGHTS[-1], points)
    true = np.stack([way, way[::-1]])
    # on the way back the tip lets go a little later
    ratio = _shapes()[0](true + np.array([[0.0], [0.15]]))
    lag = np.stack([true_lag_deg(ratio[0]), true_lag_deg(ratio[1], back=True)])
    time = np.linspace(0.0, 1.0, 2 * points).reshape(2, points)
    shape = true.shape
    # the height that is written is another than the one that the tip was at
    height = np.round((true + 0.03 * random.standard_normal(shape)) / 0.02) * 0.02
    amplitude = FREE_NM * ratio
    read = amplitude * (1.0 + drift * time + noise * random.standard_normal(shape))
    phase = lag + PHASE_ZERO_DEG + 100.0 * drift * time + phase_noise_deg * random.standard_normal(shape)
    touching = np.maximum(true - _HEIGHTS[4], 0.0)
    return RawCurve(
        height_nm=height,
        deflection_v=-0.004 * touching + 0.002 * random.standard_normal(shape),
        amplitude_v=read / NM_PER_VOLT,
        phase_deg=phase,
        amplitude_nm=amplitude,
        energy_aj=np.stack([true_energy_aj(ratio[0]), true_energy_aj(ratio[1], back=True)]),
    )


if __name__ == "__main__":
    write_whole(sys.argv[1] if len(sys.argv) > 1 else RAW_CURVE, raw_curve().text)
