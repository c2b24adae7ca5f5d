"""`sweep`: many scenes, or many fits, in one call that goes on where an earlier one was broken off."""

import contextlib
import errno
import itertools
import json
import math
import os
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from functools import lru_cache
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from afm_jax.apparatus.scene import SceneLike, as_scene
from afm_jax.checks import check_count, checked, require_float64
from afm_jax.compilation_cache import available_cores, silence_xla
from afm_jax.results import Result
from afm_jax.scenefile.scenefile import Start, scene_tables
from afm_jax.sweeps.plan import MESSAGE, Columns, SweepPlan, plan_of, plan_of_worker
from afm_jax.sweeps.scenes import EXTRAPOLATED, SCENE_BUILDER
from afm_jax.sweeps.store import STORE, Kept, SweepStore, locked, open_store
from afm_jax.words import counted

if TYPE_CHECKING:
    import xarray
    from distributed import Client

_IN_FLIGHT = 2
"""Chunks handed out for every worker: it has the next one when it has done one."""
_SECONDS_BETWEEN_LOOKS = 1.0
"""At how many workers there are."""
_RETRIES = 3
_SECONDS_TO_ANSWER, _SECONDS_TO_START = 30, 600
"""Of a scheduler, and of its first worker, which may wait in a queue."""
_TRIALS_S = 2.0
"""How long chunks are computed to plan by."""

Progress = Callable[[int, int, float], object]
"""Told how many of how many points are done, and how many a second since the start."""


class SweepRun(NamedTuple):
    """What a run over a sweep did."""

    chunks: int
    kept: Kept
    """What was there before."""
    computed: int
    """Chunks that were computed now."""
    seconds: float


class Swept(NamedTuple):
    """What `afm-jax sweep` tells of a sweep that is done."""

    plan: SweepPlan
    run: SweepRun
    store: Path
    messages: Counter[str]
    """Why points have no result to be trusted, and how many each time."""
    extrapolated: str | None
    """A sentence on points whose law is asked at other speeds than it is known for; None without any."""

    text = Result.text

    def to_dict(self) -> dict[str, Any]:
        """Return the JSON object."""
        return {
            "store": self.store,
            "points": self.plan.points,
            "shape": self.plan.shape,
            "chunks": self.run.chunks,
            "chunks_kept": len(self.run.kept.done),
            "chunks_damaged": len(self.run.kept.damaged),
            "chunks_computed": self.run.computed,
            "seconds": self.run.seconds,
            "without_result": sum(self.messages.values()),
            "messages": dict(self.messages.most_common(_MOST_MESSAGES)),
            "extrapolated": self.extrapolated,
            "variables": {variable.name: variable.attributes() for variable in self.plan.recorder.variables},
        }

    def printed(self) -> list[str | None]:
        """Return what was computed and kept, why points have no result, and how the results open."""
        run, points = self.run, "point" if self.plan.points == 1 else "points"
        grid = " x ".join(map(str, self.plan.shape))
        took = f"Computed in {_duration(run.seconds)}: {run.computed}."
        lines: list[str | None] = [f"{grid} {points} in {counted(run.chunks, 'chunk')}. {took}"]
        if run.kept.done:
            lines.append(f"Done before and kept: {len(run.kept.done)}.")
        if run.kept.damaged:
            lines.append(f"With other bytes than they were written with, computed again: {len(run.kept.damaged)}.")
        if self.messages:
            many = sum(self.messages.values())
            lines.append(f"{many} points have no result to be trusted (`message` says why), most of them:")
            lines += [f"  {count}: {text}" for text, count in self.messages.most_common(_MOST_MESSAGES)]
        return [*lines, f"Open them with xarray.open_zarr({str(self.store)!r}).", self.extrapolated]


_MOST_MESSAGES = 3


