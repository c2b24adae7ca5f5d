"""Physical parameters as arrays, and the checks of their values.

Values are checked only while they are concrete; inside ``jit``, ``grad`` or ``vmap`` a parameter is traced and the
check is skipped, because a compiled program cannot raise.
"""

import collections.abc
import dataclasses
import functools
import inspect
import itertools
import os
import sys
import types
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal, TypeVar, Union, cast, get_args, get_origin

import numpy as np
from jaxtyping import Shaped


def as_parameter(value: Any) -> Any:
    """Return a parameter as a floating-point array; arrays that are floating-point already keep their precision.

    Python numbers become arrays of the default precision and never weakly typed, so that one compiled program serves
    numbers and arrays alike. None (an absent effect) stays, and so does what is no real number, which
    `check_parameter` refuses by its name.
    """
    if not isinstance(value, float) and not _is_real(value):
        # `check_parameter` names it
        return value
    import jax.numpy as jnp  # noqa: PLC0415

    array = jnp.asarray(value)
    return jnp.asarray(array, array.dtype if jnp.issubdtype(array.dtype, jnp.floating) else float)


def as_argument(value: Any) -> Any:
    """Return the argument of a formula as a floating-point array; Python numbers adapt to the parameters' precision."""
    import jax.numpy as jnp  # noqa: PLC0415

    array = jnp.asarray(value)
    return array if jnp.issubdtype(array.dtype, jnp.floating) else array * 1.0


def is_traced(value: Any) -> bool:
    """Say whether a value is an abstract one inside `jit`, `grad` or `vmap`, whose number cannot be looked at."""
    # where JAX is not loaded nothing can be traced: readers of files do without it
    jax = sys.modules.get("jax")
    return jax is not None and isinstance(value, jax.core.Tracer)


def check_parameter(name: str, value: Any, allowed: str, *, optional: bool = False) -> None:
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
    if (value is None and optional) or is_traced(value):
        return
    number = as_real(name, value)
    if not number.size:
        raise ValueError(f"`{name}` must be a number or an array of them, but holds none")
    # An infinite quality factor is a meaningful limit; every other infinity is a mistake.
    finite = ~np.isnan(number) if allowed == "above 0.5" else np.abs(number) <= _LARGEST
    must, inside = _RANGES[allowed]
    good = finite & inside(number)
    if not np.all(good):
        offender = float(number[~good].flat[0]) if number.ndim else float(number)
        if np.isfinite(offender) and abs(offender) > _LARGEST:
            must = f"be at most {_LARGEST:g} in size, so that its powers stay numbers"
        elif allowed == "positive" and 0.0 < offender < 1.0 / _LARGEST:
            must = f"be at least {1.0 / _LARGEST:g}, so that its inverse stays a number"
        raise ValueError(f"`{name}` must {must}, but is {offender:g}")


def check_scalar(name: str, value: Any, advice: str = "`jax.vmap` takes many") -> None:
    """Check that a function of one number was given one.

    Args:
        name: what the message calls it.
        value: the number; traced ones count, too.
        advice: what takes many.

    Raises:
        ValueError: if it is an array.
    """
    shape = np.shape(value)
    if shape:
        raise ValueError(f"`{name}` must be one number, but has the shape {shape}: {advice}")


def check_count(name: str, value: int, least: int = 1) -> None:
    """Check a whole number of things.

    Raises:
        ValueError: if there are too few.
    """
    if value < least:
        raise ValueError(f"`{name}` must be {least} or more, but is {value}")


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
        except (TypeError, ValueError):
            # a list of traced numbers, or of unequal length, which JAX knows better
            return isinstance(value, list | tuple)
    if dtype.kind == "O" and isinstance(value, list | tuple):
        return all(is_traced(element) or _is_real(element) for element in value)
    # JAX's own narrow numbers are of no kind that NumPy knows
    return dtype.kind in "fiu" or "float" in dtype.name


def in_a_word(value: Any) -> str:
    """Return what a value is, short enough for a message: itself where that is short, and its type."""
    shown, kind = repr(value), type(value).__name__
    if value is None:
        return shown
    return f"{shown} ({kind})" if len(shown) <= 40 and "\n" not in shown else _with_article(kind)


Function = TypeVar("Function", bound=Callable[..., Any])


