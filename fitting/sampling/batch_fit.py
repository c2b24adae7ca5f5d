"""Many synthetic data sets of one table fitted at once: what bootstrap and coverage are made of.

A data set enters the residuals only as a shift: (predicted - measured_k)/error = (predicted - measured)/error +
(measured - measured_k)/error. One compiled program therefore serves all of them, and since every fit starts at the same
values, the first linearisation serves all of them too.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from fitting.fisher import whole_covariance_of
from fitting.least_squares import Box, Searches, descended, distance
from fitting.optimise import PLAIN, ROBUST, Objective, soft_square
from fitting.sampling.refit import Refit

_STEPS = 40
_SETTLED = 1e-6
"""Estimated distance of chi2 to its minimum at which a data set is done: values within a thousandth of an error."""


class DataSets(NamedTuple):
    """Amplitudes of shape (sets, rows, 2), and the measured values of the constrained parameters, shape (sets, p)."""

    amplitude_nm: Float[np.ndarray, "sets rows 2"]
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
    objective, sets = refit.objective, data.amplitude_nm.shape[0]
    shift = _shifts(objective, data)
    start = np.broadcast_to(refit.values, (1, refit.values.size))
    one = _plain(objective).at_values(start)
    shared = np.broadcast_to(np.asarray(one.residual), shift.shape), np.asarray(one.jacobian)
    start = _searches(objective, np.repeat(start, sets, axis=0), shared[0] + shift, np.repeat(shared[1], sets, 0))

    def look(values: Float[np.ndarray, "some p"], some: Int[np.ndarray, " some"]) -> Searches:
        found = _plain(objective).at_values(values)
        return _searches(objective, values, np.asarray(found.residual) + shift[some], np.asarray(found.jacobian))

    parameters = objective.problem.parameters
    box = Box(
        np.array([p.lowest for p in parameters]),
        np.array([p.highest for p in parameters]),
        np.zeros((sets, len(parameters)), dtype=bool),
    )
    end = descended(look, start, box, settled=_SETTLED, most=_STEPS)
    normal = np.einsum("snp,snq->spq", end.jacobian, end.jacobian)
    return BatchFit(end.place, end.chi2, whole_covariance_of(normal), distance(end, box) <= _SETTLED)


def _shifts(objective: Objective, data: DataSets) -> Float[np.ndarray, "sets n"]:
    """Return what each data set adds to the residuals of the table itself."""
    rows, known = objective.measurement.rows, objective.measurement
    weight = np.where(np.asarray(rows.measured), 1.0 / np.asarray(rows.error_nm), 0.0)
    amplitudes = weight * (np.asarray(rows.amplitude_nm) - data.amplitude_nm)
    constraints = (np.asarray(known.constraint_value) - data.constraint_value) / np.asarray(known.constraint_error)
    sets, count = amplitudes.shape[:2]
    return np.concatenate([amplitudes.reshape(sets, -1), np.zeros((sets, count)), constraints], axis=1)


def _plain(objective: Objective) -> Objective:
    """Return the objective without its soft loss, which is applied after the shift."""
    return Objective(objective.measurement, objective.problem, near=objective.near)


def _searches(objective: Objective, values, residual, jacobian) -> Searches:
    """Return the searches with the loss applied: residuals whose squares add up to it."""
    square = soft_square(residual, ROBUST if objective.robust else PLAIN)
    if objective.robust:
        soft = np.copysign(np.sqrt(square), residual)
        safe = np.where(residual == 0.0, 1.0, soft)
        root = np.sqrt(1.0 + (residual / ROBUST) ** 2)
        slope = np.where(residual == 0.0, 1.0, residual / (root * safe))
        residual, jacobian = soft, jacobian * slope[:, :, None]
    return Searches(values, residual, jacobian, square.sum(axis=1))
