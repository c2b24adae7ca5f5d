"""Law scenes in time: the impact map over whatever surface the tip sees, and rests on it, to the end of a duration.

Takes a scene with a law and a start (us, nm, nm/us in the lab); gives a `Simulation` (eqs. 2 to 4 and 6).

A round of the loop (`follow_rounds`) is a flight, the impact that ends it and the rest after it, written into one row.
All shapes are fixed; a batch goes on until its last tip has ended. The tip rests on the surface for as long as the
surface pushes it.

A tip that moves with the surface s, without adhesion, needs the push N/m = s'' + (Omega/Q) s' + Omega^2 s from it, and
is let go when the push would turn into a pull. It comes to rest by a capture, or by infinitely many impacts in finite
time: while N hardly changes the tip falls back with the acceleration -N/m, every flight takes 2 u/(N/m), r times as
long as the one before, and all of them together 2 u_out/((N/m) (1 - r)).
"""

from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, ArrayLike, Bool, Float

from afm_jax.apparatus.cantilever import Cantilever
from afm_jax.apparatus.platform import Platform
from afm_jax.apparatus.scene import Scene
from afm_jax.apparatus.surface import Surface
from afm_jax.contact.junction import ContactPhase
from afm_jax.impact.first_impact import DEFAULT_ROOT_TOLERANCE_US, time_above
from afm_jax.impact.law import Law, impact_law_of
from afm_jax.impact.map import Departure, NextImpact, Search, flight_from, impact_after
from afm_jax.motion.record import (
    ContactKind,
    FollowedTip,
    MotionOutcome,
    Simulation,
    State,
    contacts_in_lab,
    follow_rounds,
    to_gap,
    to_lab,
    where,
)
from afm_jax.outcomes import Outcome
from afm_jax.solve.derivatives import implicit_root
from afm_jax.solve.lanes import compiled_quickly

_FLIGHT_STEPS = 1_000_000
"""Steps of the search of one flight: as many as it takes, a flight that never lands needs some every period."""
_ON_SURFACE_NM = 1e-9
"""Depth up to which a start is taken to lie on the surface: rounding of lab coordinates. Times the fastest angular
frequency: speed against the surface up to which it is at rest there."""
CONSTANT_PUSH = 1e-5
"""Largest relative change of the push during the rest of a series of impacts that is summed up."""
_SHORTEST_PULL = 1e-6
"""Phase (rad of the fastest motion) below which a pull is too short to let go: the gap would stay below 1e-18 beta."""
_TAKE_OFF = 1e-3
"""Phase (rad of the fastest motion) after which a tip let go is clearly above the surface: 1e-10 beta."""
_MAX_STEPS = 1_000_000


class LawRow(NamedTuple):
    """An impact, relative to the surface; stored as one vector."""

    kind: Float[Array, "..."]
    arrival_us: Float[Array, "..."]
    approach: Float[Array, "..."]
    departure_us: Float[Array, "..."]
    rebound: Float[Array, "..."]


