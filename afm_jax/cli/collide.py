"""`afm-jax collide [SCENE.toml] --speeds 12,15,20`: free tips through the contact."""

from typing import Any

from afm_jax.cli.columns import TableColumn, columns_of, printed_table
from afm_jax.cli.command import Output, picture_of
from afm_jax.cli.contact_law import make_law as law_of
from afm_jax.cli.contact_options import chosen_contact
from afm_jax.cli.session import Session
from afm_jax.contact.collide import collisions

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
_PRINTED = (
    TableColumn("approach\nnm/us", "approach_speed_nm_per_us"),
    TableColumn("rebound\nnm/us", "rebound_speed_nm_per_us"),
    TableColumn("delay\nus", "collision_delay_us"),
    TableColumn("in junction\nus", "time_in_junction_us"),
    TableColumn("deepest gap\nnm", "deepest_gap_nm"),
    TableColumn("bridge\naJ lost", "bridge_hysteresis_aj"),
    TableColumn("junction\naJ lost", "junction_hysteresis_aj"),
    TableColumn("viscous\naJ lost", "viscous_loss_aj"),
    TableColumn("outcome", "outcome_name", "", left=True),
)
_MOST_PRINTED = 40
"""Tips in the printed table at most."""


def collide(
    session: Session,
    *,
    speeds: tuple[float, ...] | None,
    accuracy: float,
    method: str,
    make_law: bool,
    **options: Any,
) -> Output:
    """Return the collisions of free tips with a contact; with ``make_law`` the law that the contact amounts to."""
    if make_law:
        return law_of(session, **options)
    contact, mass, description = chosen_contact(options)
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
    title = f"Collisions of a free tip of {mass:g} ng: {', '.join(description['effects'])}"
    return Output(
        payload=payload,
        text=[
            printed_table("Collisions of a free tip with the sample at rest", _PRINTED, rows[:_MOST_PRINTED]),
            *sentences(payload),
        ],
        tables={"collide.csv": columns_of(rows, COLUMNS)},
        files={"collide.png": picture_of("collisions:collisions_figure", rows, result.capture_speed_nm_per_us, title)},
        json_file="collide.json",
        not_valid=f"{len(result.unresolved)} of {len(rows)} collisions: {result.unresolved[0]}"
        if result.unresolved
        else None,
    )


def sentences(payload: dict[str, Any]) -> list[str]:
    """Return what is said below the table: the capture speed, the junction, and what the outcomes mean."""
    junction, speeds, captured = payload["junction"], payload["approach_speed_nm_per_us"], payload["captured"]
    lines = []
    if len(speeds) > _MOST_PRINTED:
        lines.append(f"The first {_MOST_PRINTED} of {len(speeds)} collisions; --json and --out give all.")
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
