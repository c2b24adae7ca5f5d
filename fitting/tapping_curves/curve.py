"""A tapping curve as its energy needs it: amplitude and phase against height, and what is known of the instrument.

The tip, z ~ Re(Z exp(i omega t)), obeys k gamma Z = F_drive + F_1 with gamma = 1 - s^2 + i s/Q and s = f/f0, F_1 the
first harmonic of the sample's force. Free, Z = -A0: that sets the time. Measured are an amplitude A and a lag phi,

* under a force on the tip those of the height, Z = -A exp(-i (phi - arg gamma));
* under a base that shakes those of the deflection, behind the base: D = -A exp(-i (phi - arg gamma)), Z = D - gamma A0,
  and A0 = A_free/|1 - gamma| with A_free the amplitude of the free deflection.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple, TypeVar

import numpy as np
from jaxtyping import Bool, Complex, Float, Int

from fitting.instruments.lag import AS_STATED, PhaseReadings, PhaseSense, free_lag_deg
from fitting.tables.table import AmplitudeTable

Rows = Float[np.ndarray, " rows"]
Mask = Bool[np.ndarray, " rows"]
Phasors = Complex[np.ndarray, " rows"]
R = TypeVar("R", "TappingCurve", AmplitudeTable)


class Given(NamedTuple):
    """A number that is known beforehand, and its standard error (0: exactly known)."""

    value: float
    error: float = 0.0

    def __str__(self) -> str:
        return f"{self.value:g} +- {float(f'{self.error:.2g}'):g}" if self.error else f"{self.value:g}"


@dataclass(frozen=True, kw_only=True)
class TappingCurve:
    """Rows of a tapping curve; arrays of shape (rows,), NaN where nothing was measured.

    Attributes:
        source: its name, as it begins messages.
        drive: what shakes the cantilever: a force on the tip, or its base.
        offset_nm: height of the sample over the tip's rest position.
        amplitude_nm: of the height (force) or the deflection (base) at the drive's frequency.
        amplitude_error_nm: its standard error.
        lag_deg: how far it lags behind the drive; NaN throughout where no phase was recorded.
        lag_error_deg: its standard error.
        free_amplitude_nm: of the free tip (force) or the free deflection (base).
        free_amplitude_error: its relative standard error.
        drive_frequency_khz: omega/2 pi.
        retract: whether the sample moves away.
        free_frequency_khz: f0.
        quality_factor: Q.
        spring_constant_n_per_m: k, of the mode (1.03 times the static one of a rectangular cantilever).
        over_spring_constant: whether k is not known: it counts as 1 N/m, and energies in aJ are those over k in nm^2.
        tip_calibration: true length over the length stated, of every amplitude.
        phase_zero_deg: lag that the instrument adds; None: nothing is known of it.
        origin_error_nm: standard error of that position.
        lines: where each row stands in its file.
        time: place of each row in the order of measurement, from -1/2 to 1/2; None: that order is not known.
        phase: sign and zero of the phase as read, and how they are known.
        assumed: what of the instrument was given without an error: it has a usual one (`USUAL_ERRORS`).
    """

    source: str
    drive: Literal["force", "base"] = "force"
    offset_nm: Rows
    amplitude_nm: Rows
    amplitude_error_nm: Rows
    lag_deg: Rows
    lag_error_deg: Rows
    free_amplitude_nm: Rows
    free_amplitude_error: float = 0.0
    drive_frequency_khz: Rows
    retract: Mask
    free_frequency_khz: Given
    quality_factor: Given
    spring_constant_n_per_m: Given
    over_spring_constant: bool = False
    tip_calibration: Given = Given(1.0)  # noqa: RUF009 (never changed)
    phase_zero_deg: Given | None = None
    origin_error_nm: float = 0.3
    lines: Int[np.ndarray, " rows"]
    time: Rows | None = None
    phase: PhaseSense = AS_STATED
    assumed: tuple[str, ...] = ()

    @property
    def rows(self) -> int:
        """The number of rows of the curve."""
        return len(self.offset_nm)

    @property
    def has_phase(self) -> bool:
        """Whether any row has a phase."""
        return bool(np.isfinite(self.lag_deg).any())

    @property
    def relative_error(self) -> float:
        """Relative standard error of all energies and virials, which go with k and the square of lengths."""
        calibration, spring = self.tip_calibration, self.spring_constant_n_per_m
        return float(np.hypot(2.0 * calibration.error / calibration.value, spring.error / spring.value))


def part_of(rows: R, chosen: Mask) -> R:
    """Return the rows chosen of a curve or a table, of every array that has a number for each row."""
    own: dict[str, Any] = {
        name: value[chosen]
        for name, value in vars(rows).items()
        if isinstance(value, np.ndarray) and value.shape == chosen.shape
    }
    return replace(rows, **own)


HARMONICS_FACTOR = Given(0.9, 0.1)
"""Impacts that last excite high harmonics less: by a few per cent to a fifth in simulated curves."""


class Instrument(NamedTuple):
    """What of the instrument turns readings into motion, at one trial of it.

    Attributes:
        free_frequency_khz: f0.
        quality_factor: Q.
        phase_zero_deg: what the instrument adds to each lag.
        free_amplitude_factor: true over stated free amplitude.
        harmonics_factor: what the air takes at harmonics, over that of one brief impact a period.
    """

    free_frequency_khz: float
    quality_factor: float
    phase_zero_deg: float | Rows = 0.0
    free_amplitude_factor: float | Rows = 1.0
    harmonics_factor: float = HARMONICS_FACTOR.value


class TipMotion(NamedTuple):
    """The motion at the drive's frequency, lengths as the curve states them (not calibrated).

    Attributes:
        gamma: 1 - s^2 + i s/Q.
        free_amplitude_nm: A0 of the tip's height.
        reading: the phasor that was measured: Z, or D under a base.
        height: Z.
    """

    gamma: Phasors
    free_amplitude_nm: Rows
    reading: Phasors
    height: Phasors


def motion_of(curve: TappingCurve, instrument: Instrument) -> TipMotion:
    """Return the motion that a curve's readings mean."""
    s = curve.drive_frequency_khz / instrument.free_frequency_khz
    gamma = 1.0 - s**2 + 1j * s / instrument.quality_factor
    lag = np.deg2rad(curve.lag_deg - instrument.phase_zero_deg)
    reading = -curve.amplitude_nm * np.exp(-1j * (lag - np.angle(gamma)))
    free = curve.free_amplitude_nm * instrument.free_amplitude_factor
    if curve.drive == "force":
        return TipMotion(gamma, free, reading, reading)
    free = free / np.abs(1.0 - gamma)
    return TipMotion(gamma, free, reading, reading - gamma * free)


