"""The minimum of chi2: screened, polished from the best starts, and again where the errors are only relative."""

from dataclasses import dataclass, replace

import jax
import numpy as np
from jaxtyping import Float

from fitting.lost_rows import lost_rows, recovered
from fitting.measurement import ROWS_PER_PROGRAM
from fitting.optimise import BATCH, FINE, PLAIN, ROUGH, SOFT, Objective, lowest, polish
from fitting.starts import starts

_ROUNDS = 4
_STEPS_PER_SEARCH = 15


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
    """Screen starts, polish the best ones with outliers counting less, then plainly.

    With impacts that last the search for orbits is what costs: the screening and the first polish look at a part of the
    rows, the rest follows orbits once they are known.
    """
    points = starts(objective.problem, objective.measurement)
    scout = _thinned(objective) if objective.problem.lasting else objective
    best = np.argsort(scout.screen(points), kind="stable")[:BATCH]
    first = objective.problem.coordinates(points[best])
    if not objective.problem.lasting:
        return _polished(objective, polish(scout, first, SOFT, settled=ROUGH).coordinates, points[best])
    found = settle(objective, _whole(objective, _scouted(scout, first), points[best]))
    lost = lost_rows(objective, objective.problem.values(found.coordinates))
    back = recovered(objective, found.coordinates, lost) if lost.any() else None
    if back is None:
        return found
    other = settle(objective, replace(found, coordinates=back))
    return other if other.chi2[0] < found.chi2[0] else found


def _scouted(scout: Objective, coordinates: Float[np.ndarray, "starts p"]) -> Float[np.ndarray, "starts p"]:
    """Polish every start softly: orbits are followed, and searched for again now and then, for they come and go."""
    for _ in range(_ROUNDS):
        follower = scout.following_each(scout.problem.values(coordinates))
        end = polish(follower, coordinates, SOFT, settled=ROUGH, most=_STEPS_PER_SEARCH)
        coordinates = end.coordinates
        if end.steps == 0:
            break
    return coordinates


def _whole(
    objective: Objective, found: Float[np.ndarray, "starts p"], origins: Float[np.ndarray, "starts p"]
) -> Minimum:
    """Return the best of the scouts' ends by all rows, polished with orbits followed from there."""
    values = objective.problem.values(found)
    chi2 = objective.screen(values)
    winner = lowest(chi2)
    follower = objective.following(values[winner])
    softly = polish(follower, found[winner][None], SOFT, settled=ROUGH)
    end = polish(follower, softly.coordinates, PLAIN, settled=FINE)
    best = objective.problem.values(end.coordinates)[0]
    return Minimum(end.coordinates[0], origins[winner], np.vstack([best, values]), np.append(end.objective, chi2))


def settle(objective: Objective, minimum: Minimum) -> Minimum:
    """Polish again until the orbits that are found at the minimum are the ones that were followed to it."""
    for _ in range(_ROUNDS):
        values = objective.problem.values(minimum.coordinates)
        follower = objective.following(values)
        end = polish(follower, minimum.coordinates[None], PLAIN, settled=FINE)
        chi2 = float(np.sum(objective.searching().residual(objective.problem.values(end.coordinates)) ** 2))
        minimum = replace(minimum, coordinates=end.coordinates[0], chi2=np.append(chi2, minimum.chi2[1:]))
        if abs(chi2 - end.objective[0]) < 1e-6 * (1.0 + chi2):
            break
    return minimum


def _thinned(objective: Objective) -> Objective:
    """Return the objective of at most `ROWS_PER_PROGRAM` rows, spread over orders, frequencies and drives."""
    rows = jax.tree.map(np.asarray, objective.measurement.rows)
    seen = np.flatnonzero(rows.measured.any(axis=1) | rows.no_orbit)
    if seen.size <= ROWS_PER_PROGRAM:
        return objective
    ranked = seen[np.lexsort((rows.drive_amplitude_nm[seen], rows.drive_frequency_khz[seen], rows.order[seen]))]
    chosen = ranked[np.linspace(0, ranked.size - 1, ROWS_PER_PROGRAM).round().astype(int)]
    return objective.of_rows(chosen)


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
        residual = objective.amplitude_residuals(objective.problem.values(minimum.coordinates))
        factor = float(np.sqrt(np.sum(residual**2) / freedom))
        if factor == 0.0:
            break
        total *= factor
        objective = objective.with_rows(error_nm=objective.measurement.rows.error_nm * factor)
        if objective.problem.lasting:
            minimum = settle(objective, minimum)
        else:
            minimum = _polished(objective, objective.problem.coordinates(minimum.ends), minimum.start)
    return objective, minimum, total


def _polished(
    objective: Objective, starts: Float[np.ndarray, "starts p"], origins: Float[np.ndarray, "..."]
) -> Minimum:
    """Polish plainly and keep the best; `origins` are the starts' grid points, or the one that is already known."""
    final = polish(objective, starts, PLAIN, settled=FINE)
    winner = lowest(final.objective)
    start = origins if origins.ndim == 1 else origins[winner]
    return Minimum(final.coordinates[winner], start, objective.problem.values(final.coordinates), final.objective)
