"""Where a law lets the tip rest: on the surface, for as long as the surface pushes it.

A tip that moves with the surface s, without adhesion, needs the push N/m = s'' + (Omega/Q) s' + Omega^2 s from it, and
is let go when the push would turn into a pull. It comes to rest by a capture, or by infinitely many impacts in finite
time: while N hardly changes the tip falls back with the acceleration -N/m, every flight takes 2 u/(N/m), r times as
long as the one before, and all of them together 2 u_out/((N/m) (1 - r)).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from afm_jax.apparatus.cantilever import Cantilever
from afm_jax.apparatus.platform import Platform
from afm_jax.apparatus.surface import Surface
from afm_jax.impact.first_impact import DEFAULT_ROOT_TOLERANCE_US, time_above
from afm_jax.impact.implicit import implicit_root
from afm_jax.impact.law import ImpactLaw

_CONSTANT_PUSH = 1e-5
"""Largest relative change of the push during the rest of a series of impacts that is summed up."""
_SHORTEST_PULL = 1e-6
"""Phase (rad of the fastest motion) below which a pull is too short to let go: the gap would stay below 1e-18 beta."""
_TAKE_OFF = 1e-3
"""Phase (rad of the fastest motion) after which a tip let go is clearly above the surface: 1e-10 beta."""
_MAX_STEPS = 1_000_000


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
        """Return for how long after a time in us the push stays positive, whatever the phase of the waves."""
        surface, decay, square = self.surface, self.cantilever.decay_rate, self.cantilever.angular_frequency**2
        rate, reach = surface.offset_rate_nm_per_us, surface.reach_nm
        waves = surface.largest_acceleration_nm_per_us2 + (
            2.0 * decay * surface.fastest_angular_frequency * reach + square * reach
        )
        least = square * (surface.offset_nm + rate * time_us) + 2.0 * decay * rate - waves
        sinks = rate < 0.0
        lasts = jnp.where(sinks, least / jnp.where(sinks, -square * rate, 1.0), jnp.inf)
        return jnp.where(least >= 0.0, lasts, 0.0)


class Release(NamedTuple):
    """When the surface lets a resting tip go."""

    happens: Bool[Array, ""]
    """Whether it does before the end of the search."""
    time_us: Float[Array, ""]
    """When; the end of the search where it does not."""
    lost: Bool[Array, ""]
    """The search gave up."""


def first_release(bed: Bed, from_us: Float[Array, ""], until_us: Float[Array, ""]) -> Release:
    """Return when a tip that rests from a time on is let go: the first time at which the push turns negative.

    The search cannot miss it: with the push n >= 0, its slope n' and |n''| <= M, the push stays positive for
    (n' + sqrt(n'^2 + 2 M n))/M at least. Pulls shorter than 1e-6 rad of the fastest motion are passed over.

    Args:
        bed: what the tip rests on.
        from_us: since when it rests.
        until_us: end of the search.

    Returns:
        The release, its time with implicit derivatives. A tip that is pulled from the beginning is let go at once.
    """
    still, begin, until = lax.stop_gradient((bed, from_us, until_us))
    resolution = 4.0 * jnp.finfo(begin.dtype).eps
    bend, shortest = still.push_bend, _SHORTEST_PULL / still.fastest

    def searching(state):
        time, pulled, steps = state
        return ~pulled & (time < until) & (steps < _MAX_STEPS)

    def advance(state):
        time, _, steps = state
        push, rate = still.push_and_rate(time)
        step = jnp.where(push > 0.0, time_above(push, rate, bend), 0.0)
        met = step <= jnp.maximum(DEFAULT_ROOT_TOLERANCE_US, resolution * jnp.abs(time))
        pulled = met & ((rate < -bend * shortest) | (push < -bend * shortest**2))
        step = jnp.where(met & ~pulled, shortest, step)
        return time + jnp.maximum(step, still.time_pressed(time)), pulled, steps + 1

    none = jnp.zeros_like(begin, dtype=bool)
    time, pulled, steps = lax.while_loop(searching, advance, (begin, none, jnp.zeros_like(begin, dtype=jnp.int32)))
    happens = pulled & (time < until)
    at_once = still.push(begin) < -bend * shortest**2
    root = implicit_root(_push_at, jnp.where(happens, time, until), bed)
    when = jnp.where(happens, jnp.where(at_once, from_us, root), until_us)
    return Release(happens, when, ~pulled & (time < until) & (steps >= _MAX_STEPS))


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
    bed: Bed, law: ImpactLaw, arrival_us: Float[Array, ""], rebound: Float[Array, ""]
) -> tuple[Bool[Array, ""], Float[Array, ""]]:
    """Return whether the impacts that follow an impact may be summed up, and how long they last in us.

    They may once the push changes by less than 1e-5 of itself while they last; the sum is then right to 1e-5 of itself,
    and what is left out is a speed of at most u_out, below 5e-6 N/m over the fastest angular frequency, and a gap of
    u_out^2/2(N/m). A viscous loss ends the series sooner, by a capture.

    Args:
        bed: what the tip comes to rest on.
        law: with epsilon = 0; with adhesion the tip is captured, with a collision delay there is no series.
        arrival_us: time of the impact.
        rebound: its rebound speed in nm/us.
    """
    push, rate = bed.push_and_rate(arrival_us)
    loss = 1.0 - law.r
    converges = (push > 0.0) & (loss > 0.0) & (law.epsilon == 0.0)
    lasts = 2.0 * rebound / jnp.where(converges, push * loss, 1.0)
    change = lasts * jnp.maximum(bed.fastest * push, jnp.abs(rate))
    short = converges & (change < _CONSTANT_PUSH * push)
    if law.delay is not None:
        short = jnp.zeros_like(short)
    return short, jnp.where(short, lasts, 0.0)


def _push_at(time_us: Float[Array, ""], bed: Bed) -> Float[Array, ""]:
    return bed.push(time_us)
