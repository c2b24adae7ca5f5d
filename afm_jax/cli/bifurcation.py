"""`afm-jax bifurcation SCENE.toml --parameter P=a:b:n`: what motions come to along a parameter, swept up and down."""

from collections import Counter
from typing import TYPE_CHECKING, Any

import click

from afm_jax.cli.fitted_law import as_drawn, with_fitted_law, with_law_options
from afm_jax.cli.main import NotValid
from afm_jax.cli.session import Session, with_session
from afm_jax.cli.values import SceneName, ranges_of, scene_and_start, with_picture

if TYPE_CHECKING:
    from pathlib import Path

    import numpy as np

    from afm_jax.dynamics.bifurcations import Sweep

POINTS = ("phase_rad", "approach_speed_nm_per_us", "velocity_after_nm_per_us", "platform_height_nm")
_NONE_WENT_ON = (
    "no motion went on at any value: the tip sticks or flies away; try a larger drive amplitude, or a [start]"
)
_LISTED = 6
"""Kinds of motion named in the summary."""


@click.command()
@click.argument("scene", metavar="SCENE.toml|PRESET", type=SceneName())
@click.option("--parameter", metavar="P=a:b:n", required=True, help="A parameter of the scene file and its values.")
@click.option("--both", is_flag=True, help="Sweep up and then down, so that hysteresis shows.")
@click.option("--down", is_flag=True, help="Sweep down instead of up.")
@click.option("--impacts", type=click.IntRange(200), default=2000, show_default=True, help="At every value.")
@with_law_options
@with_picture
@with_session
def command(  # noqa: PLR0913
    session: Session,
    *,
    scene: str,
    parameter: str,
    both: bool,
    down: bool,
    impacts: int,
    law: "Path | None",
    draws: int,
    picture: str,
) -> None:
    """Sweep a parameter and record what the tip comes to at each of its values.

    The tip is carried from value to value with its drive phase and rebound speed. It begins, and begins anew where the
    platform held it or it flew away, at the file's [start]; without one on the stable single-impact orbit of the order
    nearest to resonance, else leaving the platform upward. Of each value the verdict is told, (m,N): m impacts in N
    drive periods, irregular, stuck or free; and the last impacts are. With --out bifurcation.csv (a row a value),
    impacts.csv (a row an impact; of an orbit each once), strobe.csv (heights whenever the platform is highest) and a
    picture. With --law the share of the fit's draws with the same verdict is told too. Exit code 3 if no motion went on
    anywhere.
    """
    session.start_computing()
    import numpy as np  # noqa: PLC0415

    from afm_jax.dynamics.bifurcations import bifurcation_diagram  # noqa: PLC0415
    from afm_jax.dynamics.motion_bands import verdict_probability  # noqa: PLC0415
    from afm_jax.impact.law import extrapolation_of  # noqa: PLC0415
    from afm_jax.scenefile.scenefile import scene_tables  # noqa: PLC0415

    loaded, start = scene_and_start(scene)
    loaded, known = with_fitted_law(loaded, law)
    (swept,) = ranges_of(scene, loaded, [parameter], counted=True)
    directions = [True, False] if both else [not down]
    sweeps = []
    try:
        for upward in directions:
            way = "up" if upward else "down"
            with session.working(f"sweeping {way}", f"values {way}") as report:
                sweeps.append(
                    bifurcation_diagram(
                        as_drawn(loaded),
                        swept.path,
                        swept.values,
                        start=start,
                        upward=upward,
                        impacts=impacts,
                        report=report,
                    )
                )
        probabilities = None
        if known is not None:
            with session.working("sweeping with drawn laws"):
                probabilities = [
                    verdict_probability(loaded, swept.path, sweep, known, start=start, draws=draws, impacts=impacts)
                    for sweep in sweeps
                ]
    except ValueError as error:
        raise ValueError(f"{scene}: {error}") from error
    if not all(sweep.complete for sweep in sweeps):
        session.note("some stretches were not followed to the end of a branch: sweep fewer values, or a smaller range")
    if session.out is not None:
        _write(session, swept.path, sweeps, probabilities)
        from afm_jax.plots.dynamics import draw_bifurcations  # noqa: PLC0415

        target = session.out / f"bifurcation.{picture}"
        draw_bifurcations(swept.path, sweeps, target, probabilities)
        session.note(f"wrote {target}")
    went_on = any(np.isfinite(sweep.phase_rad).any() for sweep in sweeps)
    speeds = np.concatenate([sweep.approach_nm_per_us.ravel() for sweep in sweeps])
    beyond = extrapolation_of(loaded.interaction, speeds)
    payload = {
        "parameter": swept.path,
        "scene": scene_tables(loaded),
        "impacts_each": impacts,
        "sweeps": [_payload(sweep) for sweep in sweeps],
        "extrapolated": beyond,
        "reason": None if went_on else _NONE_WENT_ON,
    }
    if probabilities is not None:
        payload["draws"] = draws
        for told, sure in zip(payload["sweeps"], probabilities, strict=True):
            told["verdict_probability"] = sure
    session.emit(payload, *(_summary(sweep) for sweep in sweeps), beyond)
    if not went_on:
        raise NotValid(_NONE_WENT_ON)


def _payload(sweep: "Sweep") -> dict[str, Any]:
    import numpy as np  # noqa: PLC0415

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


def _summary(sweep: "Sweep") -> str:
    counts = Counter(sweep.verdicts.names()).most_common()
    words = ", ".join(f"{name} at {count}" for name, count in counts[:_LISTED])
    rest = sum(count for _, count in counts[_LISTED:])
    return f"swept {'up' if sweep.upward else 'down'}: {words}" + (f", others at {rest}" if rest else "")


def _write(session: Session, path: str, sweeps: "list[Sweep]", probabilities: "list[np.ndarray] | None") -> None:
    import numpy as np  # noqa: PLC0415

    rows: dict[str, list[Any]] = {name: [] for name in ("direction", path, "verdict", "restarted")}
    impacts: dict[str, list[Any]] = {name: [] for name in ("direction", path, *POINTS)}
    strobe: dict[str, list[Any]] = {name: [] for name in ("direction", path, "height_nm")}
    for sweep in sweeps:
        word = "up" if sweep.upward else "down"
        _extend(rows, [word] * len(sweep.values), sweep.values, sweep.verdicts.names(), sweep.restarted)
        there = np.isfinite(sweep.phase_rad)
        points = (sweep.phase_rad, sweep.approach_nm_per_us, sweep.velocity_after_nm_per_us, sweep.height_nm)
        at = np.repeat(sweep.values, there.sum(axis=1))
        _extend(impacts, [word] * len(at), at, *(part[there] for part in points))
        seen = np.isfinite(sweep.strobe_height_nm)
        at = np.repeat(sweep.values, seen.sum(axis=1))
        _extend(strobe, [word] * len(at), at, sweep.strobe_height_nm[seen])
    if probabilities is not None:
        rows["verdict_probability"] = np.concatenate(probabilities).tolist()
    session.write_columns("bifurcation.csv", rows)
    session.write_columns("impacts.csv", impacts)
    session.write_columns("strobe.csv", strobe)


def _extend(table: dict[str, list[Any]], *columns: Any) -> None:
    import numpy as np  # noqa: PLC0415

    for name, column in zip(table, columns, strict=True):
        table[name] += column.tolist() if isinstance(column, np.ndarray) else column
