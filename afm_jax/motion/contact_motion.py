"""A contact scene in time: closed-form flight to the bridge, through the contact, and so on to the end.

Every tip of a batch goes at its own pace. A round takes each free tip to its next contact, as far through it as the
quick way leg by leg holds, and tips that are still in contact some trial steps in time, until they are where the quick
way may go on; so a batch does not wait for the few contacts that turn inside the bridge. All shapes are fixed.

The quick way through a driven contact: in through the bridge, through the junction, and out again, leg by leg.

The gap is the variable in the bridge, s = sqrt(A) in the junction, so that thresholds are met without a search, and the
speed follows from the energy: the static forces, which vary most, need no integration. A leg holds for a tip that goes
straight on. One that turns in the bridge, or is slow somewhere, stays where the last leg that held has left it. It goes
on from there in time, until it is where a leg begins again.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from afm_jax.contact.bridge_leg import go_in, go_out
from afm_jax.contact.driven import ContactState, Driven
from afm_jax.contact.junction import Phase
from afm_jax.contact.junction_leg import go_through_junction
from afm_jax.contact.leg import Leg
from afm_jax.contact.settings import DrivenSetting, QuickSetting
from afm_jax.contact.step import TipInContact, advance, inverse_junction_step
from afm_jax.impact.first_impact import Flight, first_impact
from afm_jax.motion.record import ContactKind, MotionOutcome
from afm_jax.outcomes import Outcome
from afm_jax.solve.lanes import repeat_for


def cross(driven: Driven, place: ContactState, setting: QuickSetting) -> Leg:
    """Return a tip beyond the contact that it has just begun.

    Args:
        driven: the equation of motion.
        place: where the bridge forms; the gap closes.
        setting: how finely.
    """
    inward = go_in(driven, place, setting)
    solid = go_through_junction(driven, inward.state, setting)
    outward = go_out(driven, solid.state, setting)
    return outward._replace(deepest_gap_nm=solid.deepest_gap_nm, holds=inward.holds & solid.holds & outward.holds)


def at_junction(driven: Driven, touch: TipInContact) -> Bool[Array, "..."]:
    """Say whether a tip has just formed the junction, so that the quick way may go on from there."""
    return (touch.phase == Phase.JUNCTION) & (touch.state.x == driven.junction.forms_root) & (touch.trial_length == 0.0)


def go_quickly(
    driven: Driven, touch: TipInContact, arrived: Array, active: Array, until_us: Array, setting: DrivenSetting
) -> TipInContact:
    """Return a tip as far on its way through the contact as legs hold that end before a time.

    Args:
        driven: the equation of motion.
        touch: the tip.
        arrived: it has just begun the contact.
        active: it moves.
        until_us: the time.
        setting: how finely.
    """
    quick = setting.quick
    if quick is None:
        raise ValueError("`setting` has no quick way")

    def taken(leg, wanted):
        return wanted & leg.holds & (leg.state.time_us < until_us)

    leg = go_in(driven, touch.state, quick)
    formed = taken(leg, arrived)
    touch = _moved(touch, leg, formed, Phase.JUNCTION)
    touch = touch._replace(
        junctions=touch.junctions + formed.astype(touch.junctions.dtype),
        junction_forms_us=jnp.where(formed, touch.state.time_us, touch.junction_forms_us),
    )
    leg = go_through_junction(driven, touch.state, quick)
    wet = driven.junction.breaks_gap_nm < driven.breaks_nm
    waits = at_junction(driven, touch) & active
    # where nothing acts outside the junction, the way out through the bridge has no length
    broken = taken(leg, waits & (wet | (not driven.bridge.spans)))
    # one for which it does not hold is told how far to go in time, and waits no longer
    there = lax.stop_gradient(touch.state._replace(x=driven.junction.forms_root))
    step = lax.stop_gradient(1.0 / (setting.fineness * inverse_junction_step(driven, there)))
    touch = touch._replace(trial_length=jnp.where(waits & ~broken, step, touch.trial_length))
    passed = touch.time_in_junction_us + leg.state.time_us - touch.state.time_us
    touch = _moved(touch, leg, broken, Phase.BRIDGE)
    touch = touch._replace(
        junction_breaks_us=jnp.where(broken, touch.state.time_us, touch.junction_breaks_us),
        time_in_junction_us=jnp.where(broken, passed, touch.time_in_junction_us),
    )
    leg = go_out(driven, touch.state, quick)
    return _moved(touch, leg, taken(leg, broken), Phase.DRY)


def _moved(touch: TipInContact, leg: Leg, moves: Array, phase: Phase) -> TipInContact:
    """Return a tip at the end of a leg, where it takes it."""
    return touch._replace(
        state=jax.tree.map(lambda new, old: jnp.where(moves, new, old), leg.state, touch.state),
        phase=jnp.where(moves, phase, touch.phase).astype(touch.phase.dtype),
        trial_length=jnp.where(moves, 0.0, touch.trial_length),
        deepest_gap_nm=jnp.where(moves, jnp.minimum(touch.deepest_gap_nm, leg.deepest_gap_nm), touch.deepest_gap_nm),
    )


_ROUNDS = 8
"""Rounds between two looks at whether all tips have arrived at the end."""
_FLIGHT_STEPS = 2000
_LEGS_AT_ONCE, _TRIALS_AT_ONCE = 256, 64
"""Tips of a batch that go the quick way together, and that try steps in time together."""
_TRIALS = 4
"""Trial steps between two looks at which tips of a batch need more."""
_LASTS_LONG = 10.0
"""Times that a tip as fast as it came takes for the bridge's gaps, in and out."""
_FINER, _MOST_REPEATS = 1.5, 5
"""Steps are so many times as fine every time: an eighth-order error is 25 times smaller, or 4 to be careful."""
_LESS = 4.0


