"""Derivatives of a batch of tips, computed forward whatever mode asks for them; batches of batches as one batch.

What becomes of a tip depends on its own numbers only, and there are few of them: the derivatives of all results by all
numbers that move are one forward pass along each. Reverse mode then has nothing of the way itself to turn round, which
is what takes long to compile and leaves much behind in memory: a product of these derivatives is transposed. Second
derivatives are found in the same way. Inside `lax.scan` JAX may drop the rule; the function itself is differentiated.

Under `vmap` the tips of all examples are side by side: a question about all tips ("do all get along with few steps?")
stays one question, where a batch of questions would do both answers' work for every tip.
"""

from collections.abc import Callable, Hashable, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_batching import custom_vmap
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array

from afm_jax.checks import is_traced

_FEW = 4
"""Numbers of a tip up to which passes forward take less time than one in reverse mode, whatever the batch."""


def by_tangents(function: Callable[..., Any], *arguments: Any, small: bool, **settings: Hashable) -> Any:
    """Return `function(*arguments, **settings)`, with derivatives that are computed forward.

    Args:
        function: a plain function of module level that returns a pytree of arrays, a value a tip, differentiable as it
            stands.
        arguments: pytrees of arrays: numbers for all tips, or one value a tip, of which only this tip's results depend.
            At least one has an axis of tips.
        small: whether the batch is so small that forward passes along all numbers are quick; else reverse mode goes
            back through the function itself where more than a few numbers move.
        settings: what is no array.
    """
    leaves, structure = jax.tree.flatten(arguments)
    return _differentiable(_Work(function, structure, tuple(settings.items())), leaves, small=small)


class _Work(NamedTuple):
    """A function of flat arguments."""

    function: Callable[..., Any]
    structure: Any
    settings: tuple[tuple[str, Hashable], ...]

    def of(self, *leaves: Array) -> Any:
        return self.function(*jax.tree.unflatten(self.structure, leaves), **dict(self.settings))


class _Slopes(NamedTuple):
    """The results of work, and their derivatives by those leaves that move, along an axis behind the tips'."""

    work: "_Work | _Slopes"
    moving: tuple[int, ...]

    def of(self, *leaves: Array) -> Any:
        return _with_slopes(leaves, self)


def _differentiable(work: _Work | _Slopes, leaves: Sequence[Array], *, small: bool) -> Any:
    ruled = jax.custom_jvp(partial(_side_by_side, work))

    def derivative(values, tangents):
        moving = tuple(i for i, tangent in enumerate(tangents) if not isinstance(tangent, SymbolicZero))
        if not small and len(moving) > _FEW:
            given = [tangents[i] if i in moving else jnp.zeros_like(value) for i, value in enumerate(values)]
            return jax.jvp(work.of, values, tuple(given))
        results, slopes = _differentiable(_Slopes(work, moving), values, small=small)
        return results, jax.tree.map(partial(_along, tangents=[tangents[i] for i in moving]), results, slopes)

    ruled.defjvp(derivative, symbolic_zeros=True)
    return ruled(*leaves)


def _along(result: Array, slopes: Array, tangents: Sequence[Array]) -> Any:
    """Return the tangent of a result; numbers for all tips in one product, whose transpose adds up before it parts."""
    if not _is_real(result):
        return np.zeros(result.shape, jax.dtypes.float0)
    shared = [place for place, tangent in enumerate(tangents) if not tangent.ndim]
    total = jnp.zeros_like(result)
    for place, tangent in enumerate(tangents):
        if tangent.ndim:
            total = total + slopes[:, place] * tangent.reshape(-1, *(1,) * (result.ndim - 1))
    if shared:
        along = jnp.stack([tangents[place] for place in shared])
        total = total + jnp.tensordot(along, slopes[:, np.array(shared)], axes=(0, 1))
    return total


@partial(jax.jit, static_argnames="asked")
def _with_slopes(leaves: tuple[Array, ...], asked: _Slopes) -> tuple[Any, Any]:
    def shifted(shifts):
        moved = list(leaves)
        for place, i in enumerate(asked.moving):
            moved[i] = leaves[i] + shifts[place]
        results = asked.work.of(*moved)
        return jax.tree.map(lambda part: part if _is_real(part) else jnp.zeros(part.shape), results), results

    at = jnp.zeros(len(asked.moving), jnp.result_type(*leaves))
    if len(asked.moving) > 1:
        slopes, results = jax.jacfwd(shifted, has_aux=True)(at)
    else:
        # one number needs no axis of directions
        _, slopes, results = jax.jvp(shifted, (at,), (jnp.ones_like(at),), has_aux=True)
        slopes = jax.tree.map(lambda part: part[..., None], slopes)
    return results, jax.tree.map(lambda part: jnp.moveaxis(part, -1, 1), slopes)


def _side_by_side(work: _Work | _Slopes, *leaves: Array) -> Any:
    """Return what work comes to, on all tips of all examples at once under `vmap`."""
    if not any(is_traced(leaf) for leaf in leaves):
        return work.of(*leaves)

    def all_examples(size, batched, *leaves):
        if not any(batched):
            # asked by derivatives of `custom_vmap` itself: one place, several directions
            results = work.of(*leaves)
            return results, jax.tree.map(lambda _: False, results)
        tips = max(leaf.shape[-1] for leaf, has in zip(leaves, batched, strict=True) if leaf.ndim > has)

        def merged(leaf, has):
            if leaf.ndim == has == 0:
                return leaf
            rows = leaf if has else leaf[None]
            return jnp.broadcast_to(rows if rows.ndim > 1 else rows[:, None], (size, tips)).ravel()

        results = _side_by_side(work, *(merged(leaf, has) for leaf, has in zip(leaves, batched, strict=True)))
        parted = jax.tree.map(lambda part: part.reshape(size, tips, *part.shape[1:]), results)
        return parted, jax.tree.map(lambda _: True, parted)

    mapped = custom_vmap(work.of)
    mapped.def_vmap(all_examples)
    return mapped(*leaves)


def _is_real(part: Array) -> bool:
    return jnp.issubdtype(part.dtype, jnp.floating)
