"""`afm-jax doctor`: what is installed, how JAX computes here, and whether compiled programs are found again."""

import os
import platform
import subprocess
import sys
from importlib import metadata
from pathlib import Path
from typing import Any

import click

from afm_jax.cli.command import Output
from afm_jax.cli.session import Session
from afm_jax.compilation_cache import silence_xla
from afm_jax.version import EXCLUDED_JAX

_PACKAGES = ("afm-jax", "jax", "jaxlib", "numpy", "scipy", "equinox", "diffrax", "optimistix", "flatbuffers")
_PROBE = "small_program_of_the_doctor"


def doctor(session: Session) -> Output:
    """Say what is installed, how JAX computes, and whether its compilation cache works.

    A small program is compiled by two fresh processes: the second should find it in the cache. Exit code 3 if it does
    not, or if the cache's folder cannot be used; every command then compiles anew, which takes up to a minute. Exit
    code 3, too, where a version of JAX is installed that computes wrongly or very slowly.
    """
    cache = session.start_computing()
    import jax  # noqa: PLC0415

    works = False
    if cache.folder is not None:
        for entry in cache.folder.glob(f"jit_{_PROBE}-*"):
            entry.unlink()
        _, works = try_cache(cache.folder), try_cache(cache.folder)
    excluded = excluded_version()
    payload = {
        "versions": {"python": platform.python_version()} | {name: _version(name) for name in _PACKAGES},
        "excluded": excluded,
        "platform": platform.platform(),
        "processors": os.cpu_count(),
        "devices": [{"platform": device.platform, "kind": device.device_kind} for device in jax.devices()],
        "float_bits": jax.numpy.zeros(()).dtype.itemsize * 8,
        "cache": {"folder": cache.folder, "reason": cache.reason, "works": works},
    }
    complaints = [] if excluded is None else [excluded]
    if cache.refused or (cache.folder is not None and not works):
        lost = f"{cache.folder}: a program that one process compiled was not found by the next"
        complaints.append(f"the compilation cache does not work: {cache.reason if cache.refused else lost}")
    return Output(payload=payload, text=_lines(payload), not_valid="; ".join(complaints) or None)


def excluded_version() -> str | None:
    """Say which excluded version of JAX is installed, what is wrong with it, and what to do; None if there is none."""
    import jax  # noqa: PLC0415

    # what is imported may not be what is installed
    versions = [("jax", jax.__version__), ("jax", _version("jax")), ("jaxlib", _version("jaxlib"))]
    for name, number in versions:
        if number in EXCLUDED_JAX:
            better = ",".join(f"!={version}" for version in EXCLUDED_JAX)
            return f"{name} {number} {EXCLUDED_JAX[number]}; install another with: pip install -U 'jax{better}'"
    return None


def try_cache(folder: Path) -> bool:
    """Compile a small program in a new process, whose cache is in a folder; say whether it was there already."""
    done = subprocess.run(
        [sys.executable, "-m", "afm_jax.cli.doctor"],
        env={**os.environ, "JAX_COMPILATION_CACHE_DIR": str(folder)},
        capture_output=True,
        text=True,
        check=False,
    )
    return done.returncode == 0 and done.stdout.strip() == "found"


def _version(name: str) -> str | None:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return None


def _lines(payload: dict[str, Any]) -> list[str]:
    cache = payload["cache"]
    devices = ", ".join(f"{device['platform']} ({device['kind']})" for device in payload["devices"])
    state = "works" if cache["works"] else "does not work" if cache["folder"] else "none"
    return [
        ", ".join(f"{name} {number or 'missing'}" for name, number in payload["versions"].items()),
        *([] if payload["excluded"] is None else [f"Excluded version: {payload['excluded']}"]),
        f"Platform: {payload['platform']}, {payload['processors']} processors; JAX devices: {devices}",
        f"Floats: {payload['float_bits']} bits",
        f"Compilation cache: {cache['folder'] or 'no folder'} ({cache['reason']}); {state}",
    ]


def main() -> None:
    """Make a small program ready; print whether the cache had it."""
    silence_xla()
    from afm_jax.cli.compilation import count_programs, start_jax  # noqa: PLC0415

    start_jax(lambda _: None)
    import jax  # noqa: PLC0415

    def program(x: jax.Array) -> jax.Array:
        return jax.numpy.linalg.eigh(jax.numpy.sin(x * x[:, None]))[0]

    program.__name__ = _PROBE
    # a chosen cache keeps slow programs only
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
    value = jax.block_until_ready(jax.numpy.linspace(0.0, 1.0, 50))
    counts = count_programs()
    jax.block_until_ready(jax.jit(program)(value))
    click.echo("found" if counts["read"] == 1 else "compiled")


if __name__ == "__main__":
    main()