def checked(function: Function) -> Function:
    """Let a public function refuse arguments of another kind than its annotations say, before it computes.

    A whole number is no true or false, a number no text and no complex number, an array one of real numbers, a class
    itself; what an annotation leaves open passes.

    Raises:
        TypeError: by the function, naming the argument, what it must be and what it is.
    """
    signature = inspect.signature(function)

    @functools.wraps(function)
    def call(*arguments: Any, **named: Any) -> Any:
        several = (inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD)
        for name, value in signature.bind(*arguments, **named).arguments.items():
            parameter = signature.parameters[name]
            if parameter.kind not in several:
                check_kind(name, value, _resolved(parameter.annotation, function))
        return function(*arguments, **named)

    return cast("Function", call)


def check_kind(name: str, value: Any, kind: Any) -> None:
    """Check that a part of an object is of the kind that an annotation says.

    Raises:
        TypeError: if not; names it.
        ValueError: if it is NaN where a number is wanted.
    """
    must = _misfit(kind, value)
    if must:
        # a text or a path may mean an object that somebody has to load
        advice = getattr(kind, "made_of_text", "") if isinstance(value, str | os.PathLike) else ""
        message = f"`{name}` must be {must}, but is {in_a_word(value)}" + f": {advice}" * bool(advice)
        raise (ValueError if _is_nan(value) else TypeError)(message)


def _resolved(annotation: Any, function: Callable[..., Any]) -> Any:
    """Return an annotation; Any where it is a text that means nothing while the program runs."""
    if not isinstance(annotation, str):
        return Any if annotation is inspect.Parameter.empty else annotation
    return getattr(inspect.getmodule(function), annotation, Any)


def _misfit(kind: Any, value: Any) -> str:
    """Return what a value must be that an annotation does not allow; nothing where it does, or leaves it open."""
    if kind is Any or isinstance(kind, TypeVar | str) or is_traced(value):
        return ""
    parts = get_args(kind)
    kind = get_origin(kind) or kind
    if kind in (Union, types.UnionType):
        # what JAX takes for a number; true, false and complex numbers are among it, but none here
        parts = tuple(part for part in parts if part in (complex, type(None))) if complex in parts else parts
        words = [_misfit(part, value) for part in parts]
        return "" if "" in words else " or ".join(dict.fromkeys(words))
    if kind is Literal:
        return "" if value in parts else f"one of {', '.join(map(repr, parts))}"
    if kind in (list, tuple, collections.abc.Sequence):
        return _misfit_of_several(kind, parts, value)
    must, fits = _SIMPLE.get(np.ndarray if hasattr(kind, "array_type") else kind, ("", None))
    if fits is not None:
        return "" if fits(value) else must
    # a named tuple may be written as a plain one
    fields = getattr(kind, "_fields", None)
    is_plain = fields is not None and isinstance(value, tuple) and len(value) == len(fields)
    return "" if is_plain or not isinstance(kind, type) or isinstance(value, kind) else _with_article(kind.__name__)


def _with_article(name: str) -> str:
    return f"{'an' if name[0] in 'AEIOUaeiou' else 'a'} {name}"


def _misfit_of_several(kind: Any, parts: tuple[Any, ...], value: Any) -> str:
    """Return what a value must be that is no list or tuple of such elements; nothing where it is."""
    if isinstance(value, str) or not (isinstance(value, collections.abc.Sequence) or is_array(value)):
        return "a list"
    is_fixed = kind is tuple and Ellipsis not in parts
    if is_fixed and len(value) != len(parts):
        return f"{len(parts)} values"
    pairs = zip(parts if is_fixed else itertools.repeat(parts[0] if parts else Any), value, strict=False)
    # a number that is none is of the right kind: what takes the list says what it must be
    inner = next((must for part, each in pairs if (must := _misfit(part, each)) and not _is_nan(each)), "")
    return f"a list, each {inner}" if inner else ""


def is_array(value: Any) -> bool:
    """Say whether a value is an array of NumPy or JAX, or one number of NumPy; neither needs to be loaded for it."""
    return hasattr(value, "dtype") and hasattr(value, "shape")


def _is_whole(value: Any) -> bool:
    return _is_real(value) and np.ndim(value) == 0 and np.asarray(value).dtype.kind in "iu"


def _is_nan(value: Any) -> bool:
    return isinstance(value, float | np.floating) and bool(np.isnan(value))


