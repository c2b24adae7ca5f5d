"""Levenberg's and Marquardt's damped least squares between bounds, and what a minimum is worth: covariance, chi2.

Takes residuals in units of their errors with a Jacobian; gives the place where the sum of squares is smallest: (J^T J +
d diag J^T J) step = -J^T r, d the damping.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

_FIRST, _LESS, _MORE, _SMALLEST, _LARGEST = 1e-3, 0.1, 8.0, 1e-9, 1e8
"""Damping in units of every unknown's own curvature: the first, its factors after steps taken and refused, its ends."""


class Sum(NamedTuple):
    """A sum of squares: value, infinite where there is none, residuals r and Jacobian J; the gradient is 2 J^T r."""

    value: float
    residual: Float[np.ndarray, " n"]
    jacobian: Float[np.ndarray, "n k"]


class Lowest(NamedTuple):
    """Where the sum is smallest, what it is there, how many evaluations that took, and how far it is from its minimum.

    The distance is estimated, and NaN where it is not finite.
    """

    place: Float[np.ndarray, " k"]
    sum: Sum
    steps: int
    distance: float


def levenberg_marquardt(  # noqa: PLR0913
    evaluate: Callable[[Float[np.ndarray, " k"]], Sum],
    start: Float[np.ndarray, " k"],
    *,
    settled: float,
    most: int,
    longest: Float[np.ndarray, " k"] | float = np.inf,
    fixed: Bool[np.ndarray, " k"] | None = None,
    lowest: Float[np.ndarray, " k"] | float = -np.inf,
    highest: Float[np.ndarray, " k"] | float = np.inf,
    rise: float = 0.0,
) -> Lowest:
    """Return a minimum; steps that cannot be evaluated are refused.

    Args:
        evaluate: of a place.
        start: where to begin.
        settled: fall of the sum in a step at which it has arrived.
        most: steps that are taken, at most.
        longest: by how much each unknown may change in a step; longer steps are shortened as a whole.
        fixed: unknowns that stay; None: none.
        lowest: value of each unknown: one that is there stays while the sum falls beyond.
        highest: likewise.
        rise: by how much a step may raise the sum, where the Jacobian is not quite that of the residuals.
    """
    free = np.ones(start.size, bool) if fixed is None else ~fixed
    place = np.where(free, np.clip(start, lowest, highest), start)
    here, damping, count = evaluate(place), _FIRST, 0

    def moves() -> Bool[np.ndarray, " k"]:
        uphill = here.jacobian.T @ here.residual
        return free & ~((place <= lowest) & (uphill > 0.0)) & ~((place >= highest) & (uphill < 0.0))

    for _ in range(most):
        moving, step, there = moves(), np.zeros_like(start), None
        while damping < _LARGEST and there is None:
            step, promised = _step(here, moving, damping)
            if promised < 1e-2 * settled:
                break
            step *= min(1.0, float(np.min(longest / np.maximum(np.abs(step), 1e-300))))
            step = np.where(moving, np.clip(step, lowest - place, highest - place), 0.0)
            trial, count = evaluate(place + step), count + 1
            if trial.value < here.value + rise:
                there = trial
            else:
                damping = max(_MORE * damping, 1e-4)
        if there is None:
            break
        fall, place, here = here.value - there.value, place + step, there
        # with little damping a small fall means that a minimum is near
        if 0.0 <= fall < settled * (1.0 if damping < 0.1 else 1e-3):
            break
        damping = max(_LESS * damping, _SMALLEST)
    return Lowest(place, here, count, _step(here, moves(), _SMALLEST)[1])


def _step(here: Sum, moving: Bool[np.ndarray, " k"], damping: float) -> tuple[Float[np.ndarray, " k"], float]:
    """Return a damped step of Gauss's and Newton's, and by how much it lowers the sum if that is a parabola."""
    jacobian, step = here.jacobian[:, moving], np.zeros(moving.size)
    gradient, unit = jacobian.T @ here.residual, np.linalg.norm(jacobian, axis=0) + 1e-30
    normal = jacobian.T @ jacobian / np.outer(unit, unit) + damping * np.eye(unit.size)
    step[moving] = -np.linalg.solve(normal, gradient / unit) / unit
    return step, -float(gradient @ step[moving])


def covariance_of(fisher: Float[np.ndarray, "... p p"]) -> Float[np.ndarray, "... p p"]:
    """Return the inverse of Fisher matrices; rows and columns of parameters that one does not determine are infinite.

    Where a matrix is not finite, all of its inverse is infinite.
    """
    finite = np.isfinite(fisher).all(axis=(-2, -1), keepdims=True)
    sound = np.where(finite, fisher, 0.0)
    scale = np.sqrt(np.diagonal(sound, axis1=-2, axis2=-1))
    safe = np.where(scale > 0.0, scale, 1.0)
    unit = safe[..., :, None] * safe[..., None, :]
    # parameters may be of very different size
    curvature, axes = np.linalg.eigh(sound / unit)
    # where every parameter's own curvature is 1, a smaller one does not determine a direction
    flat = curvature < 1e-12
    undetermined = np.any((np.abs(axes) > 1e-6) & flat[..., None, :], axis=-1)
    inverse = (axes / np.where(flat, np.inf, curvature)[..., None, :]) @ np.swapaxes(axes, -2, -1) / unit
    return np.where(undetermined[..., :, None] | undetermined[..., None, :] | ~finite, np.inf, inverse)


IMPROBABLE = 1e-3
"""Probability of the chi2 below which a model does not explain its readings."""
PULLED, TORN = 2.0, 3.0
"""Distance of a fitted quantity from what is known of it otherwise, in the standard errors of that: from the first on
it is named, from the second on neither is believed."""
LARGEST_SCALE = 3.0
"""Scale of the errors that is believed: a spread given for that of a mean, a 3 sigma limit for 1 sigma. Errors that
would have to be larger are wrong by more than a scale, and have to be stated nearer to the truth."""


def chi2_tail(chi2: float, freedom: int) -> float:
    """Return the probability that chi2 of so many degrees of freedom is larger: the finite sum, without SciPy's import.

    Q = [erfc(sqrt h)] + exp(-h) sum of h^a / Gamma(a + 1) with h = chi2/2, over a = 0, 1, ... < freedom/2; for odd ones
    a = 1/2, 3/2, ... and the term in brackets.
    """
    half, odd = 0.5 * chi2, freedom % 2
    tail = math.erfc(math.sqrt(half)) if odd else 0.0
    if half in {0.0, math.inf}:
        return float(half == 0.0)
    powers = (0.5 * odd + k for k in range(freedom // 2))
    return min(tail + math.fsum(math.exp(a * math.log(half) - half - math.lgamma(a + 1.0)) for a in powers), 1.0)
