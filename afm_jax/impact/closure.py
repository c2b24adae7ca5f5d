"""The closing condition of a single-impact orbit, as one scalar equation for the approach speed.

Equation 9 asks for the impact phase. Read the other way round it has no poles and nothing special at resonance: for an
assumed approach speed u the law gives the rebound speed w and the delay tau, and the two conditions that the flight of
duration N T - tau ends where the next one begins are *linear* in a = cos(omega t_out), b = sin(omega t_out). Every root
of a^2 + b^2 = 1 is an orbit. Both signs of eq. 9's root are among them, and nothing else, because w > 0 throughout.

In place of u stands a coordinate of the impact in which the law is smooth up to capture (`Law.speeds`). Without a delay
the condition is then a quartic in it. Where the impact lasts, speeds and delay need the phase: three passes alternate
between the two, close enough to find every orbit, and Newton's method closes the map itself from there.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from afm_jax.apparatus.cantilever import Cantilever, Propagator
from afm_jax.apparatus.platform import Platform
from afm_jax.apparatus.trigonometry import sine_cosine
from afm_jax.impact.lasting_impact import corrected, lasting, middle_of_contact
from afm_jax.impact.law import Impact, ImpactLaw, Speeds
from afm_jax.solve.derivatives import solved_pair

_REGULAR = 1e-12
"""Relative size below which a determinant is taken for the rounding of 0."""
_PASSES = 3
_CLOSE = 1e-10
"""Gaps, and the last step of Newton's method, that leave an error of the order of their square."""
_LONGEST_STEP = 0.3
"""Of Newton's method: share of the distance from capture, and rad."""


class OrbitProblem(NamedTuple):
    """A (1, N) orbit's scene: the order N is a floating-point number, so that it can be batched."""

    cantilever: Cantilever
    platform: Platform
    impact: Impact
    order: Float[Array, ""]


class ClosingSystem(NamedTuple):
    """The linear system for given speeds: a = cosine/determinant, b = sine/determinant of the phase just after impact.

    All three in units of the drive (lengths over beta, speeds over beta omega), numbers. ``regular`` is False where the
    flight returns every state (a whole number of free periods): the determinant is 0 then but for rounding.
    """

    cosine: Float[Array, ""]
    sine: Float[Array, ""]
    determinant: Float[Array, ""]
    regular: Bool[Array, ""]

    @property
    def phase(self) -> Float[Array, ""]:
        """The drive's phase in rad just after impact; 0 where it is not determined."""
        safe = jnp.where(self.regular, self.determinant, 1.0)
        cosine = jnp.where(self.regular, self.cosine / safe, 1.0)
        return jnp.arctan2(jnp.where(self.regular, self.sine / safe, 0.0), cosine)

    @property
    def residual(self) -> Float[Array, ""]:
        """a^2 + b^2 - 1 times the squared determinant, relative to the sum of its terms."""
        total = self.cosine**2 + self.sine**2 + self.determinant**2
        return (self.cosine**2 + self.sine**2 - self.determinant**2) / total


class Closure(NamedTuple):
    """The impact at a coordinate, and the linear system it leads to."""

    speeds: Speeds
    system: ClosingSystem


@jax.jit
def closure(coordinate: Float[Array, ""], problem: OrbitProblem) -> Closure:
    """Return the linear system for the phase of the orbit whose impact has a coordinate.

    Rows: z_in = p11 z_out + p12 V_out and V_in = p21 z_out + p22 V_out, with z_out = sigma + beta a,
    V_out = w - beta omega b, z_in = sigma + beta (a C + b S), V_in = -u - beta omega (b C - a S); C, S of omega tau.
    """
    cantilever, platform, impact, order = problem
    free = impact.speeds(coordinate)
    if not impact.delayed:
        flight = _returning_flight(cantilever, order * platform.period_us)
        top_speed = platform.top_speed_nm_per_us
        cosine, sine = _instantaneous(free.approach / top_speed, free.rebound / top_speed, 1.0, flight, platform)
        return Closure(free, ClosingSystem(cosine, sine, flight.closing, flight.regular(platform)))
    if not impact.lasts:
        return Closure(free, _delayed(free, problem))

    def correct(_, speeds: Speeds) -> Speeds:
        system = _delayed(speeds, problem)
        # the direction of the phase, whether or not this is an orbit already
        cosine, sine = system.cosine * system.determinant, system.sine * system.determinant
        somewhere = (cosine != 0.0) | (sine != 0.0)
        phase = jnp.arctan2(sine, jnp.where(somewhere, cosine, 1.0))
        middle = middle_of_contact(cantilever, platform, phase / platform.angular_frequency - 0.5 * speeds.delay)
        return corrected(free, middle, cantilever, impact)

    # a loop, because the program is compiled for every use of it
    speeds = lax.fori_loop(0, _PASSES, correct, free)
    return Closure(speeds, _delayed(speeds, problem))


