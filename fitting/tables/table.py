"""Amplitude tables: read them from CSV, check them, write them.

A table is a CSV file in UTF-8: comment lines about the cantilever, a row of column names, a row for each reading (of
drives that may be there repeatedly)::

    # free_frequency_khz = 90
    # quality_factor = 40 +- 2
    order,drive_frequency_khz,drive_amplitude_nm,offset_nm,peak_amplitude_nm,peak_amplitude_error_nm
    1,180,4,0,163.3,1.63

``quality_factor = none`` says that there is no air damping; a table that does not say it cannot be fitted. Its error
may be left out, and ``mass_ng`` or ``spring_constant_n_per_m`` (m = k/Omega^2; without both, energies are not known).
The columns ``order`` to ``offset_nm`` and one of ``peak_amplitude_nm`` and ``lockin_amplitude_nm`` are needed;
``phase_deg`` may join them. Each measured column has a column of standard errors (``..._error_nm``,
``phase_error_deg``); without it the scatter of repeated readings is taken, where they suffice. A blank cell in a
measured column says that this was not measured. A column ``no_orbit`` marks by 1 drives on which the tip settled on no
steady single-impact orbit (it stuck, or moved chaotically): their amplitudes are blank. Comments such as ``#
tip_calibration = 1 +- 0.02``, ``# drive_calibration = 1 +- 0.01`` and ``# offset_origin_nm = 0 +- 0.3`` say what is
known of the instrument. ``# rows = in order of time`` says that the rows stand as they were measured, so that a slow
drift of phase and amplitude can be fitted. Other comments are kept as remarks.

A cantilever that is driven itself over a sample at rest (a tapping or amplitude-phase-distance curve) says so::

    # drive = force
    # free_frequency_khz = 90 +- 0.01
    # quality_factor = 200 +- 2
    # spring_constant_n_per_m = 5.4 +- 0.5
    drive_frequency_khz,free_amplitude_nm,offset_nm,lockin_amplitude_nm,lockin_amplitude_error_nm,phase_lag_deg,phase_lag_error_deg
    92.7,80,-40,44.1,0.13,2.3,0.2

``drive = force`` acts on the tip (magnetic, photothermal), ``drive = base`` shakes the cantilever's base; ``sample``
is the default. ``free_amplitude_nm`` is the amplitude of the free tip, ``offset_nm`` the sample's height over the tip's
rest position, ``phase_lag_deg`` how far the response lags behind the drive; under ``base`` free and lock-in amplitude
are those of the deflection, the lag is behind the base. ``order`` may be left out (1), ``retract`` marks by 1 the rows
of the retract, and ``# phase_zero_deg = 0 +- 0.2`` says how well the instrument's zero of phase is known. ``#
phase_sense = lag`` says that ``phase_lag_deg`` is a lag for sure, ``lead`` that it is a phase that leads, ``either``
that its sign is not known and its zero that of the free tip; without that line the curve decides where it can.
"""

import math
import os
from collections.abc import Collection
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int, Real, Shaped

from afm_jax.checks import check_kind, checked
from afm_jax.results import Result, public_result
from afm_jax.units import TWO_SIDED_95, contradicting_mass, effective_mass_ng
from afm_jax.whole_files import write_whole
from fitting.tables.csv_text import (
    LARGEST,
    Column,
    Columns,
    FileSetting,
    Form,
    Source,
    TableError,
    check_names,
    column_of,
    fault_in_number,
    given_value,
    printable,
    quoted,
    read_comments,
    read_rows,
    read_text,
    setting_in,
    setting_line,
)

