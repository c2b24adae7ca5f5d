"""Following a motion: piece by piece, until it is over, has settled, or is enough; and the orbit that it settles on.

A piece ends at a departure, and the next one continues from there, so that no contact is cut in two and counted twice.
Whether a motion has settled is a criterion on its contacts, not a number of periods. Newton's method on the map of one
response period ends a transient, however slowly it decays.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from afm_jax.apparatus.scene import DrivePeriod, Scene, drive_of
from afm_jax.apparatus.surface import surface_of
from afm_jax.contact.contact import Contact
from afm_jax.contact.junction import Phase, explain_missing_junction, find_junction
from afm_jax.motion.record import ContactKind, MotionOutcome, Simulation, State, to_gap
from afm_jax.motion.simulate import DEFAULT_ACCURACY, simulate
from afm_jax.motion.trajectory import flights_of, state_at

DEFAULT_TOLERANCE = 1e-4
HELD_PERIODS = 3.0
"""Drive periods (and free periods) after which a contact that does not end counts as a tip that is held."""
LONGEST = 32
"""Most contacts that a response may have before it counts as broadband."""
_REPETITIONS = 6
"""Repetitions in each of the two blocks whose comparison gives the rate of approach."""
_BOTH = 2.0
"""Two departures of a motion that tends to one are as far apart as each is from it, together."""
ROUNDING = 1e-8
"""Distance below which a block has arrived, its rate being rounding; not of the tolerance, lest slow motion passes."""
_LAST_SHARE = 0.2
_PIECE_PERIODS = 256
"""Periods of the fastest motion in a piece."""
_ROOM = 1040
"""Contacts in a piece: four for every period, as `simulate` reckons."""
_LITTLE = 1.001
"""What is left is followed with the piece before, if it is next to nothing."""
_HELD_LONG_ENOUGH = 12.0
"""Drive periods (and free periods) for which a tip that is held is followed, where the end is left open: reading what
it does takes longer than following it."""
_GOES_ON = (MotionOutcome.FINISHED, MotionOutcome.HELD, MotionOutcome.CONTACT_LIMIT)
_ORBIT_PIECE = 50.0
"""Drive periods after which a motion is looked at: is it near an orbit?"""
_LONGEST_RESPONSE = 12
"""Drive periods."""
_NEAR = 0.05
"""Distance, of the tip's largest speed, within which an orbit belongs to a simulated motion."""
_OVERSHOOT = 4.0
_CLOSED = 1e-9
"""Distance from closing, of the tip's largest speed, at which an orbit is found."""
_NEWTON_STEPS = 12
_DIFFERENCE = 1e-5
"""Of the tip's largest speed: between the error of a simulated period, 1e-9 of it, and the map's curvature."""
_ATTRACTS = 1.0 - 1e-7
_LAST_FLIGHTS = 12

Run = Callable[[State, float], Simulation]
"""Of a start and a duration in us: the motion of one scene."""


class Repetition(NamedTuple):
    """How a sequence of contacts repeats."""

    contacts: int
    """m, contacts until it repeats."""
    periods: int
    """N, drive periods until it repeats."""
    remaining: float
    """Estimated distance from the motion it tends to; of the velocity scale, phases in rad."""


def find_repetition(
    times_us: Float[np.ndarray, " contacts"],
    velocities: Float[np.ndarray, " contacts"],
    period_us: float,
    *,
    tolerance: float,
    longest: int = LONGEST,
) -> Repetition | None:
    """Return the shortest repetition of a sequence of departures, closer than a tolerance; None if there is none.

    Two departures m contacts apart differ by a velocity and a phase. Their distance e is the largest over a block of
    six repetitions; from the block before, q = (e/e_before)^(1/6) is the rate per repetition, and e q/(1 - q) what is
    left of the geometric series. A block takes a maximum because distances oscillate where an approach spirals. What
    repeats after a part of the m contacts, to within twice what is left, repeats after that part.

    Args:
        times_us: when each contact ended, in order.
        velocities: velocity of the tip then, in nm/us.
        period_us: of the drive.
        tolerance: largest remaining distance that counts as none.
        longest: largest m to try.
    """
    turns = np.asarray(times_us)[None] / period_us
    found = find_repetitions(turns, np.asarray(velocities)[None], tolerance=tolerance, longest=longest)
    if not found.contacts[0]:
        return None
    return Repetition(int(found.contacts[0]), int(found.periods[0]), float(found.remaining[0]))


