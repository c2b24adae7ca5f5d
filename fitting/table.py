"""Amplitude tables: read them from CSV, check them, write them.

A table is a CSV file in UTF-8: comment lines about the cantilever, a row of column names, a row for each drive::

    # free_frequency_khz = 90
    # quality_factor = 40 +- 2
    order,drive_frequency_khz,drive_amplitude_nm,offset_nm,peak_amplitude_nm,peak_amplitude_error_nm
    1,180,4,0,163.3,1.63

``quality_factor`` may be left out (not known), its error too, and ``mass_ng`` (then 1). The columns ``order`` to
``offset_nm`` and one of ``peak_amplitude_nm`` and ``lockin_amplitude_nm`` are needed; ``phase_deg`` may join them. Each
measured column has a column of standard errors (``..._error_nm``, ``phase_error_deg``). A blank cell in a measured
column says that this was not measured. A column ``no_orbit`` marks by 1 drives on which the tip settled on no steady
single-impact orbit (it stuck, or moved chaotically): their amplitudes are blank. Comments such as
``# tip_calibration = 1 +- 0.02``, ``# drive_calibration = 1 +- 0.01`` and ``# offset_origin_nm = 0 +- 0.3`` say what is
known of the instrument. Other comments are kept as remarks.
"""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from fitting.tables.csv_text import (
    Faults,
    TableError,
    check_not_empty,
    column_of,
    fault_in_number,
    named_rows,
    parse_rows,
    printable,
    quoted,
    read_text,
    setting_in,
    split_lines,
)
from fitting.tables.table_comments import CALIBRATION, SETTINGS, parse_comments
from fitting.tables.table_rows import (
    AMPLITUDES,
    COLUMN_NAMES,
    MEASURED,
    TABLE,
    check_error_columns,
    check_rows,
    fill_errors,
)

__all__ = ["AmplitudeTable", "TableError", "read_table", "write_table"]


@dataclass(frozen=True, eq=False, kw_only=True)
class AmplitudeTable:
    """Measured amplitudes of (1, N) orbits, one row for each drive; the arrays are read-only NumPy copies.

    A measured column is None if the table does not have it, and NaN in the rows where nothing was measured. A value
    always comes with its standard error, and every row has at least one amplitude or is marked ``no_orbit``.

    Attributes:
        order: N, drive periods per impact, shape (rows,), integers.
        drive_frequency_khz: frequency of the platform, shape (rows,).
        drive_amplitude_nm: amplitude of the platform, shape (rows,).
        offset_nm: mean height of the platform above the tip's rest position, shape (rows,).
        free_frequency_khz: resonance frequency of the free cantilever.
        peak_amplitude_nm: largest height of the tip above its rest position, shape (rows,), or None.
        peak_amplitude_error_nm: its standard error.
        lockin_amplitude_nm: 2/T |integral of z exp(-i omega t/N)| over whole response periods, shape (rows,), or None.
        lockin_amplitude_error_nm: its standard error.
        phase_deg: phi in z ~ a cos(omega t/N + phi), modulo 360/N, t = 0 when the platform is highest; or None.
        phase_error_deg: its standard error.
        no_orbit: 1 where the tip settled on no single-impact orbit, else 0, shape (rows,); or None.
        quality_factor: of the free cantilever, or None: not known.
        quality_factor_error: its standard error, or None.
        mass_ng: effective mass of the cantilever.
        calibration: value and standard error of ``tip_calibration``, ``drive_calibration``, ``offset_origin_nm``, as
            far as they are uncertain.
        source: path of the file as it was given.
        lines: the line of the file that each row stands in, shape (rows,); 1, 2, 3, ... for a table not from a file, or
            if as many are not given.
        remarks: free comments of the file.

    Raises:
        TableError: if a value is impossible, an error is missing, a row repeats another or the lengths differ.
    """

    order: Int[np.ndarray, " rows"]
    drive_frequency_khz: Float[np.ndarray, " rows"]
    drive_amplitude_nm: Float[np.ndarray, " rows"]
    offset_nm: Float[np.ndarray, " rows"]
    free_frequency_khz: float
    peak_amplitude_nm: Float[np.ndarray, " rows"] | None = None
    peak_amplitude_error_nm: Float[np.ndarray, " rows"] | None = None
    lockin_amplitude_nm: Float[np.ndarray, " rows"] | None = None
    lockin_amplitude_error_nm: Float[np.ndarray, " rows"] | None = None
    phase_deg: Float[np.ndarray, " rows"] | None = None
    phase_error_deg: Float[np.ndarray, " rows"] | None = None
    no_orbit: Float[np.ndarray, " rows"] | None = None
    quality_factor: float | None = None
    quality_factor_error: float | None = None
    mass_ng: float = 1.0
    calibration: dict[str, tuple[float, float]] = field(default_factory=dict)
    source: str = "table in memory"
    lines: Int[np.ndarray, " lines"] = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    remarks: tuple[str, ...] = ()

    def __post_init__(self):
        # Lines of another number are those of the table that this one was made from (`dataclasses.replace`).
        own = len(self.lines) == np.size(self.order)
        faults = Faults(self.source, place="line" if own else "row")
        columns = {name: getattr(self, name) for name in COLUMN_NAMES if getattr(self, name) is not None}
        lines = self.lines if own else np.arange(1, np.size(self.order) + 1)
        columns = {name: column_of(name, values, len(lines), faults) for name, values in columns.items()}
        _check_pairs(columns, faults)
        _check_header(self, faults)
        faults.raise_any()
        check_rows(columns, np.asarray(lines), faults)
        faults.raise_any()
        columns["order"] = columns["order"].astype(np.int64)
        for name, values in (columns | {"lines": np.array(lines, dtype=np.int64)}).items():
            values.setflags(write=False)
            object.__setattr__(self, name, values)

    @property
    def rows(self) -> int:
        """Number of rows."""
        return len(self.order)