Rows = Float[np.ndarray, " rows"]
LEAST_REPEATS = 4
"""Readings beyond the first of each drive from which on their scatter gives errors."""
ERRORS_OF_REPEATS = "Errors from repeated readings: "
"""How the remark begins that says so."""
# Above one half: an overdamped cantilever does not vibrate.
LOWEST_QUALITY_FACTOR = math.nextafter(0.5, 1.0)
SETTINGS = {
    setting.key: setting
    for setting in (
        FileSetting("drive", "force", choices=("sample", "force", "base")),
        FileSetting("rows", "in order of time", choices=("in order of time",)),
        FileSetting("phase_sense", "lag", choices=("lag", "lead", "either")),
        FileSetting("free_frequency_khz", "90", error="maybe"),
        FileSetting("quality_factor", "40 (or 40 +- 2)", lowest=LOWEST_QUALITY_FACTOR, error="maybe", none=True),
        FileSetting("mass_ng"),
        FileSetting("spring_constant_n_per_m", "5.4 (or 5.4 +- 0.5)", error="maybe"),
        FileSetting("tip_calibration", "1 +- 0.02", error="always"),
        FileSetting("drive_calibration", "1 +- 0.02", error="always"),
        FileSetting("offset_origin_nm", "0 +- 0.3", lowest=-LARGEST, error="always"),
        FileSetting("phase_zero_deg", "0 +- 0.2", lowest=-LARGEST, error="always"),
    )
}
DRIVES = SETTINGS["drive"].choices
PHASE_SENSES = SETTINGS["phase_sense"].choices
CALIBRATION = tuple(key for key, setting in SETTINGS.items() if setting.error == "always")
"""Keys that must have an error: without one there is nothing uncertain about them."""


ERROR_OF = {
    "free_frequency_khz": "free_frequency_error_khz",
    "quality_factor": "quality_factor_error",
    "spring_constant_n_per_m": "spring_constant_error_n_per_m",
}
"""Numbers of the cantilever that may come with a standard error, and what that is called."""
_CANTILEVER = ("free_frequency_khz", "quality_factor", "mass_ng", "spring_constant_n_per_m")


_COLUMNS = (
    Column("order", needed="order", kind="whole"),
    Column("drive_frequency_khz", needed="drive frequency"),
    Column("drive_amplitude_nm", needed="drive amplitude"),
    Column("free_amplitude_nm", needed="free amplitude"),
    Column("offset_nm", needed="offset", kind="number"),
    Column("peak_amplitude_nm", needed="amplitude", error="peak_amplitude_error_nm", amplitude=True),
    Column("peak_amplitude_error_nm"),
    Column("lockin_amplitude_nm", needed="amplitude", error="lockin_amplitude_error_nm", amplitude=True),
    Column("lockin_amplitude_error_nm"),
    Column("phase_deg", error="phase_error_deg", kind="number"),
    Column("phase_error_deg"),
    Column("phase_lag_deg", error="phase_lag_error_deg", kind="number"),
    Column("phase_lag_error_deg"),
    Column("retract", kind="flag"),
    Column("no_orbit", kind="flag"),
)


def _form_without(*others: str, strange: str, optional: str = "") -> Form:
    """Return the form of tables that have all columns but those of the other form, of which it says what to do."""
    columns = [column for column in _COLUMNS if column.name not in others]
    columns = [replace(column, needed="") if column.name == optional else column for column in columns]
    return Form(tuple(columns), blanks=True, largest=LARGEST, strange=dict.fromkeys(others, strange))


TABLE = _form_without(
    *("free_amplitude_nm", "phase_lag_deg", "phase_lag_error_deg", "retract"),
    strange="belongs to a cantilever that is driven itself; add the line '# drive = force' or '# drive = base' above "
    "the names",
)
TAPPING = _form_without(
    *("drive_amplitude_nm", "peak_amplitude_nm", "peak_amplitude_error_nm", "phase_deg", "phase_error_deg"),
    strange="belongs to a sample that is driven; where the cantilever is driven the columns are free_amplitude_nm, "
    "lockin_amplitude_nm and phase_lag_deg instead",
    optional="order",
)
FORMS = {drive: TABLE if drive == "sample" else TAPPING for drive in DRIVES}
"""The columns of a table by what is driven."""
MEASURED = tuple(column for column in _COLUMNS if column.error is not None)


def columns_of(table: "AmplitudeTable") -> dict[str, Any]:
    """Return the columns that a table has, by name."""
    return {column.name: getattr(table, column.name) for column in _COLUMNS if getattr(table, column.name) is not None}


def required(columns: Collection[str]) -> tuple[Column, ...]:
    """Return the columns of a table in which every row needs a number."""
    return tuple(column for column in _COLUMNS if column.needed and not column.amplitude and column.name in columns)