def _is_number(value: Any) -> bool:
    return _is_real(value) and np.ndim(value) == 0 and not np.isnan(value)


_SIMPLE: dict[Any, tuple[str, Callable[[Any], bool] | None]] = {
    int: ("a whole number", _is_whole),
    float: ("a real number", _is_number),
    bool: ("True or False", lambda value: isinstance(value, bool | np.bool_)),
    type(None): ("None", lambda value: value is None),
    Callable: ("a function", callable),
    str: ("a text", lambda value: isinstance(value, str)),
    os.PathLike: ("a path", lambda value: isinstance(value, os.PathLike)),
    Path: ("a path", lambda value: isinstance(value, os.PathLike)),
    complex: ("a real number or an array of them", _is_real),
    np.ndarray: ("an array of real numbers", lambda value: is_array(value) or _is_real(value)),
    dict: ("a dictionary", lambda value: isinstance(value, collections.abc.Mapping)),
    collections.abc.Mapping: ("a dictionary", lambda value: isinstance(value, collections.abc.Mapping)),
}

_LARGEST = 1e30
_RANGES: dict[str, tuple[str, Callable[[Any], Any]]] = {
    "finite": ("be a finite number", lambda number: np.full(number.shape, fill_value=True)),
    "positive": ("be positive", lambda number: number >= 1.0 / _LARGEST),
    "above 0": ("be positive", lambda number: number > 0),
    "not negative": ("not be negative", lambda number: number >= 0),
    "above 0.5": ("be above 0.5", lambda number: number > 0.5),
    "in [0, 1]": ("be in [0, 1]", lambda number: (number >= 0) & (number <= 1)),
    "between 0 and 1": ("be between 0 and 1", lambda number: (number > 0) & (number < 1)),
}
"""What a value must do, in words, and whether it does."""


def readable(self: Any) -> str:
    """Return a module with its numbers, the way it was written: for `__repr__`.

    Traced values and abstract shapes show as JAX shows them.
    """
    fields = ", ".join(f"{field.name}={_number(getattr(self, field.name))}" for field in dataclasses.fields(self))
    return f"{type(self).__name__}({fields})"


def _number(value: Any) -> str:
    if is_array(value) and not isinstance(value, np.ndarray) and not is_traced(value):
        return repr(np.asarray(value).item()) if value.ndim == 0 else np.array2string(np.asarray(value), separator=", ")
    return repr(value)


def require_float64(*models: Any) -> None:
    """Check that JAX computes in 64 bits, and that models do: scenes, contacts, results of simulations.

    Args:
        models: trees of arrays; traced ones too.

    Raises:
        RuntimeError: if JAX does not, or an array was made before it was set to; results in 32 bits are not
            trustworthy by default.
    """
    import jax  # noqa: PLC0415

    if not jax.config.read("jax_enable_x64"):
        raise RuntimeError(
            "afm_jax needs 64-bit floats: add `jax.config.update('jax_enable_x64', True)` before the first computation"
        )
    refuse_float32(*models)


def in_float64(function: Function, *, loaded: bool = False) -> Function:
    """Let a function compute in 64 bits, whatever JAX is set to.

    Args:
        function: what computes.
        loaded: only where JAX is loaded: what does not load it needs none.
    """

    @functools.wraps(function)
    def call(*arguments: Any, **named: Any) -> Any:
        if loaded and "jax" not in sys.modules:
            return function(*arguments, **named)
        import jax  # noqa: PLC0415

        with jax.enable_x64(new_val=True):
            return function(*arguments, **named)

    return cast("Function", call)


def refuse_float32(*models: Any) -> None:
    """Check that models hold 64-bit floats, where JAX computes in them.

    Raises:
        RuntimeError: if one was made before JAX was set to 64 bits, or of narrower numbers.
    """
    import jax  # noqa: PLC0415

    if not jax.config.read("jax_enable_x64"):
        return
    for model in models:
        for path, leaf in jax.tree_util.tree_leaves_with_path(model):
            if str(getattr(leaf, "dtype", "")) in _NARROW:
                kind = type(model).__name__
                raise RuntimeError(
                    f"{kind}{jax.tree_util.keystr(path)} is a 32-bit float: build the {kind.lower()} after "
                    "`jax.config.update('jax_enable_x64', True)`, from 64-bit numbers"
                )


_NARROW = {"float16", "bfloat16", "float32"}
