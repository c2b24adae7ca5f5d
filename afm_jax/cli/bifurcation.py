"""`afm-jax bifurcation SCENE.toml --parameter P=a:b:n`: what motions come to along a parameter, swept up and down."""

from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np

from afm_jax.cli.command import NamedScene, Output, later
from afm_jax.cli.fitted_law import as_drawn
from afm_jax.cli.session import Session
from afm_jax.cli.values import ranges_of
from afm_jax.dynamics.bands import verdict_probability
from afm_jax.dynamics.bifurcations import Sweep, bifurcation_diagram
from afm_jax.impact.law import extrapolation_of
from afm_jax.scenefile.scenefile import scene_tables

draw_bifurcations = later("afm_jax.plots.dynamics:draw_bifurcations")

_NONE_WENT_ON = (
    "no motion went on at any value: the tip sticks or flies away; try a larger drive amplitude, or a [start]"
)
_LISTED = 6
"""Kinds of motion named in the summary."""


def bifurcation(  # noqa: PLR0913
    session: Session,
    scene: NamedScene,
    *,
    parameter: str,
    both: bool,
    down: bool,
    impacts: int,
    draws: int,
    picture: str,
) -> Output:
    """Return what motions of a scene come to along a parameter, swept up, down or both ways."""
    (swept,) = ranges_of(scene.name, scene.scene, [parameter], counted=True)
    sweeps, probabilities = [], None
    for upward in [True, False] if both else [not down]:
        direction = "up" if upward else "down"
        with session.working(f"sweeping {direction}", f"values {direction}") as report:
            sweep = bifurcation_diagram(
                as_drawn(scene.scene),
                swept.path,
                swept.values,
                start=scene.start,
                upward=upward,
                impacts=impacts,
                report=report,
            )
        sweeps.append(sweep)
    if scene.unknowns is not None:
        chosen = {"start": scene.start, "draws": draws, "impacts": impacts}
        with session.working("sweeping with drawn laws"):
            probabilities = [
                verdict_probability(scene.scene, swept.path, sweep, scene.unknowns, **chosen) for sweep in sweeps
            ]
    if not all(sweep.complete for sweep in sweeps):
        session.note("some stretches were not followed to the end of a branch: sweep fewer values, or a smaller range")
    went_on = any(np.isfinite(sweep.phase_rad).any() for sweep in sweeps)
    speeds = np.concatenate([sweep.approach_nm_per_us.ravel() for sweep in sweeps])
    payload = {
        "parameter": swept.path,
        "scene": scene_tables(scene.scene),
        "impacts_each": impacts,
        "sweeps": [_payload(sweep) for sweep in sweeps],
        "extrapolated": extrapolation_of(scene.scene.interaction, speeds),
        "reason": None if went_on else _NONE_WENT_ON,
    }
    if probabilities is not None:
        payload["draws"] = draws
        for of_sweep, probability in zip(payload["sweeps"], probabilities, strict=True):
            of_sweep["verdict_probability"] = probability
    return Output(
        payload=payload,
        text=[*map(_summary, sweeps), payload["extrapolated"]],
        tables=_tables(swept.path, sweeps, probabilities),
        files={f"bifurcation.{picture}": lambda path: draw_bifurcations(swept.path, sweeps, path, probabilities)},
        not_valid=payload["reason"],
    )


def _payload(sweep: Sweep) -> dict[str, Any]:
    return {
        "direction": "up" if sweep.upward else "down",
        "complete": sweep.complete,
        "values": sweep.values,
        "verdicts": sweep.verdicts.names(),
        "impacts": sweep.verdicts.impacts,
        "periods": sweep.verdicts.periods,
        "restarted": sweep.restarted,
        "phase_rad": [row[np.isfinite(row)] for row in sweep.phase_rad],
        "platform_height_nm": [row[np.isfinite(row)] for row in sweep.height_nm],
    }


def _summary(sweep: Sweep) -> str:
    counts = Counter(sweep.verdicts.names()).most_common()
    words = ", ".join(f"{name} at {count}" for name, count in counts[:_LISTED])
    rest = sum(count for _, count in counts[_LISTED:])
    return f"swept {'up' if sweep.upward else 'down'}: {words}" + (f", others at {rest}" if rest else "")


def _tables(path: str, sweeps: Sequence[Sweep], probabilities: list[np.ndarray] | None) -> dict[str, dict[str, Any]]:
    """Return the columns of three tables: a row a value, an impact, and a stroboscopic height."""
    tables = {"bifurcation.csv": [], "impacts.csv": [], "strobe.csv": []}
    for sweep in sweeps:
        tables["bifurcation.csv"].append(
            {path: sweep.values, "verdict": np.array(sweep.verdicts.names()), "restarted": sweep.restarted}
        )
        impacts = {
            "phase_rad": sweep.phase_rad,
            "approach_speed_nm_per_us": sweep.approach_nm_per_us,
            "velocity_after_nm_per_us": sweep.velocity_after_nm_per_us,
            "platform_height_nm": sweep.height_nm,
        }
        tables["impacts.csv"].append(_finite(path, sweep, impacts))
        tables["strobe.csv"].append(_finite(path, sweep, {"height_nm": sweep.strobe_height_nm}))
    for columns in tables.values():
        for sweep, of_sweep in zip(sweeps, columns, strict=True):
            direction = "up" if sweep.upward else "down"
            of_sweep["direction"] = np.full(len(of_sweep[path]), direction)
    joined = {
        name: {
            column: np.concatenate([of_sweep[column] for of_sweep in columns])
            for column in ("direction", *(column for column in columns[0] if column != "direction"))
        }
        for name, columns in tables.items()
    }
    if probabilities is not None:
        joined["bifurcation.csv"]["verdict_probability"] = np.concatenate(probabilities)
    return joined


def _finite(path: str, sweep: Sweep, arrays: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return the columns of arrays (values, places) where the first is finite, after the column of the values."""
    there = np.isfinite(next(iter(arrays.values())))
    return {path: np.repeat(sweep.values, there.sum(axis=1)), **{name: array[there] for name, array in arrays.items()}}
