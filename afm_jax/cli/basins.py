"""`afm-jax basins SCENE.toml --grid 1000x1000`: which start, in drive phase and rebound speed, ends where."""

from afm_jax.cli.command import NamedScene, Output, picture_of
from afm_jax.cli.fitted_law import as_drawn
from afm_jax.cli.session import Session
from afm_jax.dynamics.bands import drawn_shares
from afm_jax.dynamics.basins import basins_of_attraction


def basins(
    session: Session,
    scene: NamedScene,
    *,
    grid: tuple[int, int],
    speeds_nm_per_us: tuple[float, float] | None,
    draws: int,
) -> Output:
    """Return what the starts of a scene come to, with the bands of drawn laws if the law is uncertain."""
    columns, rows = grid
    with session.working("following starts (the first run compiles for some seconds)", "starts") as report:
        result = basins_of_attraction(
            as_drawn(scene.scene), columns=columns, rows=rows, speeds_nm_per_us=speeds_nm_per_us, report=report
        )
        if scene.unknowns is not None:
            band = drawn_shares(scene.scene, result, scene.unknowns, draws=draws)
            result = result._replace(share_interval95=band)
    return Output.of(result, files={"basins.png": picture_of("dynamics:basins_figure", result)})
