"""Time of a compiled JAX function: compilation apart, several repetitions, the best and the median of them.

A measurement runs in a Python process of its own, on one core: how many cores JAX uses is settled before it is
imported, and a process that has run other programs is a poor place to measure time in. Settings go in as JSON on
standard input, results come back as JSON on standard output.
"""

import json
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from importlib import import_module
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


def compiled_for(function: Callable[..., Any], *arguments: Any, options: dict[str, Any] | None = None) -> Compiled:
    """Compile a function for arguments of these shapes and types, with the compiler's options."""
    began = time.perf_counter()
    run = jax.jit(function).lower(*arguments).compile(options)
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


def run_in_own_process(task: str, settings: Mapping[str, Any]) -> Any:
    """Run a function in a new process and return its result; the process has one core where the system can pin it.

    Args:
        task: "module:function"; the function takes the settings as keywords and returns what JSON can carry.
        settings: the function's arguments.

    Raises:
        ValueError: if the function refuses its settings, or the process fails; its message went to standard error.
    """
    # where nothing pins it, XLA reads that; its flags do not bring its threads down to one
    threads = {} if hasattr(os, "sched_setaffinity") else {"NPROC": "1"}
    done = subprocess.run(  # noqa: S603
        [sys.executable, "-m", "afm_jax.studies.timing", task],
        input=json.dumps(dict(settings)),
        stdout=subprocess.PIPE,
        text=True,
        check=False,
        env={**os.environ, **threads, "JAX_PLATFORMS": "cpu"},
        # an interrupt from the terminal is for the process that waits, and ends this one without a traceback of its own
        process_group=0 if os.name == "posix" else None,
    )
    if done.returncode != 0:
        raise ValueError(f"the measurement in a process of its own ended with exit code {done.returncode}")
    answer = json.loads(done.stdout.splitlines()[-1])
    if "refused" in answer:
        raise ValueError(answer["refused"])
    return answer["result"]


def progress(message: str) -> None:
    """Write a line to standard error."""
    sys.stderr.write(f"{message}\n")
    sys.stderr.flush()


def main() -> None:
    """Run the task named on the command line with settings from standard input."""
    task = sys.argv[1]
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    import jax  # noqa: PLC0415

    jax.config.update("jax_enable_x64", True)  # noqa: FBT003
    # compile times are part of the result, so none may come from an earlier run
    jax.config.update("jax_enable_compilation_cache", False)  # noqa: FBT003
    module, function = task.split(":")
    try:
        answer = {"result": getattr(import_module(module), function)(**json.load(sys.stdin))}
    except ValueError as refusal:
        answer = {"refused": str(refusal)}
    sys.stdout.write(json.dumps(answer) + "\n")


if __name__ == "__main__":
    main()
