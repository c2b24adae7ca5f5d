"""Physical parameters as arrays, and the checks of their values.

Values are checked only while they are concrete; inside ``jit``, ``grad`` or ``vmap`` a parameter is traced and the
check is skipped, because a compiled program cannot raise.
"""

import contextlib
import dataclasses
from collections.abc import Iterator
from contextvars import ContextVar
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, ArrayLike, Float, Shaped


def as_parameter(value: Any) -> Any:
    """Return a parameter as a floating-point array; arrays that are floating-point already keep their precision.

    Python numbers become arrays of the default precision and never weakly typed, so that one compiled program serves
    numbers and arrays alike. What is no real number stays as it is, for `check_parameter` to refuse by its name.
    """
    if not isinstance(value, float) and not _is_real(value):
        # `check_parameter` names it
        return value
    array = jnp.asarray(value)
    return jnp.asarray(array, array.dtype if jnp.issubdtype(array.dtype, jnp.floating) else float)


def as_argument(value: ArrayLike) -> Float[Array, "..."]:
    """Return the argument of a formula as a floating-point array; Python numbers adapt to the parameters' precision."""
    array = jnp.asarray(value)
    return array if jnp.issubdtype(array.dtype, jnp.floating) else array * 1.0


def as_optional_parameter(value: ArrayLike | None) -> Float[Array, "..."] | None:
    """Return `as_parameter(value)`, or None where the effect is absent."""
    return None if value is None else as_parameter(value)


def is_traced(value: ArrayLike) -> bool:
    """Say whether a value is an abstract one inside `jit`, `grad` or `vmap`, whose number cannot be looked at."""
    return isinstance(value, Tracer)


def check_parameter(name: str, value: ArrayLike | None, allowed: str, *, optional: bool = False) -> None:
    """Check a parameter that is a concrete number.

    Args:
        name: what the message calls it, with its unit.
        value: the number or array; traced values pass.
        allowed: "finite", "positive", "above 0" (however small), "not negative", "above 0.5", "in [0, 1]" or
            "between 0 and 1" (neither of the two).
        optional: whether None, an absent effect, passes.

    Raises:
        ValueError: if a value is not finite, not in the allowed range, beyond 1e30, or, where it must be positive,
            below 1e-30.
        TypeError: if it is no real number.
    """
    if (value is None and optional) or isinstance(value, Tracer):
        return
    number = as_real(name, value)
    # An infinite quality factor is a meaningful limit; every other infinity is a mistake.
    finite = ~np.isnan(number) if allowed == "above 0.5" else np.abs(number) <= _LARGEST
    good = finite & _RANGES[allowed](number)
    if not np.all(good):
        offender = float(number[~good].flat[0]) if number.ndim else float(number)
        must = {"finite": "be a finite number", "above 0": "be positive", "not negative": "not be negative"}.get(
            allowed, f"be {allowed}"
        )
        if np.isfinite(offender) and abs(offender) > _LARGEST:
            must = f"be at most {_LARGEST:g} in size, so that its powers stay numbers"
        elif allowed == "positive" and 0.0 < offender < 1.0 / _LARGEST:
            must = f"be at least {1.0 / _LARGEST:g}, so that its inverse stays a number"
        raise ValueError(f"`{name}` must {must}, but is {offender:g}")


def as_real(name: str, value: Any) -> Shaped[np.ndarray, "..."]:
    """Return a number or an array of numbers that a caller gave.

    Raises:
        TypeError: if it is, or holds, a text, true or false, a complex number, None or anything else that is no real
            number.
    """
    if not _is_real(value):
        raise TypeError(f"`{name}` must be a real number, but is {in_a_word(value)}")
    return np.asarray(value)


def _is_real(value: Any) -> bool:
    dtype = getattr(value, "dtype", None)
    if dtype is None:
        try:
            dtype = np.asarray(value).dtype
        except (TypeError, ValueError, jax.errors.TracerArrayConversionError):
            # a list of traced numbers, or of unequal length, which JAX knows better
            return isinstance(value, list | tuple)
    return jnp.issubdtype(dtype, jnp.floating) or jnp.issubdtype(dtype, jnp.integer)


