"""Newton's method for n equations f(x, p) = 0 in n unknowns inside a program: x <- x - (df/dx)^-1 f, steps limited.

Takes f, a guess and a `Newton` with tolerances in the units of f and x; gives the root.

`newton` solves for one guess, under `vmap` for many, and gives the root the derivative of the implicit function
theorem, dx/dp = -(df/dx)^-1 df/dp. In a batch of slots with few guesses `where` names the slots that hold one.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from afm_jax.solve.derivatives import implicit_system, solved_columns, value_and_slopes
from afm_jax.solve.newton_rows import Newton


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
