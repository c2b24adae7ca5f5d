"""The optimiser: screen a coarse grid, polish the best starts with optax's L-BFGS, then trust none of it (checks.py).

Compilation is what a fit from the command line waits for, so one program alone contains the forward model: residuals
with their Jacobian for a handful of parameter sets at once (`forward.linearise`). The screening, the polish, the checks
and the profile intervals all drive it from outside.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Bool, Float

from afm_jax.units import RAD_PER_US_PER_KHZ
from fitting.forward import Linearised, Measurement, linearise
from fitting.models import Problem

BATCH = 8
"""Parameter sets that `linearise` takes at once."""
SOFT = 5.0
"""Residual, in errors, beyond which the screening and the first polish count a row linearly (soft-l1)."""
PLAIN = np.inf
"""The same for plain least squares: no residual gets there."""
_GRID_PER_PARAMETER = {1: 96, 2: 16}
_MAX_STEPS = 60
_LBFGS = optax.lbfgs(learning_rate=1.0, linesearch=None, scale_init_precond=False)
_init = jax.jit(jax.vmap(_LBFGS.init))
_update = jax.jit(jax.vmap(_LBFGS.update))


class Polished(NamedTuple):
    """Where the polish of each start ended: coordinates (starts, p), objective (starts,), and the steps taken."""

    coordinates: Float[np.ndarray, "starts p"]
    objective: Float[np.ndarray, " starts"]
    steps: int


def soft_square(residual: Float[np.ndarray, "..."], softness: float) -> Float[np.ndarray, "..."]:
    """Return 2 s^2 (sqrt(1 + x^2/s^2) - 1), which is x^2 for infinite s; written so that nothing cancels."""
    square = residual**2
    return 2.0 * square / (1.0 + np.sqrt(1.0 + square / softness**2))


def grid(problem: Problem, measurement: Measurement) -> Float[np.ndarray, "points p"]:
    """Return the values of a coarse grid, logarithmic in every loss; Q stays where it was measured.

    Adhesion and viscous loss are laid out in terms of the drive's speed beta omega, on which capture depends.
    """
    rows = measurement.rows
    drive = RAD_PER_US_PER_KHZ * np.asarray(rows.drive_amplitude_nm) * np.asarray(rows.drive_frequency_khz)
    slow, fast = float(drive.min()), float(drive.max())
    laws = [name for name in problem.names if name != "quality_factor"]
    count = _GRID_PER_PARAMETER[len(laws)]
    ranges = {
        "r": 1.0 - np.geomspace(0.7, 1e-4, count),
        "epsilon": np.geomspace(1e-4 * slow**2, 30.0 * fast**2, count),
        "viscous_loss": np.geomspace(1e-4 * slow, 10.0 * fast, count),
        "quality_factor": np.array([float(measurement.quality_factor)]),
    }
    mesh = np.meshgrid(*(ranges[name] for name in problem.names), indexing="ij")
    return np.stack([axis.ravel() for axis in mesh], axis=1)


class Objective:
    """The objective of a table and a model in optimiser coordinates, with its gradient, for up to `BATCH` sets."""

    def __init__(self, measurement: Measurement, problem: Problem):
        """Keep what every evaluation shares."""
        self.measurement, self.problem = measurement, problem

    def at_values(self, values: Float[np.ndarray, "sets p"]) -> Linearised:
        """Return the linearised model at parameter values, as NumPy arrays; short batches are filled up."""
        count = values.shape[0]
        filled = np.concatenate([values, np.repeat(values[-1:], BATCH - count, axis=0)])
        result = linearise(jnp.asarray(filled), self.measurement, self.problem)
        return jax.tree.map(lambda leaf: np.asarray(leaf)[:count], result)

    def residual(self, values: Float[np.ndarray, "sets p"]) -> Float[np.ndarray, "sets n"]:
        """Return the residuals at parameter values."""
        return np.asarray(self.at_values(values).residual)

    def linearise(
        self, coordinates: Float[np.ndarray, "sets p"]
    ) -> tuple[Float[np.ndarray, "sets n"], Float[np.ndarray, "sets n p"]]:
        """Return residuals and their Jacobian by the coordinates."""
        values, slopes = self.problem.values_and_slopes(coordinates)
        result = self.at_values(values)
        return np.asarray(result.residual), np.asarray(result.jacobian) * slopes[:, None, :]

    def screen(self, values: Float[np.ndarray, "points p"]) -> Float[np.ndarray, " points"]:
        """Return the soft objective at every point of a grid of parameter values."""
        batches = [values[i : i + BATCH] for i in range(0, len(values), BATCH)]
        return np.concatenate([soft_square(self.residual(batch), SOFT).sum(axis=1) for batch in batches])

    def value_and_gradient(
        self, coordinates: Float[np.ndarray, "sets p"], softness: float
    ) -> tuple[Float[np.ndarray, " sets"], Float[np.ndarray, "sets p"]]:
        """Return the soft objective and its gradient by the coordinates."""
        residual, jacobian = self.linearise(coordinates)
        weight = 2.0 * residual / np.sqrt(1.0 + (residual / softness) ** 2)
        return soft_square(residual, softness).sum(axis=1), np.einsum("snp,sn->sp", jacobian, weight)

    def scale(self, coordinates: Float[np.ndarray, "sets p"]) -> Float[np.ndarray, "sets p p"]:
        """Return matrices whose columns are steps of about one standard error each (Gauss-Newton).

        A direction that changes nothing at this point gets at most a large step, not an infinite one.
        """
        _, jacobian = self.linearise(coordinates)
        curvature, axes = np.linalg.eigh(np.einsum("snp,snq->spq", jacobian, jacobian))
        largest = np.maximum(curvature[:, -1:], 1e-12)
        return axes / np.sqrt(np.maximum(curvature, 1e-8 * largest))[:, None, :]


def polish(objective: Objective, starts: Float[np.ndarray, "starts p"], softness: float, *, settled: float) -> Polished:
    """Minimise from every start at once by optax's L-BFGS, steps halved until they descend (Armijo).

    Args:
        objective: what to minimise.
        starts: optimiser coordinates, at most `BATCH` of them.
        softness: residual in errors beyond which rows count linearly; `PLAIN` for least squares.
        settled: estimated distance of the objective to its minimum at which a start is done.
    """
    scale = objective.scale(starts)

    def evaluate(z):
        """Return the objective and half its gradient in units of standard errors, where its Hessian is about 2."""
        value, gradient = objective.value_and_gradient(starts + np.einsum("spq,sq->sp", scale, z), softness)
        return value, np.einsum("spq,sp->sq", scale, gradient) / 2.0

    z = np.zeros_like(starts)
    value, gradient = evaluate(z)
    step, state = _lbfgs(gradient, None, z)
    step, share = _descending(step, gradient), np.ones(len(z))
    count = 0
    while count < _MAX_STEPS and np.any((_squared(gradient) > settled) & (share > 1e-9)):
        count += 1
        trial = z + share[:, None] * step
        new_value, new_gradient = evaluate(trial)
        accepted = new_value <= value + 2e-4 * share * np.einsum("sp,sp->s", gradient, step)
        kept = accepted[:, None]
        z, gradient = np.where(kept, trial, z), np.where(kept, new_gradient, gradient)
        value, share = np.where(accepted, new_value, value), np.where(accepted, 1.0, 0.5 * share)
        new_step, new_state = _lbfgs(gradient, state, z)
        state = _choose(accepted, new_state, state)
        step = np.where(kept, _descending(new_step, gradient), step)
    return Polished(starts + np.einsum("spq,sq->sp", scale, z), value, count)


def _lbfgs(
    gradient: Float[np.ndarray, "sets p"], state: optax.OptState | None, z: Float[np.ndarray, "sets p"]
) -> tuple[Float[np.ndarray, "sets p"], optax.OptState]:
    """Return optax's L-BFGS step of every set and its new state; no state: the first step."""
    # optax mixes integers of 32 and 64 bits, which strict promotion would refuse.
    with jax.numpy_dtype_promotion("standard"):
        before = _init(jnp.asarray(z)) if state is None else state
        step, after = _update(jnp.asarray(gradient), before, jnp.asarray(z))
    return np.asarray(step), after


def _squared(gradient: Float[np.ndarray, "sets p"]) -> Float[np.ndarray, " sets"]:
    return np.einsum("sp,sp->s", gradient, gradient)


def _descending(
    step: Float[np.ndarray, "sets p"], gradient: Float[np.ndarray, "sets p"]
) -> Float[np.ndarray, "sets p"]:
    """Return L-BFGS steps, or the gradient's where one does not lead downhill; none longer than 30 errors."""
    downhill = np.einsum("sp,sp->s", step, gradient) < 0.0
    step = np.where(downhill[:, None], step, -gradient)
    length = np.linalg.norm(step, axis=1, keepdims=True)
    return step * np.minimum(1.0, 30.0 / np.maximum(length, 1e-300))


def _choose(accepted: Bool[np.ndarray, " sets"], new: optax.OptState, old: optax.OptState) -> optax.OptState:
    """Return the new optimiser state where a step was accepted, the old one elsewhere."""

    def one(new_leaf, old_leaf):
        return np.where(accepted.reshape((-1,) + (1,) * (new_leaf.ndim - 1)), new_leaf, old_leaf)

    return jax.tree.map(one, new, old)
