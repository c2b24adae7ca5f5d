"""A time trace as plain CSV: comment lines, a row of column names, a row for each sample."""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from fitting.resonance.sweep_rows import NumberedLines, parse_cells
from fitting.tables.table_columns import NUMBER, nearest_name
from fitting.tables.table_faults import Faults, quoted
from fitting.tables.table_rows import split_cells
from fitting.traces.lockin_settings import settings_of_comments

ATTRIBUTES = {
    "time_us": "time_us",
    "deflection_nm": "deflection_nm",
    "position_nm": "deflection_nm",
    "platform_nm": "platform",
    "drive": "platform",
}
"""The columns that are read, and what each becomes; `drive` is the drive's signal in any unit."""


@dataclass(frozen=True)
class ParsedTrace:
    """What a file says; `columns` holds time_us, deflection_nm, platform as far as they are there."""

    columns: dict[str, Float[np.ndarray, " samples"]]
    settings: dict[str, float]
    platform_in_nm: bool
    first_line: int = 0
    """Line of the first sample; 0 where the file has no lines."""
    remarks: tuple[str, ...] = field(default=())


def parse_csv(lines: NumberedLines, faults: Faults) -> ParsedTrace:
    """Read the lines of a CSV file; columns of other names are left alone.

    Args:
        lines: all of them, numbered.
        faults: where faults are noted; with any, the result is not to be used.

    Raises:
        TableError: at once where the column names are wrong: the cells below them cannot be judged.
    """
    comments = [(line, text.strip()[1:].strip()) for line, text in lines if text.strip().startswith("#")]
    rows = [(line, text) for line, text in lines if text.strip(",; \t") and not text.strip().startswith("#")]
    settings, remarks = settings_of_comments([comment for comment in comments if comment[1]], faults)
    if not rows:
        faults.add("there are no samples; add a row of column names and a row for each sample")
        faults.raise_any()
    line, text = rows.pop(0)
    names = split_cells(text)
    wanted = wanted_columns(names, faults, line=line)
    if not rows:
        faults.add("there are column names but no rows below them; add a row for each sample", line=line)
    faults.raise_any()
    columns = _numbers(rows, names, wanted, faults)
    attributes = {ATTRIBUTES[name]: column for name, column in columns.items()}
    return ParsedTrace(attributes, settings, "platform_nm" in wanted, rows[0][0], remarks)


def wanted_columns(names: list[str], faults: Faults, *, line: int = 0) -> list[str]:
    """Return those of the names that are read, after noting a missing deflection and columns that say the same.

    Args:
        names: of all columns (or data sets).
        faults: where faults are noted.
        line: of the names, for the messages.
    """
    if any(NUMBER.fullmatch(name) for name in names):
        faults.add("the first row holds numbers; put a row of column names above it: time_us,deflection_nm", line=line)
        return []
    wanted = [name for name in names if name in ATTRIBUTES]
    for name in names:
        meant = nearest_name(name, ATTRIBUTES) if name and name not in ATTRIBUTES else None
        if meant is not None and ATTRIBUTES[meant] not in {ATTRIBUTES[other] for other in wanted}:
            faults.add(f"unknown column {quoted(name)}; did you mean {meant}? The unit belongs to the name", line=line)
            return []
    meanings = [ATTRIBUTES[name] for name in wanted]
    for position, meaning in enumerate(meanings):
        if meaning in meanings[:position]:
            faults.add("says again what another column says; remove one", line=line, column=wanted[position])
    if "deflection_nm" not in meanings:
        there = f" (there are {', '.join(quoted(name) for name in names[:6])})" if any(names) else ""
        faults.add(f"the column deflection_nm is missing{there}; add it or rename the one that holds it", line=line)
    return wanted


def _numbers(
    rows: list[tuple[int, str]], names: list[str], wanted: list[str], faults: Faults
) -> dict[str, Float[np.ndarray, " samples"]]:
    """Return the wanted columns: at once where all rows are plain, cell by cell where one is not."""
    if any(";" in text or "\t" in text for _, text in rows[:1]):
        faults.add("the columns are separated by something else than commas; write commas", line=rows[0][0])
        faults.raise_any()
    try:
        positions = [names.index(name) for name in wanted]
        block = np.loadtxt([text for _, text in rows], delimiter=",", usecols=positions, ndmin=2, comments=None)
        if all(text.count(",") == len(names) - 1 for _, text in rows):
            return {name: block[:, position].copy() for position, name in enumerate(wanted)}
    except ValueError:
        # some cell is no number: the slow way names it
        pass
    columns, _ = parse_cells([(line, split_cells(text)) for line, text in rows], names, wanted, faults)
    faults.raise_any()
    return columns
