"""Optax's L-BFGS around a function of NumPy: the caller gives residuals and their Jacobian, steps are halved.

The start's Gauss-Newton curvature makes steps of one standard error each the unit, so that steep valleys look round.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import numpy as np
import optax
from jaxtyping import Float

from afm_jax.solve.least_squares import Sum

OPTIMISER = f"optax.lbfgs {optax.__version__}"
_LBFGS = optax.lbfgs(learning_rate=1.0, linesearch=None, scale_init_precond=False)
_init, _update = jax.jit(_LBFGS.init), jax.jit(_LBFGS.update)
_LONGEST = 30.0
"""Longest step in standard errors."""
_ARMIJO, _SHORTEST = 1e-4, 1e-9
"""Part of the descent that the gradient promises which a step must bring; share of a step at which it gives up."""


class Minimised(NamedTuple):
    """Where an optimiser has ended: place, value and steps taken."""

    place: Float[np.ndarray, " p"]
    value: float
    steps: int


def minimised(
    evaluate: Callable[[Float[np.ndarray, " p"]], Sum],
    start: Float[np.ndarray, " p"],
    *,
    settled: float,
    most: int = 60,
) -> Minimised:
    """Return a minimum.

    Args:
        evaluate: gives the sum at a place, whose gradient is 2 J^T r; an infinite value refuses a step.
        start: where to begin.
        settled: estimated distance of the value to its minimum at which it has arrived.
        most: steps at most.
    """
    first = evaluate(start)
    curvature = first.jacobian.T @ first.jacobian
    sound = np.isfinite(curvature).all()
    strength, axes = np.linalg.eigh(curvature if sound else np.eye(start.size))
    scale = axes / np.sqrt(np.maximum(strength, 1e-8 * max(float(strength[-1]), 1e-12)))
    z = np.zeros_like(start)
    value = first.value
    gradient = (first.residual @ first.jacobian) @ scale
    # optax mixes integers of 32 and 64 bits, which strict promotion would refuse
    with jax.numpy_dtype_promotion("standard"):
        step, state = _update(gradient, _init(z), z)
        share, count = 1.0, 0
        while count < most and gradient @ gradient > settled and share > _SHORTEST:
            count += 1
            move = _downhill(np.asarray(step), gradient)
            there = evaluate(start + scale @ (z + share * move))
            if not there.value <= value + 2.0 * _ARMIJO * share * float(gradient @ move):
                share *= 0.5
                continue
            z = z + share * move
            value = there.value
            gradient = (there.residual @ there.jacobian) @ scale
            share = 1.0
            step, state = _update(gradient, state, z)
    return Minimised(start + scale @ z, value, count)


def _downhill(step: Float[np.ndarray, " p"], gradient: Float[np.ndarray, " p"]) -> Float[np.ndarray, " p"]:
    """Return a step that leads downhill, the gradient's if need be, not too long."""
    step = step if step @ gradient < 0.0 else -gradient
    return step * min(1.0, _LONGEST / max(float(np.linalg.norm(step)), 1e-300))
