"""The columns of a result, as CSV files and as rows."""

import csv
import io
import math
from collections.abc import Iterable, Mapping, Sequence
from functools import singledispatch
from typing import Any

CsvColumns = Mapping[str, Mapping[str, Any]]
"""Columns by their names, of each file by its name."""


@singledispatch
def csv_columns(result: Any) -> CsvColumns:  # noqa: ARG001 (kinds of results register theirs)
    """Return the columns, by their names, of each CSV file of a result, by the file's name."""
    return {}


def columns_of(rows: Sequence[Mapping[str, Any]], names: Iterable[str] | None = None) -> dict[str, list[Any]]:
    """Return the columns of rows, those that are named or all; what a row lacks is None."""
    chosen = dict.fromkeys(name for row in rows for name in row) if names is None else names
    return {name: [row.get(name) for row in rows] for name in chosen}


def rows_of(columns: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return the rows that columns, arrays or lists, are made of."""
    plain = (_plain(column) for column in columns.values())
    return [dict(zip(columns, row, strict=True)) for row in zip(*plain, strict=True)]


def csv_text(columns: Mapping[str, Any], comments: Iterable[str] = ()) -> str:
    """Return a CSV file: numbers with all their digits, true and false in words, empty what is None or not finite.

    Args:
        columns: lists or arrays of one length, in order.
        comments: lines above the table, each after a number sign.
    """
    text = io.StringIO()
    text.writelines(f"# {comment}\n" for comment in comments)
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    cells = ([_csv_cell(_plain(value)) for value in _plain(column)] for column in columns.values())
    writer.writerows(zip(*cells, strict=True))
    return text.getvalue()


def _csv_cell(value: Any) -> Any:
    if isinstance(value, bool):
        return "true" if value else "false"
    return "" if value is None or (isinstance(value, float) and not math.isfinite(value)) else value


def _plain(value: Any) -> Any:
    return value.tolist() if hasattr(value, "tolist") else value