class ContactRow(NamedTuple):
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


class Repeats(NamedTuple):
    """How often the present contact was computed again, and what it ended with the last time; scalars of one tip."""

    times: Int[Array, ""]
    departure_us: Float[Array, ""]
    departure_rate: Float[Array, ""]


class ContactTip(NamedTuple):
    """A tip on its way; scalars of one tip, but for the rows."""

    touch: TipInContact
    """Its place and phase, and the contact it is in; the gap of a free tip."""
    arrival: Arrival
    """Where the present contact began."""
    repeats: Repeats
    contacts: Int[Array, ""]
    rows: Float[Array, "rows columns"]
    outcome: Int[Array, ""]
    done: Bool[Array, ""]
    rounds: Int[Array, ""]


def begin(driven: Driven, time_us: Array, gap_nm: Array, rate: Array, rows: int) -> ContactTip:
    """Return a tip at its start: free above the gap where the bridge forms, in the bridge below it."""
    wet = gap_nm <= driven.forms_nm
    sane = jnp.isfinite(time_us) & jnp.isfinite(rate) & (gap_nm > driven.junction.forms_gap_nm)
    outcome = jnp.where(sane, MotionOutcome.FINISHED, MotionOutcome.INVALID_START)
    outcome = jnp.where(driven.junction.exists, outcome, MotionOutcome.NO_JUNCTION)
    phase = jnp.where(wet, Phase.BRIDGE, Phase.DRY)
    zero = jnp.zeros_like(time_us)
    return ContactTip(
        touch=TipInContact.at_start(ContactState(gap_nm, rate, time_us, zero), phase),
        arrival=Arrival(time_us, gap_nm, rate),
        repeats=Repeats(jnp.zeros_like(phase, dtype=jnp.int32), zero, zero),
        contacts=jnp.zeros_like(phase),
        rows=jnp.zeros((rows, len(ContactRow._fields)), time_us.dtype),
        outcome=outcome.astype(jnp.int32),
        done=outcome != MotionOutcome.FINISHED,
        rounds=jnp.zeros_like(phase),
    )