class OrbitPlace(NamedTuple):
    """An orbit: the coordinate of its impact in nm/us, and the drive's phase in rad when the tip arrives."""

    coordinate: Float[Array, ""]
    phase: Float[Array, ""]


def place_of(coordinate: Float[Array, ""], speeds: Speeds, system: ClosingSystem, problem: OrbitProblem) -> OrbitPlace:
    """Return where an orbit is, given the closure at its coordinate; about, where the impact lasts."""
    return OrbitPlace(coordinate, system.phase - problem.platform.angular_frequency * speeds.delay)


def speeds_at_place(place: OrbitPlace, problem: OrbitProblem) -> Speeds:
    """Return what the impact is at a place: that of the map."""
    cantilever, platform, impact, _ = problem
    return lasting(
        impact.speeds(place.coordinate), impact, place.phase / platform.angular_frequency, cantilever, platform
    )


@jax.jit
def map_gaps(unknowns: Float[Array, " 2"], problem: OrbitProblem) -> Float[Array, " 2"]:
    """Return by how much one turn of the map misses its start: height over beta, velocity over beta omega."""
    cantilever, platform, _, order = problem
    place = OrbitPlace(*unknowns)
    arrival = place.phase / platform.angular_frequency
    speeds = speeds_at_place(place, problem)
    height, speed = platform.position_and_velocity(arrival + speeds.delay)
    flight = cantilever.propagator(order * platform.period_us - speeds.delay)
    position, velocity = flight(height, speed + speeds.rebound)
    height, speed = platform.position_and_velocity(arrival)
    missing = (velocity - speed + speeds.approach) / platform.top_speed_nm_per_us
    return jnp.stack([(position - height) / platform.amplitude_nm, missing])


class ClosedMap(NamedTuple):
    """Coordinate and phase where Newton's method has ended, and the last gaps it has seen."""

    unknowns: Float[Array, " 2"]
    gaps: Float[Array, " 2"]


def close_map(place: OrbitPlace, problem: OrbitProblem, steps: int, wanted: Bool[Array, ""]) -> ClosedMap:
    """Return where steps of Newton's method towards the orbit of the map end: as many as it takes.

    Args:
        place: where to begin.
        problem: what orbits are of.
        steps: at most.
        wanted: False: none at all.
    """

    def twice(unknowns):
        value = map_gaps(unknowns, problem)
        return value, value

    def longest(unknowns):
        return jnp.stack([unknowns[0] - problem.impact.lowest, jnp.ones_like(unknowns[1])])

    def unsettled(state):
        count, unknowns, gaps, step = state
        small = (jnp.abs(gaps) < _CLOSE) & (jnp.abs(step) < _CLOSE * longest(unknowns))
        return wanted & (count < steps) & ~jnp.all(small)

    def improve(state):
        count, unknowns, _, _ = state
        slopes, gaps = jax.jacfwd(twice, has_aux=True)(unknowns)
        most = longest(unknowns) * _LONGEST_STEP
        step = jnp.clip(-solved_pair([slopes[:, 0], slopes[:, 1]], gaps), -most, most)
        return count + 1, unknowns + step, gaps, step

    first = jnp.stack(place)
    far = jnp.full_like(first, jnp.inf)
    _, unknowns, gaps, _ = lax.while_loop(unsettled, improve, (0, first, far, far))
    return ClosedMap(unknowns, gaps)


def instantaneous_quartic(problem: OrbitProblem) -> Float[Array, " 5"]:
    """Return Y^2 (cosine^2 + sine^2 - determinant^2) without a delay: a quartic in Y/(beta omega)."""
    cantilever, platform, _, order = problem
    law = _law_of(problem)
    flight = _returning_flight(cantilever, order * platform.period_us)
    top_speed = platform.top_speed_nm_per_us
    square = (law.epsilon + (law.viscous_loss / (2.0 * law.r)) ** 2) / top_speed**2
    middle, half = law.viscous_loss / (2.0 * law.r**2) / top_speed, 0.5 / law.r
    # Y times u, Y times w and Y itself, in powers of Y.
    approach, rebound = jnp.array([half, middle, half * square]), jnp.array([0.5, 0.0, -0.5 * square])
    cosine, sine = _instantaneous(approach, rebound, jnp.array([0.0, 1.0, 0.0]), flight, platform)
    quartic = _squared(cosine) + _squared(sine)
    return quartic.at[2].add(-(flight.closing**2))


