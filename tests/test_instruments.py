"""Instruments' files: the real ones completely, the others against their writers; traps named; damage in one line."""

import re
import struct
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

import fitting.instruments.recording as recording_module
from afm_jax.cli.main import main
from afm_jax.saved import as_json
from fitting import TableError, read_curve, read_curves, read_table
from fitting.examples import RAW_CURVE, RAW_CURVE_OPTIONS
from fitting.examples.make_raw_curve import FREE_NM, NM_PER_VOLT, raw_curve, true_energy_aj
from fitting.instruments.curve import MeasuredCurve, table_text
from fitting.instruments.formats import read_recording
from fitting.tables.table import parse_table
from fitting.tapping_curves.measured import is_table
from fitting.tapping_curves.tapping import tapping
from tests.instrument_files import BRUKER, asylum_ramp, bruker_ramp, nanonis_ramp, separated, tapping_rows
from tests.strict_reading import strictly

REAL = Path(__file__).parent.parent / "fitting" / "examples" / "real"
AMPLITUDES, FORCES = (REAL / f"tapping_{what}_wsxm.f.curves" for what in ("amplitude", "normal_force"))
NEASNOM, THERMAL = REAL / "tapping_approach_neasnom.txt", REAL / "thermal_nanosurf.nid"


def saved(folder: Path, data: bytes | str, name: str = "curve.dat") -> Path:
    path = folder / name
    path.write_bytes(data.encode() if isinstance(data, str) else data)
    return path


def given(column: np.ndarray | None) -> np.ndarray:
    assert column is not None
    return column


def run(*arguments: object):
    return CliRunner().invoke(main, ["read", *(str(argument) for argument in arguments)])


# ---- the real files


def test_neasnom_text_is_read_completely():
    lines = NEASNOM.read_text("utf-8").split("\n")
    head = next(number for number, line in enumerate(lines) if line.startswith("Row"))
    names = lines[head].split("\t")
    columns = np.loadtxt(NEASNOM, skiprows=head + 1, usecols=range(len(names) - 1), unpack=True)
    wanted = dict(zip(names, columns, strict=False))
    curve = read_curve(NEASNOM)
    np.testing.assert_allclose(given(curve.amplitude), wanted["M1A"], rtol=1e-15)
    np.testing.assert_allclose(given(curve.phase_lag_deg), np.rad2deg(np.unwrap(wanted["M1P"])), rtol=1e-12)
    # heights grow towards the tip, from an origin of their own
    np.testing.assert_allclose(np.diff(curve.offset_nm), -1e9 * np.diff(wanted["Z"]), atol=1e-10)
    assert (len(curve.offset_nm), set(curve.branch)) == (200, {"retract"})
    frequency = curve.known["drive_frequency_khz"]
    assert (frequency.value, frequency.origin) == (264.13261, "header: Tip Frequency")
    assert {"free_frequency_khz", "quality_factor", "spring_constant_n_per_m"} == set(curve.missing)
    # the amplitude falls by more than the height rises: its scale is off
    assert curve.slope == (pytest.approx(-1.37, abs=0.02), pytest.approx(0.018, abs=0.01))
    assert any("falls by 1.37" in note for note in curve.notes)
    assert curve.number("free_amplitude_nm") == pytest.approx(77.26, abs=0.02)
    assert read_curve(NEASNOM, nm_per_volt="slope").number("free_amplitude_nm") == pytest.approx(56.4, abs=0.3)


def test_wsxm_curves_are_read_completely():
    curves = read_curves(AMPLITUDES)
    assert [(len(c.offset_nm), int(np.sum(c.branch == "approach"))) for c in curves] == [(1024, 512)] * 5
    last = struct.unpack("<2048d", AMPLITUDES.read_bytes()[-16384:])
    recorded = read_recording(AMPLITUDES).segments[-2:]
    pairs = np.concatenate([np.stack(list(segment.channels.values()), axis=1) for segment in recorded])
    np.testing.assert_array_equal(pairs.ravel(), last)
    heights = np.array(last[::2])
    assert curves[4].offset_nm - curves[4].offset_nm[0] == pytest.approx(heights - heights[0], abs=1e-12)
    known = {key: curves[0].number(key) for key in ("free_frequency_khz", "quality_factor", "spring_constant_n_per_m")}
    assert known == {"free_frequency_khz": 89.7046, "quality_factor": 201.854, "spring_constant_n_per_m": 5.33904}
    with pytest.raises(TableError, match="no lockin_amplitude_nm among the channels Z, Normal force; say"):
        read_curves(FORCES)


