"""Programs of their own, for tests of what is imported and configured when a program starts."""

import os
import subprocess
import sys


def python(code: str, **environment: str) -> str:
    """Return what a program of its own prints; it must succeed."""
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=False, env={**os.environ, **environment}
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()
