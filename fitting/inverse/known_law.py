"""A law that is known otherwise, from a CSV file such as `afm-jax collide --out` writes."""

import csv
from pathlib import Path

import numpy as np
from jaxtyping import Float

from fitting.tables.table_faults import TableError, printable
from fitting.tables.table_file import read_text

_COLUMNS = ("approach_speed_nm_per_us", "rebound_speed_nm_per_us")


def read_known_law(path: str | Path) -> tuple[Float[np.ndarray, " points"], Float[np.ndarray, " points"]]:
    """Return approach and rebound speeds in nm/us, ascending; rows of captured tips are left out.

    Args:
        path: a CSV file with at least the columns approach_speed_nm_per_us and rebound_speed_nm_per_us.

    Raises:
        TableError: if the file cannot be read, lacks a column or holds no two rebounding tips.
    """
    name = printable(str(path))
    lines = [line for line in read_text(path).split("\n") if line.strip() and not line.startswith("#")]
    reader = csv.DictReader(lines)
    for column in _COLUMNS:
        if column not in (reader.fieldnames or ()):
            raise TableError(f"{name}: there is no column {column}; give a CSV file as `afm-jax collide --out` writes")
    pairs = []
    for row in reader:
        try:
            pair = tuple(float(row[column] or "nan") for column in _COLUMNS)
        except (TypeError, ValueError):
            raise TableError(f"{name}: a speed is not a number in the row {list(row.values())}; correct it") from None
        if np.all(np.isfinite(pair)) and min(pair) > 0.0:
            pairs.append(pair)
    found = np.unique(np.array(pairs).reshape(-1, 2), axis=0)
    if len(np.unique(found[:, 0])) < 2 or len(np.unique(found[:, 0])) < len(found):
        raise TableError(f"{name}: there must be two or more rebounding tips, each speed once; give more speeds")
    return found[:, 0], found[:, 1]