@compiled_quickly(static_argnames=("max_contacts", "reverse"))
def follow_law(  # noqa: PLR0913
    scene: Scene,
    surface: Platform | Surface,
    response: Surface | None,
    start: State,
    until: Float[Array, ""],
    *,
    max_contacts: int,
    tolerance: ArrayLike = DEFAULT_ROOT_TOLERANCE_US,
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
        start: the tip at the start, in the lab, above the surface, or on it: leaving it, or at rest, which counts as
            an impact at speed 0.
        until: time of the end in us.
        max_contacts: rows for contacts.
        tolerance: of the times of impacts, in us.
        reverse: make it differentiable in reverse mode: all rounds are run, in blocks that are recomputed backwards.

    Raises:
        TypeError: if the scene's interaction is not an impact law.
    """
    impact_law_of(scene)
    seen = eqx.tree_at(lambda parts: parts.platform, scene, surface)
    gap, rate = to_gap(surface, response, start)
    touches = (gap < 0.0) & (gap > -_ON_SURFACE_NM)
    gap = gap + lax.stop_gradient(jnp.where(touches, -gap, 0.0))
    departure = Departure(start.time_us, gap, rate + surface.velocity(start.time_us))
    no_row, begun = LawRow(*[jnp.zeros_like(gap)] * len(LawRow._fields)), jnp.int32(MotionOutcome.FINISHED)
    course = FollowedTip.begun(departure, no_row, begun, rows=max_contacts)
    # one more, which finds no room
    search = Search(_FLIGHT_STEPS, jnp.asarray(tolerance, until.dtype), until, from_above=True)
    course = follow_rounds(partial(_one_flight, seen, until, search), course, rounds=max_contacts + 1, reverse=reverse)
    row, no_gap = LawRow(*course.rows.T), jnp.zeros(max_contacts)
    arrival = State(row.arrival_us, no_gap, -row.approach)
    departure = State(row.departure_us, no_gap, row.rebound)
    lost = 0.5 * scene.cantilever.mass_ng * (row.approach**2 - row.rebound**2)
    held = course.outcome == MotionOutcome.HELD
    return Simulation(
        start=start,
        contacts=contacts_in_lab(surface, response, row.kind, arrival, departure, lost),
        count=course.contacts,
        final=_final(seen, response, course.tip, course.outcome, until),
        phase=jnp.where(held, jnp.int32(ContactPhase.JUNCTION), jnp.int32(ContactPhase.DRY)),
        outcome=course.outcome,
    )


def _one_flight(seen: Scene, until: Array, search: Search, course: FollowedTip) -> FollowedTip:
    """Return a tip after a flight, its impact and the rest that follows, with its row; as it was where it has ended."""
    departure, flies = course.tip, ~course.done
    impact = impact_after(seen, departure, search, flies=flies)
    impact = where(course.contacts == 0, or_rest(seen, departure, impact), impact)
    ended = impact.outcome
    landed = (ended == Outcome.IMPACT) | (ended == Outcome.CAPTURED)
    arrived = flies & landed & (impact.arrival_time_us < until)
    failed = flies & ~landed & (ended != Outcome.NO_FURTHER_IMPACT)
    row, beyond, lost = through_impact(seen, impact, arrived, until)
    held = arrived & (row.kind == ContactKind.HELD)
    outcome = jnp.where(held, MotionOutcome.HELD, MotionOutcome.FINISHED)
    known = [ended == Outcome.STEP_LIMIT, (ended == Outcome.INVALID_START) & (course.contacts == 0)]
    failure = jnp.select(known, [MotionOutcome.STEP_LIMIT, MotionOutcome.INVALID_START], MotionOutcome.UNRESOLVED)
    outcome = jnp.where(failed, failure, outcome)
    outcome = jnp.where(lost, MotionOutcome.STEP_LIMIT, outcome)
    goes_on = arrived & ~held & ~lost
    return course.after(where(goes_on, beyond, departure), row, arrived & ~lost, outcome, ~goes_on)


def or_rest(seen: Scene, departure: Departure, impact: NextImpact) -> NextImpact:
    """Return the capture that a tip at rest on the surface at its start has had, or the impact that was found."""
    time, gap, velocity = departure
    speed, fastest = seen.platform.velocity(time), Bed(seen.cantilever, seen.platform).fastest
    rests = (gap == 0.0) & (jnp.abs(velocity - speed) <= _ON_SURFACE_NM * fastest)
    captured = NextImpact(time, time, speed, speed, jnp.full_like(impact.outcome, Outcome.CAPTURED), rests)
    return where(rests, captured, impact)


def through_impact(seen: Scene, impact: NextImpact, arrived: Array, until: Array) -> tuple[LawRow, Departure, Array]:
    """Return the row of an impact and the beginning of the next flight; where there is none, numbers without meaning.

    The third: whether the search for the end of a rest gave up.

    Args:
        seen: a scene with a law, the platform the surface that its tip sees.
        impact: the impact.
        arrived: whether there is one, before the end.
        until: the end in us: a tip that rests then is held.
    """
    law, bed = impact_law_of(seen), Bed(seen.cantilever, seen.platform)
    arrival = jnp.where(arrived, impact.arrival_time_us, until)
    before = jnp.where(arrived, impact.velocity_before_nm_per_us, 0.0)
    approach = jnp.where(arrived, bed.surface.velocity(arrival) - before, 1.0)
    captured = arrived & (impact.outcome == Outcome.CAPTURED)
    leaving = jnp.where(arrived, impact.time_us, until)
    after = jnp.where(arrived, impact.velocity_after_nm_per_us, 0.0)
    rebound = jnp.where(arrived & ~captured, after - bed.surface.velocity(leaving), 0.0)
    chatters, lasts = chatter(bed, law, arrival, rebound)
    chatters = chatters & arrived & ~captured
    rests = captured | chatters
    resting = jnp.minimum(arrival + jnp.where(chatters, lasts, 0.0), until)
    is_let_go, release_us, lost = first_release(bed, jnp.where(rests & ~law.adheres, resting, until), until)
    away = Departure(*take_off(bed, release_us, until))
    next_flight = Departure(leaving, jnp.zeros_like(leaving), after)
    leaves = jnp.where(rests, is_let_go, leaving < until)
    kind = jnp.where(chatters, float(ContactKind.CHATTER), float(ContactKind.IMPACT))
    row = LawRow(
        kind=jnp.where(leaves, kind, float(ContactKind.HELD)),
        arrival_us=arrival,
        approach=approach,
        departure_us=jnp.where(rests, release_us, leaving),
        rebound=jnp.where(rests, 0.0, rebound),
    )
    return row, where(rests, away, next_flight), arrived & lost


def _final(seen: Scene, response: Surface | None, departure: Departure, outcome: Array, until: Array) -> State:
    """Return the last state in the lab, given the last departure and the simulation's outcome."""
    surface = seen.platform
    held = outcome == MotionOutcome.HELD
    time = jnp.where(held | (outcome == MotionOutcome.FINISHED), until, departure.time_us)
    height = flight_from(seen, departure).position
    position, velocity = seen.cantilever.propagator(time - departure.time_us)(height, departure.velocity_nm_per_us)
    gap, rate = to_gap(surface, None, State(time, position, velocity))
    return to_lab(surface, response, time, jnp.where(held, 0.0, gap), jnp.where(held, 0.0, rate))


class Bed(NamedTuple):
    """What a tip rests on and what holds it down; the surface is the one that the free tip sees."""

    cantilever: Cantilever
    surface: Platform | Surface

    @property
    def fastest(self) -> Float[Array, ""]:
        """Largest angular frequency in rad/us of tip and surface."""
        return jnp.maximum(self.cantilever.angular_frequency, self.surface.fastest_angular_frequency)

    @property
    def push_bend(self) -> Float[Array, ""]:
        """A bound of the push's second derivative in nm/us^4, positive: s'''' <= F^2 A, s''' <= F A, s'' <= A."""
        fastest = self.surface.fastest_angular_frequency
        decay, omega = self.cantilever.decay_rate, self.cantilever.angular_frequency
        factor = fastest**2 + 2.0 * decay * fastest + omega**2
        return jnp.maximum(self.surface.largest_acceleration_nm_per_us2 * factor, 1e-30)

    def push(self, time_us: Float[Array, ""]) -> Float[Array, ""]:
        """Return N/m = s'' + (Omega/Q) s' + Omega^2 s in nm/us^2: the gap of a tip at rest would accelerate by -N/m."""
        height, speed = self.surface.position_and_velocity(time_us)
        return self.surface.acceleration(time_us) - self.cantilever.acceleration(height, speed)

    def push_and_rate(self, time_us: Float[Array, ""]) -> tuple[Float[Array, ""], Float[Array, ""]]:
        """Return the push in nm/us^2 and its rate in nm/us^3."""
        return jax.jvp(self.push, (time_us,), (jnp.ones_like(time_us),))

    def time_pressed(self, time_us: Float[Array, ""]) -> Float[Array, ""]:
        """Return infinity where the push stays positive after a time in us, whatever the phase of the waves, else 0."""
        surface = self.surface
        decay = self.cantilever.decay_rate
        square = self.cantilever.angular_frequency**2
        rate, reach = surface.offset_rate_nm_per_us, surface.reach_nm
        waves = surface.largest_acceleration_nm_per_us2 + (
            2.0 * decay * surface.fastest_angular_frequency * reach + square * reach
        )
        least = square * (surface.offset_nm + rate * time_us) + 2.0 * decay * rate - waves
        return jnp.where((least >= 0.0) & (rate >= 0.0), jnp.inf, 0.0)


def first_release(
    bed: Bed, from_us: Float[Array, ""], until_us: Float[Array, ""]
) -> tuple[Bool[Array, ""], Float[Array, ""], Bool[Array, ""]]:
    """Return when a tip that rests from a time on is let go: the first time at which the push turns negative.

    The search cannot miss it: with the push n >= 0, its slope n' and |n''| <= M, the push stays positive for
    (n' + sqrt(n'^2 + 2 M n))/M at least. Pulls shorter than 1e-6 rad of the fastest motion are passed over.

    Args:
        bed: what the tip rests on.
        from_us: since when it rests.
        until_us: end of the search.

    Returns:
        Whether the surface lets the tip go before the end of the search; when, with implicit derivatives, else that
        end; whether the search gave up. A tip that is lifted from the beginning is let go at once.
    """
    still, begin, until = lax.stop_gradient((bed, from_us, until_us))
    resolution = 4.0 * jnp.finfo(begin.dtype).eps
    bend, shortest = still.push_bend, _SHORTEST_PULL / still.fastest

    def searching(state):
        time, lifted, steps = state
        return ~lifted & (time < until) & (steps < _MAX_STEPS)

    def advance(state):
        time, _, steps = state
        push, rate = still.push_and_rate(time)
        step = jnp.where(push > 0.0, time_above(push, rate, bend), 0.0)
        met = step <= jnp.maximum(DEFAULT_ROOT_TOLERANCE_US, resolution * jnp.abs(time))
        lifted = met & ((rate < -bend * shortest) | (push < -bend * shortest**2))
        step = jnp.where(met & ~lifted, shortest, step)
        return time + jnp.maximum(step, still.time_pressed(time)), lifted, steps + 1

    none = jnp.zeros_like(begin, dtype=bool)
    time, lifted, steps = lax.while_loop(searching, advance, (begin, none, jnp.zeros_like(begin, dtype=jnp.int32)))
    happens = lifted & (time < until)
    at_once = still.push(begin) < -bend * shortest**2
    root = implicit_root(lambda time, bed: bed.push(time), jnp.where(happens, time, until), bed)
    when = jnp.where(happens, jnp.where(at_once, from_us, root), until_us)
    return happens, when, ~lifted & (time < until) & (steps >= _MAX_STEPS)


def take_off(
    bed: Bed, release_us: Float[Array, ""], until_us: Float[Array, ""]
) -> tuple[Float[Array, ""], Float[Array, ""], Float[Array, ""]]:
    """Return a tip shortly after its release: time in us, gap in nm, velocity in nm/us.

    At the release gap, gap rate and, as a rule, the gap's acceleration vanish: no search can start there. The tip flies
    freely from there in closed form, and is surely above the surface while the pull lasts (the gap is the pull's
    response, and the response to a blow is positive for half a period): so it may begin later, at most 1e-3 rad of the
    fastest motion, and within a lower bound of the pull's duration.
    """
    still, release, until = lax.stop_gradient((bed, release_us, until_us))
    push, rate = still.push_and_rate(release)
    # not 0: a push and a rate of exactly 0 (nothing moves) have no time
    lasts = time_above(jnp.maximum(-push, 1e-30), -rate, still.push_bend)
    after = jnp.clip(lasts, _SHORTEST_PULL / still.fastest, _TAKE_OFF / still.fastest)
    after = jnp.minimum(after, jnp.maximum(until - release, 0.0))
    height, speed = bed.surface.position_and_velocity(release_us)
    position, velocity = bed.cantilever.propagator(after)(height, speed)
    time = release_us + after
    gap = position - bed.surface.position(time)
    # rounding must not put the tip below the surface
    return time, gap + lax.stop_gradient(jnp.maximum(gap, 1e-30) - gap), velocity


def chatter(
    bed: Bed, law: Law, arrival_us: Float[Array, ""], rebound: Float[Array, ""]
) -> tuple[Bool[Array, ""], Float[Array, ""]]:
    """Return whether the impacts that follow an impact may be summed up, and how long they last in us.

    They may once the push changes by less than 1e-5 of itself while they last; the sum is then right to 1e-5 of itself,
    and what is left out is a speed of at most u_out, below 5e-6 N/m over the fastest angular frequency, and a gap of
    u_out^2/2(N/m). A viscous loss ends the series sooner, by a capture.

    Args:
        bed: what the tip comes to rest on.
        law: without adhesion; with it the tip is captured, with a collision delay there is no series.
        arrival_us: time of the impact.
        rebound: its rebound speed in nm/us.
    """
    push, rate = bed.push_and_rate(arrival_us)
    loss = 1.0 - law.slow_restitution
    converges = (push > 0.0) & (loss > 0.0) & ~law.adheres
    lasts = 2.0 * rebound / jnp.where(converges, push * loss, 1.0)
    change = lasts * jnp.maximum(bed.fastest * push, jnp.abs(rate))
    short = converges & (change < CONSTANT_PUSH * push) & (law.delay is None)
    return short, jnp.where(short, lasts, 0.0)
