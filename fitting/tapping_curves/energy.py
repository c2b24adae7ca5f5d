"""The energy of a tap and the virial along a tapping curve, with bands that hold what the instrument leaves open.

*A row.* With F_1 = k gamma (Z + A0), the sample's force at the drive's frequency,

    E = -pi Im(F_1 conj Z) - (pi k s/Q) sum_{n >= 2} n^2 |Z_n|^2,      virial = Re(F_1 conj Z)/2.

The first term is what the drive gives less what the air takes at the drive's frequency, for a force on the tip
pi k A (A0 |gamma| sin phi - s A/Q); the sum is what the air takes at the harmonics. They are taken as of one brief
impact a period, F_n = F_1, a tenth less: on resonance they do not matter, 3 to 10 % above it they take as much as
the tap.

*The instrument* x (f0, Q, the harmonics' factor; of each curve the lag and the amplitude of its free tip, and drifts)
comes from what is stated and from rows of the free tip alone. Rows in contact tell nothing of it: a change of f0 turns
an energy into another one that is as smooth, E(a) + t a sqrt(1 - a^2) with a = A/A0.

*Along a branch* the energy is a constant and a Gaussian process (Matern 5/2) over the logarithm of the amplitude lost,
for energies change fastest at first contact. Energies of all branches and curves of a lever are E ~ N(E^, G) with
G = diag(noise^2) + S C S^T, S = dE/dx and C the covariance of x.

*No sample gives energy.* Each point's band is its normal distribution, cut where another point would have less than no
energy. What is left says of a point that it is measured, bracketed, or below a bound.

*One energy for all taps* is an assumption that narrows the instrument. It stands apart and makes no curve valid.
"""

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.optimize import isotonic_regression
from scipy.special import ndtr, ndtri

from afm_jax.saved import as_json
from afm_jax.solve.least_squares import IMPROBABLE, Sum, chi2_tail, covariance_of, levenberg_marquardt
from afm_jax.units import TWO_SIDED_95
from fitting.instruments.lag import turned
from fitting.parameters import USUAL_DRIFTS
from fitting.tapping_curves.branches import FEWEST_ROWS, CurveBranch, free_ends, side_of, ways
from fitting.tapping_curves.curve import (
    HARMONICS_FACTOR,
    Given,
    Instrument,
    Mask,
    Rows,
    TappingCurve,
    lag_of_free_tip,
    motion_of,
)

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


FEWEST_FREE_ROWS = 3
"""Rows that are off the sample; fewer may be those of first contact, and are not taken for the free tip's."""
_ANY_ZERO_DEG, _WIDE_ZERO_DEG = 90.0, 1000.0
"""Errors of a zero of the phase that is unknown, and of one that free rows determine: theirs is far smaller."""
_WIDE_DRIFTS = {"phase_drift_deg": 30.0, "free_amplitude_drift": 0.3}
"""Errors of drifts that rows of the free tip at both ends determine."""
_STEP = 1e-4
"""Of differences by the unknowns, in their units."""
_SETTLED, _ROUNDS, _RISE = 1e-6, 40, 0.1
"""Estimated distance of chi2 to its minimum, steps at most, and by how much a step may raise chi2: slopes of rows in
contact are taken at smooth readings, not at those that chi2 is of."""


class Nuisance(NamedTuple):
    """Something of the instrument that is not known exactly.

    Attributes:
        name: its key, with a number from the second of its kind on: each drive may have its own.
        kind: its key without the number.
        given: what is stated of it, the unit that of the key; an error of infinity: nothing.
        value: at the minimum.
        standard_error: there.
    """

    name: str
    kind: str
    given: Given
    value: float
    standard_error: float

    @property
    def pull(self) -> float:
        """Distance of the value from what was given, in the error given."""
        return (self.value - self.given.value) / self.given.error


class _Unknown(NamedTuple):
    """One of the unknowns x, which count in standard errors of what is known beforehand.

    Attributes:
        kind: what it is; frequency and Q by their logarithms.
        curve: number of the curve that it is of; None: of the lever.
        rows: by how much it counts in each row of that curve.
        given: what is known beforehand.
    """

    kind: str
    curve: int | None
    rows: Rows
    given: Given


Means = tuple[Float[np.ndarray, "means rows"], Float[np.ndarray, " means"], Float[np.ndarray, " means"]]
"""Means of free rows: the weights of the rows in each, its value and its error."""


class Solution(NamedTuple):
    """Where a least squares ends: unknowns, their covariance, chi2, its degrees of freedom, whether it settled there.

    Every unknown has a residual of what is known of it beforehand, so that the other residuals count the freedom.
    """

    at: Float[np.ndarray, " unknowns"]
    covariance: Float[np.ndarray, "unknowns unknowns"]
    chi2: float
    degrees_of_freedom: int
    settled: bool

    @property
    def p_value(self) -> float:
        """Probability of a larger chi2 if the model is right; NaN where nothing is left to judge by."""
        return chi2_tail(self.chi2, self.degrees_of_freedom) if self.degrees_of_freedom > 0 else float("nan")


Function = Callable[[np.ndarray], np.ndarray]


def _minimum(residual: Function, jacobian: Function, start: np.ndarray, *, until: float = _SETTLED) -> Solution:
    """Return the minimum of a sum of squares to some distance of chi2, and whether the search settled there."""

    def evaluate(place: np.ndarray) -> Sum:
        left = residual(place)
        return Sum(float(left @ left), left, jacobian(place))

    # what is far out of range is refused by its chi2
    with np.errstate(over="ignore", invalid="ignore"):
        end = levenberg_marquardt(evaluate, start, settled=until, most=_ROUNDS, rise=_RISE)
    chi2, left, slopes = end.sum
    covariance = covariance_of(slopes.T @ slopes)
    settled = end.distance <= 1e-2 and bool(np.isfinite(covariance).all())
    return Solution(end.place, covariance, chi2, len(left) - len(start), settled)


