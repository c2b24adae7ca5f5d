"""Levenberg's and Marquardt's damped least squares: steps that cannot be evaluated are refused."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

_FIRST, _LESS, _MORE, _SMALLEST, _LARGEST = 1e-3, 0.1, 8.0, 1e-9, 1e8
"""Damping in units of every unknown's own curvature: the first, its factors after steps taken and refused, its ends."""
_SURELY = 0.1
"""Damping below which a small fall of the sum means that a minimum is near."""


class Sum(NamedTuple):
    """A sum of squares: value, infinite where there is none, residuals r and Jacobian J; the gradient is 2 J^T r."""

    value: float
    residual: Float[np.ndarray, " n"]
    jacobian: Float[np.ndarray, "n k"]


class Lowest(NamedTuple):
    """Where the sum is smallest, what it is there, and how many evaluations that took."""

    place: Float[np.ndarray, " k"]
    sum: Sum
    steps: int


def levenberg_marquardt(
    evaluate: Callable[[Float[np.ndarray, " k"]], Sum],
    start: Float[np.ndarray, " k"],
    *,
    settled: float,
    most: int,
    longest: Float[np.ndarray, " k"] | float = np.inf,
    fixed: Bool[np.ndarray, " k"] | None = None,
    lowest: Float[np.ndarray, " k"] | float = -np.inf,
) -> Lowest:
    """Return a minimum.

    Args:
        evaluate: of a place.
        start: where to begin.
        settled: fall of the sum in a step at which it has arrived.
        most: steps that are taken, at most.
        longest: by how much each unknown may change in a step; longer steps are shortened as a whole.
        fixed: unknowns that stay; None: none.
        lowest: value of each unknown: one that is there stays while the sum falls beyond.
    """
    free = np.ones(start.size, bool) if fixed is None else ~fixed
    place = np.where(free, np.maximum(start, lowest), start)
    here, damping, count = evaluate(place), _FIRST, 0
    for _ in range(most):
        moves = free & ~((place <= lowest) & (here.jacobian.T @ here.residual > 0.0))
        gradient = here.jacobian[:, moves].T @ here.residual
        normal = here.jacobian[:, moves].T @ here.jacobian[:, moves]
        unit = np.sqrt(np.diag(normal)) + 1e-30
        normal = normal / np.outer(unit, unit)
        step, there = np.zeros_like(start), here
        while damping < _LARGEST and not there.value < here.value:
            step = np.zeros_like(start)
            step[moves] = -np.linalg.solve(normal + damping * np.eye(unit.size), gradient / unit) / unit
            promised = -float(gradient @ step[moves])
            if promised < 1e-2 * settled:
                return Lowest(place, here, count)
            step *= min(1.0, float(np.min(longest / np.maximum(np.abs(step), 1e-300))))
            step = np.where(moves, np.maximum(step, lowest - place), 0.0)
            there, count = evaluate(place + step), count + 1
            if not there.value < here.value:
                damping = max(_MORE * damping, 1e-4)
        if not there.value < here.value:
            break
        fall, place, here = here.value - there.value, place + step, there
        if fall < settled * (1.0 if damping < _SURELY else 1e-3):
            break
        damping = max(_LESS * damping, _SMALLEST)
    return Lowest(place, here, count)