def test_wsxm_curves_whose_free_amplitude_jumps_are_refused_by_name():
    curves = read_curves(AMPLITUDES)
    assert "3.513 V in the approach and 2.854 V in the retract" in curves[1].reasons[1]
    # tapping at 1.08 to 1.12 V/nm, on a channel that is inverted
    assert all(-1.13 < curve.slope[0] < -1.08 for curve in curves if curve.slope is not None)
    assert "nm_per_volt" in curves[0].missing
    assert any("inverted channel" in note for note in curves[0].notes)
    with pytest.raises(TableError, match=r'give `nm_per_volt=NM_PER_V\|"slope"`'):
        table_text(curves[0])


def test_a_nanosurf_spectrum_is_what_their_own_package_reads():
    recording = read_recording(THERMAL)
    channels = recording.segments[0].channels
    assert {len(numbers) for numbers in channels.values()} == {8369}
    known = {key: recording.known[key].value for key in ("spring_constant_n_per_m", "quality_factor", "temperature_k")}
    wanted = {"spring_constant_n_per_m": 27.13, "quality_factor": 442.0, "temperature_k": pytest.approx(313.15)}
    assert known == wanted
    np.testing.assert_allclose(channels["Frequency"], np.arange(8369) * 319214.0 / 8368.0, rtol=1e-14)
    with pytest.raises(TableError, match="holds a spectrum or a resonance sweep"):
        read_curve(THERMAL)


# ---- formats of which no real file is at hand


def with_units_in_names(sign: str, decimal: str) -> str:
    offset, amplitude, lag = tapping_rows()
    return separated({"Z [um]": 1e-3 * offset, "Amp (nm)": amplitude, "Phase/rad": np.deg2rad(lag)}, sign, decimal)


def without_names(separator: str) -> str:
    decimal = "." if separator.strip() == "," else ","
    rows = zip(*tapping_rows(), strict=True)
    return "".join(separator.join(f"{cell:.4f}".replace(".", decimal) for cell in row) + "\n" for row in rows)


RAMP = {"drive": "force"}
NUMBERS = {"columns": "offset_nm=1:nm,lockin_amplitude_nm=2:nm,phase_lag_deg=3:deg"}


@pytest.mark.parametrize(
    ("write", "options", "precision", "degrees"),
    [
        # 32-bit numbers
        (partial(asylum_ramp, order="<"), RAMP, {"rtol": 2e-7}, 0.01),
        (partial(asylum_ramp, order=">"), RAMP, {"rtol": 2e-7}, 0.01),
        (nanonis_ramp, {}, {"rtol": 1e-9}, 1e-6),
        (partial(with_units_in_names, "\t", "."), {}, {"rtol": 0.0, "atol": 1e-6}, 1e-4),
        (partial(with_units_in_names, ";", ","), {}, {"rtol": 0.0, "atol": 1e-6}, 1e-4),
        # decimal commas are told from commas that separate
        *((partial(without_names, sign), NUMBERS, {"rtol": 0.0, "atol": 1e-4}, 1e-4) for sign in (" ", ", ")),
    ],
)
def test_every_format_holds_the_same_curve(tmp_path: Path, write, options: dict, precision: dict, degrees: float):
    offset, amplitude, lag = tapping_rows()
    curve = read_curve(saved(tmp_path, write()), **options)
    assert int(np.sum(curve.branch == "approach")) == 120
    assert len(curve.branch) == (240 if options is RAMP or write is nanonis_ramp else 120)
    np.testing.assert_allclose(given(curve.amplitude)[:120], amplitude, **precision)
    np.testing.assert_allclose(given(curve.phase_lag_deg)[:120], lag, atol=degrees)
    np.testing.assert_allclose(np.diff(curve.offset_nm[:120]), np.diff(offset), atol=1e-2)
    # where the amplitude begins to fall the sample is one free amplitude below the rest position
    np.testing.assert_allclose(curve.offset_nm[:120], offset, atol=0.3)


