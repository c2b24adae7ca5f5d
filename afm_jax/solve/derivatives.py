"""Derivatives that need care: of a root, of the largest value, of a number that is absent, and of a batch of tips.

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
from jax.custom_batching import custom_vmap
from jax.custom_derivatives import SymbolicZero
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir
from jaxtyping import Array, Float

from afm_jax.checks import is_traced
from afm_jax.solve.lanes import again_for_the_open, compiled_quickly

_implicit_root = Primitive("implicit_root")


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
    return _implicit_root.bind(root, *leaves, residual=residual, structure=structure, system=False)


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
    return _implicit_root.bind(root, *leaves, residual=residual, structure=structure, system=True)


def implicit_step(
    residual: Callable[[Float[Array, " n"], Any], Float[Array, " rows"]],
    root: Float[Array, " n"],
    parameters: Any,
    slopes: Float[Array, "rows n"],
) -> tuple[Float[Array, " n"], Float[Array, " more"]]:
    """Attach the first implicit derivative to a root, as `implicit_system` does, with slopes from the search itself.

    Args:
        residual: f(x, parameters) and, below these n equations, more functions g(x, parameters).
        root: the value of x that the search found; its own derivative is ignored.
        parameters: pytree of arrays, of what the root depends on.
        slopes: derivatives of f and g by x at the root, held constant: there are no second derivatives.

    Returns:
        The root x(p), and g(x(p), p).
    """
    root = lax.stop_gradient(root)
    value, count = residual(root, parameters), root.shape[0]
    # a step of Newton's method for what changes
    step = -solved_columns(list(slopes[:count].T), (value - lax.stop_gradient(value))[:count])
    # a product and a sum: under vmap a matrix product of this size costs ten times as much
    return root + step, value[count:] + jnp.sum(slopes[count:] * step, axis=-1)


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
def _evaluate(root, *leaves, residual, structure, system):
    del leaves, residual, structure, system
    return root


@_implicit_root.def_abstract_eval
def _shape(root, *leaves, residual, structure, system):
    del leaves, residual, structure, system
    return root


def _lower(context, root, *leaves, residual, structure, system):
    del context, leaves, residual, structure, system
    return [root]


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
    """Return the solution of n linear equations, given the matrix's columns; of two equations as `solved_pair`."""
    if len(columns) == 2:
        return solved_pair(columns, right)
    return jnp.linalg.solve(jnp.stack(columns, axis=-1), right[..., None])[..., 0]


def solved_pair(columns: list[Float[Array, "... 2"]], right: Float[Array, "... 2"]) -> Float[Array, "... 2"]:
    """Return the solution of two linear equations, given the matrix's columns; 0 where the matrix is singular."""
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
    mapped = _Mapped(residual, structure, tuple(None if axis is None else 0 for axis in axes[1:]))
    return _implicit_root.bind(root, *leaves, residual=mapped, structure=structure, system=system), 0


mlir.register_lowering(_implicit_root, _lower)
ad.primitive_jvps[_implicit_root] = _differentiate
batching.primitive_batchers[_implicit_root] = _map_over_batch


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


def bracketed_root(function: Callable[[float], float], low: float, high: float, *, tolerance: float) -> float:
    """Return where a continuous function is 0 between two numbers, in either order.

    Args:
        function: from a number to a number.
        low: one end of the bracket.
        high: the other end; the function has the other sign there.
        tolerance: absolute, of the root.

    Raises:
        ValueError: if the function has one sign at both ends, or is NaN on the way.
    """
    from scipy.optimize import brentq  # noqa: PLC0415 (half a second, seldom needed)

    return float(np.asarray(brentq(function, low, high, xtol=tolerance)))


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


_FORWARD_BY = 4
"""Numbers of a tip up to which passes forward take less time than one in reverse mode, whatever the batch."""


def by_tangents(
    function: Callable[..., Any],
    *arguments: Any,
    small: bool,
    many_steps: Callable[..., Any] | None = None,
    **settings: Hashable,
) -> Any:
    """Return `function(*arguments, **settings)`, with derivatives that are computed forward.

    Args:
        function: a plain function of module level that returns a pytree of arrays, a value a tip, differentiable as it
            stands.
        arguments: pytrees of arrays: numbers for all tips, or one value for each tip, which only its own results use.
            At least one has an axis of tips.
        small: whether the batch is so small that forward passes along all numbers are quick; else reverse mode goes
            back through the function itself where more than a few numbers move.
        many_steps: the function for hard tips; `function` then returns with its results for which tips they hold, and
            the others are computed again.
        settings: what is no array.
    """
    leaves, structure = jax.tree.flatten(arguments)
    return _differentiable(_Work(function, many_steps, structure, tuple(settings.items())), leaves, small=small)


class _Work(NamedTuple):
    """A function of flat arguments, which can be compared: equal work shares compiled programs."""

    function: Callable[..., Any]
    many_steps: Callable[..., Any] | None
    structure: Any
    settings: tuple[tuple[str, Hashable], ...]

    def of(self, *leaves: Array) -> Any:
        found = self.function(*jax.tree.unflatten(self.structure, leaves), **dict(self.settings))
        if self.many_steps is None:
            return found
        return again_for_the_open(self.hard.of, found[1], leaves, found[0])

    @property
    def hard(self) -> "_Work":
        """The work for hard tips."""
        return self._replace(function=self.many_steps, many_steps=None)


class _Slopes(NamedTuple):
    """Work that gives results and their derivatives by the leaves that move, along an axis behind the tips'."""

    work: "_Work | _Slopes"
    moving: tuple[int, ...]

    def of(self, *leaves: Array) -> Any:
        work = self.work
        if isinstance(work, _Slopes) or work.many_steps is None or any(map(is_traced, leaves)):
            return _with_slopes(leaves, self)
        # by themselves: the second program is made only where a tip needs it
        (results, enough), (slopes, _) = _with_slopes(leaves, self._replace(work=work._replace(many_steps=None)))
        hard = self._replace(work=work.hard)
        return again_for_the_open(lambda *some: _with_slopes(some, hard), enough, leaves, (results, slopes))


def _differentiable(work: _Work | _Slopes, leaves: Sequence[Array], *, small: bool) -> Any:
    """Return the results of work, whose derivative is the product of `_Slopes` with the tangents."""
    ruled = jax.custom_jvp(partial(_side_by_side, work))

    def derivative(values, tangents):
        moving = tuple(i for i, tangent in enumerate(tangents) if not isinstance(tangent, SymbolicZero))
        if not small and len(moving) > _FORWARD_BY:
            given = [tangents[i] if i in moving else jnp.zeros_like(value) for i, value in enumerate(values)]
            return jax.jvp(work.of, values, tuple(given))
        results, slopes = _differentiable(_Slopes(work, moving), values, small=small)
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


@compiled_quickly(static_argnames="asked")
def _with_slopes(leaves: tuple[Array, ...], asked: _Slopes) -> tuple[Any, Any]:
    """Return results and derivatives: the derivatives by shifts, at 0, that all tips' numbers have in common."""

    def shifted(shifts):
        moved = list(leaves)
        for place, i in enumerate(asked.moving):
            moved[i] = leaves[i] + shifts[place]
        results = asked.work.of(*moved)
        return jax.tree.map(lambda part: part if _is_real(part) else jnp.zeros(part.shape), results), results

    at = jnp.zeros(len(asked.moving), jnp.result_type(*leaves))
    slopes, results = jax.jacfwd(shifted, has_aux=True)(at)
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
