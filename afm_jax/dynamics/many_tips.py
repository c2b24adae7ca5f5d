"""Many tips followed from impact to impact at once: the engine behind exponents, bifurcation diagrams and basins.

Times are in us, velocities in nm/us, phases in rad; the map is that of eqs. 2 to 6, or eq. 16 for contacts.

`follow` takes `Tips`, each at the beginning of a flight, and returns them some impacts later with a `Record` of the
last ones. A time is a number of whole drive periods plus a remainder in us within one period, so that the drive's phase
stays accurate in long motions.

Of laws, `advance` is one step of the impact map for a block of tips that fits the processor's cache: `impact_after`,
written for arrays, not as a `vmap` of one tip: what only a resting tip needs (chatter summed up, the ride, the release)
and long searches for an impact are computed in the steps in which a tip of the block needs them.

Contacts are simulated, a stretch of many at a time. A tip departs where the bridge breaks, at one gap always, so that
its next contact depends on time and velocity alone: a map of two variables like that of impacts, whose Jacobian is the
forward derivative of the simulation (`next_departures`).
"""

from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from afm_jax.apparatus.scene import Scene
from afm_jax.contact.contact import Contact
from afm_jax.contact.junction import ContactPhase
from afm_jax.impact.first_impact import Flight
from afm_jax.impact.law import impact_law_of
from afm_jax.impact.map import Departure, NextImpact, Search, end_of_flight, flight_from, impact_at_end
from afm_jax.motion.law_motion import CONSTANT_PUSH, Bed, through_impact
from afm_jax.motion.record import ContactKind, Contacts, Simulation, State
from afm_jax.motion.settle import HELD_PERIODS
from afm_jax.motion.simulate import simulate
from afm_jax.motion.start import gap_of_departure
from afm_jax.outcomes import Outcome
from afm_jax.scenefile.parameter_paths import with_numbers
from afm_jax.solve.lanes import again_for
from afm_jax.units import RAD_PER_US_PER_KHZ

MAX_STEPS = 2000
"""Steps of the search for one impact."""
_FEW = 16
"""Tips of a block whose rest, or long search, is computed together."""
_ROWS = 40
"""Contacts of one stretch, which is one call of `simulate`."""


class Tips(NamedTuple):
    """Tips at the beginning of a flight each, arrays of one lane a tip."""

    time_us: Float[Any, " lanes"]
    """Within the first drive period."""
    periods: Float[Any, " lanes"]
    """Whole drive periods gone before."""
    gap_nm: Float[Any, " lanes"]
    """Height over the surface: `gap_of_departure`, almost 0 after a release from rest."""
    velocity_nm_per_us: Float[Any, " lanes"]
    """In the lab."""
    outcome: Int[Any, " lanes"]
    """An `Outcome`: IMPACT while the motion goes on, else how it ended."""


class Record(NamedTuple):
    """Impacts of tips, arrays (lanes, impacts), NaN where there was none.

    Times in us count within the drive's period, speeds are in nm/us; the approach speed is relative to the platform.
    """

    arrival_us: Float[Any, "lanes impacts"]
    approach_nm_per_us: Float[Any, "lanes impacts"]
    departure_us: Float[Any, "lanes impacts"]
    """Beginning of the next flight; after a rest that is the release."""
    velocity_after_nm_per_us: Float[Any, "lanes impacts"]
    arrival_periods: Float[Any, "lanes impacts"]
    """Whole drive periods before the arrival."""
    departure_periods: Float[Any, "lanes impacts"]
    """Whole drive periods before the departure."""
    rested: Bool[Any, "lanes impacts"]

    def turns(self, period_us: Float[np.ndarray, " lanes"]) -> Float[np.ndarray, "lanes impacts"]:
        """Return the times of the departures in drive periods."""
        return self.departure_periods + self.departure_us / period_us[:, None]


def follow(scenes: Scene, tips: Tips, *, skip: int, record: int, accuracy: float) -> tuple[Tips, Record]:
    """Return a block of tips some impacts or contacts later, and the last of these, arrays (lanes, impacts).

    Args:
        scenes: a batch of scenes with laws or contacts.
        tips: at the beginning of a flight each.
        skip: impacts before those that are recorded; contacts are skipped in whole stretches, so at least as many.
        record: impacts that are recorded.
        accuracy: of `simulate`, for contacts.
    """
    if isinstance(scenes.interaction, Contact):
        return tips_after_contacts(scenes, tips, skip=skip, record=record, accuracy=accuracy)
    tips, rows = recorded(scenes, tips, skip, impacts=record)
    return tips, Record(*(np.asarray(column).T for column in rows))


