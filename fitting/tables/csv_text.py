"""CSV files: from bytes to columns of numbers by a specification of the columns, every fault one line with its place.

A file is UTF-8 text: comment lines that begin with a number sign, a row of column names, a row of cells for each thing
that was measured. What the columns are a `Form` says; tables of amplitudes, resonance sweeps, time traces and laws are
read by the same functions.
"""

import csv
import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool, Float, Int, Shaped

from afm_jax.whole_files import LARGEST_BYTES, read_whole
from afm_jax.words import NUMBER, nearest_name, printable, value_and_error

# a cell may be as long as a file
csv.field_size_limit(LARGEST_BYTES)
DECIMAL_COMMA = re.compile(r"[+-]?\d+,\d+(?:[eE][+-]?\d+)?", re.ASCII)
# A colon makes a key only in front of a number: "Measured: Tuesday" is a remark.
_KEY_AND_VALUE = re.compile(r"\s*(?P<key>[^=:]+?)\s*(?:(?P<sign>=)|:(?=\s*[-+.\d]))(?P<value>.*)", re.DOTALL)
_SHORT_NAMES = {"q": "quality_factor", "q_factor": "quality_factor", "f0": "free_frequency_khz"}
"""What people call a key, too far from its name for a comparison of letters."""

SETTING_NAMES = frozenset(
    {
        *("drive", "rows", "free_frequency_khz", "quality_factor", "mass_ng", "spring_constant_n_per_m"),
        *("tip_calibration", "drive_calibration", "offset_origin_nm", "phase_zero_deg"),
        *("averages", "temperature_k", "length_um", "width_um", "scale_error", "drive_frequency_khz"),
    }
)
"""What a comment sets in one file or another: where it sets nothing it is refused, never left among the remarks."""

Rows = Float[np.ndarray, " rows"]
Lines = Int[np.ndarray, " rows"]
NumberedLines = list[tuple[int, str]]
"""Lines of a file, each with its number."""
Columns = dict[str, Shaped[np.ndarray, " rows"]]
"""Columns by name: numbers, of orders whole ones."""


class TableError(ValueError):
    """Raised where a file or table cannot be used; the message is one line: what, where, how to mend it."""


@dataclass(frozen=True)
class Source:
    """What numbers are read from, and how a message names a place in it.

    Attributes:
        name: of the file or table, as it begins every message.
        row: what a row's number is called, "line" for a file and "row" for a table in memory.
    """

    name: str
    row: str = "line"

    def fault(self, message: str, *, line: int = 0, column: str | None = None) -> TableError:
        """Return the error of a fault.

        Args:
            message: what is wrong and how to mend it, without the place.
            line: number of the line (or row) it is in; 0 stands for the table as a whole.
            column: name of the column it is in.
        """
        place = f", {self.row} {line}" if line else ""
        place += "" if column is None else f", column {column}"
        return TableError(f"{printable(self.name)}{place}: {message}")

    def refuse(self, bad: Bool[np.ndarray, " rows"], message: str, lines: Lines, column: str | None = None) -> None:
        """Check that no row is bad.

        Args:
            bad: which rows are.
            message: as for `fault`.
            lines: number of the line of each row.
            column: as for `fault`.

        Raises:
            TableError: of the first row that is.
        """
        if bad.any():
            raise self.fault(message, line=int(lines[np.argmax(bad)]), column=column)


LARGEST = 1e9
"""Size of any number in a table: a length of a metre, a frequency of a terahertz."""
FARTHEST = 1e30
"""Size of a number in any unit, and the inverse of one that must be above 0: the powers of others are no numbers."""


def quoted(text: str) -> str:
    """Return a piece of the file for a message: in quotation marks, escaped, and cut after 40 characters."""
    return repr(text if len(text) <= 40 else text[:40] + "...")


