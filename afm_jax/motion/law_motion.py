"""Law scenes in time: the impact map over whatever surface the tip sees, and rests on it, to the end of a duration.

Every round takes a tip from the beginning of a flight through its next impact to the beginning of the flight after it,
the rest between them included, and writes one row. All shapes are fixed; a batch goes on until its last tip is done.
"""

from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from afm_jax.apparatus.platform import Platform
from afm_jax.apparatus.scene import Scene
from afm_jax.apparatus.surface import Surface
from afm_jax.contact.phases import Phase
from afm_jax.impact.first_impact import DEFAULT_ROOT_TOLERANCE_US, Flight
from afm_jax.impact.law import impact_law_of
from afm_jax.impact.poincare import NextImpact, impact_after
from afm_jax.motion.frames import to_gap, to_lab
from afm_jax.motion.law_rest import Bed, chatter, first_release, take_off
from afm_jax.motion.record import ContactKind, Contacts, MotionOutcome, Simulation, State
from afm_jax.outcome import Outcome

_ROUNDS = 8
"""Rounds between two looks at whether all tips have arrived at the end."""
_FLIGHT_STEPS = 1_000_000
"""Steps of the search of one flight: as many as it takes, a flight that never lands needs some every period."""
_ON_SURFACE_NM = 1e-9
"""Depth up to which a start that leaves is taken to lie on the surface: rounding of lab coordinates."""


class Row(NamedTuple):
    """An impact, relative to the surface; stored as one vector."""

    kind: Float[Array, "..."]
    arrival_us: Float[Array, "..."]
    approach: Float[Array, "..."]
    departure_us: Float[Array, "..."]
    rebound: Float[Array, "..."]


class Leg(NamedTuple):
    """The beginning of a flight: time in us, gap in nm, velocity in nm/us of the freely moving y = z - response."""

    time_us: Float[Array, ""]
    gap_nm: Float[Array, ""]
    velocity: Float[Array, ""]


class Tip(NamedTuple):
    """A tip on its way; scalars of one tip, but for the rows."""

    leg: Leg
    used: Int[Array, ""]
    rows: Float[Array, "rows columns"]
    outcome: Int[Array, ""]
    done: Bool[Array, ""]
    rounds: Int[Array, ""]


@partial(jax.jit, static_argnames=("max_contacts", "reverse"))
def follow_law(
    scene: Scene,
    surface: Platform | Surface,
    response: Surface | None,
    start: State,
    until: Float[Array, ""],
    *,
    max_contacts: int,
    reverse: bool = False,
) -> Simulation:
    """Return a scene with an impact law followed in time.

    Every flight and impact is that of `iterate_map`. A captured tip moves with the surface, with adhesion (epsilon > 0)
    to the end, without it until the surface pulls. Infinitely many impacts in finite time are summed up: one row of
    kind CHATTER, or HELD if the rest outlasts the simulation. A tip within its collision delay at the end is held as
    well, on the surface. Where the rows are full, or a search gives up, the final state is the beginning of the flight
    that failed.

    Args:
        scene: its interaction is an `ImpactLaw`.
        surface: what the free tip sees (`surface_of`).
        response: the steady response to drives of base and tip, or None.
        start: the tip at the start, in the lab, above the surface; on it, it must leave.
        until: time of the end in us.
        max_contacts: rows for contacts.
        reverse: make it differentiable in reverse mode: all rounds are run, in blocks that are recomputed backwards.

    Raises:
        TypeError: if the scene's interaction is not an impact law.
    """
    impact_law_of(scene)
    seen = eqx.tree_at(lambda parts: parts.platform, scene, surface)
    gap, rate = to_gap(surface, response, start)
    touches = (gap < 0.0) & (gap > -_ON_SURFACE_NM)
    gap = gap + lax.stop_gradient(jnp.where(touches, -gap, 0.0))
    none = jnp.zeros((), jnp.int32)
    tip = Tip(
        leg=Leg(start.time_us, gap, rate + surface.velocity(start.time_us)),
        used=none,
        rows=jnp.zeros((max_contacts, len(Row._fields)), gap.dtype),
        outcome=none + jnp.int32(MotionOutcome.FINISHED),
        done=jnp.zeros((), bool),
        rounds=none,
    )
    tip = _to_the_end(seen, tip, until, rounds=max_contacts + 1, reverse=reverse)
    held = tip.outcome == MotionOutcome.HELD
    return Simulation(
        start=start,
        contacts=_contacts(scene, surface, response, Row(*jnp.moveaxis(tip.rows, -1, 0))),
        count=tip.used,
        final=_final(seen, response, tip, until),
        phase=jnp.where(held, jnp.int32(Phase.JUNCTION), jnp.int32(Phase.DRY)),
        held=held,
        outcome=tip.outcome,
    )