def test_what_files_say_of_the_lever_is_known_with_its_origin(tmp_path: Path):
    curve = read_curve(saved(tmp_path, asylum_ramp()), drive="force")
    known = curve.known["free_frequency_khz"]
    assert (known.value, known.unit, known.origin) == (
        pytest.approx(90.0, rel=1e-12),
        "kHz",
        "header: ThermalFrequency",
    )
    lever = ("spring_constant_n_per_m", "quality_factor", "drive_frequency_khz")
    numbers = [curve.number(key) for key in (*lever, "nm_per_volt")]
    assert numbers == pytest.approx([5.4, 200.0, 90.0, 120.0], rel=1e-12)
    assert (curve.known["drive"].origin, curve.missing) == ("option `drive=...`", ())
    nanonis = read_curve(saved(tmp_path, nanonis_ramp()))
    assert nanonis.number("free_frequency_khz") == 90.0
    assert any("grows away from the sample" in note for note in nanonis.notes)


def test_a_column_map_names_channels_units_and_factors(tmp_path: Path):
    offset, amplitude, lag = tapping_rows()
    path = saved(tmp_path, separated({"a": -1e-3 * offset, "b": 0.01 * amplitude, "c": -lag}, ";"))
    with pytest.raises(TableError, match="among the channels a, b, c; say `columns=") as raised:
        read_curve(path)
    # the line is ready to paste
    pasted = read_curve(path, columns=str(raised.value).rpartition('columns="')[2].removesuffix('"`'))
    np.testing.assert_allclose(given(pasted.phase_lag_deg), -lag, atol=1e-5)
    wanted = "offset_nm=a:um:-1,lockin_amplitude_nm=b:V,phase_lag_deg=c:-1"
    curve = read_curve(path, columns=wanted)
    assert (curve.amplitude_unit, "nm_per_volt" in curve.missing) == ("V", True)
    lever: dict[str, Any] = {"drive_frequency_khz": 90.0, "free_frequency_khz": 90.0}
    curve = read_curve(path, columns=wanted, nm_per_volt=(100.0, 2.0), **lever)
    # six decimals of hundredths
    np.testing.assert_allclose(given(curve.amplitude), amplitude, atol=1e-4)
    np.testing.assert_allclose(given(curve.phase_lag_deg), lag, atol=1e-5)
    assert "# tip_calibration = 1.0 +- 0.02\n" in table_text(curve)


def test_pairs_of_names_are_two_ways_and_numbers_count_below_a_head(tmp_path: Path):
    there, back = tapping_rows(), tapping_rows(retract=True)
    path = saved(tmp_path, bruker_ramp())
    for columns in ("", BRUKER):
        curve = read_curve(path, columns=columns, nm_per_volt="50 +- 1", drive="force")
        assert curve.branch.tolist() == ["approach"] * 120 + ["retract"] * 120
        assert curve.known["nm_per_volt"].error == 1.0
        np.testing.assert_allclose(given(curve.amplitude), np.concatenate([there[1], back[1]]), atol=1e-4)
        np.testing.assert_allclose(given(curve.phase_lag_deg), np.concatenate([there[2], back[2]]), atol=1e-4)
    offset, amplitude, lag = there
    path = saved(tmp_path, separated({"a": offset, "b": amplitude, "c": lag}, ";"))
    by_number = read_curve(path, columns="offset_nm=1:nm,lockin_amplitude_nm=2:nm,phase_lag_deg=3:deg")
    np.testing.assert_allclose(np.diff(by_number.offset_nm), np.diff(offset), atol=1e-5)
    np.testing.assert_allclose(given(by_number.phase_lag_deg), lag, atol=1e-5)


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (b"\x89HDF\r\n\x1a\n", "Nanosurf's .nhf; export the curve as .nid or CSV"),
        (b"\x12\x34\x56\x78\x10\0\0\0ARDF", "Asylum's .ARDF; export the curve as .ibw, or as text"),
        (b"\\*Force file list\r\n", "Bruker's; export the curve as text"),
    ],
)
def test_files_that_are_not_read_say_how_to_export(tmp_path: Path, data: bytes, said: str):
    with pytest.raises(TableError, match=re.escape(said)):
        read_curves(saved(tmp_path, data))


