"""Time of a compiled JAX function: compilation apart, several repetitions, the best and the median of them."""

import statistics
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax

_SHORTEST_REPETITION_S = 0.02
"""A repetition calls the function so often that the clock's resolution and the first call's hiccups do not matter."""


class Timing(NamedTuple):
    """Seconds: to compile, and per call the best and the median of the repetitions."""

    compile_s: float
    best_s: float
    median_s: float


class Compiled(NamedTuple):
    """A function compiled for one kind of arguments, and the seconds that took."""

    run: Callable[..., Any]
    seconds: float


def compiled_for(function: Callable[..., Any], *arguments: Any) -> Compiled:
    """Compile a function for arguments of these shapes and types."""
    began = time.perf_counter()
    run = jax.jit(function).lower(*arguments).compile()
    return Compiled(run, time.perf_counter() - began)


def time_compiled(compiled: Compiled, *arguments: Any, repetitions: int) -> tuple[Timing, Any]:
    """Run a compiled function, and return the times and what it computed."""
    result = jax.block_until_ready(compiled.run(*arguments))
    calls = 1 + int(_SHORTEST_REPETITION_S / _seconds(compiled, arguments, 1))
    seconds = [_seconds(compiled, arguments, calls) for _ in range(repetitions)]
    return Timing(compiled.seconds, min(seconds), statistics.median(seconds)), result


def _seconds(compiled: Compiled, arguments: tuple[Any, ...], calls: int) -> float:
    began = time.perf_counter()
    for _ in range(calls):
        jax.block_until_ready(compiled.run(*arguments))
    return (time.perf_counter() - began) / calls
