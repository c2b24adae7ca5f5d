"""Whether a motion has settled, on what, and the window that is read of it.

Takes a scene and its simulation; gives a `Settled` (m, N, the distance that is left, without unit) and a `Window` in
us.

The criterion is on the sequence of departures (drive phase, velocity), not on a number of periods: it repeats after m
contacts in N drive periods, and what a geometric extrapolation leaves of the distance between repetitions is small.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from afm_jax.apparatus.scene import DrivePeriod, Scene, drive_of
from afm_jax.apparatus.surface import surface_of
from afm_jax.contact.contact import Contact
from afm_jax.motion.record import ContactKind, Simulation, contacts_left, contacts_of, to_gap
from afm_jax.motion.trajectory import flights_of
from afm_jax.words import counted

DEFAULT_TOLERANCE = 1e-4
HELD_PERIODS = 3.0
"""Drive periods (and free periods) after which a contact that does not end counts as a tip that is held."""
LONGEST = 32
"""Most contacts that a response may have before it counts as broadband."""
_REPETITIONS = 6
"""Repetitions in each of the two blocks whose comparison gives the rate of approach."""
_BOTH = 2.0
"""Two departures are as far apart as both together are from the motion they tend to."""
ROUNDING = 1e-8
"""Distance below which a block has arrived, its rate being rounding; not of the tolerance, lest slow motion passes."""
_LAST_FRACTION = 0.2


class Repetitions(NamedTuple):
    """How sequences of contacts repeat, arrays of one lane a sequence; ``contacts`` 0 where nothing repeats."""

    contacts: Int[np.ndarray, " lanes"]
    """m, contacts until it repeats."""
    periods: Int[np.ndarray, " lanes"]
    """N, drive periods until it repeats."""
    remaining: Float[np.ndarray, " lanes"]
    """Estimated distance from the motion it tends to; of the velocity scale, phases in rad."""


def find_repetitions(
    turns: Float[np.ndarray, "lanes contacts"],
    velocities: Float[np.ndarray, "lanes contacts"],
    *,
    tolerance: float,
    repeated: int = _REPETITIONS,
    rounding: float = ROUNDING,
) -> Repetitions:
    """Return the shortest repetition of each of many sequences of departures, closer than a tolerance.

    Two departures m contacts apart differ by a velocity and a phase. Their distance e is the largest over a block of
    some repetitions n; from the block before, q = (e/e_before)^(1/n) is the rate per repetition, and e q/(1 - q) what
    is left of the geometric series. A block takes a maximum because distances oscillate where an approach spirals. What
    repeats after a part of the m contacts, to within twice what is left, repeats after that part.

    Args:
        turns: times of the departures in drive periods.
        velocities: of the tip then, in nm/us; a sequence with NaN in its end repeats nothing.
        tolerance: largest remaining distance that counts as none.
        repeated: repetitions in each of the two blocks that are compared.
        rounding: distance below which departures are the same, and a rate of approach says nothing.
    """
    lanes, count = turns.shape
    shortest = Repetitions(np.zeros(lanes, int), np.zeros(lanes, int), np.full(lanes, np.inf))
    still_open = np.arange(lanes)
    for contacts in range(1, LONGEST + 1):
        block = repeated * contacts
        if count < 2 * block + contacts or not still_open.size:
            break
        last = slice(count - 2 * block - contacts, None)
        periods, distance = _distances(turns[still_open, last], velocities[still_open, last], contacts)
        before, now = distance[:, :block].max(axis=1), distance[:, block:].max(axis=1)
        # where something is infinite nothing repeats; a distance of 0 before is one that has arrived
        near = np.isfinite(now) & np.isfinite(before)
        rate = (np.where(near, now, 1.0) / np.where(near & (before > 0.0), before, np.inf)) ** (1.0 / repeated)
        slowly = np.where(rate < 1.0, rate / np.where(rate < 1.0, 1.0 - rate, 1.0), np.inf)
        remaining = np.where(now <= rounding, now, np.where(near, now, 1.0) * slowly)
        repeats = near & (np.maximum(now, remaining) <= tolerance)
        chosen = still_open[repeats]
        shortest.contacts[chosen], shortest.periods[chosen] = contacts, periods[repeats]
        shortest.remaining[chosen] = remaining[repeats]
        for fewer in (divisor for divisor in range(1, contacts) if contacts % divisor == 0 and chosen.size):
            # what dies away as it turns comes back after some rounds, long before one round is as near
            periods, distance = _distances(turns[chosen, last], velocities[chosen, last], fewer)
            within = distance[:, -repeated * fewer :].max(axis=1) <= _BOTH * shortest.remaining[chosen]
            shortest.contacts[chosen[within]], shortest.periods[chosen[within]] = fewer, periods[within]
            chosen = chosen[~within]
        still_open = still_open[~repeats]
    return shortest


def _distances(
    turns: np.ndarray, velocities: np.ndarray, contacts: int
) -> tuple[Float[np.ndarray, " lanes"], Float[np.ndarray, "lanes steps"]]:
    """Return N and the distances between departures m contacts apart; infinite where their N differ or are 0."""
    apart = turns[:, contacts:] - turns[:, :-contacts]
    periods = np.round(apart)
    same = (periods[:, -1] >= 1) & (periods == periods[:, -1:]).all(axis=1)
    scale = np.maximum(np.abs(velocities).max(axis=1, keepdims=True), np.finfo(float).tiny)
    angle = 2.0 * np.pi * np.abs(apart - periods)
    speed = np.abs(velocities[:, contacts:] - velocities[:, :-contacts]) / scale
    return np.where(same, periods[:, -1], 0.0), np.where(same[:, None], np.maximum(angle, speed), np.inf)


class Settled(NamedTuple):
    """Whether a motion has settled, and on what."""

    reason: str
    """In words, what was found."""
    stuck: bool = False
    """Whether the sample holds the tip to the end, for more than three periods."""
    settled: bool = True
    contacts: int | None = None
    """m of the (m, N) orbit: contacts in a response period, 0 where the tip no longer meets the sample."""
    periods: int | None = None
    """N: drive periods in a response period; None where nothing repeats, and for a tip that is held."""
    remaining: float | None = None
    """Estimated distance from the motion it tends to: largest of velocity over velocity scale and phase in rad."""


def settled(scene: Scene, simulation: Simulation, *, tolerance: float = DEFAULT_TOLERANCE) -> Settled:
    """Say whether a motion has settled, on m contacts in N drive periods.

    It has if the sequence of departures (phase of the drive, velocity) repeats after m contacts and N periods, and what
    a geometric extrapolation leaves of the distance between repetitions is below the tolerance; if the tip no longer
    meets the sample and its transient has died away; or if the sample holds it. Under a ramp or several drive
    frequencies nothing settles, but a tip may be held.

    Args:
        scene: the scene that was simulated.
        simulation: of one scene, not of a batch.
        tolerance: of the remaining distance, relative to the velocity scale; of phases in rad.

    Raises:
        ValueError: if the tolerance is not positive.
    """
    if not tolerance > 0.0:
        raise ValueError(f"`tolerance` must be positive, but is {tolerance!r}")
    drive = drive_of(scene)
    stuck = is_stuck(scene, simulation)
    if drive.aperiodic is not None:
        return Settled(("the sample holds the tip; " if stuck else "") + drive.aperiodic, stuck, settled=False)
    if stuck:
        return Settled("the sample holds the tip to the end", stuck)
    transient = _transient_of_a_free_tip(scene, simulation, drive.period_us)
    if transient is not None:
        if not transient <= tolerance:
            why = f"the tip does not meet the sample, but its transient is still {transient:.1e} of the velocity scale"
            return Settled(why, settled=False)
        where = "the tip no longer meets the sample" if scene.interaction is not None else "the cantilever is free"
        return Settled(f"{where}, and its transient has decayed", contacts=0, periods=1, remaining=transient)
    rows = contacts_left(simulation)
    turns = rows.departure_time_us[None] / drive.period_us
    found = find_repetitions(turns, rows.departure_velocity_nm_per_us[None], tolerance=tolerance)
    contacts, periods, remaining = (column[0].item() for column in found)
    if not contacts:
        why = f"no sequence of up to {LONGEST} contacts repeats to {tolerance:g} (of {turns.size} contacts)"
        return Settled(why, settled=False)
    why = f"the motion repeats: {counted(contacts, 'contact')} in {counted(periods, 'drive period')}"
    return Settled(why, contacts=contacts, periods=periods, remaining=remaining)


def is_stuck(scene: Scene, simulation: Simulation) -> bool:
    """Say whether the sample holds the tip at the end, and has for more than three drive and three free periods."""
    if not bool(simulation.held) or int(simulation.count) == 0:
        return False
    return float(simulation.final.time_us) - held_since(simulation) > HELD_PERIODS * slower_period_us(scene)


def held_since(simulation: Simulation) -> float:
    """Return when the last contact began, in us; of a tip that is held: since when."""
    return float(np.asarray(simulation.contacts.arrival_time_us)[int(simulation.count) - 1])


def slower_period_us(scene: Scene) -> float:
    """Return the longer one of a drive period and a free period."""
    return max(drive_of(scene).period_us, 2.0 * np.pi / float(scene.cantilever.angular_frequency))


def felt_nm(scene: Scene) -> float:
    """Return the gap below which a flying tip meets the sample."""
    return float(scene.interaction.bridge_forms_nm) if isinstance(scene.interaction, Contact) else 0.0


def _transient_of_a_free_tip(scene: Scene, simulation: Simulation, period_us: float) -> float | None:
    """Return the transient of a tip that cannot meet the sample any more, of the velocity scale; None where it can."""
    surface, response = surface_of(scene)
    gap, rate = (float(part) for part in to_gap(surface, response, simulation.final))
    height, speed = (float(part) for part in surface.position_and_velocity(simulation.final.time_us))
    omega = float(scene.cantilever.angular_frequency)
    size = float(np.hypot(gap + height, (rate + speed) / omega))
    highest = float(surface.offset_nm) + float(surface.reach_nm)
    if scene.interaction is not None and (bool(simulation.held) or -highest - size <= felt_nm(scene)):
        return None
    steady = 0.0 if response is None else float(response.top_speed_nm_per_us)
    moved = max(steady, float(surface.top_speed_nm_per_us), 2.0 * np.pi / period_us * 1e-3)
    return omega * size / moved


class Window(NamedTuple):
    """A stretch of time, in us, whole response periods of the drive where it is long enough."""

    from_us: float
    to_us: float
    periods: int
    """N: drive periods in a response period; where nothing repeats the nearest integer between two contacts."""
    responses: int
    """Whole response periods in the stretch; 0 where it is shorter than one."""


def window_of(scene: Scene, simulation: Simulation, verdict: Settled) -> Window:
    """Return the last response period of a settled motion, else whole response periods in the last fifth.

    The end is moved into a flight where there is one, so that no contact is cut in a motion that repeats.

    Args:
        scene: the scene.
        simulation: of one scene.
        verdict: what `settled` says of it.
    """
    drive = drive_of(scene)
    first, last = float(simulation.start.time_us), float(simulation.final.time_us)
    periods = verdict.periods or _likely_order(simulation, drive.period_us, stuck=verdict.stuck)
    response = periods * drive.period_us
    if verdict.settled and not verdict.stuck and last - first >= response:
        flights = flights_of(scene, simulation)
        end = last if verdict.contacts == 0 else flights.where(flights.end_us > last - response).middle_of_longest()
        return Window(max(end - response, first), end, periods, 1)
    return last_fifth(first, last, drive, periods)


def last_fifth(first_us: float, last_us: float, drive: DrivePeriod, periods: int = 1) -> Window:
    """Return whole response periods in the last fifth of a time; one if it is too short for that, if there is one.

    Args:
        first_us: beginning of the time.
        last_us: its end.
        drive: in whose periods to count.
        periods: N, drive periods in a response period.
    """
    span, response = last_us - first_us, periods * drive.period_us
    whole = int(_LAST_FRACTION * span / response) or int(span >= response)
    return Window(last_us - (whole * response if whole else _LAST_FRACTION * span), last_us, periods, whole)


def _likely_order(simulation: Simulation, period_us: float, *, stuck: bool) -> int:
    """Return the nearest integer to the mean number of drive periods between contacts, over the last fifth of them."""
    rows = contacts_of(simulation)
    times = rows.departure_time_us[rows.kind == ContactKind.IMPACT]
    some = times[-max(5, int(_LAST_FRACTION * len(times))) :]
    if stuck or len(some) < 2:
        return 1
    return max(1, round(float(some[-1] - some[0]) / (len(some) - 1) / period_us))
