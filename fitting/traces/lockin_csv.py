"""A time trace as plain CSV: comment lines, a row of column names, a row for each sample."""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from fitting.tables.csv_text import Column, Faults, Form, check_names, named_rows, parse_rows, split_lines
from fitting.traces.lockin_settings import settings_of_comments

TRACE = Form(
    (
        Column("time_us"),
        Column("deflection_nm", needed="deflection"),
        Column("position_nm", meaning="deflection_nm"),
        Column("platform_nm", meaning="platform"),
        Column("drive", meaning="platform"),
    ),
    "sample",
    open=True,
    example="time_us,deflection_nm",
)
"""The columns that are read, and what each becomes; `drive` is the drive's signal in any unit."""
ATTRIBUTES = {column.name: column.says for column in TRACE.columns}


@dataclass(frozen=True)
class ParsedTrace:
    """What a file says; `columns` holds time_us, deflection_nm, platform as far as they are there."""

    columns: dict[str, Float[np.ndarray, " samples"]]
    settings: dict[str, float]
    platform_in_nm: bool
    first_line: int = 0
    """Line of the first sample; 0 where the file has no lines."""
    remarks: tuple[str, ...] = field(default=())


def parse_csv(text: str, faults: Faults) -> ParsedTrace:
    """Read the text of a CSV file; columns of other names are left alone.

    Args:
        text: all of it.
        faults: where faults are noted; with any, the result is not to be used.

    Raises:
        TableError: at once where the column names are wrong: the cells below them cannot be judged.
    """
    comments, rows = split_lines(text)
    settings, remarks = settings_of_comments(comments, faults)
    if not rows:
        faults.add("there are no samples; add a row of column names and a row for each sample")
        faults.raise_any()
    head, rows = named_rows(rows, TRACE, faults)
    faults.raise_any()
    columns, _, lines = parse_rows(rows, head.names, TRACE, faults)
    faults.raise_any()
    attributes = {ATTRIBUTES[name]: column for name, column in columns.items()}
    return ParsedTrace(attributes, settings, "platform_nm" in columns, int(lines[0]), remarks)


def wanted_columns(names: list[str], faults: Faults) -> list[str]:
    """Return those of the names of data sets that are read, after noting what is missing or said twice."""
    check_names(names, TRACE, faults=faults)
    return [name for name in names if name in ATTRIBUTES]
