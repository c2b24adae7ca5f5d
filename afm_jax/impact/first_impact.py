"""The switching condition (eq. 3): the first time after an impact at which the tip meets the platform again.

Takes a flight: start in us, velocity in nm/us, gap and level in nm; gives its duration in us and an `Outcome`.

The search cannot miss a root. With a gap g >= 0, its slope g' and a bound |g''| <= M over the whole flight, the gap
stays positive for at least h = (g' + sqrt(g'^2 + 2 M g))/M, so a step of h never passes a root; it leaves the surface
by itself after an impact (g = 0, g' > 0) and closes in quadratically. M = Omega sqrt(E) sqrt(1 + 1/Q^2) + beta omega^2,
with E = v^2 + Omega^2 z^2, which a free flight never raises. The same bound against the highest point the platform can
reach gives a second, often much longer, safe step.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from afm_jax.apparatus.cantilever import Cantilever
from afm_jax.apparatus.platform import Platform
from afm_jax.apparatus.surface import Surface
from afm_jax.apparatus.trigonometry import sine_cosine
from afm_jax.outcomes import Outcome
from afm_jax.solve.derivatives import implicit_root, kept

DEFAULT_MAX_STEPS = 2000
DEFAULT_ROOT_TOLERANCE_US = 1e-13


class Flight(NamedTuple):
    """A free flight that begins at `start_us` (us) with the lab velocity `velocity` (nm/us).

    ``start_gap`` is the gap in nm it begins with, and ``level`` the gap in nm at which it is to end, not above the
    first. None: both are the platform's surface, from which the tip has just left.
    """

    cantilever: Cantilever
    platform: Platform | Surface
    start_us: Float[Array, ""]
    velocity: Float[Array, ""]
    start_gap: Float[Array, ""] | None = None
    level: Float[Array, ""] | None = None

    @property
    def position(self) -> Float[Array, ""]:
        """The tip's height in nm at the start."""
        height = self.platform.position(self.start_us)
        return height if self.start_gap is None else height + self.start_gap


class FirstImpact(NamedTuple):
    """The first impact of a flight.

    ``duration_us`` is the time from the flight's start to the impact; 0 where ``outcome`` is not `Outcome.IMPACT`.
    """

    duration_us: Float[Array, ""]
    outcome: Int[Array, ""]


def flight_gap(duration_us: Float[Array, ""], flight: Flight) -> Float[Array, ""]:
    """Return the gap z - z_p less the flight's level in nm, a duration after its start (eq. 3: its first zero)."""
    cantilever, platform, start = flight.cantilever, flight.platform, flight.start_us
    position, _ = cantilever.propagator(duration_us)(flight.position, flight.velocity)
    gap = position - platform.position(start + duration_us)
    return gap if flight.level is None else gap - flight.level


def first_impact(
    flight: Flight,
    *,
    skip_us: ArrayLike | None = None,
    latest_us: ArrayLike | None = None,
    max_steps: int = DEFAULT_MAX_STEPS,
    root_tolerance_us: ArrayLike = DEFAULT_ROOT_TOLERANCE_US,
) -> FirstImpact:
    """Return the first impact of a flight, guaranteed to be the first, with implicit derivatives.

    Args:
        flight: where, when and how fast the tip leaves the platform.
        skip_us: the gap counts from this time (us) after the start on, after a negative collision delay; None: at once.
        latest_us: the search ends at this time (us) after the start with `Outcome.NO_FURTHER_IMPACT`; None: never.
        max_steps: steps before the search gives up with `Outcome.STEP_LIMIT`.
        root_tolerance_us: the remaining error of the impact time at which the search stops, in us.

    Returns:
        Duration and outcome; the duration's derivatives of any order and mode follow the implicit function theorem.
    """
    skip = None if skip_us is None else jnp.asarray(skip_us, flight.velocity.dtype)
    search = _Search.begin(*lax.stop_gradient((flight, skip)))
    if latest_us is not None:
        search = search._replace(latest_us=jnp.minimum(search.latest_us, lax.stop_gradient(latest_us)))
    found, ended = search.run(max_steps, jnp.asarray(root_tolerance_us, flight.velocity.dtype))
    hit = ended == Outcome.IMPACT
    root = implicit_root(flight_gap, jnp.where(hit, found, 0.0), flight)
    return FirstImpact(jnp.where(hit, root, 0.0), ended)