def swept(plan: SweepPlan, run: SweepRun, store: Path) -> Swept:
    """Return what is told of a sweep whose results are in a store."""
    import xarray  # noqa: PLC0415 (an extra package)

    told = {variable.name: variable.meaning for variable in plan.recorder.variables}
    messages, beyond = Counter[str](), None
    with xarray.open_zarr(str(store)) as found:
        if MESSAGE.name in told:
            messages.update(text for text in found[MESSAGE.name].values.ravel().tolist() if text)
        if EXTRAPOLATED in told:
            outside = int(found[EXTRAPOLATED].values.reshape(plan.points, -1).any(axis=1).sum())
            if outside:
                beyond = f"Extrapolated: at {outside} of {plan.points} points {told[EXTRAPOLATED]}."
    return Swept(plan, run, store, messages, beyond)


def processes_for(plan: SweepPlan) -> int:
    """Return how many processes use this machine best: one for batches, which take every device themselves."""
    if not plan.recorder.alone or find_spec("distributed") is None:
        return 1
    return min(available_cores(), plan.chunks)


def _duration(seconds: float) -> str:
    """Return a duration in words.

    >>> _duration(75.0), _duration(1e5)
    ('1.2 min', '27.8 h')
    """
    if seconds < 60.0:
        return f"{seconds:.1f} s"
    if seconds < 3600.0:
        return f"{seconds / 60.0:.1f} min"
    return f"{seconds / 3600.0:.1f} h" if seconds < 200.0 * 3600.0 else f"{seconds / 86400.0:.0f} days"


def _size(size_bytes: float) -> str:
    """Return a size in words.

    >>> _size(3e6), _size(45e9)
    ('2.9 MiB', '41.9 GiB')
    """
    return f"{size_bytes / 2**20:.1f} MiB" if size_bytes < 2**30 else f"{size_bytes / 2**30:,.1f} GiB"


@checked
def sweep(  # noqa: PLR0913
    scene: SceneLike,
    axes: Sequence[Mapping[str, Any]],
    record: str | Mapping[str, Any],
    *,
    out: str | os.PathLike[str] | None = None,
    accuracy: float | None = None,
    start: Start | None = None,
    chunk: int | None = None,
    workers: int = 1,
    scheduler: str | None = None,
    report: Progress | None = None,
) -> "xarray.Dataset":
    """Return what is recorded of a scene over a grid of its parameters.

    Args:
        scene: one scene.
        axes: of the grid, tables as in a sweep file: {"parameter": "interaction.r", "linear": [0.5, 0.9, 100]}, "log"
            likewise, "list" with values; or {"random": {"interaction.r": [0.5, 0.9]}, "count": 100, "seed": 1}, and
            "latin_hypercube" likewise. Parameters are paths of the scene file.
        record: "orbits", "collide", "lyapunov" or "simulation", or a table with that as `what` and settings.
        out: folder of the results: chunks that are done there are kept; None: nothing is kept on the disk.
        accuracy: of resolved contacts.
        start: of simulations; None: `default_start` of each.
        chunk: points that are computed, kept and handed out together; None: as suits what is recorded.
        workers: processes; above 1 a local Dask cluster is started, which needs the extra `sweep`, and a script that
            calls this below `if __name__ == "__main__":`.
        scheduler: address of a Dask scheduler whose workers do the work, "tcp://...".
        report: told how far it is.

    Returns:
        The results with a coordinate for every parameter, units, and the whole input as attributes; from a folder they
        are read when they are used.

    Raises:
        ModuleNotFoundError: if xarray or Zarr, or for several workers Dask, is not installed (extra `sweep`).
        OSError: if the disk is full; what is done is kept.
        RuntimeError: if JAX is not set to 64-bit floats, or workers fail again and again.
        ValueError: if the input is impossible, or the folder holds another sweep or is being written to.
    """
    scene = as_scene(scene)
    require_float64(scene)
    check_count("workers", workers)
    settings = {"what": record} if isinstance(record, str) else dict(record)
    given = {
        "builder": SCENE_BUILDER,
        "scene": scene_tables(scene),
        "start": None if start is None else start._asdict(),
        "axes": [dict(axis) for axis in axes],
        "record": settings,
        "accuracy": accuracy,
        "chunk": chunk,
    }
    return dataset_of(plan_of(given), out, workers=workers, scheduler=scheduler, report=report)


