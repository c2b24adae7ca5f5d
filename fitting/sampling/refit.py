"""The objective that a fit ended with, rebuilt from its result: what samplers of a posterior start from."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from afm_jax.checks import require_float64
from afm_jax.contact.parameters import EFFECTS
from fitting.infer.intervals import at_bound, covariance
from fitting.infer.rows import Objective
from fitting.infer.result import FitResult
from fitting.models import ROWS_PER_PROGRAM, Problem, measurement_of
from fitting.tables.several import SeveralTables


class Refit(NamedTuple):
    """An objective with the orbits followed from a fit's values, and those values in the problem's order."""

    objective: Objective
    values: Float[np.ndarray, " p"]


def objective_of(result: FitResult) -> Refit:
    """Return the objective that a fit ended with: its rows, errors, constraints, effects and loss.

    Excluded rows stay excluded, and errors contain the model's error and the scale that the fit gave them.

    Args:
        result: from `fitting.fit`.

    Raises:
        ValueError: if the fit is of several tables.
        RuntimeError: if JAX is not set to 64-bit floats.
    """
    require_float64()
    if isinstance(result.table, SeveralTables):
        raise ValueError(  # noqa: TRY004 (a fit of several tables is no wrong type)
            "a posterior is about one table; the intervals of a joint fit are its own"
        )
    settings = result.settings
    effects = EFFECTS if settings["effects"] is None else tuple(settings["effects"])
    names = tuple(result.parameters)
    problem = Problem(result.model, names, effects, result.table.drive)
    measurement = measurement_of(result.table, problem, settings["constraints"], settings["fixed"])
    values = np.array([result.parameters[name].value for name in names])
    stated = Objective(measurement, problem, robust=settings["robust"] is not None)
    size = np.asarray(measurement.rows.order).shape[0]
    error = np.full(np.asarray(measurement.rows.error_nm).shape, np.nan)
    error[: result.table.rows, :2] = result.rows.error_nm
    if result.rows.phase_error_deg is not None:
        error[: result.table.rows, 2] = result.rows.phase_error_deg
    used = np.isfinite(error)
    objective = stated.with_rows(error_nm=np.where(used, error, 1.0), measured=used)
    if result.model != "contact":
        return Refit(objective.following(values), values)
    # a contact's orbits are named by their approach speed, which the fit has noted: no need to search for them
    near = np.full(size, np.nan)
    near[: result.table.rows] = result.rows.approach_speed_nm_per_us
    return Refit(Objective(objective.measurement, problem, near=near, robust=objective.robust), values)


def compact(refit: Refit) -> Refit:
    """Return a refit without the rows that say nothing, padded anew: many fits of it take less time.

    Args:
        refit: from `objective_of`.
    """
    objective = refit.objective
    rows = objective.measurement.rows
    telling = telling_rows(objective)
    size = max(-(-telling.size // ROWS_PER_PROGRAM), 1) * ROWS_PER_PROGRAM
    if size == np.asarray(rows.order).shape[0]:
        return refit
    # the rest of the new size is filled with rows that say nothing either
    silent = np.setdiff1d(np.arange(np.asarray(rows.order).shape[0]), telling)
    chosen = np.concatenate([telling, silent[: size - telling.size]])
    return Refit(objective.of_rows(chosen), refit.values)


def telling_rows(objective: Objective) -> Int[np.ndarray, " telling"]:
    """Return the places of the rows that say something."""
    rows = objective.measurement.rows
    return np.flatnonzero(np.asarray(rows.measured).any(axis=1) | np.asarray(rows.no_orbit))


def standard_covariance(refit: Refit) -> Float[np.ndarray, "p p"]:
    """Return the Fisher covariance at a fit's values.

    Args:
        refit: from `objective_of`.

    Raises:
        ValueError: if the data do not determine every parameter.
    """
    matrix = covariance(refit.objective, refit.values, ~at_bound(refit.objective, refit.values))
    adrift = [
        name
        for name, own in zip(refit.objective.problem.names, np.diag(matrix), strict=True)
        if not (np.isfinite(own) and own > 0.0)
    ]
    if adrift:
        raise ValueError(
            f"the data do not determine {', '.join(adrift)}: there is no size of steps to start from; fit a model with "
            "fewer parameters, or constrain these"
        )
    return matrix


def require_valid(result: FitResult) -> None:
    """Refuse a fit that is not valid: synthetic data of a wrong law say nothing of the errors.

    Raises:
        ValueError: if so, with the fit's reason.
    """
    if not result.valid:
        raise ValueError(f"the fit of the model {result.model!r} is not valid ({result.reasons[0]}); mend it first")
