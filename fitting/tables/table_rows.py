"""The columns of an amplitude table, and the checks that every table must pass."""

import numpy as np
from jaxtyping import Bool, Float, Int

from fitting.tables.csv_text import Column, Columns, Faults, Form, Head, Masks

COLUMNS = (
    Column("order", needed="order", required=True, integer=True),
    Column("drive_frequency_khz", "kHz", needed="drive frequency", required=True),
    Column("drive_amplitude_nm", "nm", needed="drive amplitude", required=True),
    Column("offset_nm", "nm", needed="offset", required=True, positive=False),
    Column("peak_amplitude_nm", "nm", needed="amplitude", error="peak_amplitude_error_nm", amplitude=True),
    Column("peak_amplitude_error_nm", "nm"),
    Column("lockin_amplitude_nm", "nm", needed="amplitude", error="lockin_amplitude_error_nm", amplitude=True),
    Column("lockin_amplitude_error_nm", "nm"),
    Column("phase_deg", "degrees", error="phase_error_deg", positive=False),
    Column("phase_error_deg", "degrees"),
    Column("no_orbit", positive=False, flag=True),
)
TABLE = Form(
    COLUMNS,
    "drive",
    blanks=True,
    fewer="fill in the others",
    more="remove the others; a decimal comma must be a point",
    number="write it like 174.6 or 1.746e2, without a unit",
)
COLUMN_NAMES = TABLE.names
REQUIRED = tuple(column for column in COLUMNS if column.required)
MEASURED = tuple(column for column in COLUMNS if column.error is not None)
AMPLITUDES = tuple(column for column in COLUMNS if column.amplitude)


def check_error_columns(head: Head, faults: Faults, noise: float | None) -> None:
    """Note measured columns without their errors, and errors without what they belong to.

    Args:
        head: the column names.
        faults: where the faults are noted.
        noise: relative noise for amplitudes without an error column, or None.
    """
    for column in MEASURED:
        error, line = str(column.error), head.line
        if error in head.present and column.name not in head.present:
            message = f"stands without {column.name}; add that column or remove this one"
            faults.add(message, line=line, column=error)
        if column.name not in head.present or error in head.present:
            continue
        if not column.amplitude:
            faults.add(f"has no errors; add the column {error}", line=line, column=column.name)
        elif noise is None:
            hint = f"add the column {error} or give the relative noise (--noise 1%)"
            faults.add(f"has no errors; {hint}", line=line, column=column.name)


def fill_errors(columns: Columns, unreadable: Masks, noise: float | None) -> None:
    """Set the errors that amplitudes lack to the relative noise times the amplitude.

    Args:
        columns: the table's columns, changed in place.
        unreadable: masks of cells whose fault is noted elsewhere, changed in place: errors of impossible amplitudes.
        noise: relative noise, for example 0.01; None leaves the columns as they are.
    """
    if noise is None:
        return
    for column in AMPLITUDES:
        if column.name in columns:
            values, error = columns[column.name], str(column.error)
            errors = columns.get(error, np.full(len(values), np.nan))
            possible = np.isfinite(values) & (values > 0.0)
            columns[error] = np.where(np.isnan(errors) & possible, noise * values, errors)
            value_is_bad = ~possible & (~np.isnan(values) | unreadable[column.name])
            unreadable[error] = unreadable.get(error, np.zeros(len(values), dtype=bool)) | value_is_bad


def check_rows(
    columns: Columns, lines: Int[np.ndarray, " rows"], faults: Faults, unreadable: Masks | None = None
) -> None:
    """Check the numbers of a table and note every fault.

    Args:
        columns: the columns by name, NaN where nothing was measured.
        lines: the number of each row's line, for the messages.
        faults: where the faults are noted.
        unreadable: masks of cells whose fault has been noted already.
    """
    rows = len(lines)
    known_bad = {name: np.zeros(rows, dtype=bool) for name in columns} | (unreadable or {})
    for column in COLUMNS:
        if column.name in columns:
            # A cell with an impossible number is not to be blamed a second time for what depends on it.
            known_bad[column.name] |= _check_numbers(column, columns[column.name], lines, faults)
    for column in REQUIRED:
        for row in np.flatnonzero(np.isnan(columns[column.name]) & ~known_bad[column.name]):
            faults.add("is blank; every row needs it", line=int(lines[row]), column=column.name)
    blank = {name: np.isnan(values) & ~known_bad[name] for name, values in columns.items()}
    unseen = columns.get("no_orbit", np.zeros(rows)) == 1.0
    _check_measured(blank, unseen, lines, faults)
    _check_duplicates(columns, lines, faults)


