"""`afm-jax sweep SWEEP.toml --out DIR`: a grid of scenes or of fits, in chunks, on all cores; goes on where it was."""

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import click
import xarray

from afm_jax.cli.command import Output, later, picture_of
from afm_jax.cli.fitted_law import with_fitted_law
from afm_jax.cli.session import Session
from afm_jax.cli.values import scene_and_start
from afm_jax.scenefile.scenefile import read_toml, scene_of_tables, scene_tables
from afm_jax.sweeps.plan import SweepPlan, plan_of
from afm_jax.sweeps.scenes import SCENE_BUILDER
from afm_jax.sweeps.store import STORE
from afm_jax.sweeps.sweep import SweepRun, estimate, processes_for, run_plan, swept

table_input = later("fitting.bulk:table_input")

_KEYS = ("scene", "tables", "axes", "record", "accuracy", "chunk")
_WRITTEN = (("axes", list, "[[axes]]"), ("record", dict, "[record]"))
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
) -> Output:
    """Run a sweep, or estimate what it would take."""
    given = _read(sweep)
    try:
        plan = plan_of(_input(given, sweep, law))
    except (ValueError, TypeError) as error:
        raise ValueError(f"{sweep}: {error}") from error
    if plot and len(plan.axes) > _MOST_DRAWN:
        raise click.UsageError(f"--plot draws sweeps of one or two axes, but this has {len(plan.axes)}: slice it first")
    if dry_run:
        with session.working("measuring a chunk"):
            result = estimate(plan)
        return Output(payload=result.to_dict(), text=result.printed())
    assert session.out is not None  # asked before  # noqa: S101
    result = swept(plan, run_sweep(session, plan, workers=workers, scheduler=scheduler), session.out / STORE)
    files = {"sweep.png": partial(_draw, plan, result.store)} if plot else {}
    return Output(payload=result.to_dict(), text=result.printed(), files=files)


def run_sweep(session: Session, plan: SweepPlan, *, workers: int | None, scheduler: str | None) -> SweepRun:
    """Run a plan into the `--out` folder, with its progress on standard error."""
    assert session.out is not None  # asked before  # noqa: S101
    number = processes_for(plan) if workers is None and scheduler is None else workers or 1
    with session.working("computing (the first chunk compiles)", "points") as tell:
        return run_plan(
            plan,
            session.out,
            workers=number,
            scheduler=scheduler,
            report=lambda done, total, _: tell(done, total),
        )


def _draw(plan: SweepPlan, store: Path, target: Path) -> None:
    with xarray.open_zarr(str(store)) as found:
        picture_of("sweeps:sweep_figure", found, [variable.name for variable in plan.recorder.variables[:2]])(target)


def _read(path: Path) -> dict[str, Any]:
    """Return the tables of a sweep file.

    Raises:
        ValueError: if it cannot be read, or has other keys.
    """
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
        if common.pop("accuracy") is not None:
            raise ValueError("a fit is as accurate as its table: leave `accuracy` out")
        return table_input(_tables(given["tables"], path.parent), given.get("record", {}), **common)
    if isinstance(given["scene"], dict):
        scene, start = scene_of_tables(given["scene"], "scene"), None
    else:
        name = str(given["scene"])
        beside = path.parent / name
        scene, start = scene_and_start(str(beside) if beside.exists() else name)
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
