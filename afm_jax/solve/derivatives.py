"""Derivatives that need care: of a root, of the largest value, of a number that is absent, and of a batch of tips.

Takes functions of arrays in whatever units; gives their results with derivatives.

A root x(p) of f(x, p) = 0 that some search (such as `halved`) has found obeys dx/dp = -(df/dp)/(df/dx). The rule calls
itself for the root it differentiates at, so that second derivatives (forward over reverse, Hessians) are right as well;
a Newton step behind `stop_gradient` would give wrong Hessians. So would `jax.custom_jvp` as soon as the root is found
inside `lax.scan`: reverse mode evaluates a loop's body partially to move what does not change out of the loop, and
drops custom rules on the way (jax 0.10.1). A primitive keeps its rule.

`by_tangents` is for a batch of tips each of which depends on its own few numbers. With n of them, n forward passes give
the matrix of a tip's derivatives; the derivative of the batch is the product of these matrices with the tangents, and
reverse mode transposes that product. So reverse mode never turns round the function itself, which would take long to
compile and leave much behind in memory. Second derivatives are those of the matrices, found in this way again. Under
`vmap` the tips of all examples are laid side by side as one batch: a question about all tips ("are few steps enough for
all?") stays one question, where a batch of questions would do both answers' work for every tip. Inside `lax.scan` JAX
may drop the rule; the function itself is then differentiated.
"""

from collections.abc import Callable, Hashable, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.ad_checkpoint import checkpoint_name
from jax.custom_batching import custom_vmap
from jax.custom_derivatives import SymbolicZero
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir
from jaxtyping import Array, Float

from afm_jax.checks import is_traced
from afm_jax.solve.lanes import again_for_the_open, compiled_quickly

_implicit_root = Primitive("implicit_root")
_FOUND = "found"


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
    return _implicit_root.bind(kept(root), *leaves, residual=residual, structure=structure, system=False)


def implicit_system(
    residual: Callable[[Float[Array, " n"], Any], Float[Array, " n"]], root: Float[Array, " n"], parameters: Any
) -> Float[Array, " n"]:
    """Attach the implicit derivative dx/dp = -(df/dx)^-1 df/dp to a root of n equations in n unknowns.

    Args:
        residual: f(x, parameters), smooth near the root; a plain function, the same object at every call.
        root: the value of x that the search found; its own derivative is ignored.
        parameters: pytree of arrays, of what the root depends on.

    Returns:
        `root`, differentiable with respect to `parameters`. Of two equations the derivative is 0 where df/dx is
        singular, of more it is not finite there.
    """
    leaves, structure = jax.tree.flatten(parameters)
    return _implicit_root.bind(kept(root), *leaves, residual=residual, structure=structure, system=True)


def _differentiate(primals, tangents, *, residual, structure, system):
    """Differentiate: dx = -(df/dp dp) / (df/dx) at the root, summed over the parameters that move."""
    root, *leaves = primals
    x = _implicit_root.bind(root, *leaves, residual=residual, structure=structure, system=system)
    rates = {place: rate for place, rate in enumerate(tangents[1:]) if not isinstance(rate, ad.Zero)}
    if not rates:
        return x, jnp.zeros_like(x)

    def at(value, moved):
        return residual(value, jax.tree.unflatten(structure, [moved.get(i, leaf) for i, leaf in enumerate(leaves)]))

    moving = {place: leaves[place] for place in rates}
    _, shift = jax.jvp(lambda moved: at(x, moved), (moving,), (rates,))

    def along(direction):
        return jax.jvp(lambda value: at(value, moving), (x,), (direction,))[1]

    if system:
        axes = [jnp.broadcast_to(row, x.shape) for row in jnp.eye(x.shape[-1], dtype=x.dtype)]
        return x, -solved_columns(list(jax.vmap(along)(jnp.stack(axes))), shift)
    slope = along(jnp.ones_like(x))
    regular = slope != 0.0
    return x, jnp.where(regular, -shift / jnp.where(regular, slope, 1.0), 0.0)


