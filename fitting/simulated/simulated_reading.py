"""Amplitudes and phase of periodic motions, many at once: closed forms in flight, quadrature in contact.

The same readings as `afm_jax.motion.observables.observe` takes of one motion, for single-impact orbits only.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Complex, Float, Int

from afm_jax.apparatus.cantilever import Cantilever
from afm_jax.apparatus.platform import Platform
from afm_jax.impact.orbit_amplitude import FlightEnds, peak_amplitude
from afm_jax.motion.record import Contacts

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(10)

Heights = Callable[[Float[np.ndarray, "rows nodes"]], Float[np.ndarray, "rows nodes"]]
"""Of times within a contact of each row: the tip's heights."""


class Reading(NamedTuple):
    """What is read of single-impact orbits, one entry a row."""

    peak_amplitude_nm: Float[np.ndarray, " rows"]
    lockin_amplitude_nm: Float[np.ndarray, " rows"]
    lockin_phase_deg: Float[np.ndarray, " rows"]
    """In [0, 360/N)."""


def read_orbits(
    cantilever: Cantilever,
    platforms: Platform,
    orders: Int[np.ndarray, " rows"],
    contact: Contacts,
    heights: Heights,
    depth: Float[np.ndarray, " rows"],
) -> Reading:
    """Return peak, lock-in amplitude and phase of single-impact orbits.

    a exp(i phi) = 2/T int z exp(-i nu t) dt over one response period, nu = omega/N.

    Args:
        cantilever: the cantilever.
        platforms: with fields of shape (rows,).
        orders: N of each row.
        contact: one contact of each row, arrays of shape (rows,).
        heights: the tip's heights at times in contact.
        depth: by how much the tip is lower in contact, its integral over time in nm us.
    """
    period = orders * np.asarray(platforms.period_us)
    nu = 2.0 * np.pi / period
    arrival, departure = contact.arrival_time_us, contact.departure_time_us
    ends = (
        departure,
        period - (departure - arrival),
        contact.departure_position_nm,
        contact.departure_velocity_nm_per_us,
        contact.arrival_position_nm,
        contact.arrival_velocity_nm_per_us,
    )
    flight = FlightEnds(*(jnp.asarray(part) for part in ends))
    times, weights = _nodes(contact)
    height = heights(times)
    inside = np.sum(weights * height * np.exp(-1j * nu[:, None] * times), axis=1)
    inside = inside - depth * np.exp(-1j * nu * 0.5 * (arrival + departure))
    value = 2.0 / period * (_flight_integral(cantilever, flight, nu) + inside)
    top = jax.jit(jax.vmap(lambda one: peak_amplitude(cantilever, one)))(flight)
    peak = np.maximum(np.asarray(top), height.max(axis=1))
    return Reading(peak, np.abs(value), np.degrees(np.angle(value)) % (360.0 / orders))


def _flight_integral(
    cantilever: Cantilever, flight: FlightEnds, nu: Float[np.ndarray, " rows"]
) -> Complex[np.ndarray, " rows"]:
    """Return int z exp(-i nu t) dt over flights.

    Integrating the equation of motion by parts, I (Omega^2 - nu^2 + i nu Omega/Q) = -[v e] - (i nu + Omega/Q) [z e],
    e = exp(-i nu t), [.] the difference between end and start.
    """
    loss = 2.0 * float(cantilever.decay_rate)
    start, duration, position, velocity, end_position, end_velocity = (np.asarray(part) for part in flight)
    first = np.exp(-1j * nu * start)
    last = first * np.exp(-1j * nu * duration)
    velocity = end_velocity * last - velocity * first
    position = end_position * last - position * first
    response = float(cantilever.angular_frequency) ** 2 - nu**2 + 1j * nu * loss
    return -(velocity + (1j * nu + loss) * position) / response


def _nodes(contact: Contacts) -> tuple[Float[np.ndarray, "rows nodes"], Float[np.ndarray, "rows nodes"]]:
    """Return Gauss nodes and weights over a contact of each row, in three panels where a junction forms and breaks."""
    arrival, departure = np.asarray(contact.arrival_time_us), np.asarray(contact.departure_time_us)
    forms = breaks = arrival
    if contact.detail is not None:
        touched = np.asarray(contact.detail.junctions) > 0
        forms = np.where(touched, contact.detail.junction_forms_us, arrival)
        breaks = np.where(touched, contact.detail.junction_breaks_us, arrival)
    edges = np.stack([arrival, forms, breaks, departure], axis=1)
    half = 0.5 * np.diff(edges, axis=1)[:, :, None]
    times = edges[:, :-1, None] + half * (_NODES + 1.0)
    return times.reshape(len(edges), -1), (half * _WEIGHTS).reshape(len(edges), -1)
