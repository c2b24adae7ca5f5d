"""A trace folded onto one response period: its waveform, what each period leaves, and the errors that follow."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Complex, Float, Int

from fitting.traces.lockin_harmonics import Harmonics, fit_harmonics, highest_harmonic, widest_gap
from fitting.traces.lockin_trace import Trace

SCATTER_PERIODS = 12
"""With fewer response periods their scatter says less of the noise than all samples' together."""


@dataclass(frozen=True, eq=False)
class Fold:
    """The last whole response periods of a trace.

    Attributes:
        order: N, drive periods in a response period.
        period_us: of the response.
        angle: omega t/N of the samples, in rad, shape (samples,).
        height: of the samples above the rest position, in nm.
        cycle: the response period that each sample belongs to, from 0.
        waveform: harmonics fitted to all of them.
        left: height less waveform.
        noise_nm: standard deviation of one sample, from what the waveform leaves.
        resolution: distinct phases in a response period.
    """

    order: int
    period_us: float
    angle: Float[np.ndarray, " samples"]
    height: Float[np.ndarray, " samples"]
    cycle: Int[np.ndarray, " samples"]
    waveform: Harmonics
    left: Float[np.ndarray, " samples"]
    noise_nm: float
    resolution: float

    @property
    def cycles(self) -> int:
        """Whole response periods."""
        return int(self.cycle[-1]) + 1

    @property
    def lockin(self) -> complex:
        """2/T times the integral of z exp(-i omega t/N)."""
        return complex(2.0 * self.waveform.coefficients[1])

    @property
    def spread_nm(self) -> float:
        """Standard deviation of the heights."""
        return float(np.std(self.height))

    def per_cycle(self, values: Complex[np.ndarray, " samples"]) -> Complex[np.ndarray, " cycles"]:
        """Return the sums of complex values over each response period."""
        sums = [np.bincount(self.cycle, part, self.cycles) for part in (np.real(values), np.imag(values))]
        return sums[0] + 1j * sums[1]

    def error_of(self, weights: Float[np.ndarray, " samples"]) -> float:
        """Return the standard error of sum of weights times heights.

        From twelve response periods on it is their scatter, whatever the colour of the noise; with fewer the noise is
        taken as white.

        Args:
            weights: of the samples.
        """
        if self.cycles < SCATTER_PERIODS:
            return self.noise_nm * float(np.sqrt(np.sum(weights**2)))
        parts = np.bincount(self.cycle, weights * self.left, self.cycles)
        return float(np.sqrt(np.sum((parts - parts.mean()) ** 2) * self.cycles / (self.cycles - 1)))

    @property
    def lockin_deviations(self) -> Complex[np.ndarray, " cycles"]:
        """By how much each response period's lock-in value differs from that of all."""
        return self.per_cycle(2.0 * self.cycles * self.waveform.first_weights(self.angle) * self.left)


def fold(trace: Trace, order: int) -> Fold:
    """Fold the last whole response periods of a trace.

    Args:
        trace: at least two response periods of it.
        order: N.
    """
    period = order * trace.drive_period_us
    cycles = int(trace.drive_periods / order + 1e-9)
    count = min(trace.samples, round(cycles * period / trace.step_us))
    time, height = trace.time_us[-count:], trace.height_nm[-count:]
    since = (time - time[0]) / period
    cycle = np.minimum((since + 1e-9).astype(np.int64), cycles - 1)
    angle = 2.0 * np.pi * time / period
    highest = highest_harmonic(angle, order)
    waveform = fit_harmonics(angle, height, highest)
    left = height - waveform(angle)
    freedom = max(1, count - 2 * highest - 1)
    noise = float(np.sqrt(np.sum(left**2) / freedom))
    return Fold(order, period, angle, height, cycle, waveform, left, noise, 1.0 / widest_gap(angle))


def sampling_error_nm(folded: Fold) -> float:
    """Return by how much harmonics beyond the sampling may falsify the lock-in amplitude.

    An impact's kink makes the harmonics fall as C/k^2. Sampled at M phases, the harmonics M - 1 and M + 1 look like the
    first. C is read off the harmonics that were fitted; where there is only one it is that of |sin|, 3/4 of the first.
    """
    lines = 2.0 * np.abs(folded.waveform.coefficients[1:])
    squares = np.arange(1, len(lines) + 1) ** 2
    kink = float(np.max((squares * lines)[1:])) if len(lines) > 1 else 0.75 * float(lines[0])
    # in a long noisy trace high harmonics are noise times k^2; a kink never makes more than the whole signal's
    kink = min(kink, float(folded.order**2 * 4.0 * np.max(lines)))
    m = max(folded.resolution, 2.0)
    return kink * (1.0 / (m - 1.0) ** 2 + 1.0 / (m + 1.0) ** 2)