def _slopes(function: Function, x: np.ndarray, count: int) -> np.ndarray:
    """Return the changes of a function by the first unknowns, along the last axis, by central differences."""
    steps = _STEP * np.eye(len(x))[:count]
    return np.stack([(function(x + step) - function(x - step)) / (2.0 * _STEP) for step in steps], axis=-1)


COMMON = ("free_frequency_khz", "quality_factor", "harmonics_factor")
"""Unknowns that curves of one lever have in common: the first of a lever's."""


@dataclass(init=False, eq=False)
class Lever:
    """Curves of one lever, and the least squares that determines their instrument without the rows in contact.

    Attributes:
        curves: the curves.
        free: the rows of the free tip of each.
        unknowns: of the instrument.
        zeros: places among them of the phases' zeros, and their curves' numbers.
        minimum: of what is stated and the means of free rows.
    """

    curves: tuple[TappingCurve, ...]
    free: tuple[Mask, ...]
    _by_init: ClassVar[bool] = True

    def __init__(self, curves: Sequence[TappingCurve], free: Sequence[Mask]):
        """Find the instrument of curves with the same statements on their lever."""
        self.curves = tuple(curves)
        self.free = tuple(_of_free_tip(*pair) for pair in zip(curves, free, strict=True))
        lever = (self.curves[0].free_frequency_khz, self.curves[0].quality_factor)
        known = [Given(float(np.log(value)), max(error / value, 1e-9)) for value, error in lever]
        pairs = zip(COMMON, [*known, HARMONICS_FACTOR], strict=True)
        unknowns = [_Unknown(name, None, np.ones(0), given) for name, given in pairs]
        self._means = []
        for number, (curve, here) in enumerate(zip(self.curves, self.free, strict=True)):
            unknowns += _unknowns_of(number, curve, here)
            share, error = (part / curve.free_amplitude_nm for part in (curve.amplitude_nm, curve.amplitude_error_nm))
            drives = curve.drive_frequency_khz, curve.free_amplitude_nm
            lags = _means(curve, curve.lag_deg, curve.lag_error_deg, here, _kinds(drives[0]))
            self._means.append((lags, _means(curve, share, error, here, _kinds(*drives))))
        self.unknowns = tuple(unknowns)
        self._start = np.array([unknown.given.value for unknown in unknowns])
        self._unit = np.array([unknown.given.error for unknown in unknowns])
        self.zeros = [(i, one.curve or 0) for i, one in enumerate(unknowns) if one.kind == "phase_zero_deg"]
        # all but linear: a few steps more are as good as none
        self.minimum = _minimum(self.residual, self.jacobian, np.zeros(len(unknowns)), until=1e-20)

    def values(self, x: np.ndarray) -> np.ndarray:
        """Return the unknowns in their own units."""
        return self._start + self._unit * x[: len(self._unit)]

    def instrument(self, number: int, x: np.ndarray | None = None) -> Instrument:
        """Return the instrument of a curve, at the minimum if no unknowns are given."""
        values = self.values(self.minimum.at if x is None else x)
        rows = self.curves[number].rows
        zero, factor = np.zeros(rows), np.zeros(rows)
        for unknown, value in zip(self.unknowns, values.tolist(), strict=True):
            if unknown.curve == number:
                column = zero if unknown.kind.startswith("phase") else factor
                column += value * unknown.rows
        frequency, quality = np.exp(values[:2]).tolist()
        return Instrument(frequency, quality, zero, factor, float(values[2]))

    def residual(self, x: np.ndarray) -> np.ndarray:
        """Return in standard errors what is stated, the means of free rows, and stated zeros of the phase."""
        left = [x[: len(self.unknowns)]]
        for number, (lags, shares) in enumerate(self._means):
            at = self.instrument(number, x)
            columns = lag_of_free_tip(self.curves[number], at), at.free_amplitude_factor
            for (weights, mean, error), column in zip((lags, shares), columns, strict=True):
                left.append(turned(weights @ column - mean) / error)
        zeros = [(i, zero) for i, number in self.zeros if (zero := self.curves[number].phase_zero_deg)]
        off = [turned(self.values(x)[i] - zero.value) / max(zero.error, 1e-4) for i, zero in zeros]
        # the zero that several curves or frequencies state is one and the same, and counts once
        return np.concatenate([*left, np.array(off) / np.sqrt(max(len(off), 1))])

    def jacobian(self, x: np.ndarray) -> np.ndarray:
        """Return the changes of the residuals by the unknowns."""
        return _slopes(self.residual, x, len(self.unknowns))

    def slopes(self, curve: TappingCurve, number: int, x: np.ndarray) -> Float[np.ndarray, "2 rows unknowns"]:
        """Return the changes of each row's energy and virial by every unknown.

        Args:
            curve: readings at which they are taken.
            number: of the curve that they are of.
            x: the unknowns.
        """

        def of(y: np.ndarray) -> np.ndarray:
            found = energies(curve, self.instrument(number, y))
            return np.stack([found.energy_aj, found.virial_aj])

        return _slopes(of, x, len(self.unknowns))

    def nuisances(self, number: int, minimum: Solution | None = None) -> tuple[Nuisance, ...]:
        """Return what is stated of the instrument of a curve and where a least squares ends."""
        minimum = self.minimum if minimum is None else minimum
        curve = self.curves[number]
        values = self.values(minimum.at)
        errors = np.sqrt(np.diag(minimum.covariance))
        found: list[Nuisance] = []
        for i, unknown in enumerate(self.unknowns):
            if unknown.curve not in {None, number}:
                continue
            kind, given, value = unknown.kind, unknown.given, float(values[i])
            error = float(given.error * errors[i])
            if kind in {"free_frequency_khz", "quality_factor"}:
                given, value = getattr(curve, kind), float(np.exp(value))
                error *= value
            elif kind == "phase_zero_deg":
                given = curve.phase_zero_deg or Given(value, np.inf)
            count = sum(one.kind == kind for one in found)
            name = f"{kind}_{count}" if count else kind
            found.append(Nuisance(name, kind, given, value, error))
        return tuple(found)


