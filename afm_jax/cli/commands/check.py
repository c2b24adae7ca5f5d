"""Commands that check equations, accuracy and the installation."""

import click

from afm_jax.cli.command import Command
from afm_jax.cli.options import flag, valued

VERIFY = Command(
    name="verify",
    runs="afm_jax.cli.verify:verification",
    help="""Compare eqs. 5 to 8 with automatic differentiation, forward and reverse, at random scenes and starts.

    Equations are compared as printed, and with air damping, viscous loss and a collision delay; eq. 8 on single-impact
    orbits. Differences are relative to the sum of the magnitudes of a formula's terms. With --out verify.csv. Exit code
    3 if one is too large.
    """,
    options=(
        valued("--states", click.IntRange(min=1), "Random states of each kind.", default=10_000),
        valued("--seed", click.IntRange(min=0), "Seed of the random states.", default=0),
    ),
)


ACCURACY = Command(
    name="accuracy",
    runs="afm_jax.cli.accuracy:accuracy",
    help="""Show errors of a value and of its gradient against the time they take, beside SciPy and Diffrax.

    map: the time of the next impact, by start and velocity; errors are against 50 digits (needs mpmath, extra
    `verify`). collide: the rebound speed of the paper's contact, by speed and viscosity; errors are against a
    quadrature converged to rounding. SCENE.toml (or a preset's name): the arrival of one of the first contacts,
    however the scene is driven, by the start's velocity; errors are against the finest setting. SciPy's DOP853 and
    Diffrax's Dopri8 follow the same equations phase by phase, each ended by an event. Some minutes. With --out
    accuracy.csv, accuracy.json and accuracy.png.
    """,
    options=(
        click.argument("study", default="map", metavar="[map|collide|SCENE.toml|PRESET]", type=click.Path()),
        valued(
            "--contacts",
            click.IntRange(1, 10_000),
            "For a scene: number of the contact whose arrival is compared.",
            default=10,
        ),
        flag("--quick", "Few and small measurements, to check that it works."),
    ),
)


DOCTOR = Command(
    name="doctor",
    runs="afm_jax.cli.doctor:doctor",
    help="""Say what is installed, how JAX computes, and whether its compilation cache works.

    A small program is compiled by two fresh processes: the second should find it in the cache. Exit code 3 if it does
    not, or if the cache's folder cannot be used; every command then compiles anew, which takes up to a minute. Exit
    code 3, too, where a version of JAX is installed that computes wrongly or very slowly.
    """,
    computes=False,
)


COMMANDS = (ACCURACY, DOCTOR, VERIFY)