@dataclass(frozen=True)
class Column:
    """One column that a form of file may have.

    Attributes:
        name: its name in the file.
        kind: what its numbers must be; see `Form.check_numbers`.
        meaning: what its numbers become; empty: the name. Columns of one meaning are aliases; a file has one.
        needed: what it gives, in a word, if every file needs a column that gives it; else empty.
        error: the name of the column that holds its standard errors, for a measured column.
        amplitude: whether it is a measured amplitude: each row needs one, and a relative noise applies to it.
        convert: makes the unit of the meaning of its numbers; None: they have it.
    """

    name: str
    kind: Literal["number", "not negative", "positive", "whole", "flag"] = "positive"
    meaning: str = ""
    needed: str = ""
    error: str | None = None
    amplitude: bool = False
    convert: Callable[[Rows], Rows] | None = None

    @property
    def becomes(self) -> str:
        """What its numbers become."""
        return self.meaning or self.name


@dataclass(frozen=True)
class Form:
    """A form of file: its columns, and the words that its messages need.

    Attributes:
        columns: the columns it may have.
        open: whether columns of other names are left alone, not refused.
        blanks: whether cells may be blank (NaN); else every cell is needed.
        largest: size of any number.
        strange: columns that other files have, and what to do about them.
    """

    columns: tuple[Column, ...]
    open: bool = False
    blanks: bool = False
    largest: float = FARTHEST
    strange: Mapping[str, str] = field(default_factory=dict)

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the table's columns."""
        return tuple(column.name for column in self.columns)

    def check_numbers(self, name: str, values: Rows, lines: Lines, source: Source) -> None:
        """Check the numbers of a column: a "number" is finite, a "whole" one 1, 2, 3, ..., a "flag" 0 or 1.

        Args:
            name: of the column, or what it becomes.
            values: its numbers, NaN where nothing was measured.
            lines: where each stands.
            source: for messages.
        """
        kind = next(one.kind for one in self.columns if name in {one.name, one.becomes})
        lowest = {"number": -self.largest, "positive": 1.0 / FARTHEST, "whole": 1.0}.get(kind, 0.0)
        highest, whole = 1.0 if kind == "flag" else self.largest, kind in {"whole", "flag"}
        must = f"{'be a whole number' if whole else 'lie'} between {lowest:g} and {highest:g}"
        good = (values >= lowest) & (values <= highest) & ((not whole) | (values == np.floor(values)))
        bad = ~(good | (np.isnan(values) & self.blanks))
        number = repr(float(values[np.argmax(bad)])).removesuffix(".0")
        source.refuse(bad, f"must {must}, but is {number}; correct it or remove the row", lines, name)


@dataclass(frozen=True)
class FileSetting:
    """A number that a comment line can set, `# key = value` or `# key = value +- error`.

    Attributes:
        key: its name.
        example: how its value may be written, for messages.
        lowest: how small it may be.
        error: whether a standard error stands behind it: "never", "maybe" or "always".
        choices: of a word in place of a number: which there are.
        none: whether the word "none" may stand in place of the number, which then is None.
    """

    key: str
    example: str = "1"
    lowest: float = 1.0 / FARTHEST
    error: Literal["never", "maybe", "always"] = "never"
    choices: tuple[str, ...] = ()
    none: bool = False

    @property
    def line(self) -> str:
        """A line that sets it."""
        return f"# {self.key} = {self.example}"


Settings = Mapping[str, FileSetting]
"""Settings by their key."""


def read_bytes(path: str | Path, wanted: str) -> bytes:
    """Return what a file holds.

    Args:
        path: the file.
        wanted: what the path is to be of, in words.

    Raises:
        TableError: if there is no such file, or it cannot be read.
    """
    name = printable(str(path))
    try:
        return read_whole(path)
    except FileNotFoundError:
        raise TableError(f"{name}: there is no such file; check the path") from None
    except IsADirectoryError:
        raise TableError(f"{name}: is a folder; give the path of {wanted}") from None
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise TableError(f"{name}: cannot be read ({reason}); check the path and its permissions") from error


def read_text(path: str | Path) -> str:
    """Return the text of a UTF-8 file, with or without a byte order mark, with every line end as a newline.

    Raises:
        TableError: if there is no such file, it cannot be read or is not UTF-8 text.
    """
    wrong = "is not UTF-8 text; save the table as CSV with the encoding UTF-8"
    return text_of(read_bytes(path, "a CSV file"), path, wrong)