def _of_free_tip(curve: TappingCurve, free: Mask) -> Mask:
    """Return free rows with a phase where a frequency has at least three of them."""
    known = free & (np.isfinite(curve.lag_deg) | (not curve.has_phase))
    kinds = _kinds(curve.drive_frequency_khz)
    return known & (np.bincount(kinds[known], minlength=curve.rows + 1)[kinds] >= FEWEST_FREE_ROWS)


def _kinds(*columns: Rows) -> Int[np.ndarray, " rows"]:
    """Return the number of each row's kind; rows of a kind are alike in all columns."""
    return np.unique(np.stack(columns), axis=1, return_inverse=True)[1].reshape(-1)


def _unknowns_of(number: int, curve: TappingCurve, free: Mask) -> list[_Unknown]:
    """Return a curve's own unknowns: of each frequency the free tip's lag, of each drive its amplitude, and drifts."""
    zero = 0.0 if curve.phase_zero_deg is None else curve.phase_zero_deg.value
    off = curve.lag_deg - lag_of_free_tip(curve, Instrument(curve.free_frequency_khz.value, curve.quality_factor.value))
    drives = curve.drive_frequency_khz, curve.free_amplitude_nm
    kinds, levels = _kinds(drives[0]), _kinds(*drives)
    found = []
    for kind in range(kinds.max(initial=-1) + 1):
        here = kinds == kind
        rows = np.flatnonzero(here & free & np.isfinite(off))
        start = zero
        error = _ANY_ZERO_DEG
        if len(rows):
            first, weights = off[rows[0]], curve.lag_error_deg[rows] ** -2.0
            start = float(first + np.average(turned(off[rows] - first), weights=weights))
            # of a zero that nothing is known of, any turn will do
            start = float(turned(start)) if curve.phase_zero_deg is None else start
            error = _WIDE_ZERO_DEG
        found.append(_Unknown("phase_zero_deg", number, here.astype(float), Given(start, error)))
    known = Given(1.0, max(curve.free_amplitude_error, 1e-6))
    each = [(levels == level).astype(float) for level in range(levels.max(initial=-1) + 1)]
    found += [_Unknown("free_amplitude", number, rows, known) for rows in each]
    if curve.time is not None:
        errors = _WIDE_DRIFTS if free_ends(curve, free) else USUAL_DRIFTS
        found += [_Unknown(name, number, curve.time, Given(0.0, error)) for name, error in errors.items()]
    return found


_FEWEST_OF_MEAN, _MOST_MEANS = 4, 8


