"""Sweeps over law scenes: time and memory as they grow, and as processes of one core each are added.

One process uses all cores by itself, so that more processes than cores, and two of all cores, gain nothing: what is
measured is what a cluster gains, whose workers bring their cores with them.
"""

import contextlib
import math
import resource
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax

from afm_jax.bench.problems import chaotic_scene
from afm_jax.scenefile.scenefile import scene_tables
from afm_jax.studies.timing import progress, run_in_own_process
from afm_jax.sweeps.plan import SweepPlan, plan_of
from afm_jax.sweeps.scenes import SCENE_BUILDER
from afm_jax.sweeps.sweep import local_cluster, peak_memory, run_plan

Row = dict[str, Any]
_TASK = "afm_jax.bench.sweeps:law_sweep"
_SHORT = 10_000
_SAMPLES = {"platform.reduced_frequency": [0.4, 4.4], "platform.amplitude_nm": [0.5, 8.0], "interaction.r": [0.5, 0.99]}


def sweep_rows(sizes: Sequence[int], *, points: int, processes: Sequence[int], cores: int) -> list[Row]:
    """Measure sweeps over random law scenes, each in a process of its own.

    Args:
        sizes: numbers of scenes, in one process on all devices.
        points: scenes of the sweeps by several processes.
        processes: numbers of them, of one core each; more than `cores` share these.
        cores: devices of the one process.

    Returns:
        Rows with what, points, processes, devices, seconds, microseconds_per_point, processor_microseconds_per_point
        and peak_memory_mib (of the process that writes).
    """
    rows = []
    for size in sizes:
        progress(f"bench: sweeps, {size} scenes")
        rows.append(run_in_own_process(_TASK, {"points": size, "processes": 1}, cores=cores))
    for number in processes:
        progress(f"bench: sweeps, {number} processes")
        # not pinned, as its workers would be, too, all of them to the same core
        rows.append(run_in_own_process(_TASK, {"points": points, "processes": number, "by_dask": True}, cores=cores))
    return rows


def law_sweep(*, points: int, processes: int, by_dask: bool = False) -> Row:
    """Run one sweep; what is compiled, and how long processes take to start, is not counted."""
    if by_dask:
        begin = _processor_seconds()
        seconds = points / _run(_plan(points), processes)
    else:
        short = _plan(_SHORT)
        _run(short, None)
        begin, wall = _processor_seconds(), time.perf_counter()
        # with the programs of the short one
        _run(replace(_plan(points), recorder=short.recorder), None)
        seconds = time.perf_counter() - wall
    return {
        "what": "processes of one core" if by_dask else "one process, all devices",
        "points": points,
        "processes": processes,
        "devices": 1 if by_dask else len(jax.devices()),
        "seconds": seconds,
        "microseconds_per_point": 1e6 * seconds / points,
        "processor_microseconds_per_point": 1e6 * (_processor_seconds() - begin) / points,
        "peak_memory_mib": peak_memory() / 2**20,
    }


def _run(plan: SweepPlan, processes: int | None) -> float:
    """Run a sweep to be thrown away, here or by a cluster of processes.

    Returns:
        Points a second after the first quarter: by then every process has its programs, and no chunk of several that
        were under way together is counted without its time.
    """
    told: list[tuple[float, int]] = []
    with contextlib.ExitStack() as stack:
        folder, scheduler = Path(stack.enter_context(tempfile.TemporaryDirectory())), None
        if processes is not None:
            scheduler = stack.enter_context(local_cluster(processes, cores_each=1)).scheduler_address
        run_plan(plan, folder, scheduler=scheduler, report=lambda done, *_: told.append((time.perf_counter(), done)))
    late = [each for each in told if 4 * each[1] >= plan.points]
    return (late[-1][1] - late[0][1]) / (late[-1][0] - late[0][0]) if len(late) > 1 else math.nan


def _plan(points: int) -> SweepPlan:
    return plan_of(
        {
            "builder": SCENE_BUILDER,
            "scene": scene_tables(chaotic_scene().scene),
            "start": None,
            "record": {"what": "orbits"},
            "axes": [{"random": _SAMPLES, "count": points, "seed": 1}],
            "accuracy": None,
            "chunk": None,
        }
    )


def _processor_seconds() -> float:
    """Return the processor time of this process and of those that it started and that have ended."""
    whose = (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)
    return sum(used.ru_utime + used.ru_stime for used in map(resource.getrusage, whose))


def aims(rows: Sequence[Mapping[str, Any]]) -> list[tuple[str, float | None, float]]:
    """Return the aims: name, reached (None: not measured), and the largest allowed."""
    one = [row for row in rows if row["what"].startswith("one process")]
    dask = {row["processes"]: row["microseconds_per_point"] for row in rows if row not in one}
    flat = memory = None
    if len(one) > 1:
        ends = min(one, key=lambda row: row["points"]), max(one, key=lambda row: row["points"])
        flat = ends[1]["microseconds_per_point"] / ends[0]["microseconds_per_point"]
        memory = ends[1]["peak_memory_mib"] / ends[0]["peak_memory_mib"]
    two = dask[2] / dask[1] if {1, 2} <= set(dask) else None
    return [
        ("time a scene of the largest sweep over the smallest's", flat, 1.2),
        ("memory of the largest sweep over the smallest's", memory, 1.2),
        ("time of two processes of one core over one's", two, 1.0 / 1.8),
    ]
