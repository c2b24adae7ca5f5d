"""Commands that check equations, accuracy and the installation."""

import click

from afm_jax.cli.command import Command
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
        click.option(
            "--states",
            type=click.IntRange(min=1),
            default=10_000,
            show_default=True,
            help="Random states of each kind.",
        ),
        click.option(
            "--seed", type=click.IntRange(min=0), default=0, show_default=True, help="Seed of the random states."
        ),
        click.option(
            "--exact-states",
            type=click.IntRange(min=1),
            default=200,
            show_default=True,
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
            show_default=True,
            help="Error of an impact time for which to find the cheapest setting.",
        ),
        click.option(
            "--accuracy",
            type=Finite(positive=True),
            default=1e-9,
            show_default=True,
            help="For collide: relative error of the rebound speed (a tenth of the delay's in us) to find the "
            "cheapest for.",
        ),
        click.option(
            "--contacts",
            type=click.IntRange(1, 10_000),
            default=10,
            show_default=True,
            help="For a scene: the arrival of which contact is compared.",
        ),
        click.option("--quick", is_flag=True, help="Few and small measurements: to see that it works."),
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
    to do. Fits of 100 rows are timed as commands. With --out bench.csv, bench_contact.csv, bench_scenes.csv,
    bench_dynamics.csv, bench_sweep.csv, bench_fits.csv and bench.json.
    """,
    options=(
        click.option("--quick", is_flag=True, help="Few and small measurements: to see that it works."),
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


_FIGURES = ("2", "3", "4", "5", "6", "7", "8", "9", "10", "11")


def _chosen_figures(ctx: click.Context, parameter: click.Parameter, text: str) -> tuple[str, ...]:
    """Return the numbers in a comma list, without repetitions and in the order of the paper."""
    numbers = {part.strip() for part in text.split(",") if part.strip()}
    have = ", ".join(_FIGURES)
    for number in sorted(numbers):
        if number not in _FIGURES:
            message = f"there is no figure `{number}` to draw; choose from {have}"
            raise click.BadParameter(message, ctx=ctx, param=parameter)
    if not numbers:
        raise click.BadParameter(f"names no figure; choose from {have}", ctx=ctx, param=parameter)
    return tuple(number for number in _FIGURES if number in numbers)


FIGURES = Command(
    name="figures",
    group="check",
    summary="Draw figures 2 to 11 of the paper, with its statements checked.",
    runs="afm_jax.cli.figures:figures",
    help="""Draw the paper's figures, with their data as CSV (into the folder `figures` without --out).

    Figures 2 and 3: where single-impact orbits are stable, without and with adhesion. Figure 4: the forces of the
    liquid bridge; 5: loading and unloading; 6: the impact law of the contact; 7: one impact in time; 8: Poincare
    section of the contact in motion. Figure 9: amplitude of the (1,1) orbit against the tip-sample offset, below and
    above resonance; 10 and 11: the contact in motion under a rising offset. What the paper says of each figure is
    checked on the data, and random points of 2, 3 and 9 against long iterations of the impact map.
    """,
    options=(
        click.option(
            "--only",
            metavar="2,3,4,...",
            default=",".join(_FIGURES),
            callback=_chosen_figures,
            help="Draw these figures of the paper only (comma list); all that there are if left out.",
        ),
        click.option("--coarse", is_flag=True, help="A quick look: fewer points, starts and ramps."),
        click.option(
            "--seed", type=click.IntRange(min=0), default=1, show_default=True, help="Of the random spot checks."
        ),
    ),
    computes=False,
)

COMMANDS = (ACCURACY, BENCH, DOCTOR, FIGURES, VERIFY)