def _check_pairs(columns: dict[str, Float[np.ndarray, "..."]], faults: Faults) -> None:
    """Note a measured column without its errors, errors without their column, and a table without amplitudes."""
    for column in MEASURED:
        if (column.name in columns) != (column.error in columns):
            faults.add(f"{column.name} and {column.error} come together; give both or none")
    if not any(column.name in columns for column in AMPLITUDES):
        faults.add(f"there is no amplitude; give {' or '.join(column.name for column in AMPLITUDES)}")


def _check_header(table: AmplitudeTable, faults: Faults) -> None:
    for key, error in (("free_frequency_khz", None), ("quality_factor", table.quality_factor_error), ("mass_ng", None)):
        value = getattr(table, key)
        fault = None if value is None else fault_in_number(SETTINGS[key], value, error)
        if fault is not None:
            faults.add(f"{key} {fault}")
    if table.quality_factor is None and table.quality_factor_error is not None:
        faults.add("quality_factor_error stands without quality_factor; give both or none")
    for remark in table.remarks:
        if (
            setting_in(remark, SETTINGS) is not None
            or remark != remark.strip()
            or not remark
            or set(remark) & set("\r\n\0")
        ):
            faults.add(f"the remark {quoted(remark)} would not be read back as one; make it one line of free text")


def read_table(path: str | Path, noise: float | None = None) -> AmplitudeTable:
    """Read an amplitude table from a CSV file and check all of it.

    Args:
        path: the file, in the format described at the top of this module.
        noise: standard error of an amplitude relative to the amplitude (0.01 stands for 1 %), for amplitudes without
            an error of their own; those with one keep it.

    Raises:
        TableError: one line that names the first fault, its place and how to mend it, and the number of other faults.
    """
    faults = Faults(str(path))
    if noise is not None and not 0.0 < noise < 1.0:
        faults.add(f"the relative noise must be between 0 and 1, but is {noise!r}; write 0.01 for 1 %")
        faults.raise_any()
    comments, rows = split_lines(read_text(path))
    check_not_empty(comments, rows, faults)
    header = parse_comments(comments, faults)
    found = faults.count
    head, rows = named_rows(rows, TABLE, faults)
    check_error_columns(head, faults, noise)
    if faults.count > found:
        # With a wrong name the cells below it cannot be judged.
        faults.raise_any()
    columns, unreadable, lines = parse_rows(rows, head.names, TABLE, faults)
    fill_errors(columns, unreadable, noise)
    check_rows(columns, lines, faults, unreadable)
    faults.raise_any()
    arrays = {name: columns.get(name) for name in COLUMN_NAMES} | {"order": columns["order"].astype(np.int64)}
    return AmplitudeTable(**arrays, **vars(header), source=str(path), lines=lines)


def write_table(table: AmplitudeTable, path: str | Path) -> None:
    """Write an amplitude table as a CSV file that ``read_table`` reads back without loss.

    Args:
        table: the table.
        path: the file; one that exists is replaced.

    Raises:
        TableError: if the file cannot be written.
    """
    quality_factor, error = table.quality_factor, table.quality_factor_error
    lines = [f"# free_frequency_khz = {float(table.free_frequency_khz)!r}"]
    if quality_factor is not None:
        tail = "" if error is None else f" +- {float(error)!r}"
        lines.append(f"# quality_factor = {float(quality_factor)!r}{tail}")
    lines.append(f"# mass_ng = {float(table.mass_ng)!r}")
    known = [(name, *table.calibration[name]) for name in CALIBRATION if name in table.calibration]
    lines += [f"# {name} = {float(value)!r} +- {float(error)!r}" for name, value, error in known]
    lines += [f"# {remark}" for remark in table.remarks]
    columns = {name: getattr(table, name) for name in COLUMN_NAMES if getattr(table, name) is not None}
    lines.append(",".join(columns))
    # tolist gives Python numbers, whose repr is the shortest text that reads back as the same number.
    cells = [["" if value != value else repr(value) for value in column.tolist()] for column in columns.values()]  # noqa: PLR0124
    lines += [",".join(row) for row in zip(*cells, strict=True)]
    try:
        Path(path).write_text("\n".join(lines) + "\n", encoding="utf-8", newline="\n")
    except (OSError, UnicodeEncodeError) as error_met:
        reason = getattr(error_met, "strerror", None) or str(error_met)
        raise TableError(f"{printable(str(path))}: cannot be written ({reason}); choose another path") from error_met
