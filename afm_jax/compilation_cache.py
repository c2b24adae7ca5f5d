"""JAX's compilation cache in the user's own folder: what commands, Python sessions and notebooks compile is kept.

JAX keys its cache by program and version, but not by all that a processor can do, and a home folder may be shared by
different machines: so every version of jaxlib and every kind of processor has a folder of its own. What lies there is
machine code that will be run: a folder that somebody else owns or may write to is not used.
"""

import errno
import hashlib
import os
import platform
import sys
import tempfile
import warnings
from contextlib import suppress
from functools import lru_cache
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple


class Cache(NamedTuple):
    """Where compiled programs are kept."""

    folder: Path | None
    """None: nowhere."""
    reason: str
    """Who chose the folder, or why there is none."""
    refused: bool = False
    """Whether there is none because its folder cannot be trusted or written to."""


def use_cache() -> Path | None:
    """Keep what JAX compiles from one Python session to the next, in the folder that the `afm-jax` commands use.

    To be called before the first computation. XLA's messages, which are errors of no consequence for every program that
    it reads on processors with AVX-512, are switched off unless `TF_CPP_MIN_LOG_LEVEL` asks for them. A cache that was
    chosen before (`JAX_COMPILATION_CACHE_DIR`) or switched off (`JAX_ENABLE_COMPILATION_CACHE`) stays as it is.

    Returns:
        The folder; None where nothing is kept, with a warning if that is because the folder cannot be used.
    """
    silence_xla()
    cache = open_cache()
    if cache.refused:
        warnings.warn(f"compiled programs are not kept: {cache.reason}", stacklevel=2)
    return cache.folder


def silence_xla() -> None:
    """Keep XLA's messages off standard error, in programs started from here too, unless the user asked for them.

    Its errors about "prefer-no-gather" (openxla/xla issue 44565) take tuning for a feature of the processor, on the
    very machine that compiled a program. XLA reads the variable when jaxlib is loaded; later the
    setting goes to jaxlib itself.
    """
    # JAX itself sets 1, and so do sessions that have imported it for the programs they start
    if os.environ.get("TF_CPP_MIN_LOG_LEVEL", "1") != "1":
        return
    os.environ["TF_CPP_MIN_LOG_LEVEL"] = "3"
    if "jaxlib" in sys.modules:
        # what jax.config's jax_logging_level calls, which changes loggers of Python, too
        with suppress(ImportError, AttributeError):
            import_module("jaxlib.utils").absl_set_min_log_level(3)


def quick_options(level: int = 1) -> dict[str, Any] | None:
    """Return options that leave the compiler's slowest passes on the CPU out, where it knows them by these names.

    Programs then take half as long to compile, for a tenth of the time that they run. None on other devices, and where
    XLA_FLAGS has chosen.

    Args:
        level: of optimisation; 0 halves the time to compile once more and doubles the time that programs run.
    """
    options = _if_known("xla_cpu_use_fusion_emitters", "xla_backend_optimization_level")
    return None if options is None else options | (wide_vectors() or {}) | {"xla_backend_optimization_level": level}


_OPTIONS: dict[str, Any] = {
    "xla_cpu_use_fusion_emitters": False,
    "xla_backend_optimization_level": 1,
    "xla_cpu_prefer_vector_width": 512,
}


@lru_cache
def _if_known(*names: str) -> dict[str, Any] | None:
    """Return these options; None on other devices, where the compiler does not know them, or XLA_FLAGS has chosen."""
    import jax  # noqa: PLC0415  # packages are imported without it

    options = {name: _OPTIONS[name] for name in names}
    if jax.default_backend() != "cpu" or any(name in os.environ.get("XLA_FLAGS", "") for name in options):
        return None
    try:
        jax.jit(lambda x: x, compiler_options=options)(0.0)
    except jax.errors.JaxRuntimeError:
        return None
    return options


def wide_vectors() -> dict[str, Any] | None:
    """Return the option for vectors of 512 bits, where the processor has them; driven contacts take 0.9 of the time."""
    return _if_known("xla_cpu_prefer_vector_width") if any("avx512f" in line for line in _processor()) else None


def open_cache() -> Cache:
    """Switch JAX's compilation cache on in the user's cache folder, unless the user has decided otherwise."""
    import jax  # noqa: PLC0415  # packages are imported without it

    enabled, chosen = (
        getattr(jax.config, name) for name in ("jax_enable_compilation_cache", "jax_compilation_cache_dir")
    )
    if not enabled:
        return Cache(None, "the compilation cache is switched off (jax_enable_compilation_cache)")
    folder = cache_folder()
    if chosen is not None and chosen != str(folder):
        return Cache(Path(chosen), "chosen by jax_compilation_cache_dir")
    if folder is None:
        return Cache(None, "there is no home folder: set HOME or XDG_CACHE_HOME", refused=True)
    try:
        make_private(folder)
    except OSError as error:
        return Cache(None, f"{error.filename or folder}: {error.strerror or error}", refused=True)
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
    return Cache(folder, "the user's cache folder")


def cache_folder() -> Path | None:
    """Return where programs that this jaxlib compiles on this kind of processor are kept.

    That is below XDG_CACHE_HOME or ~/.cache; None where that depends on a home folder and there is none: a user without
    an entry in the system's list, as containers have, and without HOME; or one whose HOME is no absolute path.
    """
    from jaxlib.version import __version__ as version  # noqa: PLC0415

    base = Path(os.environ.get("XDG_CACHE_HOME", ""))
    with suppress(RuntimeError):
        # The specification says that a relative path there is to be ignored.
        base = base if base.is_absolute() else Path.home() / ".cache"
    return base / "afm-jax" / f"jaxlib-{version}-{processor_key()}" if base.is_absolute() else None


def processor_key() -> str:
    """Return a short name of this kind of processor: equal where compiled programs are interchangeable."""
    kind = [platform.system(), platform.machine(), platform.processor(), *_processor()]
    return hashlib.sha256("\n".join(kind).encode()).hexdigest()[:12]


def _processor() -> list[str]:
    """Return the lines in which Linux describes the kind of the first processor: large machines list hundreds."""
    lines: list[str] = []
    with suppress(OSError), Path("/proc/cpuinfo").open(encoding="utf-8", errors="replace") as file:
        lines = file.read(1 << 14).partition("\n\n")[0].splitlines()
    return [line for line in lines if line.startswith(("model name", "CPU part", "flags", "Features", "isa"))]


def available_cores() -> int:
    """Return how many cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def make_private(folder: Path) -> None:
    """Make a folder, and those above it that are missing, for this user alone; check it and the one above it.

    Raises:
        OSError: if it cannot be made or written to, belongs to somebody else, or others may write to it.
    """
    for path in reversed([path for path in (folder, *folder.parents) if not path.exists()]):
        path.mkdir(mode=0o700, exist_ok=True)
    for path in (folder.parent, folder) if os.name == "posix" else ():
        found = path.stat()
        if found.st_uid != os.geteuid():
            raise PermissionError(errno.EPERM, "the folder belongs to another user", str(path))
        if found.st_mode & 0o022:
            raise PermissionError(errno.EPERM, "others may write to the folder; `chmod go-w` mends it", str(path))
    with tempfile.TemporaryFile(dir=folder):
        pass
