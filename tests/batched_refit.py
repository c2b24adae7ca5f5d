"""Many synthetic tables of one fit, fitted at once, and densities of its posterior: for studies of coverage and ranks.

A data set enters the residuals only as a shift: (predicted - measured_k)/error = (predicted - measured)/error +
(measured - measured_k)/error. One compiled program therefore serves all of them, and since every fit starts at the same
values, the first linearisation serves all of them too.
"""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.special import kve
from scipy.stats import genhyperbolic

from afm_jax.least_squares import Box, Searches, descended, distance, whole_covariance_of
from fitting.fits.objective import PLAIN, ROBUST, Objective, soft_square, softened
from fitting.infer.result import FitResult
from fitting.sampling.posterior_result import Posterior
from fitting.sampling.refit import Refit, objective_of, telling_rows

DRAWS = 250
"""Draws of each chain that are taken, evenly spaced."""
_STEPS = 40
_SETTLED = 1e-6
"""Estimated distance of chi2 to its minimum at which a data set is done: values within a thousandth of an error."""


class DataSets(NamedTuple):
    """Readings of shape (sets, rows, k), and the measured values of the constrained parameters, shape (sets, p)."""

    amplitude_nm: Float[np.ndarray, "sets rows k"]
    constraint_value: Float[np.ndarray, "sets p"]


class BatchFit(NamedTuple):
    """The fits of several data sets.

    Attributes:
        values: of the parameters.
        chi2: there; with a robust loss the soft sum.
        covariance: Fisher's, infinite where a direction is not determined.
        converged: the estimated distance to the minimum is small.
    """

    values: Float[np.ndarray, "sets p"]
    chi2: Float[np.ndarray, " sets"]
    covariance: Float[np.ndarray, "sets p p"]
    converged: Bool[np.ndarray, " sets"]


def draw_data(refit: Refit, sets: int, random: np.random.Generator) -> DataSets:
    """Return data sets as they would have been measured if the fitted values were the truth.

    Amplitudes scatter about the fitted ones by the rows' errors, and constraints, which are measurements as well, about
    the fitted parameters by theirs.

    Args:
        refit: the fit, from `fitting.sampling.refit.objective_of`.
        sets: how many.
        random: the generator that is drawn from.
    """
    objective, values = refit
    rows, constraint = objective.measurement.rows, objective.measurement.constraint_error
    predicted = np.asarray(objective.at_values(values[None]).prediction.amplitude_nm)[0]
    errors = np.where(np.asarray(rows.measured), np.asarray(rows.error_nm), 0.0)
    known = np.where(np.isfinite(np.asarray(constraint)), np.asarray(constraint), 0.0)
    return DataSets(
        amplitude_nm=predicted + errors * random.normal(size=(sets, *errors.shape)),
        constraint_value=values + known * random.normal(size=(sets, known.size)),
    )


def fit_data_sets(refit: Refit, data: DataSets) -> BatchFit:
    """Fit every data set by damped Gauss-Newton steps (Levenberg, Marquardt) from the fit's values.

    Args:
        refit: the fit that the data sets resemble; its orbits are followed.
        data: from `draw_data`.

    Returns:
        The fits. A parameter at an end of its range is held there while chi2 falls towards the outside.
    """
    objective, sets = refit.objective, len(data.amplitude_nm)
    shift = shifts(objective, data)
    start = np.broadcast_to(refit.values, (1, refit.values.size))
    one = plain(objective).at_values(start)
    residual = np.asarray(one.residual) + shift
    jacobian = np.repeat(np.asarray(one.jacobian), sets, axis=0)
    start = _searches(objective, np.repeat(start, sets, axis=0), residual, jacobian)

    def look(values: Float[np.ndarray, "some p"], some: Int[np.ndarray, " some"]) -> Searches:
        found = plain(objective).at_values(values)
        return _searches(objective, values, np.asarray(found.residual) + shift[some], np.asarray(found.jacobian))

    lowest, highest = objective.problem.ends
    box = Box(lowest, highest, np.zeros((sets, refit.values.size), dtype=bool))
    end = descended(look, start, box, settled=_SETTLED, most=_STEPS)
    normal = np.einsum("snp,snq->spq", end.jacobian, end.jacobian)
    return BatchFit(end.place, end.chi2, whole_covariance_of(normal), distance(end, box) <= _SETTLED)


def shifts(objective: Objective, data: DataSets) -> Float[np.ndarray, "sets n"]:
    """Return what each data set adds to the residuals of the table itself."""
    rows, known = objective.measurement.rows, objective.measurement
    weight = np.where(np.asarray(rows.measured), 1.0 / np.asarray(rows.error_nm), 0.0)
    amplitudes = weight * (np.asarray(rows.amplitude_nm) - data.amplitude_nm)
    constraints = (np.asarray(known.constraint_value) - data.constraint_value) / np.asarray(known.constraint_error)
    sets, count = amplitudes.shape[:2]
    return np.concatenate([amplitudes.reshape(sets, -1), np.zeros((sets, count)), constraints], axis=1)


def plain(objective: Objective) -> Objective:
    """Return the objective without its soft loss, which is applied after the shift."""
    return Objective(objective.measurement, objective.problem, near=objective.near)


