"""`afm-jax collide [SCENE.toml] --speeds 12,15,20`: free tips through the contact."""

from typing import TYPE_CHECKING, Any

import click

from afm_jax.cli.contact_options import ContactOptions, chosen_contact, with_contact_options
from afm_jax.cli.main import NotValid
from afm_jax.cli.session import Session, with_session, write_json
from afm_jax.cli.values import Ends, Finite, Numbers
from afm_jax.words import known

if TYPE_CHECKING:
    from rich.table import Table

COLUMNS = (
    "approach_speed_nm_per_us",
    "rebound_speed_nm_per_us",
    "collision_delay_us",
    "captured",
    "outcome",
    "time_in_contact_us",
    "time_in_junction_us",
    "deepest_gap_nm",
    "bridge_hysteresis_aj",
    "junction_hysteresis_aj",
    "viscous_loss_aj",
    "end_energy_aj",
)
"""What is told of a tip."""
_SHOWN = 40


@click.command()
@with_contact_options
@click.option(
    "--speeds",
    type=Numbers("speed", example="12,15,20"),
    metavar="LIST",
    help="Approach speeds in nm/us: 12,15,20 or start:stop:step as 12:200:10 (with the stop where it fits), or both. "
    "Left out: 20 speeds from 1.1 times the capture speed to 200.",
)
@click.option(
    "--accuracy",
    type=Finite(positive=True),
    default=1e-9,
    show_default=True,
    help="Wanted relative accuracy of the rebound speed.",
)
@click.option(
    "--method",
    type=click.Choice(("diffrax", "collocation")),
    default="diffrax",
    show_default=True,
    help="How the way through the bridge is integrated.",
)
@click.option(
    "--make-law",
    is_flag=True,
    help="Make the impact law that the contact amounts to, in place of a table of collisions: with --out law.json and "
    "law.csv, which scene files and --law take, and the formulas closest to it.",
)
@click.option(
    "--speed-range",
    type=Ends(),
    metavar="LOW:HIGH",
    help="With --make-law: approach speeds of the formulas in nm/us. Left out: 1.5 times the capture speed to 250.",
)
@click.option(
    "--delay-range",
    type=Ends(),
    metavar="LOW:HIGH",
    help="With --make-law: the same for the delay's formula. Left out: 1.37 times the capture speed to 700.",
)
@click.option(
    "--residuals",
    type=click.Choice(("relative", "absolute")),
    help="With --make-law: what is made small, u_fit/u_out - 1 (this is what happens without) or u_fit - u_out.",
)
@click.option(
    "--points",
    type=click.IntRange(min=10, max=100_000),
    help="With --make-law: number of speeds that formulas are fitted to; 512 without.",
)
@with_session
def command(  # noqa: PLR0913
    session: Session,
    *,
    contact_options: ContactOptions,
    speeds: tuple[float, ...] | None,
    accuracy: float,
    method: str,
    make_law: bool,
    speed_range: tuple[float, float] | None,
    delay_range: tuple[float, float] | None,
    residuals: str | None,
    points: int | None,
) -> None:
    """Let free tips collide with a sample at rest, through liquid bridge and solid junction.

    The contact is the paper's, or that of SCENE.toml, changed by the options. Of every speed: rebound speed, collision
    delay, whether the tip is captured, times, deepest gap, and where the energy went; and the capture speed. With
    --out collide.csv, collide.json and collide.png. Captured tips are a result, even if all are; exit code 3 if the
    integration does not resolve one. With --make-law the law that the contact amounts to.
    """
    of_laws = {"--speed-range": speed_range, "--delay-range": delay_range, "--residuals": residuals, "--points": points}
    given = [name for name, value in of_laws.items() if value is not None]
    if given and not make_law:
        raise click.UsageError(f"{given[0]} is of the formulas of a law: add --make-law")
    if make_law and speeds is not None:
        raise click.UsageError("--make-law chooses its own speeds: leave --speeds out")
    if make_law:
        from afm_jax.cli import contact_law  # noqa: PLC0415

        session.start_computing()
        contact_law.make_law(
            session,
            contact_options,
            speed_range=speed_range,
            delay_range=delay_range,
            residuals=residuals or "relative",
            points=points or 512,
        )
        return
    session.start_computing("afm_jax.contact.collide:_capture_speed", "afm_jax.contact.collide:_quick")
    from afm_jax.contact.collide import collisions  # noqa: PLC0415

    contact, mass, description = chosen_contact(contact_options)
    with session.working("colliding (the first run compiles for some seconds)"):
        result = collisions(contact, speeds, mass, accuracy=accuracy, method=method)
    rows = result.rows
    payload = {
        **{name: [row[name] for row in rows] for name in COLUMNS},
        "capture_speed_nm_per_us": result.capture_speed_nm_per_us,
        "capture_speed_reason": result.capture_speed_reason,
        "junction": result.junction,
        "contact": description,
        "mass_ng": mass,
        "settings": {"accuracy": accuracy, "method": method, "default_speeds": speeds is None},
    }
    session.write_table("collide.csv", rows, COLUMNS)
    if session.out is not None:
        from afm_jax.plots.collisions import draw_collisions  # noqa: PLC0415

        write_json(session.out / "collide.json", payload)
        title = f"Collisions of a free tip of {mass:g} ng: {', '.join(description['effects'])}"
        draw_collisions(rows, result.capture_speed_nm_per_us, session.out / "collide.png", title=title)
        session.note(f"wrote {session.out / 'collide.json'} and {session.out / 'collide.png'}")
    session.emit(payload, collision_table(rows), *sentences(payload))
    if result.unresolved:
        raise NotValid(f"{len(result.unresolved)} of {len(rows)} collisions: {result.unresolved[0]}")


