"""A computation in a Python process of its own that may use a stated number of cores.

How many cores JAX uses is settled before it is imported, and a process that has run other programs is a poor place to
measure time in. Settings go in as JSON on standard input, results come back as JSON on standard output.
"""

import json
import os
import subprocess
import sys
from collections.abc import Mapping
from importlib import import_module
from typing import Any


def available_cores() -> int:
    """Return how many cores this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


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
    flags = os.environ.get("XLA_FLAGS", "")
    if cores > 1:
        flags += f" --xla_force_host_platform_device_count={cores}"
    elif not hasattr(os, "sched_setaffinity"):
        flags += " --xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"
    done = subprocess.run(  # noqa: S603
        [sys.executable, "-m", "afm_jax.study.own_process", task, str(cores)],
        input=json.dumps(dict(settings)),
        stdout=subprocess.PIPE,
        text=True,
        check=False,
        env={**os.environ, "XLA_FLAGS": flags.strip(), "JAX_PLATFORMS": "cpu"},
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
