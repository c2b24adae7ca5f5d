"""The step after a fit that takes in the model discrepancy: parameters and unknowns by generalised least squares.

To first order the readings' residuals in errors are r + J d + U b + noise, with the change d of the parameters and the
unknowns b ~ N(0, 1) of what the model leaves out (`fitting.fits.discrepancy`). With V = noise covariance + U U^T the
step of the parameters is d = -(J^T V^-1 J)^-1 J^T V^-1 r, their covariance is (J^T V^-1 J)^-1, and the most likely
unknowns are b = -U^T V^-1 (r + J d) (`StepSystem.step`).

All of it is small: a step from the fit's own linearisation, of which as much is taken as lowers chi2 with the readings
computed from the law after it, not linearised (`descending_part`). Readings of slow impacts bend with the law: the step
is taken again with what was computed in place of its linearisation, until chi2 falls no more (`settled_step`).
Remainders of the corrections, and what slow impacts lack in any picture of impacts, common to peak and lock-in of a
row, are no part of that law: they are in the covariance of the rows.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float

from afm_jax.least_squares import covariance_of
from fitting.fits.discrepancy import ModelDiscrepancy, remainders
from fitting.fits.minimum import ModelErrors, padding
from fitting.fits.objective import MOST_OUTLIERS, OUTLIER, ROBUST, Objective
from fitting.forward import ImpactSlopes, Predicted, free_impacts, impact_at, impact_slopes
from fitting.parameters import parameter_called

_RUN, _RUN_STEP = 0.2, 0.1
"""Width of the bumps in ln u that a run of residuals is looked for with (standard deviation), and their distance."""
_TOGETHER, _APART = 2.0, 1.0 / 16.0
"""Variance of the mean and of the difference of peak and lock-in of a slow row (times root 2), over that of each."""
_NO_WEIGHT = 1e-3
"""Weight of the rows that a robust fit finds to be outliers."""


class StepRows(NamedTuple):
    """The rows of a fit as the step sees them: everything in the objective's errors.

    Attributes:
        residual: of the readings, then of what else there is.
        jacobian: by the parameters.
        slopes: of the amplitudes' residuals by what impacts do.
        measurement_error: of each amplitude, over the objective's.
        slow_error: that slow impacts have in any picture, over the objective's error.
        approach, rebound: of the free tip, in nm/us.
        pull, change: acceleration at mid contact in nm/us^2 and its change in nm/us^3.
        hertz_time: in us.
    """

    residual: Float[np.ndarray, " n"]
    jacobian: Float[np.ndarray, "n p"]
    slopes: ImpactSlopes
    measurement_error: Float[np.ndarray, "rows k"]
    slow_error: Float[np.ndarray, "rows k"]
    approach: Float[np.ndarray, " rows"]
    rebound: Float[np.ndarray, " rows"]
    pull: Float[np.ndarray, " rows"]
    change: Float[np.ndarray, " rows"]
    hertz_time: Float[np.ndarray, " rows"]


def rows_of_fit(
    stated: Objective, objective: Objective, values: Float[np.ndarray, " p"], model_errors: ModelErrors, scale: float
) -> StepRows:
    """Return the rows of a fit as the step sees them.

    Args:
        stated: the objective with the errors as measured.
        objective: the fit's, following its orbits.
        values: the fitted ones.
        model_errors: of the rows.
        scale: of the errors.
    """
    problem, rows = objective.problem, jax.tree.map(np.asarray, objective.measurement.rows)
    plain = Objective(objective.measurement, problem, near=objective.near)
    linear = plain.at_values(values[None])
    prediction = jax.tree.map(lambda leaf: np.asarray(leaf)[0], linear.prediction)
    impact = impact_at(values, objective.measurement, problem).impact
    tips = jax.tree.map(np.asarray, free_impacts(impact, prediction.coordinate))
    speeds = tips.speeds
    measured = np.asarray(objective.measurement.rows.measured)
    error = np.where(measured, rows.error_nm, 1.0)
    if objective.robust:
        # the squares' weights, at which least squares have the same minimum; outliers pull no more
        misfit = plain.misfit(linear)
        error = error * (1.0 + (misfit / ROBUST) ** 2) ** -0.25
        far = np.any(np.abs(misfit) > OUTLIER, axis=1, keepdims=True)
        if far.sum() <= max(1.0, MOST_OUTLIERS * measured.any(axis=1).sum()):
            error = np.where(far, _NO_WEIGHT * error, error)
    there = (prediction.orbits > 0) & ~rows.free
    return StepRows(
        residual=np.asarray(linear.residual)[0],
        jacobian=np.asarray(linear.jacobian)[0],
        slopes=impact_slopes(values, objective.measurement, problem, objective.near),
        measurement_error=np.where(measured, scale * np.asarray(stated.measurement.rows.error_nm) / error, 1.0),
        slow_error=np.where(measured, scale * padding(model_errors.slow_error, rows.amplitude_nm) / error, 0.0),
        approach=np.where(there, speeds.approach, 100.0),
        rebound=np.where(there, speeds.rebound, 99.0),
        pull=np.where(there, prediction.pull_nm_per_us2, 0.0),
        change=np.where(there, prediction.change_nm_per_us3, 0.0),
        hertz_time=tips.hertz_time,
    )


class LinearStep(NamedTuple):
    """The fit after the step, to first order: parameters, shapes, and unknowns b of the model discrepancy.

    Attributes:
        names: of the parameters, then of the shapes.
        values: of parameters and shapes.
        change: d, by which these values have moved in the step.
        covariance: of these values; infinite where a direction is not determined.
        chi2: r^T V^-1 r of the readings, with the constraints and priors.
        residual: of the readings, in the objective's errors, at the most likely b.
        unknown: the most likely b; the prior of each is N(0, 1).
        unknown_covariance: of b, for given parameters.
        follow: derivatives of the most likely b by the parameters and shapes.
    """

    names: tuple[str, ...]
    values: Float[np.ndarray, " k"]
    change: Float[np.ndarray, " k"]
    covariance: Float[np.ndarray, "k k"]
    chi2: float
    residual: Float[np.ndarray, "rows k"]
    unknown: Float[np.ndarray, " m"]
    unknown_covariance: Float[np.ndarray, "m m"]
    follow: Float[np.ndarray, "m k"]

    def partly(self, share: float) -> "LinearStep":
        """Return what a part of the step leads to; covariances, chi2 and residuals are those of the whole one."""
        return self._replace(
            values=self.values - (1.0 - share) * self.change, change=share * self.change, unknown=share * self.unknown
        )

    def towards(self, other: "LinearStep") -> "LinearStep":
        """Return the step half way to another one; covariances, chi2 and residuals are those of this one."""
        middle = {name: 0.5 * (getattr(self, name) + getattr(other, name)) for name in ("values", "change", "unknown")}
        return self._replace(**middle)


class StepParameters(NamedTuple):
    """What moves in a step: the parameters, then the shapes of the discrepancy.

    Attributes:
        names: theirs.
        values: where the step begins.
        ends: lowest and highest value of each.
        free: which of them are not at their bound.
    """

    names: tuple[str, ...]
    values: Float[np.ndarray, " k"]
    ends: Float[np.ndarray, "k 2"]
    free: Bool[np.ndarray, " k"]


@dataclass(frozen=True, eq=False)
class StepSystem:
    """A fit's rows, linearised, with all that is left out; what steps from it share is computed once.

    Attributes:
        residual: of the readings, then of what else there is, the shapes' priors last.
        jacobian: by the parameters, then by the shapes.
        unknown: how the readings' residuals change with unknowns of unit variance, those of the law first.
        noise: covariance of the readings' residuals, of each row by itself.
        parameters: what moves.
        of_law: how many of the unknowns are coefficients of the law's discrepancy; the others belong to the rows.
    """

    residual: Float[np.ndarray, " n"]
    jacobian: Float[np.ndarray, "n k"]
    unknown: Float[np.ndarray, "readings m"]
    noise: Float[np.ndarray, "readings readings"]
    parameters: StepParameters
    of_law: int = 0

    @cached_property
    def whitening(self) -> Float[np.ndarray, "readings readings"]:
        """The inverse of the Cholesky factor of V, the covariance of the readings with all that is left out."""
        return np.linalg.inv(np.linalg.cholesky(self.noise + self.unknown @ self.unknown.T))

    def whitened(self, columns: Float[np.ndarray, "n ..."]) -> Float[np.ndarray, "n ..."]:
        """Return columns of residuals with the readings in units in which they are independent."""
        size = len(self.noise)
        return np.concatenate([self.whitening @ columns[:size], columns[size:]])

    @cached_property
    def slope(self) -> Float[np.ndarray, "n k"]:
        """The Jacobian in units in which readings are independent."""
        return self.whitened(self.jacobian)

    @cached_property
    def covariance(self) -> Float[np.ndarray, "k k"]:
        """(J^T V^-1 J)^-1; infinite where a direction is not determined, and by itself what is at its bound."""
        free = self.parameters.free
        full = covariance_of(self.slope.T @ self.slope)
        covariance = np.zeros_like(full)
        covariance[np.ix_(free, free)] = covariance_of(self.slope[:, free].T @ self.slope[:, free])
        held = np.flatnonzero(~free)
        covariance[held, held] = full[held, held]
        return covariance

    @cached_property
    def gain(self) -> Float[np.ndarray, "m readings"]:
        """U^T V^-1: what the unknowns most likely are, but for the sign, by the residuals."""
        return (self.whitening @ self.unknown).T @ self.whitening

    def step(self, beyond: Float[np.ndarray, " readings"] | float = 0.0) -> LinearStep:
        """Return the generalised least-squares step from the fit.

        Args:
            beyond: by how much the readings' residuals at the fit are larger than they are.
        """
        size, (names, begin, ends, free) = len(self.noise), self.parameters
        residual = self.residual.copy()
        residual[:size] += beyond
        white = self.whitened(residual)
        change = bounded(white, self.slope, begin, ends, free & np.isfinite(np.diag(self.covariance)))
        left = residual + self.jacobian @ change
        likely = -self.gain @ left[:size]
        return LinearStep(
            names=names,
            values=begin + change,
            change=change,
            covariance=self.covariance,
            chi2=float(np.sum((white + self.slope @ change) ** 2)),
            residual=left[:size] + self.unknown @ likely,
            unknown=likely,
            unknown_covariance=np.eye(likely.size) - self.gain @ self.unknown,
            follow=-self.gain @ self.jacobian[:size],
        )

    def chi2(self, step: LinearStep, misfit: Float[np.ndarray, " readings"]) -> float:
        """Return chi2 of a law's readings: r^T V^-1 r, with what is known of parameters, shapes and discrepancy.

        V is the covariance of the rows: noise, errors of slow impacts, remainders of corrections.

        Args:
            step: that has led to the law.
            misfit: (predicted - measured)/error of the readings.
        """
        rest, coefficients = self.rest(step), step.unknown[: self.of_law]
        return float(misfit @ self.row_weights @ misfit + rest @ rest + coefficients @ coefficients)

    def misfit(self, step: LinearStep) -> Float[np.ndarray, " readings"]:
        """Return (predicted - measured)/error of the readings by the law after a step, to first order."""
        size = len(self.noise)
        by_law = self.unknown[:, : self.of_law] @ step.unknown[: self.of_law]
        return self.residual[:size] + self.jacobian[:size] @ step.change + by_law

    def rest(self, step: LinearStep) -> Float[np.ndarray, " n"]:
        """Return the residuals besides the readings' after a step: of rows without orbit, and of what is known."""
        size = len(self.noise)
        return self.residual[size:] + self.jacobian[size:] @ step.change

    @cached_property
    def row_weights(self) -> Float[np.ndarray, "readings readings"]:
        """The inverse of the covariance of the readings about a law: without the unknowns that belong to the law."""
        of_rows = self.unknown[:, self.of_law :]
        return np.linalg.inv(self.noise + of_rows @ of_rows.T)

    def alone(self, misfit: Float[np.ndarray, " readings"]) -> Float[np.ndarray, " readings"]:
        """Return residuals of the readings without the rows' most likely remainders."""
        return self.noise @ self.row_weights @ misfit


