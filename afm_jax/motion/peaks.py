"""Largest heights of a motion: of flights in closed form or on ever finer grids, of all else along a dense path."""

from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import ArrayLike, Float

from afm_jax.apparatus.scene import Scene
from afm_jax.apparatus.surface import surface_of
from afm_jax.impact.orbits import FlightEnds, peak_amplitude
from afm_jax.motion.record import ContactKind, Simulation
from afm_jax.motion.trajectory import DensePath, Trajectory, flights_of, fly

_REFINEMENTS = 4
_REFINED = 33
"""Times between two around the best one, of every refinement."""
_GRID = 257
_ZOOMS = 3


def largest_height(dense: DensePath, path: Trajectory, from_us: float, to_us: float) -> float:
    """Return the largest height between two times.

    Args:
        dense: the tip between the two times.
        path: the tip at times in between that resolve contacts and flights, those of `DensePath.nodes`.
        from_us: beginning.
        to_us: end.
    """
    scene = dense.scene
    if scene.base is None and scene.force is None:
        in_flight = _largest_in_flights(scene, dense.simulation, from_us, to_us)
        # no contact comes as high in most motions: then it need not be looked at more closely
        if path.position_nm.size and in_flight >= float(path.position_nm.max()):
            return in_flight
    return largest_along(dense, lambda path: path.position_nm, path.time_us, (from_us, to_us))


def largest_along(
    dense: DensePath,
    quantity: Callable[[Trajectory], np.ndarray],
    times_us: Float[np.ndarray, " times"],
    ends_us: tuple[float, float],
) -> float:
    """Return the largest value of a quantity of trajectories between two times.

    It is evaluated at the given times, then ever closer to the two best ones: a period that begins just before its top
    ends nearly as high.

    Args:
        dense: the tip between the two times.
        quantity: of a trajectory, an array of its times' shape.
        times_us: times to begin with.
        ends_us: the two times.
    """
    times = np.unique(np.concatenate([times_us, ends_us]))
    largest = -np.inf
    for _ in range(_REFINEMENTS + 1):
        values = quantity(dense.at(times))
        largest = max(largest, float(values.max()))
        framed = np.concatenate([[-np.inf], values, [-np.inf]])
        tops = np.flatnonzero((values >= framed[:-2]) & (values >= framed[2:]))
        tops = tops[np.argsort(values[tops])[-2:]]
        around = times[np.maximum(tops - 1, 0)], times[np.minimum(tops + 1, len(times) - 1)]
        times = np.unique(np.linspace(*around, _REFINED))
    return largest


def _largest_in_flights(scene: Scene, simulation: Simulation, from_us: float, to_us: float) -> float:
    """Return the largest height of flights between two times, of a tip that only the sample drives."""
    flights = flights_of(scene, simulation)
    begin, end = np.maximum(flights.begin_us, from_us), np.minimum(flights.end_us, to_us)
    inside = end > begin
    if not inside.any():
        return -np.inf
    position, velocity = fly(scene, flights.where(inside), begin[inside][None, :])
    return float(peaks_of_flights(scene, begin[inside], position[0], velocity[0], end[inside]).max())


def peaks_of_flights(
    scene: Scene, start_us: ArrayLike, position_nm: ArrayLike, velocity_nm_per_us: ArrayLike, end_us: ArrayLike
) -> Float[np.ndarray, " flights"]:
    """Return the largest height of each of some flights.

    With drives of base or force: a grid over the flight, then finer grids about its highest point; a flight shorter
    than a few dozen periods of the fastest motion is resolved to rounding.

    Args:
        scene: the scene.
        start_us: where the flights start, shape (flights,).
        position_nm: height in the lab there.
        velocity_nm_per_us: velocity in the lab there.
        end_us: where they end.
    """
    _, response = surface_of(scene)
    if response is None:
        start, z, v = (jnp.asarray(column, float) for column in (start_us, position_nm, velocity_nm_per_us))
        duration = jnp.asarray(end_us, float) - start
        flights = FlightEnds(start, duration, z, v, *scene.cantilever.propagator(duration)(z, v))
        return np.asarray(jax.vmap(partial(peak_amplitude, scene.cantilever))(flights))
    start, end = (np.asarray(column, float)[:, None] for column in (start_us, end_us))
    position, velocity = (jnp.asarray(column)[:, None] for column in (position_nm, velocity_nm_per_us))
    steady, rate = response.position_and_velocity(start)
    low, high, heights = start, end, np.zeros(start.shape)
    for _ in range(_ZOOMS):
        times = low + (high - low) * np.linspace(0.0, 1.0, _GRID)
        free, _ = scene.cantilever.propagator(times - start)(position - steady, velocity - rate)
        heights = np.asarray(free + response.position_and_velocity(times)[0])
        top, spacing = np.argmax(heights, axis=1)[:, None], (high - low) / (_GRID - 1)
        peak = np.take_along_axis(times, top, axis=1)
        low, high = np.maximum(peak - spacing, start), np.minimum(peak + spacing, end)
    return heights.max(axis=1)


def peaks_between_contacts(scene: Scene, simulation: Simulation) -> Float[np.ndarray, " flights"]:
    """Return the largest heights of the flights from a contact to the next one, in order."""
    rows = simulation.contacts
    count = int(np.sum(np.asarray(rows.kind) != ContactKind.NONE))
    departures = (rows.departure_time_us, rows.departure_position_nm, rows.departure_velocity_nm_per_us)
    start, position, velocity = (np.asarray(column)[: max(count - 1, 0)] for column in departures)
    return peaks_of_flights(scene, start, position, velocity, np.asarray(rows.arrival_time_us)[1 : max(count, 1)])
