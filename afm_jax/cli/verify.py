"""`afm-jax verify`: the equations against automatic differentiation and against 50 digits."""

from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import click

from afm_jax.cli.main import NotValid
from afm_jax.cli.session import Session, with_session
from afm_jax.words import known

if TYPE_CHECKING:
    from afm_jax.verify.checks import Check

_COLUMNS = (
    "equation",
    "against",
    "where",
    "points",
    "max_relative_difference",
    "mode",
    "judged",
    "tolerance",
    "passed",
    "reason",
)


@click.command()
@click.option(
    "--states", type=click.IntRange(min=1), default=10_000, show_default=True, help="Random states of each kind."
)
@click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True, help="Seed of the random states.")
@click.option(
    "--exact-states",
    type=click.IntRange(min=1),
    default=200,
    show_default=True,
    help="States of each kind compared with 50 digits (needs mpmath).",
)
@with_session
def command(session: Session, *, states: int, seed: int, exact_states: int) -> None:
    """Compare eqs. 5 to 8 with automatic differentiation, and both with 50 digits.

    Differences are relative to the sum of the magnitudes of a formula's terms. Against 50 digits they are judged in
    units of machine epsilon times the condition number, which is large close to capture and grazing. Exit code 3 if
    one is too large.
    """
    session.start_computing()
    from afm_jax.verify.checks import verify  # noqa: PLC0415

    with session.working("comparing"):
        checks = verify(states=states, seed=seed, exact_states=exact_states)
    failed = [check for check in checks if check.passed is False]
    rows = [asdict(check) for check in checks]
    payload = {"checks": rows, "passed": not failed, "seed": seed, "states": states, "exact_states": exact_states}
    session.write_table("verify.csv", rows, _COLUMNS)
    session.emit(payload, _table(checks), *_remarks(checks))
    if failed:
        worst = failed[0]
        raise NotValid(
            f"{len(failed)} of {len(checks)} comparisons differ too much, first {worst.equation} ({worst.against}, "
            f"{worst.where}): {worst.judged:.2g}, allowed {worst.tolerance:g}"
        )


def _table(checks: list["Check"]) -> Any:
    from rich.table import Table  # noqa: PLC0415

    table = Table()
    for title in ("equation", "against", "where", "points", "worst rel. difference", "in eps x condition", "passed"):
        table.add_column(title, justify="right" if title in {"points", "worst rel. difference"} else "left")
    for check in checks:
        worst = known(check.max_relative_difference, ".1e")
        scaled = "" if check.against == "autodiff" or check.judged is None else f"{check.judged:.2g}"
        passed = {True: "yes", False: "NO", None: "not compared"}[check.passed]
        table.add_row(check.equation, check.against, check.where, str(check.points), worst, scaled, passed)
    return table


def _remarks(checks: list["Check"]) -> list[str]:
    """Return the reasons in the checks, each once, and what the columns were held against."""
    limits = {check.against: check.tolerance for check in reversed(checks)}
    held = (
        f"Allowed: {limits['autodiff']:g} against automatic differentiation (worse of forward and reverse); "
        f"{limits['50 digits']:g} eps x condition number against 50 digits (eq. 8: {_orbit_limit(checks):g})."
    )
    return [
        held,
        *dict.fromkeys(f"{check.where}, {check.against}: {check.reason}." for check in checks if check.reason),
    ]


def _orbit_limit(checks: list["Check"]) -> float:
    return max(check.tolerance for check in checks)
