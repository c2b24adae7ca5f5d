"""A contact scene in time (eq. 16): closed-form flight to the bridge, through the contact, and so on to the end.

Takes a scene with a contact and a start (us, nm, nm/us in the lab); gives a `Simulation`.

A leg is one integral through the whole bridge, or through the whole junction, with a coordinate in place of time: the
gap D in the bridge, s = sqrt(A) of JKR's normalised contact radius A (eq. 15) in the junction. Thresholds are met
without a search, and the speed follows from the energy. A leg holds (is accurate) for a tip that passes without turning
in the bridge or becoming slow; every other tip takes steps in time (`contact/step.py`) from the end of the last leg
that held.

One round of the loop (`follow_rounds`) is a flight to the next contact, the legs that hold (`legs_through`), then some
steps in time until a leg begins or the tip has left. Contacts that magnify errors are computed again in finer steps
(`_repetition`).

Every tip of a batch goes at its own rate, and a batch does not wait for the few contacts that turn inside the bridge.
All shapes are fixed.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from afm_jax.apparatus.platform import Platform
from afm_jax.apparatus.scene import Scene
from afm_jax.apparatus.surface import Surface
from afm_jax.contact.bridge_leg import go_in, go_out
from afm_jax.contact.driven import ContactState, Driven, Leg, driven_by
from afm_jax.contact.junction import ContactPhase
from afm_jax.contact.junction_leg import go_through_junction
from afm_jax.contact.settings import DrivenSetting
from afm_jax.contact.step import TipInContact, advance, inverse_junction_step
from afm_jax.impact.first_impact import Flight, first_impact
from afm_jax.motion.record import (
    ContactDetail,
    ContactKind,
    Contacts,
    FollowedTip,
    MotionOutcome,
    Simulation,
    State,
    as_vector,
    contacts_in_lab,
    follow_rounds,
    to_gap,
    to_lab,
    where,
)
from afm_jax.outcomes import Outcome
from afm_jax.solve.lanes import compiled_quickly, repeat_for

_FLIGHT_STEPS = 2000
"""Most steps of the search for the end of a flight."""
_ROUNDS_PER_CONTACT, _SPARE_ROUNDS = 4, 64
"""Rounds of a motion in reverse mode: for every contact there is room for, and besides."""
_HELD_ROUNDS_PER_CONTACT, _LEAST_HELD_ROUNDS = 256, 1 << 16
"""Far more rounds than any motion takes that comes to an end: for every contact there is room for, and at least."""
_TRIALS_BACKWARDS = 40
"""Trial steps of a round when all of them are run and kept for the reverse pass."""
_LEGS_AT_ONCE, _TRIALS_AT_ONCE = 256, 64
"""Tips of a batch that go through legs together, and that try steps in time together."""
_TRIALS = 4
"""Trial steps between two checks which tips of a batch need more."""
_ROUNDINGS = 32.0
"""Roundings of the numbers from which a gap is made, within which it is at a level."""
_LASTS_LONG = 5.0
"""Duration from which a contact counts as long, in units of (gap at arrival + gap at departure)/(arrival speed)."""
_FINER, _MOST_REPEATS = 1.5, 5
"""Factor by which steps are finer in each repetition of a contact, and the most repetitions."""
_LESS = 4.0
"""Factor by which a repetition is taken to lower the error: the order of the steps, 8, gives 1.5^8 = 25."""


class ContactRow(NamedTuple):
    """One contact, kept as numbers in one vector: gaps in nm over the surface, their rates in nm/us, times in us."""

    kind: Int[Array, "..."]
    arrival: ContactState
    tip: TipInContact
    """Where it ended, with a record of the contact."""


class Repeats(NamedTuple):
    """How often the present contact was computed again, and what it ended with the last time; scalars of one tip."""

    times: Int[Array, ""]
    departure_us: Float[Array, ""]
    departure_rate: Float[Array, ""]


class ContactTip(NamedTuple):
    """A tip on its way through a scene; scalars of one tip."""

    tip: TipInContact
    """State and phase, and a record of the present contact; x of a free tip is the gap."""
    arrival: ContactState
    """Where the present contact began."""
    repeats: Repeats


@compiled_quickly(static_argnames=("max_contacts", "setting", "max_rounds", "reverse"))
def follow_contacts(  # noqa: PLR0913
    scene: Scene,
    surface: Platform | Surface,
    response: Surface | None,
    start: State,
    until: Float[Array, ""],
    *,
    max_contacts: int,
    setting: DrivenSetting,
    max_rounds: int | None = None,
    reverse: bool = False,
) -> Simulation:
    """Return a scene with a contact followed in time.

    Args:
        scene: its interaction is a `Contact`.
        surface: what the free tip sees (`surface_of`).
        response: the steady response to drives of base and tip, or None.
        start: the tip at the start, in the lab, outside the sample.
        until: time of the end in us.
        max_contacts: rows for contacts.
        setting: how finely contacts are resolved.
        max_rounds: most rounds; None: more than any motion takes, in reverse mode four for every contact.
        reverse: make it differentiable in reverse mode: all rounds are run, in blocks that are recomputed backwards.
    """
    rounds = max(_HELD_ROUNDS_PER_CONTACT * max_contacts, _LEAST_HELD_ROUNDS)
    if reverse:
        # legs tell by NaN that they do not hold, which reverse derivatives would spread
        setting = setting._replace(quick=None, trials=_TRIALS_BACKWARDS, agreement=None)
        rounds = _ROUNDS_PER_CONTACT * max_contacts + _SPARE_ROUNDS
    driven = driven_by(scene.interaction, scene.cantilever, surface)
    course = _at_start(driven, start.time_us, *to_gap(surface, response, start), rows=max_contacts)
    one_round = partial(_round, driven, until, setting, reverse)
    course = follow_rounds(one_round, course, rounds=max_rounds or rounds, reverse=reverse)
    tip, arrival, _ = course.tip
    row = jax.vmap(as_vector(ContactRow(course.contacts, arrival, tip))[1])(course.rows)
    return Simulation(
        start=start,
        contacts=_contacts(row, scene, surface, response, driven),
        count=course.contacts,
        final=to_lab(surface, response, tip.state.time_us, driven.gap(tip.state.x, tip.phase), tip.state.gap_rate),
        phase=tip.phase,
        outcome=course.outcome,
    )


@jax.jit
def has_just_left(
    surface: Platform | Surface, ends_nm: Array, time_us: ArrayLike, gap_nm: Array, rate: ArrayLike
) -> Bool[Array, "..."]:
    """Say whether a tip has just left a contact: it is where contact ends and the gap opens, both but for rounding.

    It is free there, although a contact may begin at that very gap: where nothing bridges it, the way in begins where
    the way out ends, and only the gap's rate tells the two apart. A tip that has grazed the sample leaves it with next
    to no rate.

    Args:
        surface: what the free tip sees (`surface_of`).
        ends_nm: the gap at which contact ends (`end_of_contact`).
        time_us: the time; arrays of one shape from here on.
        gap_nm: of the tip then.
        rate: of the gap in nm/us.
    """
    # of the heights whose difference the gap is, and of the surface's phase omega t
    heights = jnp.abs(surface.offset_nm + surface.offset_rate_nm_per_us * time_us) + surface.reach_nm + jnp.abs(gap_nm)
    moved = jnp.abs(time_us) * surface.top_speed_nm_per_us
    rounding = _ROUNDINGS * jnp.finfo(heights.dtype).eps * (heights + moved)
    return (jnp.abs(gap_nm - ends_nm) <= rounding) & (jnp.asarray(rate) > -slowest_departure(surface, time_us))


def slowest_departure(surface: Platform | Surface, time_us: ArrayLike) -> Float[Array, "..."]:
    """Return the gap rate in nm/us below which its rounding does not tell whether a gap opens or closes.

    Args:
        surface: what the free tip sees.
        time_us: the time.
    """
    speeds = surface.top_speed_nm_per_us + jnp.abs(time_us) * surface.largest_acceleration_nm_per_us2
    return _ROUNDINGS * jnp.finfo(speeds.dtype).eps * speeds


def _at_start(driven: Driven, time_us: Array, gap_nm: Array, rate: Array, *, rows: int) -> FollowedTip:
    """Return a tip at its start: free above the gap where the bridge forms or if it has just left, else in the bridge.

    One that has just left starts exactly where contact ends, on its way up, with the derivatives of what was given.
    """
    surface = driven.driving.surface
    leaves = has_just_left(surface, driven.ends_nm, time_us, gap_nm, rate)
    gap_nm = gap_nm + lax.stop_gradient(jnp.where(leaves, driven.ends_nm - gap_nm, 0.0))
    slower = jnp.maximum(slowest_departure(surface, time_us) - rate, 0.0)
    rate = rate + lax.stop_gradient(jnp.where(leaves, slower, 0.0))
    above = leaves | (gap_nm > driven.junction.forms_gap_nm)
    sane = jnp.isfinite(time_us) & jnp.isfinite(rate) & above
    outcome = jnp.where(sane, MotionOutcome.FINISHED, MotionOutcome.INVALID_START)
    outcome = jnp.where(driven.junction.exists, outcome, MotionOutcome.NO_JUNCTION)
    phase = jnp.where(leaves | (gap_nm > driven.forms_nm), ContactPhase.DRY, ContactPhase.BRIDGE)
    none, zero = jnp.zeros((), jnp.int32), jnp.zeros_like(time_us)
    state = ContactState(gap_nm, rate, time_us, zero)
    tip = TipInContact.at_start(state, phase)
    start, no_row = ContactTip(tip, state, Repeats(none, zero, zero)), ContactRow(none, state, tip)
    return FollowedTip.begun(start, no_row, outcome.astype(jnp.int32), rows=rows)


def _round(driven: Driven, until_us: Array, setting: DrivenSetting, reverse: bool, course: FollowedTip) -> FollowedTip:  # noqa: FBT001
    """Return a tip after one round: flight, legs through the contact, steps in time where those do not hold."""
    (tip, arrival, repeats), active = course.tip, ~course.done
    free = (tip.phase == ContactPhase.DRY) & active
    flown, arrives, lost = _fly(driven, tip.state, free, until_us)
    tip = where(free, TipInContact.arriving(driven, flown, arrives), tip)
    arrival = where(arrives, flown, arrival)
    tip = _through_legs(driven, tip, arrives, active & (repeats.times == 0), until_us, setting)
    tip = _step_in_time(driven, tip, active, repeats.times, until_us, setting, reverse=reverse)

    in_contact = active & (arrives | ~free)
    leaves = tip.phase == ContactPhase.DRY
    over = tip.state.time_us >= until_us
    again, repeats = _repetition(tip, arrival, repeats, in_contact & leaves & ~over, setting)
    ends, finite = in_contact & (leaves | over) & ~again, jnp.isfinite(tip.state.x)
    outcome = jnp.where(ends & ~leaves, MotionOutcome.HELD, MotionOutcome.FINISHED)
    outcome = jnp.where(lost, MotionOutcome.STEP_LIMIT, outcome)
    outcome = jnp.where(finite, outcome, MotionOutcome.UNRESOLVED)
    row = ContactRow(jnp.where(leaves, ContactKind.IMPACT, ContactKind.HELD), arrival, tip)
    if setting.agreement is not None:
        tip = where(again, TipInContact.arriving(driven, arrival, jnp.ones_like(again)), tip)
    is_over = (free & ~arrives) | (in_contact & over) | lost | ~finite
    return course.after(ContactTip(tip, arrival, repeats), row, ends, outcome, is_over)


def _fly(
    driven: Driven, start: ContactState, free: Array, until_us: Array
) -> tuple[ContactState, Bool[Array, ""], Bool[Array, ""]]:
    """Return where a free tip meets the bridge or is at the end, whether it meets it, and whether the search gave up.

    A tip that is not free stays where it is: its search starts below the level and ends at once.
    """
    cantilever, surface, _ = driven.driving
    gap = jnp.where(free, start.x, driven.forms_nm - 1.0)
    height, speed = surface.position_and_velocity(start.time_us)
    velocity = start.gap_rate + speed
    flight = Flight(cantilever, surface, start.time_us, velocity, gap, driven.forms_nm)
    arrival = first_impact(flight, max_steps=_FLIGHT_STEPS, latest_us=until_us - start.time_us)
    in_time = start.time_us + arrival.duration_us < until_us
    arrives = free & (arrival.outcome == Outcome.IMPACT) & in_time
    lost = free & (arrival.outcome == Outcome.STEP_LIMIT)
    duration = jnp.where(arrives, arrival.duration_us, jnp.where(free, until_us - start.time_us, 0.0))
    position, velocity = cantilever.propagator(duration)(gap + height, velocity)
    time = start.time_us + duration
    height, speed = surface.position_and_velocity(time)
    gap = jnp.where(arrives, driven.forms_nm, position - height)
    end = ContactState(gap, velocity - speed, time, jnp.zeros_like(time))
    return where(free, end, start), arrives, lost


def at_junction(driven: Driven, tip: TipInContact) -> Bool[Array, "..."]:
    """Return whether a tip has just formed the junction, so that legs may go on from there."""
    formed = (tip.phase == ContactPhase.JUNCTION) & (tip.state.x == driven.junction.forms_root)
    return formed & (tip.trial_length == 0.0)


def _through_legs(
    driven: Driven, tip: TipInContact, arrives: Array, active: Array, until_us: Array, setting: DrivenSetting
) -> TipInContact:
    """Return `legs_through`, of a batch for the tips alone that begin a leg."""
    if setting.quick is None:
        return tip
    one_pass = repeat_for(
        partial(legs_through, setting),
        lambda driven, tip, arrives, active, _: arrives | (active & at_junction(driven, tip)),
        changed=1,
        passes=1,
        block=_LEGS_AT_ONCE,
    )
    return one_pass(driven, tip, arrives, active, until_us)


def legs_through(
    setting: DrivenSetting, driven: Driven, tip: TipInContact, arrives: Array, active: Array, until_us: ArrayLike
) -> TipInContact:
    """Return a tip as far on its way through the contact as legs hold that end before a time.

    Args:
        setting: how finely; with a `quick` one.
        driven: the equation of motion.
        tip: the tip.
        arrives: whether it has just begun the contact.
        active: whether it moves.
        until_us: the time.
    """
    quick: Any = setting.quick

    def takes(leg, wanted):
        return wanted & leg.holds & (leg.state.time_us < until_us)

    inward = go_in(driven, tip.state, quick)
    forms = takes(inward, arrives)
    tip = _at_end_of(inward, tip, forms, ContactPhase.JUNCTION)
    tip = tip._replace(
        junctions=tip.junctions + forms.astype(tip.junctions.dtype),
        junction_forms_us=jnp.where(forms, tip.state.time_us, tip.junction_forms_us),
    )
    solid = go_through_junction(driven, tip.state, quick)
    waits = at_junction(driven, tip) & active
    # where nothing acts outside the junction, the retraction has no length
    goes_out = (driven.junction.breaks_gap_nm < driven.breaks_nm) | (not driven.bridge.spans)
    breaks = takes(solid, waits & goes_out)
    # one for which the leg does not hold is told how far to go in time, and waits no longer
    at_forming = lax.stop_gradient(tip.state._replace(x=driven.junction.forms_root))
    first_step = lax.stop_gradient(1.0 / (setting.fineness * inverse_junction_step(driven, at_forming)))
    tip = tip._replace(trial_length=jnp.where(waits & ~breaks, first_step, tip.trial_length))
    in_junction = tip.time_in_junction_us + solid.state.time_us - tip.state.time_us
    tip = _at_end_of(solid, tip, breaks, ContactPhase.BRIDGE)
    tip = tip._replace(
        junction_breaks_us=jnp.where(breaks, tip.state.time_us, tip.junction_breaks_us),
        time_in_junction_us=jnp.where(breaks, in_junction, tip.time_in_junction_us),
    )
    outward = go_out(driven, tip.state, quick)
    return _at_end_of(outward, tip, takes(outward, breaks), ContactPhase.DRY)


def _at_end_of(leg: Leg, tip: TipInContact, takes: Array, phase: ContactPhase) -> TipInContact:
    """Return a tip in a phase at the end of a leg where it takes the leg, else as it was."""
    return tip._replace(
        state=where(takes, leg.state, tip.state),
        phase=jnp.where(takes, phase, tip.phase).astype(tip.phase.dtype),
        trial_length=jnp.where(takes, 0.0, tip.trial_length),
        deepest_gap_nm=jnp.where(takes, jnp.minimum(tip.deepest_gap_nm, leg.deepest_gap_nm), tip.deepest_gap_nm),
    )


def _step_in_time(
    driven: Driven,
    tip: TipInContact,
    active: Array,
    repeats: Array,
    until_us: Array,
    setting: DrivenSetting,
    *,
    reverse: bool,
) -> TipInContact:
    """Return a tip in contact after some trial steps, or where legs may go on; a free one stays as it is."""
    fineness = setting.fineness * _FINER ** repeats.astype(until_us.dtype)

    def needs_steps(driven, tip, active, fineness, until_us):
        finite = jnp.isfinite(tip.state.x) & jnp.isfinite(tip.state.gap_rate)
        moves = active & (tip.phase != ContactPhase.DRY) & (tip.state.time_us < until_us) & finite
        if setting.quick is None:
            return moves
        # a tip that has just formed the junction waits for its leg, unless that did not hold or the contact is repeated
        return moves & ~(at_junction(driven, tip) & (fineness == setting.fineness))

    def one_trial(driven, tip, active, fineness, until_us):
        moving = needs_steps(driven, tip, active, fineness, until_us)
        return where(moving, advance(driven, tip, until_us, fineness), tip)

    def some_trials(driven, tip, *others):
        def goes_on(state):
            return jnp.any(needs_steps(driven, state[0], *others)) & (state[1] < _TRIALS)

        return lax.while_loop(goes_on, lambda state: (one_trial(driven, state[0], *others), state[1] + 1), (tip, 0))[0]

    others = active, fineness, until_us
    if reverse:
        return lax.scan(lambda tip, _: (one_trial(driven, tip, *others), None), tip, length=setting.trials)[0]
    passes = -(-setting.trials // _TRIALS)
    return repeat_for(some_trials, needs_steps, changed=1, passes=passes, block=_TRIALS_AT_ONCE)(driven, tip, *others)


def _repetition(
    tip: TipInContact, arrival: ContactState, repeats: Repeats, has_left: Array, setting: DrivenSetting
) -> tuple[Bool[Array, ""], Repeats]:
    """Return whether a contact that a tip has left is to be computed again in finer steps, and what it ended with.

    The first repetition is made of contacts that magnify errors: the tip left with less than 1/`magnified` of its
    kinetic energy, stayed long or, with `turned`, did not form the junction exactly once. More follow, up to five in
    all, until rate (relative) and time (in us, times 10) of the departure change by less than 4 `agreement`.
    """
    if setting.agreement is None:
        return jnp.zeros_like(has_left), repeats
    arrived, departed, previous = lax.stop_gradient((arrival, tip.state, repeats))
    gaps = arrived.x + departed.x
    # without a bridge the path leads into the sample and out again
    gaps = jnp.where(gaps > 0.0, gaps, -2.0 * tip.deepest_gap_nm)
    lasts = (departed.time_us - arrived.time_us) * jnp.abs(arrived.gap_rate) > _LASTS_LONG * gaps
    slowed = setting.magnified * departed.gap_rate**2 < arrived.gap_rate**2
    differs = jnp.maximum(
        jnp.abs(departed.gap_rate - previous.departure_rate),
        10.0 * jnp.abs(departed.time_us - previous.departure_us) * jnp.abs(departed.gap_rate),
    ) > _LESS * setting.agreement * jnp.abs(departed.gap_rate)
    magnified = slowed | lasts | (tip.junctions != 1) if setting.turned else slowed | lasts
    again = has_left & jnp.where(repeats.times == 0, magnified, differs & (repeats.times < _MOST_REPEATS))
    over = repeats._replace(times=jnp.where(has_left, 0, repeats.times))
    return again, where(again, Repeats(repeats.times + 1, departed.time_us, departed.gap_rate), over)


def _contacts(
    row: ContactRow, scene: Scene, surface: Platform | Surface, response: Surface | None, driven: Driven
) -> Contacts:
    """Return the rows as contacts in the lab, with the energy in aJ that each one dissipated.

    Loss = hysteresis of the bridge (of a tip that left) + junctions times their hysteresis + viscous loss.
    """
    junction, tip = driven.junction, row.tip
    has_left, touched = row.kind == ContactKind.IMPACT, tip.junctions > 0
    bridge = jnp.where(has_left, junction.bridge_hysteresis_aj, 0.0)
    solid = tip.junctions * junction.junction_hysteresis_aj
    depth = junction.shift_nm - jnp.where(touched, tip.deepest_gap_nm, 0.0)
    force = jnp.where(touched, scene.interaction.solid.force(depth), 0.0)
    detail = ContactDetail(
        junctions=tip.junctions.astype(jnp.int32),
        junction_forms_us=tip.junction_forms_us,
        junction_breaks_us=tip.junction_breaks_us,
        time_in_junction_us=tip.time_in_junction_us,
        deepest_gap_nm=tip.deepest_gap_nm,
        peak_force_nn=jnp.maximum(force, 0.0),
        bridge_hysteresis_aj=bridge,
        junction_hysteresis_aj=solid,
        viscous_loss_aj=tip.state.viscous_loss_aj,
    )
    arrival = State(row.arrival.time_us, row.arrival.x, row.arrival.gap_rate)
    departure = State(tip.state.time_us, tip.state.x, tip.state.gap_rate)
    lost = bridge + solid + tip.state.viscous_loss_aj
    return contacts_in_lab(surface, response, row.kind, arrival, departure, lost, detail)
