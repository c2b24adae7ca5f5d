"""Rows of a result as columns of a CSV file, and as a table to print."""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

from afm_jax.words import known

if TYPE_CHECKING:
    from rich.table import Table


def columns_of(rows: Sequence[Mapping[str, Any]], names: Sequence[str]) -> dict[str, list[Any]]:
    """Return the columns of rows; what a row lacks is None."""
    return {name: [row.get(name) for row in rows] for name in names}


def csv_cells(column: Any) -> Iterable[Any]:
    """Return the cells of a column: numbers with all their digits, true and false in words, the unknown empty."""
    if hasattr(column, "tolist"):
        return map(_csv_cell, column.tolist())
    return (_csv_cell(value.tolist() if hasattr(value, "tolist") else value) for value in column)


def _csv_cell(value: Any) -> Any:
    if isinstance(value, bool):
        return "true" if value else "false"
    return "" if value is None or (isinstance(value, float) and not math.isfinite(value)) else value


class TableColumn(NamedTuple):
    """A column of a table to print.

    Attributes:
        heading: what stands above it, with the unit in a second line.
        value: the key of the rows, or a function of a row.
        form: format of its numbers; what is unknown is a dash. "yes" writes yes and no, an empty one words.
        left: whether it is set to the left.
    """

    heading: str
    value: str | Callable[[Any], Any]
    form: str = ".6g"
    left: bool = False

    def cell(self, row: Any) -> str:
        """Return the cell of a row."""
        value = self.value(row) if callable(self.value) else row[self.value]
        if self.form == "yes":
            return "yes" if value else "no"
        return known(value, self.form) if self.form else value


def printed_table(title: str, columns: Sequence[TableColumn], rows: Iterable[Any]) -> "Table":
    """Return a table to print, a row a line."""
    from rich.table import Table  # noqa: PLC0415 (help is there without it)

    table = Table(title=title or None, title_justify="left")
    for column in columns:
        table.add_column(column.heading, justify="left" if column.left else "right")
    for row in rows:
        table.add_row(*(column.cell(row) for column in columns))
    return table


Cell = str | Callable[[Mapping[str, Any]], str]
"""The key of a row, with a format behind a colon if its numbers are not to have three digits, or a function of it."""


def rows_table(title: str, cells: Mapping[str, Cell], rows: Sequence[Mapping[str, Any]]) -> "Table":
    """Return a table to print of rows that hold words, numbers, or None where nothing is known, which is a dash.

    Args:
        title: what stands above the table; may be empty.
        cells: of each heading what stands below it; columns of words are set to the left.
        rows: numbers and words by key.
    """

    def column(heading: str, cell: Cell) -> TableColumn:
        if callable(cell):
            return TableColumn(heading, cell, form="", left=True)
        key, _, form = cell.partition(":")

        def text(row: Mapping[str, Any]) -> str:
            value = row.get(key)
            return value if isinstance(value, str) else known(value, form or ".3g")

        return TableColumn(heading, text, form="", left=any(isinstance(row.get(key), str) for row in rows))

    return printed_table(title, [column(heading, cell) for heading, cell in cells.items()], rows)