def test_columns_without_names_are_asked_for_in_pairs(tmp_path: Path):
    path = saved(tmp_path, raw_curve(50).text)
    for columns, said in (
        ("offset_nm=1/2:nm,lockin_amplitude_nm=5:V", "=5 has one channel where other columns have OUT/BACK"),
        ("", re.escape('say `columns="offset_nm=1/2:nm,lockin_amplitude_nm=5/6:V')),
    ):
        with pytest.raises(TableError, match=said):
            read_curves(path, columns=columns)


def test_a_file_that_begins_like_an_instruments_is_no_table(tmp_path: Path):
    comments = b"# free_frequency_khz = 90\r\n"
    for start, table in ((b"", True), (b"WSxM file copyright\r\n", False), (b"Z (m),Amp (m)\r\n", True)):
        assert is_table(saved(tmp_path, start + comments)) == table


# ---- what the numbers say themselves


def test_channels_whose_names_say_nothing_are_asked_for(tmp_path: Path):
    path = saved(tmp_path, "Z;A;P\n-10;9.8;80\n-9;9;70\n-8;8.2;65\n")
    notes = read_curve(path, columns="lockin_amplitude_nm=A").notes
    assert any('another channel is, say `columns="offset_nm=Z:nm,' in note for note in notes)
    # names that cannot be printed are quoted
    strange = saved(tmp_path, "offset_nm,lockin_amplit\x1dude_nm,phase_lag_deg\n" + "1,2,3\n" * 9)
    assert read_recording(strange).channels == ["offset_nm", r"'lockin_amplit\x1dude_nm'", "phase_lag_deg"]


OFFSET, AMPLITUDE, LAG = tapping_rows()
NEAR = OFFSET > -38.0
KNOWN: dict[str, Any] = {"free_frequency_khz": 90.0, "quality_factor": 200.0, "drive": "force"}


@pytest.fixture
def curve_of(tmp_path: Path) -> Callable[..., MeasuredCurve]:
    """Return what reads the usual curve, some of its columns changed."""

    def read(offset=OFFSET, amplitude=AMPLITUDE, phase=LAG, **options: Any) -> MeasuredCurve:
        columns = {"Z (nm)": offset, "Amp (nm)": amplitude, "Phase (deg)": phase}
        return read_curve(saved(tmp_path, separated(columns)), **options)

    return read


def test_a_ramp_there_and_back_is_parted_where_it_turns(curve_of):
    columns = (np.concatenate(both) for both in zip(tapping_rows(), tapping_rows(80, retract=True), strict=True))
    assert curve_of(*columns).branch.tolist() == ["approach"] * 120 + ["retract"] * 80


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"amplitude": np.sqrt(0.5) * AMPLITUDE}, "falls by 0.707 +- 0.00"),
        ({"amplitude": 1.3 * AMPLITUDE}, "falls by 1.3 +- 0.00"),
        ({"phase": -LAG, **KNOWN}, "Sign: the free tip"),
        ({"phase": LAG - 90.0, **KNOWN}, "Zero: the free tip"),
        ({"offset": -OFFSET}, "Direction: "),
        ({"columns": "offset_nm=Z:-1"}, "Direction: "),
        ({"offset": OFFSET[NEAR], "amplitude": AMPLITUDE[NEAR], "phase": LAG[NEAR]}, "There is no flat free part"),
    ],
)
def test_what_is_odd_is_said_and_mended_if_it_can_be(curve_of, changed: dict[str, Any], said: str):
    curve = curve_of(**changed)
    assert any(said in one for one in (*curve.notes, *curve.reasons)), curve.notes
    if not curve.reasons:
        np.testing.assert_allclose(given(curve.phase_lag_deg), LAG, atol=0.02)
        np.testing.assert_allclose(np.diff(curve.offset_nm), np.diff(OFFSET), atol=1e-5)


