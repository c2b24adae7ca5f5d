"""Whether a simulated motion has settled: a criterion on its contacts, not a number of periods."""

from typing import NamedTuple

import numpy as np

from afm_jax.apparatus.scene import Scene
from afm_jax.apparatus.surface import surface_of
from afm_jax.contact.contact import Contact
from afm_jax.motion.drive_period import drive_of
from afm_jax.motion.frames import to_gap
from afm_jax.motion.record import ContactKind, Simulation
from afm_jax.motion.response_order import LONGEST, find_repetition

DEFAULT_TOLERANCE = 1e-4
HELD_PERIODS = 3.0
"""Drive periods (and free periods) after which a contact that does not end counts as a tip that is held."""


class Settled(NamedTuple):
    """Whether a motion has settled, and on what."""

    settled: bool
    contacts: int | None
    """m of the (m, N) orbit: contacts in a response period, 0 where the tip no longer meets the sample."""
    periods: int | None
    """N: drive periods in a response period; None where nothing repeats, and for a tip that is held."""
    stuck: bool
    """Whether the sample holds the tip to the end, for more than three periods."""
    remaining: float | None
    """Estimated distance from the motion it tends to: largest of velocity over velocity scale and phase in rad."""
    reason: str
    """In words, what was found."""


def settled(
    scene: Scene, simulation: Simulation, *, tolerance: float = DEFAULT_TOLERANCE, longest: int = LONGEST
) -> Settled:
    """Say whether a motion has settled, on m contacts in N drive periods.

    It has if the sequence of departures (phase of the drive, velocity) repeats after m contacts and N periods, and what
    a geometric extrapolation leaves of the distance between repetitions is below the tolerance; if the tip no longer
    meets the sample and its transient has died away; or if the sample holds it. Under a ramp or several drive
    frequencies nothing settles, but a tip may be held.

    Args:
        scene: the scene that was simulated.
        simulation: of one scene, not of a batch.
        tolerance: of the remaining distance, relative to the velocity scale; of phases in rad.
        longest: largest m to try.

    Raises:
        ValueError: if the tolerance is not positive.
    """
    if not tolerance > 0.0:
        raise ValueError(f"`tolerance` must be positive, but is {tolerance!r}")
    drive = drive_of(scene)
    stuck = is_stuck(scene, simulation)
    if drive.aperiodic is not None:
        held = "the sample holds the tip; " if stuck else ""
        return _not(held + drive.aperiodic, stuck=stuck)
    if stuck:
        return _settled("the sample holds the tip to the end", stuck=True)
    free = _free_of_the_sample(scene, simulation, drive.period_us)
    if free is not None:
        if free <= tolerance:
            where = "the tip no longer meets the sample" if scene.interaction is not None else "the cantilever is free"
            why = f"{where}, and its transient has decayed"
            return _settled(why, contacts=0, periods=1, remaining=free)
        return _not(f"the tip does not meet the sample, but its transient is still {free:.1e} of the velocity scale")
    rows = simulation.contacts
    left = np.isin(np.asarray(rows.kind), (ContactKind.IMPACT, ContactKind.CHATTER))
    times, velocities = (np.asarray(part)[left] for part in (rows.departure_time_us, rows.departure_velocity_nm_per_us))
    found = find_repetition(times, velocities, drive.period_us, tolerance=tolerance, longest=longest)
    if found is None:
        return _not(f"no sequence of up to {longest} contacts repeats to {tolerance:g} (of {len(times)} contacts)")
    what = f"{found.contacts} contact{'s' if found.contacts > 1 else ''} in {found.periods} drive period"
    why = f"the motion repeats: {what}{'s' if found.periods > 1 else ''}"
    return _settled(why, contacts=found.contacts, periods=found.periods, remaining=found.remaining)


def _settled(
    reason: str,
    *,
    contacts: int | None = None,
    periods: int | None = None,
    stuck: bool = False,
    remaining: float | None = None,
) -> Settled:
    return Settled(settled=True, contacts=contacts, periods=periods, stuck=stuck, remaining=remaining, reason=reason)


def _not(reason: str, *, stuck: bool = False) -> Settled:
    return Settled(settled=False, contacts=None, periods=None, stuck=stuck, remaining=None, reason=reason)


def is_stuck(scene: Scene, simulation: Simulation) -> bool:
    """Say whether the sample holds the tip at the end, and has for more than three drive and three free periods."""
    if not bool(simulation.held) or int(simulation.count) == 0:
        return False
    since = float(np.asarray(simulation.contacts.arrival_time_us)[int(simulation.count) - 1])
    free_period = 2.0 * np.pi / float(scene.cantilever.angular_frequency)
    long = HELD_PERIODS * max(drive_of(scene).period_us, free_period)
    return float(simulation.final.time_us) - since > long


def _free_of_the_sample(scene: Scene, simulation: Simulation, period_us: float) -> float | None:
    """Return the transient of a tip that cannot meet the sample any more, of the velocity scale; None where it can."""
    surface, response = surface_of(scene)
    gap, rate = (float(part) for part in to_gap(surface, response, simulation.final))
    height, speed = (float(part) for part in surface.position_and_velocity(simulation.final.time_us))
    omega = float(scene.cantilever.angular_frequency)
    size = float(np.hypot(gap + height, (rate + speed) / omega))
    if scene.interaction is not None:
        level = float(scene.interaction.bridge_forms_nm) if isinstance(scene.interaction, Contact) else 0.0
        highest = float(surface.offset_nm) + float(surface.reach_nm)
        if bool(simulation.held) or -highest - size <= level:
            return None
    steady = 0.0 if response is None else float(response.top_speed_nm_per_us)
    moved = max(steady, float(surface.top_speed_nm_per_us), 2.0 * np.pi / period_us * 1e-3)
    return omega * size / moved
