"""Faults of a table's file, comments and column names: one line that says what, where and how to mend it."""

import time
from pathlib import Path

import pytest

from afm_jax.scenefile.scenefile import SceneError, load_scene
from fitting.tables.csv_text import TableError
from fitting.tables.table import TABLE, read_table
from tests.table_texts import KEY, NAMES, ROW, fault_of, message_of

Q = "'# quality_factor = 40 (or 40 +- 2)'"
NOT_UTF8 = "line 1: is not UTF-8 text; save the table as CSV with the encoding UTF-8"
REPEAT = ", or repeat readings: 4 repeats tell them"
ADD_ERRORS = f"add the column peak_amplitude_error_nm or give the relative noise (--noise 1%){REPEAT}"
NEEDS_ERROR = (
    "needs its standard error; write '# tip_calibration = 1 +- 0.02', or correct the columns and remove this line"
)


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"", "the file holds nothing; add a row of column names and rows of numbers"),
        (b"\n \n\r\n", "the file holds nothing; add a row of column names and rows of numbers"),
        (KEY.encode(), "the file holds only comments; add a row of column names and rows of numbers"),
        (
            (KEY + NAMES).encode(),
            "line 2: there are column names but no rows below them; add a row for each drive",
        ),
        ((KEY + NAMES + ROW).encode("utf-16"), NOT_UTF8),
        ((KEY + NAMES + ROW).encode("utf-16-le"), NOT_UTF8),
        (f"# a\r\n# 40 ± 2\r\n{KEY}{NAMES}{ROW}".encode("latin-1"), NOT_UTF8.replace("line 1", "line 2")),
    ],
    ids=["empty", "blank-lines", "only-comments", "header-only", "utf-16", "utf-16-without-mark", "latin-1"],
)
def test_files_that_hold_no_table(tmp_path: Path, data: bytes, message: str):
    assert fault_of(tmp_path, data) == message


def test_paths_that_are_no_file(tmp_path: Path):
    assert message_of(tmp_path / "no.csv") == "there is no such file; check the path"
    assert message_of(tmp_path) == "is a folder; give the path of a CSV file"
    with pytest.raises(TableError, match=r"^'a\\nb': there is no such file; check the path$"):
        read_table("a\nb")


def test_a_file_without_end_is_refused(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("afm_jax.whole_files.LARGEST_BYTES", 1 << 20)
    why = "it holds more than 1,048,576 bytes"
    with pytest.raises(TableError, match=f"^/dev/zero: cannot be read [(]{why}[)]; check the path"):
        read_table("/dev/zero")
    with pytest.raises(SceneError, match=f"^/dev/zero: cannot be read [(]{why}[)]$"):
        load_scene("/dev/zero")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (",", ";", ": the columns are separated by semicolons; separate them by commas, decimals by points"),
        (",", "\t", ": the columns are separated by tabs; separate them by commas, decimals by points"),
        (",", " ", ": the columns are separated by spaces; separate them by commas, decimals by points"),
        (NAMES, ROW, ": the first row holds numbers; put the row of column names above it"),
        ("offset_nm,", "", ": the column offset_nm (in nm) is missing; add it"),
        ("order,", "", ": the column order is missing; add it"),
        ("offset_nm", "offest_nm", ": unknown column 'offest_nm'; did you mean offset_nm (in nm)?"),
        ("offset_nm", "offset", ": unknown column 'offset'; did you mean offset_nm (in nm)?"),
        ("offset_nm", "Offset_nm", ": unknown column 'Offset_nm'; did you mean offset_nm (in nm)?"),
        ("order", "ordre", ": unknown column 'ordre'; did you mean order?"),
        ("\n", ",room\n", f": unknown column 'room'; remove it, the columns are {', '.join(TABLE.names)}"),
        ("\n", ",\n", ": column 7 has no name; name it or remove its comma"),
        ("\n", ",order\n", ", column order: is there twice, as columns 1 and 7; remove one"),
        (
            ",peak_amplitude_nm,peak_amplitude_error_nm",
            "",
            ": there is no amplitude column; add peak_amplitude_nm or lockin_amplitude_nm",
        ),
        (
            "peak_amplitude_nm,",
            "",
            ", column peak_amplitude_error_nm: stands without peak_amplitude_nm; add that column or remove this one",
        ),
        (",peak_amplitude_error_nm", "", f", column peak_amplitude_nm: has no errors; {ADD_ERRORS}"),
        (
            "\n",
            ",phase_deg\n",
            f", column phase_deg: has no errors; add the column phase_error_deg{REPEAT}",
        ),
        (
            "\n",
            ",phase_error_deg\n",
            ", column phase_error_deg: stands without phase_deg; add that column or remove this one",
        ),
    ],
)
def test_column_names(tmp_path: Path, old: str, new: str, message: str):
    assert fault_of(tmp_path, KEY + NAMES.replace(old, new) + ROW) == f"line 2{message}"


