"""`afm-jax` and `python -m afm_jax`."""

import gc
import os

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
    try:
        from afm_jax.cli.main import main  # noqa: PLC0415
    except KeyboardInterrupt:
        os.write(2, b"afm-jax: interrupted\n")
        raise SystemExit(130) from None
    main(prog_name="afm-jax")


if __name__ == "__main__":
    run()