class Repetitions(NamedTuple):
    """`Repetition` of many sequences, arrays of one lane a sequence; ``contacts`` 0 where nothing repeats."""

    contacts: Int[np.ndarray, " lanes"]
    periods: Int[np.ndarray, " lanes"]
    remaining: Float[np.ndarray, " lanes"]


def find_repetitions(
    turns: Float[np.ndarray, "lanes contacts"],
    velocities: Float[np.ndarray, "lanes contacts"],
    *,
    tolerance: float,
    longest: int = LONGEST,
    repeated: int = _REPETITIONS,
    rounding: float = ROUNDING,
) -> Repetitions:
    """Return the shortest repetition of each of many sequences, as `find_repetition` does.

    Args:
        turns: times of the departures in drive periods.
        velocities: as there; a sequence with NaN in its end repeats nothing.
        tolerance: as there.
        longest: as there.
        repeated: repetitions in each of the two blocks that are compared.
        rounding: distance below which departures are the same, and a rate of approach says nothing.
    """
    lanes, count = turns.shape
    found = Repetitions(np.zeros(lanes, int), np.zeros(lanes, int), np.full(lanes, np.inf))
    left = np.arange(lanes)
    for contacts in range(1, longest + 1):
        block = repeated * contacts
        if count < 2 * block + contacts or not left.size:
            break
        last = slice(count - 2 * block - contacts, None)
        periods, distance = _steps(turns[left, last], velocities[left, last], contacts)
        before, now = distance[:, :block].max(axis=1), distance[:, block:].max(axis=1)
        # where something is infinite nothing repeats; a distance of 0 before is one that has arrived
        near = np.isfinite(now) & np.isfinite(before)
        rate = (np.where(near, now, 1.0) / np.where(near & (before > 0.0), before, np.inf)) ** (1.0 / repeated)
        slowly = np.where(rate < 1.0, rate / np.where(rate < 1.0, 1.0 - rate, 1.0), np.inf)
        remaining = np.where(now <= rounding, now, np.where(near, now, 1.0) * slowly)
        repeats = near & (np.maximum(now, remaining) <= tolerance)
        chosen = left[repeats]
        found.contacts[chosen], found.periods[chosen] = contacts, periods[repeats]
        found.remaining[chosen] = remaining[repeats]
        for fewer in (part for part in range(1, contacts) if contacts % part == 0 and chosen.size):
            # what dies away as it turns comes back after some rounds, long before one round is as near
            periods, distance = _steps(turns[chosen, last], velocities[chosen, last], fewer)
            within = distance[:, -repeated * fewer :].max(axis=1) <= _BOTH * found.remaining[chosen]
            found.contacts[chosen[within]], found.periods[chosen[within]] = fewer, periods[within]
            chosen = chosen[~within]
        left = left[~repeats]
    return found