def advance(scenes: Scene, tips: Tips) -> tuple[Tips, Record]:
    """Return one step of the impact map for a block of tips: where the flights after the next impacts begin, and these.

    Args:
        scenes: a batch of scenes with a law, every number of one lane a tip.
        tips: at the beginning of a flight each.
    """

    def ends(max_steps: int):
        return jax.vmap(partial(end_of_flight, search=Search(max_steps)))

    flights = jax.vmap(_flight_of)(scenes, tips)
    if len(tips.time_us) <= _FEW:
        ends_of_flights = ends(MAX_STEPS)(scenes, flights)
    else:
        # steps that all take together; those that need more go on among themselves
        ends_of_flights = ends(14)(scenes, flights)
        slow = ends_of_flights.outcome == Outcome.STEP_LIMIT
        ends_of_flights = again_for(ends(MAX_STEPS), slow, (scenes, flights), ends_of_flights, block=_FEW)
    return after_impacts(scenes, tips, jax.vmap(impact_at_end)(scenes, flights, ends_of_flights))


def after_impacts(scenes: Scene, tips: Tips, impact: NextImpact) -> tuple[Tips, Record]:
    """Return what follows impacts that are known, a flight, a rest or the end, and their record, one lane a tip."""
    going = tips.outcome == Outcome.IMPACT
    captured = going & (impact.outcome == Outcome.CAPTURED)
    landed = captured | (going & (impact.outcome == Outcome.IMPACT))
    surface = scenes.platform
    rebound = impact.velocity_after_nm_per_us - surface.velocity(impact.time_us)
    leaving = Departure(impact.time_us, jnp.zeros_like(rebound), impact.velocity_after_nm_per_us)
    never = jnp.zeros_like(going)
    # only where the law has no adhesion can a tip at rest leave again, and can chatter end in a rest
    law = impact_law_of(scenes)
    may_rest = landed & (~law.adheres) & (captured | (rebound < jax.vmap(_slowest_chatter)(scenes)))

    (time, gap, velocity), rested, held = again_for(
        jax.vmap(_rest), may_rest, (scenes, impact), (leaving, never, never), block=_FEW
    )
    stuck = (captured & law.adheres) | held
    goes_on = landed & ~stuck
    outcome = jnp.where(goes_on, Outcome.IMPACT, jnp.where(stuck, Outcome.CAPTURED, impact.outcome))
    arrival, time, velocity = (jnp.where(goes_on, part, jnp.nan) for part in (impact.arrival_time_us, time, velocity))
    approach = surface.velocity(arrival) - impact.velocity_before_nm_per_us
    record = _record(tips.periods, surface.period_us, arrival, approach, time, velocity)
    return _departed(tips, record, goes_on, outcome, gap), record._replace(rested=goes_on & rested)


def _record(periods: Any, period_us: Any, arrival: Any, approach: Any, departure: Any, velocity: Any) -> Record:
    """Return the record of impacts, none of which rested.

    Args:
        periods: whole drive periods before the beginning from which times count.
        period_us: of the drive.
        arrival: times in us, NaN where there is no impact.
        approach: speeds in nm/us, of the platform and the tip.
        departure: times in us, NaN where there is no impact.
        velocity: in nm/us, in the lab, at the departure.
    """
    arrivals, departures = jnp.floor(arrival / period_us), jnp.floor(departure / period_us)
    return Record(
        arrival_us=arrival - arrivals * period_us,
        approach_nm_per_us=approach,
        departure_us=departure - departures * period_us,
        velocity_after_nm_per_us=velocity,
        arrival_periods=periods + arrivals,
        departure_periods=periods + departures,
        rested=jnp.zeros(jnp.shape(arrival), bool),
    )


def _departed(tips: Tips, last: Record, goes_on: Any, outcome: Any, gap_nm: Any) -> Tips:
    """Return tips that go on from their last impacts with an outcome; those that had ended before stay as they are."""
    going = tips.outcome == Outcome.IMPACT
    return Tips(
        time_us=jnp.where(goes_on, last.departure_us, tips.time_us),
        periods=jnp.where(goes_on, last.departure_periods, tips.periods),
        gap_nm=jnp.where(goes_on, gap_nm, tips.gap_nm),
        velocity_nm_per_us=jnp.where(goes_on, last.velocity_after_nm_per_us, tips.velocity_nm_per_us),
        outcome=jnp.where(going, outcome, tips.outcome).astype(tips.outcome.dtype),
    )


