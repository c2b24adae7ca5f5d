"""Reading and writing of amplitude tables: values against the csv module, and a lossless round trip."""

import csv
import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.stats import t as student_t

from fitting.tables.csv_text import TableError, setting_in
from fitting.tables.table import SETTINGS, TABLE, AmplitudeTable, as_table, read_table, write_table

NAMES = "order,drive_frequency_khz,drive_amplitude_nm,offset_nm,peak_amplitude_nm,peak_amplitude_error_nm\n"
KEY = "# free_frequency_khz = 90\n"
TEXT = f"{KEY}{NAMES}1,180,4,0,163.3,1.63\n2,349.2,2,-1,106.67,1.06\n"
TAPPING = """# drive = force
# free_frequency_khz = 90 +- 0.01
# spring_constant_n_per_m = 5.4 +- 0.5
# phase_zero_deg = -1 +- 0.2
drive_frequency_khz,free_amplitude_nm,offset_nm,lockin_amplitude_nm,lockin_amplitude_error_nm,phase_lag_deg,phase_lag_error_deg,retract,order
92.7,80,-40,44,0.1,2,0.2,0,1
99,40,-20,21,0.1,,,1,1
"""


def read(folder: Path, text: str, noise: float | None = None) -> AmplitudeTable:
    path = folder / "table.csv"
    path.write_bytes(text.encode())
    return read_table(path, noise)


def small_table(**changes: Any) -> AmplitudeTable:
    columns: dict[str, Any] = {"order": np.array([1, 2]), "drive_frequency_khz": np.array([180.0, 349.2])}
    columns |= {"drive_amplitude_nm": np.array([4.0, 2.0]), "offset_nm": np.array([0.0, -1.0])}
    columns |= {"peak_amplitude_nm": np.array([163.3, 106.67]), "peak_amplitude_error_nm": np.array([1.63, 1.06])}
    return AmplitudeTable(**{"free_frequency_khz": 90.0, **columns, **changes})


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
    assert (table.free_frequency_khz, table.quality_factor, table.mass_ng, table.phase_deg) == (90.0, 40.0, 1.0, None)


def test_names_the_line_of_every_row(tmp_path: Path):
    table = read(tmp_path, TEXT.replace("2,349.2", "\n# pause\n,,,,,\n2,349.2"))
    np.testing.assert_array_equal(table.lines, [3, 7])
    assert table.remarks == ("pause",)
    names = [name for name in TABLE.names if getattr(table, name) is not None]
    first = dataclasses.replace(table, **{name: getattr(table, name)[:1] for name in names})
    assert first.lines.tolist() == [1]


@pytest.mark.parametrize(
    "text",
    [
        "\ufeff" + TEXT,
        TEXT.replace("\n", "\r\n"),
        TEXT.rstrip("\n").replace("\n", "\r"),
        TEXT.replace(",", " ,\t ").replace("# free", "  #free").replace(" = ", "="),
        TEXT.replace("163.3", '"163.3"').replace("349.2", ' "349.2" ').replace("order", '"order"'),
        TEXT.replace("= 90", "= 90,,,,,").replace("163.3", "+1.633e2").replace("349.2", "3492E-1"),
        TEXT.replace(KEY, "") + KEY,
        *(TEXT.replace(",", sign) for sign in ";\t "),
    ],
    ids=["mark", "crlf", "cr", "spaces", "quotes", "numbers", "below", "semicolons", "tabs", "blanks"],
)
def test_writing_habits_make_no_difference(tmp_path: Path, text: str):
    plain = read(tmp_path, TEXT)
    assert str(plain.quality_factor) == "nan"
    np.testing.assert_array_equal(plain.peak_amplitude_nm, [163.3, 106.67])
    assert_same(plain, read(tmp_path, text), but=("lines",))


FORTY = "40 +- 2", "40 ± 2", "40+-2", "40 +/- 2", "4e1 +- 2.0,,"
QUALITY = {"quality_factor": 40.0, "quality_factor_error": 2.0, "mass_ng": 3.5}
UNKNOWN = dict.fromkeys(("quality_factor", "quality_factor_error", "mass_ng", "spring_constant_n_per_m"))
TIP, DRIVE, ORIGIN = "tip_calibration = 1.01 +- 0.02", "drive_calibration = 1 ± 0.05", "offset_origin_nm = -0.2 +- 0.3"
CALIBRATION = {"tip_calibration": (1.01, 0.02), "drive_calibration": (1.0, 0.05), "offset_origin_nm": (-0.2, 0.3)}
FREE_TEXT = "Operator = Jan", "12:30 h", "Measured: Tuesday", "# twice", "humidity_percent = 40", "a, b,,", "=", "ä"


