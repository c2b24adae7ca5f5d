"""Traces from files: CSV and HDF5, settings in them and beside them, and what is wrong with them."""

import contextlib
import re
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fitting import TableError, read_trace
from fitting.traces.trace import Trace, TraceSettings
from tests.lockin_traces import bounce

DRIVE = 181.8
COMMENTS = "# drive_frequency_khz = 181.8\n# quality_factor = 40 +- 2\n# Tuesday's tip\n"


TIME = 2.0 + np.arange(300) / 10.0
HEIGHT = bounce(TIME, order=1, drive_khz=DRIVE)[0]


def saved(folder: Path, columns: dict[str, np.ndarray], comments: str = COMMENTS) -> Path:
    path = folder / "trace.csv"
    rows = zip(*(column.tolist() for column in columns.values()), strict=True)
    lines = [",".join(columns), *(",".join(map(repr, row)) for row in rows)]
    path.write_text(comments + "\n".join(lines) + "\n", encoding="utf-8")
    return path


def test_a_csv_file_is_read_back(tmp_path: Path):
    platform = 4.0 * np.cos(TIME)
    columns = {"time_us": TIME, "note": np.zeros(300), "deflection_nm": HEIGHT, "platform_nm": platform}
    trace = read_trace(saved(tmp_path, columns))
    np.testing.assert_array_equal([trace.deflection_nm, trace.platform], [HEIGHT, platform])
    # rounding of the printed times
    assert (trace.start_us, trace.step_us) == (TIME[0], pytest.approx(0.1, rel=1e-12))
    assert (trace.settings.quality_factor, trace.settings.quality_factor_error) == (40.0, 2.0)
    assert (trace.platform_in_nm, trace.remarks) == (True, ("Tuesday's tip",))
    assert trace.drive_periods == pytest.approx(300 * 0.1 * 0.1818, rel=1e-12)
    printed = np.round(np.arange(300) * 0.0937, 2)
    # 0.005 us over 299 steps
    rounded = read_trace(saved(tmp_path, {"time_us": printed, "deflection_nm": HEIGHT}))
    assert rounded.step_us == pytest.approx(0.0937, rel=4e-4)


def test_options_stand_in_front_of_comments(tmp_path: Path):
    path = saved(tmp_path, {"position_nm": HEIGHT}, COMMENTS + "# sampling_rate_mhz = 10\n")
    assert read_trace(path).step_us == 0.1
    trace = read_trace(path, sampling_rate_mhz=20.0, drive_frequency_khz=150.0, quality_factor=30.0, rest_nm=2.0)
    assert (trace.start_us, trace.step_us, trace.drive_frequency_khz) == (0.0, 0.05, 150.0)
    # an error of another quality factor says nothing of this one
    assert (trace.settings.quality_factor, trace.settings.quality_factor_error) == (30.0, None)
    np.testing.assert_array_equal(trace.height_nm, HEIGHT - 2.0)


@pytest.mark.parametrize("group", [None, "scan/forward"])
def test_an_hdf5_file_says_the_same_as_a_csv_file(tmp_path: Path, group: str | None):
    h5py = pytest.importorskip("h5py")
    comments = "# drive_frequency_khz = 181.8\n# offset_nm = -1\n"
    wanted = read_trace(saved(tmp_path, {"time_us": TIME, "deflection_nm": HEIGHT}, comments))
    path = tmp_path / "trace.bin"
    with h5py.File(path, "w") as file:
        place = file if group is None else file.create_group(group)
        file.attrs["drive_frequency_khz"] = 181.8
        file.attrs["operator"] = "E. Rutherford"
        place["time_us"] = TIME
        place["deflection_nm"] = HEIGHT.astype(np.float32)
        place["deflection_nm"].attrs["offset_nm"] = -1
        place["image"] = np.zeros((3, 3))
    trace = read_trace(path, group=group)
    assert trace.settings == wanted.settings
    assert (trace.start_us, trace.step_us) == (wanted.start_us, wanted.step_us)
    np.testing.assert_array_equal(trace.deflection_nm, HEIGHT.astype(np.float32).astype(np.float64))


KNOWN: dict[str, Any] = {"drive_frequency_khz": 180.0, "sampling_rate_mhz": 10.0}


