"""Reading and writing of amplitude tables: values against the csv module, and a lossless round trip."""

import csv
import dataclasses
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.stats import t as student_t

from fitting.tables.csv_text import TableError, setting_in
from fitting.tables.table import SETTINGS, TABLE, AmplitudeTable, read_table, write_table

NAMES = "order,drive_frequency_khz,drive_amplitude_nm,offset_nm,peak_amplitude_nm,peak_amplitude_error_nm\n"
TEXT = f"# free_frequency_khz = 90\n{NAMES}1,180,4,0,163.3,1.63\n2,349.2,2,-1,106.67,1.06\n"


FEW = """order,drive_frequency_khz,drive_amplitude_nm,offset_nm,peak_amplitude_nm,peak_amplitude_error_nm
1,180,4,0,163.3,1.63
2,349.2,2,-1,106.67,1.06
"""


def write(folder: Path, text: str | bytes) -> Path:
    path = folder / "table.csv"
    path.write_bytes(text.encode() if isinstance(text, str) else text)
    return path


def small_table(**changes: Any) -> AmplitudeTable:
    columns: dict[str, Any] = {
        "order": np.array([1, 2]),
        "drive_frequency_khz": np.array([180.0, 349.2]),
        "drive_amplitude_nm": np.array([4.0, 2.0]),
        "offset_nm": np.array([0.0, -1.0]),
        "peak_amplitude_nm": np.array([163.3, 106.67]),
        "peak_amplitude_error_nm": np.array([1.63, 1.06]),
        "free_frequency_khz": 90.0,
    }
    return AmplitudeTable(**(columns | changes))


def assert_same(left: AmplitudeTable, right: AmplitudeTable, *, but: tuple[str, ...] = ()) -> None:
    """Compare every field bit by bit, NaN equal to NaN."""
    for field in dataclasses.fields(AmplitudeTable):
        if field.name not in but:
            one, other = getattr(left, field.name), getattr(right, field.name)
            assert type(one) is type(other), field.name
            if isinstance(one, np.ndarray):
                assert one.dtype == other.dtype, field.name
                np.testing.assert_array_equal(one, other, err_msg=field.name)
            else:
                assert one == other or (one != one and other != other), field.name  # noqa: PLR0124


def test_reads_the_contact_table_as_the_csv_module_does(contact_table_path: Path):
    table = read_table(contact_table_path)
    text = [line for line in contact_table_path.read_text().splitlines() if not line.startswith("#")]
    expected = list(csv.DictReader(text))
    assert table.rows == len(expected) == 93
    for name in expected[0]:
        np.testing.assert_array_equal(getattr(table, name), [float(row[name]) for row in expected], err_msg=name)
    assert (table.free_frequency_khz, table.quality_factor, table.mass_ng) == (90.0, 40.0, 1.0)
    assert table.quality_factor_error is None
    assert table.phase_deg is None
    assert table.phase_error_deg is None
    assert table.source == str(contact_table_path)


def test_names_the_line_of_every_row(tmp_path: Path):
    text = TEXT.replace("2,349.2", "\n# pause\n,,,,,\n2,349.2")
    table = read_table(write(tmp_path, text))
    np.testing.assert_array_equal(table.lines, [3, 7])
    assert text.splitlines()[7 - 1].startswith("2,349.2")
    assert table.remarks == ("pause",)


@pytest.mark.parametrize(
    "text",
    [
        "\ufeff" + TEXT,
        TEXT.replace("\n", "\r\n"),
        TEXT.replace("\n", "\r"),
        TEXT.rstrip("\n"),
        TEXT.replace(",", " ,\t "),
        TEXT.replace("163.3", '"163.3"').replace("349.2", ' "349.2" ').replace("order", '"order"'),
        TEXT.replace("= 90", "= 90,,,,,"),
        TEXT.replace("163.3", "+1.633e2").replace("349.2", "3492E-1"),
        TEXT.replace("# free", "  #free").replace(" = ", "="),
        TEXT.replace("# free_frequency_khz = 90\n", "") + "# free_frequency_khz = 90\n",
    ],
    ids=["mark", "crlf", "cr", "no-end", "spaces", "quotes", "filled", "exponent", "tight", "below"],
)
def test_writing_habits_make_no_difference(tmp_path: Path, text: str):
    plain = read_table(write(tmp_path, TEXT))
    np.testing.assert_array_equal(plain.peak_amplitude_nm, [163.3, 106.67])
    assert_same(plain, read_table(write(tmp_path, text)), but=("lines",))


