"""The closing condition of a single-impact orbit, as one scalar equation for the approach speed.

Equation 9 asks for the impact phase. Read the other way round it has no poles and nothing special at resonance: for an
assumed approach speed u the law gives the rebound speed w and the delay tau, and the two conditions that the flight of
duration N T - tau ends where the next one begins are *linear* in a = cos(omega t_out), b = sin(omega t_out). Every root
of a^2 + b^2 = 1 is an orbit. Both signs of eq. 9's root are among them, and nothing else, because w > 0 throughout.

In place of u stands a coordinate Y >= q in which the law is smooth up to capture: u = c/2r^2 + (Y + q^2/Y)/2r,
w = (Y - q^2/Y)/2, q^2 = epsilon + c^2/4r^2. Without a delay the condition is then a quartic in Y.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from afm_jax.apparatus.cantilever import Cantilever, Propagator
from afm_jax.apparatus.platform import Platform
from afm_jax.impact.law import ImpactLaw

_REGULAR = 1e-12
"""Relative size below which a determinant is taken for the rounding of 0."""


class OrbitProblem(NamedTuple):
    """A (1, N) orbit's scene: the order N is a floating-point number, so that it can be batched."""

    cantilever: Cantilever
    platform: Platform
    law: ImpactLaw
    order: Float[Array, ""]


class Closure(NamedTuple):
    """The linear system at one Y: a = cosine/determinant, b = sine/determinant of the phase just after impact.

    All three in units of the drive (lengths over beta, speeds over beta omega), numbers. ``regular`` is False where the
    flight returns every state (a whole number of free periods): the determinant is 0 then but for rounding.
    """

    cosine: Float[Array, ""]
    sine: Float[Array, ""]
    determinant: Float[Array, ""]
    regular: Bool[Array, ""]


class Speeds(NamedTuple):
    """Approach and rebound speed in nm/us, collision delay in us."""

    approach: Float[Array, ""]
    rebound: Float[Array, ""]
    delay: Float[Array, ""]


def capture_coordinate(law: ImpactLaw) -> Float[Array, ""]:
    """Return q in nm/us: the Y at which the tip is captured."""
    square = law.epsilon + (law.viscous_loss / (2.0 * law.r)) ** 2
    positive = square > 0.0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, square, 1.0)), 0.0)


def speeds_at(coordinate: Float[Array, ""], law: ImpactLaw) -> Speeds:
    """Return the speeds and the delay of the impact at a coordinate Y > q, in nm/us."""
    square = law.epsilon + (law.viscous_loss / (2.0 * law.r)) ** 2
    middle = law.viscous_loss / (2.0 * law.r**2)
    approach = middle + (coordinate + square / coordinate) / (2.0 * law.r)
    rebound = 0.5 * (coordinate - square / coordinate)
    delay = jnp.zeros_like(approach) if law.delay is None else law.delay(approach, rebound)
    return Speeds(approach, rebound, delay)


def closure(coordinate: Float[Array, ""], problem: OrbitProblem) -> Closure:
    """Return the linear system for the phase of the orbit whose impact has coordinate Y.

    Rows: z_in = p11 z_out + p12 V_out and V_in = p21 z_out + p22 V_out, with z_out = sigma + beta a,
    V_out = w - beta omega b, z_in = sigma + beta (a C + b S), V_in = -u - beta omega (b C - a S); C, S of omega tau.
    """
    cantilever, platform, law, order = problem
    speeds = speeds_at(coordinate, law)
    if law.delay is None:
        flight = _returning_flight(cantilever, order * platform.period_us)
        top_speed = platform.top_speed_nm_per_us
        cosine, sine = _instantaneous(speeds.approach / top_speed, speeds.rebound / top_speed, 1.0, flight, platform)
        return Closure(cosine, sine, flight.closing, flight.regular(platform))
    propagator = cantilever.propagator(order * platform.period_us - speeds.delay)
    turn = platform.angular_frequency * speeds.delay
    return delayed_closure(propagator, speeds, platform, (jnp.cos(turn), jnp.sin(turn)))


def instantaneous_quartic(problem: OrbitProblem) -> Float[Array, " 5"]:
    """Return Y^2 (cosine^2 + sine^2 - determinant^2) without a delay: a quartic in Y/(beta omega)."""
    cantilever, platform, law, order = problem
    flight = _returning_flight(cantilever, order * platform.period_us)
    top_speed = platform.top_speed_nm_per_us
    square = (law.epsilon + (law.viscous_loss / (2.0 * law.r)) ** 2) / top_speed**2
    middle, half = law.viscous_loss / (2.0 * law.r**2) / top_speed, 0.5 / law.r
    # Y times u, Y times w and Y itself, in powers of Y.
    approach, rebound = jnp.array([half, middle, half * square]), jnp.array([0.5, 0.0, -0.5 * square])
    cosine, sine = _instantaneous(approach, rebound, jnp.array([0.0, 1.0, 0.0]), flight, platform)
    quartic = _squared(cosine) + _squared(sine)
    return quartic.at[2].add(-(flight.closing**2))


def closing_residual(coordinate: Float[Array, ""], problem: OrbitProblem) -> Float[Array, ""]:
    """Return a^2 + b^2 - 1 times the squared determinant, relative to the sum of its terms: 0 on an orbit."""
    cosine, sine, determinant, _ = closure(coordinate, problem)
    total = cosine**2 + sine**2 + determinant**2
    return (cosine**2 + sine**2 - determinant**2) / total


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


def delayed_closure(p: Propagator, speeds: Speeds, platform: Platform, turn) -> Closure:
    """Solve both rows by Cramer's rule, every length over beta and every speed over beta omega."""
    omega, top_speed = platform.angular_frequency, platform.top_speed_nm_per_us
    cos_turn, sin_turn = turn
    sigma = platform.offset_nm / platform.amplitude_nm
    approach, rebound = speeds.approach / top_speed, speeds.rebound / top_speed
    p12, p21 = p.position_per_velocity * omega, p.velocity_per_position / omega
    m11, m12 = cos_turn - p.position_per_position, sin_turn + p12
    m21, m22 = sin_turn - p21, p.velocity_per_velocity - cos_turn
    right1 = (p.position_per_position - 1.0) * sigma + p12 * rebound
    right2 = approach + p21 * sigma + p.velocity_per_velocity * rebound
    determinant = m11 * m22 - m12 * m21
    # Here the determinant is of second order in the distance to a whole number of free periods, its rounding of zeroth.
    return Closure(
        cosine=right1 * m22 - right2 * m12,
        sine=m11 * right2 - m21 * right1,
        determinant=determinant,
        regular=jnp.abs(determinant) > _REGULAR,
    )


def _squared(quadratic: Float[Array, " 3"]) -> Float[Array, " 5"]:
    """Return the square of a quadratic (jnp.polymul's convolution takes 50 times as long under vmap)."""
    a, b, c = quadratic
    return jnp.array([a * a, 2.0 * a * b, b * b + 2.0 * a * c, 2.0 * b * c, c * c])