def system_of(rows: StepRows, discrepancy: ModelDiscrepancy, free: Bool[np.ndarray, " p"]) -> StepSystem:
    """Return the rows of a fit, linearised, with what its model leaves out.

    Args:
        rows: of the fit.
        discrepancy: by the fitted model.
        free: which of its parameters are not at their bound.
    """
    problem, priors = discrepancy.problem, discrepancy.priors
    size, names = rows.measurement_error.size, (*problem.names, *priors)
    columns = discrepancy.columns(rows.approach, rows.rebound)
    slopes = np.stack([rows.slopes.by_square, rows.slopes.by_delay])

    def amplitudes(change):
        """Return changes of the amplitudes' residuals that changes of the impacts make."""
        return np.einsum("krc,kr...->rc...", slopes, change).reshape(size, *change.shape[2:])

    known = len(problem.names)
    values = np.array([discrepancy.values[name] for name in problem.names])
    residual = rows.residual.copy()
    residual[:size] += amplitudes(columns.known)
    jacobian = np.zeros((residual.size + len(priors), len(names)))
    jacobian[: residual.size, :known] = rows.jacobian
    if "viscous_loss" in problem.names:
        jacobian[:size, problem.names.index("viscous_loss")] += amplitudes(columns.drag)
    jacobian[:size, known:] = amplitudes(columns.shape)
    jacobian[residual.size :, known:] = np.diag([1.0 / error for _, error in priors.values()])
    residual = np.append(residual, np.zeros(len(priors)))
    of_law = amplitudes(columns.unknown)
    unknown = [of_law]
    if problem.lasting:
        parts = rows.approach, rows.rebound, rows.pull, rows.change, rows.hertz_time
        unknown.append(amplitudes(remainders(*parts, tapping=problem.tapping)))
    parameters = StepParameters(
        names=names,
        values=np.append(values, [mean for mean, _ in priors.values()]),
        ends=np.array([(p.lowest, p.highest) for p in map(parameter_called, names)]),
        free=np.append(free, np.ones(len(priors), dtype=bool)),
    )
    return StepSystem(residual, jacobian, np.concatenate(unknown, axis=1), _noise(rows), parameters, of_law.shape[1])


