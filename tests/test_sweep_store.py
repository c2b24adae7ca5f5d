"""What a sweep keeps, and how it goes on after faults; its points are plain sums, so that nothing is compiled."""

import errno
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import xarray

from afm_jax.studies.sweep import (
    FORMAT_VERSION,
    STORE,
    SweepPlan,
    axes_of,
    run_plan,
)
from tests.sweep_numbers import SIZES, contents, plan

X, Y = np.linspace(0.0, 6.0, SIZES[0]), np.linspace(0.0, 11.0, SIZES[1])
SUM = X[:, None] + 0.1 * Y


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a whole sweep, which tests only read."""
    folder = tmp_path_factory.mktemp("whole")
    assert run_plan(plan(), folder) == (0, 14)
    return folder


@pytest.fixture
def swept(whole: Path, tmp_path: Path) -> Path:
    """A copy of the whole sweep."""
    return shutil.copytree(whole, tmp_path / "swept")


def test_results_open_with_xarray_alone(whole: Path):
    found = xarray.open_zarr(str(whole / STORE)).load()
    np.testing.assert_array_equal(found["sum_nm"], np.where(SUM < 2.0, np.nan, SUM))
    np.testing.assert_array_equal(found["large"], SUM > 4.0)
    np.testing.assert_array_equal(found["parts"].sel(part=2.0), SUM)
    np.testing.assert_array_equal(found["x"], X)
    assert found["large"].dtype == bool
    assert found["sum_nm"].attrs == {"long_name": "sum", "units": "nm"}
    given = json.loads(found.attrs["input"])
    assert given["axes"][1] == {"parameter": "y", "linear": [0.0, 11.0, 12]}
    assert {"jax", "afm-jax", "numpy"} <= set(given["versions"])


def results(folder: Path, wanted: SweepPlan) -> xarray.Dataset:
    run_plan(wanted, folder)
    return xarray.open_zarr(str(folder / STORE)).load()


def test_results_do_not_depend_on_chunks(tmp_path: Path):
    whole = results(tmp_path / "whole", plan())
    for chunk in (5, 84):
        assert whole.drop_attrs().identical(results(tmp_path / f"{chunk}", plan(chunk=chunk)).drop_attrs())
    assert plan(chunk=30).block == (2, 12)
    assert len(plan(chunk=30).regions()) == 4


def test_what_is_not_marked_is_computed_again(whole: Path, swept: Path):
    for name in ("computed", "sum_nm"):
        (swept / STORE / name / "c" / "3" / "0").unlink()
    assert run_plan(plan(), swept) == (13, 1)
    assert contents(swept) == contents(whole)


def test_a_changed_input_is_refused_and_named(swept: Path):
    same = plan()
    for other, fault in (
        (plan(last=12.0), r"axes is .*\[0.0, 11.0, 12\].*, not .*\[0.0, 12.0, 12\]"),
        (plan(chunk=5), "chunk is 10, not 5"),
        (plan(seconds=0.001), 'record is {}, not {"seconds": 0.001}'),
    ):
        with pytest.raises(ValueError, match=f"{fault}.*: choose another folder"):
            run_plan(other, swept)
    head = swept / STORE / "zarr.json"
    older = head.read_text().replace(f'"format_version": {FORMAT_VERSION}', '"format_version": 4')
    for text, fault in ((older, "format_version is 4, not 5: ch"), ("{}", "is not a sweep of afm-jax; ch")):
        head.write_text(text)
        with pytest.raises(ValueError, match=fault):
            run_plan(same, swept)


def test_a_full_disk_keeps_what_is_done(whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    def full(own: SweepPlan, region: tuple[slice, ...]) -> dict:
        if own.regions().index(region) >= 3:
            raise OSError(errno.ENOSPC, "No space left on device", str(tmp_path / "sum_nm"))
        return compute(own, region)

    compute = SweepPlan.compute
    monkeypatch.setattr(SweepPlan, "compute", full)
    with pytest.raises(OSError, match="No space left on device: 3 of 14 chunks are kept; mend that, and give"):
        run_plan(plan(), tmp_path)
    monkeypatch.undo()
    # of ten points, two and ten
    assert xarray.open_zarr(str(tmp_path / STORE))["computed"].values.sum() == 22
    assert run_plan(plan(), tmp_path) == (3, 11)
    assert contents(tmp_path) == contents(whole)
    assert run_plan(plan(), tmp_path) == (14, 0)


def test_what_a_killed_sweep_left_unfinished_is_cleared(whole: Path, swept: Path):
    (swept / STORE / "sum_nm" / "c" / "3" / "0.abc.partial").touch()
    (swept / STORE / "computed" / "c" / "3" / "0.abcd.partial").touch()
    run_plan(plan(), swept)
    assert contents(swept) == contents(whole)


LINKED = [STORE, *(f"{STORE}/{name}" for name in ("computed", "computed/c/0/0", "sum_nm", "sum_nm/c/3/0", "x"))]
LINKED += [f"{STORE}/zarr.json", f"{STORE}/x/c/0", f".{STORE}.part", f".{STORE}.0a1b2c3d.part"]


@pytest.mark.parametrize("place", LINKED)
@pytest.mark.parametrize("begun", [True, False])
def test_a_folder_with_links_is_refused_and_nothing_outside_it_changes(
    whole: Path, tmp_path: Path, place: str, *, begun: bool
):
    out, mine = tmp_path / "out", tmp_path / "mine"
    for folder in (out, mine):
        folder.mkdir()
    for name in ("letter", "0.json", "0", "zarr.json"):
        (mine / name).write_text("mine")
    if begun:
        shutil.copytree(whole, out, dirs_exist_ok=True)
        (out / STORE / "computed" / "c" / "1" / "1").unlink()
    link = out / place
    shutil.rmtree(link) if link.is_dir() else link.unlink(missing_ok=True)
    link.parent.mkdir(parents=True, exist_ok=True)
    link.symlink_to(mine / "letter" if place.endswith(("json", "0")) else mine)
    with pytest.raises(OSError, match="is a link, which is not followed; delete it or choose another") as refused:
        run_plan(plan(), out)
    assert refused.value.filename == str(link)
    assert [path.read_text() for path in mine.iterdir()] == ["mine"] * 4


def test_axes_are_what_they_say():
    random = {"random": {"c": [0.0, 2.0], "d": {"log": [1.0, 10.0]}}, "count": 1001, "seed": 5}
    log, listed, first, second = axes_of(
        [
            {"parameter": "a", "log": [1.0, 100.0, 3]},
            {"parameter": "b", "list": [3, 1, 2]},
            random,
            {"random": {"e": [-1.0, 1.0]}, "count": 20, "seed": 5},
        ]
    )
    np.testing.assert_allclose(log.columns["a"], [1.0, 10.0, 100.0], rtol=1e-15)
    assert listed.columns["b"].tolist() == [3.0, 1.0, 2.0]
    assert (first.dimension, first.size, second.dimension, second.size) == ("sample", 1001, "sample_2", 20)
    c, d = first.columns["c"], first.columns["d"]
    np.testing.assert_array_equal(c, 2.0 * np.random.default_rng(5).random(1001))
    assert abs(np.corrcoef(c, d)[0, 1]) < 0.1
    assert abs(np.median(d) / np.sqrt(10.0) - 1.0) < 0.2
    assert (d.min() >= 1.0, d.max() <= 10.0) == (True, True)