def solved_columns(columns: list[Float[Array, "... n"]], right: Float[Array, "... n"]) -> Float[Array, "... n"]:
    """Return the solution of n linear equations, given the matrix's columns; 0 where that of two is singular."""
    if len(columns) != 2:
        return jnp.linalg.solve(jnp.stack(columns, axis=-1), right[..., None])[..., 0]
    (a, c), (b, d), (first, second) = (jnp.moveaxis(part, -1, 0) for part in (*columns, right))
    determinant = a * d - b * c
    regular = determinant != 0.0
    solution = jnp.stack([d * first - b * second, a * second - c * first], axis=-1)
    return jnp.where(regular[..., None], solution / jnp.where(regular, determinant, 1.0)[..., None], 0.0)


def _map_over_batch(arguments, axes, *, residual, structure, system):
    size = next(argument.shape[axis] for argument, axis in zip(arguments, axes, strict=True) if axis is not None)
    root, *leaves = (
        argument if axis is None else jnp.moveaxis(argument, axis, 0)
        for argument, axis in zip(arguments, axes, strict=True)
    )
    if axes[0] is None:
        root = jnp.broadcast_to(root, (size, *root.shape))

    def mapped(x, parameters):
        def of_row(value, *leaves):
            return residual(value, jax.tree.unflatten(structure, leaves))

        in_axes = 0, *(None if axis is None else 0 for axis in axes[1:])
        return jax.vmap(of_row, in_axes=in_axes)(x, *jax.tree.leaves(parameters))

    return _implicit_root.bind(root, *leaves, residual=mapped, structure=structure, system=system), 0


_implicit_root.def_impl(lambda root, *_, **__: root)
_implicit_root.def_abstract_eval(lambda root, *_, **__: root)
mlir.register_lowering(_implicit_root, lambda _, root, *__, **___: [root])
ad.primitive_jvps[_implicit_root] = _differentiate
batching.primitive_batchers[_implicit_root] = _map_over_batch


def kept(found: Array) -> Array:
    """Return what a search has found, marked to be kept where reverse mode computes work again (`recomputed`)."""
    return checkpoint_name(found, _FOUND)


def recomputed(work: Callable[..., Any]) -> Callable[..., Any]:
    """Return work that reverse mode computes again, from its arguments and what its searches found (`kept`).

    Of the impact map, 1,000 tips side by side, a gradient takes 0.15 us an impact in place of 0.41: what lies between
    is computed anew in less time than it is written to memory and read.
    """
    return jax.checkpoint(work, prevent_cse=False, policy=jax.checkpoint_policies.save_only_these_names(_FOUND))