@pytest.mark.parametrize("value", ["40 +- 2", "40 ± 2", "40+-2", "40 +/- 2", "4e1 +- 2.0,,"])
def test_quality_factor_with_its_error(tmp_path: Path, value: str):
    table = read_table(write(tmp_path, f"# quality_factor = {value}\n# mass_ng = 3.5\n{TEXT}"))
    assert (table.quality_factor, table.quality_factor_error, table.mass_ng) == (40.0, 2.0, 3.5)


def test_what_a_table_does_not_say_of_the_cantilever_is_not_known(tmp_path: Path):
    table = read_table(write(tmp_path, TEXT))
    assert str(table.quality_factor) == "nan"
    assert (table.quality_factor_error, table.mass_ng, table.spring_constant_n_per_m) == (None, None, None)
    undamped = read_table(write(tmp_path, f"# quality_factor = none\n{TEXT}"))
    assert undamped.quality_factor is None


def test_mass_and_spring_constant_say_the_same(tmp_path: Path):
    mass = 5.4 / (2e-3 * np.pi * 90.0) ** 2
    table = read_table(write(tmp_path, f"# spring_constant_n_per_m = 5.4 +- 0.5\n{TEXT}"))
    assert table.mass_ng == pytest.approx(mass, rel=1e-14)
    write(tmp_path, f"# spring_constant_n_per_m = 5.4\n# mass_ng = {1.019 * mass}\n{TEXT}")
    assert read_table(tmp_path / "table.csv").mass_ng == pytest.approx(1.019 * mass, rel=1e-14)
    # 2 % is too far, however badly the spring constant is known
    write(tmp_path, f"# spring_constant_n_per_m = 5.4 +- 0.5\n# mass_ng = {1.021 * mass}\n{TEXT}")
    with pytest.raises(TableError, match=r"contradict each other: k/\(2 pi f0\)\^2 is 16.89 ng"):
        read_table(tmp_path / "table.csv")


@pytest.mark.parametrize(
    "remark", ["Operator = Jan", "12:30 h", "Measured: Tuesday", "# twice", "humidity_percent = 40", "a, b,,", "=", "ä"]
)
def test_other_comments_are_kept(tmp_path: Path, remark: str):
    table = read_table(write(tmp_path, f"# {remark}\n{TEXT}"))
    assert table.remarks == (remark,)


def test_blank_cells_are_not_measured(tmp_path: Path):
    names = NAMES.replace("\n", ",lockin_amplitude_nm,lockin_amplitude_error_nm,phase_deg,phase_error_deg\n")
    rows = "1,180,4,0,163.3,1.63,,,,\n1,180,5,0,, ,70,0.7,-12.5,0.1\n"
    table = read_table(write(tmp_path, f"# free_frequency_khz = 90\n{names}{rows}"))
    np.testing.assert_array_equal(table.peak_amplitude_nm, [163.3, np.nan])
    np.testing.assert_array_equal(table.lockin_amplitude_nm, [np.nan, 70.0])
    np.testing.assert_array_equal(table.lockin_amplitude_error_nm, [np.nan, 0.7])
    np.testing.assert_array_equal(table.phase_deg, [np.nan, -12.5])


def test_noise_stands_in_for_missing_errors_only(tmp_path: Path):
    names = NAMES.replace("\n", ",lockin_amplitude_nm\n")
    rows = "1,180,4,0,163.3,1.63,70\n2,349.2,2,-1,200,,50\n3,540,2,-1,200,7,\n"
    table = read_table(write(tmp_path, f"# free_frequency_khz = 90\n{names}{rows}"), noise=0.25)
    # A quarter is exact in binary, so are the products.
    np.testing.assert_array_equal(table.peak_amplitude_error_nm, [1.63, 50.0, 7.0])
    np.testing.assert_array_equal(table.lockin_amplitude_error_nm, [17.5, 12.5, np.nan])


def test_drives_without_an_orbit_need_no_amplitude(tmp_path: Path):
    names = NAMES.replace("\n", ",no_orbit\n")
    rows = "1,180,4,0,163.3,1.63,0\n2,349.2,0.1,-1,,,1\n3,540,2,-1,200,7,\n"
    table = read_table(write(tmp_path, f"# free_frequency_khz = 90\n{names}{rows}"))
    np.testing.assert_array_equal(table.no_orbit, [0.0, 1.0, np.nan])
    np.testing.assert_array_equal(table.peak_amplitude_nm, [163.3, np.nan, 200.0])


def test_what_is_known_of_the_instrument_is_kept(tmp_path: Path):
    known = "# tip_calibration = 1.01 +- 0.02\n# drive_calibration = 1 ± 0.05\n# offset_origin_nm = -0.2 +- 0.3\n"
    table = read_table(write(tmp_path, known + TEXT))
    assert table.calibration == {
        "tip_calibration": (1.01, 0.02),
        "drive_calibration": (1.0, 0.05),
        "offset_origin_nm": (-0.2, 0.3),
    }
    assert table.remarks == ()


