"""Names of a package that are imported only when somebody asks for them, so that importing it needs no JAX."""

import sys
from collections.abc import Mapping
from importlib import import_module


def import_name(package: str, homes: Mapping[str, str], name: str) -> object:
    """Return an exported name of a package and keep it there, so that it is looked up only once.

    Args:
        package: the package's own name.
        homes: for every exported name, the module that defines it.
        name: the name that somebody asked for.

    Raises:
        AttributeError: if the package exports no such name.
    """
    if name not in homes:
        raise AttributeError(f"module {package!r} has no attribute {name!r}")
    value = getattr(import_module(homes[name]), name)
    setattr(sys.modules[package], name, value)
    return value
