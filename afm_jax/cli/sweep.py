"""`afm-jax sweep SWEEP.toml --out DIR`: a grid of scenes or of fits, in chunks, on all cores; goes on where it was."""

import os
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from afm_jax.cli.session import Session
from afm_jax.cli.values import scene_and_start
from afm_jax.compilation_cache import available_cores

if TYPE_CHECKING:
    from afm_jax.sweeps.plan import SweepPlan
    from afm_jax.sweeps.sweep import Estimate, SweepRun

_KEYS = ("scene", "tables", "axes", "record", "accuracy", "chunk")
_WRITTEN = (("axes", list, "[[axes]]"), ("record", dict, "[record]"))
_MOST_MESSAGES = 3
_MOST_DRAWN = 2
"""Axes of a sweep that a picture can show."""


def sweep(
    session: Session,
    *,
    sweep: Path,
    workers: int | None,
    scheduler: str | None,
    dry_run: bool,
    plot: bool,
    law: Path | None,
) -> None:
    """Run a sweep, or estimate what it would take."""
    if workers is not None and scheduler is not None:
        raise click.UsageError("--scheduler has workers of its own: leave --workers out")
    if session.out is None and not dry_run:
        raise click.UsageError("--out is missing: name a folder for the results, or ask for a --dry-run")
    if dry_run and plot:
        raise click.UsageError("--dry-run computes nothing to --plot: leave one of them out")
    # said before the computation, not after it
    import xarray as _  # noqa: F401, PLC0415
    import zarr  # noqa: F401, PLC0415

    given = _read(sweep)
    _use_all_cores()
    session.start_computing()
    from afm_jax.sweeps.plan import plan_of  # noqa: PLC0415

    try:
        plan = plan_of(_input(given, sweep, law))
    except (ValueError, TypeError) as error:
        raise ValueError(f"{sweep}: {error}") from error
    if plot and len(plan.axes) > _MOST_DRAWN:
        raise click.UsageError(f"--plot draws sweeps of one or two axes, but this has {len(plan.axes)}: slice it first")
    if dry_run:
        _tell_estimate(session, plan)
        return
    _tell(session, plan, run_sweep(session, plan, workers=workers, scheduler=scheduler))
    if plot:
        _draw(session, plan)


def run_sweep(session: Session, plan: "SweepPlan", *, workers: int | None, scheduler: str | None) -> "SweepRun":
    """Run a plan into the `--out` folder, with its progress on standard error."""
    from afm_jax.sweeps.sweep import run_plan  # noqa: PLC0415

    assert session.out is not None  # asked before  # noqa: S101
    number = _processes(plan) if workers is None and scheduler is None else workers or 1
    with session.working("computing (the first chunk compiles)", "points") as tell:
        return run_plan(
            plan,
            session.out,
            workers=number,
            scheduler=scheduler,
            report=lambda done, total, _: tell(done, total),
        )


def _tell(session: Session, plan: "SweepPlan", done: "SweepRun") -> None:
    from afm_jax.sweeps.store import STORE  # noqa: PLC0415

    assert session.out is not None  # asked before  # noqa: S101
    messages = _messages(plan, session.out / STORE)
    beyond = _extrapolated(plan, session.out / STORE)
    payload = {
        "store": session.out / STORE,
        "points": plan.points,
        "shape": plan.shape,
        "chunks": done.chunks,
        "chunks_kept": len(done.kept.done),
        "chunks_damaged": len(done.kept.damaged),
        "chunks_computed": done.computed,
        "seconds": done.seconds,
        "without_result": sum(messages.values()),
        "messages": dict(messages.most_common(_MOST_MESSAGES)),
        "extrapolated": beyond,
        "variables": {variable.name: variable.attributes() for variable in plan.recorder.variables},
    }
    session.emit(payload, *_words(plan, done, messages, session.out / STORE), beyond)


def _messages(plan: "SweepPlan", store: Path) -> Counter[str]:
    """Return why points have no result to be trusted, and how many each time."""
    import xarray  # noqa: PLC0415

    from afm_jax.sweeps.plan import MESSAGE  # noqa: PLC0415

    if MESSAGE not in plan.recorder.variables:
        return Counter()
    with xarray.open_zarr(str(store)) as found:
        return Counter(text for text in found[MESSAGE.name].values.ravel().tolist() if text)


def _extrapolated(plan: "SweepPlan", store: Path) -> str | None:
    """Return a sentence on points whose impacts come at other speeds than their law is known for; None without any."""
    import xarray  # noqa: PLC0415

    from afm_jax.sweeps.scenes import EXTRAPOLATED  # noqa: PLC0415

    (meaning,) = [one.meaning for one in plan.recorder.variables if one.name == EXTRAPOLATED] or [None]
    if meaning is None:
        return None
    with xarray.open_zarr(str(store)) as found:
        outside = found[EXTRAPOLATED].values.reshape(plan.points, -1).any(axis=1)
    return f"Extrapolated: at {int(outside.sum())} of {plan.points} points {meaning}." if outside.any() else None


def _words(plan: "SweepPlan", done: "SweepRun", messages: Counter[str], store: Path) -> list[str]:
    grid = " x ".join(map(str, plan.shape))
    points, chunks = ("" if number == 1 else "s" for number in (plan.points, done.chunks))
    took = f"Computed in {_duration(done.seconds)}: {done.computed}."
    lines = [f"{grid} point{points} in {done.chunks} chunk{chunks}. {took}"]
    if done.kept.done:
        lines.append(f"Done before and kept: {len(done.kept.done)}.")
    if done.kept.damaged:
        lines.append(f"With other bytes than they were written with, computed again: {len(done.kept.damaged)}.")
    if messages:
        lines.append(
            f"{sum(messages.values())} points have no result to be trusted (`message` says why), most of them:"
        )
        lines += [f"  {count}: {text}" for text, count in messages.most_common(_MOST_MESSAGES)]
    return [*lines, f"Open them with xarray.open_zarr({str(store)!r})."]