def dataset_of(
    plan: SweepPlan,
    out: str | os.PathLike[str] | None,
    *,
    workers: int = 1,
    scheduler: str | None = None,
    report: Progress | None = None,
) -> "xarray.Dataset":
    """Return the results of a plan; arguments as of `sweep`."""
    import xarray  # noqa: PLC0415

    with contextlib.ExitStack() as stack:
        folder = Path(out if out is not None else stack.enter_context(tempfile.TemporaryDirectory()))
        run_plan(plan, folder, workers=workers, scheduler=scheduler, report=report)
        found = xarray.open_zarr(str(folder / STORE))
        return found if out is not None else found.load()


def run_plan(
    plan: SweepPlan,
    folder: Path,
    *,
    workers: int = 1,
    scheduler: str | None = None,
    report: Progress | None = None,
) -> SweepRun:
    """Compute what a folder does not hold yet of a sweep; arguments and errors as of `sweep`."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except (FileExistsError, NotADirectoryError) as error:
        raise NotADirectoryError(
            errno.ENOTDIR, "is no folder, or lies in none; choose another `out`", str(folder)
        ) from error
    begin = time.monotonic()
    kept, computed, first = None, 0, 0.0
    try:
        with locked(folder):
            store = open_store(folder, plan)
            kept = store.kept()
            missing = [chunk for chunk in range(plan.chunks) if chunk not in kept.done]
            # the last chunks of axes may be smaller, which only a guess of the time left would notice
            share = plan.points / plan.chunks
            for _ in _computed(store, missing, workers=workers, scheduler=scheduler):
                computed += 1
                passed = time.monotonic() - begin
                if computed == 1:
                    # it waited for programs to be compiled, the others do not
                    first = passed
                elif report is not None:
                    rate = (computed - 1) * share / (passed - first)
                    report(round((len(kept.done) + computed) * share), plan.points, rate)
    except OSError as error:
        if kept is None:
            raise
        count = len(kept.done) + computed
        where = f"{error.filename}: " if error.filename and Path(error.filename) != folder else ""
        what = f"{where}{error.strerror or error}: {count} of {plan.chunks} chunks are kept; mend that"
        raise OSError(error.errno, f"{what}, and give the same command again", str(folder)) from error
    return SweepRun(plan.chunks, kept, computed, time.monotonic() - begin)


def _computed(store: SweepStore, chunks: Sequence[int], *, workers: int, scheduler: str | None) -> Iterator[int]:
    """Give chunks, in any order, once they have been computed and written."""
    if workers <= 1 and scheduler is None:
        yield from _computed_here(store, chunks)
    elif chunks:
        with _client(min(workers, len(chunks)), scheduler) as client:
            for chunk, results in _handed_out(client, store.plan, chunks):
                store.write(chunk, results)
                yield chunk


def _computed_here(store: SweepStore, chunks: Sequence[int]) -> Iterator[int]:
    """Compute chunks in this process, each while the one before is written."""

    def write(chunk: int, results: Columns) -> int:
        store.write(chunk, results)
        return chunk

    with ThreadPoolExecutor(1) as aside:
        writing: list[Future[int]] = []
        for chunk in chunks:
            results = store.plan.compute(chunk)
            if writing:
                yield writing.pop().result()
            writing.append(aside.submit(write, chunk, results))
        for last in writing:
            yield last.result()


def _handed_out(client: "Client", plan: SweepPlan, chunks: Iterable[int]) -> Iterator[tuple[int, Columns]]:
    """Give chunks with their results as workers have done them; no more are under way than keep them busy."""
    from distributed import KilledWorker, as_completed  # noqa: PLC0415

    text = json.dumps(plan.given)
    waiting = iter(chunks)
    token = os.urandom(8).hex()

    def submit(chunk: int) -> Any:
        return client.submit(compute_chunk, text, chunk, key=f"sweep-{token}-{chunk}", retries=_RETRIES, pure=False)

    numbers: dict[str, int] = {}
    under_way = as_completed()
    threads, asked = 0, -math.inf

    def fill() -> None:
        nonlocal threads, asked
        # workers may come and go; to ask takes as long as to write a chunk
        if time.monotonic() - asked > _SECONDS_BETWEEN_LOOKS:
            threads, asked = _threads(client), time.monotonic()
        for chunk in itertools.islice(waiting, max(_IN_FLIGHT * threads - len(numbers), 1)):
            future = submit(chunk)
            numbers[future.key] = chunk
            under_way.add(future)

    fill()
    for future in under_way:
        try:
            results = future.result()
        except KilledWorker as error:
            raise RuntimeError(
                f"chunk {numbers[future.key]} has killed every worker that was given it (out of memory?)"
            ) from error
        yield numbers.pop(future.key), results
        fill()


def compute_chunk(text: str, chunk: int) -> Columns:
    """Return the results of a chunk, for a process that knows nothing but the input.

    Args:
        text: `SweepPlan.given` as JSON.
        chunk: its number.

    Raises:
        RuntimeError: if this process would compute otherwise than the one that asks.
    """
    return _plan_of_worker(text).compute(chunk)


_plan_of_worker = lru_cache(maxsize=4)(plan_of_worker)


def _threads(client: "Client") -> int:
    found: Any = client.ncores()
    return sum(found.values())


@contextlib.contextmanager
def _client(workers: int, scheduler: str | None) -> "Iterator[Client]":
    """Give a client of a scheduler, or of a cluster of local processes of its own."""
    from distributed import Client  # noqa: PLC0415

    if scheduler is not None:
        try:
            client = Client(scheduler, timeout=_SECONDS_TO_ANSWER, direct_to_workers=_here(scheduler))
        except (OSError, ValueError) as error:
            raise ValueError(f"{scheduler}: no Dask scheduler answers there ({error})") from error
        with client:
            try:
                client.wait_for_workers(1, timeout=_SECONDS_TO_START)
            except TimeoutError as error:
                raise ValueError(f"{scheduler}: has no workers; start some: dask worker {scheduler}") from error
            yield client
        return
    with local_cluster(workers) as cluster, Client(cluster, direct_to_workers=True) as client:
        yield client


def _here(scheduler: str) -> bool:
    """Return whether a scheduler has workers of this machine alone, from which results come without its help.

    >>> _here("tcp://127.0.0.1:8786"), _here("tcp://10.0.0.7:8786")
    (True, False)
    """
    return "://127." in scheduler or "://localhost" in scheduler


@contextlib.contextmanager
def local_cluster(workers: int, *, cores_each: int | None = None) -> "Iterator[Any]":
    """Give a Dask cluster of processes of this machine, spawned, each with one device.

    Args:
        workers: how many.
        cores_each: cores that XLA uses in each; None: its share of this machine's.
    """
    import logging  # noqa: PLC0415

    from dask import config  # noqa: PLC0415
    from distributed import LocalCluster  # noqa: PLC0415

    # workers import what their caller's program imports before they can be told anything
    silence_xla()
    flags = os.environ.get("XLA_FLAGS", "").split()
    cores = cores_each or max(available_cores() // workers, 1)
    settings: dict[str, Any] = {
        "n_workers": workers,
        "threads_per_worker": 1,
        "processes": True,
        "memory_limit": None,
        "dashboard_address": None,
        "silence_logs": logging.CRITICAL,
        "env": {
            "XLA_FLAGS": " ".join(flag for flag in flags if "host_platform_device_count" not in flag),
            # of XLA's threads: its flags do not reach them
            "NPROC": str(cores),
        },
    }
    with (
        tempfile.TemporaryDirectory() as scratch,
        config.set(
            {
                "distributed.worker.multiprocessing-method": "spawn",
                # an interrupt from the keyboard reaches all processes, but is this one's business
                "distributed.worker.preload": ["import signal; signal.signal(signal.SIGINT, signal.SIG_IGN)"],
                # nobody looks at what these find
                "distributed.worker.profile.enabled": False,
                "distributed.admin.tick.interval": "500ms",
                # what is freed is soon wanted again
                "distributed.nanny.pre-spawn-environ.MALLOC_TRIM_THRESHOLD_": 1 << 30,
                "distributed.nanny.pre-spawn-environ.MALLOC_MMAP_THRESHOLD_": 1 << 28,
            }
        ),
        _quiet_tracker(),
        LocalCluster(**settings, local_directory=scratch) as cluster,
    ):
        yield cluster


@contextlib.contextmanager
def _quiet_tracker() -> "Iterator[None]":
    """Have Python's tracker of what processes share, once it is started, clean up behind an interrupt silently."""
    option = "ignore:resource_tracker:UserWarning"
    sys.warnoptions.append(option)
    try:
        yield
    finally:
        sys.warnoptions.remove(option)