def _searches(objective: Objective, values, residual, jacobian) -> Searches:
    """Return the searches with the loss applied: residuals whose squares add up to it."""
    if objective.robust:
        residual, slope = softened(residual)
        jacobian = jacobian * slope[:, :, None]
    return Searches(values, residual, jacobian, np.sum(residual**2, axis=1))


@dataclass(frozen=True, eq=False)
class PosteriorDraws:
    """Draws of a posterior and what they predict for the rows that say something.

    Attributes:
        names: of the parameters, nuisances included.
        rows: places of these rows in the table.
        measured: what was read there: peak, lock-in amplitude and, if the table has one, the phase; NaN: not used.
        error: of the readings, with the model's.
        values: of the parameters.
        log_density: logarithm of the posterior's density but for a constant, of shape (chains, draws).
        predicted: readings without noise.
        replicated: readings with noise, as another experiment would give them.
        log_likelihood: of each row's readings together.
    """

    names: tuple[str, ...]
    rows: Int[np.ndarray, " rows"]
    measured: Float[np.ndarray, "rows k"]
    error: Float[np.ndarray, "rows k"]
    values: Float[np.ndarray, "chains draws p"]
    log_density: Float[np.ndarray, "chains draws"]
    predicted: Float[np.ndarray, "chains draws rows k"]
    replicated: Float[np.ndarray, "chains draws rows k"]
    log_likelihood: Float[np.ndarray, "chains draws rows"]


def posterior_draws(result: FitResult, found: Posterior, *, seed: int = 0) -> PosteriorDraws:
    """Return draws of a fit's posterior, `DRAWS` of each chain at most, and what they predict.

    Args:
        result: from `fitting.fit`.
        found: its posterior, from `fitting.posterior`.
        seed: of the replicated noise.
    """
    refit, rows = refit_of_rows(result)
    step = max(found.chains.samples.shape[1] // DRAWS, 1)
    values = found.chains.samples[:, ::step]
    dense = densities(refit.objective, values.reshape(-1, values.shape[2]))
    noise = noise_of(refit.objective, len(dense.predicted), np.random.default_rng(seed))
    used = np.asarray(refit.objective.measurement.rows.measured)

    def in_chains(column):
        return column.reshape(*values.shape[:2], *column.shape[1:])

    return PosteriorDraws(
        names=refit.objective.problem.names,
        rows=rows,
        measured=np.where(used, np.asarray(refit.objective.measurement.rows.amplitude_nm), np.nan),
        error=np.where(used, np.asarray(refit.objective.measurement.rows.error_nm), np.nan),
        values=values,
        log_density=in_chains(dense.log_density),
        predicted=in_chains(dense.predicted),
        replicated=in_chains(dense.predicted + noise),
        log_likelihood=in_chains(dense.log_likelihood),
    )


def refit_of_rows(result: FitResult) -> tuple[Refit, Int[np.ndarray, " rows"]]:
    """Return the fit's objective with the rows that say something alone, and their places in the table."""
    refit = objective_of(result)
    rows = telling_rows(refit.objective)
    return Refit(refit.objective.of_rows(rows), refit.values), rows


class Densities(NamedTuple):
    """What sets of values predict, and how likely: logarithms of the rows' likelihoods and the posterior's density."""

    predicted: Float[np.ndarray, "sets rows k"]
    log_likelihood: Float[np.ndarray, "sets rows"]
    log_density: Float[np.ndarray, " sets"]


def densities(
    objective: Objective,
    values: Float[np.ndarray, "sets p"],
    shift: Float[np.ndarray, "... n"] | float = 0.0,
) -> Densities:
    """Return what sets of values predict and how likely that makes the readings.

    With a robust loss errors have the distribution that this loss stands for, the symmetric hyperbolic one.

    Args:
        objective: of the rows.
        values: of the parameters, within their ranges.
        shift: what other readings add to the residuals, of all sets or of each.
    """
    prediction = plain(objective).at_values(values)
    rows, predicted = objective.measurement.rows, np.asarray(prediction.prediction.amplitude_nm)
    residual = np.asarray(prediction.residual) + shift
    half = 0.5 * soft_square(residual, ROBUST if objective.robust else PLAIN)
    readings, unseen = predicted[0].size, predicted.shape[1]
    weight = 2.0 * ROBUST * kve(1, ROBUST**2) if objective.robust else np.sqrt(2.0 * np.pi)
    norm = np.where(np.asarray(rows.measured), np.log(weight * np.asarray(rows.error_nm)), 0.0)
    each = -half[:, :readings].reshape(predicted.shape) - norm
    return Densities(
        predicted=predicted,
        log_likelihood=each.sum(axis=2) - half[:, readings : readings + unseen],
        log_density=-half.sum(axis=1),
    )


def noise_of(objective: Objective, sets: int, random: np.random.Generator) -> Float[np.ndarray, "sets rows k"]:
    """Return noise of readings, 0 where nothing was read."""
    rows = objective.measurement.rows
    used: Bool[np.ndarray, "rows k"] = np.asarray(rows.measured)
    shape: Any = (sets, *used.shape)
    standard = random.normal(size=shape)
    if objective.robust:
        # e^(-s^2 sqrt(1 + x^2/s^2)), with s the softness
        standard = genhyperbolic(1.0, ROBUST**2, 0.0, scale=ROBUST).rvs(size=shape, random_state=random)
    return np.where(used, np.asarray(rows.error_nm), 0.0) * standard
