"""Batches of tips as an axis of every array, rather than a batch of programs.

One Runge-Kutta step of a thousand tips costs half as much when its state has an axis of a thousand as when a thousand
steps are batched by `vmap`; and what only a few tips need can be gathered into a small batch of its own. The functions
here keep the interface of `vmap`: under it, work written for arrays of any shape sees the whole batch at once. Forward
derivatives pass through; reverse ones do not.
"""

from collections.abc import Callable, Sequence
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

    def called(*arguments):
        leaves, tree = jax.tree.flatten(arguments)

        def of_leaves(*leaves):
            return work(*jax.tree.unflatten(tree, leaves))

        # `custom_vmap` sees flat arrays: its derivatives stumble over a None in a tree. In its rules it must not be
        # called again: a batch of derivatives at one point comes as a batch without a batched argument.
        flat = custom_vmap(of_leaves)

        @flat.def_vmap
        def batched(size, flags, *leaves):
            if not any(flags):
                results = of_leaves(*leaves)
                return results, jax.tree.map(lambda _: False, results)
            shape, aligned = _lined_up(size, flags, leaves)
            results = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, shape), of_leaves(*aligned))
            return results, jax.tree.map(lambda _: True, results)

        return flat(*leaves)

    return called


def for_the_few(
    work: Callable[..., Any], needed: Callable[..., Any], *, changed: int, common: int
) -> Callable[..., Any]:
    """Return elementwise `work` in a form that costs a batch what the tips that need it cost.

    Args:
        work: a function of arrays that returns its argument number `changed`, changed where `needed`.
        needed: says of the same arguments, the common ones left out, whether a tip needs the work.
        changed: the number of that argument.
        common: the number of leading arguments that are passed on to `work` alone.

    Returns:
        A function like `work`.
    """

    def called(*arguments):
        leaves, tree = jax.tree.flatten(arguments)
        before = len(jax.tree.leaves(arguments[:changed]))
        of_changed = slice(before, before + len(jax.tree.leaves(arguments[changed])))

        def of_leaves(*leaves):
            return tuple(jax.tree.leaves(work(*jax.tree.unflatten(tree, leaves))))

        flat = custom_vmap(of_leaves)

        @flat.def_vmap
        def gathered(size, flags, *leaves):
            if not any(flags):
                results = of_leaves(*leaves)
                return results, (False,) * len(results)
            if max(leaf.ndim + (not flag) for flag, leaf in zip(flags, leaves, strict=True)) > 1:
                # a batch of batches: one after the other
                results = _one_by_one(of_leaves, size, flags, leaves)
                return results, (True,) * len(results)
            results = _few_at_once(of_leaves, lambda *now: needed(*jax.tree.unflatten(tree, now)[common:]), of_changed)(
                size, flags, leaves
            )
            return results, (True,) * len(results)

        return jax.tree.unflatten(jax.tree.structure(arguments[changed]), flat(*leaves))

    return called


def _few_at_once(work: Callable[..., Any], needed: Callable[..., Any], changed: slice) -> Callable[..., Any]:
    """Return how a batch of flat arguments is worked on: those in need, gathered in blocks."""

    def worked(size: int, flags: Sequence[bool], leaves: Sequence[Array]) -> tuple[Array, ...]:
        marks, full = [*flags], [*leaves]
        full[changed] = [jnp.broadcast_to(leaf, (size,)) for leaf in full[changed]]
        marks[changed] = [True] * len(full[changed])
        needs = jnp.broadcast_to(needed(*full), (size,))
        count, block = jnp.sum(needs), min(_BLOCK, size)
        # those in need first; beyond the last an index that is dropped
        order = jnp.where(jnp.arange(size) < count, jnp.argsort(~needs), size)
        order = jnp.concatenate([order, jnp.full((block,), size)])

        def one_block(state):
            done, values = state
            chosen = lax.dynamic_slice(order, (done,), (block,))
            now = [*full]
            now[changed] = values
            taken = [leaf.at[chosen].get(mode="clip") if mark else leaf for mark, leaf in zip(marks, now, strict=True)]
            after = work(*taken)
            values = tuple(old.at[chosen].set(new, mode="drop") for old, new in zip(values, after, strict=True))
            return done + block, values

        begin = (jnp.zeros_like(count), tuple(full[changed]))
        return lax.while_loop(lambda state: state[0] < count, one_block, begin)[1]

    return worked


def _one_by_one(work: Callable[..., Any], size: int, flags: Sequence[bool], leaves: Sequence[Array]) -> Any:
    def one(index):
        return work(*(leaf[index] if flag else leaf for flag, leaf in zip(flags, leaves, strict=True)))

    return lax.map(one, jnp.arange(size))


def _lined_up(size: int, flags: Sequence[bool], leaves: Sequence[Array]) -> tuple[tuple[int, ...], list[Array]]:
    """Return the common shape of a batch, and its arrays with the batch as first axis of that shape."""
    pairs = list(zip(flags, leaves, strict=True))
    inner = jnp.broadcast_shapes(*(leaf.shape[1:] if flag else leaf.shape for flag, leaf in pairs))
    rank = 1 + len(inner)
    aligned = [
        leaf.reshape(leaf.shape[0], *(1,) * (rank - leaf.ndim), *leaf.shape[1:]) if flag else leaf
        for flag, leaf in pairs
    ]
    return (size, *inner), aligned
