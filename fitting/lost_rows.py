"""Minima at which measured orbits have got lost: a way back to laws that have them.

Where a law has no orbit on a row that was measured, chi2 is a plateau there: nothing tells a minimisation which way the
orbit lies. The laws around the minimum are asked for these rows alone, and the minimisation goes on from the best ones.
"""

import numpy as np
from jaxtyping import Bool, Float

from fitting.optimise import BATCH, FINE, PLAIN, ROUGH, SOFT, Objective, lowest, polish

_STEPS = (0.01, 0.03, 0.1, 0.3)
"""How far around a minimum laws are tried, in the optimiser's coordinates; those of losses relative to themselves."""


def lost_rows(objective: Objective, values: Float[np.ndarray, " p"]) -> Bool[np.ndarray, " rows"]:
    """Say on which rows something was measured that the law has no orbit for.

    Args:
        objective: its orbits are searched for.
        values: of the law.
    """
    measured = np.asarray(objective.measurement.rows.measured).any(axis=1)
    return measured & (np.asarray(objective.searching().at_values(values[None]).prediction.orbits)[0] == 0)


def recovered(
    objective: Objective, coordinates: Float[np.ndarray, " p"], lost: Bool[np.ndarray, " rows"]
) -> Float[np.ndarray, " p"] | None:
    """Return a minimum from which fewer orbits are missing, None if the laws around have no more of them.

    Args:
        objective: of all rows.
        coordinates: the minimum.
        lost: rows without orbit there.
    """
    around = _around(objective, coordinates)
    found = (
        np.asarray(objective.searching().of_rows(lost).at_values(objective.problem.values(around)).prediction.orbits)
        > 0
    )
    if not found.any():
        return None
    # the closest ones come first
    best = around[np.argsort(-found.sum(axis=1), kind="stable")[:BATCH]]
    follower = objective.following_each(objective.problem.values(best))
    ends = polish(follower, best, SOFT, settled=ROUGH).coordinates
    follower = objective.following_each(objective.problem.values(ends))
    ends = polish(follower, ends, PLAIN, settled=FINE).coordinates
    chi2 = np.sum(objective.searching().residual(objective.problem.values(ends)) ** 2, axis=1)
    return ends[lowest(chi2)]


def _around(objective: Objective, coordinates: Float[np.ndarray, " p"]) -> Float[np.ndarray, "sets p"]:
    """Return coordinates to either side of a point along every parameter of the law, close ones first."""
    problem = objective.problem
    sets = []
    for step in _STEPS:
        for index, parameter in enumerate(problem.parameters[: len(problem.own)]):
            for side in (-step, step):
                moved = coordinates.copy()
                moved[index] += side * (coordinates[index] if parameter.sign else 1.0)
                sets.append(moved)
    return np.array(sets)