def test_faults_of_hdf5_files(tmp_path: Path):
    h5py = pytest.importorskip("h5py")
    path, nested, cut = (tmp_path / name for name in ("trace.h5", "nested.h5", "cut.h5"))
    with h5py.File(path, "w") as file:
        file["scan/deflection_nm"] = np.zeros((2, 3))
    with h5py.File(nested, "w") as file:
        for name in ("scan/forward", "scan/backward"):
            file[f"{name}/deflection_nm"] = np.zeros(300)
    cut.write_bytes(path.read_bytes()[:100])
    for place, group, said in (
        (path, "scam", "there is no group 'scam'; those with deflection_nm are scan"),
        (path, "scan", "column deflection_nm: the data set has shape (2, 3)"),
        (nested, None, '`group="scan/backward"` (there are scan/backward, scan/forward)'),
        (cut, None, "cannot be read as HDF5"),
    ):
        with pytest.raises(TableError, match=re.escape(said)):
            read_trace(place, group=group, **KNOWN)


def announced(count: int, **how: Any) -> Any:
    """Return what writes a data set of so many numbers that are not there."""
    return lambda file, _: file.create_dataset("deflection_nm", shape=(count,), dtype="f8", **how)


def linked(target: str, file: str = "") -> Any:
    """Return what writes a link in place of the data set."""
    return lambda place, h5py: place.__setitem__(
        "deflection_nm", h5py.ExternalLink(file, target) if file else h5py.SoftLink(target)
    )


def elsewhere(file, _) -> None:
    place = str(Path(file.filename).parent / "letter")
    file.create_dataset("deflection_nm", shape=(300,), dtype="f8", external=[(place, 0, 2400)])


def virtual(file, h5py) -> None:
    layout = h5py.VirtualLayout(shape=(300,), dtype="f8")
    layout[:] = h5py.VirtualSource("mine.h5", "deflection_nm", shape=(300,))
    file.create_virtual_dataset("deflection_nm", layout)


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (announced(10**8, chunks=(1 << 20,), compression="gzip"), "100,000,000 numbers are announced in a file of"),
        (announced(10, maxshape=(None,), chunks=(1 << 28,)), "268,435,456 numbers are announced in a file of"),
        (linked("/deflection_nm"), "column 'deflection_nm': is a link to another place, which is not followed"),
        (linked("/deflection_nm", "mine.h5"), "column 'deflection_nm': is a link to another file, which is not"),
        (elsewhere, "its numbers are in other files, which are not read"),
        (virtual, "its numbers are in other files, which are not read"),
    ],
)
def test_an_hdf5_file_says_no_more_than_it_holds(tmp_path: Path, make, said: str):
    h5py = pytest.importorskip("h5py")
    (tmp_path / "letter").write_bytes(np.arange(300.0).tobytes())
    with h5py.File(tmp_path / "mine.h5", "w") as file:
        file["deflection_nm"] = np.zeros(300)
    path = tmp_path / "trace.h5"
    with h5py.File(path, "w") as file:
        make(file, h5py)
    with pytest.raises(TableError, match=re.escape(said)):
        read_trace(path, **KNOWN)


def test_links_of_groups_are_not_followed_either_and_groups_may_hold_each_other(tmp_path: Path):
    h5py = pytest.importorskip("h5py")
    path = tmp_path / "trace.h5"
    with h5py.File(path, "w") as file:
        file["scan/deflection_nm"] = np.zeros(300)
        file["scan/back"] = file["/"]
        file["alias"] = h5py.SoftLink("/scan")
    with pytest.raises(TableError, match="column 'alias': is a link to another place"):
        read_trace(path, group="alias", **KNOWN)
    assert read_trace(path, group="scan/back/scan", **KNOWN).samples == 300


def test_damaged_hdf5_files_end_in_one_line(tmp_path: Path):
    h5py = pytest.importorskip("h5py")
    path, damaged = tmp_path / "trace.h5", tmp_path / "damaged.h5"
    with h5py.File(path, "w") as file:
        file.attrs["drive_frequency_khz"] = 181.8
        file["time_us"] = TIME[::5]
        file.create_dataset("deflection_nm", data=HEIGHT[::5], compression="gzip")
    chance = np.random.default_rng(5)
    for _ in range(300):
        data = bytearray(path.read_bytes())
        for place in chance.integers(8, len(data), chance.integers(1, 4)):
            data[place] = chance.integers(256)
        damaged.write_bytes(data)
        with contextlib.suppress(TableError):
            read_trace(damaged)


def test_hdf5_without_its_package_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / "trace.h5").write_bytes(b"\x89HDF\r\n\x1a\n" + bytes(100))
    monkeypatch.setitem(sys.modules, "h5py", None)
    with pytest.raises(TableError, match="needs the package h5py; install it with: pip install h5py"):
        read_trace(tmp_path / "trace.h5")


def test_a_trace_in_memory_is_checked_too():
    height, settings = np.array([0.0, 1.0, np.nan]), TraceSettings(drive_frequency_khz=DRIVE)
    with pytest.raises(TableError, match=r"sample 3, column deflection_nm: must be finite"):
        Trace(deflection_nm=height, start_us=0.0, step_us=0.1, settings=settings)
