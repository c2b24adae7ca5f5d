"""Batches of tips as an axis of every array, rather than a batch of programs.

One Runge-Kutta step of a thousand tips costs half as much when its state has an axis of a thousand as when a thousand
steps are batched by `vmap`; and what only a few tips need can be gathered into a small batch of its own. The functions
here keep the interface of `vmap`: under it, work written for arrays of any shape sees the whole batch at once. Forward
derivatives pass through; reverse ones do not.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jax.custom_batching import custom_vmap
from jaxtyping import Array

_BLOCK = 64
"""Tips of a gathered batch."""


def side_by_side(work: Callable[..., Any]) -> Callable[..., Any]:
    """Return elementwise `work` in a form that `vmap` calls once, with the batch as first axis of its arrays.

    Args:
        work: a function of arrays that broadcast against each other; its results have their common shape.
    """

    @custom_vmap
    def wrapped(*arguments):
        return work(*arguments)

    @wrapped.def_vmap
    def batched(size, flags, *arguments):
        flags = tuple(flags)
        rank = max(leaf.ndim + (not flag) for flag, leaf in _pairs(flags, arguments))
        shape = _common_shape(size, flags, arguments)
        aligned = jax.tree.map(lambda flag, leaf: _aligned(leaf, rank) if flag else leaf, flags, arguments)
        results = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, shape), wrapped(*aligned))
        return results, jax.tree.map(lambda _: True, results)

    return wrapped


def for_the_few(
    work: Callable[..., Any], needed: Callable[..., Any], *, changed: int, common: int
) -> Callable[..., Any]:
    """Return elementwise `work` in a form that costs a batch what the tips that need it cost.

    Args:
        work: a function of arrays that returns its argument number `changed`, changed where `needed`.
        needed: says of the same arguments whether a tip needs the work.
        changed: the number of that argument.
        common: the number of leading arguments that are passed on to `work` alone.

    Returns:
        A function like `work`.
    """

    @custom_vmap
    def wrapped(*arguments):
        return work(*arguments)

    @wrapped.def_vmap
    def gathered(size, flags, *arguments):
        flags = tuple(flags)
        rank = max(leaf.ndim + (not flag) for flag, leaf in _pairs(flags, arguments))
        if rank > 1:
            # a batch of batches: one after the other
            axes = jax.tree.map(lambda flag: 0 if flag else None, flags)
            results = _one_by_one(wrapped, size, axes, arguments)
            return results, jax.tree.map(lambda _: True, results)
        every = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (size,)), arguments[changed])
        flags = [*flags]
        flags[changed] = jax.tree.map(lambda _: True, every)
        full = [*arguments]
        full[changed] = every
        needs = jnp.broadcast_to(needed(*full[common:]), (size,))
        count, block = jnp.sum(needs), min(_BLOCK, size)
        # those in need first; beyond the last an index that is dropped
        order = jnp.where(jnp.arange(size) < count, jnp.argsort(~needs), size)
        order = jnp.concatenate([order, jnp.full((block,), size)])

        def one_block(state):
            done, values = state
            chosen = lax.dynamic_slice(order, (done,), (block,))
            now = [*full]
            now[changed] = values
            taken = jax.tree.map(
                lambda flag, leaf: leaf.at[chosen].get(mode="clip") if flag else leaf, tuple(flags), tuple(now)
            )
            after = work(*taken)
            values = jax.tree.map(lambda old, new: old.at[chosen].set(new, mode="drop"), values, after)
            return done + block, values

        _, values = lax.while_loop(lambda state: state[0] < count, one_block, (jnp.zeros_like(count), every))
        return values, jax.tree.map(lambda _: True, values)

    return wrapped


def _one_by_one(work: Callable[..., Any], size: int, axes: Any, arguments: tuple[Any, ...]) -> Any:
    def one(index):
        picked = jax.tree.map(
            lambda axis, leaf: leaf if axis is None else leaf[index],
            axes,
            arguments,
            is_leaf=lambda node: node is None,
        )
        return work(*picked)

    return lax.map(one, jnp.arange(size))


def _pairs(flags: Any, arguments: Any) -> list[tuple[bool, Array]]:
    return list(zip(jax.tree.leaves(flags), jax.tree.leaves(arguments), strict=True))


def _aligned(leaf: Array, rank: int) -> Array:
    return leaf.reshape(leaf.shape[0], *(1,) * (rank - leaf.ndim), *leaf.shape[1:])


def _common_shape(size: int, flags: Any, arguments: Any) -> tuple[int, ...]:
    inner = jnp.broadcast_shapes(*(leaf.shape[1:] if flag else leaf.shape for flag, leaf in _pairs(flags, arguments)))
    return (size, *inner)
