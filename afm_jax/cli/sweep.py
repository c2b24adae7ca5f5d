"""`afm-jax sweep SWEEP.toml --out DIR`: a grid of scenes, in chunks, on all cores; goes on where it was."""

from functools import partial
from pathlib import Path
from typing import Any

import click
import xarray

from afm_jax.cli.command import Output, picture_of
from afm_jax.cli.fitted_law import with_fitted_law
from afm_jax.cli.session import Session
from afm_jax.cli.values import scene_and_start
from afm_jax.scenefile.scenefile import read_toml, scene_of_tables
from afm_jax.studies.sweep import STORE, SweepPlan, input_of, plan_of, processes_for, run_plan, swept

_KEYS = {"scene": (str, dict), "record": (dict,), "axes": (list,), "accuracy": (float, int), "chunk": (int,)}
_MOST_DRAWN = 2
"""Axes of a sweep that a picture can show."""


def sweep(
    session: Session, *, sweep: Path, workers: int | None, scheduler: str | None, plot: bool, law: Path | None
) -> Output:
    """Run a sweep."""
    assert session.out is not None  # asked before  # noqa: S101
    try:
        plan = _plan(read_toml(str(sweep)), sweep.parent, law)
    except (ValueError, TypeError) as error:
        said = str(error)
        raise ValueError(said if said.startswith(str(sweep)) else f"{sweep}: {said}") from error
    if plot and len(plan.axes) > _MOST_DRAWN:
        raise click.UsageError(f"--plot draws sweeps of one or two axes, but this has {len(plan.axes)}: slice it first")
    number = processes_for(plan) if workers is None and scheduler is None else workers or 1
    with session.working("computing (the first chunk compiles)", "points") as report:
        run = run_plan(plan, session.out, workers=number, scheduler=scheduler, report=report)
    result = swept(plan, run, session.out / STORE)
    files = {"sweep.png": partial(_draw, plan, result.store)} if plot else {}
    return Output(payload=result.to_dict(), text=result.printed(), files=files)


def _draw(plan: SweepPlan, store: Path, target: Path) -> None:
    with xarray.open_zarr(str(store)) as found:
        picture_of("sweeps:sweep_figure", found, [variable.name for variable in plan.recorder.variables[:2]])(target)


def _plan(given: dict[str, Any], folder: Path, law: Path | None) -> SweepPlan:
    """Return the plan of the tables of a sweep file; what the file names is read, relative to its folder.

    Raises:
        ValueError: if there are other keys, or one is missing.
    """
    for key, value in given.items():
        if key not in _KEYS:
            raise ValueError(f"unknown key {key}; a sweep has {', '.join(_KEYS)}")
        if not isinstance(value, _KEYS[key]):
            kind = {"axes": "tables, written as [[axes]]", "record": "a table, written as [record]", "scene": "a name"}
            raise TypeError(f"`{key}` must be {kind.get(key, 'a number')}, but is {value!r}")
    if "scene" not in given or "record" not in given:
        missing = 'scene = "scene.toml"' if "scene" not in given else '[record] with what = "orbits"'
        raise ValueError(f"add {missing} (afm-jax sweep --help shows a whole file)")
    if isinstance(given["scene"], dict):
        scene, start = scene_of_tables(given["scene"], "scene"), None
    else:
        beside = folder / given["scene"]
        scene, start = scene_and_start(str(beside) if beside.exists() else given["scene"])
    scene, _ = with_fitted_law(scene, law)
    # a start is of use for simulations alone
    start = start if given["record"].get("what") == "simulation" else None
    settings = {"accuracy": given.get("accuracy"), "chunk": given.get("chunk")}
    return plan_of(input_of(scene, given.get("axes", []), given["record"], start=start, **settings))
