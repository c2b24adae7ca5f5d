"""Time of a compiled JAX function: compilation apart, several repetitions, the best and the median of them.

A measurement runs in a Python process of its own that may use a stated number of cores: how many cores JAX uses is
settled before it is imported, and a process that has run other programs is a poor place to measure time in. Settings go
in as JSON on standard input, results come back as JSON on standard output.
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


class Calls(NamedTuple):
    """Seconds that calls of a function take which compiles in its first, and what the last returns."""

    first_s: float
    best_s: float
    """Of the calls after the first."""
    best_processor_s: float
    """Processor time of that best call."""
    result: Any

    @property
    def compile_s(self) -> float:
        """Seconds by which the first call took longer: next to nothing if the programs are compiled already."""
        return max(self.first_s - self.best_s, 0.0)


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


def time_calls(run: Callable[[], Any], *, repetitions: int) -> Calls:
    """Call a function once and then some times more, at least once, and return the times and what it computed."""
    result, seconds, processor = None, [], []
    for _ in range(1 + max(repetitions, 1)):
        began, used = time.perf_counter(), os.times()
        result = jax.block_until_ready(run())
        now = os.times()
        seconds.append(time.perf_counter() - began)
        processor.append(now.user - used.user + now.system - used.system)
    best = min(range(1, len(seconds)), key=seconds.__getitem__)
    return Calls(seconds[0], seconds[best], processor[best], result)


def _seconds(compiled: Compiled, arguments: tuple[Any, ...], calls: int) -> float:
    began = time.perf_counter()
    for _ in range(calls):
        jax.block_until_ready(compiled.run(*arguments))
    return (time.perf_counter() - began) / calls


def run_in_own_process(task: str, settings: Mapping[str, Any], *, cores: int) -> Any:
    """Run a function in a new process and return its result.

    Args:
        task: "module:function"; the function takes the settings as keywords and returns what JSON can carry.
        settings: the function's arguments.
        cores: 1 pins the process to one core where the system can do that and forbids further threads elsewhere;
            more give JAX that many CPU devices.

    Raises:
        ValueError: if the process fails; its own message went to standard error.
    """
    flags, threads = os.environ.get("XLA_FLAGS", ""), {}
    if cores > 1:
        flags += f" --xla_force_host_platform_device_count={cores}"
    elif not hasattr(os, "sched_setaffinity"):
        # XLA reads that; its flags do not bring its threads down to one
        threads = {"NPROC": "1"}
    done = subprocess.run(  # noqa: S603
        [sys.executable, "-m", "afm_jax.studies.timing", task, str(cores)],
        input=json.dumps(dict(settings)),
        stdout=subprocess.PIPE,
        text=True,
        check=False,
        env={**os.environ, **threads, "XLA_FLAGS": flags.strip(), "JAX_PLATFORMS": "cpu"},
        # an interrupt from the terminal is for the process that waits, and ends this one without a traceback of its own
        process_group=0 if os.name == "posix" else None,
    )
    if done.returncode != 0:
        raise ValueError(f"the measurement in a process of its own ended with exit code {done.returncode}")
    return json.loads(done.stdout.splitlines()[-1])


def progress(message: str) -> None:
    """Write a line to standard error."""
    sys.stderr.write(f"{message}\n")
    sys.stderr.flush()


def main() -> None:
    """Run the task named on the command line with settings from standard input."""
    task, cores = sys.argv[1], int(sys.argv[2])
    if cores == 1 and hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    import jax  # noqa: PLC0415

    jax.config.update("jax_enable_x64", True)  # noqa: FBT003
    # compile times are part of the result, so none may come from an earlier run
    jax.config.update("jax_enable_compilation_cache", False)  # noqa: FBT003
    module, function = task.split(":")
    result = getattr(import_module(module), function)(**json.load(sys.stdin))
    sys.stdout.write(json.dumps(result) + "\n")


if __name__ == "__main__":
    main()