@pytest.mark.parametrize(
    ("name", "written", "unit"),
    [
        ("offset_nm", "offset_um", "nm"),
        ("offset_nm", "offset (um)", "nm"),
        ("drive_frequency_khz", "drive_frequency_hz", "kHz"),
        ("drive_frequency_khz", "drive_frequency_hertz", "kHz"),
        ("drive_amplitude_nm", "drive_amplitude_mv", "nm"),
        ("peak_amplitude_nm", "peak_amplitude_pm", "nm"),
        ("peak_amplitude_error_nm", "peak_amplitude_error_pm", "nm"),
    ],
)
def test_units_of_columns(tmp_path: Path, name: str, written: str, unit: str):
    assert fault_of(tmp_path, KEY + NAMES.replace(name, written) + ROW) == (
        f"line 2: unknown unit in column '{written}'; convert it and name it {name} (in {unit})"
    )


@pytest.mark.parametrize(
    ("comment", "message"),
    [
        ("quality_factor = 0.5", "quality_factor must be finite and above 0.5, but is 0.5; correct it"),
        ("quality_factor = 1e999", "quality_factor must be finite and above 0.5, but is inf; correct it"),
        ("quality_factor = 40 +- -2", "quality_factor has the error -2.0; it must be finite and above 0, or left out"),
        ("quality_factor = 40 +- 0", "quality_factor has the error 0.0; it must be finite and above 0, or left out"),
        (
            "quality_factor = forty",
            f"quality_factor has 'forty' where a number must stand; write {Q}, without the unit",
        ),
        ("quality_factor =", f"quality_factor has '' where a number must stand; write {Q}, without the unit"),
        ("quality_factor = 40,5", "quality_factor is '40,5'; write the decimal comma as a point"),
        ("quality_factor = 40 +- 2 +- 1", f"quality_factor takes no such error; write {Q}"),
        ("quality_factor: 40", f"'quality_factor: 40' is no known setting; the key is quality_factor, as in {Q}"),
        ("Quality factor = 40", f"'Quality factor = 40' is no known setting; the key is quality_factor, as in {Q}"),
        ("qualty_factor = 40", f"'qualty_factor = 40' is no known setting; the key is quality_factor, as in {Q}"),
        ("Q = 40", f"'Q = 40' is no known setting; the key is quality_factor, as in {Q}"),
        ("mass_kg = 1", "'mass_kg = 1' is no known setting; the key is mass_ng (in ng), as in '# mass_ng = 1'"),
        ("mass_ng = 0", "mass_ng must be finite and above 0, but is 0.0; correct it"),
        ("mass_ng = 1 +- 0.1", "mass_ng takes no such error; write '# mass_ng = 1'"),
        (
            "tip_calibration = 1.02",
            f"tip_calibration {NEEDS_ERROR}",
        ),
        ("drive_calibration = 0 +- 0.1", "drive_calibration must be finite and above 0, but is 0.0; correct it"),
        (
            "offset_origin_nm = 0 +- 0",
            "offset_origin_nm has the error 0.0; it must be finite and above 0, or left out",
        ),
        ("free_frequency_khz = 91", "free_frequency_khz was given in line 1 already; remove one of the two"),
    ],
)
def test_comments_that_set_something(tmp_path: Path, comment: str, message: str):
    assert fault_of(tmp_path, f"{KEY}# {comment}\n{NAMES}{ROW}") == f"line 2: {message}"


def test_the_free_frequency_is_needed(tmp_path: Path):
    example = "'# free_frequency_khz = 90'"
    missing = f"the free frequency is missing; add a line such as {example} above the column names"
    assert fault_of(tmp_path, NAMES + ROW) == missing
    named = f"the key is free_frequency_khz (in kHz), as in {example}"
    other_unit = f"line 1: 'free_frequency_mhz = 0.09' is no known setting; {named}"
    assert fault_of(tmp_path, "# free_frequency_mhz = 0.09\n" + NAMES + ROW) == other_unit
    with_unit = f"line 1: free_frequency_khz has '90 kHz' where a number must stand; write {example}, without the unit"
    assert fault_of(tmp_path, "# free_frequency_khz = 90 kHz\n" + NAMES + ROW) == with_unit


def test_a_flood_of_unknown_columns_is_refused_at_once(tmp_path: Path):
    # comparing every name with the known ones took 0.4 ms each, and looking for it among those before it grew as well
    names = ",".join(f"a_rather_long_column_name_{i}" for i in range(20_000))
    start = time.perf_counter()
    message = fault_of(tmp_path, f"{KEY}{names}\n{','.join('1' * 20_000)}\n")
    assert time.perf_counter() - start < 5.0
    assert message.startswith("line 2: unknown column 'a_rather_long_column_name_0'")