class Estimate(NamedTuple):
    """What a sweep would take, from chunks that were computed and written to be thrown away."""

    points: int
    chunks: int
    chunk_points: int
    sampled_points: int
    seconds_a_point: float
    """In this process, on all its devices."""
    seconds: float
    disk_bytes: float
    memory_bytes: int
    """Most that this process has had so far: it does not grow with the points."""
    processes: int
    """That the sweep would use here."""

    def to_dict(self) -> dict[str, Any]:
        """Return the JSON object of `afm-jax sweep --dry-run`."""
        return self._asdict()

    def printed(self) -> list[str]:
        """Return points, time, disk and memory, a line each."""
        here = f"{self.processes} process{'es' if self.processes > 1 else ''}"
        return [
            f"{self.points:,} points in {self.chunks:,} chunks of {self.chunk_points:,}.",
            (
                f"Time: {_duration(self.seconds / self.processes)} with {here} here, "
                f"{1e6 * self.seconds_a_point:.3g} us a point as measured on {self.sampled_points:,}."
            ),
            f"Disk: {_size(self.disk_bytes)}, compressed as the sample was.",
            f"Memory: {self.memory_bytes / 2**20:,.0f} MiB a process, whatever the number of points.",
        ]


def estimate(plan: SweepPlan) -> Estimate:
    """Return what a plan would take, measured on chunks from its middle on, after one for which programs compile."""
    middle = plan.chunks // 2
    sampled = int(np.prod([part.stop - part.start for part in plan.region(middle)]))
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        store = open_store(folder, plan, coordinates=False)
        empty = _bytes_in(folder)
        _seconds_of(store, [middle])
        size = _bytes_in(folder) - empty
        rounds, seconds = 1, _seconds_of(store, [middle])
        if seconds < _TRIALS_S:
            # as a sweep does it: each is written while the next is computed
            rounds = math.ceil(_TRIALS_S / seconds)
            seconds = _seconds_of(store, [(middle + more) % plan.chunks for more in range(rounds)])
        seconds /= rounds * sampled
    return Estimate(
        points=plan.points,
        chunks=plan.chunks,
        chunk_points=int(np.prod(plan.block)),
        sampled_points=rounds * sampled,
        seconds_a_point=seconds,
        seconds=seconds * plan.points,
        disk_bytes=size * plan.points / sampled + empty + sum(8 * axis.size * len(axis.columns) for axis in plan.axes),
        memory_bytes=peak_memory(),
        processes=processes_for(plan),
    )


def _seconds_of(store: SweepStore, chunks: Sequence[int]) -> float:
    begin = time.perf_counter()
    for _ in _computed_here(store, chunks):
        pass
    return time.perf_counter() - begin


def _bytes_in(folder: Path) -> int:
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())


def peak_memory() -> int:
    """Return the most memory that this process has had, in bytes; 0 where that is not known."""
    try:
        import resource  # noqa: PLC0415
    except ModuleNotFoundError:
        return 0
    import sys  # noqa: PLC0415

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else 1024 * peak