def test_the_zero_of_the_phase_is_that_of_the_free_rows(curve_of):
    gamma = 1.0 - 1.03**2 + 1j * 1.03 / 200.0
    for drive, wanted in (("force", np.angle(gamma)), ("base", np.angle(gamma / (1.0 - gamma)))):
        curve = curve_of(phase=LAG - 33.0, drive_frequency_khz=92.7, **(KNOWN | {"drive": drive}))
        assert np.median(given(curve.phase_lag_deg)[curve.free]) == pytest.approx(np.rad2deg(wanted), abs=1e-9)


def test_signs_and_units_of_the_phase_that_the_caller_gives_stay(curve_of):
    kept = curve_of(phase=-LAG, columns="phase_lag_deg=Phase:1", **KNOWN)
    assert np.polyfit(LAG, given(kept.phase_lag_deg), 1)[0] == pytest.approx(-1.0, abs=1e-3)
    with pytest.raises(TableError, match='it is in radians; say `columns="phase_lag_deg=CHANNEL:rad"`'):
        curve_of(phase=-np.deg2rad(LAG), **KNOWN)
    curve = curve_of(phase=np.deg2rad(LAG), columns="phase_lag_deg=Phase:rad", **KNOWN)
    assert np.ptp(given(curve.phase_lag_deg)) == pytest.approx(np.ptp(LAG), rel=1e-4)


def test_approach_and_retract_that_are_mixed_are_one_branch(curve_of):
    made = raw_curve(400, drift=0.0)
    height, amplitude = made.height_nm[0], 42.0 * made.amplitude_v[0]
    rows = np.random.default_rng(2).permutation(400)
    curve = curve_of(height[rows], amplitude[rows], 90.0 + 0.0 * height)
    assert set(curve.branch) == {"approach"}
    assert any("step back" in note for note in curve.notes)


EIGHT = "offset_nm=1/2:nm,lockin_amplitude_nm=5/6:V,phase_lag_deg=7/8:deg"
LEVER: dict[str, Any] = {"quality_factor": (230.0, 5.0), "free_frequency_khz": (344.6, 0.01), "drive": "force"}
LEVER |= {"nm_per_volt": NM_PER_VOLT}


def test_eight_columns_without_a_head_become_bins_with_the_scatter_in_them(tmp_path: Path):
    made = raw_curve(1200, drift=0.0)
    path = saved(tmp_path, made.text)
    (curve,) = read_curves(path, columns=EIGHT, **LEVER)
    assert [int(np.sum(curve.branch == name)) for name in ("approach", "retract")] == [1200, 1200]
    assert curve.known["drive_frequency_khz"].origin.startswith("assumed: on resonance")
    assert curve.bin_nm == pytest.approx(43.3 / 200.0, rel=0.01)
    repeated = sum(1200 - len(np.unique(heights)) for heights in made.height_nm)
    assert any(f"{repeated} rows repeat a height" in note for note in curve.notes)
    table = parse_table(table_text(curve), "bins")
    assert table.rows_in_order_of_time
    assert 380 < table.rows < 420
    error, lag_error = given(table.lockin_amplitude_error_nm), given(table.phase_lag_error_deg)
    # six readings of 0.2 % of 13.4 nm and of 0.12 degrees; in contact heights that scatter by 0.03 nm add to it
    free = given(table.lockin_amplitude_nm) > 0.9975 * FREE_NM
    assert np.median(error[free]) == pytest.approx(0.0268 / np.sqrt(6.0), rel=0.1)
    assert np.median(lag_error[free]) == pytest.approx(0.12 / np.sqrt(6.0), rel=0.1)
    steep = given(table.lockin_amplitude_nm) < 0.9 * FREE_NM
    assert 1.3 < np.median(error[steep]) / np.median(error[free]) < 2.5
    # the motion at the bins' heights, from the curve without noise
    for way in (0.0, 1.0):
        rows = (given(table.retract) == way) & free
        off = (given(table.lockin_amplitude_nm)[rows] - FREE_NM) / error[rows]
        assert 0.8 < np.sqrt(np.mean(off**2)) < 1.25


