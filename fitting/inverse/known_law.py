"""A law that is known otherwise, from a CSV file such as `afm-jax collide --out` writes."""

from pathlib import Path

import numpy as np
from jaxtyping import Float

from fitting.tables.csv_text import (
    Column,
    Faults,
    Form,
    TableError,
    parse_rows,
    printable,
    read_text,
    split_cells,
    split_lines,
)

_COLUMNS = ("approach_speed_nm_per_us", "rebound_speed_nm_per_us")
_LAW = Form(tuple(Column(name) for name in _COLUMNS), "speed", open=True, blanks=True)


def read_known_law(path: str | Path) -> tuple[Float[np.ndarray, " points"], Float[np.ndarray, " points"]]:
    """Return approach and rebound speeds in nm/us, ascending; rows of captured tips are left out.

    Args:
        path: a CSV file with at least the columns approach_speed_nm_per_us and rebound_speed_nm_per_us.

    Raises:
        TableError: if the file cannot be read, lacks a column or holds no two rebounding tips.
    """
    name = printable(str(path))
    _, rows = split_lines(read_text(path))
    names = split_cells(rows[0][1]) if rows else []
    for column in _COLUMNS:
        if column not in names:
            raise TableError(f"{name}: there is no column {column}; give a CSV file as `afm-jax collide --out` writes")
    columns, unreadable, lines = parse_rows(rows[1:], names, _LAW, faults := Faults(str(path)))
    for row in np.flatnonzero(np.any(list(unreadable.values()), axis=0)):
        raise TableError(f"{name}, line {lines[row]}: a speed is not a number; correct it")
    faults.raise_any()
    pairs = np.stack([columns[column] for column in _COLUMNS], axis=1)
    pairs = pairs[np.all(np.isfinite(pairs) & (pairs > 0.0), axis=1)]
    found = np.unique(pairs, axis=0)
    if len(np.unique(found[:, 0])) < 2 or len(np.unique(found[:, 0])) < len(found):
        raise TableError(f"{name}: there must be two or more rebounding tips, each speed once; give more speeds")
    return found[:, 0], found[:, 1]
