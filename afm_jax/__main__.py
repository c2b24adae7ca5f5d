"""`afm-jax` and `python -m afm_jax`."""

import gc
import os
import signal
from typing import Any

_THREADS = ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "BLIS_NUM_THREADS", "VECLIB_MAXIMUM_THREADS")
"""What BLAS libraries read their number of threads from, when they are loaded."""
_COLLECTIONS = 100_000, 20, 100
"""Thresholds of Python's garbage collector: its usual ones take a fifth of the time in which JAX traces a program."""


def run() -> None:
    """Run the command line; an interrupt ends it in one line while packages are still being imported, too.

    NumPy's and SciPy's linear algebra gets one thread unless the environment says otherwise: its matrices are so small
    that threads take longer than the work. JAX has threads of its own.
    """
    gc.set_threshold(*_COLLECTIONS)
    for name in _THREADS:
        os.environ.setdefault(name, os.environ.get("OMP_NUM_THREADS", "1"))
    # a shell starts what runs in the background with interrupts ignored
    heard = signal.getsignal(signal.SIGINT) is signal.default_int_handler
    if heard:
        signal.signal(signal.SIGINT, _end)
    from afm_jax.cli.main import main  # noqa: PLC0415

    if heard:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    main(prog_name="afm-jax")


def _end(_number: int, _frame: Any) -> None:
    """End the program at once: nothing has been begun."""
    os.write(2, b"afm-jax: interrupted\n")
    os._exit(130)


if __name__ == "__main__":
    run()