class _Motion(NamedTuple):
    """The tip's height in nm and velocity in nm/us, and how far and how fast (g, g') it is from the platform."""

    position: Float[Array, ""]
    velocity: Float[Array, ""]
    gap: Float[Array, ""]
    gap_rate: Float[Array, ""]


class _Search(NamedTuple):
    """What the search for the first root needs of a flight: the constants of its closed form, and its bounds."""

    angular_frequency: Float[Array, ""]  # of the flight, damped
    decay_rate: Float[Array, ""] | None
    position: Float[Array, ""]  # at the start
    velocity: Float[Array, ""]
    position_sine: Float[Array, ""]  # factor of the sine in z e^(gamma s)
    velocity_sine: Float[Array, ""]
    platform: Platform | Surface
    start_us: Float[Array, ""]
    skip_us: Float[Array, ""] | None
    level: Float[Array, ""] | None
    reach: Float[Array, ""]  # highest point the platform can get to; infinite with a rising offset
    latest_us: Float[Array, ""]  # no impact can happen after this duration
    tip_bound: Float[Array, ""]  # bound of |z''|
    gap_bound: Float[Array, ""]  # bound of |g''|
    clearance_speed: Float[Array, ""]  # at the start
    leaves: Bool[Array, ""]  # the start is above the level, or leaves it

    @classmethod
    def begin(cls, flight: Flight, skip_us: Float[Array, ""] | None) -> "_Search":
        cantilever, platform, start, velocity = flight.cantilever, flight.platform, flight.start_us, flight.velocity
        height, platform_velocity = platform.position_and_velocity(start)
        position = height if flight.start_gap is None else height + flight.start_gap
        omega, omega_d, gamma = (
            cantilever.angular_frequency,
            cantilever.damped_angular_frequency,
            cantilever.decay_rate,
        )
        damped = cantilever.quality_factor is not None
        tip_bound = omega * jnp.sqrt(velocity**2 + (omega * position) ** 2)
        if damped:
            tip_bound = tip_bound * jnp.sqrt(1.0 + (2.0 * gamma / omega) ** 2)
        rate = platform.offset_rate_nm_per_us
        highest = platform.offset_nm + rate * start + platform.reach_nm
        reach = jnp.where(rate > 0.0, jnp.inf, highest if flight.level is None else highest + flight.level)
        clearance_speed = velocity - platform_velocity
        leaves = clearance_speed > 0.0
        if flight.start_gap is not None and flight.level is not None:
            leaves = (flight.start_gap > flight.level) | ((flight.start_gap == flight.level) & leaves)
        amplitude = jnp.sqrt(position**2 + ((velocity + gamma * position) / omega_d) ** 2)
        return cls(
            angular_frequency=omega_d,
            decay_rate=gamma if damped else None,
            position=position,
            velocity=velocity,
            position_sine=(velocity + gamma * position) / omega_d,
            velocity_sine=-(gamma * velocity + omega**2 * position) / omega_d,
            platform=platform,
            start_us=start,
            skip_us=skip_us,
            level=flight.level,
            reach=reach,
            latest_us=_latest_impact(amplitude, reach, gamma if damped else None, rate),
            tip_bound=tip_bound,
            gap_bound=tip_bound + platform.largest_acceleration_nm_per_us2,
            clearance_speed=clearance_speed,
            leaves=leaves,
        )

    def motion(self, duration: Float[Array, ""]) -> _Motion:
        """Return tip and gap a duration in us after the start."""
        sine, cosine = sine_cosine(self.angular_frequency * duration)
        position = self.position * cosine + self.position_sine * sine
        velocity = self.velocity * cosine + self.velocity_sine * sine
        if self.decay_rate is not None:
            decay = jnp.exp(-self.decay_rate * duration)
            position, velocity = decay * position, decay * velocity
        platform_position, platform_velocity = self.platform.position_and_velocity(self.start_us + duration)
        gap = position - platform_position
        return _Motion(
            position, velocity, gap if self.level is None else gap - self.level, velocity - platform_velocity
        )

    def safe_step(self, duration: Float[Array, ""]) -> tuple[Float[Array, ""], Float[Array, ""]]:
        """Return a step in us that cannot pass the first root, and the error of the root it would leave."""
        position, velocity, gap, gap_rate = self.motion(duration)
        # A gap that opens is a true one even where rounding makes it negative: right after a slow departure.
        step = jnp.where((gap > 0.0) | (gap_rate > 0.0), time_above(gap, gap_rate, self.gap_bound), 0.0)
        clearance = position - self.reach
        clear = jnp.where(clearance > 0.0, time_above(clearance, velocity, self.tip_bound), 0.0)
        # Once M h is small against |g'|, the root exists and is at most M h^2/|g'| further on.
        bend = self.gap_bound * step
        error = jnp.where(4.0 * bend <= -gap_rate, bend * step / jnp.maximum(-gap_rate, 1e-30), jnp.inf)
        return jnp.maximum(step, clear), error

    def run(self, max_steps: int, tolerance: Float[Array, ""]) -> tuple[Float[Array, ""], Int[Array, ""]]:
        """Step until the root is met, out of reach, or the steps are used up."""
        resolution = 4.0 * jnp.finfo(self.velocity.dtype).eps

        # One number says how far the search is and, by its sign, whether it has ended: with every further output of
        # the loop XLA would compute the sines and square roots once more.
        def searching(state):
            duration, steps = state
            return (duration >= 0.0) & (duration < self.latest_us) & (steps < max_steps)

        def advance(state):
            duration, steps = state
            step, error = self.safe_step(duration)
            met = (error <= tolerance) | (step <= resolution * duration)
            reached = duration + step
            return jnp.where(met, -reached, reached), steps + 1

        leaving = self.leaves
        finite = jnp.isfinite(self.gap_bound) & jnp.isfinite(self.start_us) & jnp.isfinite(self.clearance_speed)
        begin, inside = self._first_step()
        begin = jnp.where(finite & leaving & ~inside, begin, -1.0)  # an ended search
        duration, _ = lax.while_loop(searching, advance, (begin, jnp.zeros_like(begin, dtype=jnp.int32)))
        ended = jnp.where(
            duration < 0.0,
            Outcome.IMPACT,
            jnp.where(duration >= self.latest_us, Outcome.NO_FURTHER_IMPACT, Outcome.STEP_LIMIT),
        )
        ended = jnp.where(inside, Outcome.DELAY_EXCEEDS_FLIGHT, ended)
        return -duration, kept(jnp.where(finite & leaving, ended, Outcome.INVALID_START).astype(jnp.int32))

    def _first_step(self) -> tuple[Float[Array, ""], Bool[Array, ""]]:
        """Return a duration in us before which there is no impact, and whether the tip is in the platform there."""
        leave = 2.0 * self.clearance_speed / self.gap_bound
        if self.level is not None:
            leave = jnp.zeros_like(leave)
        if self.skip_us is None:
            return leave, jnp.zeros_like(leave, dtype=bool)
        skips = self.skip_us > 0.0
        return jnp.where(skips, self.skip_us, leave), skips & (self.motion(self.skip_us).gap <= 0.0)