@pytest.mark.parametrize(
    ("comment", "fields"),
    [
        *((f"quality_factor = {value}\n# mass_ng = 3.5", QUALITY) for value in FORTY),
        ("quality_factor = none", UNKNOWN | {"rows_in_order_of_time": False}),
        (f"{TIP}\n# {DRIVE}\n# {ORIGIN}", {"calibration": CALIBRATION, "remarks": ()}),
        ("rows = in order of time", {"rows_in_order_of_time": True, "remarks": ()}),
        *((remark, {"remarks": (remark,)}) for remark in FREE_TEXT),
    ],
)
def test_comments_are_settings_or_remarks(tmp_path: Path, comment: str, fields: dict[str, Any]):
    table = read(tmp_path, f"# {comment}\n{TEXT}")
    assert {name: getattr(table, name) for name in fields} == fields


def test_mass_and_spring_constant_say_the_same(tmp_path: Path):
    mass = 5.4 / (2e-3 * np.pi * 90.0) ** 2
    spring = "# spring_constant_n_per_m = 5.4 +- 0.5\n"
    assert read(tmp_path, spring + TEXT).mass_ng == pytest.approx(mass, rel=1e-14)
    stated = read(tmp_path, f"{spring}# mass_ng = {1.019 * mass}\n{TEXT}")
    assert stated.mass_ng == pytest.approx(1.019 * mass, rel=1e-14)
    # 2 % is too far, however badly the spring constant is known
    with pytest.raises(TableError, match="contradict each other"):
        read(tmp_path, f"{spring}# mass_ng = {1.021 * mass}\n{TEXT}")


def test_blank_cells_are_not_measured(tmp_path: Path):
    names = NAMES.replace("\n", ",lockin_amplitude_nm,lockin_amplitude_error_nm,phase_deg,phase_error_deg,no_orbit\n")
    rows = "1,180,4,0,163.3,1.63,,,,,0\n1,180,5,0,, ,70,0.7,-12.5,0.1,\n2,349.2,0.1,-1,,,,,,,1\n"
    table = read(tmp_path, KEY + names + rows)
    read_back = [table.peak_amplitude_nm, table.lockin_amplitude_error_nm, table.phase_deg, table.no_orbit]
    blank = np.nan
    wanted = [[163.3, blank, blank], [blank, 0.7, blank], [blank, -12.5, blank], [0.0, blank, 1.0]]
    np.testing.assert_array_equal(read_back, wanted)


def test_noise_stands_in_for_missing_errors_only(tmp_path: Path):
    names = NAMES.replace("\n", ",lockin_amplitude_nm\n")
    rows = "1,180,4,0,163.3,1.63,70\n2,349.2,2,-1,200,,50\n3,540,2,-1,200,7,\n"
    table = read(tmp_path, KEY + names + rows, noise=0.25)
    # A quarter is exact in binary, so are the products.
    np.testing.assert_array_equal(table.peak_amplitude_error_nm, [1.63, 50.0, 7.0])
    np.testing.assert_array_equal(table.lockin_amplitude_error_nm, [17.5, 12.5, np.nan])


def test_the_curve_of_a_cantilever_that_is_driven_itself_is_read_and_written(tmp_path: Path):
    table = read(tmp_path, TAPPING)
    assert (table.drive, table.tapping, table.rows, table.drive_amplitude_nm) == ("force", True, 2, None)
    np.testing.assert_array_equal([table.free_amplitude_nm, table.phase_lag_deg], [[80.0, 40.0], [2.0, np.nan]])
    assert (table.free_frequency_khz, table.free_frequency_error_khz) == (90.0, 0.01)
    assert (table.spring_constant_n_per_m, table.spring_constant_error_n_per_m) == (5.4, 0.5)
    assert table.calibration == {"phase_zero_deg": (-1.0, 0.2)}
    # a tap a period: without the column orders are 1
    blank = read(tmp_path, TAPPING.replace(",order\n", "\n").replace(",1\n", "\n").replace("= force", "= base"))
    np.testing.assert_array_equal(blank.order, [1, 1])
    made = dataclasses.replace(blank, order=np.zeros(0, dtype=int))
    write_table(made, tmp_path / "second.csv")
    assert_same(made, read_table(tmp_path / "second.csv"), but=("source", "lines"))


def test_a_call_may_say_the_quality_factor(tmp_path: Path):
    path = tmp_path / "table.csv"
    path.write_text(TEXT, "utf-8")
    for said, wanted in (
        (40, (40.0, None)),
        ((40.0, 2.0), (40.0, 2.0)),
        ("40 +- 2", (40.0, 2.0)),
        ("none", (None, None)),
    ):
        table = as_table(path, quality_factor=said)
        assert (table.quality_factor, table.quality_factor_error) == wanted
    with pytest.raises(ValueError, match="`quality_factor` must be finite and above 0, but is -1"):
        as_table(path, quality_factor=-1)


POSITIVE = st.floats(min_value=1e-30, max_value=1e9)
FINITE = st.floats(min_value=-1e9, max_value=1e9)
REMARKS = st.text(st.characters(codec="utf-8", exclude_characters="\r\n\0"), min_size=1).map(str.strip)