def drive_numbers(columns: Columns) -> Int[np.ndarray, " rows"]:
    """Return the number of the drive that each row is of: the same for rows that repeat each other."""
    names = ["order", *(column.name for column in required(columns)), "retract"]
    keys = [np.nan_to_num(np.asarray(columns[name], float)) for name in dict.fromkeys(names) if name in columns]
    return np.unique(np.stack(keys), axis=1, return_inverse=True)[1].ravel()


def scatter_about_means(
    column: Column, columns: Columns, error: Rows | None
) -> tuple[Bool[np.ndarray, " rows"], int, float]:
    """Return which rows repeat others, degrees of freedom and chi2 of a measured column about each drive's mean.

    Angles are taken within half a turn of a drive's first.

    Args:
        column: the measured one.
        columns: of the table, by name.
        error: of each reading; None: as large as an amplitude's mean, or one degree.
    """
    values, drive = columns[column.name], drive_numbers(columns)
    known = np.isfinite(values) & ((values > 0.0) | (not column.amplitude))
    there = known & (np.bincount(drive[known], minlength=drive.max() + 1) > 1)[drive]
    if not there.any():
        return there, 0, 0.0
    _, first, place = np.unique(drive[there], return_index=True, return_inverse=True)
    apart = values[there] - values[there][first][place]
    if not column.amplitude:
        turn = 360.0 / columns.get("order", np.ones(len(values)))[there]
        apart = apart - turn * np.round(apart / turn)
    if error is None:
        means = np.bincount(place, values[there]) / np.bincount(place)
        error = np.ones(len(values))
        error[there] = means[place] if column.amplitude else 1.0
    weight = error[there] ** -2.0
    mean = np.bincount(place, weight * apart) / np.bincount(place, weight)
    return there, len(place) - len(first), float(np.sum(weight * (apart - mean[place]) ** 2))


def _fill_errors_of_repeats(columns: Columns) -> list[str]:
    """Add the errors that a table does not give, where repeated readings tell them: one scatter for all its rows.

    Amplitudes scatter by a share of them, phases by an angle. Of few readings the scatter is itself uncertain: it is
    widened by the quantile of Student's t over that of the normal distribution, so that 95 % intervals are that.

    Args:
        columns: of the table, by name, changed in place.

    Returns:
        A remark for each column that errors were added for.
    """
    remarks = []
    for column in MEASURED:
        if column.name not in columns or str(column.error) in columns:
            continue
        from scipy.stats import t as student_t  # noqa: PLC0415 - fits of other tables need no SciPy

        values = columns[column.name]
        known = np.isfinite(values) & ((values > 0.0) | (not column.amplitude))
        there, freedom, chi2 = scatter_about_means(column, columns, None)
        if freedom < LEAST_REPEATS or chi2 == 0.0:
            continue
        wider = float(student_t.ppf(0.975, freedom)) / TWO_SIDED_95
        error = wider * float(np.sqrt(chi2 / freedom))
        columns[str(column.error)] = np.where(known, error * (values if column.amplitude else 1.0), np.nan)
        said = f"{100.0 * error:.3g} %" if column.amplitude else f"{error:.3g} degrees"
        count = f"{int(there.sum())} rows of {len(np.unique(drive_numbers(columns)[there]))} drives"
        remarks.append(
            f"{ERRORS_OF_REPEATS}{column.name} +- {said} ({count}, widened {wider:.2f} times for their number)"
        )
    return remarks