def _noise(rows: StepRows) -> Float[np.ndarray, "n n"]:
    """Return the covariance of the readings' residuals: measured errors, and what slow impacts lack.

    Noise of a lock-in is as large along the measured phasor as across it, and independent: errors of amplitude and
    phase are not correlated. What slow impacts lack is common to peak and lock-in, and to the phase its own.
    """
    count, kinds = rows.measurement_error.shape
    shares = np.eye(kinds)
    shares[:2, :2] = 0.5 * (_TOGETHER + _APART * np.array([[1.0, -1.0], [-1.0, 1.0]]))
    of_row = shares * rows.slow_error[:, :, None] * rows.slow_error[:, None, :]
    of_row += np.eye(kinds) * rows.measurement_error[:, None, :] ** 2
    variance = np.zeros((count, kinds, count, kinds))
    one = np.arange(count)
    variance[one, :, one, :] = of_row
    return variance.reshape(count * kinds, count * kinds)


def bounded(
    residual: Float[np.ndarray, " n"],
    slope: Float[np.ndarray, "n k"],
    begin: Float[np.ndarray, " k"],
    ends: Float[np.ndarray, "k 2"],
    moving: Bool[np.ndarray, " k"],
) -> Float[np.ndarray, " k"]:
    """Return the least-squares step between bounds: what would leave its range is held at the end.

    Args:
        residual: whose sum of squares is to become smallest.
        slope: its derivatives.
        begin: values at which the step begins.
        ends: lowest and highest value of each.
        moving: which of the values change.
    """
    change = np.zeros_like(begin)
    moving = moving.copy()
    for _ in range(begin.size):
        held = residual + slope[:, ~moving] @ change[~moving]
        change[moving] = np.linalg.lstsq(slope[:, moving], -held, rcond=None)[0]
        out = moving & ((begin + change < ends[:, 0]) | (begin + change > ends[:, 1]))
        if not out.any():
            break
        change[out] = np.clip(begin + change, ends[:, 0], ends[:, 1])[out] - begin[out]
        moving &= ~out
    return change