def text_of(data: bytes, path: str | Path, wrong: str, *, latin: bool = False) -> str:
    """Return the text of a file's bytes; see `read_text`.

    Args:
        data: the bytes.
        path: the file.
        wrong: what is said where they are no text, with what to do.
        latin: whether what is not UTF-8 is taken as Latin-1.

    Raises:
        TableError: if they are no text.
    """
    data = data.replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    try:
        text = data.decode("utf-8-sig")
        # UTF-16 of plain English is valid UTF-8 with a zero byte in front of every letter.
        start = text.find("\0")
    except UnicodeDecodeError as error:
        text = data.decode("latin-1")
        start = text.find("\0") if latin else error.start
    if start >= 0:
        line = text.count("\n", 0, start) + 1
        raise TableError(f"{printable(str(path))}, line {line}: {wrong}")
    return text


def read_columns(
    path: str | Path, form: Form, settings: Settings
) -> tuple[dict[str, Column], Columns, dict[str, tuple[Any, float | None]]]:
    """Read a file of comments, a row of column names, and rows of numbers, whose form is known.

    Args:
        path: the file.
        form: the columns that it may have.
        settings: those that comments may make.

    Returns:
        The columns that were read, and their numbers in the unit of what they become, both by that; value and error of
        the settings.

    Raises:
        TableError: with the first fault of the file.
    """
    source = Source(str(path))
    found, _, rows = read_comments(read_text(path), settings, source)
    numbers, lines = read_rows(rows, form, source)
    used = {column.becomes: column for column in form.columns if column.name in numbers}
    columns = {key: one.convert(numbers[one.name]) if one.convert else numbers[one.name] for key, one in used.items()}
    for key, values in columns.items():
        form.check_numbers(key, values, lines, source)
    return used, columns, found


def split_lines(text: str) -> tuple[NumberedLines, NumberedLines]:
    """Return comments (without their number sign, stripped) and other lines of a text, numbered, without blank ones."""
    comments, rows = [], []
    for number, line in enumerate(text.split("\n"), start=1):
        stripped = line.strip(" \t")
        if stripped.startswith("#"):
            comments.append((number, stripped[1:].strip()))
        elif stripped.strip(",; \t"):
            rows.append((number, line))
    return [comment for comment in comments if comment[1]], rows


def setting_in(text: str, settings: Settings) -> FileSetting | None:
    """Return the setting that a comment makes or was meant to make, or None for a free remark.

    Args:
        text: the comment without its number sign.
        settings: those there are.
    """
    match = _KEY_AND_VALUE.fullmatch(text)
    if match is None or len(match["key"].split()) > 4:
        return None
    meant = _SHORT_NAMES.get(match["key"].lower()) or nearest_name(plain_name(match["key"]), settings)
    return settings.get(meant or "")


def given_value(name: str, given: Any, *, any_sign: bool = False) -> tuple[float, float | None]:
    """Return a value and its standard error, None without one, that a caller gives.

    >>> given_value("k", "44 +- 4"), given_value("k", 44), given_value("k", (44.0, None))
    ((44.0, 4.0), (44.0, None), (44.0, None))

    Args:
        name: of the argument, for messages.
        given: a number, a pair, or a text such as '44 +- 4'.
        any_sign: whether it need not be above 0.

    Raises:
        ValueError: if it is none, or is impossible.
    """
    if isinstance(given, str):
        given = value_and_error(given, f'`{name}=40` or `{name}="40 +- 2"`')
    value, error = given if isinstance(given, tuple) else (given, None)
    if not (np.isfinite(value) and (value > 0.0 or any_sign) and (error is None or 0.0 < error < np.inf)):
        raise ValueError(f"`{name}` must be finite and above 0, but is {given!r}")
    return float(value), None if error is None else float(error)


