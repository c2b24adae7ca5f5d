"""Faults of amplitude tables beyond those of the corpus (`tests.malformed`): paths, floods, tables made in memory."""

import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from afm_jax.scenefile.scenefile import SceneError, load_scene
from fitting.tables.csv_text import TableError
from fitting.tables.table import read_table, write_table
from tests.test_table import KEY, read, small_table


def test_paths_that_are_no_file(tmp_path: Path):
    for path, said in (
        (tmp_path, f"{tmp_path}: is a folder; give the path of a CSV file"),
        ("a\nb", r"'a\nb': there is no such file; check the path"),
    ):
        with pytest.raises(TableError) as caught:
            read_table(path)
        assert str(caught.value) == said
    path = tmp_path / "no" / "table.csv"
    with pytest.raises(TableError, match=r"cannot be written \(No such file or directory\); choose another path"):
        write_table(small_table(), path)


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


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"peak_amplitude_error_nm": None}, ", column peak_amplitude_nm: has no errors; add the column peak_amplitude"),
        ({"quality_factor_error": 2.0}, ": quality_factor_error stands without quality_factor; give both or none"),
        ({"no_orbit": np.array([0.0, 1.0])}, ", row 2, column no_orbit: the row has an amplitude; clear it or "),
        ({"remarks": ("a\nb",)}, r": the remark 'a\nb' would not be read back as one; make it one line"),
        ({"source": "a\nb", "quality_factor": 0.4}, ": quality_factor must lie between 0.5 and 1e+09, but is 0.4; "),
    ],
)
def test_a_table_in_memory_keeps_the_same_rules(change: dict[str, Any], message: str):
    with pytest.raises(TableError) as caught:
        small_table(**change)
    source = r"'a\nb'" if "source" in change else "table in memory"
    assert str(caught.value).startswith(source + message)
