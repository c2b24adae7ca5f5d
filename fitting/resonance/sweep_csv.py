"""A resonance sweep as plain CSV."""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float, Int

from fitting.tables.csv_text import Column, Faults, Form, check_not_empty, named_rows, parse_rows, split_lines

HZ_PER_KHZ = 1e3

SWEEP = Form(
    (
        Column("frequency_khz", needed="frequency"),
        Column("frequency_hz", meaning="frequency_khz", needed="frequency"),
        Column("amplitude_nm", meaning="amplitude", needed="amplitude"),
        Column("amplitude", meaning="amplitude", needed="amplitude"),
        Column("phase_deg"),
        Column("amplitude_error_nm", meaning="amplitude_error"),
        Column("amplitude_error"),
        Column("phase_error_deg"),
    ),
    "point",
    separators=" (Nanonis text needs its line [DATA])",
)
"""The columns a file may have, and the attribute of `ResonanceSweep` that each becomes."""


@dataclass(frozen=True)
class ParsedSweep:
    """What a file says, in the names and units of `ResonanceSweep`."""

    columns: dict[str, Float[np.ndarray, " points"]]
    lines: Int[np.ndarray, " points"]
    amplitude_unit: str
    instrument: dict[str, float] = field(default_factory=dict)
    remarks: tuple[str, ...] = ()


def parse_csv(text: str, faults: Faults) -> ParsedSweep:
    """Read the text of a CSV file.

    Args:
        text: all of it.
        faults: where faults are noted; with any, the result is not to be used.

    Raises:
        TableError: at once where the column names are wrong: the cells below them cannot be judged.
    """
    comments, rows = split_lines(text)
    check_not_empty(comments, rows, faults)
    head, rows = named_rows(rows, SWEEP, faults)
    faults.raise_any()
    columns, _, lines = parse_rows(rows, head.names, SWEEP, faults)
    if "frequency_hz" in columns:
        columns["frequency_hz"] = columns["frequency_hz"] / HZ_PER_KHZ
    unit = "nm" if "amplitude_nm" in columns else ""
    attributes = {column.says: columns[column.name] for column in SWEEP.columns if column.name in columns}
    return ParsedSweep(attributes, lines, unit, remarks=tuple(remark for _, remark in comments))