def _means(curve: TappingCurve, values: Rows, errors: Rows, free: Mask, kinds: np.ndarray) -> Means:
    """Return means of the free rows of each kind, their errors with what they scatter beyond their noise.

    Where the order of the rows is known each stretch of neighbours has means of its own, which tell a drift.

    Args:
        curve: the curve.
        values: of its rows, degrees or parts of one, which are far from a turn.
        errors: theirs.
        free: rows of the free tip.
        kinds: number of each row's kind.
    """
    weights, means, mean_errors = [], [], []
    for kind in np.unique(kinds):
        rows = np.flatnonzero(free & (kinds == kind) & np.isfinite(values))
        parts = [rows]
        if curve.time is not None:
            runs = np.split(rows, np.flatnonzero(np.diff(rows) > 1) + 1)
            parts = [
                part for run in runs for part in np.array_split(run, min(len(run) // _FEWEST_OF_MEAN, _MOST_MEANS) or 1)
            ]
        for part in parts:
            if not len(part):
                continue
            off, information = turned(values[part] - values[part[0]]), errors[part] ** -2.0
            excess = np.sqrt(max(np.var(off) - 1.0 / information.mean(), 0.0))
            weights.append(np.bincount(part, information / information.sum(), curve.rows))
            means.append(values[part[0]] + weights[-1][part] @ off)
            mean_errors.append(np.hypot(information.sum() ** -0.5, excess))
    return np.reshape(weights, (-1, curve.rows)), np.array(means), np.array(mean_errors)


_SHALLOW = 0.03
"""Loss, of the free amplitude, that is added to all: there the length in nm is that at contact."""
_LENGTH, _SIZE = 0.7, 3.0
"""Of the process: length in the logarithm of the amplitude lost, and size over the range of the readings; the size that
readings make most probable is too small for one curve in twenty."""
_MOST_BINS, _POINTS = 60, 41
"""Rows of a branch beyond which neighbours are averaged, and points that it is given at."""


def losses(curve: TappingCurve, factor: float | Rows = 1.0) -> Rows:
    """Return the logarithm of what each row's amplitude has lost of the free one, smoothed along its way.

    By amplitude an energy is smooth where by height it is not: an attractive plateau ends within a nanometre.

    Args:
        curve: the curve.
        factor: true over stated free amplitude.
    """
    place, free = np.zeros(curve.rows), curve.free_amplitude_nm * factor
    for part in ways(curve):
        weights = (free[part] / curve.amplitude_error_nm[part]) ** 2
        ratio = isotonic_regression(curve.amplitude_nm[part] / free[part], weights=weights, increasing=False).x
        place[part] = np.log(_SHALLOW + np.maximum(1.0 - ratio, 0.0))
    return place


class Smoother(NamedTuple):
    """A constant and a process, given readings whose neighbours are averaged in bins.

    Attributes:
        place: of the bins.
        starts: where each begins.
        weights: of the rows in their bins.
        size: standard deviation of the process.
        inverse: of the averages' covariance, noise and process.
    """

    place: Float[np.ndarray, " bins"]
    starts: Int[np.ndarray, " bins"]
    weights: Float[np.ndarray, " rows"]
    size: float
    inverse: Float[np.ndarray, "bins bins"]

    @classmethod
    def of(cls, place: np.ndarray, noise: np.ndarray, size: float, most: int = _MOST_BINS) -> "Smoother":
        """Return the smoother of rows that stand in the order of their places, for a size of the process."""
        count = min(len(place), most)
        starts = -(-np.arange(count) * len(place) // count)
        information = noise**-2.0
        total = np.add.reduceat(information, starts)
        weights = information / np.repeat(total, np.diff(starts, append=len(place)))
        middle = np.add.reduceat(weights * place, starts)
        # places of several bins may be one
        own = np.diag(1.0 / total + 1e-12 * size**2)
        root = np.linalg.inv(np.linalg.cholesky(matern(middle, middle, size) + own))
        return cls(middle, starts, weights, size, root.T @ root)

    def average(self, values: np.ndarray) -> np.ndarray:
        """Return the weighted averages over the bins of values of the rows, shape (rows, ...)."""
        return np.add.reduceat((self.weights * values.T).T, self.starts, axis=0)

    def at(self, place: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return at some places the weights of the bins, shape (places, bins), and the variance besides."""
        ones = self.inverse.sum(axis=1)
        cross = matern(place, self.place, self.size)
        left, weights = 1.0 - cross @ ones, cross @ self.inverse
        variance = self.size**2 - np.sum(weights * cross, axis=1) + left**2 / ones.sum()
        return weights + np.outer(left, ones / ones.sum()), np.maximum(variance, 0.0)

    def of_rows(self, place: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, float]:
        """Return what rows' values become at their places, and the degrees of freedom that this takes."""
        weights, _ = self.at(place)
        bins = np.repeat(np.arange(len(self.starts)), np.diff(self.starts, append=len(place)))
        return weights @ self.average(values), float(np.sum(weights[np.arange(len(place)), bins] * self.weights))


def matern(a: np.ndarray, b: np.ndarray, size: float) -> np.ndarray:
    """Return the Matern 5/2 covariance of a process between two sets of places."""
    distance = np.sqrt(5.0) * np.abs(a[:, None] - b[None, :]) / _LENGTH
    return size**2 * (1.0 + distance + distance**2 / 3.0) * np.exp(-distance)


def _size_of(values: np.ndarray, noise: np.ndarray) -> float:
    """Return the size of the process of some readings: three times their range, in running means of five."""
    width = min(5, len(values))
    means = np.convolve(values, np.full(width, 1.0 / width), "valid")
    return _SIZE * max(float(np.ptp(means)), float(np.median(noise)))


def _smoothed(
    curve: TappingCurve, stretches: Sequence[np.ndarray], factor: float | Rows
) -> tuple[TappingCurve, Rows, list[np.ndarray]]:
    """Return a curve with smooth readings, at which errors of energies are taken, places of its rows, and stretches.

    Args:
        curve: the curve.
        stretches: rows along which readings are smooth; they are returned in the order of their places.
        factor: true over stated free amplitude.
    """
    place = losses(curve, factor)
    stretches = [rows[np.argsort(place[rows], kind="stable")] for rows in stretches]
    amplitude, lag = curve.amplitude_nm.copy(), curve.lag_deg.copy()
    for rows in stretches:
        for readings, errors in ((amplitude, curve.amplitude_error_nm), (lag, curve.lag_error_deg)):
            smoother = Smoother.of(place[rows], errors[rows], _size_of(readings[rows], errors[rows]))
            readings[rows], _ = smoother.of_rows(place[rows], readings[rows])
    return replace(curve, amplitude_nm=amplitude, lag_deg=lag), place, stretches


_FAR, _MOST_OUTLIERS = 4.0, 0.2
"""Residual in standard errors from which a row is excluded, and share of rows that may be."""
_ALLOWED = 3.0
"""Standard errors within which a negative energy is chance."""
MEASURED, BRACKET = 0.5, 0.1
"""Half of a band over its middle up to which an energy is measured; lower over upper end from which it is bracketed."""
HEADLINE = (0.95, 0.9, 0.8, 0.7, 0.5)
"""Amplitudes, as fractions of the free one, at which the output gives the energy."""


def said_of(low: float, high: float) -> str:
    """Return what a band of 95 % says of an energy: "measured", "bracket", or "upper bound".

    >>> said_of(2.0, 4.0), said_of(0.5, 4.0), said_of(0.1, 4.0)
    ('measured', 'bracket', 'upper bound')
    """
    if high - low <= MEASURED * (high + low):
        return "measured"
    return "bracket" if low > BRACKET * high else "upper bound"


@dataclass(frozen=True, kw_only=True, eq=False)
class EnergyCurve:
    """Energy and virial along a branch, in the order of the amplitude; bands hold the truth in 95 of 100 places.

    Attributes:
        amplitude_ratio: amplitude read over the free one.
        height_nm: of the sample.
        energy_low_aj: lower end of the energy's band, mean over a period of the drive.
        energy_high_aj: its upper end.
        virial_aj: mean of force times height, positive where attraction prevails.
        virial_error_aj: its standard error.
        estimate_aj: energy with the instrument where statements and free rows put it, whatever its sign.
        noise_aj: standard error of that but for the instrument.
        by_instrument: its change by every unknown of the instrument, in standard errors of what is known beforehand,
            shape (points, unknowns).
        certain: whether the place is far enough from first contact to be distinguished from it.
    """

    amplitude_ratio: Float[np.ndarray, " points"]
    height_nm: Float[np.ndarray, " points"]
    energy_low_aj: Float[np.ndarray, " points"]
    energy_high_aj: Float[np.ndarray, " points"]
    virial_aj: Float[np.ndarray, " points"]
    virial_error_aj: Float[np.ndarray, " points"]
    estimate_aj: Float[np.ndarray, " points"]
    noise_aj: Float[np.ndarray, " points"]
    by_instrument: Float[np.ndarray, "points unknowns"]
    certain: Bool[np.ndarray, " points"]

    @property
    def energy_aj(self) -> Float[np.ndarray, " points"]:
        """The middle of the band."""
        return 0.5 * (self.energy_low_aj + self.energy_high_aj)

    @property
    def energy_error_aj(self) -> Float[np.ndarray, " points"]:
        """The standard error that a band of this width has."""
        return 0.5 * (self.energy_high_aj - self.energy_low_aj) / TWO_SIDED_95

    def at(self, ratio: Any) -> Float[np.ndarray, "2 ..."]:
        """Return the band at amplitudes, of the free one, NaN beyond the branch."""
        return interpolated(ratio, self.amplitude_ratio, self.energy_low_aj, self.energy_high_aj)

    def estimates_at(self, ratio: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return energy, its own standard error and its change by the instrument at some amplitudes, NaN beyond.

        With the instrument where statements and free rows put it: differences of branches and curves hardly depend on
        it.
        """
        columns = self.estimate_aj, self.noise_aj, *self.by_instrument.T
        energy, noise, *by = interpolated(ratio, self.amplitude_ratio, *columns)
        return energy, noise, np.stack(by, axis=-1)


@as_json.register
def _(curve: EnergyCurve) -> dict[str, Any]:
    # what is said of each point stands beside its band
    names = ("amplitude_ratio", "height_nm", "energy_aj", "energy_low_aj", "energy_high_aj", "virial_aj")
    half = TWO_SIDED_95 * curve.virial_error_aj
    return {name: getattr(curve, name) for name in names} | {
        "said": [said_of(*ends) for ends in zip(curve.energy_low_aj, curve.energy_high_aj, strict=True)],
        "virial_low_aj": curve.virial_aj - half,
        "virial_high_aj": curve.virial_aj + half,
    }


def interpolated(ratio: Any, measured: np.ndarray, *columns: np.ndarray) -> np.ndarray:
    """Return columns at amplitudes, of the free one, by straight lines between those measured; NaN beyond them."""
    return np.stack([np.interp(ratio, measured, column, np.nan, np.nan) for column in columns])


@dataclass(frozen=True, eq=False)
class TappingBranch(CurveBranch):
    """Rows of one drive, one way and one side of the phase, and the energy along them.

    Attributes:
        rows: numbers of the rows.
        curve: energy and virial along them.
    """

    rows: Int[np.ndarray, " some"]
    curve: EnergyCurve


@dataclass(frozen=True, kw_only=True)
class EnergyFunctions:
    """Energies along the branches of a curve.

    Attributes:
        lever: the curves of its lever, and their instrument.
        number: of the curve among them.
        smooth: the curve with smooth readings, at which errors of energies are taken.
        energies: of every row, with the instrument where statements and free rows put it.
        branches: energy and virial along each.
        outliers: rows too far from the others.
        rows_chi2: of the rows about their functions.
        rows_freedom: number of these rows less what their functions take.
        scale: what the rows' own errors were multiplied by, the largest of the branches.
        possible: whether some instrument as stated leaves no energy of the lever's curves negative.
    """

    lever: Lever
    number: int
    smooth: TappingCurve
    energies: Energies
    branches: tuple[TappingBranch, ...]
    outliers: Mask
    rows_chi2: float
    rows_freedom: float
    scale: float
    possible: bool

    @property
    def nuisances(self) -> tuple[Nuisance, ...]:
        """What is known of the instrument."""
        return self.lever.nuisances(self.number)

    @property
    def instrument(self) -> Instrument:
        """Where statements and free rows put it."""
        return self.lever.instrument(self.number)


def energies_along(
    lever: Lever, stretches: Sequence[Sequence[np.ndarray]], repulsive: Sequence[Mask]
) -> list[EnergyFunctions]:
    """Return the energies along the branches of the curves of a lever, with their bands.

    Args:
        lever: the curves, and their instrument.
        stretches: rows of each curve along which the energy is smooth.
        repulsive: rows of each curve that are on the repulsive branch.
    """
    each = [_along(lever, i, *pair) for i, pair in enumerate(zip(stretches, repulsive, strict=True))]
    curves = [branch.curve for one in each for branch in one.branches]
    if not curves:
        return each
    names = ("estimate_aj", "noise_aj", "certain")
    estimate, noise, certain = (np.concatenate([getattr(c, name) for c in curves]) for name in names)
    size, axes = np.linalg.eigh(lever.minimum.covariance)
    root = axes * np.sqrt(np.maximum(size, 0.0))
    by_instrument = np.concatenate([c.by_instrument for c in curves]) @ root
    low, high, possible = positive_bands(estimate, noise, certain, by_instrument)
    middle = 0.5 * (low + high)
    common = TWO_SIDED_95 * lever.curves[0].relative_error * middle
    low = np.maximum(middle - np.hypot(middle - low, common), 0.0)
    high = middle + np.hypot(high - middle, common)
    bands = zip(curves, low.reshape(-1, _POINTS), high.reshape(-1, _POINTS), strict=True)
    curves = iter([replace(curve, energy_low_aj=below, energy_high_aj=above) for curve, below, above in bands])
    return [
        replace(one, possible=possible, branches=tuple(replace(branch, curve=next(curves)) for branch in one.branches))
        for one in each
    ]


def _along(lever: Lever, number: int, stretches: Sequence[np.ndarray], repulsive: Mask) -> EnergyFunctions:
    """Return the energies along the branches of one curve, without their bands."""
    # where the instrument's search did not settle there is no energy
    stretches = stretches if lever.minimum.settled else ()
    curve, at = lever.curves[number], lever.instrument(number)
    smooth, place, stretches = _smoothed(curve, stretches, at.free_amplitude_factor)
    found, at_smooth = energies(curve, at), energies(smooth, at)
    by_reading = np.stack([at_smooth.amplitude_slopes, at_smooth.lag_slopes])
    by_instrument = lever.slopes(smooth, number, lever.minimum.at)
    unknowns = [one if one.curve == number else one._replace(rows=np.zeros(curve.rows)) for one in lever.unknowns]
    outliers, branches, fits = np.zeros(curve.rows, bool), [], []
    for rows in stretches:
        fit = _stretch(curve, rows, place, found.energy_aj, by_reading[:, 0])
        of_virial = _stretch(curve, fit.rows, place, found.virial_aj, by_reading[:, 1])
        outliers[rows] = ~np.isin(rows, fit.rows)
        fits.append(fit)
        for side in (False, True):
            here = fit.rows[repulsive[fit.rows] == side]
            if len(here) < FEWEST_ROWS:
                continue
            ratios = 1.0 + _SHALLOW - np.exp(place[here])
            ratio = np.linspace(max(ratios.min(), 0.0), ratios.max(), _POINTS)
            estimate, noise, by = _at(unknowns, fit, found.energy_aj, by_instrument[0], ratio)
            virial, virial_noise, virial_by = _at(unknowns, of_virial, found.virial_aj, by_instrument[1], ratio)
            variance = np.einsum("nu,uv,nv->n", virial_by, lever.minimum.covariance, virial_by) + virial_noise**2
            heights = fit.smoother.average(curve.offset_nm[fit.rows])
            uncertain = _ALLOWED * np.median(curve.amplitude_error_nm[here] / curve.free_amplitude_nm[here])
            along = EnergyCurve(
                amplitude_ratio=ratio,
                height_nm=np.interp(np.log(_SHALLOW + 1.0 - ratio), fit.smoother.place, heights),
                energy_low_aj=estimate,
                energy_high_aj=estimate,
                virial_aj=virial,
                virial_error_aj=np.sqrt(variance + (curve.relative_error * virial) ** 2),
                estimate_aj=estimate,
                noise_aj=noise,
                by_instrument=by,
                certain=1.0 - ratio > uncertain,
            )
            drive = float(curve.drive_frequency_khz[here[0]]), float(curve.free_amplitude_nm[here[0]])
            branches.append(TappingBranch(*drive, bool(curve.retract[here[0]]), side, rows=np.sort(here), curve=along))
    return EnergyFunctions(
        lever=lever,
        number=number,
        smooth=smooth,
        energies=found,
        branches=tuple(sorted(branches, key=lambda b: (b.drive, b.retract, b.repulsive))),
        outliers=outliers,
        rows_chi2=sum((fit.chi2 for fit in fits), 0.0),
        rows_freedom=sum((fit.freedom for fit in fits), 0.0),
        scale=max([1.0, *(fit.scale for fit in fits)]),
        possible=True,
    )


class _Stretch(NamedTuple):
    """A smooth function along rows: those kept, their smoother, what they scatter about it, and the scale of errors."""

    rows: Int[np.ndarray, " some"]
    smoother: Smoother
    chi2: float
    freedom: float
    scale: float


def _stretch(curve: TappingCurve, rows: np.ndarray, place: Rows, values: Rows, slopes: np.ndarray) -> _Stretch:
    """Return the smooth function of values along a stretch of rows, without those that are more than four errors off.

    An energy is one at an amplitude, which is known no better than it was read: an error dA of the reading moves it by
    E_A dA at the height, and by (E_A - E'/A0) dA at the ratio.
    """
    amplitude_slope, lag_slope = (slope[rows] for slope in slopes)
    free, ratios = curve.free_amplitude_nm[rows], 1.0 + _SHALLOW - np.exp(place[rows])
    by_lag = lag_slope * curve.lag_error_deg[rows]
    steep = np.zeros(len(rows))
    kept = np.ones(len(rows), bool)
    for last in (False, False, True):
        steepest = np.maximum(np.abs(amplitude_slope), np.abs(amplitude_slope - steep / free))
        here = rows[kept]
        noise = np.hypot(steepest * curve.amplitude_error_nm[rows], by_lag)[kept]
        size = _size_of(values[here], noise)
        smoother = Smoother.of(place[here], noise, size)
        mean, taken = smoother.of_rows(place[here], values[here])
        off, freedom = (values[here] - mean) / noise, max(len(here) - taken, 1.0)
        chi2 = float(off @ off)
        scale = 1.0 if chi2_tail(chi2, max(round(freedom), 1)) > IMPROBABLE else float(np.sqrt(chi2 / freedom))
        ratio, first = np.unique(ratios[kept], return_index=True)
        if len(ratio) > 4:
            steep = np.interp(ratios, ratio, np.gradient(mean[first], ratio))
        far = np.abs(off) > _FAR * scale
        if not last and kept.all() and far.sum() <= _MOST_OUTLIERS * len(here):
            kept[far] = False
    smoother = Smoother.of(place[here], noise * scale, size) if scale > 1.0 else smoother
    return _Stretch(here, smoother, chi2, freedom, scale)


def _at(
    unknowns: Sequence[_Unknown], fit: _Stretch, values: Rows, slopes: np.ndarray, ratio: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return a smooth function at some amplitudes, its own standard error, and its change by every unknown.

    Args:
        unknowns: of the instrument.
        fit: of the function.
        values: of it in each row of the curve.
        slopes: changes of the values by every unknown, shape (rows, unknowns).
        ratio: the amplitudes, of the free one.
    """
    weights, variance = fit.smoother.at(np.log(_SHALLOW + 1.0 - ratio))
    mean, by = (weights @ fit.smoother.average(column[fit.rows]) for column in (values, slopes))
    # with more of a free amplitude the same ratio is at a larger reading; a branch may be all at one amplitude
    moved = np.gradient(mean, ratio) * ratio if np.ptp(ratio) > 0.0 else np.zeros(len(ratio))
    for i, unknown in enumerate(unknowns):
        if unknown.kind.startswith("free_amplitude"):
            by[:, i] += moved * unknown.given.error * (weights @ fit.smoother.average(unknown.rows[fit.rows]))
    return mean, np.sqrt(variance), by


def positive_bands(
    estimate: Rows, noise: Rows, certain: Mask, by_instrument: Float[np.ndarray, "rows unknowns"]
) -> tuple[Rows, Rows, bool]:
    """Return bands of 95 % of energies that are nowhere negative, and whether such energies exist.

    With E(a) = t at one point, E(a') of another has the mean E^' + (t - E^) G(a', a)/G(a, a) and a variance: t may be
    what leaves each mean + 3 standard deviations >= 0.

    Args:
        estimate: energies of all points of a lever.
        noise: their own standard errors.
        certain: points that may say so.
        by_instrument: changes of the energies by independent unknowns of the instrument, each known to 1.
    """
    variance = noise**2 + np.sum(by_instrument**2, axis=1)
    possible = not np.any((estimate + _ALLOWED * np.sqrt(variance) <= 0.0) & certain)
    certain = certain & (estimate + _ALLOWED * np.sqrt(variance) > 0.0)
    ends = []
    for n, middle in enumerate(estimate.tolist()):
        shared = by_instrument @ by_instrument[n]
        gain = shared / variance[n]
        left = np.sqrt(np.maximum(variance - gain * shared, 0.0))
        gain[n], left[n] = 1.0, 0.0
        with np.errstate(divide="ignore", invalid="ignore"):
            limits = middle - (estimate + _ALLOWED * left) / gain
        least = max(limits[certain & (gain > 1e-9)].max(initial=-np.inf), 0.0)
        most = limits[certain & (gain < -1e-9)].min(initial=np.inf)
        if least > most - noise[n]:
            # no instrument leaves all above nothing but by chance: none is taken for more than it is
            possible = possible and bool(least <= most)
            least, most = 0.0, np.inf
        low, high = _densest(middle, float(np.sqrt(variance[n])), least, most)
        ends.append((low, max(high, low + TWO_SIDED_95 * noise[n])))
    low, high = np.array(ends).T
    return low, high, possible


def _densest(mean: float, error: float, low: float, high: float) -> tuple[float, float]:
    """Return the 95 % of highest density of a normal distribution that is cut at low and high.

    Equal tails would never hold a truth that is next to nothing.
    """
    below, above = (low - mean) / error, (high - mean) / error
    if below > 0.0:
        # the tail that is left, without cancellation
        low, high = _densest(-mean, error, -high, -low)
        return -high, -low
    inside = 0.95 * (ndtr(above) - ndtr(below))
    # about the mean as far as the cuts allow
    first = np.clip(0.5 - 0.5 * inside, ndtr(below), ndtr(above) - inside)
    ends = np.clip(ndtri([first, first + inside]), max(below, min(above, 0.0) - 9.0), above)
    return mean + error * float(ends[0]), mean + error * float(ends[1])


def largest_of(branches: Sequence[TappingBranch]) -> tuple[int, int]:
    """Return the branch and the point at which the middle of the band is largest."""
    tops = [int(np.argmax(branch.curve.energy_aj)) for branch in branches]
    branch = max(range(len(branches)), key=lambda i: float(branches[i].curve.energy_aj[tops[i]]))
    return branch, tops[branch]


_NARROWS = 0.7
"""Half of a band over that of today up to which something more that is known narrows it."""


def what_narrows(functions: EnergyFunctions) -> str:
    """Return what to state to narrow the band where the energy is largest: zero of the phase, or free frequency.

    What is known of an unknown i to an error e takes (S C)_i^2/(e^2 + C_ii) off the variance S C S.
    """
    branch, point = largest_of(functions.branches)
    lever = functions.lever
    c = functions.branches[branch].curve
    row = functions.branches[branch].rows[0]
    covariance, by = lever.minimum.covariance, c.by_instrument[point]
    zero = next(i for i, n in lever.zeros if n == functions.number and lever.unknowns[i].rows[row])

    def half_of_band(i: int, error: float) -> float:
        known = (error / lever.unknowns[i].given.error) ** 2
        left = by @ covariance @ by - (by @ covariance[i]) ** 2 / (known + covariance[i, i])
        return TWO_SIDED_95 * float(np.sqrt(max(left, 0.0) + c.noise_aj[point] ** 2))

    frequency = f"'# free_frequency_khz = VALUE +- {1e-5 * functions.instrument.free_frequency_khz:.1g}'"
    half, words = min(
        (half_of_band(zero, 0.2), "the zero of the phase to 0.2 degrees ('# phase_zero_deg = VALUE +- 0.2')"),
        (half_of_band(0, 1e-5), f"the free frequency to 1e-5 of itself ({frequency})"),
    )
    if half > _NARROWS * half_of_band(zero, np.inf):
        return "zero of the phase and free frequency would not narrow that; less noise or more rows would"
    return f"state {words}, which would leave +- {half:.2g} aJ"


def differences_of_ways(functions: EnergyFunctions) -> list[dict[str, Any]]:
    """Return by how much retract differs from approach at the same amplitude and on the same side of the phase.

    Of each two branches, by their numbers, where they differ most in errors; what both have in common cancels.
    """
    found, covariance = [], functions.lever.minimum.covariance
    share = functions.lever.curves[functions.number].relative_error
    for (i, one), (j, other) in itertools.product(enumerate(functions.branches), repeat=2):
        low = max(b.curve.amplitude_ratio[0] for b in (one, other))
        high = min(b.curve.amplitude_ratio[-1] for b in (one, other))
        same = (one.drive, one.repulsive) == (other.drive, other.repulsive)
        if one.retract or not other.retract or not same or not low < high:
            continue
        ratio = np.linspace(low, high, _POINTS)
        (a, of_a, by_a), (b, of_b, by_b) = (branch.curve.estimates_at(ratio) for branch in (one, other))
        off, by = b - a, by_b - by_a
        error = np.sqrt(of_a**2 + of_b**2 + np.einsum("nu,uv,nv->n", by, covariance, by) + (share * off) ** 2)
        most = int(np.argmax(np.abs(off) / error))
        at = {"amplitude_ratio": ratio[most], "energy_aj": off[most], "standard_error": error[most]}
        found.append({"approach": i, "retract": j} | at)
    return found


@dataclass(frozen=True, kw_only=True)
class EnergyGroup:
    """One energy of rows of one drive and one side of the phase.

    Attributes:
        drive: frequency in kHz and free amplitude in nm.
        repulsive: whether the lag is below the free tip's.
        rows: numbers of the rows.
        energy_aj: of a tap.
        error_aj: its standard error.
    """

    drive: tuple[float, float]
    repulsive: bool
    rows: Int[np.ndarray, " some"]
    energy_aj: float
    error_aj: float

    @property
    def name(self) -> str:
        """What it is called."""
        frequency, amplitude = self.drive
        return f"{side_of(self.repulsive)}, {frequency:g} kHz, free amplitude {amplitude:.4g} nm"

    @property
    def interval95_aj(self) -> tuple[float, float]:
        """Ends of the 95 % interval of the energy of a tap in aJ."""
        return self.energy_aj - TWO_SIDED_95 * self.error_aj, self.energy_aj + TWO_SIDED_95 * self.error_aj


@dataclass(frozen=True, kw_only=True)
class OneEnergy:
    """One energy for each group of rows, fitted together with the instrument.

    Attributes:
        groups: rows and energies.
        nuisances: of the instrument.
        residual: of the rows fitted, in standard errors; NaN elsewhere.
        minimum: chi2 of rows, free rows and what is stated, its degrees of freedom.
        scale: what the rows' own errors were multiplied by.
    """

    groups: tuple[EnergyGroup, ...]
    nuisances: tuple[Nuisance, ...]
    residual: Rows
    minimum: Solution
    scale: float

    @property
    def used(self) -> Mask:
        """Rows that were fitted."""
        return np.isfinite(self.residual)


def one_energy(
    lever: Lever, usable: Mask, repulsive: Mask, smooth: TappingCurve, scale: float = 1.0
) -> OneEnergy | None:
    """Return one energy for each drive and side of a lever's only curve, the instrument free within what is stated.

    Args:
        lever: the curve, and its instrument.
        usable: rows that may share an energy; None where no drive and side has enough of them.
        repulsive: rows of the repulsive branch.
        smooth: the curve with smooth readings, at which errors of energies are taken.
        scale: what the rows' own errors are multiplied by.
    """
    curve, count = lever.curves[0], len(lever.unknowns)
    columns = np.stack([curve.drive_frequency_khz, curve.free_amplitude_nm, ~repulsive], axis=1)
    kinds = np.unique(columns[usable], axis=0)
    groups = [np.flatnonzero(usable & np.all(columns == kind, axis=1)) for kind in kinds]
    groups = [rows for rows in groups if len(rows) >= FEWEST_ROWS]
    if not groups:
        return None
    rows = np.concatenate(groups)
    group = np.repeat(np.arange(len(groups)), [len(part) for part in groups])
    own = (group[:, None] == np.arange(len(groups))).astype(float)

    def off(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return how far the rows' energies are from those of their groups, and their noise."""
        at = lever.instrument(0, x)
        noise = scale * noise_of(smooth, energies(smooth, at))[0][rows]
        return energies(curve, at).energy_aj[rows] - x[count:][group], noise

    def residual(x: np.ndarray) -> np.ndarray:
        left, noise = off(x)
        return np.concatenate([lever.residual(x), left / noise])

    def jacobian(x: np.ndarray) -> np.ndarray:
        """Return the changes at the likeliest readings with the groups' energies.

        At others slopes depend on the scatter of the energies, and pull Q and f0 to where all of them are smaller.
        """
        noise, there = off(x)[1], energies(smooth, lever.instrument(0, x))
        missing = (x[count:][group] - there.energy_aj[rows]) / (noise / scale) ** 2
        moved = replace(smooth, amplitude_nm=smooth.amplitude_nm.copy(), lag_deg=smooth.lag_deg.copy())
        moved.amplitude_nm[rows] += missing * (there.amplitude_slopes[0] * smooth.amplitude_error_nm**2)[rows]
        moved.lag_deg[rows] += missing * (there.lag_slopes[0] * smooth.lag_error_deg**2)[rows]
        by = lever.slopes(moved, 0, x)[0][rows]
        of_free = np.pad(lever.jacobian(x), ((0, 0), (0, len(groups))))
        return np.concatenate([of_free, np.concatenate([by, -own], axis=1) / noise[:, None]])

    start = energies(curve, lever.instrument(0)).energy_aj
    x = np.concatenate([lever.minimum.at, [float(np.mean(start[part])) for part in groups]])
    minimum = _minimum(residual, jacobian, x)
    residuals = np.full(curve.rows, np.nan)
    residuals[rows] = np.divide(*off(minimum.at))
    found = zip(groups, minimum.at[count:].tolist(), np.sqrt(np.diag(minimum.covariance)[count:]).tolist(), strict=True)
    return OneEnergy(
        groups=tuple(
            EnergyGroup(
                drive=(float(curve.drive_frequency_khz[part[0]]), float(curve.free_amplitude_nm[part[0]])),
                repulsive=bool(repulsive[part[0]]),
                rows=part,
                energy_aj=energy,
                error_aj=float(np.hypot(error, curve.relative_error * energy)),
            )
            for part, energy, error in found
        ),
        nuisances=lever.nuisances(0, minimum),
        residual=residuals,
        minimum=minimum,
        scale=scale,
    )
