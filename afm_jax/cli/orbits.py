"""`afm-jax orbits SCENE.toml|PRESET --order N [--impacts m]`: the orbits of a scene."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from rich.table import Table

from afm_jax.apparatus.scene import Scene, drive_of
from afm_jax.cli.columns import TableColumn, columns_of, printed_table
from afm_jax.cli.command import NamedScene, Output, later
from afm_jax.cli.session import Session
from afm_jax.contact.contact import Contact
from afm_jax.dynamics.contact_orbits import contact_orbits
from afm_jax.dynamics.impact_loop import LoopReading
from afm_jax.dynamics.impact_orbits import is_stable, many_impact_orbits, multipliers_of
from afm_jax.dynamics.sticking_orbits import sticking_orbit
from afm_jax.impact.law import Law
from afm_jax.impact.orbits import SingleImpactOrbits, single_impact_orbits
from afm_jax.scenefile.scenefile import scene_tables
from afm_jax.words import counted

save = later("afm_jax.plots.picture_style:save")

DRIVEN_COLUMNS = (
    "drive_lockin_amplitude_nm",
    "drive_lockin_phase_deg",
    "phase_lag_deg",
    "peak_deflection_nm",
    "deflection_lockin_amplitude_nm",
    "deflection_lockin_phase_deg",
    "deflection_drive_lockin_amplitude_nm",
    "deflection_drive_lockin_phase_deg",
)
"""What is told besides of a tip that base or force drives; the deflection's over a moving base only."""

IMPACT_COLUMNS = (
    "phase_rad",
    "velocity_after_nm_per_us",
    "velocity_before_nm_per_us",
    "approach_speed_nm_per_us",
    "rebound_speed_nm_per_us",
    "delay_us",
)
"""What is told of each impact: attributes of `LoopReading`."""