def time_above(height: Float[Array, ""], rate: Float[Array, ""], bound: Float[Array, ""]) -> Float[Array, ""]:
    """Return how long a height above a level stays positive at least, its second derivative within the bound.

    (g' + sqrt(g'^2 + 2 M g))/M, for g' <= 0 in the form 2 g/(sqrt(g'^2 + 2 M g) - g') that does not cancel. Counts a
    negative height as 0; not to be used at height and rate 0.
    """
    root = jnp.sqrt(rate * rate + 2.0 * bound * jnp.maximum(height, 0.0))
    falling = rate <= 0.0
    return jnp.where(falling, 2.0 * height, rate + root) / jnp.where(falling, root - rate, bound)


def _latest_impact(
    amplitude: Float[Array, ""], reach: Float[Array, ""], decay_rate: Float[Array, ""] | None, rate: Float[Array, ""]
) -> Float[Array, ""]:
    """Return the duration in us after which the flight's envelope lies above all that the platform can reach."""
    retreats = rate < 0.0
    latest = jnp.where(retreats, (reach + amplitude) / jnp.where(retreats, -rate, 1.0), jnp.inf)
    if decay_rate is None:
        return latest
    below = reach < 0.0
    decayed = jnp.log(amplitude / jnp.where(below, -reach, 1.0)) / decay_rate
    return jnp.minimum(latest, jnp.where(below, decayed, jnp.inf))
