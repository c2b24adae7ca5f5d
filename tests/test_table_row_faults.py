"""Faults of a table's rows, read or made in memory: one line that says what, where and how to mend it."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fitting.tables.csv_text import Faults, TableError, column_of
from fitting.tables.table import AmplitudeTable
from tests.table_texts import KEY, NAMES, ROW, fault_of

NOT_NUMBER = "is not a number; write it like 174.6 or 1.746e2, without a unit"
NOT_MEASURED = "is not a number; leave the cell of a value that was not measured blank"
NOT_ORDER = "is not a positive whole number; write 1, 2, 3, ..."
OR_BLANK = "correct it or leave it blank if it was not measured"
OR_UNSEEN = ", or set no_orbit to 1 if the tip settled on no orbit there"


@pytest.mark.parametrize(
    ("row", "column", "message"),
    [
        ("1,abc,4,0,163.3,1.63", "drive_frequency_khz", f"'abc' {NOT_NUMBER}"),
        ("1,1_80,4,0,163.3,1.63", "drive_frequency_khz", f"'1_80' {NOT_NUMBER}"),
        # Digits of another script, which float() takes.
        ("1,\u0661,4,0,163.3,1.63", "drive_frequency_khz", f"'\u0661' {NOT_NUMBER}"),
        ("1,180 kHz,4,0,163.3,1.63", "drive_frequency_khz", f"'180 kHz' {NOT_NUMBER}"),
        ("1,180,4,1e,163.3,1.63", "offset_nm", f"'1e' {NOT_NUMBER}"),
        ("1,180,4,inf,163.3,1.63", "offset_nm", f"'inf' {NOT_NUMBER}"),
        ("1,180,4,0,nan,1.63", "peak_amplitude_nm", f"'nan' {NOT_MEASURED}"),
        ("1,180,4,0,-,1.63", "peak_amplitude_nm", f"'-' {NOT_MEASURED}"),
        ("1,180,4,0,163.3,-inf", "peak_amplitude_error_nm", f"'-inf' {NOT_MEASURED}"),
        ("1,180,4,0," + "x" * 50 + ",1.63", "peak_amplitude_nm", f"'{'x' * 40}...' {NOT_NUMBER}"),
        ('1,180,4,0,"163,3",1.63', "peak_amplitude_nm", "'163,3' has a decimal comma; write a point"),
        ("1,180,4,0,1e999,1.63", "peak_amplitude_nm", f"must be finite and above 0, but is inf; {OR_BLANK}"),
        ("1,180,4,-1e999,163.3,1.63", "offset_nm", "must be finite, but is -inf; correct it"),
        ("1,180,4,0,-163.3,1.63", "peak_amplitude_nm", f"must be finite and above 0, but is -163.3; {OR_BLANK}"),
        ("1,180,4,0,0.0,1.63", "peak_amplitude_nm", f"must be finite and above 0, but is 0; {OR_BLANK}"),
        ("1,180,4,0,163.3,0", "peak_amplitude_error_nm", "must be finite and above 0, but is 0; correct it"),
        ("1,180,4,0,163.3,-1", "peak_amplitude_error_nm", "must be finite and above 0, but is -1; correct it"),
        ("1,0,4,0,163.3,1.63", "drive_frequency_khz", "must be finite and above 0, but is 0; correct it"),
        ("1,-180,4,0,163.3,1.63", "drive_frequency_khz", "must be finite and above 0, but is -180; correct it"),
        ("1,180,0,0,163.3,1.63", "drive_amplitude_nm", "must be finite and above 0, but is 0; correct it"),
        ("1,180,-4.5,0,163.3,1.63", "drive_amplitude_nm", "must be finite and above 0, but is -4.5; correct it"),
        ("0,180,4,0,163.3,1.63", "order", "must be a positive whole number (1, 2, 3, ...), but is 0; correct it"),
        ("-1,180,4,0,163.3,1.63", "order", "must be a positive whole number (1, 2, 3, ...), but is -1; correct it"),
        ("1.5,180,4,0,163.3,1.63", "order", f"'1.5' {NOT_ORDER}"),
        ("2.0,180,4,0,163.3,1.63", "order", f"'2.0' {NOT_ORDER}"),
        ("one,180,4,0,163.3,1.63", "order", f"'one' {NOT_ORDER}"),
        (",180,4,0,163.3,1.63", "order", "is blank; every row needs it"),
        ("1,180,,0,163.3,1.63", "drive_amplitude_nm", "is blank; every row needs it"),
        (
            "1,180,4,0,163.3,",
            "peak_amplitude_nm",
            "the value has no error; fill peak_amplitude_error_nm in or give the relative noise (--noise 1%)",
        ),
        (
            "1,180,4,0,,1.63",
            "peak_amplitude_error_nm",
            "the error has no value; fill peak_amplitude_nm in or clear this cell",
        ),
        ("1,180,4,0,,", None, "the row has no amplitude; fill peak_amplitude_nm in or remove the row"),
        ("1,180,4,0,163.3", None, "there are 5 cells for 6 columns; fill in the others"),
        (
            "1,180,4,0,163,3,1.63",
            None,
            "there are 7 cells for 6 columns; remove the others; a decimal comma must be a point",
        ),
        ('1,180,4,0,"163.3,1.63', None, "a quotation mark is not closed; close or remove it"),
    ],
)
def test_cells(tmp_path: Path, row: str, column: str | None, message: str):
    place = "line 4" if column is None else f"line 4, column {column}"
    good = "3,540,4,0,163.3,1.63\n"
    assert fault_of(tmp_path, f"{KEY}{NAMES}{good}{row}\n") == f"{place}: {message}"


@pytest.mark.parametrize(
    ("row", "message"),
    [
        (
            "1,180,4,0,,,0",
            "line 4: the row has no amplitude; fill peak_amplitude_nm in or remove the row" + OR_UNSEEN,
        ),
        (
            "1,180,4,0,163.3,1.63,1",
            "line 4, column no_orbit: the row has an amplitude; clear it or set no_orbit to 0",
        ),
        (
            "1,180,4,0,163.3,1.63,2",
            "line 4, column no_orbit: must be 1 (no steady orbit was seen) or 0, but is 2; correct it",
        ),
        ("1,180,4,0,163.3,1.63,yes", f"line 4, column no_orbit: 'yes' {NOT_NUMBER}"),
    ],
)
def test_rows_without_an_orbit(tmp_path: Path, row: str, message: str):
    names = NAMES.replace("\n", ",no_orbit\n")
    assert fault_of(tmp_path, f"{KEY}{names}3,540,4,0,163.3,1.63,0\n{row}\n") == message


def test_several_faults_are_counted_and_the_first_line_is_shown(tmp_path: Path):
    one = fault_of(tmp_path, KEY + NAMES + "1,180,4,0,163.3,x\n2,180,-4,0,163.3,1\n")
    assert one == f"line 3, column peak_amplitude_error_nm: 'x' {NOT_NUMBER} (and 1 more fault)"
    same_line = fault_of(tmp_path, KEY + NAMES + "1,180,y,0,163.3,x\n")
    assert same_line == f"line 3, column drive_amplitude_nm: 'y' {NOT_NUMBER} (and 1 more fault)"
    two = fault_of(tmp_path, f"{KEY}# mass_ng = 0\n{NAMES}1,y,4,0,163.3,x\n")
    assert two == "line 2: mass_ng must be finite and above 0, but is 0.0; correct it (and 2 more faults)"


@pytest.mark.parametrize("cell", ["-5", "0", "x", "1e999"])
def test_noise_does_not_add_faults_to_an_impossible_amplitude(tmp_path: Path, cell: str):
    message = fault_of(tmp_path, f"{KEY}{NAMES}1,180,4,0,{cell},\n", noise=0.01)
    assert message.startswith("line 3, column peak_amplitude_nm: ")
    assert "more fault" not in message


@pytest.mark.parametrize("noise", [0.0, -0.01, 1.0, 5.0])
def test_noise_is_a_fraction(tmp_path: Path, noise: float):
    message = fault_of(tmp_path, KEY + NAMES + ROW, noise=noise)
    assert message == f"the relative noise must be between 0 and 1, but is {noise!r}; write 0.01 for 1 %"


def test_noise_is_a_number(tmp_path: Path):
    with pytest.raises(ValueError, match="`noise` must be a real number or None, but is nan"):
        fault_of(tmp_path, KEY + NAMES + ROW, noise=float("nan"))


def test_noise_says_nothing_about_a_phase(tmp_path: Path):
    names = NAMES.replace("\n", ",phase_deg,phase_error_deg\n")
    message = fault_of(tmp_path, KEY + names + ROW.replace("\n", ",12,\n"), noise=0.01)
    assert message == "line 3, column phase_deg: the value has no error; fill phase_error_deg in"


FIELDS: dict[str, Any] = {
    "order": np.array([1, 1]),
    "drive_frequency_khz": np.array([180.0, 181.0]),
    "drive_amplitude_nm": np.array([4.0, 4.0]),
    "offset_nm": np.zeros(2),
    "lockin_amplitude_nm": np.array([70.0, 80.0]),
    "lockin_amplitude_error_nm": np.array([0.7, 0.8]),
    "free_frequency_khz": 90.0,
}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"offset_nm": np.array([0.0, np.nan])}, ", row 2, column offset_nm: is blank; every row needs it"),
        (
            {"lockin_amplitude_error_nm": None},
            ": lockin_amplitude_nm and lockin_amplitude_error_nm come together; give both or none",
        ),
        (
            {"lockin_amplitude_nm": None, "lockin_amplitude_error_nm": None},
            ": there is no amplitude; give peak_amplitude_nm or lockin_amplitude_nm",
        ),
        (
            {"order": np.array([1, 0])},
            ", row 2, column order: must be a positive whole number (1, 2, 3, ...), but is 0; correct it",
        ),
        ({"quality_factor_error": 2.0}, ": quality_factor_error stands without quality_factor; give both or none"),
        ({"quality_factor": 0.4}, ": quality_factor must be finite and above 0.5, but is 0.4; correct it"),
        (
            {"no_orbit": np.array([0.0, 1.0])},
            ", row 2, column no_orbit: the row has an amplitude; clear it or set no_orbit to 0",
        ),
        ({"remarks": ("a\nb",)}, r": the remark 'a\nb' would not be read back as one; make it one line of free text"),
        (
            {"remarks": ("mass_ng = 2",)},
            ": the remark 'mass_ng = 2' would not be read back as one; make it one line of free text",
        ),
        (
            {"source": "a\nb", "quality_factor": 0.4},
            r": quality_factor must be finite and above 0.5, but is 0.4; correct it",
        ),
    ],
)
def test_a_table_in_memory_keeps_the_same_rules(change: dict[str, Any], message: str):
    with pytest.raises(TableError) as caught:
        AmplitudeTable(**(FIELDS | change))
    source = r"'a\nb'" if "source" in change else "table in memory"
    assert str(caught.value) == source + message


def test_columns_of_a_table_in_memory_have_one_length():
    faults = Faults("here")
    column_of("offset_nm", np.zeros(2), 2, faults)
    faults.raise_any()
    column_of("offset_nm", np.zeros(3), 2, faults)
    with pytest.raises(TableError) as caught:
        faults.raise_any()
    assert str(caught.value) == (
        "here, column offset_nm: has the shape (3,); every column is a list of the same length, at least 1"
    )