def _check_rows(columns: Columns, form: Form, lines: Int[np.ndarray, " rows"], source: Source) -> None:
    """Check the numbers of a table.

    Args:
        columns: the columns by name, NaN where nothing was measured.
        form: what the table is to be.
        lines: the number of each row's line, for the messages.
        source: for messages.

    Raises:
        TableError: with the first fault: of impossible numbers, else of what must or must not stand together.
    """
    for name in columns:
        form.check_numbers(name, columns[name], lines, source)
    blank = {name: np.isnan(values) for name, values in columns.items()}
    for column in required(columns):
        source.refuse(blank[column.name], "is blank; every row needs it", lines, column.name)
    if form is TAPPING:
        message = "must be 1 where the cantilever is driven: amplitude and lag are read at the drive's frequency"
        source.refuse(columns["order"] > 1.0, f"{message}; remove the row", lines, "order")
    present = [column for column in MEASURED if column.name in columns]
    for column in present:
        value, error = blank[column.name], blank[str(column.error)]
        mend = f"fill {column.error} in" + _OR_NOISE * column.amplitude
        source.refuse(error & ~value, f"the value has no error; {mend}", lines, column.name)
        source.refuse(value & ~error, "the error has no value; fill it in or clear this cell", lines, column.error)
    amplitudes = [column.name for column in present if column.amplitude]
    empty = np.all([blank[name] for name in amplitudes], axis=0)
    unseen = np.zeros(len(lines), bool)
    message = f"the row has no amplitude; fill {' or '.join(amplitudes)} in or remove the row"
    if "no_orbit" in columns:
        unseen = columns["no_orbit"] == 1.0
        message += ", or set no_orbit to 1 if the tip settled on no orbit there"
    source.refuse(empty & ~unseen, message, lines)
    source.refuse(~empty & unseen, "the row has an amplitude; clear it or set no_orbit to 0", lines, "no_orbit")


_OR_NOISE = " or give the relative noise (`noise=0.01`)"


