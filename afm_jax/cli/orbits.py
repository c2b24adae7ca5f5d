"""`afm-jax orbits SCENE.toml --order N`: all single-impact orbits of a scene."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from afm_jax.cli.main import NotValid
from afm_jax.cli.session import Session, with_session

if TYPE_CHECKING:
    from rich.table import Table

    from afm_jax.apparatus.scene import Scene
    from afm_jax.impact.orbits import SingleImpactOrbits

COLUMNS = (
    "phase_rad",
    "velocity_after_nm_per_us",
    "velocity_before_nm_per_us",
    "approach_speed_nm_per_us",
    "rebound_speed_nm_per_us",
    "delay_us",
    "peak_amplitude_nm",
    "lockin_amplitude_nm",
    "lockin_phase_deg",
    "trace",
    "determinant",
    "stable",
    "admissible",
    "near_double",
)
"""What is told of an orbit: attributes of `SingleImpactOrbits`."""


class PositiveInteger(click.ParamType):
    """An integer from 1 to a million."""

    name = "integer"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> int:
        """Return the integer that a text says.

        Raises:
            click.BadParameter: if it is none, or none in the range.
        """
        text = str(value).strip()
        if not (text.isascii() and text.isdigit() and len(text) < 8 and 1 <= int(text) <= 1_000_000):
            self.fail(f"must be a positive integer up to 1000000, but is {value}", param, ctx)
        return int(text)


@click.command()
@click.argument("scene", metavar="SCENE.toml", type=click.Path(path_type=Path))
@click.option(
    "--order",
    metavar="N",
    required=True,
    type=PositiveInteger(),
    help="Drive periods between two impacts, a positive integer.",
)
@with_session
def command(session: Session, scene: Path, order: int) -> None:
    """Find all single-impact orbits of a scene.

    Of every orbit: impact phase and velocities, peak and lock-in amplitude, whether it is stable, and whether it is
    admissible (its flight stays above the platform). With --out a table orbits.csv. Exit code 3 if none is admissible.
    """
    session.start_computing()
    from afm_jax.impact.law import ImpactLaw  # noqa: PLC0415
    from afm_jax.impact.orbits import single_impact_orbits  # noqa: PLC0415
    from afm_jax.scenefile.scenefile import load_scene, scene_tables  # noqa: PLC0415

    loaded = load_scene(scene)
    if not isinstance(loaded.interaction, ImpactLaw):
        absent = loaded.interaction is None
        advice = "a tip that meets nothing has none" if absent else f"`afm-jax fit-law {scene}` gives a contact's law"
        model = "none" if absent else "contact"
        raise ValueError(  # noqa: TRY004
            f'{scene}: [interaction] model: must be "law" here, but is "{model}"; {advice}'
        )
    try:
        with session.working("searching for orbits"):
            found = single_impact_orbits(loaded, order)
    except ValueError as error:
        raise ValueError(f"{scene}: {error}") from error
    orbits = orbit_rows(found)
    reason = None if any(orbit["admissible"] for orbit in orbits) else why_none(loaded, order, rejected=len(orbits))
    near_fold = any(orbit["near_double"] for orbit in orbits)
    if not bool(found.complete):
        session.note("there are more orbits than could be listed; the slowest are shown")
    session.write_table("orbits.csv", orbits, COLUMNS)
    session.emit(
        {
            "order": order,
            "scene": scene_tables(loaded),
            "orbits": orbits,
            "complete": found.complete,
            "reason": reason,
        },
        orbit_table(orbits, title=f"Orbits with one impact in {order} drive period{'s' if order > 1 else ''}"),
        *(["Two of them nearly coincide (a fold): derivatives there have no meaning."] if near_fold else []),
    )
    if reason is not None:
        raise NotValid(reason)


def orbit_rows(found: "SingleImpactOrbits") -> list[dict[str, Any]]:
    """Return the orbits that exist as one dict of plain numbers each, by rising approach speed."""
    columns = {name: getattr(found, name).tolist() for name in COLUMNS}
    slots = [slot for slot, exists in enumerate(found.exists.tolist()) if exists]
    return [{name: values[slot] for name, values in columns.items()} for slot in slots]


def why_none(scene: "Scene", order: int, *, rejected: int) -> str:
    """Return a sentence on why a scene has no admissible orbit of an order, and what to try.

    Args:
        scene: a scene with an impact law.
        order: N, drive periods between impacts.
        rejected: how many orbits would close if the tip could pass through the platform.
    """
    reduced = float(scene.platform.frequency_khz) / (2.0 * float(scene.cantilever.frequency_khz))
    nearest = max(1, round(reduced))
    what = (
        f"in every orbit of order {order} the tip would have to pass through the platform"
        if rejected
        else f"there is no orbit of order {order}"
    )
    if nearest != order:
        return f"{what}; the drive is at {reduced:.4g} times twice the free frequency: try --order {nearest}"
    return f"{what}; try a larger drive amplitude, another offset or a drive nearer to resonance"


def orbit_table(orbits: Sequence[Mapping[str, Any]], *, title: str) -> "Table":
    """Return the orbits as a table to print."""
    from rich.table import Table  # noqa: PLC0415

    table = Table(title=title, title_justify="left")
    table.add_column("phase\nrad", justify="right")
    for name, unit in (("velocity after", "nm/us"), ("approach", "nm/us"), ("rebound", "nm/us"), ("delay", "us")):
        table.add_column(f"{name}\n{unit}", justify="right")
    for name, unit in (("peak", "nm"), ("lock-in", "nm"), ("lock-in", "deg"), ("trace", ""), ("determinant", "")):
        table.add_column(f"{name}\n{unit}", justify="right")
    table.add_column("stable")
    table.add_column("admissible")
    shown = ("phase_rad", "velocity_after_nm_per_us", "approach_speed_nm_per_us", "rebound_speed_nm_per_us", "delay_us")
    shown += ("peak_amplitude_nm", "lockin_amplitude_nm", "lockin_phase_deg", "trace", "determinant")
    for orbit in orbits:
        words = ("yes" if orbit[name] else "no" for name in ("stable", "admissible"))
        table.add_row(*(f"{orbit[name]:.6g}" for name in shown), *words)
    return table
