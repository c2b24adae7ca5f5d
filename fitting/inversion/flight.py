"""From amplitudes and phase of a single-impact orbit to its flight, and from the flight to the impact: no law needed.

The response's amplitude and phase say when the tip leaves the platform and how fast; the rest is free flight, until it
meets the platform again. Where three numbers are measured (peak, lock-in amplitude, phase) the two unknowns are their
least squares.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from afm_jax.apparatus.cantilever import Cantilever
from afm_jax.apparatus.platform import Platform
from afm_jax.impact.lasting_impact import gained_and_longer, indentation, middle_of_contact
from afm_jax.impact.orbits import FlightEnds, lockin, peak_amplitude
from afm_jax.least_squares import Box, Searches, descended, distance, whole_covariance_of
from afm_jax.solve.lanes import compiled_quickly

_HALF_SINE = 0.42441318157838753
"""4/(3 pi): lock-in amplitude of half sines at their own frequency, over their height."""
_ANGLES = (-0.45, 0.0, 0.45)
"""Starts of the search: angle of the response in rad beside a half sine's."""


class MeasuredRow(NamedTuple):
    """One row: its drive, and peak, lock-in amplitude and phase (nm, nm, degrees) with errors; arrays of one row."""

    platform: Platform
    order: Float[Array, ""]
    value: Float[Array, " 3"]
    error: Float[Array, " 3"]
    """Infinite where nothing was measured."""


class Inverted(NamedTuple):
    """Rows inverted; arrays with a leading axis of rows."""

    impact: Float[np.ndarray, "rows 3"]
    """Approach speed, rebound speed and delay."""
    covariance: Float[np.ndarray, "rows 3 3"]
    chi2: Float[np.ndarray, " rows"]
    """Of the measured numbers; 0 where there are only two."""
    converged: Bool[np.ndarray, " rows"]


def flight_of(unknowns: Float[Array, " 2"], row: MeasuredRow, cantilever: Cantilever) -> FlightEnds:
    """Return the flight that leaves the platform with unknowns: the start's phase nu t + phi, log of the velocity.

    Its end is where it meets the platform about a response period later, by Newton's method.
    """
    nu = row.platform.angular_frequency / row.order
    start = (unknowns[0] - jnp.deg2rad(row.value[2])) / nu
    velocity = jnp.exp(unknowns[1])
    position = row.platform.position(start)

    def ends(duration):
        z, v = cantilever.propagator(duration)(position, velocity)
        height, speed = row.platform.position_and_velocity(start + duration)
        return z, v, z - height, v - speed

    def step(_, duration):
        _, _, gap, rate = ends(duration)
        # the tip must be closing in: a step is no longer than a tenth of the response period
        move = jnp.where(rate < 0.0, -gap / jnp.where(rate < 0.0, rate, 1.0), 0.0)
        return duration + jnp.clip(move, -0.1 * period, 0.1 * period)

    period = row.order * row.platform.period_us
    found = lax.stop_gradient(lax.fori_loop(0, 8, step, period))
    _, _, gap, rate = ends(found)
    # one more step carries the derivative of the root
    duration = found - gap / lax.stop_gradient(rate)
    end_position, end_velocity, _, _ = ends(duration)
    return FlightEnds(start, duration, position, velocity, end_position, end_velocity)


def readings(flight: FlightEnds, row: MeasuredRow, cantilever: Cantilever) -> Float[Array, " 3"]:
    """Return peak and lock-in amplitude in nm and the phase in degrees that a flight makes."""
    platform = row.platform
    end = flight.start_us + flight.duration_us
    tau = jnp.maximum(row.order * platform.period_us - flight.duration_us, 0.0)
    # in contact the tip is below the platform's rest surface by the indentation
    middle = middle_of_contact(cantilever, platform, end + 0.5 * tau)
    nu = platform.angular_frequency / row.order
    depth = indentation(platform.velocity(end) - flight.end_velocity, tau, middle, cantilever, nu)
    amplitude, phase = lockin(cantilever, platform, flight, row.order, delayed=True, indentation=depth)
    return jnp.stack([peak_amplitude(cantilever, flight), amplitude, phase])


