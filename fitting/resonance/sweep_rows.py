"""Rows of a resonance sweep: from cells of text to columns of numbers, whatever the file's form."""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float, Int

from fitting.tables.table_columns import DECIMAL_COMMA, NUMBER
from fitting.tables.table_faults import Faults, quoted

NumberedLines = list[tuple[int, str]]
"""Lines of a file, each with its number."""


@dataclass(frozen=True)
class ParsedSweep:
    """What a file says, in the names and units of `ResonanceSweep`."""

    columns: dict[str, Float[np.ndarray, " points"]]
    lines: Int[np.ndarray, " points"]
    amplitude_unit: str
    instrument: dict[str, float] = field(default_factory=dict)
    remarks: tuple[str, ...] = ()


def parse_cells(
    rows: list[tuple[int, list[str]]], names: list[str], wanted: list[str], faults: Faults
) -> tuple[dict[str, Float[np.ndarray, " points"]], Int[np.ndarray, " points"]]:
    """Turn rows of cells into columns of numbers.

    Args:
        rows: line number and stripped cells of each row.
        names: the names of the file's columns.
        wanted: those that are read; the others may hold anything.
        faults: where faults are noted: a row of another length, a cell that is no number.

    Returns:
        The wanted columns by name, and the line of each row.
    """
    kept = []
    for line, cells in rows:
        if len(cells) == len(names):
            kept.append((line, cells))
        else:
            hint = "fill the row up" if len(cells) < len(names) else "a decimal comma must be a point"
            faults.add(f"there are {len(cells)} cells for {len(names)} columns; {hint}", line=line)
    columns = {}
    for name in wanted:
        position = names.index(name)
        cells = [(line, row[position]) for line, row in kept]
        columns[name] = np.array([_number(text, line, name, faults) for line, text in cells], dtype=np.float64)
    return columns, np.array([line for line, _ in kept], dtype=np.int64)


def _number(text: str, line: int, name: str, faults: Faults) -> float:
    if NUMBER.fullmatch(text):
        return float(text)
    if not text:
        faults.add("is blank; every point needs it: fill it in or remove the row", line=line, column=name)
    elif DECIMAL_COMMA.fullmatch(text):
        faults.add(f"{quoted(text)} has a decimal comma; write a point", line=line, column=name)
    else:
        message = f"{quoted(text)} is not a number; write it like 90.25 or 9.025e1, or remove the row"
        faults.add(message, line=line, column=name)
    return float("nan")
