"""The columns of an amplitude table: a small specification, and the check of a file's column names."""

import difflib
import re
from collections.abc import Iterable
from dataclasses import dataclass

from fitting.tables.table_faults import Faults, quoted

NUMBER = re.compile(r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?", re.ASCII)
"""A number as a table writes it; stricter than ``float``, which also takes "nan", "inf" and "1_000"."""

DECIMAL_COMMA = re.compile(r"[+-]?\d+,\d+(?:[eE][+-]?\d+)?", re.ASCII)


@dataclass(frozen=True)
class Column:
    """One column of the table.

    Attributes:
        name: its name, which is also the attribute of ``AmplitudeTable``.
        unit: its unit in words of a message; empty for a plain number.
        positive: whether its numbers must be above zero.
        integer: whether its numbers must be whole.
        required: whether every table and every row needs it.
        error: the name of the column that holds its standard errors, for a measured column.
        amplitude: whether it is a measured amplitude: each row needs one, and a relative noise applies to it.
        flag: whether its numbers are 0 or 1.
    """

    name: str
    unit: str
    positive: bool = True
    integer: bool = False
    required: bool = False
    error: str | None = None
    amplitude: bool = False
    flag: bool = False


COLUMNS = (
    Column("order", "", required=True, integer=True),
    Column("drive_frequency_khz", "kHz", required=True),
    Column("drive_amplitude_nm", "nm", required=True),
    Column("offset_nm", "nm", required=True, positive=False),
    Column("peak_amplitude_nm", "nm", error="peak_amplitude_error_nm", amplitude=True),
    Column("peak_amplitude_error_nm", "nm"),
    Column("lockin_amplitude_nm", "nm", error="lockin_amplitude_error_nm", amplitude=True),
    Column("lockin_amplitude_error_nm", "nm"),
    Column("phase_deg", "degrees", error="phase_error_deg", positive=False),
    Column("phase_error_deg", "degrees"),
    Column("no_orbit", "", positive=False, flag=True),
)
COLUMN_NAMES = tuple(column.name for column in COLUMNS)
REQUIRED = tuple(column for column in COLUMNS if column.required)
MEASURED = tuple(column for column in COLUMNS if column.error is not None)
AMPLITUDES = tuple(column for column in COLUMNS if column.amplitude)
UNIT_OF = {column.name: column.unit for column in COLUMNS}


def plain_name(text: str) -> str:
    """Return a name in the table's spelling: lower case, words joined by underscores, no brackets around units."""
    return "_".join(re.findall(r"\w+", text.lower().replace("_", " ")))


def without_unit(name: str) -> str:
    """Return a name without its last word, where that may be a unit: one of five letters at most."""
    stem, _, unit = name.rpartition("_")
    return stem if stem and len(unit) <= 5 else name


def _has_unit(name: str) -> bool:
    return name.rpartition("_")[2] in {"khz", "nm", "deg", "ng"}


def nearest_name(text: str, known: Iterable[str], *, cutoff: float = 0.75) -> str | None:
    """Return the known name that a misspelt one or one with another unit was meant to be, or None.

    Args:
        text: the name as it stands in the file.
        known: the right names; their unit is the last word.
        cutoff: similarity (0 to 1, as difflib counts it) that a misspelling must reach.
    """
    known = list(known)
    name = plain_name(text)
    for candidate in known:
        if name in {candidate, without_unit(candidate)}:
            return candidate
    for candidate in known:
        if _has_unit(candidate) and without_unit(name) == without_unit(candidate):
            return candidate
    return next(iter(difflib.get_close_matches(name, known, n=1, cutoff=cutoff)), None)


def check_column_names(names: list[str], *, line: int, faults: Faults, noise: float | None) -> None:
    """Check the row of column names and note every fault in it.

    Args:
        names: the cells of that row, stripped.
        line: its line number in the file.
        faults: where the faults are noted.
        noise: relative noise for amplitudes without an error column, or None.
    """
    if any(NUMBER.fullmatch(name) for name in names):
        faults.add("the first row holds numbers; put the row of column names above it", line=line)
        return
    meant = _check_each_name(names, line=line, faults=faults)
    # A name that was only misspelt has been reported; that its column is then missing is not a second fault.
    present = set(names) | meant
    for column in REQUIRED:
        if column.name not in present:
            faults.add(f"the column {column.name}{_in_unit(column.name)} is missing; add it", line=line)
    if not any(column.name in present or column.error in present for column in AMPLITUDES):
        either = " or ".join(column.name for column in AMPLITUDES)
        faults.add(f"there is no amplitude column; add {either}", line=line)
    for column in MEASURED:
        _check_error_column(column, present, line=line, faults=faults, noise=noise)


def _check_each_name(names: list[str], *, line: int, faults: Faults) -> set[str]:
    """Note unknown, empty and doubled names; return the right names that unknown ones were meant to be."""
    meant = set()
    for position, name in enumerate(names, start=1):
        if not name:
            faults.add(f"column {position} has no name; name it or remove its comma", line=line)
        elif name in names[: position - 1]:
            first = names.index(name) + 1
            faults.add(f"is there twice, as columns {first} and {position}; remove one", line=line, column=name)
        elif name not in COLUMN_NAMES:
            suggestion = nearest_name(name, COLUMN_NAMES)
            faults.add(_unknown_column(name, suggestion), line=line)
            if suggestion is not None:
                meant.add(suggestion)
    return meant


def _unknown_column(name: str, suggestion: str | None) -> str:
    if suggestion is None:
        return f"unknown column {quoted(name)}; remove it, the columns are {', '.join(COLUMN_NAMES)}"
    plain = plain_name(name)
    if plain != suggestion and _has_unit(suggestion) and without_unit(plain) == without_unit(suggestion) != plain:
        return f"unknown unit in column {quoted(name)}; convert it and name it {suggestion}{_in_unit(suggestion)}"
    return f"unknown column {quoted(name)}; did you mean {suggestion}{_in_unit(suggestion)}?"


def _in_unit(name: str) -> str:
    return f" (in {UNIT_OF[name]})" if UNIT_OF[name] else ""


def _check_error_column(column: Column, present: set[str], *, line: int, faults: Faults, noise: float | None) -> None:
    error = str(column.error)
    if error in present and column.name not in present:
        faults.add(f"stands without {column.name}; add that column or remove this one", line=line, column=error)
    if column.name not in present or error in present:
        return
    if not column.amplitude:
        faults.add(f"has no errors; add the column {error}", line=line, column=column.name)
    elif noise is None:
        hint = f"add the column {error} or give the relative noise (--noise 1%)"
        faults.add(f"has no errors; {hint}", line=line, column=column.name)
