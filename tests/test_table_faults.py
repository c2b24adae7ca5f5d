"""Faults of amplitude tables beyond those of the corpus (`tests.malformed`): paths, floods, tables made in memory."""

import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from afm_jax.scenefile.scenefile import SceneError, load_scene
from fitting.tables.csv_text import Faults, TableError, column_of
from fitting.tables.table import read_table
from tests.test_table import KEY, TEXT, read, small_table


def test_paths_that_are_no_file(tmp_path: Path):
    for path, said in (
        (tmp_path / "no.csv", f"{tmp_path}/no.csv: there is no such file; check the path"),
        (tmp_path, f"{tmp_path}: is a folder; give the path of a CSV file"),
        ("a\nb", r"'a\nb': there is no such file; check the path"),
    ):
        with pytest.raises(TableError) as caught:
            read_table(path)
        assert str(caught.value) == said


def test_a_file_without_end_is_refused(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("afm_jax.whole_files.LARGEST_BYTES", 1 << 20)
    why = "it holds more than 1,048,576 bytes"
    with pytest.raises(TableError, match=f"^/dev/zero: cannot be read [(]{why}[)]; check the path"):
        read_table("/dev/zero")
    with pytest.raises(SceneError, match=f"^/dev/zero: cannot be read [(]{why}[)]$"):
        load_scene("/dev/zero")


def test_a_flood_of_unknown_columns_is_refused_at_once(tmp_path: Path):
    # comparing every name with the known ones took 0.4 ms each, and looking for it among those before it grew as well
    names = ",".join(f"a_rather_long_column_name_{i}" for i in range(20_000))
    start = time.process_time()
    with pytest.raises(TableError, match="line 2: unknown column 'a_rather_long_column_name_0'"):
        read(tmp_path, f"{KEY}{names}\n{','.join('1' * 20_000)}\n")
    assert time.process_time() - start < 5.0


def test_noise_is_a_fraction(tmp_path: Path):
    for noise in (0.0, -0.01, 1.0, 5.0):
        said = f"the relative noise must be between 0 and 1, but is {noise!r}; write 0.01 for 1 %"
        with pytest.raises(TableError, match=said):
            read(tmp_path, TEXT, noise=noise)
    with pytest.raises(ValueError, match="`noise` must be a real number or None, but is nan"):
        read(tmp_path, TEXT, noise=float("nan"))


NOT_ONE_LINE = "would not be read back as one; make it one line of free text"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"offset_nm": np.array([0.0, np.nan])}, ", row 2, column offset_nm: is blank; every row needs it"),
        (
            {"peak_amplitude_error_nm": None},
            ": peak_amplitude_nm and peak_amplitude_error_nm come together; give both or none",
        ),
        (
            {"peak_amplitude_nm": None, "peak_amplitude_error_nm": None},
            ": there is no amplitude; give peak_amplitude_nm or lockin_amplitude_nm",
        ),
        ({"quality_factor_error": 2.0}, ": quality_factor_error stands without quality_factor; give both or none"),
        (
            {"no_orbit": np.array([0.0, 1.0])},
            ", row 2, column no_orbit: the row has an amplitude; clear it or set no_orbit to 0",
        ),
        ({"remarks": ("a\nb",)}, rf": the remark 'a\nb' {NOT_ONE_LINE}"),
        ({"remarks": ("mass_ng = 2",)}, f": the remark 'mass_ng = 2' {NOT_ONE_LINE}"),
        (
            {"source": "a\nb", "quality_factor": 0.4},
            ": quality_factor must be finite and above 0.5, but is 0.4; correct it",
        ),
    ],
)
def test_a_table_in_memory_keeps_the_same_rules(change: dict[str, Any], message: str):
    with pytest.raises(TableError) as caught:
        small_table(**change)
    source = r"'a\nb'" if "source" in change else "table in memory"
    assert str(caught.value) == source + message


def test_columns_of_a_table_in_memory_have_one_length():
    faults = Faults("here")
    column_of("offset_nm", np.zeros(2), 2, faults)
    faults.raise_any()
    column_of("offset_nm", np.zeros(3), 2, faults)
    said = r"here, column offset_nm: has the shape \(3,\); every column is a list of the same length, at least 1"
    with pytest.raises(TableError, match=said):
        faults.raise_any()
