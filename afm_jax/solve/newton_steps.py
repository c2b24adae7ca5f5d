"""A few steps of Newton's method inside a program, to a simple root of one equation that a scan has come close to.

Takes f with its derivative and a guess, in whatever unit; gives x after so many steps x - f/f'.
"""

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, ArrayLike, Float


def newton_steps(
    value_and_slope: Callable[[Array], tuple[Array, Array]],
    guess: Float[Array, "..."],
    steps: int,
    low: ArrayLike = -jnp.inf,
    high: ArrayLike = jnp.inf,
    *,
    unroll: bool = False,
) -> Float[Array, "..."]:
    """Return the root of f that so many steps x - f/f' lead to, or of each of several equations.

    >>> import jax
    >>> with jax.enable_x64(True):
    ...     print(round(newton_steps(lambda x: (x * x - 2.0, 2.0 * x), jnp.ones(()), 6).item(), 12))
    1.414213562373

    Args:
        value_and_slope: f and its derivative at x, of x's shape; where the derivative is 0 no step is made.
        guess: near the root.
        steps: how many.
        low: the root is held above it.
        high: and below it.
        unroll: write the steps out: longer to compile than a loop, quicker to run where f is short.
    """

    def step(_: Any, x: Array) -> Array:
        value, slope = value_and_slope(x)
        flat = slope == 0.0
        return jnp.clip(x - jnp.where(flat, 0.0, value / jnp.where(flat, 1.0, slope)), low, high)

    return lax.fori_loop(0, steps, step, guess, unroll=unroll)