def collision_table(rows: list[dict[str, Any]]) -> "Table":
    """Return the collisions as a table to print."""
    from rich.table import Table  # noqa: PLC0415

    table = Table(title="Collisions of a free tip with the sample at rest", title_justify="left")
    headings = (("approach", "nm/us"), ("rebound", "nm/us"), ("delay", "us"), ("in junction", "us"))
    headings += (("deepest gap", "nm"), ("bridge", "aJ lost"), ("junction", "aJ lost"), ("viscous", "aJ lost"))
    for name, unit in headings:
        table.add_column(f"{name}\n{unit}", justify="right")
    table.add_column("outcome")
    names = ("approach_speed_nm_per_us", "rebound_speed_nm_per_us", "collision_delay_us", "time_in_junction_us")
    names += ("deepest_gap_nm", "bridge_hysteresis_aj", "junction_hysteresis_aj", "viscous_loss_aj")
    for row in rows[:_SHOWN]:
        table.add_row(*(known(row[name], ".6g") for name in names), row["outcome_name"])
    return table


def sentences(payload: dict[str, Any]) -> list[str]:
    """Return what is said below the table: the capture speed, the junction, and what the outcomes mean."""
    junction, speeds, captured = payload["junction"], payload["approach_speed_nm_per_us"], payload["captured"]
    lines = []
    if len(speeds) > _SHOWN:
        lines.append(f"The first {_SHOWN} of {len(speeds)} collisions; --json and --out give all.")
    lines += sorted(set(payload["outcome"]))
    capture = payload["capture_speed_nm_per_us"]
    if all(captured):
        lines.append(f"All of these tips are captured{'; faster ones leave again' if capture else ''}.")
    lines.append(payload["capture_speed_reason"] or f"Capture speed: {capture:.6g} nm/us.")
    lines.append(
        f"The junction forms at a gap of {junction['forms_gap_nm']:.4g} nm and breaks at "
        f"{junction['breaks_gap_nm']:.4g} nm; hysteresis takes {junction['hysteresis_aj']:.4g} aJ: "
        f"{junction['bridge_hysteresis_aj']:.4g} in the bridge, {junction['junction_hysteresis_aj']:.4g} in the "
        "junction."
    )
    return lines