def _flight_of(scene: Scene, tip: Tips) -> Flight:
    departure = Departure(tip.time_us, tip.gap_nm, tip.velocity_nm_per_us)
    return flight_from(scene, departure, flies=tip.outcome == Outcome.IMPACT)


def _slowest_chatter(scene: Scene) -> Float[Array, ""]:
    """Return the rebound speed in nm/us below which the impacts that follow may have a closed sum (chatter).

    It is 1e-5 P (1 - r)/(2 F), with a bound P of the push N/m in nm/us^2 and the largest angular frequency F: an upper
    limit, so that `law_motion.chatter` is asked about every rebound that it may sum up.
    """
    surface, bed = scene.platform, Bed(scene.cantilever, scene.platform)
    omega, decay = scene.cantilever.angular_frequency, scene.cantilever.decay_rate
    reach = jnp.abs(surface.offset_nm) + surface.amplitude_nm
    push = surface.largest_acceleration_nm_per_us2 + 2.0 * decay * surface.top_speed_nm_per_us + omega**2 * reach
    return 0.5 * CONSTANT_PUSH * push * (1.0 - impact_law_of(scene).slow_restitution) / bed.fastest


def _rest(scene: Scene, impact: NextImpact) -> tuple[Departure, Bool[Array, ""], Bool[Array, ""]]:
    """Return where the flight after an impact begins, whether the tip rests before, and whether it rests for ever."""
    landed = (impact.outcome == Outcome.IMPACT) | (impact.outcome == Outcome.CAPTURED)
    # the push on a resting tip repeats every drive period: one that a period does not release is held for ever
    until = jnp.where(landed, impact.arrival_time_us, 0.0) + 1.1 * scene.platform.period_us
    row, departure, _ = through_impact(scene, impact, landed, until)
    held = row.kind == ContactKind.HELD
    rested = (row.kind == ContactKind.CHATTER) | (impact.outcome == Outcome.CAPTURED)
    return departure, rested & ~held, held


@partial(jax.jit, static_argnames=("impacts",))
def recorded(scenes: Scene, tips: Tips, skip: int | Int[Array, ""] = 0, *, impacts: int) -> tuple[Tips, Record]:
    """Return a block of tips `skip` and then so many more impacts later, and these, with axes (impacts, lanes).

    The map stands in the program once: compiling it takes longer than most runs of it.
    """

    def next_row(state: tuple[Tips, Record], count: Array) -> tuple[tuple[Tips, Record], Record]:
        state = lax.fori_loop(0, count, lambda _, before: advance(scenes, before[0]), state)
        return state, state[1]

    counts = jnp.ones(impacts, int).at[0].add(skip)
    no_number, no = jnp.full(tips.time_us.shape, jnp.nan), jnp.zeros(tips.time_us.shape, bool)
    (tips, _), rows = lax.scan(next_row, (tips, Record(*[*[no_number] * 6, no])), counts)
    return tips, rows