def impact_of(flight: FlightEnds, row: MeasuredRow, cantilever: Cantilever) -> Float[Array, " 3"]:
    """Return approach speed, rebound speed and delay between a flight and the next, of a free tip on a sample at rest.

    What air, spring and the platform's motion do during a Hertz contact is taken back (`gained_and_longer`): its
    duration is the delay, for want of a law that tells lead and offset apart.
    """
    platform = row.platform
    end = flight.start_us + flight.duration_us
    approach = platform.velocity(end) - flight.end_velocity
    rebound = flight.start_velocity - platform.velocity(flight.start_us)
    delay = row.order * platform.period_us - flight.duration_us
    middle = middle_of_contact(cantilever, platform, flight.start_us - 0.5 * delay)

    def taken_back(tau):
        return gained_and_longer(approach, jnp.maximum(tau, 0.0), middle, cantilever)

    free_delay = lax.fori_loop(0, 3, lambda _, free_delay: delay - taken_back(free_delay)[1], delay)
    square = jnp.where(rebound > 0.0, rebound**2 - taken_back(delay)[0], -1.0)
    free_rebound = jnp.where(square > 0.0, jnp.sqrt(jnp.where(square > 0.0, square, 1.0)), jnp.nan)
    return jnp.stack([approach, free_rebound, free_delay])


@compiled_quickly()
@partial(jax.vmap, in_axes=(0, 0, None))
def _evaluate(
    unknowns: Float[Array, " 2"], row: MeasuredRow, cantilever: Cantilever
) -> tuple[Float[Array, " 6"], Float[Array, "6 2"]]:
    """Return the residuals of a place, then the impact that it says, and their derivatives by the unknowns."""

    def twice(unknowns):
        flight = flight_of(unknowns, row, cantilever)
        apart = readings(flight, row, cantilever) - row.value
        # the phase is known modulo a drive period
        turn = 360.0 / row.order
        apart = apart.at[2].set((apart[2] + 0.5 * turn) % turn - 0.5 * turn)
        residual = jnp.where(jnp.isfinite(row.error), apart / row.error, 0.0)
        both = jnp.concatenate([residual, impact_of(flight, row, cantilever)])
        return both, both

    slopes, both = jax.jacfwd(twice, has_aux=True)(unknowns)
    return both, slopes


def invert_rows(rows: MeasuredRow, cantilever: Cantilever) -> Inverted:
    """Return the impacts of rows with a phase and at least one amplitude: the least squares of the two unknowns.

    Args:
        rows: arrays with a leading axis of rows.
        cantilever: its frequency and Q, exactly known.
    """
    height = np.where(np.isfinite(rows.error[:, 0]), rows.value[:, 0], rows.value[:, 1] / _HALF_SINE)
    # half sines z = a |sin(nu (t - t_out)/2)| have the phase nu t_out + phi = pi
    speed = np.repeat(np.log(np.asarray(cantilever.angular_frequency) * height), len(_ANGLES))
    kept = np.stack([np.pi + np.tile(_ANGLES, len(height)), speed], axis=1)
    each = jax.tree.map(lambda part: np.repeat(np.asarray(part), len(_ANGLES), axis=0), rows)

    def look(places: Float[np.ndarray, "some 2"], some: Int[np.ndarray, " some"]) -> Searches:
        # all places at once, so that one program serves: what the others have is known already
        kept[some] = places
        residual, slopes = (np.asarray(part)[some, :3] for part in _evaluate(kept, each, cantilever))
        chi2 = np.sum(residual**2, axis=1)
        return Searches(places, residual, slopes, np.where(np.isfinite(chi2), chi2, np.inf))

    box = Box(np.full(2, -np.inf), np.full(2, np.inf), np.zeros(kept.shape, dtype=bool), longest=0.3)
    ends = descended(look, look(kept.copy(), np.arange(len(kept))), box, settled=1e-24, most=30)
    impact, slopes = (np.asarray(part)[:, 3:] for part in _evaluate(ends.place, each, cantilever))
    spread = whole_covariance_of(np.swapaxes(ends.jacobian, 1, 2) @ ends.jacobian)
    covariance = slopes @ spread @ np.swapaxes(slopes, 1, 2)
    # a search has arrived if its minimum is within a thousandth of a standard error
    good = (distance(ends, box) < 1e-6) & (impact[:, :2] > 0.0).all(axis=1)
    good &= np.isfinite(covariance).all(axis=(1, 2))
    # of equally good ones that with the shortest contact
    response = np.repeat(np.asarray(rows.order * rows.platform.period_us), len(_ANGLES))
    score = np.where(good, ends.chi2 + 1e-3 * (impact[:, 2] / response) ** 2, np.inf).reshape(len(height), -1)
    best = np.argmin(score, axis=1) + len(_ANGLES) * np.arange(len(score))
    return Inverted(impact[best], covariance[best], ends.chi2[best], good[best])