def halved(
    holds: Callable[[Array], Array], low: Float[Array, ""], high: Float[Array, ""], *, rounds: int = 50
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Return the ends of an interval in which a condition ceases to hold, halved again and again; without derivative.

    Args:
        holds: the condition, taken to hold at the low end and not at the high one.
        low: one end, which may be the larger number.
        high: the other end.
        rounds: how often the interval is halved.
    """

    def halve(_: Any, ends: tuple[Array, Array]) -> tuple[Array, Array]:
        middle = 0.5 * (ends[0] + ends[1])
        held = holds(middle)
        return jnp.where(held, middle, ends[0]), jnp.where(held, ends[1], middle)

    return lax.fori_loop(0, rounds, halve, (low, high))


def slope_of(function: Callable[[Array], Array], at: Float[Array, "..."]) -> Float[Array, "..."]:
    """Return the derivative of an elementwise function, by automatic differentiation."""
    return jax.jvp(function, (at,), (jnp.ones_like(at),))[1]


def value_and_slopes(function: Callable[[Array], Array], at: Float[Array, " n"]) -> tuple[Array, Array]:
    """Return the value of a function of some numbers, and its derivatives by each, which come last."""
    slopes, value = jax.jacfwd(lambda at: (function(at),) * 2, has_aux=True)(at)
    return value, slopes


def largest(values: Float[Array, " n"]) -> Float[Array, ""]:
    """Return the largest of some values, with the derivative of that one.

    `jnp.max` compares the values with their maximum in its derivative, and is NaN (0/0) where a compiler has computed
    the values twice, rounded differently, so that none of them is the maximum.
    """
    return values[jnp.argmax(values)]


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


def by_tangents(
    function: Callable[..., tuple[Any, Array]], *arguments: Any, small: bool, settings: tuple[Hashable, ...]
) -> Any:
    """Return the results of a function of tips, with derivatives that are computed forward.

    Args:
        function: a plain function of module level that takes the arguments and a setting, and returns a pytree of
            arrays, a value a tip, differentiable as it stands, and for which tips these hold.
        arguments: pytrees of arrays: numbers for all tips, or one value for each tip, which only its own results use.
            At least one has an axis of tips.
        small: whether the batch is so small that forward passes along all numbers are quick; else reverse mode goes
            back through the function itself where more than a few numbers move.
        settings: tips whose results with one of them do not hold are computed again with the next.
    """
    leaves, structure = jax.tree.flatten(arguments)
    return _differentiable(_Work(function, structure, settings), leaves, small=small)


class _Work(NamedTuple):
    """A function of flat arguments and its derivatives, which can be compared: equal work shares compiled programs."""

    function: Callable[..., tuple[Any, Array]]
    structure: Any
    settings: tuple[Hashable, ...]
    moving: tuple[tuple[int, ...], ...] = ()
    """For each derivative, one of the other, the leaves that it is by."""

    def of(self, *leaves: Array) -> Any:
        """Return the results, with the derivatives beside them, if any, along an axis behind the tips'."""
        results, holds = _with_slopes(leaves, self) if self.moving else self.once(*leaves)
        if len(self.settings) == 1:
            return results
        return again_for_the_open(self._replace(settings=self.settings[1:]).of, holds, leaves, results)

    def once(self, *leaves: Array) -> tuple[Any, Array]:
        """Return the results by the first setting, and for which tips they hold."""
        if not self.moving:
            return self.function(*jax.tree.unflatten(self.structure, leaves), self.settings[0])
        moving, inner = self.moving[-1], self._replace(moving=self.moving[:-1])

        def shifted(shifts):
            moved = list(leaves)
            for place, i in enumerate(moving):
                moved[i] = leaves[i] + shifts[place]
            results, holds = inner.once(*moved)
            real = jax.tree.map(lambda part: part if _is_real(part) else jnp.zeros(part.shape), results)
            return real, (results, holds)

        # by shifts, at 0, that all tips' numbers have in common
        at = jnp.zeros(len(moving), jnp.result_type(*leaves))
        slopes, (results, holds) = jax.jacfwd(shifted, has_aux=True)(at)
        return (results, jax.tree.map(lambda part: jnp.moveaxis(part, -1, 1), slopes)), holds


@compiled_quickly(static_argnames="work")
def _with_slopes(leaves: tuple[Array, ...], work: _Work) -> tuple[Any, Array]:
    return work.once(*leaves)


def _differentiable(work: _Work, leaves: Sequence[Array], *, small: bool) -> Any:
    """Return the results of work, whose derivative is the product of one derivative more with the tangents."""
    ruled = jax.custom_jvp(partial(_side_by_side, work))

    def derivative(values, tangents):
        moving = tuple(i for i, tangent in enumerate(tangents) if not isinstance(tangent, SymbolicZero))
        # up to so many, passes forward take less time than one in reverse mode, whatever the batch
        if not small and len(moving) > 4:
            given = [tangents[i] if i in moving else jnp.zeros_like(value) for i, value in enumerate(values)]
            return jax.jvp(work.of, values, tuple(given))
        more = work._replace(moving=(*work.moving, moving))
        results, slopes = _differentiable(more, values, small=small)
        return results, jax.tree.map(partial(_along, tangents=[tangents[i] for i in moving]), results, slopes)

    ruled.defjvp(derivative, symbolic_zeros=True)
    return ruled(*leaves)


def _along(result: Array, slopes: Array, tangents: Sequence[Array]) -> Any:
    """Return the tangent of a result, from the slopes by each number and the numbers' tangents."""
    if not _is_real(result):
        return np.zeros(result.shape, jax.dtypes.float0)
    total = jnp.zeros_like(result)
    for place, tangent in enumerate(tangents):
        along = tangent.reshape(-1, *(1,) * (result.ndim - 1)) if tangent.ndim else tangent
        total = total + slopes[:, place] * along
    return total


def _side_by_side(work: _Work, *leaves: Array) -> Any:
    """Return what work comes to, on all tips of all examples at once under `vmap`."""
    if not any(map(is_traced, leaves)):
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
