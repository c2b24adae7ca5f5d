"""The axes of a sweep: values of parameters, evenly or logarithmically spaced, listed, random, or a Latin hypercube.

Every axis gives any stretch of its values without the others, so that an axis of a billion values takes no memory; only
the values of a list and of a Latin hypercube are held.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.stats import qmc

KINDS = ("linear", "log", "list", "random", "latin_hypercube")
_MOST_HELD = 10_000_000
"""Values of an axis that are held."""
_MOST_VALUES = 10**12
_PER_COUNT = 4
"""Random numbers that the generator makes for every step of its counter."""
_EXAMPLE = '{ parameter = "platform.reduced_frequency", linear = [0.9, 1.1, 100] }'

Stretch = Callable[[int, int], Float[np.ndarray, " n"]]
"""Values from one index to another."""


@dataclass(frozen=True)
class Axis:
    """One axis of a sweep.

    Attributes:
        dimension: its name in the results.
        size: how many values it has.
        columns: for every parameter that changes along it, its values.
        ends: for every parameter its lowest and highest possible value.
    """

    dimension: str
    size: int
    columns: Mapping[str, Stretch]
    ends: Mapping[str, tuple[float, float]]


def axes_of(given: Sequence[Mapping[str, Any]]) -> tuple[Axis, ...]:
    """Return the axes that tables describe.

    >>> axes = axes_of([{"parameter": "interaction.r", "linear": [0.5, 0.9, 5]}])
    >>> axes[0].dimension, axes[0].columns["interaction.r"](1, 3).tolist()
    ('interaction_r', [0.6, 0.7])

    Args:
        given: of each axis either `parameter` with `linear` or `log` (low, high, count) or `list` (values), or
            `random` or `latin_hypercube` (for each parameter its [low, high], or {log = [low, high]}) with `count` and
            `seed`.

    Raises:
        ValueError: if one is no such table, or a parameter changes along two of them.
    """
    if not given:
        raise ValueError(f"a sweep needs at least one axis; add [[axes]], as in {_EXAMPLE}")
    axes: list[Axis] = []
    for number, table in enumerate(given):
        samples = sum(axis.dimension.startswith("sample") for axis in axes)
        try:
            axes.append(_axis(dict(table), "sample" if samples == 0 else f"sample_{samples + 1}"))
        except (TypeError, ValueError) as error:
            raise ValueError(f"axis {number + 1}: {error}") from error
    names = [name for axis in axes for name in axis.columns]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise ValueError(f"the parameter {twice[0]} changes along two axes: leave one of them out")
    return tuple(axes)


def dimension_of(parameter: str) -> str:
    """Return the name that a parameter has in the results."""
    return parameter.replace(".", "_")


def _axis(table: dict[str, Any], sample: str) -> Axis:
    kinds = [kind for kind in KINDS if kind in table]
    if len(kinds) != 1:
        raise ValueError(f"has {' and '.join(kinds) or 'no values'}; give one of {', '.join(KINDS)}, as in {_EXAMPLE}")
    kind = kinds[0]
    known = (kind, "count", "seed") if kind in ("random", "latin_hypercube") else (kind, "parameter")
    unknown = sorted(set(table) - set(known))
    if unknown:
        raise ValueError(f"unknown key {unknown[0]}; an axis of this kind has {', '.join(known)}")
    if kind in ("random", "latin_hypercube"):
        return _samples(kind, table, sample)
    parameter = str(table.get("parameter", ""))
    if not parameter:
        raise ValueError(f"`parameter` is missing; name one, as in {_EXAMPLE}")
    values, ends, size = _listed(table[kind]) if kind == "list" else _ladder(kind, table[kind])
    return Axis(dimension_of(parameter), size, {parameter: values}, {parameter: ends})


def _listed(given: Any) -> tuple[Stretch, tuple[float, float], int]:
    if not isinstance(given, (list, tuple)):
        raise TypeError(f"`list` must be [value, ...], but is {given}")
    numbers = [_number(value, "a value of the list") for value in given]
    if not 0 < len(numbers) <= _MOST_HELD:
        raise ValueError(f"a list needs from 1 to {_MOST_HELD} values, but has {len(numbers)}")
    if len(set(numbers)) < len(numbers):
        raise ValueError("a value of the list stands there twice: leave one of them out")
    held = np.array(numbers)
    return lambda first, end: held[first:end], (min(numbers), max(numbers)), len(numbers)


def _ladder(kind: str, given: Any) -> tuple[Stretch, tuple[float, float], int]:
    if not isinstance(given, (list, tuple)) or len(given) != 3:
        raise ValueError(f"`{kind}` must be [low, high, count], but is {given}")
    low, high = (_number(end, f"an end of `{kind}`") for end in given[:2])
    count = _whole(given[2], "count", least=1)
    if not (low < high or (low == high and count == 1)):
        raise ValueError(f"`{kind}` = {list(given)} does not rise: its first end must be below its second")
    if kind == "log" and low <= 0.0:
        raise ValueError(f"the ends of `log` must be positive, but one is {low:g}")

    def values(first: int, end: int) -> np.ndarray:
        share = np.arange(first, end) / max(count - 1, 1)
        between = _between(share, low, high, log=kind == "log")
        return np.where(share == 1.0, high, between) if count > 1 else between

    return values, (low, high), count


def _samples(kind: str, table: dict[str, Any], name: str) -> Axis:
    chosen = table[kind]
    if not isinstance(chosen, Mapping) or not chosen:
        raise ValueError(f'`{kind}` must name parameters with their ends, as in {{ "interaction.r" = [0.9, 0.99] }}')
    count = _whole(table.get("count"), "count", least=1)
    seed = _whole(table.get("seed"), "seed", least=0)
    spreads = {parameter: _spread(parameter, ends) for parameter, ends in chosen.items()}
    shares = _hypercube(len(chosen), count, seed) if kind == "latin_hypercube" else _independent(len(chosen), seed)
    columns = {
        parameter: _spread_out(share, *spread)
        for share, (parameter, spread) in zip(shares, spreads.items(), strict=True)
    }
    return Axis(name, count, columns, {parameter: (low, high) for parameter, (low, high, _) in spreads.items()})


def _spread(parameter: str, given: Any) -> tuple[float, float, bool]:
    log = isinstance(given, Mapping) and list(given) == ["log"]
    ends = given["log"] if log else given
    if not isinstance(ends, (list, tuple)) or len(ends) != 2:
        raise ValueError(f"{parameter}: must be [low, high] or {{ log = [low, high] }}, but is {given}")
    low, high = (_number(end, f"an end of {parameter}") for end in ends)
    if not low < high or (log and low <= 0.0):
        raise ValueError(f"{parameter}: {list(ends)} is no rising pair{' of positive numbers' if log else ''}")
    return low, high, log


def _spread_out(share: Stretch, low: float, high: float, log: bool) -> Stretch:  # noqa: FBT001
    return lambda first, end: _between(share(first, end), low, high, log=log)


def _between(share: Float[np.ndarray, " n"], low: float, high: float, *, log: bool) -> Float[np.ndarray, " n"]:
    if log:
        return low * np.exp(share * math.log(high / low))
    return low + share * (high - low)


def _independent(number: int, seed: int) -> list[Stretch]:
    """Return independent random numbers in [0, 1), any stretch of them: the generator counts."""

    def stream(key: int) -> Stretch:
        def values(first: int, end: int) -> np.ndarray:
            generator = np.random.Philox(np.random.SeedSequence(seed, spawn_key=(key,)))
            generator.advance(first // _PER_COUNT)
            skipped = first % _PER_COUNT
            return np.random.Generator(generator).random(end - first + skipped)[skipped:]

        return values

    return [stream(key) for key in range(number)]


def _hypercube(number: int, count: int, seed: int) -> list[Stretch]:
    if count > _MOST_HELD:
        raise ValueError(f"a Latin hypercube of more than {_MOST_HELD} samples is not held; take `random`")
    whole = qmc.LatinHypercube(number, rng=np.random.default_rng(seed)).random(count).T
    return [lambda first, end, column=column: column[first:end] for column in whole]


def _number(value: Any, what: str) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
        # JSON, in which inputs are kept, has no infinity
        raise ValueError(f"{what} must be a number, but is {'not finite' if value is None else repr(value)}")
    return float(value)


def _whole(value: Any, name: str, *, least: int) -> int:
    if isinstance(value, bool) or not isinstance(value, int) or not least <= value <= _MOST_VALUES:
        raise ValueError(f"`{name}` must be a whole number from {least} on, but is {value!r}")
    return value