@pytest.mark.parametrize("padding", ["0", "nan", ""])
def test_a_shorter_way_is_padded_and_its_padding_no_rows(tmp_path: Path, padding: str):
    made = [line.split() for line in raw_curve(600, drift=0.0).text.split("\n") if line.strip() and line[0] != "#"]
    columns = np.array(made, dtype=object)
    # approach and retract stand side by side, the retract is 150 rows shorter
    columns[450:, 1::2] = padding
    text = "\n".join("\t".join(row) for row in columns.tolist()) + "\n"
    (curve,) = read_curves(saved(tmp_path, text), columns=EIGHT, **LEVER)
    (whole,) = read_curves(saved(tmp_path, raw_curve(600, drift=0.0).text), columns=EIGHT, **LEVER)
    assert curve.valid, curve.reasons
    assert [int(np.sum(curve.branch == name)) for name in ("approach", "retract")] == [600, 450]
    retract = given(curve.amplitude)[curve.branch == "retract"]
    np.testing.assert_array_equal(retract, given(whole.amplitude)[whole.branch == "retract"][:450])


def test_bins_of_a_width_asked_for_and_of_equal_heights(tmp_path: Path):
    made = raw_curve(1200)
    path = saved(tmp_path, made.text)
    (curve,) = read_curves(path, columns=EIGHT, bin_nm=1.0, **LEVER)
    table = parse_table(table_text(curve), "bins")
    assert 86 <= table.rows <= 90
    assert np.all(np.diff(table.offset_nm[:43]) > 0.5)
    (curve,) = read_curves(path, columns=EIGHT, bin_nm=0.0, **LEVER)
    table = parse_table(table_text(curve), "merged")
    assert table.rows == sum(len(np.unique(heights)) for heights in made.height_nm)
    _, counts = np.unique(made.height_nm[0], return_counts=True)
    errors = given(table.lockin_amplitude_error_nm)[given(table.retract) == 0.0]
    # 0.2 % of the free amplitude
    np.testing.assert_allclose(errors, 0.0268 / np.sqrt(counts), rtol=0.1)


def test_several_curves_of_one_file_in_metres_and_reversed(tmp_path: Path):
    made = [raw_curve(300, seed=seed) for seed in (1, 2)]
    below = [np.stack([-1e-9 * m.height_nm.ravel(), m.amplitude_v.ravel(), m.phase_deg.ravel()], 1) for m in made]
    np.savetxt(tmp_path / "curve.dat", np.concatenate(below), fmt="%.9g", delimiter=";")
    columns = "offset_nm=1:m,lockin_amplitude_nm=2:V,phase_lag_deg=3:deg"
    curves = read_curves(tmp_path / "curve.dat", columns=columns, **LEVER)
    assert [curve.curve for curve in curves] == [1, 2]
    for curve, one in zip(curves, made, strict=True):
        assert abs(int(np.sum(curve.branch == "approach")) - 300) <= 2
        assert any(note.startswith("Direction: ") for note in curve.notes)
        np.testing.assert_allclose(np.diff(curve.offset_nm[:300]), np.diff(one.height_nm[0]), atol=1e-6)
        np.testing.assert_allclose(given(curve.amplitude), NM_PER_VOLT * one.amplitude_v.ravel(), rtol=1e-6)


# ---- wrong and damaged files


def test_what_reads_a_format_is_named_where_it_is_missing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    def missing(name: str):
        raise ModuleNotFoundError(name=name)

    path = saved(tmp_path, asylum_ramp())
    monkeypatch.setattr(recording_module, "import_module", missing)
    with pytest.raises(TableError, match=r"the package igor2; install it with: pip install 'afm-jax\[instruments\]'"):
        read_curves(path)


