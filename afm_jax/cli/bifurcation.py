"""`afm-jax bifurcation SCENE.toml --parameter P=a:b:n`: what motions come to along a parameter, swept up and down."""

from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np

from afm_jax.cli.command import NamedScene, Output, picture_of
from afm_jax.cli.fitted_law import as_drawn
from afm_jax.cli.session import Session
from afm_jax.cli.values import ranges_of
from afm_jax.dynamics.bands import verdict_probability
from afm_jax.dynamics.bifurcations import Sweep, bifurcation_diagram
from afm_jax.scenefile.scenefile import scene_tables

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
    payload = {
        "parameter": swept.path,
        "scene": scene_tables(scene.scene),
        "impacts_each": impacts,
        "sweeps": [_payload(sweep) for sweep in sweeps],
        "reason": None if went_on else _NONE_WENT_ON,
    }
    if probabilities is not None:
        payload["draws"] = draws
        for of_sweep, probability in zip(payload["sweeps"], probabilities, strict=True):
            of_sweep["verdict_probability"] = probability
    return Output(
        payload=payload,
        text=[_summary(sweep) for sweep in sweeps],
        impact_speeds=np.concatenate([sweep.approach_nm_per_us.ravel() for sweep in sweeps]),
        tables=_tables(swept.path, sweeps, probabilities),
        files={f"bifurcation.{picture}": picture_of("dynamics:bifurcation_figure", sweeps, swept.path, probabilities)},
        not_valid=payload["reason"],
    )


def _payload(sweep: Sweep) -> dict[str, Any]:
    return {
        "direction": _direction(sweep),
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
    return f"swept {_direction(sweep)}: {words}" + (f", others at {rest}" if rest else "")


def _tables(path: str, sweeps: Sequence[Sweep], probabilities: list[np.ndarray] | None) -> dict[str, dict[str, Any]]:
    """Return the columns of three tables: a row a value, an impact, and a stroboscopic height."""
    values, impacts, strobe = [], [], []
    for number, sweep in enumerate(sweeps):
        values.append(
            {
                "direction": np.full(len(sweep.values), _direction(sweep)),
                path: sweep.values,
                "verdict": np.array(sweep.verdicts.names()),
                "restarted": sweep.restarted,
                **({} if probabilities is None else {"verdict_probability": probabilities[number]}),
            }
        )
        of_impacts = {
            "phase_rad": sweep.phase_rad,
            "approach_speed_nm_per_us": sweep.approach_nm_per_us,
            "velocity_after_nm_per_us": sweep.velocity_after_nm_per_us,
            "platform_height_nm": sweep.height_nm,
        }
        impacts.append(_finite(path, sweep, of_impacts))
        strobe.append(_finite(path, sweep, {"height_nm": sweep.strobe_height_nm}))
    return {
        name: {column: np.concatenate([part[column] for part in parts]) for column in parts[0]}
        for name, parts in (("bifurcation.csv", values), ("impacts.csv", impacts), ("strobe.csv", strobe))
    }


def _finite(path: str, sweep: Sweep, arrays: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return direction and value, and arrays (values, places) where the first of them is finite, as columns."""
    there = np.isfinite(next(iter(arrays.values())))
    return {
        "direction": np.full(there.sum(), _direction(sweep)),
        path: np.repeat(sweep.values, there.sum(axis=1)),
        **{name: array[there] for name, array in arrays.items()},
    }


def _direction(sweep: Sweep) -> str:
    return "up" if sweep.upward else "down"