def _check_numbers(
    column: Column, values: Float[np.ndarray, " rows"], lines: Int[np.ndarray, " rows"], faults: Faults
) -> Bool[np.ndarray, " rows"]:
    bad = np.isinf(values)
    what = "must be finite"
    if column.positive:
        bad |= values <= 0.0
        what = "must be finite and above 0"
    if column.integer:
        # Larger numbers would not survive the way through 64-bit floats.
        bad |= (values != np.floor(values)) | (values >= 2**53)
        bad &= ~np.isnan(values)
        what = "must be a positive whole number (1, 2, 3, ...)"
    if column.flag:
        bad |= ~np.isnan(values) & (values != 0.0) & (values != 1.0)
        what = "must be 1 (no steady orbit was seen) or 0"
    for row in np.flatnonzero(bad):
        number = repr(float(values[row])).removesuffix(".0")
        faults.add(f"{what}, but is {number}; correct it{_or_blank(column)}", line=int(lines[row]), column=column.name)
    return bad


def _or_blank(column: Column) -> str:
    return " or leave it blank if it was not measured" if column.error is not None else ""


def _check_measured(
    blank: Masks, unseen: Bool[np.ndarray, " rows"], lines: Int[np.ndarray, " rows"], faults: Faults
) -> None:
    """Note values without error, errors without value, and rows without an amplitude that are not marked `no_orbit`."""
    for column in MEASURED:
        if column.name not in blank or column.error not in blank:
            continue
        mend = f"fill {column.error} in" + (" or give the relative noise (--noise 1%)" if column.amplitude else "")
        for row in np.flatnonzero(blank[column.error] & ~blank[column.name]):
            faults.add(f"the value has no error; {mend}", line=int(lines[row]), column=column.name)
        for row in np.flatnonzero(blank[column.name] & ~blank[column.error]):
            message = f"the error has no value; fill {column.name} in or clear this cell"
            faults.add(message, line=int(lines[row]), column=column.error)
    present = [column.name for column in AMPLITUDES if column.name in blank]
    if present:
        # An error without its value has been noted already.
        empty = [blank[name] for column in AMPLITUDES for name in (column.name, column.error) if name in blank]
        for row in np.flatnonzero(np.all(empty, axis=0) & ~unseen):
            message = f"the row has no amplitude; fill {' or '.join(present)} in or remove the row"
            message += ", or set no_orbit to 1 if the tip settled on no orbit there" if "no_orbit" in blank else ""
            faults.add(message, line=int(lines[row]))
        for row in np.flatnonzero(~np.all(empty, axis=0) & unseen):
            message = "the row has an amplitude; clear it or set no_orbit to 0"
            faults.add(message, line=int(lines[row]), column="no_orbit")


def _check_duplicates(columns: Columns, lines: Int[np.ndarray, " rows"], faults: Faults) -> None:
    keys = np.stack([columns[column.name] for column in REQUIRED])
    # The sort is stable: of rows with equal keys the earlier one stays first.
    order = np.lexsort(keys)
    same = np.all(keys[:, order[1:]] == keys[:, order[:-1]], axis=0)
    for position in np.flatnonzero(same):
        first, second = int(lines[order[position]]), int(lines[order[position + 1]])
        what = f"repeats {faults.place} {first} (same order, drive frequency, drive amplitude and offset)"
        faults.add(f"{what}; average the measurements into one row or remove one", line=second)
