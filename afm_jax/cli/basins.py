"""`afm-jax basins SCENE.toml --grid 1000x1000`: which start, in drive phase and rebound speed, ends where."""

from typing import Annotated

from click import IntRange

from afm_jax.cli.command import Output
from afm_jax.cli.scenes import NamedScene, as_drawn
from afm_jax.cli.session import Session
from afm_jax.cli.values import Ends, Grid
from afm_jax.dynamics.bands import drawn_shares
from afm_jax.dynamics.basins import basins_of_attraction


def basins(
    session: Session,
    scene: NamedScene,
    *,
    grid: Annotated[tuple[int, int], Grid()] = (300, 300),
    speeds_nm_per_us: Annotated[tuple[float, float] | None, Ends(), "--speeds", "LOW:HIGH"] = None,
    draws: Annotated[int, IntRange(2)] = 20,
) -> Output:
    """Find the motion on which each start of a scene ends.

    A start is a drive phase and a speed at which the tip leaves the platform, at most four times the platform's top
    speed unless --speeds says otherwise. Attractors are named (m,N), m impacts in N drive periods, irregular, stuck or
    free. The output gives the fraction of the starts that end on each, with the errors of as many random starts. With
    --law fractions have a band from drawn laws. With --out basins.csv (a row a start) and a picture.
    Exit code 3 if starts could not be followed.

    Args:
        session: for progress.
        scene: the scene.
        grid: drive phases x rebound speeds; 300x300 if left out.
        speeds_nm_per_us: range of the rebound speed, in nm/us.
        draws: laws drawn from the fit for the bands.
    """
    columns, rows = grid
    with session.working("following starts (the first run compiles for some seconds)", "starts") as report:
        result = basins_of_attraction(
            as_drawn(scene.scene), columns=columns, rows=rows, speeds_nm_per_us=speeds_nm_per_us, report=report
        )
        if scene.unknowns is not None:
            band = drawn_shares(scene.scene, result, scene.unknowns, draws=draws)
            result = result._replace(share_interval95=band)
    return Output.of(result, "basins")