def _value_of(setting: FileSetting, text: str) -> tuple[Any, float | None]:
    """Return the value and its error of a comment that makes a setting; of a word the word.

    Args:
        setting: from `setting_in`.
        text: the comment without its number sign.

    Raises:
        ValueError: with what is wrong.
    """
    match, key = _KEY_AND_VALUE.fullmatch(text), setting.key
    if match is None or match["key"] != key or match["sign"] is None:
        raise ValueError(f"{quoted(text)} is no known setting; the key is {key}, as in '{setting.line}'")
    # Spreadsheets fill every line up with commas.
    value = match["value"].rstrip(",; \t").strip()
    if setting.choices and value not in setting.choices:
        raise ValueError(f"{key} must be {' or '.join(setting.choices)}, but is {quoted(value)}")
    if setting.choices or (setting.none and value == "none"):
        return (value if setting.choices else None), None
    number, error = value_and_error(value, f"'{setting.line}', with a decimal point and without the unit")
    if setting.error == ("always" if error is None else "never"):
        raise ValueError(f"{key} {'needs its' if error is None else 'takes no'} standard error; write '{setting.line}'")
    if wrong := fault_in_number(setting, number, error):
        raise ValueError(f"{key} {wrong}")
    return number, error


def read_comments(
    text: str, settings: Settings, source: Source
) -> tuple[dict[str, tuple[Any, float | None]], tuple[str, ...], NumberedLines]:
    """Return value and error of the settings that comments make, other comments, and rows.

    Args:
        text: of the whole file.
        settings: those there are.
        source: for messages of a misspelt key, a value that is no number and a repeated key.

    Raises:
        TableError: if something is wrong, or there are no rows below the column names.
    """
    found: dict[str, tuple[Any, float | None]] = {}
    remarks = []
    comments, rows = split_lines(text)
    for line, comment in comments:
        setting = setting_in(comment, settings)
        if setting is None:
            match = _KEY_AND_VALUE.fullmatch(comment)
            name = "" if match is None else plain_name(match["key"])
            if name in SETTING_NAMES:
                raise source.fault(f"{name} sets nothing in such a file; remove the line", line=line)
            remarks.append(comment)
        elif setting.key in found:
            raise source.fault(f"{setting.key} was given already; remove one of the two", line=line)
        else:
            try:
                found[setting.key] = _value_of(setting, comment)
            except ValueError as error:
                raise source.fault(str(error), line=line) from None
    if len(rows) < 2:
        raise source.fault("the file holds no rows of numbers; add a row of column names, and rows of numbers below it")
    return found, tuple(remarks), rows


def setting_line(key: str, value: float | str, error: float | None) -> str:
    """Return the comment line that makes a setting."""
    return f"# {key} = {value}" + (f" +- {error!r}" if error else "")


def fault_in_number(setting: FileSetting, value: float, error: float | None = None) -> str | None:
    """Return what is wrong with a setting's number or its standard error, both in the unit of its key, or None."""
    if not setting.lowest <= value <= LARGEST:
        return f"must lie between {setting.lowest:g} and {LARGEST:g}, but is {value!r}; correct it"
    if error is not None and not 1.0 / FARTHEST <= error <= LARGEST:
        return f"has the error {error!r}; it must lie between {1.0 / FARTHEST:g} and {LARGEST:g}, or be left out"
    return None


