"""Commands about the contact between tip and sample."""

import click

from afm_jax.cli.command import Command, Options
from afm_jax.cli.contact_options import CONTACT_OPTIONS
from afm_jax.cli.options import flag, valued
from afm_jax.cli.session import Session
from afm_jax.cli.values import Ends, Finite, Numbers

_PROGRAMS = ("afm_jax.contact.collide:_capture_speed", "afm_jax.contact.collide:_quick")


def _check_law(_: Session, options: Options) -> None:
    """Check that options of a law go with --make-law, and others without."""
    of_laws = ("speed_range", "points")
    given = [name for name in of_laws if options[name] is not None]
    if given and not options["make_law"]:
        raise click.UsageError(f"--{given[0].replace('_', '-')} is of the formulas of a law: add --make-law")
    if options["make_law"] and options["speeds"] is not None:
        raise click.UsageError("--make-law chooses its own speeds: leave --speeds out")


COLLIDE = Command(
    name="collide",
    runs="afm_jax.cli.collide:collide",
    help="""Let free tips collide with a sample at rest, through liquid bridge and solid junction.

    The contact is the paper's, or that of SCENE.toml, changed by the options. The output gives the capture speed, and
    for every speed the rebound speed, the collision delay, whether the tip is captured, times, deepest gap, and where
    the energy went. With --out collide.csv, collide.json and collide.png. Captured tips are a result, even if all are;
    exit code 3 if the integration does not resolve a collision. --make-law computes the impact law of the contact.
    """,
    options=(
        *CONTACT_OPTIONS,
        valued(
            "--speeds",
            Numbers("speed", example="12,15,20"),
            "Approach speeds in nm/us: 12,15,20 or start:stop:step as 12:200:10 (with the stop where it fits), "
            "or both. Left out: 20 speeds from 1.1 times the capture speed to 200.",
            metavar="LIST",
        ),
        valued("--accuracy", Finite(positive=True), "Wanted relative accuracy of the rebound speed.", default=1e-9),
        flag(
            "--make-law",
            "Compute the impact law of the contact instead of a table of collisions: with --out law.json and law.csv, "
            "which scene files and --law read, and the formulas closest to it.",
        ),
        valued(
            "--speed-range",
            Ends(),
            "With --make-law: approach speeds of the formulas in nm/us. Left out: 1.5 times the capture speed to 250.",
            metavar="LOW:HIGH",
        ),
        valued(
            "--points",
            click.IntRange(min=10, max=100_000),
            "With --make-law: number of speeds that formulas are fitted to; else 512.",
        ),
    ),
    check=_check_law,
    programs=lambda options: () if options["make_law"] else _PROGRAMS,
)

COMMANDS = (COLLIDE,)
