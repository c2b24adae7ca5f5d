"""Programs of their own, for tests of what is imported and configured when a program starts."""

import os
import subprocess
import sys
from collections.abc import Mapping


def python(code: str, **environment: str | None) -> str:
    """Return what a program of its own prints; it must succeed. Variables that are None are not set."""
    return outputs(code, environment)[0]


def outputs(
    code: str, environment: Mapping[str, str | None], codes: tuple[int, ...] = (0,), limit_s: float | None = None
) -> tuple[str, str]:
    """Return what a program of its own writes to standard output and to standard error, in time."""
    variables = {name: value for name, value in {**os.environ, **environment}.items() if value is not None}
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=False, env=variables, timeout=limit_s
    )
    assert done.returncode in codes, done.stderr
    return done.stdout.strip(), done.stderr
