"""The highest point of each free flight of a motion, whatever drives it."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import ArrayLike, Float

from afm_jax.apparatus.scene import Scene
from afm_jax.apparatus.surface import surface_of
from afm_jax.motion.record import ContactKind, Simulation

_POINTS = 257
_ZOOMS = 3


def peaks_of_flights(
    scene: Scene, start_us: ArrayLike, position_nm: ArrayLike, velocity_nm_per_us: ArrayLike, end_us: ArrayLike
) -> Float[np.ndarray, " flights"]:
    """Return the largest height of the tip above its rest position in each flight, in nm.

    A grid over the flight, then finer grids about its highest point: a flight shorter than a few dozen periods of the
    fastest motion is resolved to rounding.

    Args:
        scene: the scene.
        start_us: where the flights start, shape (flights,).
        position_nm: height in the lab there.
        velocity_nm_per_us: velocity in the lab there.
        end_us: where they end.
    """
    _, response = surface_of(scene)
    start, end = (np.asarray(part, float)[:, None] for part in (start_us, end_us))
    position, velocity = (jnp.asarray(part)[:, None] for part in (position_nm, velocity_nm_per_us))
    if response is not None:
        steady, rate = response.position_and_velocity(start)
        position, velocity = position - steady, velocity - rate
    low, high, heights = start, end, np.zeros(start.shape)
    for _ in range(_ZOOMS):
        times = low + (high - low) * np.linspace(0.0, 1.0, _POINTS)
        free, _ = scene.cantilever.propagator(times - start)(position, velocity)
        heights = np.asarray(free if response is None else free + response.position_and_velocity(times)[0])
        top, spacing = np.argmax(heights, axis=1)[:, None], (high - low) / (_POINTS - 1)
        peak = np.take_along_axis(times, top, axis=1)
        low, high = np.maximum(peak - spacing, start), np.minimum(peak + spacing, end)
    return heights.max(axis=1)


def peaks_between_contacts(scene: Scene, found: Simulation) -> Float[np.ndarray, " flights"]:
    """Return the largest heights in nm of the flights from a contact to the next one, in order."""
    rows = found.contacts
    columns = (
        rows.kind,
        rows.departure_time_us,
        rows.departure_position_nm,
        rows.departure_velocity_nm_per_us,
        rows.arrival_time_us,
    )
    kind, start, position, velocity, arrival = (np.asarray(column) for column in columns)
    used = int(np.sum(kind != ContactKind.NONE))
    left = slice(0, max(used - 1, 0))
    return peaks_of_flights(scene, start[left], position[left], velocity[left], arrival[1 : max(used, 1)])
