"""Many synthetic data sets of one table fitted at once: what bootstrap and coverage are made of.

A data set enters the residuals only as a shift: (predicted - measured_k)/error = (predicted - measured)/error +
(measured - measured_k)/error. One compiled program therefore serves all of them, and since every fit starts at the same
values, the first linearisation serves all of them too.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from fitting.optimise import PLAIN, ROBUST, Objective, soft_square
from fitting.sampling.refit import Refit

_STEPS = 40
_SETTLED = 1e-6
"""Estimated distance of chi2 to its minimum at which a data set is done: values within a thousandth of an error."""
_FIRST_DAMPING = 1e-6
_LARGEST_DAMPING = 1e8


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


class _State(NamedTuple):
    """Where the fits are: values, residuals of their own data, the Jacobian by the values, and chi2."""

    values: Float[np.ndarray, "sets p"]
    residual: Float[np.ndarray, "sets n"]
    jacobian: Float[np.ndarray, "sets n p"]
    chi2: Float[np.ndarray, " sets"]


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
    sets = data.amplitude_nm.shape[0]
    shift = _shifts(refit.objective, data)
    start = np.broadcast_to(refit.values, (1, refit.values.size))
    one = _plain(refit.objective).at_values(start)
    shared = np.broadcast_to(np.asarray(one.residual), shift.shape), np.asarray(one.jacobian)
    state = _state(refit.objective, np.repeat(start, sets, axis=0), shared[0] + shift, np.repeat(shared[1], sets, 0))
    damping = np.full(sets, _FIRST_DAMPING)
    for _ in range(_STEPS):
        active = np.flatnonzero((_distance(refit.objective, state) > _SETTLED) & (damping < _LARGEST_DAMPING))
        if not active.size:
            break
        some = _State(*(leaf[active] for leaf in state))
        trial = some.values + _step(refit.objective, some, damping[active])
        found = _evaluate(refit.objective, _inside(refit.objective, trial), shift[active])
        better = found.chi2 <= some.chi2
        for leaf, new in zip(state, found, strict=True):
            leaf[active[better]] = new[better]
        damping[active] = np.where(better, 0.1 * damping[active], np.maximum(30.0 * damping[active], 1e-3))
    normal = np.einsum("snp,snq->spq", state.jacobian, state.jacobian)
    return BatchFit(state.values, state.chi2, _inverse(normal), _distance(refit.objective, state) <= _SETTLED)


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


def _evaluate(objective: Objective, values: Float[np.ndarray, "sets p"], shift: Float[np.ndarray, "sets n"]) -> _State:
    found = _plain(objective).at_values(values)
    return _state(objective, values, np.asarray(found.residual) + shift, np.asarray(found.jacobian))


def _state(objective: Objective, values, residual, jacobian) -> _State:
    """Return the state with the loss applied: residuals whose squares add up to it."""
    square = soft_square(residual, ROBUST if objective.robust else PLAIN)
    if objective.robust:
        soft = np.copysign(np.sqrt(square), residual)
        safe = np.where(residual == 0.0, 1.0, soft)
        root = np.sqrt(1.0 + (residual / ROBUST) ** 2)
        slope = np.where(residual == 0.0, 1.0, residual / (root * safe))
        residual, jacobian = soft, jacobian * slope[:, :, None]
    return _State(np.array(values), np.array(residual), np.array(jacobian), square.sum(axis=1))


def _inside(objective: Objective, values: Float[np.ndarray, "sets p"]) -> Float[np.ndarray, "sets p"]:
    parameters = objective.problem.parameters
    return np.clip(values, [p.lowest for p in parameters], [p.highest for p in parameters])


def _held(objective: Objective, state: _State) -> Bool[np.ndarray, "sets p"]:
    """Say which parameters sit at an end of their range while chi2 falls towards the outside, or change nothing."""
    parameters = objective.problem.parameters
    slope = np.einsum("snp,sn->sp", state.jacobian, state.residual)
    low = (state.values <= np.array([p.lowest for p in parameters])) & (slope > 0.0)
    high = (state.values >= np.array([p.highest for p in parameters])) & (slope < 0.0)
    return low | high | ~np.any(state.jacobian, axis=1)


def _step(objective: Objective, state: _State, damping: Float[np.ndarray, " sets"]) -> Float[np.ndarray, "sets p"]:
    """Return damped Gauss-Newton steps, in units in which every parameter has the curvature 1."""
    held = _held(objective, state)
    jacobian = state.jacobian * ~held[:, None, :]
    scale = np.linalg.norm(jacobian, axis=1)
    unit = np.where(held, 1.0, scale)
    scaled = jacobian / unit[:, None, :]
    normal = np.einsum("snp,snq->spq", scaled, scaled)
    # a held parameter's own curvature is 1 instead of 0: its step is then 0
    normal += (damping[:, None] + held)[:, :, None] * np.eye(unit.shape[1])
    gradient = np.einsum("snp,sn->sp", scaled, state.residual)
    return -np.linalg.solve(normal, gradient[:, :, None])[:, :, 0] / unit


def _distance(objective: Objective, state: _State) -> Float[np.ndarray, " sets"]:
    """Return the estimated distance of chi2 to its minimum, g H^-1 g, H = J^T J."""
    gradient = np.einsum("snp,sn->sp", state.jacobian, state.residual) * ~_held(objective, state)
    step = _step(objective, state, np.full(len(state.chi2), 1e-12))
    return -np.einsum("sp,sp->s", gradient, step)


def _inverse(normal: Float[np.ndarray, "sets p p"]) -> Float[np.ndarray, "sets p p"]:
    """Return the inverse of Fisher matrices; infinite where one is singular."""
    scale = np.sqrt(np.einsum("spp->sp", normal))
    unit = np.where(scale > 0.0, scale, 1.0)
    outer = unit[:, :, None] * unit[:, None, :]
    scaled = normal / outer
    finite = np.all(np.isfinite(scaled), axis=(1, 2))
    safe = np.where(finite[:, None, None], scaled, np.eye(scaled.shape[1]))
    regular = np.logical_and(finite, np.linalg.eigvalsh(safe)[:, 0] > 1e-12)
    safe = np.where(regular[:, None, None], scaled, np.eye(scaled.shape[1]))
    return np.where(regular[:, None, None], np.linalg.inv(safe) / outer, np.inf)