def test_labels_of_igor_end_where_their_text_ends(tmp_path: Path):
    # what stands behind a text's NUL in its field of 32 bytes is left over from an earlier label
    field = b"Phase".ljust(32, b"\0")
    data = asylum_ramp()
    assert data.count(field) == 1
    for told, name in (
        (b"Phase\0Retrace\xe4\0rest", "Phase"),
        ("Phase °".encode(), "Phase °"),
        (b"Phase \xb0", "Phase °"),
        (b"\0nothing", "channel 3"),
    ):
        path = saved(tmp_path, data.replace(field, told.ljust(32, b"\0")))
        assert read_recording(path).channels == ["ZSnsr", "Amp", name, "Defl"]


def damaged(data: bytes, random: np.random.Generator) -> bytes:
    """Return a file cut off or with flipped bits, most of them in its header."""
    if random.random() < 0.4:
        return data[: random.integers(0, len(data))]
    flipped = bytearray(data)
    for _ in range(random.integers(1, 6)):
        place = random.integers(0, min(len(data), 4000 if random.random() < 0.7 else len(data)))
        flipped[place] ^= 1 << random.integers(0, 8)
    return bytes(flipped)


@pytest.mark.parametrize(
    "whole",
    [
        # texts are spoiled by `tests.fuzz`
        *(AMPLITUDES.read_bytes, THERMAL.read_bytes, asylum_ramp),
    ],
)
def test_damaged_files_never_end_in_a_traceback(tmp_path: Path, whole, capfd: pytest.CaptureFixture[str]):
    random, data = np.random.default_rng(20260), whole()
    for _ in range(20):
        path = saved(tmp_path, damaged(data, random))
        fault, curves = str(path), []
        try:
            curves = read_curves(path)
        except TableError as error:
            fault = str(error)
        assert str(path) in fault
        assert "\n" not in fault
        assert all(np.all(np.isfinite(curve.offset_nm)) for curve in curves)
    assert capfd.readouterr() == ("", "")


def test_tapping_takes_a_curve_that_was_read_and_its_file_alike():
    of_file, of_curve = (
        as_json(tapping(source, law=False, **options))
        for source, options in ((RAW_CURVE, RAW_CURVE_OPTIONS), (read_curve(RAW_CURVE, **RAW_CURVE_OPTIONS), {}))
    )
    assert of_file["valid"]
    assert of_file["branches"] == of_curve["branches"]
    # a file of several curves asks which
    with pytest.raises(TableError, match="several curves; choose one, `curve=1`"):
        tapping(AMPLITUDES, law=False, nm_per_volt=1090.0)
    with pytest.raises(TableError, match="refused curve 2; The free amplitude jumps"):
        tapping(AMPLITUDES, law=False, nm_per_volt="1090 +- 20", curve=2)
    with pytest.raises(TableError, match="is for an instrument's file"):
        tapping(REAL.parent / "tapping_resonance.csv", law=False, nm_per_volt=42.0)
    stated = tapping(REAL.parent / "tapping_resonance.csv", law=False, quality_factor="210 +- 3")
    assert stated.curve.quality_factor == (210.0, 3.0)


# ---- the command


def test_the_command_asks_for_what_is_missing_and_writes_the_table(tmp_path: Path):
    out = tmp_path / "new" / "table.csv"
    result = run(NEASNOM, "--out", out)
    assert (result.exit_code, result.stdout) == (2, "")
    assert "the file does not say free_frequency_khz; give --free-frequency-khz KHZ" in result.stderr
    numbers = ["--free-frequency-khz", "264 +- 0.05", "--quality-factor", "500", "--spring-constant", "40 +- 4"]
    result = run(NEASNOM, "--out", out, "--drive", "force", *numbers)
    assert result.exit_code == 0, result.stderr
    curve, table = read_curve(NEASNOM), read_table(out)
    assert (table.drive, table.free_frequency_khz, table.free_frequency_error_khz) == ("force", 264.0, 0.05)
    lever = (table.quality_factor, table.spring_constant_n_per_m, table.spring_constant_error_n_per_m)
    assert (table.rows, lever) == (200, (500.0, 40.0, 4.0))
    np.testing.assert_allclose(given(table.lockin_amplitude_nm), given(curve.amplitude), rtol=1e-5)
    np.testing.assert_array_equal(table.drive_frequency_khz, 264.13261)


