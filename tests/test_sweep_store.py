"""What a sweep keeps, and how it goes on after faults; its points are plain sums, so that nothing is compiled."""

import errno
import json
import multiprocessing
import os
import shutil
import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import xarray
from scipy.stats import qmc

from afm_jax import compilation_cache
from afm_jax.plots.sweeps import sweep_figure
from afm_jax.sweeps.axes import axes_of
from afm_jax.sweeps.plan import plan_of
from afm_jax.sweeps.store import FORMAT_VERSION, STORE, SweepStore, locked
from afm_jax.sweeps.sweep import compute_chunk, dataset_of, estimate, run_plan
from tests.sweep_numbers import SIZES, contents, plan

X, Y = np.linspace(0.0, 6.0, SIZES[0]), np.linspace(0.0, 11.0, SIZES[1])
SUM = X[:, None] + 0.1 * Y


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a whole sweep, which tests only read."""
    folder = tmp_path_factory.mktemp("whole")
    done = run_plan(plan(), folder)
    assert (done.chunks, done.computed) == (14, 14)
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
    assert found["sum_nm"].attrs == {"long_name": "x and a tenth of y", "units": "nm"}
    given = json.loads(found.attrs["input"])
    assert given["axes"][1] == {"parameter": "y", "linear": [0.0, 11.0, 12]}
    assert {"jax", "afm-jax", "numpy"} <= set(given["versions"])


def test_points_without_a_result_say_why(tmp_path: Path):
    run_plan(plan(explained=True), tmp_path)
    with warnings.catch_warnings(action="error"):
        found = xarray.open_zarr(str(tmp_path / STORE)).load()
    np.testing.assert_array_equal(found["message"], np.where(SUM < 2.0, "the sum is below 2 \u00e4", ""))


def test_results_do_not_depend_on_chunks():
    whole = dataset_of(plan(), None)
    for chunk in (5, 84):
        assert whole.drop_attrs().identical(dataset_of(plan(chunk=chunk), None).drop_attrs())
    assert plan(chunk=30).block == (2, 12)
    assert plan(chunk=30).grid == (4, 1)


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-2])


def flip(path: Path) -> None:
    data = path.read_bytes()
    path.write_bytes(data[:-1] + bytes([data[-1] ^ 1]))


@pytest.mark.parametrize(
    ("place", "damage", "computed"),
    [
        *(("sum_nm/c/3/0", damage, 1) for damage in (cut, flip, Path.unlink)),
        ("computed/c/3/0", cut, 1),
        # the axes, which are written again
        *(("*/c/*", damage, 0) for damage in (cut, Path.unlink)),
    ],
)
def test_what_is_damaged_is_made_again(
    whole: Path, swept: Path, place: str, damage: Callable[[Path], None], computed: int
):
    files = [path for path in (swept / STORE).glob(place) if path.is_file()]
    assert files
    for path in files:
        damage(path)
    again = run_plan(plan(), swept)
    assert (len(again.kept.damaged), again.computed) == (computed, computed)
    assert contents(swept) == contents(whole)


def test_a_changed_input_is_refused_and_named(swept: Path):
    same = plan()
    otherwise_cut = replace(same, recorder=replace(same.recorder, points=24))
    for other, fault in (
        (plan(last=12.0), r"axes\[2\].linear is \[0.0, 11.0, 12\], not \[0.0, 12.0, 12\]"),
        (plan(chunk=5), "chunk is absent, not 5"),
        (plan(seconds=0.001), "record.seconds is absent, not 0.001"),
        (otherwise_cut, r"shape of its chunks is \[1, 10\], not \[2, 12\]"),
    ):
        with pytest.raises(ValueError, match=f"{fault}: choose another folder"):
            run_plan(other, swept)
    head = swept / STORE / "zarr.json"
    older = head.read_text().replace(f'"format_version": {FORMAT_VERSION}', '"format_version": 3')
    for text, fault in ((older, "has format_version 3, not 4; ch"), ("{}", "is not a sweep of afm-jax; ch")):
        head.write_text(text)
        with pytest.raises(ValueError, match=fault):
            run_plan(same, swept)


def test_a_full_disk_keeps_what_is_done(whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    def full(store: SweepStore, chunk: int, results: dict) -> None:
        if chunk >= 3:
            raise OSError(errno.ENOSPC, "No space left on device", str(store.folder / "sum_nm"))
        write(store, chunk, results)

    write = SweepStore.write
    monkeypatch.setattr(SweepStore, "write", full)
    with pytest.raises(OSError, match="No space left on device: 3 of 14 chunks are kept; mend that, and give"):
        run_plan(plan(), tmp_path)
    monkeypatch.undo()
    # of ten points, two and ten
    assert xarray.open_zarr(str(tmp_path / STORE))["computed"].values.sum() == 22
    again = run_plan(plan(), tmp_path)
    assert (len(again.kept.done), again.computed) == (3, 11)
    assert contents(tmp_path) == contents(whole)
    assert run_plan(plan(), tmp_path).computed == 0


def _hold(folder: str, held, let_go) -> None:
    with locked(Path(folder)):
        held.set()
        let_go.wait(60)


@pytest.mark.slow
def test_two_sweeps_on_one_folder(tmp_path: Path):
    spawned = multiprocessing.get_context("spawn")
    held, let_go = spawned.Event(), spawned.Event()
    other = spawned.Process(target=_hold, args=(str(tmp_path), held, let_go))
    other.start()
    assert held.wait(60)
    with pytest.raises(ValueError, match=f"another sweep is writing there .process {other.pid} on .*; wait for it"):
        run_plan(plan(), tmp_path)
    # killed, it leaves its lock file behind, which does not count
    other.kill()
    other.join()
    assert (tmp_path / "lock").exists()
    assert run_plan(plan(), tmp_path).computed == 14


def test_what_a_killed_sweep_left_unfinished_is_cleared(whole: Path, swept: Path):
    (swept / STORE / "sum_nm" / "c" / "3" / "0.abc.partial").touch()
    (swept / STORE / "computed" / "c" / "3" / "0.abcd.partial").touch()
    run_plan(plan(), swept)
    assert contents(swept) == contents(whole)


LINKED = ["lock", STORE, *(f"{STORE}/{name}" for name in ("computed", "computed/c/0/0", "sum_nm", "sum_nm/c/3/0", "x"))]
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
    link.symlink_to(mine / "letter" if place.endswith(("json", "0", "lock")) else mine)
    with pytest.raises(OSError, match="is a link, which is not followed; delete it or choose another") as refused:
        run_plan(plan(), out)
    assert refused.value.filename == str(link)
    assert [path.read_text() for path in mine.iterdir()] == ["mine"] * 4


def test_other_files_by_another_name_and_pipes_are_refused(swept: Path, tmp_path: Path):
    (tmp_path / "letter").write_text("mine")
    (swept / "lock").unlink()
    (swept / "lock").hardlink_to(tmp_path / "letter")
    with pytest.raises(OSError, match=r"is another file, too .a hard link.; delete it"):
        run_plan(plan(), swept)
    assert (tmp_path / "letter").read_text() == "mine"
    (swept / "lock").unlink()
    (swept / "lock").touch()
    for name in ("lock", f"{STORE}/computed/c/2/1", f"{STORE}/sum_nm/c/3/0"):
        place = swept / name
        kept = place.rename(tmp_path / "kept")
        os.mkfifo(place)
        with pytest.raises(OSError, match="is a device or a pipe, not a file; delete it") as refused:
            run_plan(plan(), swept)
        assert refused.value.filename == str(place)
        kept.replace(place)


def test_the_plan_of_a_billion_points_is_quick():
    axes = [{"random": {"x": [0.0, 1.0]}, "count": 10**6, "seed": 1}, {"parameter": "y", "log": [1.0, 10.0, 1000]}]
    given = dict(plan().given, axes=axes, chunk=20_000)
    found = estimate(type(plan())(given, axes_of(axes), plan().recorder))
    assert (found.points, found.chunks) == (10**9, 50_000)
    assert 0.0 < found.seconds_a_point < 1e-5
    # eight bytes three times, and two bits, at most
    assert 1e8 < found.disk_bytes < 26e9


def test_axes_are_what_they_say():
    log, listed, random, cube = axes_of(
        [
            {"parameter": "a", "log": [1.0, 100.0, 3]},
            {"parameter": "b", "list": [3, 1, 2]},
            {"random": {"c": [0.0, 2.0], "d": {"log": [1.0, 10.0]}}, "count": 1001, "seed": 5},
            {"latin_hypercube": {"e": [-1.0, 1.0], "f": [0.0, 1.0]}, "count": 20, "seed": 5},
        ]
    )
    np.testing.assert_allclose(log.columns["a"](0, 3), np.geomspace(1.0, 100.0, 3), rtol=1e-15)
    assert listed.columns["b"](1, 3).tolist() == [1.0, 2.0]
    assert (random.dimension, cube.dimension) == ("sample", "sample_2")
    # any stretch is the same as in the whole, however it lies in the generator's steps
    c, d = random.columns["c"], random.columns["d"]
    whole = c(0, 1001)
    assert all(np.array_equal(c(first, first + 9), whole[first : first + 9]) for first in (0, 1, 2, 3, 4, 511))
    generator = np.random.Generator(np.random.Philox(np.random.SeedSequence(5, spawn_key=(0,))))
    np.testing.assert_array_equal(whole, 2.0 * generator.random(1001))
    assert abs(np.corrcoef(whole, d(0, 1001))[0, 1]) < 0.1
    assert abs(np.median(d(0, 1001)) / np.sqrt(10.0) - 1.0) < 0.2
    shares = qmc.LatinHypercube(2, rng=np.random.default_rng(5)).random(20)
    np.testing.assert_allclose(cube.columns["e"](0, 20), 2.0 * shares[:, 0] - 1.0, rtol=0.0, atol=1e-15)
    # one sample in each twentieth
    assert np.array_equal(np.sort(np.floor(20.0 * cube.columns["f"](0, 20))), np.arange(20))


def test_a_worker_with_other_versions_is_refused(whole: Path, monkeypatch: pytest.MonkeyPatch):
    # a worker is a process of its own; this one keeps its settings
    for name in ("open_cache", "silence_xla"):
        monkeypatch.setattr(compilation_cache, name, lambda: None)
    given = plan().given
    found = compute_chunk(json.dumps(given), 5)
    np.testing.assert_array_equal(found["sum_nm"], xarray.open_zarr(str(whole / STORE))["sum_nm"].values[2:3, 10:])
    other = given | {"versions": given["versions"] | {"jax": "0.0.1"}}
    with pytest.raises(RuntimeError, match=r"a worker would compute otherwise than the others: jax is .*, not 0.0.1"):
        compute_chunk(json.dumps(other), 5)


@pytest.mark.parametrize("log", [False, True])
def test_a_picture_shows_all_that_was_swept(log: bool):  # noqa: FBT001
    line = {"parameter": "x", "log": [1.0, 16.0, 5]} if log else {"parameter": "x", "linear": [1.0, 16.0, 5]}
    found = dataset_of(plan_of(plan().given | {"axes": [line, {"parameter": "y", "linear": [0.0, 10.0, 11]}]}), None)
    lines, plane = (sweep_figure(shown, ["sum_nm"]).axes[0] for shown in (found.isel(y=0, drop=True), found))
    assert lines.get_xscale() == plane.get_yscale() == ("log" if log else "linear")
    low, high = lines.get_xlim()
    assert (low < 1.0, high > 16.0) == (True, True)
    # the first cell reaches from as far below its value as the second from above
    assert plane.get_ylim()[0] == pytest.approx(2.0**-0.5 if log else 1.0 - 0.5 * 15.0 / 4.0)
    # labels of a logarithmic axis leave room
    assert not log or [at for at in lines.get_xticks() if low <= at <= high] == pytest.approx([1, 2, 5, 10])
