"""The law that a fit found, read back from the JSON of `afm-jax fit`, to be drawn over rows inverted without it."""

import json
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from fitting.tables.csv_text import TableError, printable, read_text

_COLUMNS = ("approach_speed_nm_per_us", "rebound_speed_nm_per_us", "collision_delay_us")


class SavedLaw(NamedTuple):
    """A law at some approach speeds: rebound speed in nm/us and delay in us, each of shape (points,)."""

    model: str
    approach_speed_nm_per_us: Float[np.ndarray, " points"]
    rebound_speed_nm_per_us: Float[np.ndarray, " points"]
    collision_delay_us: Float[np.ndarray, " points"]


def read_fitted_law(path: str | Path) -> SavedLaw:
    """Read the law of a fit.

    Args:
        path: what `afm-jax fit --json` prints, or the fit.json of its report.

    Raises:
        TableError: if the file cannot be read, is no fit, or the fit is not valid.
    """
    name = printable(str(path))
    try:
        found = json.loads(read_text(path))
    except json.JSONDecodeError as error:
        raise TableError(f"{name}, line {error.lineno}: is no JSON; give the fit.json of `afm-jax fit --out`") from None
    if not isinstance(found, dict) or found.get("format") != "afm-jax fit" or not isinstance(found.get("law"), dict):
        raise TableError(f"{name}: is no fit; give the fit.json of `afm-jax fit --out`")
    if not found.get("valid"):
        raise TableError(f"{name}: the fit is not valid, so that its law means nothing; give a valid one")
    columns = [_numbers(found["law"].get(column)) for column in _COLUMNS]
    if any(column.shape != columns[0].shape or column.size < 2 for column in columns):
        raise TableError(f"{name}: its law lacks {', '.join(_COLUMNS)}; fit again with this version")
    return SavedLaw(str(found.get("model")), *columns)


def _numbers(cells: Any) -> Float[np.ndarray, " points"]:
    """Return a list of numbers as an array, NaN for null; an empty one for anything else."""
    if not isinstance(cells, list) or any(not isinstance(cell, (int, float, type(None))) for cell in cells):
        return np.zeros(0)
    return np.array([np.nan if cell is None else float(cell) for cell in cells], dtype=np.float64)
