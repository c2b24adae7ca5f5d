"""`afm-jax sweep SWEEP.toml --out DIR`: a grid of scenes, in chunks, on all cores; goes on where it was."""

import math
from collections import Counter
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Any

import click
import xarray
from click import IntRange

from afm_jax.cli.command import Output, picture_of
from afm_jax.cli.scenes import load_named
from afm_jax.cli.session import Session
from afm_jax.compilation_cache import available_cores
from afm_jax.scenefile.scenefile import read_toml, scene_tables
from afm_jax.studies.sweep import EXTRAPOLATED, MESSAGE, STORE, SweepPlan, plan_of, run_plan
from afm_jax.words import counted

_KEYS = ("scene", "record", "axes", "accuracy", "chunk")
_MOST_DRAWN = 2
"""Axes of a sweep that a picture can show."""
_MOST_MESSAGES = 3


def sweep(
    session: Session,
    sweep: Annotated[Path, "SWEEP.toml"],
    *,
    workers: Annotated[int | None, IntRange(1, 1024)] = None,
    scheduler: Annotated[str | None, "tcp://..."] = None,
    plot: bool = False,
    law: Path | None = None,
) -> Output:
    r"""Compute many scenes over the grid of SWEEP.toml into DIR/sweep.zarr; after a fault, the same call continues.

    \b
    scene = "scene.toml"                  # or a preset
    accuracy = 1e-6                       # of contacts; may be left out
    [record]
    what = "orbits"                       # simulation, collide, lyapunov
    orders = [1, 2]
    [[axes]]
    parameter = "platform.reduced_frequency"
    linear = [0.9, 1.1, 1000]             # or log, or list = [0.9, 1.0, 1.1]
    [[axes]]
    random."interaction.r" = [0.9, 0.99]
    random."interaction.epsilon".log = [1, 100]
    count = 500
    seed = 1

    `xarray.open_zarr` opens the results. Other workers give the same numbers except for last digits. Finished chunks
    are kept, whatever happens. Only one sweep at a time may write into a folder.

    Args:
        session: for progress; its folder holds the results.
        sweep: the file.
        workers: number of processes that share this machine's cores, by Dask; 1: this process alone.
        scheduler: a Dask scheduler whose workers do the work.
        plot: draw a sweep of one or two axes, sweep.png.
        law: as of other commands.
    """
    assert session.out is not None  # the command's row says so  # noqa: S101
    try:
        plan = _plan(read_toml(str(sweep)), sweep.parent, law)
    except ValueError as error:
        said = str(error)
        raise ValueError(said if said.startswith(str(sweep)) else f"{sweep}: {said}") from error
    if plot and len(plan.axes) > _MOST_DRAWN:
        raise click.UsageError(f"--plot draws sweeps of one or two axes, but this has {len(plan.axes)}: slice it first")
    if workers is None:
        # batches take every core themselves
        alone = plan.recorder.alone and scheduler is None and find_spec("distributed") is not None
        workers = min(available_cores(), len(plan.regions())) if alone else 1
    with session.working("computing (the first chunk compiles)", "points") as report:
        kept, computed = run_plan(plan, session.out, workers=workers, scheduler=scheduler, report=report)
    store, points, chunks = session.out / STORE, math.prod(plan.shape), kept + computed
    messages, beyond = Counter[str](), None
    found = xarray.open_zarr(str(store))
    if MESSAGE in found:
        messages.update(text for text in found[MESSAGE].values.ravel().tolist() if text)
    if EXTRAPOLATED in found:
        outside = int(found[EXTRAPOLATED].values.reshape(points, -1).any(axis=1).sum())
        where = f"at {outside} of {points} points impacts come outside the speeds that the law is known for"
        beyond = f"Extrapolated: {where}." if outside else None
    grid = f"{' x '.join(map(str, plan.shape))} points in {counted(chunks, 'chunk')}"
    lines = [f"{grid}. Computed: {computed}; done before and kept: {kept}."]
    if messages:
        lines.append(f"{messages.total()} points have no result to be trusted (`message` says why), most of them:")
        lines += [f"  {count}: {text}" for text, count in messages.most_common(_MOST_MESSAGES)]
    payload = {
        "store": store,
        "points": points,
        "shape": plan.shape,
        "chunks": chunks,
        "chunks_kept": kept,
        "chunks_computed": computed,
        "without_result": messages.total(),
        "messages": dict(messages),
        "extrapolated": beyond,
    }
    return Output(
        payload=payload,
        text=[*lines, f"Open them with xarray.open_zarr({str(store)!r}).", beyond],
        files={"sweep.png": picture_of("sweeps:sweep_figure", found, plan.recorder.shown)} if plot else {},
    )


def _plan(given: dict[str, Any], folder: Path, law: Path | None) -> SweepPlan:
    """Return the plan of the tables of a sweep file; what the file names is read, relative to its folder.

    Raises:
        ValueError: if there are other keys, or one is missing.
    """
    for key in given:
        if key not in _KEYS:
            raise ValueError(f"unknown key {key}; a sweep has {', '.join(_KEYS)}")
    scene, record = given.get("scene"), given.get("record")
    if not isinstance(scene, str) or not isinstance(record, dict):
        missing = 'scene = "scene.toml"' if not isinstance(scene, str) else '[record] with what = "orbits"'
        raise ValueError(f"add {missing} (afm-jax sweep --help shows a whole file)")  # noqa: TRY004 (a wrong file)
    beside = folder / scene
    named = load_named(str(beside) if beside.exists() else scene, law)
    # a start is of use for simulations alone
    begin = named.start._asdict() if named.start and record.get("what") == "simulation" else None
    return plan_of(given | {"scene": scene_tables(named.scene), "start": begin})