def _law_of(problem: OrbitProblem) -> ImpactLaw:
    assert isinstance(problem.impact, ImpactLaw)  # the formula alone makes a quartic  # noqa: S101
    return problem.impact


@jax.jit
def closing_residual(coordinate: Float[Array, ""], problem: OrbitProblem) -> Float[Array, ""]:
    """Return a^2 + b^2 - 1 times the squared determinant, relative to the sum of its terms: 0 on an orbit."""
    return closure(coordinate, problem).system.residual


class _ReturningFlight(NamedTuple):
    """The flights that come back to the height they left, up to a common factor.

    ``rest`` is that height in us, ``after`` and ``before`` the velocities at the start and at the end (numbers).
    """

    rest: Float[Array, ""]
    after: Float[Array, ""]
    before: Float[Array, ""]

    @property
    def closing(self) -> Float[Array, ""]:
        """By how much the velocity changes between end and start: what the impact has to supply."""
        return self.after - self.before

    def regular(self, platform: Platform) -> Bool[Array, ""]:
        """Say whether the impact supplies anything beyond rounding."""
        size = jnp.abs(self.after) + jnp.abs(self.before) + jnp.abs(self.rest) * platform.angular_frequency
        return jnp.abs(self.closing) > _REGULAR * size


def _returning_flight(cantilever: Cantilever, duration: Float[Array, ""]) -> _ReturningFlight:
    """Return the flight of a duration in us, written so that nothing cancels near a whole number of free periods."""
    omega_d = cantilever.damped_angular_frequency
    half_sine, half_cosine = jnp.sin(0.5 * omega_d * duration), jnp.cos(0.5 * omega_d * duration)
    if cantilever.quality_factor is None:
        return _ReturningFlight(half_cosine / omega_d, half_sine, -half_sine)
    loss = -jnp.expm1(-cantilever.decay_rate * duration)
    sine, dip = 2.0 * half_sine * half_cosine, 2.0 * half_sine**2
    lag = cantilever.decay_rate / omega_d * sine
    kept = 1.0 - loss
    return _ReturningFlight(kept * sine / omega_d, loss + kept * (dip - lag), kept * (loss - dip - lag))


def _instantaneous(approach, rebound, one, flight: _ReturningFlight, platform: Platform):
    """Return cosine and sine of the linear system for speeds over beta omega (or their coefficients, `one` for 1).

    z_out = rest (u + w)/closing and v_p = (u after + w before)/closing on a returning flight.
    """
    height = flight.rest * platform.angular_frequency * (approach + rebound)
    offset = one * (platform.offset_nm / platform.amplitude_nm * flight.closing)
    return height - offset, -(approach * flight.after + rebound * flight.before)


def _delayed(speeds: Speeds, problem: OrbitProblem) -> ClosingSystem:
    """Solve both rows by Cramer's rule, every length over beta and every speed over beta omega."""
    cantilever, platform, _, order = problem
    p: Propagator = cantilever.propagator(order * platform.period_us - speeds.delay)
    turn = platform.angular_frequency * speeds.delay
    sin_turn, cos_turn = sine_cosine(turn)
    omega, top_speed = platform.angular_frequency, platform.top_speed_nm_per_us
    sigma = platform.offset_nm / platform.amplitude_nm
    approach, rebound = speeds.approach / top_speed, speeds.rebound / top_speed
    p12, p21 = p.position_per_velocity * omega, p.velocity_per_position / omega
    m11, m12 = cos_turn - p.position_per_position, sin_turn + p12
    m21, m22 = sin_turn - p21, p.velocity_per_velocity - cos_turn
    right1 = (p.position_per_position - 1.0) * sigma + p12 * rebound
    right2 = approach + p21 * sigma + p.velocity_per_velocity * rebound
    determinant = m11 * m22 - m12 * m21
    # Here the determinant is of second order in the distance to a whole number of free periods, its rounding of zeroth.
    return ClosingSystem(
        cosine=right1 * m22 - right2 * m12,
        sine=m11 * right2 - m21 * right1,
        determinant=determinant,
        regular=jnp.abs(determinant) > _REGULAR,
    )


def _squared(quadratic: Float[Array, " 3"]) -> Float[Array, " 5"]:
    """Return the square of a quadratic (jnp.polymul's convolution takes 50 times as long under vmap)."""
    a, b, c = quadratic
    return jnp.array([a * a, 2.0 * a * b, b * b + 2.0 * a * c, 2.0 * b * c, c * c])