def read_cells(rows: NumberedLines, source: Source) -> Iterator[list[str]]:
    """Give the cells of each line, as many in each as in the first, without the spaces and quotation marks around them.

    A separator that ends a line begins no cell, and decimal commas become points.

    Args:
        rows: lines with their numbers, at least one.
        source: for messages.

    Raises:
        TableError: if a line has another number of cells, or less than two.
    """
    # names may hold commas, and the last row may be cut off
    separator = _separator_of(rows[len(rows) // 2][1])
    width = 0
    all_cells = _cells_of((text for _, text in rows), separator)
    for (line, text), cells in zip(rows, all_cells, strict=False):
        if text.count('"') % 2:
            raise source.fault("a quotation mark is not closed; close or remove it", line=line)
        width = width or len(cells) - (not cells[-1])
        if len(cells) == width + 1 and not cells[-1]:
            cells.pop()
        if width < 2:
            raise source.fault("columns separated by commas, tabs, semicolons or blanks are expected here", line=line)
        if len(cells) != width:
            mend = "fill the row up, and write points for decimal commas"
            raise source.fault(f"there are {len(cells)} cells for {width} columns; {mend}", line=line)
        yield cells


def _cells_of(lines: Iterable[str], separator: str) -> Iterator[list[str]]:
    # several spaces may stand between columns
    for row in csv.reader((line.strip(" ") for line in lines), delimiter=separator, skipinitialspace=True):
        cells = [cell.strip() for cell in row]
        yield [cell.replace(",", ".") if "," in cell and DECIMAL_COMMA.fullmatch(cell) else cell for cell in cells]


def _separator_of(row: str) -> str:
    """Return what separates numbers: commas only where they are no decimal commas."""
    for sign in ",\t; ":
        cells = [cell for cell in next(_cells_of([row], sign)) if cell]
        if len(cells) > 1 and all(map(NUMBER.fullmatch, cells)):
            return sign
    return next((sign for sign in "\t;, " if sign in row.strip()), ",")


def numbers_of(cells: Sequence[str]) -> Rows:
    """Return the numbers in cells, NaN where a cell holds none."""
    return np.array([float(cell) if NUMBER.fullmatch(cell) else math.nan for cell in cells])


def read_rows(rows: NumberedLines, form: Form, source: Source) -> tuple[Columns, Lines]:
    """Return the columns that the form has as numbers (NaN where a cell is blank), and the line of each row.

    Args:
        rows: lines with their numbers, the column names first.
        form: what the file is to be.
        source: for messages.

    Raises:
        TableError: if names, or a cell, are wrong.
    """
    table = read_cells(rows, source)
    names = next(table)
    check_names(names, form, source, line=rows[0][0])
    lines = np.array([line for line, _ in rows[1:]])
    columns = {}
    for name, cells in zip(names, zip(*table, strict=True), strict=True):
        if name in form.names:
            columns[name] = numbers_of(cells)
            bad = np.isnan(columns[name]) & ~(np.array([not cell for cell in cells]) & form.blanks)
            wrong = f"{quoted(cells[np.argmax(bad)])} is not a number like 90.25 or 9.025e1"
            source.refuse(bad, f"{wrong}; correct it or remove the row", lines, name)
    return columns, lines


def check_names(names: list[str], form: Form, source: Source, *, line: int = 0) -> None:
    """Check the names of columns.

    Args:
        names: of the columns, from left to right.
        form: what the table is to be.
        source: for messages.
        line: where the names stand; 0: in memory.
    """
    if any(NUMBER.fullmatch(name) for name in names):
        raise source.fault("the first row holds numbers; put the row of column names above it", line=line)
    becomes = {column.name: column.becomes for column in form.columns}
    present = [becomes[name] for name in names if name in becomes]
    for name in {becomes[name]: name for name in names if present.count(becomes.get(name, "")) > 1}.values():
        raise source.fault("says again what another column says; remove one", line=line, column=name)
    # each takes milliseconds to compare
    for name in [name for name in names if name not in becomes][:20]:
        meant = nearest_name(plain_name(name), becomes)
        if name in form.strange:
            raise source.fault(form.strange[name], line=line, column=name)
        if not form.open or (meant is not None and becomes[meant] not in present):
            known = f"remove or rename it, the columns are {', '.join(becomes)}"
            mend = known if meant is None else f"did you mean {meant}?"
            raise source.fault(f"unknown column {quoted(name)}; {mend}", line=line)
    # a column that is missing may be one that is misspelt
    for what in dict.fromkeys(column.needed for column in form.columns):
        columns = [column for column in form.columns if column.needed == what]
        if what and not any(column.becomes in present for column in columns):
            raise source.fault(
                f"there is no {what} column; add {' or '.join(column.name for column in columns)}", line=line
            )


def plain_name(text: str) -> str:
    """Return a name in a table's spelling: lower case, words joined by underscores, no brackets around units."""
    return "_".join(re.findall(r"\w+", text.lower().replace("_", " ")))


def column_of(name: str, values: Shaped[np.ndarray, "..."], rows: int, source: Source) -> Float[np.ndarray, "..."]:
    """Return a copy of a column of a table in memory, after noting another length than that of the table."""
    column = np.array(values, dtype=np.float64)
    if column.shape != (rows,) or rows == 0:
        raise source.fault(
            f"has the shape {column.shape}; every column is a list of the same length, at least 1", column=name
        )
    return column