def _to_the_end(seen: Scene, tip: Tip, until: Array, *, rounds: int, reverse: bool) -> Tip:
    """Return a tip after as many rounds as it needs."""
    blocks = -(-rounds // _ROUNDS)

    def block(tip, _):
        return lax.scan(lambda state, _: (_round(seen, state, until), None), tip, None, length=_ROUNDS)

    if reverse:
        return lax.scan(jax.checkpoint(block), tip, None, length=blocks)[0]
    limit = blocks * _ROUNDS
    return lax.while_loop(lambda tip: ~tip.done & (tip.rounds < limit), lambda tip: block(tip, None)[0], tip)


def _round(seen: Scene, tip: Tip, until: Array) -> Tip:
    """Return a tip after its next impact, or as it was where there is none."""
    leg, surface = tip.leg, seen.platform
    # a tip that is done does not leave the surface, so that its search ends at once
    resting = surface.velocity(leg.time_us) - 1.0
    flight = Flight(
        seen.cantilever,
        surface,
        leg.time_us,
        jnp.where(tip.done, resting, leg.velocity),
        jnp.where(tip.done, 0.0, leg.gap_nm),
        jnp.zeros_like(leg.gap_nm),
    )
    tolerance = jnp.asarray(DEFAULT_ROOT_TOLERANCE_US, until.dtype)
    impact = impact_after(seen, flight, tolerance, max_steps=_FLIGHT_STEPS, latest_us=until - leg.time_us)
    ended = impact.outcome
    landed = (ended == Outcome.IMPACT) | (ended == Outcome.CAPTURED)
    arrived = ~tip.done & landed & (impact.arrival_time_us < until)
    failed = ~tip.done & ~landed & (ended != Outcome.NO_FURTHER_IMPACT)
    row, beyond, lost = _through(seen, impact, arrived, until)
    room = tip.used < tip.rows.shape[0]
    held, full = arrived & (row.kind == ContactKind.HELD), arrived & ~room
    outcome = jnp.where(held, MotionOutcome.HELD, MotionOutcome.FINISHED)
    outcome = jnp.where(failed, _failure(ended, tip.rounds), outcome)
    outcome = jnp.where(lost, MotionOutcome.STEP_LIMIT, outcome)
    outcome = jnp.where(full, MotionOutcome.CONTACT_LIMIT, outcome)
    goes_on = arrived & ~held & ~full & ~lost
    written = arrived & room & ~lost
    place = jnp.where(written, tip.used, tip.rows.shape[0])
    return Tip(
        leg=jax.tree.map(lambda new, old: jnp.where(goes_on, new, old), beyond, leg),
        used=jnp.where(written, tip.used + 1, tip.used),
        rows=tip.rows.at[place].set(jnp.stack(row), mode="drop"),
        outcome=jnp.where(tip.done, tip.outcome, outcome).astype(jnp.int32),
        done=tip.done | ~goes_on,
        rounds=tip.rounds + 1,
    )


def _through(seen: Scene, impact: NextImpact, arrived: Array, until: Array) -> tuple[Row, Leg, Array]:
    """Return the row of an impact and the beginning of the next flight; where there is none, numbers without meaning.

    The third: whether the search for the end of a rest gave up.
    """
    law, bed = impact_law_of(seen), Bed(seen.cantilever, seen.platform)
    arrival = jnp.where(arrived, impact.arrival_time_us, until)
    before = jnp.where(arrived, impact.velocity_before_nm_per_us, 0.0)
    approach = jnp.where(arrived, bed.surface.velocity(arrival) - before, 1.0)
    captured = arrived & (impact.outcome == Outcome.CAPTURED)
    rebound = law.rebound_speed(approach)
    if law.lasts:
        departs = arrived & ~captured
        time, after = (jnp.where(departs, part, 0.0) for part in (impact.time_us, impact.velocity_after_nm_per_us))
        rebound = jnp.where(departs, after - bed.surface.velocity(time), 0.0)
    chatters, lasts = chatter(bed, law, arrival, rebound)
    chatters = chatters & arrived & ~captured
    rests = captured | chatters
    resting = jnp.minimum(arrival + jnp.where(chatters, lasts, 0.0), until)
    release = first_release(bed, jnp.where(rests & (law.epsilon == 0.0), resting, until), until)
    away = Leg(*take_off(bed, release.time_us, until))
    leaving = jnp.where(arrived, impact.time_us, until)
    next_leg = Leg(leaving, jnp.zeros_like(leaving), jnp.where(arrived, impact.velocity_after_nm_per_us, 0.0))
    left = jnp.where(rests, release.happens, leaving < until)
    kind = jnp.where(chatters, float(ContactKind.CHATTER), float(ContactKind.IMPACT))
    row = Row(
        kind=jnp.where(left, kind, float(ContactKind.HELD)),
        arrival_us=arrival,
        approach=approach,
        departure_us=jnp.where(left, jnp.where(rests, release.time_us, leaving), jnp.inf),
        rebound=jnp.where(left & ~rests, rebound, 0.0),
    )
    return row, jax.tree.map(lambda new, old: jnp.where(rests, new, old), away, next_leg), arrived & release.lost


def _failure(ended: Array, rounds: Array) -> Array:
    """Return the outcome of a simulation whose flight failed."""
    start = jnp.where(rounds == 0, MotionOutcome.INVALID_START, MotionOutcome.UNRESOLVED)
    other = jnp.where(ended == Outcome.STEP_LIMIT, MotionOutcome.STEP_LIMIT, MotionOutcome.UNRESOLVED)
    return jnp.where(ended == Outcome.INVALID_START, start, other)


def _final(seen: Scene, response: Surface | None, tip: Tip, until: Array) -> State:
    """Return the last state in the lab."""
    leg, surface = tip.leg, seen.platform
    held = tip.outcome == MotionOutcome.HELD
    time = jnp.where(held | (tip.outcome == MotionOutcome.FINISHED), until, leg.time_us)
    height = surface.position(leg.time_us) + leg.gap_nm
    position, velocity = seen.cantilever.propagator(time - leg.time_us)(height, leg.velocity)
    gap, rate = to_gap(surface, None, State(time, position, velocity))
    return to_lab(surface, response, time, jnp.where(held, 0.0, gap), jnp.where(held, 0.0, rate))


def _contacts(scene: Scene, surface: Platform | Surface, response: Surface | None, row: Row) -> Contacts:
    """Return the rows as contacts in the lab."""
    kind = row.kind.astype(jnp.int32)
    used = kind != ContactKind.NONE
    left = used & (kind != ContactKind.HELD)
    zero = jnp.zeros_like(row.approach)
    arrival = to_lab(surface, response, row.arrival_us, zero, -row.approach)
    departure = to_lab(surface, response, jnp.where(left, row.departure_us, 0.0), zero, row.rebound)

    def where(condition, value):
        return jnp.where(condition, value, 0.0)

    return Contacts(
        kind=kind,
        arrival_time_us=row.arrival_us,
        arrival_position_nm=where(used, arrival.position_nm),
        arrival_velocity_nm_per_us=where(used, arrival.velocity_nm_per_us),
        approach_speed_nm_per_us=row.approach,
        departure_time_us=row.departure_us,
        departure_position_nm=where(left, departure.position_nm),
        departure_velocity_nm_per_us=where(left, departure.velocity_nm_per_us),
        rebound_speed_nm_per_us=row.rebound,
        energy_lost_aj=0.5 * scene.cantilever.mass_ng * (row.approach**2 - row.rebound**2),
    )
