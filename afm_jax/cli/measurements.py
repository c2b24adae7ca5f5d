"""What `accuracy`, `bench` and `verify` show in the terminal: rows of measurements as tables, told column by column."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from rich.table import Table

from afm_jax.words import known

Cell = str | Callable[[Mapping[str, Any]], str]
"""A column's name, with a format behind a colon if it is not three digits, or a function of the row."""


def rows_table(title: str, cells: Mapping[str, Cell], rows: Sequence[Mapping[str, Any]]) -> Table:
    """Return rows as a table with words to the left and numbers to the right; a dash stands where nothing is known.

    Args:
        title: above it, if it has one.
        cells: of each heading what stands below it.
        rows: numbers and words by column.
    """
    table = Table(title=title or None, title_justify="left")
    for heading, cell in cells.items():
        words = callable(cell) or any(isinstance(row.get(cell.partition(":")[0]), str) for row in rows)
        table.add_column(heading, justify="left" if words else "right")
    for row in rows:
        table.add_row(*(_text(cell, row) for cell in cells.values()))
    return table


def _text(cell: Cell, row: Mapping[str, Any]) -> str:
    if callable(cell):
        return cell(row)
    name, _, form = cell.partition(":")
    value = row.get(name)
    return value if isinstance(value, str) else known(value, form or ".3g")