def tips_after_contacts(scenes: Scene, tips: Tips, *, skip: int, record: int, accuracy: float) -> tuple[Tips, Record]:
    """Return tips some contacts later, and the last contacts.

    Args:
        scenes: a batch of scenes with a contact.
        tips: at a departure each, or anywhere free above the sample.
        skip: least number of contacts before those that are recorded; skip and record are each rounded up to whole
            stretches of 40, and the last contacts are recorded.
        record: contacts that are recorded.
        accuracy: of `simulate`.
    """
    tips = jax.tree.map(np.asarray, tips)
    no_number = np.full((len(tips.time_us), record), np.nan)
    kept = Record(*[*[no_number] * 6, np.zeros_like(no_number, bool)])
    for _ in range(-(-skip // _ROWS) + -(-record // _ROWS)):
        tips, rows = _stretch(scenes, tips, accuracy)
        kept = Record(*(np.concatenate(both, axis=1)[:, _ROWS:] for both in zip(kept, rows, strict=True)))
        if np.all(tips.outcome != Outcome.IMPACT):
            break
    return tips, kept


def _stretch(scenes: Scene, tips: Tips, accuracy: float) -> tuple[Tips, Record]:
    """Return tips after the next 40 contacts, simulated together, and these contacts."""
    period = np.asarray(scenes.platform.period_us)
    slower = np.maximum(period, 2.0 * np.pi / np.asarray(scenes.cantilever.angular_frequency))
    # so many of the longer periods for each contact
    motion = jax.tree.map(np.asarray, _followed(scenes, tips, 6.0 * _ROWS * slower, accuracy=accuracy))
    contacts = motion.contacts
    going = tips.outcome == Outcome.IMPACT
    leaves = (contacts.kind == ContactKind.IMPACT) & going[:, None]
    count = leaves.sum(axis=1)
    departure = np.where(leaves, contacts.departure_time_us, np.nan)
    arrival = np.where(leaves, contacts.arrival_time_us, np.nan)
    full = count == _ROWS
    since = motion.final.time_us - np.nanmax(np.column_stack([tips.time_us, departure]), axis=1)
    held = (motion.phase != ContactPhase.DRY) & (since > HELD_PERIODS * slower)
    outcome = np.select(
        # so long without a contact the tip counts as having left the sample
        [full, held, since > 30.0 * slower],
        [Outcome.IMPACT, Outcome.CAPTURED, Outcome.NO_FURTHER_IMPACT],
        Outcome.STEP_LIMIT,
    ).astype(np.int32)
    approach, velocity = (
        np.where(leaves, part, np.nan)
        for part in (contacts.approach_speed_nm_per_us, contacts.departure_velocity_nm_per_us)
    )
    record = _record(tips.periods[:, None], period[:, None], arrival, approach, departure, velocity)
    last = jax.tree.map(lambda part: part[:, -1], record)
    end = _departed(tips, last, going & full, outcome, gap_of_departure(scenes))
    return jax.tree.map(np.asarray, (end, record))


@eqx.filter_jit
def _followed(scenes: Scene, tips: Tips, duration_us: Float[Any, " lanes"], *, accuracy: float) -> Simulation:
    def followed(scene: Scene, tip: Tips, duration: Array) -> Simulation:
        position = scene.platform.position(tip.time_us) + tip.gap_nm
        # one whose motion has ended flies for next to no time
        duration = jnp.where(tip.outcome == Outcome.IMPACT, duration, 1e-9)
        start = State(tip.time_us, position, tip.velocity_nm_per_us)
        return simulate(scene, start, duration, max_contacts=_ROWS, accuracy=accuracy)

    return jax.vmap(followed)(scenes, tips, duration_us)


@partial(jax.jit, static_argnames=("paths", "driven", "accuracy"))
def next_departures(
    scenes: Scene,
    departures: Float[Array, "lanes unknowns"],
    until_rad: Float[Array, " lanes"],
    *,
    paths: tuple[str, ...] = (),
    driven: str = "platform",
    accuracy: float,
) -> tuple[Float[Array, "lanes 2"], Float[Array, "lanes 2 unknowns"], Contacts, Scene]:
    """Return drive phase in rad and rebound speed in nm/us of the departures after some, and their derivatives.

    Args:
        scenes: a batch of scenes with a contact.
        departures: phase and rebound speed of each, followed by the values of some parameters.
        until_rad: phases until which the tips are followed.
        paths: of the parameters.
        driven: the part of the scene that sets the period.
        accuracy: of `simulate`.

    Returns:
        The next departures, their derivatives by what is given, the contacts in between, and the scenes with the
        values.
    """

    def of_one(scene: Scene, departure: Array, until: Array) -> tuple[Array, Array, Contacts, Scene]:
        def departs(unknowns: Array) -> tuple[Array, tuple[Array, Contacts, Scene]]:
            there = with_numbers(scene, dict(zip(paths, unknowns[2:], strict=True)))
            omega = RAD_PER_US_PER_KHZ * getattr(there, driven).frequency_khz
            time = unknowns[0] / omega
            height, rate = there.platform.position_and_velocity(time)
            start = State(time, height + gap_of_departure(there), rate + unknowns[1])
            rows = simulate(there, start, until / omega - time, max_contacts=1, accuracy=accuracy).contacts
            contact = jax.tree.map(lambda part: part[0], rows._replace(detail=None))
            following = jnp.stack([omega * contact.departure_time_us, contact.rebound_speed_nm_per_us])
            return following, (following, contact, there)

        slopes, (following, contact, there) = jax.jacfwd(departs, has_aux=True)(departure)
        return following, slopes, contact, there

    return jax.vmap(of_one)(scenes, departures, until_rad)
