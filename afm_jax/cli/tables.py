"""Amplitude tables of commands: their files, with what the call says in place of them."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import fitting.examples
from fitting.tables.table import AmplitudeTable, as_table


def example_path() -> Path:
    """Return where the bundled table of `--example` lies, the short way if that is below the working folder."""
    path = Path(fitting.examples.__path__[0]) / "amplitudes_law.csv"
    return path.relative_to(Path.cwd()) if path.is_relative_to(Path.cwd()) else path


def tables_with(
    paths: Sequence[Path], noise: float | None, quality_factor: tuple[float, float | None] | None
) -> list[AmplitudeTable]:
    """Return amplitude tables from their files, with the quality factor of the call, if it gives one.

    Raises:
        TableError: if one cannot be read, or the quality factor is impossible.
    """
    quality: Any = "none" if quality_factor is not None and math.isinf(quality_factor[0]) else quality_factor
    return [as_table(path, noise=noise, quality_factor=quality) for path in paths]
