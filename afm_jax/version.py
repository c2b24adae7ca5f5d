"""The versions of this package and of what it computes with."""

from functools import cache
from importlib.metadata import PackageNotFoundError, version

EXCLUDED_JAX = {
    "0.10.2": "silently miscomputes sums over the rows of arrays with more than 16,384 rows (jax issue 39103)",
    "0.11.1": "copies a whole array at every write into it in a loop, hundreds of times as slow (jax issue 40101)",
}
"""What is wrong with the versions of JAX that pyproject.toml excludes; both faults are jaxlib's, on a CPU."""


@cache
def version_of(package: str) -> str:
    """Return the installed version of a package; "not installed" for one that runs from its source folder."""
    try:
        return version(package)
    except PackageNotFoundError:
        return "not installed"


__version__ = version_of("afm-jax")
