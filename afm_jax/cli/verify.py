"""`afm-jax verify`: the equations against automatic differentiation and against 50 digits."""

from dataclasses import asdict
from typing import Any

from rich.table import Table

from afm_jax.cli.command import Output, columns_of
from afm_jax.cli.session import Session
from afm_jax.verify.checks import Check, verify
from afm_jax.words import known

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


def verification(session: Session, *, states: int, seed: int, exact_states: int) -> Output:
    """Return the comparisons of eqs. 5 to 8 with automatic differentiation and with 50 digits."""
    with session.working("comparing"):
        checks = verify(states=states, seed=seed, exact_states=exact_states)
    failed = [check for check in checks if check.passed is False]
    rows = [asdict(check) for check in checks]
    return Output(
        payload={
            "checks": rows,
            "passed": not failed,
            "seed": seed,
            "states": states,
            "exact_states": exact_states,
        },
        text=[_table(checks), *_remarks(checks)],
        tables={"verify.csv": columns_of(rows, _COLUMNS)},
        not_valid=_why_not(failed, len(checks)) if failed else None,
    )


def _why_not(failed: list[Check], compared: int) -> str:
    worst = failed[0]
    return (
        f"{len(failed)} of {compared} comparisons differ too much, first {worst.equation} ({worst.against}, "
        f"{worst.where}): {worst.judged:.2g}, allowed {worst.tolerance:g}"
    )


def _table(checks: list[Check]) -> Any:
    table = Table()
    for title in ("equation", "against", "where", "points", "worst rel. difference", "in eps x condition", "passed"):
        table.add_column(title, justify="right" if title in {"points", "worst rel. difference"} else "left")
    for check in checks:
        worst = known(check.max_relative_difference, ".1e")
        scaled = "" if check.against == "autodiff" or check.judged is None else f"{check.judged:.2g}"
        passed = {True: "yes", False: "NO", None: "not compared"}[check.passed]
        table.add_row(check.equation, check.against, check.where, str(check.points), worst, scaled, passed)
    return table


def _remarks(checks: list[Check]) -> list[str]:
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


def _orbit_limit(checks: list[Check]) -> float:
    return max(check.tolerance for check in checks)
