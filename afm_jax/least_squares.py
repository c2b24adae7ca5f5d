"""Damped Gauss-Newton steps (Levenberg, Marquardt), for several searches side by side and between bounds."""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

_SMALLEST_DAMPING, _FIRST_DAMPING, _LARGEST_DAMPING = 1e-12, 1e-6, 1e8


class Searches(NamedTuple):
    """Where several searches are: places, residuals, their Jacobian by the places, and the sums of their squares."""

    place: Float[np.ndarray, "sets p"]
    residual: Float[np.ndarray, "sets n"]
    jacobian: Float[np.ndarray, "sets n p"]
    chi2: Float[np.ndarray, " sets"]


Evaluate = Callable[[Float[np.ndarray, "some p"], Int[np.ndarray, " some"]], Searches]
"""Of places and the searches that they belong to: what is there."""


class Box(NamedTuple):
    """Where searches may go: between bounds (infinite: none), and which parameters of each search stay."""

    lowest: Float[np.ndarray, " p"]
    highest: Float[np.ndarray, " p"]
    fixed: Bool[np.ndarray, "sets p"]

    def of(self, some: Int[np.ndarray, " some"]) -> "Box":
        """Return the box of some of the searches."""
        return self._replace(fixed=self.fixed[some])


def descended(
    evaluate: Evaluate, start: Searches, box: Box, *, settled: float, most: int, rise: float = 0.0
) -> Searches:
    """Return where searches end that go down from their starts, each as long as it has not arrived.

    Args:
        evaluate: evaluates places of some of the searches.
        start: of every search.
        box: where they may go; a parameter at a bound stays there while the sum falls towards the outside.
        settled: estimated distance of the sum of squares to its minimum at which a search has arrived.
        most: steps at most.
        rise: by how much a step may raise the sum, where the Jacobian is not quite that of the residuals.
    """
    state = Searches(*(np.array(leaf) for leaf in start))
    damping = np.full(len(state.chi2), _FIRST_DAMPING)
    for _ in range(most):
        active = np.flatnonzero((distance(state, box) > settled) & (damping < _LARGEST_DAMPING))
        if not active.size:
            break
        some = Searches(*(leaf[active] for leaf in state))
        step = _step(some, box.of(active), damping[active])
        trials = evaluate(np.clip(some.place + step, box.lowest, box.highest), active)
        better = trials.chi2 <= some.chi2 + rise
        for leaf, new in zip(state, trials, strict=True):
            leaf[active[better]] = new[better]
        less = np.maximum(0.1 * damping[active], _SMALLEST_DAMPING)
        damping[active] = np.where(better, less, np.maximum(30.0 * damping[active], 1e-3))
    return state


def distance(state: Searches, box: Box) -> Float[np.ndarray, " sets"]:
    """Return the estimated distance of the sum of squares to its minimum, g H^-1 g; NaN where not finite.

    H = J^T J.
    """
    gradient = np.einsum("snp,sn->sp", state.jacobian, state.residual) * ~_held(state, box)
    step = _step(state, box, np.full(len(state.chi2), _SMALLEST_DAMPING))
    return -np.einsum("sp,sp->s", gradient, step)


def _held(state: Searches, box: Box) -> Bool[np.ndarray, "sets p"]:
    """Say which parameters stay: fixed ones, those at a bound that the sum falls beyond, and those without effect."""
    slope = np.einsum("snp,sn->sp", state.jacobian, state.residual)
    low, high = (state.place <= box.lowest) & (slope > 0.0), (state.place >= box.highest) & (slope < 0.0)
    return box.fixed | low | high | ~np.any(state.jacobian, axis=1)


def _step(state: Searches, box: Box, damping: Float[np.ndarray, " sets"]) -> Float[np.ndarray, "sets p"]:
    """Return damped Gauss-Newton steps, in units in which every parameter has the curvature 1; NaN if not finite."""
    held = _held(state, box)
    jacobian = np.where(held[:, None, :], 0.0, state.jacobian)
    unit = np.where(held, 1.0, np.linalg.norm(jacobian, axis=1))
    scaled = jacobian / unit[:, None, :]
    normal = np.einsum("snp,snq->spq", scaled, scaled)
    # a held parameter's own curvature is 1 instead of 0: its step is then 0
    normal += (damping[:, None] + held)[:, :, None] * np.eye(unit.shape[1])
    gradient = np.einsum("snp,sn->sp", scaled, state.residual)
    sound = np.all(np.isfinite(normal), axis=(1, 2))
    safe = np.where(sound[:, None, None], normal, np.eye(unit.shape[1]))
    step = -np.linalg.solve(safe, gradient[:, :, None])[:, :, 0] / unit
    return np.where(sound[:, None], step, np.nan)


_FLAT = 1e-12
"""Curvature, where every parameter's own is 1, below which a direction is not determined."""


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
    flat = curvature < _FLAT
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