def longest_run(rows: StepRows, system: StepSystem) -> float:
    """Return by how many standard deviations residuals run together over the approach speed, at the worst place.

    A bump of the loss, or of the path that the delay stands for, is fitted at every speed beside everything else: what
    counts is its size over its standard error (the score statistic). Of 20 honest tables 19 stay below 3.

    Args:
        rows: of the fit.
        system: of these, with what the model leaves out.
    """
    seen = np.any(rows.slopes.by_square != 0.0, axis=1) | np.any(rows.slopes.by_delay != 0.0, axis=1)
    if not seen.any():
        return 0.0
    place = np.log(rows.approach)
    middles = np.arange(place[seen].min(), place[seen].max() + _RUN_STEP, _RUN_STEP)
    bumps = np.exp(-0.5 * ((place[:, None] - middles) / _RUN) ** 2)
    by_square = rows.slopes.by_square[:, :, None] * (bumps * (rows.approach**2 - rows.rebound**2)[:, None])[:, None]
    by_delay = rows.slopes.by_delay[:, :, None] * (bumps / rows.approach[:, None])[:, None]
    tried = np.concatenate([by_square, by_delay], axis=2).reshape(len(system.noise), -1)
    known = system.slope[:, system.parameters.free]

    def beside(columns: np.ndarray) -> np.ndarray:
        return columns - known @ np.linalg.lstsq(known, columns, rcond=None)[0]

    residual = beside(system.whitened(system.residual))
    bump = system.whitened(np.pad(tried, ((0, residual.size - len(tried)), (0, 0))))
    apart = beside(bump)
    before, after = np.linalg.norm(bump, axis=0), np.linalg.norm(apart, axis=0)
    told = after > 1e-6 * np.maximum(before, 1e-300)
    return float(np.max(np.abs(apart.T @ residual)[told] / after[told], initial=0.0))