@st.composite
def table_fields(draw: st.DrawFn) -> dict[str, Any]:
    """The fields of any table that keeps the rules: any columns, any blank cells, numbers over the whole range."""
    rows = draw(st.integers(1, 6))

    def column(values: st.SearchStrategy[Any], there: list[bool] | None = None) -> np.ndarray:
        return np.array([draw(values) if one else np.nan for one in there or [True] * rows])

    kinds = draw(st.sampled_from([("peak_amplitude",), ("lockin_amplitude",), ("peak_amplitude", "lockin_amplitude")]))
    columns = {"no_orbit": column(st.sampled_from([0.0, 1.0, np.nan]))} if draw(st.booleans()) else {}
    unseen = columns.get("no_orbit", np.zeros(rows)) == 1.0
    # a row has one of the amplitudes at least, unless no orbit was seen
    subsets = st.sets(st.sampled_from(kinds), min_size=1)
    present = [set() if one else draw(subsets) for one in unseen]
    for kind in kinds:
        there = [kind in one for one in present]
        columns |= {f"{kind}_nm": column(POSITIVE, there), f"{kind}_error_nm": column(POSITIVE, there)}
    if draw(st.booleans()):
        there = [draw(st.booleans()) for _ in range(rows)]
        columns |= {"phase_deg": column(FINITE, there), "phase_error_deg": column(POSITIVE, there)}
    quality_factor = draw(st.none() | st.just(np.nan) | st.floats(0.5, 1e9, exclude_min=True))
    calibration = {"tip_calibration": POSITIVE, "drive_calibration": POSITIVE, "offset_origin_nm": FINITE}
    known = {name: st.tuples(values, POSITIVE) for name, values in calibration.items()}
    return columns | {
        "order": column(st.integers(1, 10**9)),
        "drive_frequency_khz": column(POSITIVE),
        "drive_amplitude_nm": column(POSITIVE),
        "offset_nm": column(FINITE),
        "free_frequency_khz": draw(POSITIVE),
        "quality_factor": quality_factor,
        "quality_factor_error": None if quality_factor in (None, np.nan) else draw(st.none() | POSITIVE),
        "mass_ng": draw(st.none() | POSITIVE),
        "calibration": draw(st.fixed_dictionaries({}, optional=known)),
        "remarks": tuple(draw(st.lists(REMARKS, max_size=3))),
        "rows_in_order_of_time": draw(st.booleans()),
    }


@settings(max_examples=50, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
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


def test_repeated_readings_give_the_errors_that_a_table_lacks(tmp_path: Path):
    """Pooled standard deviations of NumPy, widened by SciPy's Student's t; phases about 0 and 120 degrees."""
    random = np.random.default_rng(5)
    drive = np.repeat(np.arange(5), 3)
    peak = (100.0 + 20.0 * drive) * (1.0 + 0.01 * random.standard_normal(15))
    phase = np.where(drive == 0, 119.9, 30.0 + drive) + 0.3 * random.standard_normal(15)
    readings = zip(drive, peak.tolist(), (phase % 120.0).tolist(), strict=True)
    rows = [f"3,{180 + 10 * i},4,-2,{height!r},{turn!r}\n" for i, height, turn in readings]
    # a drive that was measured once has the error too
    rows.append("3,250,4,-2,80,7\n")
    head = KEY + "order,drive_frequency_khz,drive_amplitude_nm,offset_nm,peak_amplitude_nm,phase_deg\n"
    table = read(tmp_path, head + "".join(rows))
    wider = student_t.ppf(0.975, 10) / 1.959964
    share = np.sqrt(np.mean([np.var(peak[drive == i], ddof=1) / np.mean(peak[drive == i]) ** 2 for i in range(5)]))
    degrees = np.sqrt(np.mean([np.var(phase[drive == i], ddof=1) for i in range(5)]))
    errors = wider * share * np.append(peak, 80.0)
    again = AmplitudeTable.from_dataframe(table.to_pandas().drop(columns=["peak_amplitude_error_nm"]))
    for found in (table.peak_amplitude_error_nm, again.peak_amplitude_error_nm):
        np.testing.assert_allclose(np.asarray(found), errors, rtol=1e-6)
    np.testing.assert_allclose(np.asarray(table.phase_error_deg), np.full(16, wider * degrees), rtol=1e-6)
    said = f"peak_amplitude_nm +- {100.0 * wider * share:.3g} % (15 rows of 5 drives, widened 1.14 times"
    assert table.remarks[0].startswith(f"Errors from repeated readings: {said}")
    write_table(table, tmp_path / "written.csv")
    assert read_table(tmp_path / "written.csv").remarks == table.remarks
    # three repeats are too few
    with pytest.raises(TableError, match=r"has no errors; add .* or repeat readings: 4 repeats tell them"):
        read(tmp_path, head + "".join([*rows[:4], rows[-1]]))
