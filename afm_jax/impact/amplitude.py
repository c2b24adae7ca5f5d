"""What an experiment reads of a single-impact orbit: peak height, and lock-in amplitude and phase."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, ArrayLike, Float

from afm_jax.apparatus.cantilever import Cantilever
from afm_jax.apparatus.platform import Platform
from afm_jax.apparatus.surface import Surface
from afm_jax.checks import as_argument
from afm_jax.units import within_turn

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(12)


class FlightEnds(NamedTuple):
    """A free flight between two impacts, its start and its end.

    Positions in nm, velocities in nm/us, the start's time and the duration in us.
    """

    start_us: Float[Array, ""]
    duration_us: Float[Array, ""]
    start_position: Float[Array, ""]
    start_velocity: Float[Array, ""]
    end_position: Float[Array, ""]
    end_velocity: Float[Array, ""]


def peak_amplitude(cantilever: Cantilever, flight: FlightEnds) -> Float[Array, ""]:
    """Return the largest height of the tip above its rest position during a flight, in nm.

    The amplitude decays, so the first turning point after the start is the highest one inside the flight:
    tan(Omega_d s) = v/((gamma v + Omega^2 z)/Omega_d).
    """
    omega_d = cantilever.damped_angular_frequency
    fall = cantilever.decay_rate * flight.start_velocity + cantilever.angular_frequency**2 * flight.start_position
    # At rest at the start (v = 0) there is nothing to turn: keep the angle's derivative finite there.
    moving = (flight.start_velocity != 0.0) | (fall != 0.0)
    angle = jnp.arctan2(jnp.where(moving, flight.start_velocity, 1.0), jnp.where(moving, fall / omega_d, 0.0))
    # A tip that starts downward turns at the bottom first; the top follows half a turn later.
    turn = jnp.where(angle > 0.0, angle, angle + 2.0 * jnp.pi) / omega_d
    top, _ = cantilever.propagator(turn)(flight.start_position, flight.start_velocity)
    ends = jnp.maximum(flight.start_position, flight.end_position)
    return jnp.where(turn < flight.duration_us, jnp.maximum(ends, top), ends)


SAMPLES = 512
"""Heights looked at of a flight that has no closed form for its highest."""


def highest_of_sum(
    cantilever: Cantilever, flight: FlightEnds, motion: Surface, samples: int = SAMPLES
) -> Float[Array, ""]:
    """Return the largest sum of a flight's height and another motion during the flight, in nm.

    Args:
        cantilever: of the free flight.
        flight: from impact to impact.
        motion: added to it: a steady response, less a base's motion where the deflection is meant.
        samples: heights looked at; the highest of them is improved by Newton's method.
    """

    def at(after):
        position, velocity = cantilever.propagator(after)(flight.start_position, flight.start_velocity)
        height, rate = motion.position_and_velocity(flight.start_us + after)
        bend = cantilever.acceleration(position, velocity) + motion.acceleration(flight.start_us + after)
        return position + height, velocity + rate, bend

    step = flight.duration_us / samples
    times = step * jnp.arange(samples + 1.0)
    seen, _, _ = at(times)

    def improve(_, after):
        _, rate, bend = at(after)
        move = jnp.where(bend < 0.0, -rate / jnp.where(bend < 0.0, bend, 1.0), 0.0)
        return jnp.clip(after + jnp.clip(move, -step, step), 0.0, flight.duration_us)

    # its own change counts nothing, because the height is largest there
    top = lax.fori_loop(0, 5, improve, times[jnp.argmax(seen)])
    return at(lax.stop_gradient(top))[0]


def lockin(  # noqa: PLR0913
    cantilever: Cantilever,
    platform: Platform,
    flight: FlightEnds,
    order: ArrayLike,
    *,
    delayed: bool,
    indentation: ArrayLike = 0.0,
    late_us: ArrayLike = 0.0,
    at_drive: bool = False,
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Return lock-in amplitude in nm and phase in degrees of an orbit at its response frequency omega/N, or omega.

    a exp(i phi) = 2/T int z exp(-i nu t) dt over one response period T; nu = omega/N, phi modulo 360/N, or with
    `at_drive` the drive's nu = omega, phi modulo 360. The flight's integral
    is closed: with [.] the difference of the ends, I (Omega^2 - nu^2 + i nu Omega/Q) = -[v e] - (i nu + Omega/Q)[z e],
    e = exp(-i nu t). From the flight's end to the next start (a collision delay, if there is one: `delayed`) the tip
    rides on the platform, or below it: `indentation` is the time integral of how much, in nm us, and
    `late_us` by how much its mean time is behind the middle.
    """
    period = as_argument(order) * platform.period_us
    turns = 1.0 if at_drive else as_argument(order)
    nu = platform.angular_frequency / turns
    loss = 2.0 * cantilever.decay_rate
    end_us = flight.start_us + flight.duration_us
    first, last = _turned_back(nu, flight.start_us), _turned_back(nu, end_us)
    # Real and imaginary parts side by side, as arrays of shape (2,).
    velocity = flight.end_velocity * last - flight.start_velocity * first
    position = flight.end_position * last - flight.start_position * first
    source = -velocity - loss * position - nu * jnp.array([-position[1], position[0]])
    real, imaginary = cantilever.angular_frequency**2 - nu**2, nu * loss
    size = real**2 + imaginary**2
    # Without damping a free flight can be exactly resonant with the response; no orbit lives there.
    size = jnp.where(size == 0.0, 1.0, size)
    flying = jnp.array([real * source[0] + imaginary * source[1], real * source[1] - imaginary * source[0]]) / size
    if delayed:
        start_us = flight.start_us + period
        flying = flying + _platform_integral(platform, nu, end_us, start_us)
        flying = flying - indentation * _turned_back(nu, 0.5 * (end_us + start_us) + late_us)
    cosine, sine = 2.0 / period * flying
    phase = within_turn(jnp.rad2deg(jnp.arctan2(sine, cosine)), 360.0 / turns)
    return jnp.sqrt(cosine**2 + sine**2), phase


def _turned_back(nu: Float[Array, ""], time_us: Float[Array, "..."]) -> Float[Array, "2 ..."]:
    """Return exp(-i nu t) as its real and imaginary part."""
    return jnp.stack([jnp.cos(nu * time_us), -jnp.sin(nu * time_us)])


def _platform_integral(
    platform: Platform, nu: Float[Array, ""], begin_us: Float[Array, ""], end_us: Float[Array, ""]
) -> Float[Array, " 2"]:
    """Integrate z_p exp(-i nu t) between two times by Gauss's rule; the interval is a collision delay."""
    half = 0.5 * (end_us - begin_us)
    times = 0.5 * (begin_us + end_us) + half * jnp.asarray(_NODES, half.dtype)
    weighted = half * jnp.asarray(_WEIGHTS, half.dtype) * platform.position(times)
    # A product and a sum: under vmap a matrix product of this size costs ten times as much.
    return jnp.sum(_turned_back(nu, times) * weighted, axis=1)
