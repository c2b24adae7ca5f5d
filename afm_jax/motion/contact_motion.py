"""A contact scene in time: closed-form flight to the bridge, through the contact, and so on to the end.

Every tip of a batch goes at its own pace. A round takes each free tip to its next contact, as far through it as the
quick way leg by leg holds, and tips that are still in contact some trial steps in time, until they are where the quick
way may go on; so a batch does not wait for the few contacts that turn inside the bridge. All shapes are fixed.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from afm_jax.contact.driven import Driven, Place
from afm_jax.contact.phases import Phase
from afm_jax.contact.settings import DrivenSetting
from afm_jax.contact.step import Touch, advance, fresh_touch
from afm_jax.impact.first_impact import Flight, first_impact
from afm_jax.motion.contact_crossing import at_junction, go_quickly
from afm_jax.motion.record import ContactKind, MotionOutcome
from afm_jax.motion.side_by_side import for_the_few
from afm_jax.outcome import Outcome

_ROUNDS = 8
"""Rounds between two looks at whether all tips have arrived at the end."""
_FLIGHT_STEPS = 2000
_LEGS_AT_ONCE, _TRIALS_AT_ONCE = 256, 64
"""Tips of a batch that go the quick way together, and that try steps in time together."""
_TRIALS = 4
"""Trial steps between two looks at which tips of a batch need more."""


class Row(NamedTuple):
    """A contact, in the gap and its rate; stored as one vector."""

    kind: Float[Array, "..."]
    arrival_us: Float[Array, "..."]
    arrival_gap_nm: Float[Array, "..."]
    arrival_rate: Float[Array, "..."]
    departure_us: Float[Array, "..."]
    departure_gap_nm: Float[Array, "..."]
    departure_rate: Float[Array, "..."]
    junctions: Float[Array, "..."]
    junction_forms_us: Float[Array, "..."]
    junction_breaks_us: Float[Array, "..."]
    time_in_junction_us: Float[Array, "..."]
    deepest_gap_nm: Float[Array, "..."]
    viscous_loss_aj: Float[Array, "..."]


class Arrival(NamedTuple):
    """Where a contact began; scalars of one tip."""

    time_us: Float[Array, ""]
    gap_nm: Float[Array, ""]
    gap_rate: Float[Array, ""]


class Tip(NamedTuple):
    """A tip on its way; scalars of one tip, but for the rows."""

    touch: Touch
    """Its place and phase, and the contact it is in; the gap of a free tip."""
    arrival: Arrival
    """Where the present contact began."""
    contacts: Int[Array, ""]
    rows: Float[Array, "rows columns"]
    outcome: Int[Array, ""]
    done: Bool[Array, ""]
    rounds: Int[Array, ""]


def begin(driven: Driven, time_us: Array, gap_nm: Array, rate: Array, rows: int) -> Tip:
    """Return a tip at its start: free above the gap where the bridge forms, in the bridge below it."""
    wet = gap_nm <= driven.forms_nm
    sane = jnp.isfinite(time_us) & jnp.isfinite(rate) & (gap_nm > driven.junction.forms_gap_nm)
    outcome = jnp.where(sane, MotionOutcome.FINISHED, MotionOutcome.INVALID_START)
    outcome = jnp.where(driven.junction.exists, outcome, MotionOutcome.NO_JUNCTION)
    phase = jnp.where(wet, Phase.BRIDGE, Phase.DRY)
    zero = jnp.zeros_like(time_us)
    return Tip(
        touch=fresh_touch(Place(gap_nm, rate, time_us, zero), phase),
        arrival=Arrival(time_us, gap_nm, rate),
        contacts=jnp.zeros_like(phase),
        rows=jnp.zeros((rows, len(Row._fields)), time_us.dtype),
        outcome=outcome.astype(jnp.int32),
        done=outcome != MotionOutcome.FINISHED,
        rounds=jnp.zeros_like(phase),
    )


def follow(driven: Driven, tip: Tip, until_us: Array, setting: DrivenSetting, *, rounds: int, reverse: bool) -> Tip:
    """Return a tip at the end of the simulation.

    Args:
        driven: the equation of motion.
        tip: the tip at its start.
        until_us: the end.
        setting: how finely contacts are resolved.
        rounds: most rounds.
        reverse: make it differentiable in reverse mode: all rounds are run, in blocks that are recomputed backwards.
    """
    blocks = -(-rounds // _ROUNDS)
    advance_round = partial(_round, driven, until_us=until_us, setting=setting, reverse=reverse)

    def block(tip, _):
        return lax.scan(lambda state, _: (advance_round(state), None), tip, None, length=_ROUNDS)

    if reverse:
        tip, _ = lax.scan(jax.checkpoint(block), tip, None, length=blocks)
    else:
        limit = blocks * _ROUNDS
        tip = lax.while_loop(lambda tip: ~tip.done & (tip.rounds < limit), lambda tip: block(tip, None)[0], tip)
    outcome = jnp.where(tip.done, tip.outcome, MotionOutcome.STEP_LIMIT)
    return tip._replace(outcome=outcome.astype(jnp.int32))


def _round(driven: Driven, tip: Tip, *, until_us: Array, setting: DrivenSetting, reverse: bool) -> Tip:
    """Return a tip after one round: flight, the quick way through the contact, trial steps where that does not hold."""
    free = (tip.touch.phase == Phase.DRY) & ~tip.done
    arrived, lost, place = _fly(driven, tip.touch.place, free, until_us)
    began = (place.time_us, place.x, place.gap_rate)
    arrival = Arrival(*(jnp.where(arrived, new, old) for new, old in zip(began, tip.arrival, strict=True)))
    fresh = fresh_touch(place, jnp.where(arrived, Phase.BRIDGE, Phase.DRY))
    touch = jax.tree.map(lambda new, old: jnp.where(free, new, old), fresh, tip.touch)
    touch = _through(driven, touch, arrived, ~tip.done, until_us, setting)
    touch = _step(driven, touch, ~tip.done, until_us, setting, reverse=reverse)
    over = touch.place.time_us >= until_us
    left = touch.phase == Phase.DRY
    touched = arrived | ((tip.touch.phase != Phase.DRY) & ~tip.done)
    ended = touched & (left | over)
    room = tip.contacts < tip.rows.shape[0]
    row = _row(touch, arrival, held=~left)
    place_of_row = jnp.where(ended & room, tip.contacts, tip.rows.shape[0])
    full = ended & ~room
    outcome = jnp.where(full, MotionOutcome.CONTACT_LIMIT, tip.outcome)
    outcome = jnp.where(ended & ~left, MotionOutcome.HELD, outcome)
    outcome = jnp.where(lost, MotionOutcome.STEP_LIMIT, outcome)
    outcome = jnp.where(jnp.isfinite(touch.place.x), outcome, MotionOutcome.UNRESOLVED)
    flown = free & ~arrived
    return Tip(
        touch=touch,
        arrival=arrival,
        contacts=tip.contacts + ended.astype(tip.contacts.dtype),
        rows=tip.rows.at[place_of_row].set(row, mode="drop"),
        outcome=jnp.where(tip.done, tip.outcome, outcome).astype(jnp.int32),
        done=tip.done | flown | (touched & over) | full | lost | ~jnp.isfinite(touch.place.x),
        rounds=tip.rounds + 1,
    )


def _fly(driven: Driven, place: Place, free: Array, until_us: Array) -> tuple[Array, Array, Place]:
    """Return whether a free tip meets the bridge before the end, whether the search gave up, and where the tip is."""
    surface, start = driven.surface, place.time_us
    # tips that are not free start below the level, so that their search ends at once
    gap = jnp.where(free, place.x, 0.5 * driven.forms_nm)
    height, speed = surface.position_and_velocity(start)
    velocity = place.gap_rate + speed
    flight = Flight(driven.cantilever, surface, start, velocity, gap, driven.forms_nm)
    found = first_impact(flight, max_steps=_FLIGHT_STEPS, latest_us=until_us - start)
    arrives = free & (found.outcome == Outcome.IMPACT) & (start + found.duration_us < until_us)
    lost = free & (found.outcome == Outcome.STEP_LIMIT)
    duration = jnp.where(arrives, found.duration_us, jnp.where(free, until_us - start, 0.0))
    position, velocity = driven.cantilever.propagator(duration)(gap + height, velocity)
    time = start + duration
    height, speed = surface.position_and_velocity(time)
    moved = Place(jnp.where(arrives, driven.forms_nm, position - height), velocity - speed, time, jnp.zeros_like(time))
    return arrives, lost, Place(*(jnp.where(free, new, old) for new, old in zip(moved, place, strict=True)))


def _through(
    driven: Driven, touch: Touch, arrived: Array, active: Array, until_us: Array, setting: DrivenSetting
) -> Touch:
    """Return the tip as far through its contact as the quick way holds."""
    if setting.quick is None:
        return touch

    def needed(driven, touch, arrived, active, until_us):
        del until_us
        return arrived | (active & at_junction(driven, touch))

    def through(driven, touch, arrived, active, until_us):
        return go_quickly(driven, touch, arrived, active, until_us, setting)

    one_pass = for_the_few(through, needed, changed=1, passes=1, block=_LEGS_AT_ONCE)
    return one_pass(driven, touch, arrived, active, until_us)


def _step(
    driven: Driven, touch: Touch, active: Array, until_us: Array, setting: DrivenSetting, *, reverse: bool
) -> Touch:
    """Return a tip in contact after some trial steps, or where the quick way may go on; a free one stays as it is."""

    def going(touch, active, until_us):
        finite = jnp.isfinite(touch.place.x) & jnp.isfinite(touch.place.gap_rate)
        return active & (touch.phase != Phase.DRY) & (touch.place.time_us < until_us) & finite

    def waits_not(driven, touch, active, until_us):
        # a tip that has just formed the junction waits for the quick way; one for which that did not hold does not
        moves = going(touch, active, until_us)
        return moves if setting.quick is None else moves & ~at_junction(driven, touch)

    def advanced(driven, touch, moves, until_us):
        after = advance(driven, touch, until_us, setting.fineness, setting.method)
        return jax.tree.map(lambda new, old: jnp.where(moves, new, old), after, touch)

    if reverse:

        def once(touch, _):
            return advanced(driven, touch, going(touch, active, until_us), until_us), None

        return lax.scan(once, touch, None, length=setting.trials)[0]

    def run(driven, touch, active, until_us):
        def on(state):
            touch, count = state
            return jnp.any(waits_not(driven, touch, active, until_us)) & (count < _TRIALS)

        def more(state):
            touch, count = state
            return advanced(driven, touch, waits_not(driven, touch, active, until_us), until_us), count + 1

        return lax.while_loop(on, more, (touch, 0))[0]

    passes = -(-setting.trials // _TRIALS)
    return for_the_few(run, waits_not, changed=1, passes=passes, block=_TRIALS_AT_ONCE)(driven, touch, active, until_us)


def _row(touch: Touch, arrival: Arrival, *, held: Array) -> Float[Array, " columns"]:
    place = touch.place
    row = Row(
        kind=jnp.where(held, float(ContactKind.HELD), float(ContactKind.IMPACT)),
        arrival_us=arrival.time_us,
        arrival_gap_nm=arrival.gap_nm,
        arrival_rate=arrival.gap_rate,
        departure_us=jnp.where(held, jnp.inf, place.time_us),
        departure_gap_nm=jnp.where(held, 0.0, place.x),
        departure_rate=jnp.where(held, 0.0, place.gap_rate),
        junctions=touch.junctions.astype(place.x.dtype),
        junction_forms_us=touch.junction_forms_us,
        junction_breaks_us=touch.junction_breaks_us,
        time_in_junction_us=touch.time_in_junction_us,
        deepest_gap_nm=touch.deepest_gap_nm,
        viscous_loss_aj=place.viscous_loss_aj,
    )
    return jnp.stack(row)