def follow(
    driven: Driven, tip: ContactTip, until_us: Array, setting: DrivenSetting, *, rounds: int, reverse: bool
) -> ContactTip:
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


def _round(driven: Driven, tip: ContactTip, *, until_us: Array, setting: DrivenSetting, reverse: bool) -> ContactTip:
    """Return a tip after one round: flight, the quick way through the contact, trial steps where that does not hold."""
    free = (tip.touch.phase == Phase.DRY) & ~tip.done
    arrived, lost, place = _fly(driven, tip.touch.state, free, until_us)
    began = (place.time_us, place.x, place.gap_rate)
    arrival = Arrival(*(jnp.where(arrived, new, old) for new, old in zip(began, tip.arrival, strict=True)))
    fresh = TipInContact.arriving(driven, place, arrived)
    touch = jax.tree.map(lambda new, old: jnp.where(free, new, old), fresh, tip.touch)
    active, first = ~tip.done, tip.repeats.times == 0
    touch = _through(driven, touch, arrived, active & first, until_us, setting)
    touch = _step(driven, touch, active, tip.repeats.times, until_us, setting, reverse=reverse)
    over = touch.state.time_us >= until_us
    left = touch.phase == Phase.DRY
    touched = arrived | ((tip.touch.phase != Phase.DRY) & active)
    again, repeats = _again(touch, arrival, tip.repeats, touched & left & ~over, setting)
    ended = touched & (left | over) & ~again
    room = tip.contacts < tip.rows.shape[0]
    row = _row(touch, arrival, held=~left)
    place_of_row = jnp.where(ended & room, tip.contacts, tip.rows.shape[0])
    full = ended & ~room
    outcome = jnp.where(full, MotionOutcome.CONTACT_LIMIT, tip.outcome)
    outcome = jnp.where(ended & ~left, MotionOutcome.HELD, outcome)
    outcome = jnp.where(lost, MotionOutcome.STEP_LIMIT, outcome)
    outcome = jnp.where(jnp.isfinite(touch.state.x), outcome, MotionOutcome.UNRESOLVED)
    flown = free & ~arrived
    if setting.agreement is not None:
        came = ContactState(arrival.gap_nm, arrival.gap_rate, arrival.time_us, jnp.zeros_like(arrival.time_us))
        back = TipInContact.arriving(driven, came, jnp.ones_like(left))
        touch = jax.tree.map(lambda new, old: jnp.where(again, new, old), back, touch)
    return ContactTip(
        touch=touch,
        arrival=arrival,
        repeats=repeats,
        contacts=tip.contacts + ended.astype(tip.contacts.dtype),
        rows=tip.rows.at[place_of_row].set(row, mode="drop"),
        outcome=jnp.where(tip.done, tip.outcome, outcome).astype(jnp.int32),
        done=tip.done | flown | (touched & over) | full | lost | ~jnp.isfinite(touch.state.x),
        rounds=tip.rounds + 1,
    )


def _again(
    touch: TipInContact, arrival: Arrival, repeats: Repeats, left: Array, setting: DrivenSetting
) -> tuple[Array, Repeats]:
    """Say whether a contact that a tip has left is to be computed again in finer steps, and what that will know."""
    if setting.agreement is None:
        return jnp.zeros_like(left), repeats
    came, now, before = lax.stop_gradient((arrival, touch.state, repeats))
    gaps = came.gap_nm + now.x
    # without a bridge the way is that into the sample and back
    gaps = jnp.where(gaps > 0.0, gaps, -2.0 * touch.deepest_gap_nm)
    lasts = (now.time_us - came.time_us) * jnp.abs(came.gap_rate) > _LASTS_LONG * gaps
    slowed = setting.magnified * now.gap_rate**2 < came.gap_rate**2
    differs = jnp.maximum(
        jnp.abs(now.gap_rate - before.departure_rate),
        10.0 * jnp.abs(now.time_us - before.departure_us) * jnp.abs(now.gap_rate),
    ) > _LESS * setting.agreement * jnp.abs(now.gap_rate)
    magnified = slowed | lasts | (touch.junctions != 1)
    again = left & jnp.where(repeats.times == 0, magnified, differs & (repeats.times < _MOST_REPEATS))
    known = Repeats(repeats.times + 1, now.time_us, now.gap_rate)
    kept = repeats._replace(times=jnp.where(left, 0, repeats.times))
    return again, jax.tree.map(lambda new, old: jnp.where(again, new, old), known, kept)


