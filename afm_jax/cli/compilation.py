"""JAX for the command line: 64-bit floats, compiled programs kept from one call to the next, quick compiling."""

import re
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
from jax import monitoring

from afm_jax.compilation_cache import Cache, open_cache

_DAMAGED = re.compile(r"Error reading persistent compilation cache entry for '([\w.<>-]+)': (.*)", re.DOTALL)
_UNWRITTEN = "Error writing persistent compilation cache entry"


def start_jax(tell: Callable[[str], None]) -> Cache:
    """Switch 64-bit floats on, and the compilation cache unless the user has decided otherwise.

    Args:
        tell: takes what only those want to know who ask.
    """
    jax.config.update("jax_enable_x64", True)  # noqa: FBT003
    cache = open_cache()
    tell(f"compiled programs: {cache.folder or 'not kept'} ({cache.reason})")
    if cache.folder is not None:
        # A full disk costs a compilation, nothing else.
        warnings.filterwarnings("ignore", message=_UNWRITTEN)
        _replace_damaged(cache.folder, tell)
    return cache


def count_programs() -> dict[str, int]:
    """Return how many programs the cache was asked for and had, from now on: a mapping that keeps being updated."""
    names = {"compile_requests_use_cache": "asked", "cache_hits": "read"}
    counts = dict.fromkeys(names.values(), 0)

    def count(event: str, **_: Any) -> None:
        name = names.get(event.rpartition("/")[2])
        if name is not None:
            counts[name] += 1

    monitoring.register_event_listener(count)
    return counts


def _replace_damaged(folder: Path, tell: Callable[[str], None]) -> None:
    """Let entries that cannot be read make room: JAX compiles anew, but never writes over an entry."""
    shown, told = warnings.showwarning, False

    def show(message: Warning | str, *where: Any, **more: Any) -> None:
        nonlocal told
        entry = _DAMAGED.match(str(message))
        if entry is None:
            shown(message, *where, **more)
            return
        # the message names the program, not its entry: those of the same name are compiled anew as well
        for path in folder.glob(f"{entry[1]}-*-cache"):
            path.unlink(missing_ok=True)
        if not told:
            tell(f"the compilation cache's {entry[1]} was rejected and is compiled anew: {' '.join(entry[2].split())}")
        told = True

    warnings.filterwarnings("always", message="Error reading persistent compilation cache entry")
    warnings.showwarning = show