def _steps(
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
    return float(simulation.final.time_us) - held_since(simulation) > HELD_PERIODS * _slower_period_us(scene)


def held_since(simulation: Simulation) -> float:
    """Return when the last contact began, in us; of a tip that is held: since when."""
    return float(np.asarray(simulation.contacts.arrival_time_us)[int(simulation.count) - 1])


def _slower_period_us(scene: Scene) -> float:
    """Return the longer one of a drive period and a free period."""
    return max(drive_of(scene).period_us, 2.0 * np.pi / float(scene.cantilever.angular_frequency))


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


class Window(NamedTuple):
    """A stretch of time, in us, whole response periods of the drive where it is long enough."""

    from_us: float
    to_us: float
    periods: int
    """N: drive periods in a response period; where nothing repeats the nearest integer between two contacts."""
    responses: int
    """Whole response periods in the stretch; 0 where it is shorter than one."""


def window_of(scene: Scene, simulation: Simulation, verdict: Settled, drive: DrivePeriod | None = None) -> Window:
    """Return the last response period of a settled motion, else whole response periods in the last fifth.

    The end is moved into a flight where there is one, so that no contact is cut in a motion that repeats.

    Args:
        scene: the scene.
        simulation: of one scene.
        verdict: what `settled` says of it.
        drive: in whose periods to count; the scene's if None.
    """
    drive = drive_of(scene) if drive is None else drive
    first, last = float(simulation.start.time_us), float(simulation.final.time_us)
    periods = verdict.periods or _likely_order(simulation, drive.period_us, stuck=verdict.stuck)
    response = periods * drive.period_us
    if verdict.settled and not verdict.stuck and last - first >= response:
        end = last if verdict.contacts == 0 else _middle_of_a_flight(scene, simulation, response)
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
    whole = int(_LAST_SHARE * span / response)
    if whole == 0:
        whole = int(span >= response)
    return Window(last_us - (whole * response if whole else _LAST_SHARE * span), last_us, periods, whole)


def _likely_order(simulation: Simulation, period_us: float, *, stuck: bool) -> int:
    """Return the nearest integer to the mean number of drive periods between contacts, over the last fifth of them."""
    rows = simulation.contacts
    times = np.asarray(rows.departure_time_us)[np.asarray(rows.kind) == ContactKind.IMPACT]
    some = times[-max(5, int(_LAST_SHARE * len(times))) :]
    if stuck or len(some) < 2:
        return 1
    return max(1, round(float(some[-1] - some[0]) / (len(some) - 1) / period_us))


def _middle_of_a_flight(scene: Scene, simulation: Simulation, response_us: float) -> float:
    """Return the middle of the longest flight that ends in the last response period."""
    flights = flights_of(scene, simulation)
    return flights.middle_of_longest(flights.end_us > float(simulation.final.time_us) - response_us)


class Piece(NamedTuple):
    """A stretch of a motion, simulated at once."""

    motion: Simulation
    length_us: float
    row: int | None
    """The contact after whose departure the motion goes on; None: it goes on from the end."""
    goes_on: bool
    """Whether it can go on from there: it is no part of a contact that began with the piece and still lasts."""
    stuck: bool
    """Whether the sample holds the tip at the end (`is_stuck`)."""

    @property
    def contacts(self) -> int:
        """Number of its contacts up to where the next piece begins."""
        return int(self.motion.count) if self.row is None else self.row + 1


class LongRun(NamedTuple):
    """A long simulation, joined; arrays of its contacts are NumPy's and have no unused rows."""

    simulation: Simulation
    verdict: Settled
    pieces: int


def follow_in_pieces(
    scene: Scene, start: State, until_us: float, run: Run, *, piece_us: float = math.inf
) -> Iterator[Piece]:
    """Follow a scene piece by piece to a time, or until it breaks off; give every piece once it is done.

    A piece from which the motion cannot go on, the tip being in a contact that began with it, is done again, twice as
    long; in one go to the end where the sample holds the tip. Whoever has seen enough asks for no more.

    Args:
        scene: one scene, its numbers known.
        start: the tip at the start.
        until_us: the end.
        run: simulates a stretch of the scene's motion.
        piece_us: how long a piece is; ends where there is no more room for contacts, too.
    """
    state, stretch = start, 1.0
    while True:
        left = until_us - float(state.time_us)
        length = stretch * piece_us if left > stretch * piece_us * _LITTLE else left
        motion = run(state, length)
        outcome = MotionOutcome(int(motion.outcome))
        stuck = outcome in _GOES_ON and is_stuck(scene, motion)
        row, goes_on = where_to_go_on(motion)
        goes_on = goes_on and outcome in _GOES_ON and not stuck
        yield Piece(motion, length, row, goes_on, stuck)
        full = outcome == MotionOutcome.CONTACT_LIMIT
        if outcome not in _GOES_ON or (length == left and not (full and goes_on)):
            return
        if goes_on:
            state, stretch = place_after(motion, row), 1.0
        else:
            stretch = math.ceil(left / piece_us) if stuck else 2.0 * stretch


def where_to_go_on(motion: Simulation) -> tuple[int | None, bool]:
    """Return the last contact that the tip left, None: the end of a motion in flight; and whether there is either."""
    left = np.flatnonzero(np.asarray(motion.contacts.kind) == ContactKind.IMPACT)
    if left.size:
        return int(left[-1]), True
    flying = int(motion.phase) == Phase.DRY and not bool(motion.held) and motion.outcome == MotionOutcome.FINISHED
    return None, bool(flying)


def place_after(motion: Simulation, row: int | None) -> State:
    """Return where the tip departs after a contact, or is at the end; of a motion's derivative: how that changes."""
    rows = motion.contacts
    if row is None:
        return State(*motion.final)
    return State(rows.departure_time_us[row], rows.departure_position_nm[row], rows.departure_velocity_nm_per_us[row])


def joined(pieces: Sequence[Piece]) -> Simulation:
    """Return pieces that follow each other as one simulation that ended as the last one did; arrays of NumPy's."""
    counts = [*(piece.contacts for piece in pieces[:-1]), int(pieces[-1].motion.count)]
    return joined_motions([piece.motion for piece in pieces], counts)


def joined_motions(motions: Sequence[Simulation], counts: Sequence[int]) -> Simulation:
    """Return simulations that follow each other, or their derivatives, as one; of each the first few contacts count."""
    rows = [
        jax.tree.map(lambda column, count=count: np.asarray(column)[:count], motion.contacts)
        for motion, count in zip(motions, counts, strict=True)
    ]
    contacts = jax.tree.map(lambda *columns: np.concatenate(columns), *rows)
    last = motions[-1]
    return Simulation(
        start=motions[0].start,
        contacts=contacts,
        count=jnp.asarray(len(contacts.kind), jnp.int32),
        final=last.final,
        phase=last.phase,
        held=last.held,
        outcome=last.outcome,
    )


def why_over(piece: Piece) -> str | None:
    """Return why a motion does not go on after a piece; None where it does, or could have."""
    outcome = MotionOutcome(int(piece.motion.outcome))
    if outcome not in _GOES_ON:
        return outcome.sentence
    return f"the sample captures the tip (at {held_since(piece.motion):.4g} us)" if piece.stuck else None


def follow_long(  # noqa: PLR0913
    scene: Scene,
    start: State,
    duration_us: float,
    *,
    until_settled: bool = False,
    enough: Callable[[Simulation], bool] = lambda _: False,
    piece_contacts: int | None = None,
    accuracy: float = DEFAULT_ACCURACY,
    method: str = "collocation",
    report: Callable[[float, int], None] | None = None,
) -> LongRun:
    """Return a scene followed for a duration, or until it has settled or is enough if that is earlier.

    Args:
        scene: one scene, its numbers known.
        start: the tip at the start.
        duration_us: the longest duration.
        until_settled: end with the piece in which the motion has settled, or some periods after the sample has come to
            hold the tip.
        enough: asked after every piece of the motion so far: whether to stop.
        piece_contacts: contacts of a piece; None: what some periods of the fastest motion have room for.
        accuracy: of `simulate`.
        method: of `simulate`.
        report: called after every piece with the time reached in us and the number of contacts so far.

    Raises:
        ValueError: as `simulate`.
    """
    surface, _ = surface_of(scene)
    fastest = max(float(scene.cantilever.angular_frequency), float(surface.fastest_angular_frequency))
    piece_us = _PIECE_PERIODS * 2.0 * math.pi / fastest if piece_contacts is None else math.inf

    def run(state: State, length_us: float) -> Simulation:
        room = (piece_contacts or _ROOM) if length_us <= piece_us * _LITTLE else None
        return simulate(scene, state, length_us, max_contacts=room, accuracy=accuracy, method=method)

    count, pieces, whole, verdict = 0, [], None, None
    for found in follow_in_pieces(scene, start, float(start.time_us) + duration_us, run, piece_us=piece_us):
        piece = found
        if until_settled and found.stuck:
            shown_us = _end_of_held(scene, found.motion) - float(found.motion.start.time_us)
            piece = found._replace(motion=run(found.motion.start, min(found.length_us, shown_us)))
        count, pieces = count + 1, [*(done for done in pieces if done.goes_on), piece]
        whole = joined(pieces)
        if report is not None:
            report(float(whole.final.time_us), len(whole.contacts.kind))
        if until_settled:
            verdict = settled(scene, whole)
            if verdict.settled or piece.stuck:
                break
        if enough(whole):
            verdict = None
            break
    assert whole is not None  # there is one piece at least  # noqa: S101
    return LongRun(whole, settled(scene, whole) if verdict is None else verdict, count)


def _end_of_held(scene: Scene, motion: Simulation) -> float:
    """Return the time in us until which a tip that the sample holds is followed."""
    return held_since(motion) + _HELD_LONG_ENOUGH * _slower_period_us(scene)


class Orbit(NamedTuple):
    """A periodic motion that attracts."""

    start: State
    """In flight."""
    period_us: float
    periods: int
    """N: drive periods in a response period."""
    impacts: int
    """m: impacts in a response period."""
    contraction: float
    """By which a small distance from it shrinks in a response period."""
    monodromy: Float[np.ndarray, "2 2"]
    """Derivative of one response period's map: position in nm, velocity in nm/us."""
    motion: Simulation
    """One response period."""


class Followed(NamedTuple):
    """A scene followed from a start until it settles."""

    orbit: Orbit | None
    reason: str | None
    """Why there is no orbit."""


def why_impossible(scene: Scene) -> str | None:
    """Return why a scene cannot be simulated at all; None if it can."""
    try:
        surface_of(scene)
    except ValueError as error:
        return str(error)
    if isinstance(scene.interaction, Contact) and not bool(find_junction(scene.interaction).exists):
        return f"no junction forms: {explain_missing_junction(scene.interaction)}"
    return None


def follow_to_orbit(scene: Scene, start: State, most_us: float, run: Run) -> Followed:
    """Follow a scene until it is near a periodic orbit, and close in on that to rounding.

    An orbit counts only if it is near the simulated motion, and attracts.

    Args:
        scene: one scene whose drive has one period.
        start: where the motion begins.
        most_us: how long to follow it at most, in us.
        run: simulates a stretch of the scene's motion.
    """
    reason = why_impossible(scene)
    if reason is not None:
        return Followed(None, reason)
    piece_us = min(_ORBIT_PIECE * drive_of(scene).period_us, most_us)
    for piece in follow_in_pieces(scene, start, float(start.time_us) + most_us, run, piece_us=piece_us):
        reason = why_over(piece)
        if reason is not None:
            return Followed(None, reason)
        orbit = _orbit_near(scene, piece.motion, run)
        if orbit is not None:
            return Followed(orbit, None)
    return Followed(None, f"nothing repeats: no steady orbit within {most_us:.4g} us of the start")


def _orbit_near(scene: Scene, motion: Simulation, run: Run) -> Orbit | None:
    """Return the orbit that a motion is close to, of the fewest drive periods; None without one."""
    flights = flights_of(scene, motion)
    if not flights.begin_us.size:
        return None
    last = np.arange(flights.begin_us.size) >= flights.begin_us.size - _LAST_FLIGHTS
    state = state_at(scene, motion, flights.middle_of_longest(last))
    if state is None:
        return None
    period = drive_of(scene).period_us
    ahead = run(state, (_LONGEST_RESPONSE + 0.5) * period)
    omega = float(scene.cantilever.angular_frequency)
    for periods in range(1, _LONGEST_RESPONSE + 1):
        after = state_at(scene, ahead, float(state.time_us) + periods * period)
        if after is not None and _apart(_column(state), _column(after), omega)[0] <= _NEAR:
            orbit = _orbit_of(scene, state, periods, run)
            if orbit is not None:
                return orbit
    return None


def _orbit_of(scene: Scene, near: State, periods: int, run: Run) -> Orbit | None:
    """Return the attracting orbit of a number of drive periods near a state; None if there is none."""
    duration = periods * drive_of(scene).period_us

    def ends(starts: np.ndarray, _: np.ndarray) -> np.ndarray:
        motions = [run(State(near.time_us, *(jnp.asarray(part) for part in start[1:])), duration) for start in starts.T]
        return np.stack([ends_in_flight(motion) for motion in motions], axis=1)

    omega = float(scene.cantilever.angular_frequency)
    found = close_periods(ends, _column(near), np.zeros(1, int), angular_frequency=omega, reach=_NEAR)
    if not found.closed[0] or not found.contraction[0] < _ATTRACTS:
        return None
    start = State(near.time_us, *(jnp.asarray(part) for part in found.starts[1:, 0]))
    motion = run(start, duration)
    contraction = float(found.contraction[0])
    return Orbit(start, duration, periods, int(motion.count), contraction, found.slopes[0], motion)


def _column(state: State) -> Float[np.ndarray, "3 1"]:
    return np.array([[float(part)] for part in state])


def ends_in_flight(motion: Simulation) -> np.ndarray:
    """Return position and velocity at the end of a motion, a column each of a batch; NaN if not in flight then."""
    free = (np.asarray(motion.outcome) == MotionOutcome.FINISHED) & (np.asarray(motion.phase) == Phase.DRY)
    return np.where(free, np.stack([motion.final.position_nm, motion.final.velocity_nm_per_us]), np.nan)


class ClosedPeriods(NamedTuple):
    """Where a search for periodic motions ended, one entry a row."""

    starts: Float[np.ndarray, "3 rows"]
    """Time, position and velocity."""
    closed: Bool[np.ndarray, " rows"]
    """Whether the motion comes back to its start."""
    contraction: Float[np.ndarray, " rows"]
    """Largest modulus of the multipliers of the linearised map; infinite where it is not known."""
    slopes: Float[np.ndarray, "rows 2 2"]
    """The linearised map: of the end's position and velocity by the start's."""


def close_periods(
    ends: Callable[[Float[np.ndarray, "3 n"], Int[np.ndarray, " n"]], Float[np.ndarray, "2 n"]],
    starts: Float[np.ndarray, "3 rows"],
    rows: Int[np.ndarray, " rows"],
    *,
    angular_frequency: float,
    reach: float = math.inf,
) -> ClosedPeriods:
    """Return starts whose motion comes back to them.

    Newton's method on x - F(x) = 0, x = (z, v), with the slopes of F by central differences.

    Args:
        ends: F: of starts and the numbers of their scenes, position and velocity one response period later; NaN where
            there is none.
        starts: first guesses: time in us, position in nm and velocity in nm/us.
        rows: the numbers of their scenes.
        angular_frequency: of the free tip in rad/us; turns lengths into velocities.
        reach: how far from its first guess a start may end, of the tip's largest speed; on the way four times as far.
    """
    near, starts, count = starts, np.array(starts), len(rows)
    closed, contraction = np.zeros(count, bool), np.full(count, np.inf)
    slopes = np.full((count, 2, 2), np.nan)
    alive = np.arange(count)
    for _ in range(_NEWTON_STEPS):
        if not alive.size:
            break
        place = starts[1:, alive]
        gap, jacobian = _map_of(ends, starts[:, alive], rows[alive], angular_frequency)
        known = np.asarray(np.isfinite(jacobian).all(axis=(1, 2)) & np.isfinite(gap).all(axis=0))
        known &= np.linalg.det(np.eye(2) - np.where(known[:, None, None], jacobian, 0.0)) != 0.0
        safe = np.where(known[:, None, None], jacobian, 0.0)
        slopes[alive] = jacobian
        contraction[alive] = np.where(known, np.abs(np.linalg.eigvals(safe)).max(axis=1), np.inf)
        end = np.concatenate([starts[:1, alive], place + gap])
        done = known & (_apart(starts[:, alive], end, angular_frequency) <= _CLOSED)
        closed[alive[done]] = True
        step = np.linalg.solve(np.eye(2) - safe, np.where(known, gap, 0.0).T[:, :, None])[:, :, 0].T
        go = known & ~done
        starts[1:, alive[go]] += step[:, go]
        alive = alive[go]
        alive = alive[_apart(near[:, alive], starts[:, alive], angular_frequency) <= _OVERSHOOT * reach]
    closed &= _apart(near, starts, angular_frequency) <= reach
    return ClosedPeriods(starts, closed, contraction, slopes)


def _map_of(
    ends: Callable[..., np.ndarray], starts: Float[np.ndarray, "3 n"], rows: Int[np.ndarray, " n"], omega: float
) -> tuple[Float[np.ndarray, "2 n"], Float[np.ndarray, "n 2 2"]]:
    """Return by how much position and velocity change in a period, and the slopes of where they end."""
    steps = _DIFFERENCE * _speed(starts, omega) * np.array([[1.0 / omega], [1.0]])
    moves = np.concatenate([np.zeros((1, 2)), np.eye(2), -np.eye(2)])
    # trials[:, k]: the starts, and then moved
    trials = np.stack(
        [starts + np.concatenate([np.zeros(starts[:1].shape), move[:, None] * steps]) for move in moves], 1
    )
    found = ends(trials.reshape(3, -1), np.tile(rows, len(moves))).reshape(2, len(moves), -1)
    jacobian = (found[:, 1:3] - found[:, 3:]) / (2.0 * steps)
    return found[:, 0] - starts[1:], np.moveaxis(jacobian, -1, 0)


def _speed(starts: Float[np.ndarray, "3 n"], omega: float) -> Float[np.ndarray, " n"]:
    """Return the largest speeds in nm/us of free vibrations through states; 1e-3 nm of amplitude at least."""
    return np.maximum(np.hypot(omega * starts[1], starts[2]), 1e-3 * omega)


def _apart(one: Float[np.ndarray, "3 n"], other: Float[np.ndarray, "3 n"], omega: float) -> Float[np.ndarray, " n"]:
    """Return the distances of states, of the largest speed of the first."""
    _, position, velocity = other - one
    return np.hypot(omega * position, velocity) / _speed(one, omega)
