"""The derivative of a root, by the implicit function theorem.

A root x(p) of f(x, p) = 0 that some search has found obeys dx/dp = -(df/dp)/(df/dx). The rule calls itself for the
root it differentiates at, so that second derivatives (forward over reverse, Hessians) are right as well; a Newton step
behind `stop_gradient` would give wrong Hessians.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def implicit_root(
    residual: Callable[[Float[Array, ""], Any], Float[Array, ""]], root: Float[Array, ""], parameters: Any
) -> Float[Array, ""]:
    """Attach the implicit derivative to a root that a search has found.

    Args:
        residual: f(x, parameters), smooth near the root; a plain function, the same object at every call.
        root: the value of x that the search found; its own derivative is ignored.
        parameters: pytree of what the root depends on.

    Returns:
        `root`, differentiable with respect to `parameters`. Where df/dx is 0 (grazing, fold) the derivative is 0: such
        points have none, and the caller flags them.
    """
    del residual, parameters
    return root


@implicit_root.defjvp
def _implicit_root_jvp(residual, primals, tangents):
    """Differentiate: dx = -(df/dp dp) / (df/dx) at the root."""
    root, parameters = primals
    _, parameter_rates = tangents
    x = implicit_root(residual, root, parameters)
    _, slope = jax.jvp(lambda value: residual(value, parameters), (x,), (jnp.ones_like(x),))
    _, shift = jax.jvp(lambda value: residual(x, value), (parameters,), (parameter_rates,))
    regular = slope != 0.0
    return x, jnp.where(regular, -shift / jnp.where(regular, slope, 1.0), 0.0)
