"""Batches of lanes (one tip, orbit or scene each): in blocks of one size, and the few hard lanes again.

Takes work and trees of arrays with an axis of lanes, in whatever units; gives the trees of results.

Blocks keep memory flat and the processor's cache in use, and one compiled program serves batches of every size: what is
missing in the last block is filled up with copies of the last lane, whose results are dropped.

A batch costs what its hardest lane costs where all lanes take the same steps. So all lanes take few, and those that
need more are gathered into small blocks of their own, where no others wait for them.
"""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache, partial, wraps
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.custom_batching import custom_vmap
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, Bool

from afm_jax.checks import is_traced
from afm_jax.compilation_cache import available_cores, quick_options, wide_vectors

LANES = 512
"""Lanes of a block that stay in the processor's cache; from 300 to 1000 differ little."""
WIDTHS = (1, 16, 128, LANES)
"""Sizes of blocks: few, so that few programs are compiled."""
Report = Callable[[int, int], object]
"""Called with how many of how many lanes are done."""


def filled(values: Any, size: int) -> Any:
    """Return a NumPy or JAX array whose first axis is filled up to a size with copies of its last row."""
    if len(values) == size:
        return values
    pad = np.pad if isinstance(values, np.ndarray) else jnp.pad
    return pad(values, ((0, size - len(values)),) + ((0, 0),) * (values.ndim - 1), mode="edge")


def power_of_two(count: int, least: int = 1) -> int:
    """Return the power of two that holds so many lanes, and at least `least`: few sizes, so few programs."""
    return max(least, 1 << max(count - 1, 0).bit_length())


def in_blocks(
    work: Callable[[Any], Any],
    lanes: Any,
    *,
    widths: Sequence[int] = WIDTHS,
    report: Report | None = None,
) -> Any:
    """Return the results of work on lanes as NumPy arrays, done block by block on all cores.

    The first block is done alone, so that programs are compiled once.

    Args:
        work: takes a tree of JAX arrays with a leading axis of lanes, gives one of arrays with the same axis.
        lanes: the tree of all lanes, at least one.
        widths: lanes of a block, in ascending order: the first that holds all lanes, or the last.
        report: called with how far it is, from the second block on.
    """
    count = len(jax.tree.leaves(lanes)[0])
    width = next((width for width in widths if width >= count), widths[-1])
    whole = jax.tree.map(np.asarray, lanes)

    def part(first: int) -> Any:
        def cut(leaf: np.ndarray) -> np.ndarray:
            return filled(leaf[first : first + width], width)

        # a worker has JAX's usual precision, whatever its caller has said
        with jax.enable_x64(True):  # noqa: FBT003
            # all at once: array by array takes ten times as long
            return jax.tree.map(np.asarray, work(jax.device_put(jax.tree.map(cut, whole))))

    firsts = range(0, count, width)
    done = [part(0)]
    if len(firsts) > 1:
        with ThreadPoolExecutor(available_cores()) as pool:
            for result in pool.map(part, firsts[1:]):
                done.append(result)
                if report is not None:
                    report(min(len(done) * width, count), count)
    return jax.tree.map(lambda *parts: np.concatenate(parts)[:count], *done)


