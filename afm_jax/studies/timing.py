"""Time of a compiled JAX function: compilation apart, several repetitions.

A measurement runs in a Python process of its own, on one core: how many cores JAX uses is settled before it computes,
and a process that has run other programs is a poor place to measure time in.
"""

import os
import signal
import sys
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from typing import Any

import jax

_SHORTEST_REPETITION_S = 0.02
"""A repetition calls the function so often that the clock's resolution and the first call's hiccups do not matter."""


def compiled_for(function: Callable[..., Any], *arguments: Any, options: dict[str, Any] | None = None) -> Any:
    """Return a function compiled for arguments of these shapes and types, with options of the compiler."""
    return jax.jit(function).lower(*arguments).compile(options)


def seconds_a_call(run: Callable[..., Any], *arguments: Any, repetitions: int) -> list[float]:
    """Return the seconds that a call of a compiled function takes in each of several repetitions."""

    def repeated(calls: int) -> float:
        began = time.perf_counter()
        for _ in range(calls):
            jax.block_until_ready(run(*arguments))
        return (time.perf_counter() - began) / calls

    # the first call is slower
    repeated(1)
    calls = 1 + int(_SHORTEST_REPETITION_S / repeated(1))
    return [repeated(calls) for _ in range(repetitions)]


def run_in_own_process(task: Callable[..., Any], **settings: Any) -> Any:
    """Run a function in a new process and return its result; the process has one core where the system can pin it.

    Args:
        task: a function at the top of a module.
        settings: its arguments.

    Raises:
        Exception: as the function does.
    """
    with ProcessPoolExecutor(1, mp_context=get_context("spawn"), initializer=_on_one_core) as pool:
        return pool.submit(task, **settings).result()


def _on_one_core() -> None:
    """Settle how a process computes."""
    # the process that waits says that there was an interrupt
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    else:
        # where nothing pins it, XLA reads that; its flags do not bring its threads down to one
        os.environ["NPROC"] = "1"
    jax.config.update("jax_platforms", "cpu")
    jax.config.update("jax_enable_x64", True)  # noqa: FBT003


def progress(message: str) -> None:
    """Write a line to standard error."""
    sys.stderr.write(f"{message}\n")
    sys.stderr.flush()
