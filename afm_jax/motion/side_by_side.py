"""Work that only a few tips of a batch need, gathered into small batches of their own.

One Runge-Kutta step of a thousand tips costs half as much when its arrays have an axis of a thousand as when a thousand
steps are batched by `vmap`; and most tips of a batch do not need it at a time. The function here keeps the interface of
`vmap`: under it, work written for arrays of any shape sees the tips that need it side by side. Forward derivatives pass
through; reverse ones do not.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.custom_batching import custom_vmap
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array


def for_the_few(
    work: Callable[..., Any], needed: Callable[..., Any], *, changed: int, passes: int, block: int
) -> Callable[..., Any]:
    """Return elementwise `work`, done again and again where `needed`; a batch costs what the tips in need cost.

    Args:
        work: a function of arrays that returns its argument number `changed`, changed where `needed`.
        needed: says of the same arguments whether a tip needs the work.
        changed: the number of that argument.
        passes: how often at most the work is done. Tips that need it are gathered anew for every pass, so that those
            that need it often do not keep the others waiting.
        block: tips of a gathered batch: few where the work is long and its end uncertain, more where it is short.

    Returns:
        A function like `work`.
    """

    def called(*arguments):
        leaves, tree = jax.tree.flatten(arguments)
        before = len(jax.tree.leaves(arguments[:changed]))
        few = _Few(
            work=lambda *leaves: tuple(jax.tree.leaves(work(*jax.tree.unflatten(tree, leaves)))),
            needed=lambda *leaves: needed(*jax.tree.unflatten(tree, leaves)),
            changed=tuple(range(before, before + len(jax.tree.leaves(arguments[changed])))),
            passes=passes,
            block=block,
        )
        return jax.tree.unflatten(jax.tree.structure(arguments[changed]), few.done(*leaves))

    return called


class _Few(NamedTuple):
    """Work on flat arguments, and how it is done on a batch."""

    work: Callable[..., tuple[Array, ...]]
    needed: Callable[..., Array]
    changed: tuple[int, ...]
    passes: int
    block: int
    values: int = 0
    """Of arguments that are values and, behind them, tangents: how many are values; 0 where all are."""
    value_results: int = 0

    def done(self, *leaves: Array) -> tuple[Array, ...]:
        """Return the changed arguments, with derivatives and under `vmap`.

        A derivative is work on values and tangents together: `custom_vmap` sees it as more arguments, for its own
        derivatives do not work where a value is batched and its tangent is not.
        """

        @jax.custom_jvp
        def flat(*leaves):
            # `custom_vmap` sees flat arrays, and in its rule it must not be called again
            one = custom_vmap(self.of_one)
            one.def_vmap(self.of_batch)
            return one(*leaves)

        def derivative(primals, tangents):
            known = [index for index, tangent in enumerate(tangents) if not isinstance(tangent, SymbolicZero)]
            moved = [index for index in self.changed if jnp.issubdtype(primals[index].dtype, jnp.floating)]
            varied = sorted({*known, *moved})
            given = [tangents[i] if i in known else jnp.zeros_like(primals[i]) for i in varied]
            results = self._with_tangents(len(primals), varied, moved).done(*primals, *given)
            values, slopes = results[: len(self.changed)], dict(zip(moved, results[len(self.changed) :], strict=True))
            none = [np.zeros(value.shape, jax.dtypes.float0) for value in values]
            return values, tuple(slopes.get(index, zero) for index, zero in zip(self.changed, none, strict=True))

        flat.defjvp(derivative, symbolic_zeros=True)
        return flat(*leaves)

    def _with_tangents(self, count: int, varied: list[int], moved: list[int]) -> "_Few":
        """Return the same work on `count` values and, behind them, the tangents of those that vary."""

        def work(*leaves):
            values, given = leaves[:count], leaves[count:]

            def of_varied(*parts):
                now = [*values]
                for index, part in zip(varied, parts, strict=True):
                    now[index] = part
                return self.work(*now)

            # a batch may have a value for each tip and one tangent for all, or the other way round
            pairs = [jnp.broadcast_arrays(values[i], tangent) for i, tangent in zip(varied, given, strict=True)]
            points, directions = (tuple(column) for column in zip(*pairs, strict=True))
            after, slopes = jax.jvp(of_varied, points, directions)
            return *after, *(slopes[self.changed.index(index)] for index in moved)

        return _Few(
            work=work,
            needed=lambda *leaves: self.needed(*leaves[:count]),
            changed=(*self.changed, *(count + varied.index(index) for index in moved)),
            passes=self.passes,
            block=self.block,
            values=count,
            value_results=len(self.changed),
        )

    def of_one(self, *leaves: Array) -> tuple[Array, ...]:
        """Return the changed arguments of one tip."""

        def needs(state):
            return jnp.any(self.needed(*self._with(leaves, state[1]))) & (state[0] < self.passes)

        def one_pass(state):
            return state[0] + 1, self.work(*self._with(leaves, state[1]))

        return lax.while_loop(needs, one_pass, (0, tuple(leaves[i] for i in self.changed)))[1]

    def of_batch(self, size: int, flags: Sequence[bool], *leaves: Array) -> tuple[tuple[Array, ...], Any]:
        """Return the changed arguments of a batch and that they are batched: the rule of `custom_vmap`."""
        if not any(flags):
            results = self.of_one(*leaves)
            return results, (False,) * len(results)
        if max(leaf.ndim + (not flag) for flag, leaf in zip(flags, leaves, strict=True)) > 1:
            # a batch of batches: one after the other
            results = self._one_by_one(size, flags, leaves)
        else:
            results = self._in_blocks(size, flags, leaves)
        # values that do not differ stay one, whatever the tangents: several derivatives at one point
        same = self.value_results if not any(flags[: self.values]) else 0
        results = *(result[0] for result in results[:same]), *results[same:]
        return results, (False,) * same + (True,) * (len(results) - same)

    def _with(self, leaves: Sequence[Array], values: Sequence[Array]) -> list[Array]:
        now = [*leaves]
        for index, value in zip(self.changed, values, strict=True):
            now[index] = value
        return now

    def _one_by_one(self, size: int, flags: Sequence[bool], leaves: Sequence[Array]) -> tuple[Array, ...]:
        def one(index):
            return self.of_one(*(leaf[index] if flag else leaf for flag, leaf in zip(flags, leaves, strict=True)))

        return lax.map(one, jnp.arange(size))

    def _in_blocks(self, size: int, flags: Sequence[bool], leaves: Sequence[Array]) -> tuple[Array, ...]:
        """Return the changed arguments of a batch: those in need, gathered in blocks, pass after pass."""
        values = tuple(jnp.broadcast_to(leaves[index], (size,)) for index in self.changed)
        marks = [flag or index in self.changed for index, flag in enumerate(flags)]
        block = min(self.block, size)

        def needing(values):
            return jnp.broadcast_to(self.needed(*self._with(leaves, values)), (size,))

        def one_pass(state):
            number, values, needs = state
            order, count = _those_first(needs, block)

            def one_block(state):
                done, values = state
                chosen = lax.dynamic_slice(order, (done,), (block,))
                pairs = zip(marks, self._with(leaves, values), strict=True)
                after = self.work(*(leaf.at[chosen].get(mode="clip") if mark else leaf for mark, leaf in pairs))
                values = tuple(old.at[chosen].set(new, mode="drop") for old, new in zip(values, after, strict=True))
                return done + block, values

            values = lax.while_loop(lambda state: state[0] < count, one_block, (jnp.zeros_like(count), values))[1]
            return number + 1, values, needing(values)

        def on(state):
            return jnp.any(state[2]) & (state[0] < self.passes)

        return lax.while_loop(on, one_pass, (0, values, needing(values)))[1]


def _those_first(needs: Array, block: int) -> tuple[Array, Array]:
    """Return the numbers of those in need, behind them as many that are none, and how many they are."""
    size = needs.shape[0]
    place = jnp.where(needs, jnp.cumsum(needs) - 1, size + block)
    order = jnp.full(size + block, size).at[place].set(jnp.arange(size), mode="drop")
    return order, jnp.sum(needs)