def test_rows_in_order_of_time_are_so_only_where_the_table_says_it(tmp_path: Path):
    assert not read_table(write(tmp_path, TEXT)).rows_in_order_of_time
    table = read_table(write(tmp_path, "# rows = in order of time\n" + TEXT))
    assert table.rows_in_order_of_time
    assert table.remarks == ()
    with pytest.raises(TableError, match="rows must be 'in order of time', but is 'in order of height'"):
        read_table(write(tmp_path, "# rows = in order of height\n" + TEXT))


def test_replaced_columns_may_have_another_length(tmp_path: Path):
    read = read_table(write(tmp_path, "# free_frequency_khz = 90\n" + FEW))
    names = ("order", "drive_frequency_khz", "drive_amplitude_nm", "offset_nm")
    names += ("peak_amplitude_nm", "peak_amplitude_error_nm")
    first = dataclasses.replace(read, **{name: getattr(read, name)[:1] for name in names})
    assert read.lines.tolist() == [3, 4]
    assert first.lines.tolist() == [1]


def test_arrays_are_read_only_copies():
    order = np.array([1, 2])
    table = small_table(order=order)
    order[0] = 7
    np.testing.assert_array_equal(table.order, [1, 2])
    with pytest.raises(ValueError, match="read-only"):
        table.offset_nm[0] = 3.0
    np.testing.assert_array_equal(table.lines, [1, 2])


POSITIVE = st.floats(min_value=1e-30, max_value=1e9)
FINITE = st.floats(min_value=-1e9, max_value=1e9)
REMARKS = st.text(st.characters(codec="utf-8", exclude_characters="\r\n\0"), min_size=1).map(str.strip)


@st.composite
def table_fields(draw: st.DrawFn) -> dict[str, Any]:
    """The fields of any table that keeps the rules: any columns, any blank cells, numbers over the whole range."""
    drives = st.tuples(st.integers(1, 2**53 - 1), POSITIVE, POSITIVE, FINITE)
    points = draw(st.lists(drives, min_size=1, max_size=6))
    rows = len(points)

    def measured(values: st.SearchStrategy[float], there: list[bool]) -> tuple[np.ndarray, np.ndarray]:
        cells = [(draw(values), draw(POSITIVE)) if one else (np.nan, np.nan) for one in there]
        return np.array([cell[0] for cell in cells]), np.array([cell[1] for cell in cells])

    kinds = draw(st.sampled_from([("peak_amplitude",), ("lockin_amplitude",), ("peak_amplitude", "lockin_amplitude")]))
    unseen = [draw(st.sampled_from([0.0, 1.0, np.nan])) for _ in range(rows)] if draw(st.booleans()) else [0.0] * rows
    present = st.sampled_from([(0,), (1,), (0, 1)] if len(kinds) == 2 else [(0,)])
    which = [() if mark == 1.0 else draw(present) for mark in unseen]
    columns = {"no_orbit": np.array(unseen)} if any(unseen) or draw(st.booleans()) else {}
    for index, kind in enumerate(kinds):
        value, error = measured(POSITIVE, [index in there for there in which])
        columns |= {f"{kind}_nm": value, f"{kind}_error_nm": error}
    if draw(st.booleans()):
        columns["phase_deg"], columns["phase_error_deg"] = measured(FINITE, [draw(st.booleans()) for _ in range(rows)])
    quality_factor = draw(st.none() | st.just(np.nan) | st.floats(0.5, 1e9, exclude_min=True))
    return columns | {
        "order": np.array([point[0] for point in points]),
        "drive_frequency_khz": np.array([point[1] for point in points]),
        "drive_amplitude_nm": np.array([point[2] for point in points]),
        "offset_nm": np.array([point[3] for point in points]),
        "free_frequency_khz": draw(POSITIVE),
        "quality_factor": quality_factor,
        "quality_factor_error": None if quality_factor in (None, np.nan) else draw(st.none() | POSITIVE),
        "mass_ng": draw(st.none() | POSITIVE),
        "calibration": draw(
            st.fixed_dictionaries(
                {},
                optional={
                    "tip_calibration": st.tuples(POSITIVE, POSITIVE),
                    "drive_calibration": st.tuples(POSITIVE, POSITIVE),
                    "offset_origin_nm": st.tuples(FINITE, POSITIVE),
                },
            )
        ),
        "remarks": tuple(draw(st.lists(REMARKS, max_size=3))),
        "rows_in_order_of_time": draw(st.booleans()),
    }


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(fields=table_fields())
def test_a_written_table_reads_back_the_same(tmp_path: Path, fields: dict[str, Any]):
    # The run-time type checks draw random numbers, which a strategy must not; hence the table is made here.
    fields["remarks"] = tuple(remark for remark in fields["remarks"] if remark and setting_in(remark, SETTINGS) is None)
    table = AmplitudeTable(**fields)
    first, second = tmp_path / "first.csv", tmp_path / "second.csv"
    write_table(table, first)
    back = read_table(first)
    assert_same(table, back, but=("source", "lines"))
    assert back.source == str(first)
    write_table(back, second)
    assert first.read_bytes() == second.read_bytes()