def _fly(driven: Driven, place: ContactState, free: Array, until_us: Array) -> tuple[Array, Array, ContactState]:
    """Return whether a free tip meets the bridge before the end, whether the search gave up, and where the tip is."""
    surface, start = driven.surface, place.time_us
    # tips that are not free start below the level, so that their search ends at once
    gap = jnp.where(free, place.x, driven.forms_nm - 1.0)
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
    gap = jnp.where(arrives, driven.forms_nm, position - height)
    moved = ContactState(gap, velocity - speed, time, jnp.zeros_like(time))
    return arrives, lost, ContactState(*(jnp.where(free, new, old) for new, old in zip(moved, place, strict=True)))


def _through(
    driven: Driven, touch: TipInContact, arrived: Array, active: Array, until_us: Array, setting: DrivenSetting
) -> TipInContact:
    """Return the tip as far through its contact as the quick way holds."""
    if setting.quick is None:
        return touch

    def needed(driven, touch, arrived, active, until_us):
        del until_us
        return arrived | (active & at_junction(driven, touch))

    def through(driven, touch, arrived, active, until_us):
        return go_quickly(driven, touch, arrived, active, until_us, setting)

    one_pass = repeat_for(through, needed, changed=1, passes=1, block=_LEGS_AT_ONCE)
    return one_pass(driven, touch, arrived, active, until_us)


def _step(
    driven: Driven,
    touch: TipInContact,
    active: Array,
    repeats: Array,
    until_us: Array,
    setting: DrivenSetting,
    *,
    reverse: bool,
) -> TipInContact:
    """Return a tip in contact after some trial steps, or where the quick way may go on; a free one stays as it is."""
    fineness = setting.fineness * _FINER ** repeats.astype(until_us.dtype)

    def going(touch, active, until_us):
        finite = jnp.isfinite(touch.state.x) & jnp.isfinite(touch.state.gap_rate)
        return active & (touch.phase != Phase.DRY) & (touch.state.time_us < until_us) & finite

    def waits_not(driven, touch, active, fineness, until_us):
        # a tip that has just formed the junction waits for the quick way; one for which that did not hold does not,
        # nor one that repeats its contact
        moves = going(touch, active, until_us)
        if setting.quick is None:
            return moves
        return moves & ~(at_junction(driven, touch) & (fineness == setting.fineness))

    def advanced(driven, touch, moves, fineness, until_us):
        after = advance(driven, touch, until_us, fineness)
        return jax.tree.map(lambda new, old: jnp.where(moves, new, old), after, touch)

    if reverse:

        def once(touch, _):
            return advanced(driven, touch, going(touch, active, until_us), fineness, until_us), None

        return lax.scan(once, touch, None, length=setting.trials)[0]

    def run(driven, touch, active, fineness, until_us):
        def on(state):
            touch, count = state
            return jnp.any(waits_not(driven, touch, active, fineness, until_us)) & (count < _TRIALS)

        def more(state):
            touch, count = state
            moves = waits_not(driven, touch, active, fineness, until_us)
            return advanced(driven, touch, moves, fineness, until_us), count + 1

        return lax.while_loop(on, more, (touch, 0))[0]

    passes = -(-setting.trials // _TRIALS)
    few = repeat_for(run, waits_not, changed=1, passes=passes, block=_TRIALS_AT_ONCE)
    return few(driven, touch, active, fineness, until_us)


def _row(touch: TipInContact, arrival: Arrival, *, held: Array) -> Float[Array, " columns"]:
    place = touch.state
    row = ContactRow(
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
