"""`afm-jax basins SCENE.toml --grid 1000x1000`: which start, in drive phase and rebound speed, ends where."""

from typing import TYPE_CHECKING, Any

import click

from afm_jax.cli.fitted_law import as_drawn, with_fitted_law, with_law_options
from afm_jax.cli.main import NotValid
from afm_jax.cli.session import Session, with_session
from afm_jax.cli.values import Ends, SceneName, scene_and_start, with_picture

if TYPE_CHECKING:
    from pathlib import Path

    from afm_jax.dynamics.basins import Basins

_MOST_STARTS = 16_000_000


class Grid(click.ParamType):
    """Columns and rows, 1000x1000."""

    name = "grid"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[int, int]:
        """Return columns and rows.

        Raises:
            click.BadParameter: if it is no such grid, or one of too many starts.
        """
        parts = str(value).lower().split("x")
        good = len(parts) == 2 and all(part.isascii() and part.isdigit() and len(part) < 6 for part in parts)
        if not good or min(map(int, parts)) < 2 or int(parts[0]) * int(parts[1]) > _MOST_STARTS:
            self.fail(f"must be COLUMNSxROWS as in 1000x1000, 2 to {_MOST_STARTS} starts, but is {value}", param, ctx)
        return int(parts[0]), int(parts[1])


@click.command()
@click.argument("scene", metavar="SCENE.toml|PRESET", type=SceneName())
@click.option("--grid", type=Grid(), default="300x300", show_default=True, help="Drive phases x rebound speeds.")
@click.option("--speeds", type=Ends(), metavar="LOW:HIGH", help="Range of the rebound speed, in nm/us.")
@with_law_options
@with_picture
@with_session
def command(
    session: Session,
    *,
    scene: str,
    grid: tuple[int, int],
    speeds: tuple[float, float] | None,
    law: "Path | None",
    draws: int,
    picture: str,
) -> None:
    """Find what the starts of a scene come to, and which comes to what.

    A start is a drive phase and a speed at which the tip leaves the platform, at most four times the platform's top
    speed unless --speeds says otherwise. Attractors are named (m,N), m impacts in N drive periods, chaotic (the larger
    Lyapunov exponent is positive), irregular, stuck or free. Told are their shares, with the errors of as many random
    starts, and the dimension of the boundaries between them.
    With --law shares have a band from drawn laws. With --out basins.csv (a row a start), attractors.csv and a picture.
    Exit code 3 if starts could not be followed.
    """
    session.start_computing()
    import numpy as np  # noqa: PLC0415

    from afm_jax.dynamics.basins import basins_of_attraction  # noqa: PLC0415
    from afm_jax.dynamics.motion_bands import drawn_shares  # noqa: PLC0415
    from afm_jax.dynamics.verdicts import WHY_UNRESOLVED, MotionKind  # noqa: PLC0415
    from afm_jax.impact.law import extrapolation_of  # noqa: PLC0415
    from afm_jax.scenefile.scenefile import scene_tables  # noqa: PLC0415

    loaded, _ = scene_and_start(scene)
    loaded, known = with_fitted_law(loaded, law)
    columns, rows = grid
    try:
        with session.working("following starts (the first run compiles for some seconds)", "starts") as report:
            found = basins_of_attraction(
                as_drawn(loaded), columns=columns, rows=rows, speeds_nm_per_us=speeds, report=report
            )
            band = None if known is None else drawn_shares(loaded, found, known, draws=draws)
    except ValueError as error:
        raise ValueError(f"{scene}: {error}") from error
    if session.out is not None:
        _write(session, found)
        from afm_jax.plots.dynamics import draw_basins  # noqa: PLC0415

        target: Path = session.out / f"basins.{picture}"
        draw_basins(found, target)
        session.note(f"wrote {target}")
    attractors = [
        {
            "name": attractor.name,
            "impacts": attractor.impacts,
            "periods": attractor.periods,
            "share": share,
            "share_error": error,
            "phase_rad": attractor.phase_rad,
            "velocity_after_nm_per_us": attractor.velocity_nm_per_us,
        }
        for attractor, share, error in zip(found.attractors, found.share, found.share_error, strict=True)
    ]
    for one, pair in zip(attractors, () if band is None else band.tolist(), strict=False):
        one["share_interval95"] = pair
    approached = np.concatenate([attractor.approach_speed_nm_per_us for attractor in found.attractors])
    beyond = extrapolation_of(loaded.interaction, approached)
    payload = {
        "scene": scene_tables(loaded),
        "starts": found.attractor.size,
        "attractors": attractors,
        "boundary_dimension": found.boundary_dimension,
        "boundary_dimension_error": found.boundary_dimension_error,
        "extrapolated": beyond,
    }
    lines = [
        f"{one['name']}: {100.0 * one['share']:.4g} +- {100.0 * one['share_error']:.2g} % of the starts"
        + ("" if band is None else "; {:.4g} to {:.4g} % in 95 % of the draws".format(*(100.0 * band[index])))
        for index, one in enumerate(attractors)
    ]
    if np.isfinite(found.boundary_dimension):
        lines.append(
            f"dimension of the boundaries: {found.boundary_dimension:.3f} +- {found.boundary_dimension_error:.3f}"
        )
    session.emit(payload, *lines, beyond)
    unresolved = sum(
        one["share"]
        for one, attractor in zip(attractors, found.attractors, strict=True)
        if attractor.kind == MotionKind.UNRESOLVED
    )
    if unresolved:
        raise NotValid(f"{100.0 * unresolved:.3g} % of the starts could not be followed: they come {WHY_UNRESOLVED}")


def _write(session: Session, found: "Basins") -> None:
    import numpy as np  # noqa: PLC0415

    names = np.array([attractor.name for attractor in found.attractors])
    phase, speed = np.meshgrid(found.phase_rad, found.rebound_speed_nm_per_us)
    session.write_columns(
        "basins.csv",
        {
            "phase_rad": phase.ravel(),
            "rebound_speed_nm_per_us": speed.ravel(),
            "attractor": names[found.attractor.ravel()].tolist(),
        },
    )
    points: dict[str, list[Any]] = {
        name: [] for name in ("attractor", "share", "share_error", "phase_rad", "velocity_after_nm_per_us")
    }
    for attractor, share, error in zip(found.attractors, found.share, found.share_error, strict=True):
        pairs = list(zip(attractor.phase_rad.tolist(), attractor.velocity_nm_per_us.tolist(), strict=True))
        for pair in pairs or [(None, None)]:
            row = (attractor.name, float(share), float(error), *pair)
            for column, value in zip(points.values(), row, strict=True):
                column.append(value)
    session.write_columns("attractors.csv", points)