def test_refused_curves_end_with_exit_code_3_beside_the_tables_of_the_others(tmp_path: Path):
    result = run(AMPLITUDES, "--json", "--nm-per-volt", "slope", "--out", tmp_path / "wsxm.csv")
    assert result.exit_code == 3
    assert "refused curve 2, 3, 4" in result.stderr
    assert [curve["valid"] for curve in strictly(result.stdout)["curves"]] == [True, False, False, False, True]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["wsxm_1.csv", "wsxm_5.csv"]
    # the amplitude in contact is an offset of the detector, in part below zero
    assert "rows whose amplitude is not above zero" in (tmp_path / "wsxm_1.csv").read_text("utf-8")
    # approach and retract pass the same heights
    assert set(given(read_table(tmp_path / "wsxm_1.csv").retract)) == {0.0, 1.0}
    assert [run(AMPLITUDES, "--curve", number).exit_code for number in (1, 9)] == [0, 2]


@pytest.mark.parametrize(("points", "noise"), [(200, 0.004), (1000, 0.002), (1000, 0.0005)])
def test_the_scale_by_the_slope_is_known_as_well_as_it_says(tmp_path: Path, points: int, noise: float):
    pulls = []
    for seed in range(20):
        text = raw_curve(points, seed=seed, noise=noise).text
        scale = read_curve(saved(tmp_path, text), **RAW_CURVE_OPTIONS).known["nm_per_volt"]
        assert scale.error is not None
        pulls.append((float(scale.value) - NM_PER_VOLT) / scale.error)
    # on the safe side where rows are many; with the scatter about the line alone it was 2.5, 1.1 and 5.6
    assert 0.4 < np.sqrt(np.mean(np.square(pulls))) < 1.4


def test_rows_exactly_on_a_line_have_a_slope(tmp_path: Path):
    # found by tests/fuzz.py: the line's error is 0, and its weight was none
    offsets = [-50, -49, -48, -47, 46, *range(-45, -30)]
    rows = "".join(f"{offset},{min(40, 50 - row)},{95 + row}\n" for row, offset in enumerate(offsets))
    (curve,) = read_curves(saved(tmp_path, f"offset_nm,lockin_amplitude_nm,phase_lag_deg\n{rows}"))
    assert curve.slope is not None
    assert curve.slope[0] == pytest.approx(-1.0, rel=1e-12)
    assert 0.0 < curve.slope[1] < 1e-8


def test_the_example_gives_the_scale_and_the_energies_that_it_was_made_with():
    scale = read_curve(RAW_CURVE, **RAW_CURVE_OPTIONS).known["nm_per_volt"]
    assert scale.error is not None
    # through all rows in contact it would be 150 nm/V
    assert abs(float(scale.value) - NM_PER_VOLT) < 3.0 * scale.error < 5.0
    answer = CliRunner().invoke(main, ["tapping", "--example", "--no-law", "--json"])
    payload = strictly(answer.stdout)
    assert (answer.exit_code, payload["valid"]) == (0, True)
    for branch in payload["branches"]:
        curve = {name: np.array(column) for name, column in branch["curve"].items()}
        true = true_energy_aj(curve["amplitude_ratio"], back=branch["branch"] == "retract")
        error = (curve["energy_high_aj"] - curve["energy_low_aj"]) / 3.92
        assert np.all(np.abs(curve["energy_aj"] - true) < 3.0 * error)
    told = " ".join(payload["notes"])
    assert "The example is simulated; as if it were measured: afm-jax tapping " in told
    assert "slope of the steepest settled part" in told
    assert "rows repeat a height" in told
