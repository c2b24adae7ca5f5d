"""Commands that check equations, accuracy and the installation."""

from pathlib import Path

import click

from afm_jax.cli.command import Command
from afm_jax.cli.options import flag
from afm_jax.cli.values import Finite, SceneName

VERIFY = Command(
    name="verify",
    group="check",
    summary="Compare eqs. 5 to 8 with automatic differentiation and with 50 digits.",
    runs="afm_jax.cli.verify:verification",
    help="""Compare eqs. 5 to 8 with automatic differentiation, and both with 50 digits.

    Differences are relative to the sum of the magnitudes of a formula's terms. Against 50 digits they are judged in
    units of machine epsilon times the condition number, which is large close to capture and grazing. Exit code 3 if
    one is too large.
    """,
    options=(
        click.option("--states", type=click.IntRange(min=1), default=10_000, help="Random states of each kind."),
        click.option("--seed", type=click.IntRange(min=0), default=0, help="Seed of the random states."),
        click.option(
            "--exact-states",
            type=click.IntRange(min=1),
            default=200,
            help="States of each kind compared with 50 digits (needs mpmath).",
        ),
    ),
)


ACCURACY = Command(
    name="accuracy",
    group="check",
    summary="Show error against time, and the cheapest setting for a wanted accuracy.",
    runs="afm_jax.cli.accuracy:accuracy",
    help="""Show errors against the time they take: of everything in one overview, the map, `collide`, or one scene.

    Without an argument: impacts, collisions, driven contacts, orbits, fits and gradients, and general-purpose
    integrators of SciPy, Diffrax and SUNDIALS (extra `sundials`) beside them; some minutes.

    map: root tolerances in float32 and float64, and SciPy's solve_ivp with events, on three scenes: regular, near
    grazing with chatter, and of order 5; errors are against 50 digits. collide: Diffrax solvers with fixed and adaptive
    steps, in the gap and in time, values and derivatives, float32 and float64, SciPy beside them; errors are against a
    quadrature converged to rounding. SCENE.toml (or a preset's name): settings of the scene's contacts or of its root
    search against the finest, and the fidelity ladder: what orbit, map and map with delay of the fitted law make of the
    amplitude. With --out accuracy.csv, accuracy.json, accuracy.png (a scene: ladder.csv too).
    """,
    options=(
        click.argument(
            "study", required=False, metavar="[map|collide|SCENE.toml|PRESET]", type=SceneName("map", "collide")
        ),
        click.option(
            "--wanted-error-us",
            type=Finite(positive=True),
            default=1e-9,
            help="Error of an impact time for which to find the cheapest setting.",
        ),
        click.option(
            "--accuracy",
            type=Finite(positive=True),
            default=1e-9,
            help="For collide: relative error of the rebound speed (a tenth of the delay's in us) to find the "
            "cheapest for.",
        ),
        click.option(
            "--contacts",
            type=click.IntRange(1, 10_000),
            default=10,
            help="For a scene: the arrival of which contact is compared.",
        ),
        flag("--quick", "Few and small measurements: to see that it works."),
    ),
)


BENCH = Command(
    name="bench",
    group="check",
    summary="Measure impacts per second, next to SciPy.",
    runs="afm_jax.cli.bench:bench",
    help="""Measure impacts per second: next_impact iterated, collide through the contact, driven contacts; and fits.

    The impact map is measured on one core and on all. The same run measures a chaotic scene, derivatives, and SciPy's
    solve_ivp with events on the same problems. Errors of impact times are against 50 digits, those of contacts against
    finer settings. Times are the best of several repetitions, compilation apart; the machine should have nothing else
    to do. Fits of 100 rows are timed as commands, and those of another checkout beside them. With --out bench.csv,
    bench_contact.csv, bench_scenes.csv, bench_dynamics.csv, bench_sweep.csv, bench_fits.csv and bench.json.
    """,
    options=(
        flag("--quick", "Few and small measurements: to see that it works."),
        click.option(
            "--batch",
            "batches",
            type=click.IntRange(1, 10_000_000),
            multiple=True,
            metavar="N",
            help="How many tips at once; may be given several times. Default: 1, 100, 10000 and 100000.",
        ),
        click.option(
            "--only",
            type=click.Choice(["map", "contact", "scenes", "dynamics", "sweep", "fits"]),
            help="The impact map alone, the contact of free tips, driven contacts, charts, sweeps, or fits from the "
            "shell.",
        ),
        click.option(
            "--beside",
            type=click.Path(path_type=Path, file_okay=False, exists=True),
            metavar="DIR",
            help="Another checkout of the project: its fits are timed in turn with these.",
        ),
    ),
)


DOCTOR = Command(
    name="doctor",
    group="check",
    summary="Say what is installed, how JAX computes, and whether its cache works.",
    runs="afm_jax.cli.doctor:doctor",
    help="""Say what is installed, how JAX computes, and whether its compilation cache works.

    A small program is compiled by two fresh processes: the second should find it in the cache. Exit code 3 if it does
    not, or if the cache's folder cannot be used; every command then compiles anew, which takes up to a minute. Exit
    code 3, too, where a version of JAX is installed that computes wrongly or very slowly.
    """,
    computes=False,
)


COMMANDS = (ACCURACY, BENCH, DOCTOR, VERIFY)