@public_result()
@dataclass(frozen=True, eq=False, kw_only=True)
class AmplitudeTable(Result):
    """Measured amplitudes of (1, N) orbits, a row for each reading; the arrays are read-only NumPy copies.

    A measured column is None if the table does not have it, and NaN in the rows where nothing was measured. A value
    always comes with its standard error, and every row has at least one amplitude or is marked ``no_orbit``.

    Attributes:
        drive_frequency_khz: frequency of the drive, shape (rows,).
        offset_nm: mean height of the platform above the tip's rest position, shape (rows,).
        free_frequency_khz: resonance frequency of the free cantilever.
        free_frequency_error_khz: its standard error, or None: taken as exact.
        drive: what is driven: "sample", "force" (on the tip) or "base" (of the cantilever).
        order: N, drive periods per impact, shape (rows,), integers; 1 if left out where the sample is not driven.
        drive_amplitude_nm: amplitude of the platform, shape (rows,); None where the sample is not driven.
        free_amplitude_nm: amplitude of the free tip, of its deflection under "base", shape (rows,); None where the
            sample is driven.
        peak_amplitude_nm: largest height of the tip above its rest position, shape (rows,), or None.
        peak_amplitude_error_nm: its standard error.
        lockin_amplitude_nm: 2/T |integral of z exp(-i omega t/N)| over whole response periods, shape (rows,), or None.
        lockin_amplitude_error_nm: its standard error.
        phase_deg: phi in z ~ a cos(omega t/N + phi), modulo 360/N, t = 0 when the platform is highest; or None.
        phase_error_deg: its standard error.
        phase_lag_deg: lag of the tip (of the deflection) behind the force (the base), shape (rows,), or None.
        phase_lag_error_deg: its standard error.
        retract: 1 where the sample moves away, else 0, shape (rows,); or None.
        no_orbit: 1 where the tip settled on no single-impact orbit, else 0, shape (rows,); or None.
        quality_factor: of the free cantilever; None: no air damping; NaN: not known, which no fit takes.
        quality_factor_error: its standard error, or None.
        mass_ng: effective mass of the cantilever; left out, that of the spring constant; None: not known.
        spring_constant_n_per_m: of the cantilever, or None: mass and frequency say it, if anything.
        spring_constant_error_n_per_m: its standard error, or None.
        calibration: value and standard error of ``tip_calibration``, ``drive_calibration``, ``offset_origin_nm`` and
            ``phase_zero_deg``, as far as they are uncertain.
        rows_in_order_of_time: whether the rows stand in the order in which they were measured.
        phase_sense: of ``phase_lag_deg``: "lag" or "lead" as stated, "either": not known; "": nothing is stated.
        source: path of the file as it was given.
        lines: the line of the file that each row stands in, shape (rows,); 1, 2, 3, ... for a table not from a file, or
            if as many are not given.
        remarks: free comments of the file.

    Raises:
        TableError: if a value is impossible, an error is missing or the lengths differ.
    """

    drive_frequency_khz: Rows
    offset_nm: Rows
    free_frequency_khz: float
    free_frequency_error_khz: float | None = None
    drive: str = "sample"
    order: Real[np.ndarray, " orders"] = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    drive_amplitude_nm: Rows | None = None
    free_amplitude_nm: Rows | None = None
    peak_amplitude_nm: Rows | None = None
    peak_amplitude_error_nm: Rows | None = None
    lockin_amplitude_nm: Rows | None = None
    lockin_amplitude_error_nm: Rows | None = None
    phase_deg: Rows | None = None
    phase_error_deg: Rows | None = None
    phase_lag_deg: Rows | None = None
    phase_lag_error_deg: Rows | None = None
    retract: Rows | None = None
    no_orbit: Rows | None = None
    quality_factor: float | None = float("nan")
    quality_factor_error: float | None = None
    mass_ng: float | None = None
    spring_constant_n_per_m: float | None = None
    spring_constant_error_n_per_m: float | None = None
    calibration: dict[str, tuple[float, float]] = field(default_factory=dict)
    rows_in_order_of_time: bool = False
    phase_sense: str = ""
    source: str = "table in memory"
    lines: Int[np.ndarray, " lines"] = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    remarks: tuple[str, ...] = ()

    def __post_init__(self):
        # Lines of another number are those of the table that this one was made from (`dataclasses.replace`).
        rows = np.size(self.drive_frequency_khz)
        own = len(self.lines) == rows
        source = Source(self.source, "line" if own else "row")
        for name, choices in (("drive", DRIVES), ("phase_sense", ("", *PHASE_SENSES))):
            if getattr(self, name) not in choices:
                raise source.fault(
                    f"{name} must be one of {', '.join(filter(None, choices))}, but is {getattr(self, name)!r}"
                )
        columns = columns_of(self)
        if self.tapping and np.size(self.order) == 0:
            columns["order"] = np.ones(rows)
        lines = np.array(self.lines if own else np.arange(1, rows + 1), dtype=np.int64)
        check_names(list(columns), self.form, source)
        columns = {name: column_of(name, values, rows, source) for name, values in columns.items()}
        for column in MEASURED:
            if (column.name in columns) != (column.error in columns):
                noise = f"{_OR_NOISE * column.amplitude}, or repeat readings: {LEAST_REPEATS} repeats tell them"
                mend = f"has no errors; add the column {column.error}{noise}"
                lacks = mend if column.name in columns else f"comes with {column.name}; give both or none"
                raise source.fault(lacks, column=column.name if column.name in columns else column.error)
        _check_header(self, source)
        _check_rows(columns, self.form, lines, source)
        if self.mass_ng is None and self.spring_constant_n_per_m is not None:
            mass = effective_mass_ng(self.spring_constant_n_per_m, self.free_frequency_khz)
            object.__setattr__(self, "mass_ng", float(mass))
        columns["order"] = columns["order"].astype(np.int64)
        for name, values in (columns | {"lines": lines}).items():
            values.setflags(write=False)
            object.__setattr__(self, name, values)

    @classmethod
    def from_dataframe(cls, frame: Any, *, noise: float | None = None, **header: Any) -> "AmplitudeTable":
        """Return the table of a pandas data frame.

        Args:
            frame: columns called as in a file, NaN where nothing was measured; its `attrs` may hold what follows.
            noise: standard error relative to the amplitude, for amplitudes without one of their own.
            header: the other attributes, as ``free_frequency_khz=90.0`` and ``quality_factor=40.0``.

        Raises:
            TableError: if a value is impossible, a column is not known or missing.
        """
        own = {field.name for field in fields(cls)}
        known: dict[str, Any] = {"source": "data frame"}
        known |= {name: value for name, value in frame.attrs.items() if name in own} | header
        names = [name for name in frame.columns if name != "lines"]
        source = Source(str(known["source"]), "row")
        check_names(names, FORMS.get(known.get("drive", "sample"), TABLE), source)
        if "free_frequency_khz" not in known:
            how = "as free_frequency_khz=... to AmplitudeTable.from_dataframe"
            raise source.fault(f"free_frequency_khz is missing; give it in `frame.attrs`, or {how}")
        return _completed({name: np.asarray(frame[name], np.float64) for name in names}, known, noise)

    @property
    def rows(self) -> int:
        """The number of rows of the table."""
        return len(self.order)

    @property
    def tables(self) -> tuple["AmplitudeTable", ...]:
        """A tuple of this table alone; several tables that are fitted together have more than one."""
        return (self,)

    @property
    def labels(self) -> tuple[str, ...]:
        """A tuple of the path that the table was read from, a name for each of `tables`."""
        return (self.source,)

    @property
    def row_names(self) -> Shaped[np.ndarray, " rows"]:
        """Names of the rows: the line of the file that each stands in."""
        return self.lines.astype(str)

    @property
    def form(self) -> Form:
        """The columns and settings that a table of what is driven here may have."""
        return FORMS[self.drive]

    @property
    def tapping(self) -> bool:
        """Whether the cantilever is driven, by a force or its base, and not the sample."""
        return self.drive != "sample"

    @property
    def excitation_nm(self) -> Rows:
        """Amplitude in nm of the sample, or of the free tip where the cantilever is driven."""
        found = self.free_amplitude_nm if self.tapping else self.drive_amplitude_nm
        assert found is not None  # checked when it was made  # noqa: S101
        return found

    @property
    def phase_and_error_deg(self) -> tuple[Rows | None, Rows | None]:
        """Phase of the orbit, or lag of the driven tip, and its standard error; None without them."""
        if self.tapping:
            return self.phase_lag_deg, self.phase_lag_error_deg
        return self.phase_deg, self.phase_error_deg


