"""Choosing points: greedily, then exchanged one by one until no exchange helps (Fedorov), then in the best order."""

import numpy as np
from jaxtyping import Float, Int

from fitting.planning.experiment_information import Criterion

_ROUNDS = 50
_BETTER = 1e-9
"""Gain below which an exchange is rounding."""


def choose_points(
    prior: Float[np.ndarray, "p p"], each: Float[np.ndarray, "n p p"], points: int, criterion: Criterion
) -> Int[np.ndarray, " points"]:
    """Return the numbers of the chosen candidates, each once, in the order in which they help most.

    Args:
        prior: information of what is known already.
        each: information of a measurement at every candidate.
        points: how many to choose; at most n are.
        criterion: what makes an information matrix good.
    """
    points = min(points, len(each))
    if points == 0:
        return np.zeros(0, dtype=np.int64)
    chosen = _greedy(prior, each, np.arange(len(each)), points, criterion)
    chosen = _exchanged(prior, each, chosen, criterion)
    return np.array(_greedy(prior, each, np.sort(chosen), points, criterion), dtype=np.int64)


def _greedy(
    prior: Float[np.ndarray, "p p"],
    each: Float[np.ndarray, "n p p"],
    among: Int[np.ndarray, " k"],
    points: int,
    criterion: Criterion,
) -> list[int]:
    """Return candidates taken one after another, each the best addition to those before."""
    left, chosen, information = among.tolist(), [], prior
    for _ in range(points):
        best = left.pop(int(np.argmax(criterion(information + each[left]))))
        chosen.append(best)
        information = information + each[best]
    return chosen


def _exchanged(
    prior: Float[np.ndarray, "p p"], each: Float[np.ndarray, "n p p"], chosen: list[int], criterion: Criterion
) -> list[int]:
    """Return a choice that no exchange of one of its points makes better."""
    chosen = list(chosen)
    for _ in range(_ROUNDS):
        before = chosen.copy()
        for place in range(len(chosen)):
            others = [point for point in chosen if point != chosen[place]]
            score = criterion(prior + each[others].sum(axis=0) + each)
            current = score[chosen[place]]
            score[others] = -np.inf
            best = int(np.argmax(score))
            if score[best] > current + _BETTER * abs(current):
                chosen[place] = best
        if chosen == before:
            break
    return chosen
