"""The objective of a finished fit, rebuilt from its result: what bootstrap and posterior start from."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from afm_jax.contact.contact import EFFECTS
from afm_jax.parameters import require_float64
from fitting.checks import at_bound, covariance
from fitting.measurement import ROWS_PER_PROGRAM, measurement_of
from fitting.models import Problem
from fitting.optimise import Objective
from fitting.result import FitResult


class Refit(NamedTuple):
    """An objective with the orbits followed from a fit's values, and those values in the problem's order."""

    objective: Objective
    values: Float[np.ndarray, " p"]


def objective_of(result: FitResult) -> Refit:
    """Return the objective that a fit ended with: its rows, errors, constraints, effects and loss.

    Rows that were set aside stay so, and errors contain the model's error and the scale that the fit gave them.

    Args:
        result: from `fitting.fit`.

    Raises:
        RuntimeError: if JAX is not set to 64-bit floats.
    """
    require_float64()
    settings = result.settings
    effects = EFFECTS if settings["effects"] is None else tuple(settings["effects"])
    problem = Problem(result.model, tuple(result.parameters), effects)
    measurement = measurement_of(result.table, problem, settings["constraints"], settings["fixed"])
    values = np.array([parameter.value for parameter in result.parameters.values()])
    stated = Objective(measurement, problem, robust=settings["robust"] is not None)
    size = np.asarray(measurement.rows.order).shape[0]
    error = np.full((size, 2), np.nan)
    error[: result.table.rows] = result.rows.error_nm
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
    telling = np.flatnonzero(np.asarray(rows.measured).any(axis=1) | np.asarray(rows.no_orbit))
    size = max(-(-telling.size // ROWS_PER_PROGRAM), 1) * ROWS_PER_PROGRAM
    if size == np.asarray(rows.order).shape[0]:
        return refit
    # the rest of the new size is filled with rows that say nothing either
    silent = np.setdiff1d(np.arange(np.asarray(rows.order).shape[0]), telling)
    chosen = np.concatenate([telling, silent[: size - telling.size]])
    return Refit(objective.of_rows(chosen), refit.values)


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
