"""The derivative of a root, by the implicit function theorem.

A root x(p) of f(x, p) = 0 that some search has found obeys dx/dp = -(df/dp)/(df/dx). The rule calls itself for the
root it differentiates at, so that second derivatives (forward over reverse, Hessians) are right as well; a Newton step
behind `stop_gradient` would give wrong Hessians. So would `jax.custom_jvp` as soon as the root is found inside
`lax.scan`: reverse mode evaluates a loop's body partially to move what does not change out of the loop, and drops
custom rules on the way (jax 0.10.1). A primitive keeps its rule.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir
from jaxtyping import Array, Float

_implicit_root = Primitive("implicit_root")
_PAIR = 2


def implicit_root(
    residual: Callable[[Float[Array, "..."], Any], Float[Array, "..."]], root: Float[Array, "..."], parameters: Any
) -> Float[Array, "..."]:
    """Attach the implicit derivative to a root that a search has found, or to several, each of its own equation.

    Args:
        residual: f(x, parameters), smooth near the root; a plain function, the same object at every call.
        root: the value of x that the search found; its own derivative is ignored.
        parameters: pytree of arrays, of what the root depends on.

    Returns:
        `root`, differentiable with respect to `parameters`. Where df/dx is 0 (grazing, fold) the derivative is 0: such
        points have none, and the caller flags them.
    """
    leaves, structure = jax.tree.flatten(parameters)
    return _implicit_root.bind(root, *leaves, residual=residual, structure=structure, pair=False)


def implicit_pair(
    residual: Callable[[Float[Array, " 2"], Any], Float[Array, " 2"]], root: Float[Array, " 2"], parameters: Any
) -> Float[Array, " 2"]:
    """Attach the implicit derivative to a root of two equations in two unknowns; as `implicit_root` otherwise."""
    leaves, structure = jax.tree.flatten(parameters)
    return _implicit_root.bind(root, *leaves, residual=residual, structure=structure, pair=True)


class _Mapped(NamedTuple):
    """A residual for a batch: row by row the same function; ``axes``: 0 or None for each leaf of the parameters."""

    residual: Callable[[Any, Any], Any]
    structure: Any
    axes: tuple[int | None, ...]

    def __call__(self, x: Array, parameters: Any) -> Array:
        def one(value, *leaves):
            return self.residual(value, jax.tree.unflatten(self.structure, leaves))

        return jax.vmap(one, in_axes=(0, *self.axes))(x, *jax.tree.leaves(parameters))


@_implicit_root.def_impl
def _evaluate(root, *leaves, residual, structure, pair):
    del leaves, residual, structure, pair
    return root


@_implicit_root.def_abstract_eval
def _shape(root, *leaves, residual, structure, pair):
    del leaves, residual, structure, pair
    return root


def _lower(context, root, *leaves, residual, structure, pair):
    del context, leaves, residual, structure, pair
    return [root]


def _differentiate(primals, tangents, *, residual, structure, pair):
    """Differentiate: dx = -(df/dp dp) / (df/dx) at the root, summed over the parameters that move."""
    root, *leaves = primals
    x = _implicit_root.bind(root, *leaves, residual=residual, structure=structure, pair=pair)
    rates = {place: rate for place, rate in enumerate(tangents[1:]) if not isinstance(rate, ad.Zero)}
    if not rates:
        return x, jnp.zeros_like(x)

    def at(value, moved):
        return residual(value, jax.tree.unflatten(structure, [moved.get(i, leaf) for i, leaf in enumerate(leaves)]))

    moving = {place: leaves[place] for place in rates}
    _, shift = jax.jvp(lambda moved: at(x, moved), (moving,), (rates,))

    def along(direction):
        return jax.jvp(lambda value: at(value, moving), (x,), (direction,))[1]

    if pair:
        axes = [jnp.broadcast_to(row, x.shape) for row in jnp.eye(_PAIR, dtype=x.dtype)]
        return x, -solved_pair(list(jax.vmap(along)(jnp.stack(axes))), shift)
    slope = along(jnp.ones_like(x))
    regular = slope != 0.0
    return x, jnp.where(regular, -shift / jnp.where(regular, slope, 1.0), 0.0)


def solved_pair(columns: list[Float[Array, "... 2"]], right: Float[Array, "... 2"]) -> Float[Array, "... 2"]:
    """Return the solution of two linear equations, given the matrix's columns; 0 where the matrix is singular."""
    (a, c), (b, d), (first, second) = (jnp.moveaxis(part, -1, 0) for part in (*columns, right))
    determinant = a * d - b * c
    regular = determinant != 0.0
    solution = jnp.stack([d * first - b * second, a * second - c * first], axis=-1)
    return jnp.where(regular[..., None], solution / jnp.where(regular, determinant, 1.0)[..., None], 0.0)


def _map_over_batch(arguments, axes, *, residual, structure, pair):
    size = next(argument.shape[axis] for argument, axis in zip(arguments, axes, strict=True) if axis is not None)
    root, *leaves = (
        argument if axis is None else jnp.moveaxis(argument, axis, 0)
        for argument, axis in zip(arguments, axes, strict=True)
    )
    if axes[0] is None:
        root = jnp.broadcast_to(root, (size, *root.shape))
    mapped = _Mapped(residual, structure, tuple(None if axis is None else 0 for axis in axes[1:]))
    return _implicit_root.bind(root, *leaves, residual=mapped, structure=structure, pair=pair), 0


mlir.register_lowering(_implicit_root, _lower)
ad.primitive_jvps[_implicit_root] = _differentiate
batching.primitive_batchers[_implicit_root] = _map_over_batch


_absent = Primitive("absent")


def absent(number: Float[Array, "..."]) -> Float[Array, "..."]:
    """Return NaN in place of a number that stands for nothing, with NaN for its derivative, too.

    A plain NaN has the derivative 0, which looks like an answer. In reverse mode a number that nobody asks for gets
    0 (NaN times 0 would be NaN, and spread to what is asked for).
    """
    return _absent.bind(number)


def _nan_like(number: Array) -> Array:
    return jnp.full_like(number, jnp.nan)


_absent.def_impl(_nan_like)
_absent.def_abstract_eval(lambda number: number)
mlir.register_lowering(_absent, mlir.lower_fun(_nan_like, multiple_results=False))
batching.primitive_batchers[_absent] = lambda numbers, axes: (_absent.bind(*numbers), axes[0])
ad.deflinear2(_absent, lambda asked, _: [jnp.where(asked == 0.0, 0.0, jnp.nan)])