def _read(path: Path) -> dict[str, Any]:
    """Return the tables of a sweep file.

    Raises:
        ValueError: if it cannot be read, or has other keys.
    """
    from afm_jax.scenefile.scenefile import read_toml  # noqa: PLC0415

    given = read_toml(str(path))
    unknown = sorted(set(given) - set(_KEYS))
    if unknown:
        raise ValueError(f"{path}: unknown key {unknown[0]}; a sweep has {', '.join(_KEYS)}")
    if ("scene" in given) == ("tables" in given):
        raise ValueError(f'{path}: give scene = "scene.toml", or tables = ["a.csv"] to be fitted, one of the two')
    wrong = [word for key, kind, word in _WRITTEN if not isinstance(given.get(key, kind()), kind)]
    if wrong:
        raise ValueError(f"{path}: must be tables, written as {' and '.join(wrong)}")
    if "scene" in given and "record" not in given:
        raise ValueError(f'{path}: [record] is missing; add it with what = "orbits" (or simulation, collide, lyapunov)')
    return given


def _input(given: Mapping[str, Any], path: Path, law: Path | None) -> dict[str, Any]:
    """Return the input of a plan: what the file names is read, relative to its folder."""
    common = {"axes": given.get("axes", []), "accuracy": given.get("accuracy"), "chunk": given.get("chunk")}
    if "tables" in given:
        if law is not None:
            raise ValueError("--law is of a sweep over a scene: fits of tables find their law")
        from fitting.bulk import table_input  # noqa: PLC0415

        if common.pop("accuracy") is not None:
            raise ValueError("a fit is as accurate as its table: leave `accuracy` out")
        return table_input(_tables(given["tables"], path.parent), given.get("record", {}), **common)
    from afm_jax.scenefile.scenefile import scene_of_tables, scene_tables  # noqa: PLC0415
    from afm_jax.sweeps.scenes import SCENE_BUILDER  # noqa: PLC0415

    if isinstance(given["scene"], dict):
        scene, start = scene_of_tables(given["scene"], "scene"), None
    else:
        name = str(given["scene"])
        beside = path.parent / name
        scene, start = scene_and_start(str(beside) if beside.exists() else name)
    from afm_jax.cli.fitted_law import with_fitted_law  # noqa: PLC0415

    scene, _ = with_fitted_law(scene, law)
    # a start is of use for simulations alone
    told = start._asdict() if start is not None and given["record"].get("what") == "simulation" else None
    return {
        "builder": SCENE_BUILDER,
        "scene": scene_tables(scene),
        "start": told,
        "record": given["record"],
        **common,
    }


def _tables(given: Any, folder: Path) -> list[Path]:
    if not isinstance(given, list) or not given or not all(isinstance(name, str) for name in given):
        raise ValueError('`tables` must be a list of files, as in ["a.csv", "b.csv"] or ["measured/*.csv"]')
    paths: list[Path] = []
    for name in given:
        found = sorted(folder.glob(name)) if "*" in name else [folder / name]
        if not found:
            raise ValueError(f"`tables`: no file is called {name}")
        paths += found
    return paths


def _use_all_cores() -> None:
    """Let JAX have a device for every core, before it starts, unless the user has said how many there are."""
    flags = os.environ.get("XLA_FLAGS", "")
    if "host_platform_device_count" not in flags:
        os.environ["XLA_FLAGS"] = f"{flags} --xla_force_host_platform_device_count={available_cores()}".strip()


def _processes(plan: "SweepPlan") -> int:
    """Return how many processes use this machine best: one for batches, which take every device themselves."""
    from importlib.util import find_spec  # noqa: PLC0415

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


def _tell_estimate(session: Session, plan: "SweepPlan") -> None:
    from afm_jax.sweeps.sweep import estimate  # noqa: PLC0415

    with session.working("measuring a chunk"):
        found: Estimate = estimate(plan)
    number = _processes(plan)
    lines = [
        f"{found.points:,} points in {found.chunks:,} chunks of {found.chunk_points:,}.",
        (
            f"Time: {_duration(found.seconds / number)} with {number} process{'es' if number > 1 else ''} here, "
            f"{1e6 * found.seconds_a_point:.3g} us a point as measured on {found.sampled_points:,}."
        ),
        f"Disk: {_size(found.disk_bytes)}, compressed as the sample was.",
        f"Memory: {found.memory_bytes / 2**20:,.0f} MiB a process, whatever the number of points.",
    ]
    session.emit(found._asdict() | {"processes": number}, *lines)


def _draw(session: Session, plan: "SweepPlan") -> None:
    import xarray  # noqa: PLC0415

    from afm_jax.plots.picture_style import save  # noqa: PLC0415
    from afm_jax.plots.sweeps import sweep_figure  # noqa: PLC0415
    from afm_jax.sweeps.store import STORE  # noqa: PLC0415

    assert session.out is not None  # asked before  # noqa: S101
    target = session.out / "sweep.png"
    with xarray.open_zarr(str(session.out / STORE)) as found:
        names = [variable.name for variable in plan.recorder.variables[:2]]
        save(sweep_figure(found, names), target)
    session.note(f"wrote {target}")
