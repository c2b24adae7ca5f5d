"""Newton's method for n equations f(x, p) = 0 in n unknowns: x <- x - (df/dx)^-1 f, with limits on the step.

`newton` solves for one guess inside a compiled program, under `vmap` for many, and gives the root the derivative of the
implicit function theorem, dx/dp = -(df/dx)^-1 df/dp. `newton_rows` solves for many guesses in NumPy where f is itself a
program, such as a simulation: each round evaluates the rows that are still open, and no others.

In a batch of slots with few guesses `where` names the slots that hold one. A step that must not leave the domain
of f is limited by `Newton.damping`.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from afm_jax.solve.derivatives import implicit_system, solved_columns, value_and_slopes


class Newton(NamedTuple):
    """Settings of Newton's method.

    A root counts as found in the round in which residual and step are both within their tolerances. This step is still
    taken, so that the error left is of the order of the step's square.
    """

    rounds: int
    """Evaluations of residual and Jacobian at most."""
    step_tolerance: float = math.inf
    """Largest component of the last step, in units of `unit`."""
    residual_tolerance: float = math.inf
    """Largest component of the residual."""
    unit: Callable[[Any], Any] | None = None
    """Natural size of the unknowns at x, to which `step_tolerance` refers; None: 1."""
    damping: Callable[[Any, Any], Any] | None = None
    """Returns the step to be taken from x in place of the full one; None: the full step."""

    def limited(self, x: Any, step: Any) -> tuple[Any, Any]:
        """Return the step to be taken from x, and the sizes of its components."""
        step = step if self.damping is None else self.damping(x, step)
        return step, abs(step if self.unit is None else step / self.unit(x))


class Root(NamedTuple):
    """Where a search inside a program ended."""

    x: Float[Array, " n"]
    residual: Float[Array, " n"]
    """The residual before the last step; infinite where no round was made."""
    slopes: Float[Array, "n n"]
    """Derivatives of the residual by the unknowns before the last step; 0 where no round was made."""


def newton(
    residual: Callable[[Array, Any], Array],
    guess: Float[Array, " n"],
    parameters: Any,
    settings: Newton,
    *,
    where: Bool[Array, ""] | None = None,
) -> Root:
    """Return the root of f(x, parameters) = 0 that Newton's method finds from a guess, differentiable.

    Args:
        residual: f, a plain function that takes everything that may have a derivative from its parameters.
        guess: its own derivative is ignored.
        parameters: pytree of arrays.
        settings: rounds, tolerances and limits.
        where: whether a root is asked for; if not, the guess is returned, and no round is made for it.

    Returns:
        The root with its implicit derivative, also where the search has not converged; 0 where df/dx is singular.
    """
    fixed = lax.stop_gradient(parameters)
    begin = lax.stop_gradient(guess)

    def improve(state: tuple[Array, Array, Root]) -> tuple[Array, Array, Root]:
        done, going, (x, *before) = state
        value, slopes = value_and_slopes(lambda x: residual(x, fixed), x)
        full = -solved_columns(list(slopes.T), value)
        step, sizes = settings.limited(x, full)
        # of two equations the solution is 0 where the matrix is singular
        stands = jnp.all(full == 0.0) & jnp.any(value != 0.0)
        moves = going & jnp.all(jnp.isfinite(step)) & ~stands
        small = jnp.all(jnp.abs(value) <= settings.residual_tolerance)
        found = small & jnp.all(sizes <= settings.step_tolerance)
        here = (jnp.where(going, new, old) for new, old in zip((value, slopes), before, strict=True))
        return done + 1, moves & ~found, Root(jnp.where(moves, x + step, x), *here)

    def unsettled(state: tuple[Array, Array, Root]) -> Array:
        return (state[0] < settings.rounds) & state[1]

    asked = jnp.ones((), bool) if where is None else where
    # the batch's own from the start: a loop whose state joins the batch later is traced once more
    start = Root(begin, jnp.abs(begin) + jnp.inf, jnp.outer(jnp.zeros(begin.shape[0]), begin))
    root = lax.while_loop(unsettled, improve, (jnp.zeros((), jnp.int32), asked, start))[2]
    return root._replace(x=implicit_system(residual, root.x, parameters))


class LinearisedRows(NamedTuple):
    """Equations at the points of some rows; NaN in a row where they have no value."""

    residual: Float[np.ndarray, "rows n"]
    slopes: Float[np.ndarray, "rows n n"]
    """Derivatives of the residuals by the unknowns."""
    details: Sequence[Any] | None = None
    """What else the evaluation has found, one a row."""


class Roots(NamedTuple):
    """Where the searches of all rows ended."""

    x: Float[np.ndarray, "rows n"]
    converged: Bool[np.ndarray, " rows"]
    """Which rows have a root: the last step and the residual before it are within their tolerances."""
    details: list[Any]
    """What the last evaluation of each row has found besides; None where there is nothing."""


def newton_rows(
    linearised: Callable[[Float[np.ndarray, "open n"], Int[np.ndarray, " open"]], LinearisedRows],
    guesses: Float[np.ndarray, "rows n"],
    settings: Newton,
) -> Roots:
    """Return the roots that Newton's method finds from many guesses, each row on its own.

    Args:
        linearised: equations and derivatives at points, given with the numbers of their rows.
        guesses: first points.
        settings: rounds, tolerances and limits.
    """
    count = len(guesses)
    roots = Roots(np.array(guesses, float), np.zeros(count, bool), [None] * count)
    rows = np.arange(count)
    for _ in range(settings.rounds):
        if not rows.size:
            break
        here = linearised(roots.x[rows], rows)
        step, sizes = settings.limited(roots.x[rows], -_solved(here.slopes, here.residual))
        finite = np.isfinite(step).all(axis=1)
        small = np.all(np.abs(here.residual) <= settings.residual_tolerance, axis=1)
        found = finite & small & np.all(sizes <= settings.step_tolerance, axis=1)
        for row, detail in zip(rows, here.details or (), strict=bool(here.details)):
            roots.details[row] = detail
        roots.converged[rows] = found
        roots.x[rows[finite]] += step[finite]
        rows = rows[finite & ~found]
    return roots


def _solved(slopes: Float[np.ndarray, "rows n n"], right: Float[np.ndarray, "rows n"]) -> Float[np.ndarray, "rows n"]:
    """Return the solutions of linear equations, row by row; NaN where a matrix is singular."""
    with np.errstate(invalid="ignore"):
        singular = np.linalg.slogdet(slopes)[0] == 0.0
    regular = np.where(singular[:, None, None], np.eye(right.shape[1]), slopes)
    return np.where(singular[:, None], np.nan, np.linalg.solve(regular, right[:, :, None])[:, :, 0])
