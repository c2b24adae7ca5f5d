"""JAX for the command line: 64-bit floats, and compiled programs kept from one call to the next.

A short command is mostly compilation and tracing. JAX keys its cache by program and version, but not by all that a
processor can do, and a home folder may be shared by different machines: so every kind of processor has a folder of its
own.
"""

import hashlib
import os
import platform
import sys
import tempfile
import warnings
from pathlib import Path

import jax

from afm_jax.stored_program import keep_programs


def start_jax() -> None:
    """Switch 64-bit floats on and, unless the user has set one, the compilation cache in the user's cache folder."""
    jax.config.update("jax_enable_x64", True)  # noqa: FBT003
    names = ("jax_enable_compilation_cache", "jax_compilation_cache_dir")
    enabled, chosen_by_user = (getattr(jax.config, name) for name in names)
    if enabled and chosen_by_user is not None and chosen_by_user == os.environ.get("JAX_COMPILATION_CACHE_DIR"):
        keep_programs(Path(chosen_by_user) / "traced")
    if not enabled or chosen_by_user is not None:
        return
    folder = user_cache_folder() / f"jax-{jax.__version__}-{processor_key()}"
    if not _is_writable(folder):
        return
    keep_programs(folder / "traced")
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
    # A full disk or a damaged entry costs a compilation, nothing else.
    warnings.filterwarnings("ignore", message="Error (reading|writing) persistent compilation cache entry")


def user_cache_folder() -> Path:
    """Return where this platform keeps what a user's programs can do without, in a folder named afm-jax."""
    if sys.platform == "win32":
        base = os.environ.get("LOCALAPPDATA")
        return Path(base) / "afm-jax" / "cache" if base else Path.home() / "AppData" / "Local" / "afm-jax" / "cache"
    if sys.platform == "darwin":
        return Path.home() / "Library" / "Caches" / "afm-jax"
    base = os.environ.get("XDG_CACHE_HOME", "")
    # The specification says that a relative path there is to be ignored.
    return (Path(base) if Path(base).is_absolute() else Path.home() / ".cache") / "afm-jax"


def processor_key() -> str:
    """Return a short name of this kind of processor: equal where compiled programs are interchangeable."""
    kind = [platform.system(), platform.machine(), platform.processor()]
    try:
        with Path("/proc/cpuinfo").open(encoding="utf-8", errors="replace") as file:
            # the first processor is enough, and large machines list hundreds
            lines = file.read(1 << 14).partition("\n\n")[0].splitlines()
    except OSError:
        lines = []
    kind += [line for line in lines if line.startswith(("model name", "CPU part", "flags", "Features", "isa"))]
    return hashlib.sha256("\n".join(kind).encode()).hexdigest()[:12]


def _is_writable(folder: Path) -> bool:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return True
    except OSError:
        return False
