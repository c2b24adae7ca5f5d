"""A trace folded onto one response period: its waveform, what each period leaves, and the errors that follow.

Harmonics of the response frequency are fitted to the samples by least squares. The response order, after how many drive
periods the trace repeats, is the one whose fit to half of the trace predicts the other half. The phase is that of the
response against the time at which the platform is highest.
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float, Int
from scipy.linalg import solve_toeplitz

from fitting.tables.csv_text import TableError
from fitting.traces.trace import Trace

PER_RESPONSE = 16
"""Harmonics of the response frequency per drive period in it: what an impact's kink leaves beyond them is below 1 %."""
GAP_SHARE = 0.4
"""Harmonics times the widest gap between phases; below 0.5 least squares stays well conditioned (Gröchenig 1992)."""
_SAMPLES_PER_PARAMETER = 3


@dataclass(frozen=True)
class Harmonics:
    """A periodic function sum over k of C_k exp(i k theta), k from -K to K, C_-k the conjugate of C_k.

    Attributes:
        coefficients: C_0 to C_K, shape (K + 1,).
        line: one of 1 to K, whose weights are kept.
        of_line: what the inverse normal matrix makes of the unit vector k = line, shape (2 K + 1,): its weights.
    """

    coefficients: Complex[np.ndarray, " harmonics"]
    of_line: Complex[np.ndarray, " lines"]
    line: int = 1

    def __call__(self, angle: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
        """Return the function at angles in rad."""
        return 2.0 * np.real(_polynomial(self.coefficients[1:], angle)) + float(self.coefficients[0].real)

    def weights(self, angle: Float[np.ndarray, " n"]) -> Complex[np.ndarray, " n"]:
        """Return the weights w of the samples in C_line = sum of w z.

        Args:
            angle: of the samples that were fitted.
        """
        highest = len(self.coefficients) - 1
        upper = _polynomial(self.of_line[highest + 1 :], angle)
        lower = _polynomial(self.of_line[:highest][::-1], -angle)
        return np.conj(upper + lower + self.of_line[highest])


def fit_harmonics(
    angle: Float[np.ndarray, " samples"], height: Float[np.ndarray, " samples"], highest: int, line: int = 1
) -> Harmonics:
    """Fit the harmonics 0 to K to samples by least squares.

    The normal matrix has the entries sum of exp(i (l - k) theta): it is Toeplitz, and only 2 K + 1 of them differ.

    Args:
        angle: omega t/N of the samples, in rad.
        height: of the samples.
        highest: K, not above `highest_harmonic`.
        line: the harmonic whose weights are kept, 1 to K.
    """
    turn = np.exp(1j * angle)
    sums = np.empty(2 * highest + 1, dtype=np.complex128)
    moments = np.empty(highest + 1, dtype=np.complex128)
    wave = np.ones_like(turn)
    for k in range(2 * highest + 1):
        sums[k] = wave.sum()
        if k <= highest:
            moments[k] = np.vdot(wave, height)
        wave *= turn
    both = np.concatenate([np.conj(moments[:0:-1]), moments])
    unit = np.zeros(2 * highest + 1, dtype=np.complex128)
    unit[highest + line] = 1.0
    # the first column holds k - l = 0, 1, ...; the first row its conjugate
    found = solve_toeplitz((np.conj(sums), sums), np.stack([both, unit], axis=1))
    return Harmonics(found[highest:, 0], found[:, 1], line)


def highest_harmonic(angle: Float[np.ndarray, " samples"], order: int) -> int:
    """Return how many harmonics the samples determine, from the widest gap between their phases; at least 1.

    Args:
        angle: of the samples, in rad.
        order: N, drive periods in a response period.
    """
    gap = widest_gap(angle)
    return max(1, min(PER_RESPONSE * order, int(GAP_SHARE / gap), len(angle) // (2 * _SAMPLES_PER_PARAMETER)))


def widest_gap(angle: Float[np.ndarray, " samples"]) -> float:
    """Return the widest gap between the phases of the samples, as a share of the response period."""
    turns = np.sort(np.mod(angle / (2.0 * np.pi), 1.0))
    return float(max(np.max(np.diff(turns), initial=0.0), 1.0 - turns[-1] + turns[0]))


def _polynomial(coefficients: Complex[np.ndarray, " k"], angle: Float[np.ndarray, " n"]) -> Complex[np.ndarray, " n"]:
    """Return the sum of c_k exp(i k theta), k = 1, 2, ..., by Horner's rule."""
    turn = np.exp(1j * angle)
    total = np.zeros_like(turn)
    for value in coefficients[::-1]:
        total = (total + value) * turn
    return total


_ROUNDING = 1e-12
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
        """The number of whole response periods in the trace."""
        return int(self.cycle[-1]) + 1

    @property
    def lockin(self) -> complex:
        """2/T times the integral of z exp(-i k omega t/N), k the waveform's line: 1 unless `at_drive`."""
        return complex(2.0 * self.waveform.coefficients[self.waveform.line])

    def at_drive(self) -> "Fold | None":
        """Return the reading at the drive's frequency omega; None where too few phases are sampled for it."""
        highest = len(self.waveform.coefficients) - 1
        if self.order > highest:
            return None
        return replace(self, waveform=fit_harmonics(self.angle, self.height, highest, self.order))

    @property
    def spread_nm(self) -> float:
        """Standard deviation of the heights."""
        return float(np.std(self.height))

    @property
    def is_constant(self) -> bool:
        """Whether the heights differ by no more than rounding."""
        return self.spread_nm <= _ROUNDING * float(np.max(np.abs(self.height)))

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
        return self.per_cycle(2.0 * self.cycles * self.waveform.weights(self.angle) * self.left)


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
    first (M - k and M + k like that of the drive). C is read off the harmonics that were fitted; where there is one
    only it is that of |sin|, 3/4 of the first.
    """
    lines = 2.0 * np.abs(folded.waveform.coefficients[1:])
    squares = np.arange(1, len(lines) + 1) ** 2
    kink = float(np.max((squares * lines)[1:])) if len(lines) > 1 else 0.75 * float(lines[0])
    # in a long noisy trace high harmonics are noise times k^2; a kink never makes more than the whole signal's
    kink = min(kink, float(folded.order**2 * 4.0 * np.max(lines)))
    line = folded.waveform.line
    m = max(folded.resolution, 2.0 * line)
    return kink * (1.0 / (m - line) ** 2 + 1.0 / (m + line) ** 2)


HIGHEST_ORDER = 16
"""Longest response in drive periods that is looked for; a steady orbit of a higher order is hardly ever seen."""
_SAMPLES_PER_PERIOD = 48
"""Averages of neighbours keep at least so many samples per drive period; a finer trace tells no more of the order."""
_PER_PERIOD = 8
"""Most harmonics per drive period; what a kink leaves beyond them, 1 % of the motion, is the same for all orders."""
_MOST_SAMPLES = 40_000
_UNSEEN = 0.003
"""A repetition is good enough where what it misses is below this share of the deflection's standard deviation."""
_MARGIN = 0.02
"""Share of the misfit that more parameters may take away by chance."""


class OrderSearch(NamedTuple):
    """What the search found.

    Attributes:
        order: the smallest N that predicts the trace as well as any.
        misfit_nm: rms error of the prediction for N = 1, 2, ..., shape (orders,).
        spread_nm: standard deviation of the deflection.
    """

    order: int
    misfit_nm: Float[np.ndarray, " orders"]
    spread_nm: float


def find_order(trace: Trace) -> OrderSearch:
    """Find the smallest number N of drive periods after which a trace repeats.

    For every N up to half the trace the first half is fitted by harmonics of omega/N and predicts the second, and the
    other way round. A prediction, unlike a fit, gains nothing by following noise or chaos. (Even and odd periods would
    not do: sampled in step with two drive periods they see different phases.)

    Args:
        trace: at least two drive periods of it.
    """
    turns, height = shortened(trace)
    spread = float(np.std(height))
    most = min(HIGHEST_ORDER, int(trace.drive_periods / 2.0 + 1e-9))
    band = _harmonics_per_period(turns, most)
    squares = np.array([_prediction_error(turns / order, height, band * order) for order in range(1, most + 1)])
    chance = max(_MARGIN, 8.0 / np.sqrt(len(height)))
    allowed = squares.min() * (1.0 + chance) + (_UNSEEN * spread) ** 2
    order = int(np.flatnonzero(squares <= allowed)[0]) + 1
    return OrderSearch(order, np.sqrt(squares), spread)


def shortened(trace: Trace) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Return drive phases (in turns) and heights, averaged over neighbours and cut where there are too many."""
    per_period = trace.drive_period_us / trace.step_us
    join = max(1, int(per_period / _SAMPLES_PER_PERIOD))
    whole = trace.samples // join * join
    height = trace.height_nm[:whole].reshape(-1, join).mean(axis=1)
    turns = trace.time_us[:whole].reshape(-1, join).mean(axis=1) / trace.drive_period_us
    return turns[-_MOST_SAMPLES:], height[-_MOST_SAMPLES:]


def _prediction_error(turns: Float[np.ndarray, " n"], height: Float[np.ndarray, " n"], highest: int) -> float:
    """Return the mean square of what either half of a trace says wrongly of the other.

    Args:
        turns: response phase of the samples, in turns.
        height: of the samples.
        highest: harmonics that are fitted.
    """
    angle, half = 2.0 * np.pi * turns, len(height) // 2
    total = 0.0
    for known, asked in ((slice(half), slice(half, None)), (slice(half, None), slice(half))):
        function = fit_harmonics(angle[known], height[known], highest)
        total += float(np.sum((height[asked] - function(angle[asked])) ** 2))
    return total / len(height)


def _harmonics_per_period(turns: Float[np.ndarray, " n"], most: int) -> int:
    """Return how many harmonics per drive period both halves determine for every order: the same band for all."""
    half, least = len(turns) // 2, float(_PER_PERIOD)
    for order in range(1, most + 1):
        for part in (turns[:half], turns[half:]):
            least = min(least, GAP_SHARE / (order * widest_gap(2.0 * np.pi * part / order)))
    return max(1, int(least))


_LEAST_SHARE = 0.5
"""Of the reference's variance that must lie at the drive frequency."""
_SLIP_DEG = 20.0
"""Change of its phase between first and second half of the trace from which the drive frequency is wrong."""


class Reference(NamedTuple):
    """The platform z_p = offset + beta cos(omega t + psi).

    Attributes:
        origin: "column", "drive_phase_deg" or "time zero".
        phase_deg: psi.
        phase_error_deg: from the noise of the column; 0 otherwise.
        amplitude_nm: beta: given, or the platform column's; None where not known.
        offset_nm: given, or the platform column's; None where not known.
    """

    origin: str
    phase_deg: float
    phase_error_deg: float
    amplitude_nm: float | None
    offset_nm: float | None


def find_reference(trace: Trace) -> Reference:
    """Return the platform's phase: from the option or comment, else from the column, else that of time 0.

    Args:
        trace: with or without a reference column.

    Raises:
        TableError: if the column holds no wave of the drive frequency.
    """
    settings = trace.settings
    amplitude, offset, phase, error = settings.drive_amplitude_nm, settings.offset_nm, None, 0.0
    if trace.platform is not None:
        mean, value, error = _wave(trace)
        phase = float(np.degrees(np.angle(value)))
        if trace.platform_in_nm:
            amplitude = abs(value) if amplitude is None else amplitude
            offset = mean if offset is None else offset
    if settings.drive_phase_deg is not None:
        return Reference("drive_phase_deg", settings.drive_phase_deg, 0.0, amplitude, offset)
    if phase is not None:
        return Reference("column", phase, error, amplitude, offset)
    return Reference("time zero", 0.0, 0.0, amplitude, offset)


def _wave(trace: Trace) -> tuple[float, complex, float]:
    """Return mean, complex amplitude and phase error (in degrees) of the reference column."""
    signal = np.asarray(trace.platform)
    angle = 2.0 * np.pi * trace.time_us / trace.drive_period_us
    values, left = _fitted(signal, angle)
    spread = float(np.sum((signal - signal.mean()) ** 2))
    if spread == 0.0 or float(np.sum(left**2)) > (1.0 - _LEAST_SHARE) * spread:
        raise TableError(
            f"{trace.source}: the reference column holds no wave of {trace.drive_frequency_khz:g} kHz; correct "
            "drive_frequency_khz or the sampling rate, or remove the column"
        )
    half = len(signal) // 2
    first, second = (_fitted(signal[part], angle[part])[0] for part in (slice(half), slice(half, None)))
    slip = float(np.degrees(np.angle(complex(second[1], -second[2]) / complex(first[1], -first[2]))))
    if abs(slip) > _SLIP_DEG:
        seen = trace.drive_frequency_khz + slip / 360.0 / (half * trace.step_us) * 1e3
        raise TableError(
            f"{trace.source}: the reference column slips by {slip:.3g} degrees over half the trace; it has "
            f"{seen:.7g} kHz, but drive_frequency_khz is {trace.drive_frequency_khz:g}"
        )
    value = complex(values[1], -values[2])
    noise = float(np.sqrt(np.sum(left**2) / (len(signal) - 3)))
    return float(values[0]), value, float(np.degrees(noise * np.sqrt(2.0 / len(signal)) / abs(value)))


def _fitted(signal: np.ndarray, angle: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    design = np.stack([np.ones_like(angle), np.cos(angle), np.sin(angle)], axis=1)
    values = np.linalg.lstsq(design, signal, rcond=None)[0]
    return values, signal - design @ values