def lag_of_free_tip(curve: TappingCurve, instrument: Instrument) -> Rows:
    """Return the lag that the free tip shows on the instrument in every row, in degrees."""
    ratio = curve.drive_frequency_khz / instrument.free_frequency_khz
    return free_lag_deg(curve.drive, ratio, instrument.quality_factor) + instrument.phase_zero_deg


def phase_readings(curve: TappingCurve, free: Mask, ways: Sequence[np.ndarray] = ()) -> PhaseReadings:
    """Return what of a curve says which sense its phase has.

    Args:
        curve: the curve, its phase as read.
        free: rows of the free tip.
        ways: rows of each drive and way, the farthest first; empty where heights are not known.
    """
    frequency = curve.free_frequency_khz
    quality = curve.quality_factor
    level = curve.free_amplitude_nm
    return PhaseReadings(
        drive=curve.drive,
        frequency_ratio=curve.drive_frequency_khz / frequency.value,
        frequency_error=frequency.error / frequency.value,
        quality_factor=quality.value,
        quality_error=quality.error / quality.value,
        ratio=curve.amplitude_nm / level,
        ratio_error=np.hypot(curve.amplitude_error_nm / level, curve.free_amplitude_error),
        phase_deg=curve.lag_deg,
        phase_error_deg=curve.lag_error_deg,
        free=free,
        ways=ways,
        zero=curve.phase_zero_deg,
    )
