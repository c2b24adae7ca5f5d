"""The versions of this package and of what it computes with."""

from importlib.metadata import PackageNotFoundError, version


def version_of(package: str) -> str:
    """Return the installed version of a package; "not installed" for one that runs from its source folder."""
    try:
        return version(package)
    except PackageNotFoundError:
        return "not installed"


__version__ = version_of("afm-jax")
