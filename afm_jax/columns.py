"""Rows of a result as columns of a CSV file, and as a table to print."""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from afm_jax.words import known

if TYPE_CHECKING:
    from rich.table import Table


def columns_of(rows: Sequence[Mapping[str, Any]], names: Iterable[str] | None = None) -> dict[str, list[Any]]:
    """Return the columns of rows, those that are named or all; what a row lacks is None."""
    chosen = dict.fromkeys(name for row in rows for name in row) if names is None else names
    return {name: [row.get(name) for row in rows] for name in chosen}


def rows_of(columns: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return the rows that columns, arrays or lists, are made of."""
    plain = (_plain(column) for column in columns.values())
    return [dict(zip(columns, row, strict=True)) for row in zip(*plain, strict=True)]


def csv_cells(column: Any) -> Iterable[Any]:
    """Return the cells of a column: numbers with all their digits, true and false in words, the unknown empty."""
    return (_csv_cell(_plain(value)) for value in _plain(column))


def _csv_cell(value: Any) -> Any:
    if isinstance(value, bool):
        return "true" if value else "false"
    return "" if value is None or (isinstance(value, float) and not math.isfinite(value)) else value


def _plain(value: Any) -> Any:
    return value.tolist() if hasattr(value, "tolist") else value


Cell = str | Callable[[Any], Any]
"""The key of a row, with a format behind a colon if its numbers are not to have the table's, or a function of a row."""


def printed_table(title: str, cells: Mapping[str, Cell], rows: Sequence[Any], *, form: str = ".6g") -> "Table":
    """Return a table to print, a row a line: what is unknown is a dash, columns of words are set to the left.

    Args:
        title: what stands above the table; may be empty.
        cells: of each heading, which may have its unit in a second line, what stands below it.
        rows: mappings or records of numbers, words and truths.
        form: format of the numbers.
    """
    from rich.table import Table  # noqa: PLC0415 (help is there without it)

    columns = {heading: [_printed(row, cell, form) for row in rows] for heading, cell in cells.items()}
    table = Table(title=title or None, title_justify="left")
    for heading, texts in columns.items():
        words = any(text[:1].isalpha() for text in texts)
        table.add_column(heading, justify="left" if words else "right")
    for texts in zip(*columns.values(), strict=True):
        table.add_row(*texts)
    return table


def _printed(row: Any, cell: Cell, form: str) -> str:
    if callable(cell):
        value = cell(row)
    else:
        key, _, own = cell.partition(":")
        value, form = row.get(key) if isinstance(row, Mapping) else getattr(row, key), own or form
    value = _plain(value)
    if isinstance(value, bool):
        return "yes" if value else "no"
    return value if isinstance(value, str) else known(value, form)
