"""The minimum of chi2: screened, polished from the best starts, and again where the errors are only relative."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from fitting.optimise import BATCH, PLAIN, SOFT, Objective, grid, polish

_ROUGH, _FINE = 1e-2, 1e-10
"""Estimated distances to the minimum at which the soft and the plain polish stop."""


@dataclass(frozen=True)
class Minimum:
    """The best of several polished starts.

    Attributes:
        coordinates: of the best one, shape (p,).
        start: the grid point it came from, parameter values, shape (p,).
        ends: where every start ended, parameter values, shape (starts, p).
        chi2: there, shape (starts,).
    """

    coordinates: Float[np.ndarray, " p"]
    start: Float[np.ndarray, " p"]
    ends: Float[np.ndarray, "starts p"]
    chi2: Float[np.ndarray, " starts"]


def minimise(objective: Objective) -> Minimum:
    """Screen a grid, polish the best points with outliers counting less, then plainly."""
    points = grid(objective.problem, objective.measurement)
    best = np.argsort(objective.screen(points), kind="stable")[:BATCH]
    soft = polish(objective, objective.problem.coordinates(points[best]), SOFT, settled=_ROUGH)
    return _polished(objective, soft.coordinates, points[best])


def rescale_errors(objective: Objective, minimum: Minimum, parameters: int) -> tuple[Objective, Minimum, float]:
    """Scale the amplitudes' errors until their chi2 equals its degrees of freedom; the constraint on Q stays.

    Args:
        objective: with the errors as given.
        minimum: of it.
        parameters: how many parameters the amplitudes determine.

    Returns:
        The objective with scaled errors, its minimum, and the factor.

    Raises:
        ValueError: if there are no degrees of freedom to take the scale from.
    """
    rows = objective.measurement.rows
    freedom = int(np.asarray(rows.measured).sum()) - parameters
    if freedom < 1:
        raise ValueError("scaling the errors needs more amplitudes than parameters; give their errors instead")
    total = 1.0
    # The constraint on Q makes the minimum depend on the scale a little: three rounds settle it.
    for _ in range(3):
        residual = objective.residual(objective.problem.values(minimum.coordinates)[None])[0, :-1]
        factor = float(np.sqrt(np.sum(residual**2) / freedom))
        if factor == 0.0:
            break
        total *= factor
        scaled = objective.measurement.rows._replace(error_nm=objective.measurement.rows.error_nm * factor)
        objective = Objective(objective.measurement._replace(rows=scaled), objective.problem)
        minimum = _polished(objective, objective.problem.coordinates(minimum.ends), minimum.start)
    return objective, minimum, total


def _polished(
    objective: Objective, starts: Float[np.ndarray, "starts p"], origins: Float[np.ndarray, "..."]
) -> Minimum:
    """Polish plainly and keep the best; `origins` are the starts' grid points, or the one that is already known."""
    final = polish(objective, starts, PLAIN, settled=_FINE)
    winner = int(np.argmin(final.objective))
    start = origins if origins.ndim == 1 else origins[winner]
    return Minimum(final.coordinates[winner], start, objective.problem.values(final.coordinates), final.objective)
