"""Commands that check equations, accuracy and the installation."""

import click

from afm_jax.cli.command import Command

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

COMMANDS = (VERIFY,)
