"""The largest height of the tip in a stretch of time: in closed form in every flight, refined elsewhere."""

from collections.abc import Callable

import numpy as np

from afm_jax.apparatus.scene import Scene
from afm_jax.motion.record import ContactKind, Simulation
from afm_jax.motion.trajectory import DensePath, Trajectory

_REFINEMENTS = 4
_POINTS = 33


def peak_height(dense: DensePath, path: Trajectory, from_us: float, to_us: float) -> float:
    """Return the largest height above the rest position between two times, in nm.

    A tip that only the sample drives flies freely: its highest point in a flight is the first turning point from above,
    or an end. What drives of base or force add, and contacts, are looked at along the path and refined.

    Args:
        dense: the tip between the two times.
        path: the tip at times in between that resolve contacts and flights, those of `nodes`.
        from_us: beginning.
        to_us: end.
    """
    scene = dense.scene
    if scene.base is None and scene.force is None:
        flights = _of_flights(scene, dense.simulation, from_us, to_us)
        # no contact comes as high in most motions: then it need not be looked at more closely
        if path.position_nm.size and flights >= float(path.position_nm.max()):
            return flights
    return _refined(dense, _height, path.time_us, (from_us, to_us))


def peak_deflection(dense: DensePath, path: Trajectory, from_us: float, to_us: float) -> float:
    """Return the largest deflection z - z_b of a tip on a moving base between two times, in nm; arguments as above."""
    base = dense.scene.base
    if base is None:
        return peak_height(dense, path, from_us, to_us)

    def deflection(path: Trajectory) -> np.ndarray:
        return path.position_nm - np.asarray(base.position_and_velocity(path.time_us)[0])

    return _refined(dense, deflection, path.time_us, (from_us, to_us))


def _height(path: Trajectory) -> np.ndarray:
    return path.position_nm


def _refined(
    dense: DensePath,
    height: Callable[[Trajectory], np.ndarray],
    times_us: np.ndarray,
    ends_us: tuple[float, float],
) -> float:
    """Return the largest value of what `height` makes of a trajectory: on the times, then ever closer to the best."""
    times = np.unique(np.concatenate([times_us, ends_us]))
    best = -np.inf
    for _ in range(_REFINEMENTS + 1):
        values = height(dense.at(times))
        best = max(best, float(values.max()))
        top = int(np.argmax(values))
        times = np.linspace(times[max(top - 1, 0)], times[min(top + 1, len(times) - 1)], _POINTS)
    return best


def _of_flights(scene: Scene, simulation: Simulation, from_us: float, to_us: float) -> float:
    """Return the largest height in flights: the first turning point after the flight enters the stretch, or an end."""
    rows = simulation.contacts
    left = np.isin(np.asarray(rows.kind), (ContactKind.IMPACT, ContactKind.CHATTER))
    held = np.asarray(rows.kind) != ContactKind.NONE
    arrivals = np.append(np.asarray(rows.arrival_time_us)[held], float(simulation.final.time_us))
    starts = np.append(float(simulation.start.time_us), np.asarray(rows.departure_time_us)[left])
    z = np.append(float(simulation.start.position_nm), np.asarray(rows.departure_position_nm)[left])
    v = np.append(float(simulation.start.velocity_nm_per_us), np.asarray(rows.departure_velocity_nm_per_us)[left])
    begin, end = np.maximum(starts, from_us), np.minimum(arrivals[: len(starts)], to_us)
    inside = end > begin
    if not inside.any():
        return -np.inf
    starts, begin, end = starts[inside], begin[inside], end[inside]
    cantilever = scene.cantilever
    z, v = (np.asarray(part) for part in cantilever.propagator(begin - starts)(z[inside], v[inside]))
    last, _ = (np.asarray(part) for part in cantilever.propagator(end - begin)(z, v))
    omega, slow, gamma = (
        float(part)
        for part in (cantilever.angular_frequency, cantilever.damped_angular_frequency, cantilever.decay_rate)
    )
    angle = np.arctan2(v, (gamma * v + omega**2 * z) / slow)
    # a tip that comes in downward turns at the bottom first, half a turn before the top
    turn = np.where(angle >= 0.0, angle, angle + 2.0 * np.pi) / slow
    top, _ = (np.asarray(part) for part in cantilever.propagator(turn)(z, v))
    highest = np.where(turn < end - begin, top, -np.inf)
    return float(np.maximum(np.maximum(z, last), highest).max())
