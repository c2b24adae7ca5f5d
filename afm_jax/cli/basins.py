"""`afm-jax basins SCENE.toml --grid 1000x1000`: which start, in drive phase and rebound speed, ends where."""

from typing import Any

import numpy as np

from afm_jax.cli.command import NamedScene, Output, picture_of
from afm_jax.cli.fitted_law import as_drawn
from afm_jax.cli.session import Session
from afm_jax.dynamics.bands import drawn_shares
from afm_jax.dynamics.basins import Basins, basins_of_attraction
from afm_jax.dynamics.verdicts import WHY_UNRESOLVED, MotionKind
from afm_jax.scenefile.scenefile import scene_tables


def basins(
    session: Session,
    scene: NamedScene,
    *,
    grid: tuple[int, int],
    speeds: tuple[float, float] | None,
    draws: int,
    picture: str,
) -> Output:
    """Return what the starts of a scene come to, with the bands of drawn laws if the law is uncertain."""
    columns, rows = grid
    band = None
    with session.working("following starts (the first run compiles for some seconds)", "starts") as report:
        result = basins_of_attraction(
            as_drawn(scene.scene), columns=columns, rows=rows, speeds_nm_per_us=speeds, report=report
        )
        if scene.unknowns is not None:
            band = drawn_shares(scene.scene, result, scene.unknowns, draws=draws)
    attractors = _attractors(result, band)
    payload = {
        "scene": scene_tables(scene.scene),
        "starts": result.attractor.size,
        "attractors": attractors,
        "boundary_dimension": result.boundary_dimension,
        "boundary_dimension_error": result.boundary_dimension_error,
    }
    return Output(
        payload=payload,
        text=_lines(result, attractors),
        impact_speeds=np.concatenate([attractor.approach_speed_nm_per_us for attractor in result.attractors]),
        tables={"basins.csv": _starts(result), "attractors.csv": _points(result)},
        files={f"basins.{picture}": picture_of("dynamics:basins_figure", result, scene.scene)},
        not_valid=_why_not_valid(result),
    )


def _attractors(result: Basins, band: np.ndarray | None) -> list[dict[str, Any]]:
    """Return what is told of each attractor."""
    attractors = []
    for number, attractor in enumerate(result.attractors):
        told = {
            "name": attractor.name,
            "impacts": attractor.impacts,
            "periods": attractor.periods,
            "share": result.share[number],
            "share_error": result.share_error[number],
            "phase_rad": attractor.phase_rad,
            "velocity_after_nm_per_us": attractor.velocity_nm_per_us,
        }
        attractors.append(told if band is None else told | {"share_interval95": band[number].tolist()})
    return attractors


def _lines(result: Basins, attractors: list[dict[str, Any]]) -> list[str]:
    speeds = result.rebound_speed_nm_per_us
    box = f"{len(result.phase_rad)} drive phases of a period x {len(speeds)} rebound speeds"
    lines = [f"Starts: {box} from {speeds[0]:.4g} to {speeds[-1]:.4g} nm/us (--speeds chooses others)"]
    for attractor in attractors:
        line = "{name}: {0:.4g} +- {1:.2g} % of the starts".format(
            100.0 * attractor["share"], 100.0 * attractor["share_error"], name=attractor["name"]
        )
        if "share_interval95" in attractor:
            low, high = attractor["share_interval95"]
            line += f"; {100.0 * low:.4g} to {100.0 * high:.4g} % in 95 % of the draws"
        lines.append(line)
    if np.isfinite(result.boundary_dimension):
        lines.append(
            f"dimension of the boundaries: {result.boundary_dimension:.3f} +- {result.boundary_dimension_error:.3f}"
        )
    return lines


def _starts(result: Basins) -> dict[str, Any]:
    """Return the columns of a table with a row a start."""
    names = np.array([attractor.name for attractor in result.attractors])
    phase, speed = np.meshgrid(result.phase_rad, result.rebound_speed_nm_per_us)
    return {
        "phase_rad": phase.ravel(),
        "rebound_speed_nm_per_us": speed.ravel(),
        "attractor": names[result.attractor.ravel()].tolist(),
    }


def _points(result: Basins) -> dict[str, list[Any]]:
    """Return the columns of a table with a row an impact of each attractor; one row of an attractor without any."""
    rows = []
    for attractor, share, error in zip(result.attractors, result.share, result.share_error, strict=True):
        impacts = zip(attractor.phase_rad.tolist(), attractor.velocity_nm_per_us.tolist(), strict=True)
        rows += [(attractor.name, share, error, *impact) for impact in list(impacts) or [(None, None)]]
    names = ("attractor", "share", "share_error", "phase_rad", "velocity_after_nm_per_us")
    return {name: [row[place] for row in rows] for place, name in enumerate(names)}


def _why_not_valid(result: Basins) -> str | None:
    unresolved = sum(
        share
        for attractor, share in zip(result.attractors, result.share, strict=True)
        if attractor.kind == MotionKind.UNRESOLVED
    )
    if not unresolved:
        return None
    return f"{100.0 * unresolved:.3g} % of the starts could not be followed: they come {WHY_UNRESOLVED}"
