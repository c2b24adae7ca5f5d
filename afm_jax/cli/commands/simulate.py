"""Commands about the motions of a scene."""

from importlib import import_module

import click

from afm_jax.cli.command import Command, Options
from afm_jax.cli.options import DRAWS, LAW, PICTURE, SCENE
from afm_jax.cli.session import Session
from afm_jax.cli.values import Ends, Grid

BASINS = Command(
    name="basins",
    group="simulate",
    summary="Find which start of a scene ends where.",
    runs="afm_jax.cli.basins:basins",
    help="""Find what the starts of a scene come to, and which comes to what.

    A start is a drive phase and a speed at which the tip leaves the platform, at most four times the platform's top
    speed unless --speeds says otherwise. Attractors are named (m,N), m impacts in N drive periods, chaotic (the larger
    Lyapunov exponent is positive), irregular, stuck or free. Told are their shares, with the errors of as many random
    starts, and the dimension of the boundaries between them.
    With --law shares have a band from drawn laws. With --out basins.csv (a row a start), attractors.csv and a picture.
    Exit code 3 if starts could not be followed.
    """,
    options=(
        SCENE,
        click.option(
            "--grid", type=Grid(), default="300x300", show_default=True, help="Drive phases x rebound speeds."
        ),
        click.option("--speeds", type=Ends(), metavar="LOW:HIGH", help="Range of the rebound speed, in nm/us."),
        LAW,
        DRAWS,
        PICTURE,
    ),
)

BIFURCATION = Command(
    name="bifurcation",
    group="simulate",
    summary="Sweep a parameter and record what the tip comes to.",
    runs="afm_jax.cli.bifurcation:bifurcation",
    help="""Sweep a parameter and record what the tip comes to at each of its values.

    The tip is carried from value to value with its drive phase and rebound speed. It begins, and begins anew where the
    platform held it or it flew away, at the file's [start]; without one on the stable single-impact orbit of the order
    nearest to resonance, else leaving the platform upward. Of each value the verdict is told, (m,N): m impacts in N
    drive periods, irregular, stuck or free; and the last impacts are. With --out bifurcation.csv (a row a value),
    impacts.csv (a row an impact; of an orbit each once), strobe.csv (heights whenever the platform is highest) and a
    picture. With --law the share of the fit's draws with the same verdict is told too. Exit code 3 if no motion went on
    anywhere.
    """,
    options=(
        SCENE,
        click.option(
            "--parameter", metavar="P=a:b:n", required=True, help="A parameter of the scene file and its values."
        ),
        click.option("--both", is_flag=True, help="Sweep up and then down, so that hysteresis shows."),
        click.option("--down", is_flag=True, help="Sweep down instead of up."),
        click.option("--impacts", type=click.IntRange(200), default=2000, show_default=True, help="At every value."),
        LAW,
        DRAWS,
        PICTURE,
    ),
)


def _check_chart(_: Session, options: Options) -> None:
    """Check that a Zarr store can be written, before it is computed."""
    if options["zarr"]:
        import_module("zarr")


CHART = Command(
    name="chart",
    group="simulate",
    summary="Chart which single-impact orbits are stable over two parameters.",
    runs="afm_jax.cli.chart:chart",
    help="""Chart over two parameters of a scene which single-impact orbits exist, are stable and coexist.

    Of every point and order: whether an orbit is admissible, whether one is stable, and of the stable one (the highest,
    if there are several) the peak amplitude and the size of the larger multiplier. A contact's orbits are closed by
    simulation from those of the law closest to it: chart a thousand points, not a million; where none closes the point
    is unresolved. With --law the share of the fit's draws in which an orbit is stable is told too. With --out a table
    (chart.csv or chart.zarr) and a picture. Exit code 3 if there is no admissible orbit at all.
    """,
    options=(
        SCENE,
        click.option(
            "--x", metavar="P=a:b:n", required=True, help="A parameter of the scene file: the chart's columns."
        ),
        click.option("--y", metavar="P=a:b:n", required=True, help="Another one: its rows."),
        click.option("--orders", type=click.IntRange(1, 100), default=8, show_default=True, help="Highest order N."),
        click.option(
            "--zarr", is_flag=True, help="Write the table as chart.zarr instead of chart.csv; needs the extra `zarr`."
        ),
        LAW,
        DRAWS,
        PICTURE,
    ),
    check=_check_chart,
)

LYAPUNOV = Command(
    name="lyapunov",
    group="simulate",
    summary="Compute Lyapunov exponents of a motion, or along a parameter.",
    runs="afm_jax.cli.lyapunov:lyapunov",
    help="""Compute Lyapunov exponents by QR of the impact map's exact Jacobians; a contact's come from its simulation.

    Of a motion that has come to an orbit they are the logarithms of its multipliers. A tip that rests on the platform
    forgets its start: its exponents are minus infinity, null in JSON. Begins at the file's [start]; without one on the
    stable single-impact orbit of the order nearest to resonance, if there is one, else leaving the platform upward.
    With --law there is a band for the larger one, begun without [start]. With --out lyapunov.csv, and with --parameter
    a picture. Exit code 3 where every motion ends before enough impacts.
    """,
    options=(
        SCENE,
        click.option(
            "--impacts", type=click.IntRange(20), default=2000, show_default=True, help="Impacts to average over."
        ),
        click.option("--transient", type=click.IntRange(0), default=500, show_default=True, help="Impacts before."),
        click.option(
            "--parameter", metavar="P=a:b:n", help="A parameter of the scene file and its values, one motion each."
        ),
        LAW,
        DRAWS,
        PICTURE,
    ),
)

COMMANDS = (BASINS, BIFURCATION, CHART, LYAPUNOV)
