"""The instrument of curves of one lever, from what is stated of it and from rows of the free tip alone.

Its unknowns x are f0, Q, the harmonics' factor; of each curve the lag and the amplitude of its free tip, and drifts.
Rows in contact tell nothing of them: a change of f0 turns an energy into another one that is as smooth,
E(a) + t a sqrt(1 - a^2) with a = A/A0.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from afm_jax.solve.least_squares import Sum, chi2_tail, covariance_of, levenberg_marquardt
from fitting.instruments.lag import turned
from fitting.parameters import USUAL_DRIFTS
from fitting.tapping_curves.branches import free_ends
from fitting.tapping_curves.curve import (
    HARMONICS_FACTOR,
    Given,
    Instrument,
    Mask,
    Rows,
    TappingCurve,
    lag_of_free_tip,
)
from fitting.tapping_curves.energy import energies

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


class LeverUnknown(NamedTuple):
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


def least_squares(residual: Function, jacobian: Function, start: np.ndarray, *, until: float = _SETTLED) -> Solution:
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
        unknowns = [LeverUnknown(name, None, np.ones(0), given) for name, given in pairs]
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
        self.minimum = least_squares(self.residual, self.jacobian, np.zeros(len(unknowns)), until=1e-20)

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


def _unknowns_of(number: int, curve: TappingCurve, free: Mask) -> list[LeverUnknown]:
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
        found.append(LeverUnknown("phase_zero_deg", number, here.astype(float), Given(start, error)))
    known = Given(1.0, max(curve.free_amplitude_error, 1e-6))
    each = [(levels == level).astype(float) for level in range(levels.max(initial=-1) + 1)]
    found += [LeverUnknown("free_amplitude", number, rows, known) for rows in each]
    if curve.time is not None:
        errors = _WIDE_DRIFTS if free_ends(curve, free) else USUAL_DRIFTS
        found += [LeverUnknown(name, number, curve.time, Given(0.0, error)) for name, error in errors.items()]
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