COLUMNS = (
    *IMPACT_COLUMNS,
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

MANY_COLUMNS = (*IMPACT_COLUMNS, "peak_amplitude_nm", "trace", "determinant", "stable", "admissible")
"""What is told of an orbit of several impacts, of its impacts the first."""

_IMPACT_CELLS = (
    TableColumn("phase\nrad", "phase_rad"),
    TableColumn("velocity after\nnm/us", "velocity_after_nm_per_us"),
    TableColumn("approach\nnm/us", "approach_speed_nm_per_us"),
    TableColumn("rebound\nnm/us", "rebound_speed_nm_per_us"),
    TableColumn("delay\nus", "delay_us"),
)


def orbits(session: Session, scene: NamedScene, *, order: int, impacts: int | None) -> Output:
    """Return the single-impact orbits of a scene; of a contact, or with ``impacts``, those of several impacts."""
    if impacts is not None or isinstance(scene.scene.interaction, Contact):
        return _many(session, scene.scene, scene.name, order, impacts or 1)
    refuse_other_than_law(scene.scene, scene.name)
    with session.working("searching for orbits"):
        result = single_impact_orbits(scene.scene, order)
    rows = orbit_rows(result)
    reason = None
    if not any(orbit["admissible"] for orbit in rows):
        reason = why_none(scene.scene, order, rejected=len(rows))
    if not bool(result.complete):
        session.note("there are more orbits than could be listed; the slowest are shown")
    title = f"Orbits with one impact in {counted(order, 'drive period')}"
    fold = "Two of them nearly coincide (a fold): derivatives there have no meaning."
    return Output(
        payload={
            "order": order,
            "scene": scene_tables(scene.scene),
            "orbits": rows,
            "complete": result.complete,
            "reason": reason,
        },
        text=[orbit_table(rows, title=title), fold if any(orbit["near_double"] for orbit in rows) else None],
        impact_speeds=[orbit["approach_speed_nm_per_us"] for orbit in rows],
        tables={"orbits.csv": columns_of(rows, names_of(result))},
        files={"orbits.png": lambda path: save(result.plot(), path)},
        not_valid=reason,
    )


def refuse_other_than_law(scene: Scene, path: str) -> None:
    """Check that a scene's interaction is a law.

    Raises:
        ValueError: if not; says what gives one.
    """
    if isinstance(scene.interaction, Law):
        return
    absent = scene.interaction is None
    advice = (
        "a tip that meets nothing has none"
        if absent
        else f"`afm-jax collide {path} --make-law --out DIR` gives a contact's law"
    )
    raise ValueError(
        f'{path}: [interaction] model: must be "law" here, but is "{"none" if absent else "contact"}"; {advice}'
    )


def _many(session: Session, scene: Scene, name: str, order: int, impacts: int) -> Output:
    """Return the orbits of several impacts, or of a resolved contact."""
    resolved = isinstance(scene.interaction, Contact)
    if not resolved:
        refuse_other_than_law(scene, name)
    with session.working("searching for orbits (the first run compiles for some seconds)"):
        if resolved:
            result, resting = contact_orbits(scene, order, impacts), "a tip that the liquid bridge holds stays"
        else:
            result, resting = many_impact_orbits(scene, order, impacts), sticking_orbit(scene)
    orbits = [orbit_facts(result.reading, index) for index in range(len(result.stable))]
    rests = None if isinstance(resting, str) else resting._asdict()
    reason = None
    if not orbits and (rests is None or rests["order"] != order):
        reason = why_none(scene, order, rejected=0, impacts=impacts)
    rows = [{"orbit": k, **impact} for k, orbit in enumerate(orbits) for impact in orbit["impacts"]]
    title = f"Orbits with {counted(impacts, 'impact')} in {counted(order, 'drive period')}"
    return Output(
        payload={
            "order": order,
            "impacts": impacts,
            "scene": scene_tables(scene),
            "orbits": orbits,
            "sticking": rests,
            "sticking_reason": resting if rests is None else None,
            "reason": reason,
        },
        text=[
            many_table(orbits, title=title),
            f"No orbit with a rest: {resting}." if rests is None else _resting_words(rests),
        ],
        impact_speeds=[row["approach_speed_nm_per_us"] for row in rows],
        tables={
            "orbits.csv": columns_of([{**orbit, **orbit["impacts"][0]} for orbit in orbits], MANY_COLUMNS),
            "impacts.csv": columns_of(rows, ("orbit", *IMPACT_COLUMNS)),
        },
        files={"orbits.png": lambda path: save(result.plot(), path)},
        not_valid=reason,
    )


def _resting_words(rests: Mapping[str, Any]) -> str:
    return (
        f"Orbit with a rest on the sample: it repeats after {rests['order']} drive periods, peak "
        f"{rests['peak_amplitude_nm']:.6g} nm; the sample lets go at a drive phase of {rests['release_phase_rad']:.6g} "
        f"rad, {rests['impacts']} impacts were followed one by one, the rest of them and the rest take "
        f"{rests['rest_us']:.4g} us. Its multipliers are 0."
    )


def impact_rows(reading: LoopReading, index: int | None = None) -> list[dict[str, float]]:
    """Return what is told of each impact of an orbit; of one of many, or of the only one."""
    columns = {name: getattr(reading, name) for name in IMPACT_COLUMNS}
    lists = {name: (values if index is None else values[index]).tolist() for name, values in columns.items()}
    return [dict(zip(lists, values, strict=True)) for values in zip(*lists.values(), strict=True)]


def orbit_facts(reading: LoopReading, index: int) -> dict[str, Any]:
    """Return what is told of one orbit of several impacts: the first one's numbers, and all in `impacts`."""
    trace, determinant = float(reading.trace[index]), float(reading.determinant[index])
    multipliers = multipliers_of(np.asarray(trace), np.asarray(determinant))
    impacts = impact_rows(reading, index)
    first = impacts[0] if impacts else dict.fromkeys(IMPACT_COLUMNS)
    return {
        "phase_rad": first["phase_rad"],
        "velocity_after_nm_per_us": first["velocity_after_nm_per_us"],
        "peak_amplitude_nm": float(reading.peak_amplitude_nm[index]),
        "trace": trace,
        "determinant": determinant,
        "multipliers": [[float(each.real), float(each.imag)] for each in multipliers],
        "stable": bool(is_stable(multipliers)),
        "admissible": bool(reading.admissible[index]),
        "impacts": impacts,
    }


def names_of(result: SingleImpactOrbits) -> tuple[str, ...]:
    """Return what is told of orbits: what their scene has."""
    return (*COLUMNS, *(name for name in (*DRIVEN_COLUMNS, "extrapolated") if getattr(result, name) is not None))


def orbit_rows(result: SingleImpactOrbits) -> list[dict[str, Any]]:
    """Return the orbits that exist as one dict of plain numbers each, by rising approach speed."""
    columns = {name: getattr(result, name).tolist() for name in names_of(result)}
    slots = [slot for slot, exists in enumerate(result.exists.tolist()) if exists]
    return [{name: values[slot] for name, values in columns.items()} for slot in slots]


def why_none(scene: Scene, order: int, *, rejected: int, impacts: int = 1) -> str:
    """Return a sentence on why a scene has no admissible orbit of an order, and what to try.

    Args:
        scene: a scene with an impact law.
        order: N, drive periods between impacts.
        rejected: how many orbits would close if the tip could pass through the platform.
        impacts: m, impacts in an orbit.
    """
    if float(getattr(scene.interaction, "r", 1.0)) == 0.0:
        return "with r = 0 every impact is a capture: no orbit leaves the sample; `afm-jax simulate` follows the tip"
    if impacts > 1:
        return (
            f"the search found no orbit of {impacts} impacts in {order} drive periods; `afm-jax orbits --order` and "
            "`afm-jax continue` say where orbits of one impact double their period"
        )
    reduced = float(drive_of(scene).angular_frequency) / (2.0 * float(scene.cantilever.angular_frequency))
    nearest = max(1, round(reduced))
    what = (
        f"in every orbit of order {order} the tip would have to pass through the platform"
        if rejected
        else f"there is no orbit of order {order}"
    )
    if nearest != order:
        return f"{what}; the drive is at {reduced:.4g} times twice the free frequency: try --order {nearest}"
    return f"{what}; try a larger drive amplitude, another offset or a drive nearer to resonance"


def orbit_table(orbits: Sequence[Mapping[str, Any]], *, title: str) -> Table:
    """Return orbits as a table to print; where base or force drive with what is read at the drive's frequency."""
    columns = [*_IMPACT_CELLS, TableColumn("peak\nnm", "peak_amplitude_nm")]
    if orbits and "drive_lockin_amplitude_nm" in orbits[0]:
        columns.append(TableColumn("at drive\nnm", "drive_lockin_amplitude_nm"))
        columns.append(TableColumn("at drive\ndeg", "drive_lockin_phase_deg"))
        if "peak_deflection_nm" in orbits[0]:
            columns.append(TableColumn("deflection\nat drive nm", "deflection_drive_lockin_amplitude_nm"))
        columns.append(TableColumn("lag\ndeg", "phase_lag_deg"))
    else:
        columns += [TableColumn("lock-in\nnm", "lockin_amplitude_nm"), TableColumn("lock-in\ndeg", "lockin_phase_deg")]
    columns += [TableColumn(f"{name}\n", name) for name in ("trace", "determinant")]
    columns += [TableColumn(name, name, "yes", left=True) for name in ("stable", "admissible")]
    return printed_table(title, columns, orbits)


def many_table(orbits: Sequence[Mapping[str, Any]], *, title: str) -> Table:
    """Return orbits of several impacts as a table to print, a line an impact; the orbit's own numbers in its first."""

    def of_orbit(heading: str, cell: Callable[[Any], str]) -> TableColumn:
        return TableColumn(heading, lambda row: cell(row["whole"]) if row["first"] else "", "")

    rows = [
        {**impact, "whole": {**orbit, "number": number}, "first": place == 0}
        for number, orbit in enumerate(orbits)
        for place, impact in enumerate(orbit["impacts"])
    ]
    columns = [
        of_orbit("orbit", lambda orbit: str(orbit["number"])),
        *_IMPACT_CELLS,
        of_orbit("peak\nnm", lambda orbit: f"{orbit['peak_amplitude_nm']:.6g}"),
        of_orbit("multipliers", lambda orbit: ", ".join(map(_multiplier, orbit["multipliers"]))),
        of_orbit("stable", lambda orbit: "yes" if orbit["stable"] else "no"),
    ]
    return printed_table(title, columns, rows)


def _multiplier(parts: Sequence[float]) -> str:
    return f"{complex(*parts):.4g}" if parts[1] else f"{parts[0]:.4g}"
