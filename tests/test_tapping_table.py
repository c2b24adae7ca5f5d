"""Tables of cantilevers that are driven themselves: what they hold, what is refused, and the way there and back."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fitting.tables.table import AmplitudeTable, read_table, write_table
from tests.test_table import assert_same

HEAD = """# drive = force
# free_frequency_khz = 90 +- 0.01
# spring_constant_n_per_m = 5.4 +- 0.5
# phase_zero_deg = -1 +- 0.2
"""
NAMES = (
    "drive_frequency_khz,free_amplitude_nm,offset_nm,"
    "lockin_amplitude_nm,lockin_amplitude_error_nm,phase_lag_deg,phase_lag_error_deg\n"
)
ROW = "92.7,80,-40,44,0.1,2,0.2\n"


def read(folder: Path, text: str) -> AmplitudeTable:
    path = folder / "table.csv"
    path.write_text(text)
    return read_table(path)


def test_reads_a_curve(tmp_path: Path):
    table = read(tmp_path, HEAD + NAMES + ROW + "99,40,-20,21,0.1,,\n")
    assert (table.drive, table.tapping, table.rows) == ("force", True, 2)
    np.testing.assert_array_equal(table.order, [1, 1])
    np.testing.assert_array_equal(table.free_amplitude_nm, [80.0, 40.0])
    np.testing.assert_array_equal(table.phase_lag_deg, [2.0, np.nan])
    assert table.drive_amplitude_nm is None
    assert (table.free_frequency_khz, table.free_frequency_error_khz) == (90.0, 0.01)
    assert (table.spring_constant_n_per_m, table.spring_constant_error_n_per_m) == (5.4, 0.5)
    assert table.calibration == {"phase_zero_deg": (-1.0, 0.2)}
    # k/Omega^2, 1 N/m being 1 ng/us^2
    assert table.mass_ng == pytest.approx(5.4 / (2.0 * np.pi * 0.09) ** 2, rel=1e-15)


@pytest.mark.parametrize("drive", ["force", "base"])
def test_a_written_curve_reads_back_the_same(tmp_path: Path, drive: str):
    text = HEAD.replace("force", drive) + NAMES.replace("\n", ",retract\n")
    table = read(tmp_path, text + ROW.replace("\n", ",0\n") + ROW.replace("\n", ",1\n"))
    assert table.drive == drive
    write_table(table, tmp_path / "second.csv")
    assert_same(table, read_table(tmp_path / "second.csv"), but=("source", "lines"))
    made = replace(table, source="table in memory", order=np.zeros(0, dtype=int))
    assert_same(table, made, but=("source",))


def test_orders_are_those_of_the_drive(tmp_path: Path):
    text = HEAD + NAMES.replace("\n", ",order\n")
    assert read(tmp_path, text + ROW.replace("\n", ",1\n")).order.tolist() == [1]
