"""`afm-jax accuracy`: error against time, and the cheapest setting for a wanted error."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import click

from afm_jax.cli.session import Session, with_session

if TYPE_CHECKING:
    from rich.table import Table

COLUMNS = (
    "scene",
    "method",
    "tolerance",
    "microseconds_per_impact",
    "error_us",
    "median_error_us",
    "sequence_error_us",
    "impacts_checked",
    "near_grazing",
    "near_grazing_error_us",
    "lost_impacts",
    "evaluations_per_impact",
    "missed_impacts",
    "compile_s",
    "reason",
)
"""What `accuracy.csv` tells of a setting."""
FULL = {
    "root_tolerances_us": [1e-1, 1e-2, 1e-4, 1e-6, 1e-8, 1e-10, 1e-12, 1e-13, 1e-14],
    "scipy_tolerances": [1e-4, 1e-6, 1e-8, 1e-10, 1e-12],
    "batch": 2000,
    "impacts": 20,
    "lanes": 3,
    "repetitions": 5,
}
QUICK = {
    "root_tolerances_us": [1e-1, 1e-6, 1e-13],
    "scipy_tolerances": [1e-8],
    "batch": 20,
    "impacts": 5,
    "lanes": 1,
    "repetitions": 1,
}


@click.command()
@click.argument("study", default="map", metavar="[map]")
@click.option(
    "--wanted-error-us",
    type=click.FloatRange(min=0.0, min_open=True),
    default=1e-9,
    show_default=True,
    help="Error of an impact time for which to find the cheapest setting.",
)
@click.option("--quick", is_flag=True, help="Few and small measurements: to see that it works.")
@with_session
def command(session: Session, study: str, wanted_error_us: float, *, quick: bool) -> None:
    """Show the error of impact times against the time they take.

    Root tolerances in float32 and float64, and SciPy's solve_ivp with events, on three scenes: regular, near grazing
    with chatter, and of order 5. Errors are against 50 digits. With --out accuracy.csv, accuracy.json, accuracy.png.
    """
    if study != "map":
        raise click.UsageError(f"there is no accuracy study of `{study}`; choose: map")
    session.start_computing()
    from afm_jax.cli.strict_json import strict_json  # noqa: PLC0415
    from afm_jax.study.accuracy import cheapest_settings  # noqa: PLC0415
    from afm_jax.study.own_process import run_in_own_process  # noqa: PLC0415

    with session.working("measuring"):
        result = run_in_own_process("afm_jax.study.accuracy:map_accuracy", QUICK if quick else FULL, cores=1)
    cheapest = cheapest_settings(result["rows"], wanted_error_us)
    payload = {**result, "wanted_error_us": wanted_error_us, "cheapest": cheapest}
    session.write_table("accuracy.csv", result["rows"], COLUMNS)
    if session.out is not None:
        from afm_jax.plots.accuracy import accuracy_figure  # noqa: PLC0415

        (session.out / "accuracy.json").write_text(strict_json(payload) + "\n", encoding="utf-8")
        accuracy_figure(result["rows"], wanted_error_us).savefig(session.out / "accuracy.png", dpi=150)
        session.note(f"wrote {session.out / 'accuracy.json'} and {session.out / 'accuracy.png'}")
    session.emit(
        payload,
        accuracy_table(result["rows"]),
        f"Reference: 50 digits, its own error {result['reference_error_us']:.0e} us. Default of next_impact: float64, "
        f"root tolerance {result['default_root_tolerance_us']:g} us.",
        *(cheapest_sentence(choice, wanted_error_us) for choice in cheapest),
    )


def accuracy_table(rows: Sequence[dict[str, Any]]) -> "Table":
    """Return the settings as a table."""
    from rich.table import Table  # noqa: PLC0415

    table = Table(title="Error of an impact time against the time it takes (one core)")
    for heading in ("scene", "method"):
        table.add_column(heading)
    # SciPy's tolerance is relative and in nm; the map's is in us
    for heading in ("tolerance", "us/impact", "largest error us", "median us", "after sequence us", "near grazing us"):
        table.add_column(heading, justify="right")
    names = ("tolerance", "microseconds_per_impact", "error_us", "median_error_us", "sequence_error_us")
    for row in rows:
        cells = [in_digits(row.get(name)) for name in (*names, "near_grazing_error_us")]
        table.add_row(row["scene"], row["method"], *cells)
    return table


def cheapest_sentence(choice: dict[str, Any], wanted_error_us: float) -> str:
    """Say which setting is the cheapest for a scene, or that none is good enough."""
    where = "in all scenes" if choice["scene"] == "all" else f"in the scene `{choice['scene']}`"
    if choice["method"] is None:
        return f"No setting reaches {wanted_error_us:g} us {where}."
    return (
        f"Cheapest for {wanted_error_us:g} us {where}: {choice['method']}, root tolerance {choice['tolerance']:g} us "
        f"({choice['microseconds_per_impact']:.3g} us an impact, error {choice['error_us']:.1e} us)."
    )


def in_digits(value: float | None) -> str:
    """Return a number with three digits, a dash where there is none."""
    return "-" if value is None else f"{value:.3g}"