def as_count(name: str, value: Any, *, least: int = 1) -> int:
    """Return a whole number that a caller gave.

    Raises:
        TypeError: if it is no whole number; true and false are none.
        ValueError: if it is below the least.
    """
    if isinstance(value, bool | np.bool_) or not isinstance(value, int | np.integer):
        raise TypeError(f"`{name}` must be a whole number, but is {in_a_word(value)}")
    if value < least:
        raise ValueError(f"`{name}` must be at least {least}, but is {value}")
    return int(value)


def in_a_word(value: Any) -> str:
    """Return what a value is, short enough for a message: itself where that is short, and its type."""
    shown, kind = repr(value), type(value).__name__
    if value is None:
        return shown
    return f"{shown} ({kind})" if len(shown) <= 40 and "\n" not in shown else f"a {kind}"


_LARGEST = 1e30
_RANGES = {
    "finite": lambda number: np.full(number.shape, fill_value=True),
    "positive": lambda number: number >= 1.0 / _LARGEST,
    "above 0": lambda number: number > 0,
    "not negative": lambda number: number >= 0,
    "above 0.5": lambda number: number > 0.5,
    "in [0, 1]": lambda number: (number >= 0) & (number <= 1),
    "between 0 and 1": lambda number: (number > 0) & (number < 1),
}


def readable(self: eqx.Module) -> str:
    """Return a module with its numbers, the way it was written: for `__repr__`.

    Traced values and abstract shapes show as JAX shows them.
    """
    fields = ", ".join(f"{field.name}={_number(getattr(self, field.name))}" for field in dataclasses.fields(self))
    return f"{type(self).__name__}({fields})"


def _number(value: object) -> str:
    if isinstance(value, jax.Array) and not is_traced(value):
        return repr(np.asarray(value).item()) if value.ndim == 0 else np.array2string(np.asarray(value), separator=", ")
    return repr(value)


def require_float64(*models: Any) -> None:
    """Check that JAX computes in 64 bits, and that models do: scenes, contacts, results of simulations.

    Args:
        models: trees of arrays; traced ones too.

    Raises:
        RuntimeError: if JAX does not, or an array was made before it was told to; results in 32 bits are not
            trustworthy by default.
    """
    if not jax.config.read("jax_enable_x64"):
        raise RuntimeError(
            "afm_jax needs 64-bit floats: add `jax.config.update('jax_enable_x64', True)` before the first computation"
        )
    refuse_float32(*models)


def refuse_float32(*models: Any) -> None:
    """Check that models hold 64-bit floats, where JAX computes in them.

    Raises:
        RuntimeError: if one was made before JAX was told to, or of narrower numbers.
    """
    if not jax.config.read("jax_enable_x64") or _float32_allowed.get():
        return
    for model in models:
        if any(map(_is_narrow, jax.tree.leaves(model))):
            places = jax.tree_util.tree_leaves_with_path(model)
            narrow = next(jax.tree_util.keystr(path) for path, leaf in places if _is_narrow(leaf))
            raise RuntimeError(
                f"{type(model).__name__}{narrow} is a 32-bit float: build the {type(model).__name__.lower()} after "
                "`jax.config.update('jax_enable_x64', True)`, from 64-bit numbers"
            )


@contextlib.contextmanager
def float32_allowed() -> Iterator[None]:
    """Let models of 32-bit floats pass in this block: for measurements of what is left in them."""
    token = _float32_allowed.set(True)
    try:
        yield
    finally:
        _float32_allowed.reset(token)


_float32_allowed = ContextVar("_float32_allowed", default=False)


def _is_narrow(leaf: Any) -> bool:
    return getattr(leaf, "dtype", None) in _NARROW


_NARROW = {jnp.dtype(name) for name in ("float16", "bfloat16", "float32")}