def _check_header(table: AmplitudeTable, source: Source) -> None:
    for name in _CANTILEVER:
        value, error = getattr(table, name), getattr(table, ERROR_OF.get(name, ""), None)
        if value is None or (name == "quality_factor" and np.isnan(value)):
            if error is not None:
                raise source.fault(f"{ERROR_OF[name]} stands without {name}; give both or none")
        elif fault := fault_in_number(SETTINGS[name], value, error):
            raise source.fault(f"{name} {fault}")
    if table.spring_constant_n_per_m is not None and table.mass_ng is not None:
        wrong = contradicting_mass(table.mass_ng, table.spring_constant_n_per_m, table.free_frequency_khz)
        if wrong is not None:
            raise source.fault(wrong)
    for remark in table.remarks:
        plain = remark and remark == remark.strip() and not set(remark) & set("\r\n\0")
        if not plain or setting_in(remark, SETTINGS) is not None:
            raise source.fault(
                f"the remark {quoted(remark)} would not be read back as one; make it one line of free text"
            )


def check_quality_factor(table: AmplitudeTable) -> None:
    """Check that a table says its quality factor, or that there is no air damping: the impacts' loss depends on it.

    Raises:
        TableError: if it does not.
    """
    if table.quality_factor is not None and np.isnan(table.quality_factor):
        raise TableError(
            f"{printable(table.source)}: the quality factor is missing, and the loss of the impacts depends on it; add "
            "a line such as '# quality_factor = 40 +- 2' above the column names or give `quality_factor=40, "
            "quality_factor_error=2` (`afm-jax calibrate` measures it); '# quality_factor = none' says that there is "
            "no air damping"
        )


@checked
def read_table(path: str | Path, noise: float | None = None) -> AmplitudeTable:
    """Read an amplitude table from a CSV file and check all of it.

    Args:
        path: the file, in the format described at the top of this module.
        noise: standard error of an amplitude relative to the amplitude (0.01 stands for 1 %), for amplitudes without
            an error of their own; those with one keep it.

    Raises:
        TableError: one line that names the first fault, its place, and how to mend it.
    """
    return parse_table(read_text(path), str(path), noise)


TableLike = AmplitudeTable | str | os.PathLike[str]
"""An amplitude table, or the path of its file."""


def as_table(given: TableLike, *, noise: float | None = None, quality_factor: Any = None) -> AmplitudeTable:
    """Return a table that was given, or is read from its file.

    Args:
        given: the table or the path.
        noise: of a file, as for `read_table`.
        quality_factor: in place of the table's: a number, a pair with its error, '40 +- 2', or 'none'.

    Raises:
        TypeError: if it is something else.
        TableError: as `read_table`.
    """
    if not isinstance(given, AmplitudeTable):
        check_kind("table", given, TableLike)
        given = read_table(Path(os.fspath(given)), noise)
    if quality_factor is None:
        return given
    value, error = (None, None) if quality_factor == "none" else given_value("quality_factor", quality_factor)
    return replace(given, quality_factor=value, quality_factor_error=error)