_STEP_PARTS = (1.0, 0.0), (0.5, 0.25), (0.125, 0.0625)
PARTS_AT_ONCE = 2
"""Parts of a step that are looked at, and how many of them at a time."""
_NOTHING = 1e-3
"""What a step takes off chi2 at least, to first order, for it to count."""
Predictor = Callable[[list[LinearStep]], Predicted]
"""What the laws after some steps predict."""


class Descended(NamedTuple):
    """The part of a step that lowers chi2, and what the law after it predicts.

    ``stuck``: chi2 that no part lowers, and what the whole step takes it to to first order; None: one does, or there is
    nothing to gain.
    """

    step: LinearStep
    predicted: Predicted
    stuck: tuple[float, float] | None


def descending_part(system: StepSystem, predicted: Predictor) -> Descended:
    """Return the first of a whole step, its half, its quarter... that lowers chi2, computed; else none of it.

    Args:
        system: of the fit.
        predicted: what the laws after two parts of the step predict.
    """
    step, begin, stay = system.step(), np.inf, None
    for shares in _STEP_PARTS:
        looked, chi2 = _computed([step.partly(share) for share in shares], system, predicted)
        if stay is None:
            begin, stay = chi2.pop(), looked.pop()
        for one, here in zip(looked, chi2, strict=True):
            if here < begin:
                return one
    assert stay is not None  # noqa: S101
    return stay._replace(stuck=(begin, step.chi2) if begin - step.chi2 > _NOTHING else None)


def _computed(steps: list[LinearStep], system: StepSystem, predicted: Predictor) -> tuple[list[Descended], list[float]]:
    """Return the laws after steps with what they predict, and chi2 of each."""
    found = predicted(steps)
    looked = [
        Descended(one, jax.tree.map(lambda leaf, i=i: leaf[i : i + 1], found), None) for i, one in enumerate(steps)
    ]
    return looked, [system.chi2(one.step, one.predicted.misfit.ravel()) for one in looked]


_ROUNDS = 6
"""Steps at most that follow the first one."""
_SETTLED = 1e-2
"""Fall of chi2 from which another one is taken."""


def settled_step(begun: Descended, system: StepSystem, predicted: Predictor) -> Descended:
    """Return the step taken again and again, by the slopes at the fit, with what readings do beyond first order.

    Where the fitted law is far off for slow impacts, readings are not linear in it: one step leaves the law off by some
    of its errors there, too slow on the average. Each further step starts at the fit too, with the readings as computed
    after the last one in place of their linearisation: Newton's method with slopes kept (a chord), which ends at the
    law that explains the computed readings. It stops when chi2 falls no more.

    Args:
        begun: the part of the first step that lowers chi2.
        system: of the fit.
        predicted: what the laws after two steps predict.
    """
    best, chi2 = begun, system.chi2(begun.step, begun.predicted.misfit.ravel())
    for _ in range(_ROUNDS):
        whole = system.step(best.predicted.misfit.ravel() - system.misfit(best.step))
        looked, each = _computed([whole, whole.towards(best.step)], system, predicted)
        lowest = int(np.argmin(each))
        fall = chi2 - each[lowest]
        if not fall > 0.0:
            break
        best, chi2 = looked[lowest], each[lowest]
        if fall < _SETTLED:
            break
    return best