def compiled_quickly(
    *, static_argnames: str | Sequence[str] = (), level: int = 1
) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Return a decorator like `jax.jit` for the beginning of a program that takes longer to compile than to run.

    Inside of another program the function is compiled as that one is.

    Args:
        static_argnames: as of `jax.jit`.
        level: of `quick_options`: 0 for what runs once or twice.
    """

    def decorated(function: Callable[..., Any]) -> Callable[..., Any]:
        jitted = partial(jax.jit, function, static_argnames=static_argnames)
        # the compiler's options are known once JAX has started
        inside, outside = jitted(), cache(lambda: jitted(compiler_options=quick_options(level)))
        # batches by `vmap` run long: compiled whole, with vectors of full width
        batched = cache(lambda: jitted(compiler_options=wide_vectors()))

        @wraps(function)
        def called(*arguments: Any, **named: Any) -> Any:
            tracers = [leaf for leaf in jax.tree.leaves((arguments, named)) if is_traced(leaf)]
            # inside a program everything is traced, also what is made of known numbers
            if is_traced(jnp.asarray(0.0)) or any(is_traced(getattr(each, "val", each)) for each in tracers):
                return inside(*arguments, **named)
            return (batched() if tracers else outside())(*arguments, **named)

        vars(called)["outside"] = outside
        return called

    return decorated


def map_in_blocks(work: Callable[[Any], Any], lanes: Any, *, block: int, recompute: bool = False) -> Any:
    """Return the results of work on lanes inside a compiled program, one block after the other.

    Args:
        work: takes a tree of arrays with a leading axis of lanes, gives one of arrays with the same axis.
        lanes: the tree of all lanes.
        block: lanes of a block at most; all blocks have one size.
        recompute: whether derivatives in reverse mode compute a block again instead of keeping what it leaves behind.
    """
    size = jax.tree.leaves(lanes)[0].shape[0]
    if size <= block:
        return work(lanes)
    blocks = -(-size // block)
    width = -(-size // blocks)

    def parted(rows):
        return filled(rows, blocks * width).reshape(blocks, width, *rows.shape[1:])

    results = lax.map(jax.checkpoint(work) if recompute else work, jax.tree.map(parted, lanes))
    return jax.tree.map(lambda part: part.reshape(blocks * width, *part.shape[2:])[:size], results)


def for_each_lane(function: Callable[..., Any], *arguments: Any) -> Any:
    """Return the results of a function of one lane, lane by lane.

    Args:
        function: written for numbers.
        arguments: trees of numbers for all lanes, and of arrays with a value a lane; without such an array there is
            one lane.
    """
    axes = jax.tree.map(lambda leaf: 0 if leaf.ndim else None, arguments)
    return jax.vmap(function, in_axes=axes)(*arguments) if jax.tree.leaves(axes) else function(*arguments)


def again_for(
    work: Callable[..., Any], needed: Bool[Array, " lanes"], arguments: tuple[Any, ...], results: Any, *, block: int
) -> Any:
    """Return results with those of work on the lanes that need it, gathered into blocks, inside a compiled program.

    Args:
        work: of a block of lanes.
        needed: which lanes.
        arguments: of the work, arrays of all lanes.
        results: of all lanes before.
        block: lanes of a gathered block.
    """
    lanes = needed.shape[0]
    width = min(block, lanes)
    # the numbers of the lanes in need, behind them as many that are no lanes: computed as copies of the last, dropped
    place = jnp.where(needed, jnp.cumsum(needed) - 1, lanes + width)
    order = jnp.full(lanes + width, lanes).at[place].set(jnp.arange(lanes), mode="drop")

    def one_block(state):
        done, found = state
        chosen = lax.dynamic_slice(order, (done,), (width,))
        new = work(*jax.tree.map(lambda leaf: leaf.at[chosen].get(mode="clip"), arguments))
        return done + width, jax.tree.map(lambda old, part: old.at[chosen].set(part, mode="drop"), found, new)

    count = jnp.sum(needed)
    return lax.while_loop(lambda state: state[0] < count, one_block, (jnp.zeros_like(count), results))[1]


def again_for_the_open(
    work: Callable[..., Any], settled: Bool[Array, " lanes"], arguments: tuple[Any, ...], results: Any
) -> Any:
    """Return results with those of work on the lanes that are not settled: work that reverse mode goes back through.

    Where the numbers can be looked at, only those lanes are computed again; inside `jit` all are, if any needs it.

    Args:
        work: of lanes, compiled.
        settled: which lanes keep their results.
        arguments: of the work: trees of numbers for all lanes, and arrays of a value a lane.
        results: of all lanes before.
    """
    if is_traced(settled):
        # recomputed in reverse mode: what long work leaves behind would not fit into memory
        again = jax.checkpoint(lambda: work(*arguments))
        slow = lax.cond(jnp.all(settled), lambda: results, again)
        return jax.tree.map(
            lambda old, new: jnp.where(settled.reshape(-1, *(1,) * (old.ndim - 1)), old, new), results, slow
        )
    open_lanes = np.flatnonzero(~np.asarray(settled))
    count = open_lanes.size
    if not count:
        return results
    chosen = np.resize(open_lanes, power_of_two(count))
    slow = work(*jax.tree.map(lambda leaf: leaf[chosen] if leaf.ndim else leaf, arguments))
    return jax.tree.map(lambda old, new: old.at[open_lanes].set(new[:count]), results, slow)


def repeat_for(
    work: Callable[..., Any], needed: Callable[..., Any], *, changed: int, passes: int, block: int
) -> Callable[..., Any]:
    """Return elementwise `work`, done again and again where `needed`; a batch costs what the lanes in need cost.

    One step of a thousand lanes costs half as much when its arrays have an axis of a thousand as when a thousand steps
    are batched by `vmap`. The function keeps the interface of `vmap`: under it, work written for arrays of any shape
    sees the lanes that need it side by side. Forward derivatives pass through; reverse ones do not.

    Args:
        work: a function of arrays that returns its argument number `changed`, changed where `needed`.
        needed: says of the same arguments whether a lane needs the work.
        changed: the number of that argument.
        passes: how often at most the work is done. Lanes that need it are gathered anew for every pass, so that those
            that need it often do not keep the others waiting.
        block: lanes of a gathered block: few where the work is long and its end uncertain, more where it is short.

    Returns:
        A function like `work`.
    """

    def called(*arguments):
        leaves, tree = jax.tree.flatten(arguments)
        before = len(jax.tree.leaves(arguments[:changed]))
        repeated = _Repeated(
            work=lambda *leaves: tuple(jax.tree.leaves(work(*jax.tree.unflatten(tree, leaves)))),
            needed=lambda *leaves: needed(*jax.tree.unflatten(tree, leaves)),
            changed=tuple(range(before, before + len(jax.tree.leaves(arguments[changed])))),
            passes=passes,
            block=block,
        )
        return jax.tree.unflatten(jax.tree.structure(arguments[changed]), repeated.done(*leaves))

    return called


class _Repeated(NamedTuple):
    """Repeated work on flat arguments, and how it is done on a batch."""

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
            values = results[: len(self.changed)]
            slopes = dict(zip(moved, results[len(self.changed) :], strict=True))
            none = [np.zeros(value.shape, jax.dtypes.float0) for value in values]
            return values, tuple(slopes.get(index, zero) for index, zero in zip(self.changed, none, strict=True))

        flat.defjvp(derivative, symbolic_zeros=True)
        return flat(*leaves)

    def _with_tangents(self, count: int, varied: list[int], moved: list[int]) -> "_Repeated":
        """Return the work on `count` values and, behind them, the tangents of those that vary."""

        def work(*leaves):
            values, given = leaves[:count], leaves[count:]

            def of_varied(*parts):
                now = dict(zip(varied, parts, strict=True))
                return self.work(*(now.get(index, value) for index, value in enumerate(values)))

            # a batch may have a value for each lane and one tangent for all, or the other way round
            pairs = [jnp.broadcast_arrays(values[i], tangent) for i, tangent in zip(varied, given, strict=True)]
            points, directions = (tuple(column) for column in zip(*pairs, strict=True))
            after, slopes = jax.jvp(of_varied, points, directions)
            return *after, *(slopes[self.changed.index(index)] for index in moved)

        return _Repeated(
            work=work,
            needed=lambda *leaves: self.needed(*leaves[:count]),
            changed=(*self.changed, *(count + varied.index(index) for index in moved)),
            passes=self.passes,
            block=self.block,
            values=count,
            value_results=len(self.changed),
        )

    def of_one(self, *leaves: Array) -> tuple[Array, ...]:
        """Return the changed arguments of one lane."""

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
            # a batch of batches: all wait for the slowest
            results = jax.vmap(self.of_one, in_axes=[0 if flag else None for flag in flags])(*leaves)
        else:
            results = self._in_need(size, flags, leaves)
        # values that do not differ stay one, whatever the tangents: several derivatives at one point
        same = self.value_results if not any(flags[: self.values]) else 0
        results = *(result[0] for result in results[:same]), *results[same:]
        return results, (False,) * same + (True,) * (len(results) - same)

    def _with(self, leaves: Sequence[Array], values: Sequence[Array]) -> list[Array]:
        now = dict(zip(self.changed, values, strict=True))
        return [now.get(index, leaf) for index, leaf in enumerate(leaves)]

    def _in_need(self, size: int, flags: Sequence[bool], leaves: Sequence[Array]) -> tuple[Array, ...]:
        """Return the changed arguments of a batch: the lanes in need, gathered anew pass after pass."""
        marks = [flag or index in self.changed for index, flag in enumerate(flags)]

        def needing(values):
            return jnp.broadcast_to(self.needed(*self._with(leaves, values)), (size,))

        def one_pass(state):
            number, values, needs = state
            now = self._with(leaves, values)

            def work(*gathered):
                rest = iter(gathered)
                return self.work(*(next(rest) if mark else leaf for mark, leaf in zip(marks, now, strict=True)))

            own = tuple(leaf for mark, leaf in zip(marks, now, strict=True) if mark)
            values = again_for(work, needs, own, values, block=self.block)
            return number + 1, values, needing(values)

        def on(state):
            return jnp.any(state[2]) & (state[0] < self.passes)

        values = tuple(jnp.broadcast_to(leaves[index], (size,)) for index in self.changed)
        return lax.while_loop(on, one_pass, (0, values, needing(values)))[1]