def test_an_unwritable_path_is_one_line(tmp_path: Path):
    with pytest.raises(TableError) as caught:
        write_table(small_table(), tmp_path / "no" / "table.csv")
    assert str(caught.value) == (
        f"{tmp_path / 'no' / 'table.csv'}: cannot be written (No such file or directory); choose another path"
    )


def test_thirty_thousand_rows_read_in_seconds(tmp_path: Path):
    rows = 30_000
    random = np.random.default_rng(1)
    columns = {name: random.uniform(1.0, 100.0, rows) for name in TABLE.names}
    columns |= {"order": np.full(rows, 2), "no_orbit": np.zeros(rows)}
    table = small_table(**columns)
    write_table(table, tmp_path / "long.csv")
    start = time.process_time()
    back = read_table(tmp_path / "long.csv")
    # About 0.3 s of processor time on a slow core, 1.2 s where coverage is counted; the rest is room for a busy one.
    assert time.process_time() - start < 3.0
    assert_same(table, back, but=("source", "lines"))


def test_reading_does_not_load_jax():
    code = "import sys, fitting.tables.table; sys.exit('jax' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_repeated_readings_give_the_errors_that_a_table_lacks(tmp_path: Path):
    """Pooled standard deviations of NumPy, widened by SciPy's Student's t; phases about 0 and 120 degrees."""
    random = np.random.default_rng(5)
    drive = np.repeat(np.arange(5), 3)
    peak = (100.0 + 20.0 * drive) * (1.0 + 0.01 * random.standard_normal(15))
    phase = np.where(drive == 0, 119.9, 30.0 + drive) + 0.3 * random.standard_normal(15)
    rows = [
        f"3,{180 + 10 * one},4,-2,{float(peak[i])!r},{float(phase[i] % 120.0)!r}"
        for i, one in enumerate(drive.tolist())
    ]
    # a drive that was measured once has the error too
    rows.append("3,250,4,-2,80,7")
    names = "order,drive_frequency_khz,drive_amplitude_nm,offset_nm,peak_amplitude_nm,phase_deg"
    path = tmp_path / "repeated.csv"
    path.write_text("\n".join(["# free_frequency_khz = 90", names, *rows]) + "\n", encoding="utf-8")
    table = read_table(path)
    wider = student_t.ppf(0.975, 10) / 1.959964
    share = np.sqrt(np.mean([np.var(peak[drive == i], ddof=1) / np.mean(peak[drive == i]) ** 2 for i in range(5)]))
    degrees = np.sqrt(np.mean([np.var(phase[drive == i], ddof=1) for i in range(5)]))
    assert table.peak_amplitude_error_nm is not None
    assert table.phase_error_deg is not None
    np.testing.assert_allclose(table.peak_amplitude_error_nm, wider * share * np.append(peak, 80.0), rtol=1e-6)
    np.testing.assert_allclose(table.phase_error_deg, np.full(16, wider * degrees), rtol=1e-6)
    assert table.remarks[0] == (
        f"errors from repeated readings: peak_amplitude_nm +- {100.0 * wider * share:.3g} % (15 rows of 5 drives, "
        "widened 1.14 times for their number)"
    )
    again = AmplitudeTable.from_dataframe(table.to_pandas().drop(columns=["peak_amplitude_error_nm"]))
    assert again.peak_amplitude_error_nm is not None
    np.testing.assert_allclose(again.peak_amplitude_error_nm, wider * share * np.append(peak, 80.0), rtol=1e-6)
    write_table(table, tmp_path / "written.csv")
    assert read_table(tmp_path / "written.csv").remarks == table.remarks
    # three repeats are too few
    path.write_text("\n".join(["# free_frequency_khz = 90", names, *rows[:4], rows[-1]]) + "\n", encoding="utf-8")
    with pytest.raises(TableError, match=r"has no errors; add .* or repeat readings: 4 repeats tell them"):
        read_table(path)