def parse_table(text: str, source: str, noise: float | None = None) -> AmplitudeTable:
    """Return the amplitude table that a text holds, all of it checked.

    Args:
        text: what stands in the file.
        source: its name, as it begins every message.
        noise: as for `read_table`.

    Raises:
        TableError: as `read_table`.
    """
    file = Source(source)
    if noise is not None and not 0.0 < noise < 1.0:
        raise file.fault(f"the relative noise must be between 0 and 1, but is {noise!r}; write 0.01 for 1 %")
    settings, remarks, rows = read_comments(text, SETTINGS, file)
    if "free_frequency_khz" not in settings:
        example = SETTINGS["free_frequency_khz"].line
        raise file.fault(f"the free frequency is missing; add a line such as '{example}' above the column names")
    known = [name for name in ("drive", "phase_sense", *_CANTILEVER) if name in settings]
    header: dict[str, Any] = {name: settings[name][0] for name in known}
    header |= {ERROR_OF[name]: settings[name][1] for name in known if name in ERROR_OF}
    columns, lines = read_rows(rows, FORMS[header.get("drive", "sample")], file)
    calibration = {key: settings[key] for key in CALIBRATION if key in settings}
    header |= {"calibration": calibration, "rows_in_order_of_time": "rows" in settings}
    header |= {"source": source, "lines": lines, "remarks": remarks}
    return _completed(columns, header, noise)


def _completed(columns: Columns, header: dict[str, Any], noise: float | None) -> AmplitudeTable:
    """Return a table of columns, with the errors that noise and repeated readings give.

    Args:
        columns: by name, NaN where nothing was measured; changed in place.
        header: the other attributes of the table.
        noise: relative noise of amplitudes without an error.

    Raises:
        TableError: as `read_table`.
    """
    for column in MEASURED:
        if noise is not None and column.amplitude and column.name in columns:
            values, error = columns[column.name], str(column.error)
            errors = columns.get(error, np.full(len(values), np.nan))
            columns[error] = np.where(np.isnan(errors), noise * values, errors)
    repeats = _fill_errors_of_repeats(columns)
    attributes: dict[str, Any] = {**header, **columns, "remarks": (*header.get("remarks", ()), *repeats)}
    return AmplitudeTable(**attributes)


@checked
def write_table(table: TableLike, path: str | Path) -> None:
    """Write an amplitude table as a CSV file that ``read_table`` reads back without loss.

    Args:
        table: the table.
        path: the file; one that exists is replaced.

    Raises:
        TableError: if the file cannot be written.
    """
    table = as_table(table)
    try:
        write_whole(path, csv_of(table), named_by_user=True)
    except OSError as error:
        raise TableError(f"{printable(str(path))}: {error.strerror}; choose another path") from error


def csv_of(table: AmplitudeTable) -> str:
    """Return an amplitude table as the text of a CSV file that ``read_table`` reads back without loss."""
    words = {"drive": table.drive if table.tapping else "", "phase_sense": table.phase_sense}
    words["rows"] = SETTINGS["rows"].example if table.rows_in_order_of_time else ""
    numbers = {name: (getattr(table, name), getattr(table, ERROR_OF.get(name, ""), None)) for name in _CANTILEVER}
    numbers |= {name: table.calibration[name] for name in CALIBRATION if name in table.calibration}
    lines = [setting_line(key, word, None) for key, word in words.items() if word]
    for key, (value, error) in numbers.items():
        if value is not None and not np.isnan(value):
            lines.append(setting_line(key, float(value), error and float(error)))
    lines += ["# quality_factor = none"] if table.quality_factor is None else []
    lines += [f"# {remark}" for remark in table.remarks]
    columns = {name: getattr(table, name) for name in table.form.names if getattr(table, name) is not None}
    if table.tapping and np.all(table.order == 1):
        del columns["order"]
    lines.append(",".join(columns))
    # tolist gives Python numbers, whose repr is the shortest text that reads back as the same number.
    cells = [["" if value != value else repr(value) for value in column.tolist()] for column in columns.values()]  # noqa: PLR0124
    lines += [",".join(row) for row in zip(*cells, strict=True)]
    return "\n".join(lines) + "\n"
