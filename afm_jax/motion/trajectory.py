"""Dense output: where the tip is at any time of a simulation, worked out on request.

A simulation keeps its contacts. Between them the flight is a closed form; the contacts asked for are integrated once
more, step by step, and a place inside a step is one step of order 8 from its beginning.
"""

import math
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import ArrayLike, Float

from afm_jax.apparatus.cantilever import Cantilever
from afm_jax.apparatus.platform import Platform
from afm_jax.apparatus.scene import Scene
from afm_jax.apparatus.surface import Surface, surface_of
from afm_jax.contact.contact import Contact
from afm_jax.contact.phases import Phase, force_in_phase
from afm_jax.motion.contact_path import contact_steps, places_at
from afm_jax.motion.driven import Driven, Place, driven_by
from afm_jax.motion.frames import to_gap, to_lab
from afm_jax.motion.record import ContactKind, Simulation, State

_NODES_PER_STEP = 8
_NODES_PER_PANEL = 16
_PANEL_RAD = 1.5
"""Phase of the fastest motion that one panel of a flight spans."""


class Trajectory(NamedTuple):
    """The tip at given times; NumPy arrays of the times' shape."""

    time_us: np.ndarray
    position_nm: np.ndarray
    """Height in the lab."""
    velocity_nm_per_us: np.ndarray
    gap_nm: np.ndarray
    gap_rate_nm_per_us: np.ndarray
    phase: np.ndarray
    """`Phase` as integers; with a law JUNCTION while the platform holds the tip, or the collision delay lasts."""
    force_nn: np.ndarray
    """Force of the sample on the tip; 0 with a law, whose impacts take no time."""


class _Pieces(NamedTuple):
    """A simulation in pieces that follow each other: flights, steps of contacts, rests on the surface of a law."""

    begin_us: np.ndarray
    end_us: np.ndarray
    kind: np.ndarray
    """_FLIGHT, _REST, or the phase of a step of a contact."""
    origin_us: np.ndarray
    """Time at which the tip has the place that follows."""
    x: np.ndarray
    """The gap in nm, s in the junction."""
    rate: np.ndarray


_FLIGHT, _REST = -1, -2


def trajectory(scene: Scene, simulation: Simulation, times_us: ArrayLike) -> Trajectory:
    """Return the tip at given times.

    Args:
        scene: the scene that was simulated.
        simulation: of one scene, not of a batch.
        times_us: times in us within the simulation, of any shape.

    Raises:
        ValueError: if a time lies outside the simulation, or the simulation is a batch.
    """
    wanted = np.asarray(times_us, float)
    _check(simulation, wanted)
    times = wanted.reshape(-1)
    world = _World.of(scene)
    gap, rate, kind = np.zeros(times.shape), np.zeros(times.shape), np.full(times.shape, _FLIGHT)
    if times.size:
        pieces = _pieces(world, simulation, float(times.min()), float(times.max()))
        place = np.clip(np.searchsorted(pieces.begin_us, times, side="right") - 1, 0, None)
        kind = pieces.kind[place]
        for which, fill in ((kind == _FLIGHT, _in_flight), (kind >= 0, _in_contact)):
            if which.any():
                count = int(which.sum())
                found = fill(world, pieces, _padded(place[which]), _padded(times[which]))
                gap[which], rate[which] = (part[:count] for part in found)
    lab = to_lab(world.surface, world.response, times, gap, rate)
    phase = np.where(kind == _FLIGHT, int(Phase.DRY), np.where(kind == _REST, int(Phase.JUNCTION), kind))
    force = np.zeros(times.shape)
    if world.driven is not None:
        force = np.asarray(force_in_phase(scene.interaction, world.driven.junction, phase, gap, rate))
    parts = (lab.position_nm, lab.velocity_nm_per_us, gap, rate, phase, force)
    return Trajectory(wanted, *(np.asarray(part).reshape(wanted.shape) for part in parts))


def nodes(
    scene: Scene, simulation: Simulation, from_us: float, to_us: float
) -> tuple[Float[np.ndarray, " nodes"], Float[np.ndarray, " nodes"]]:
    """Return times and weights in us: sums of weights times what a trajectory has at the times are integrals over time.

    Gauss-Legendre nodes in every flight and every step of a contact, so that no phase change is crossed.

    Args:
        scene: the scene that was simulated.
        simulation: of one scene.
        from_us: beginning of the integral.
        to_us: its end.

    Raises:
        ValueError: if a time lies outside the simulation, or the simulation is a batch.
    """
    _check(simulation, np.array([from_us, to_us]))
    world = _World.of(scene)
    pieces = _pieces(world, simulation, from_us, to_us)
    fastest = max(float(scene.cantilever.angular_frequency), float(world.surface.fastest_angular_frequency))
    times, weights = [np.zeros(0)], [np.zeros(0)]
    for begin, end, kind in zip(pieces.begin_us, pieces.end_us, pieces.kind, strict=True):
        low, high = max(begin, from_us), min(end, to_us)
        if high <= low:
            continue
        panels = math.ceil((high - low) * fastest / _PANEL_RAD) if kind < 0 else 1
        points, shares = np.polynomial.legendre.leggauss(_NODES_PER_PANEL if kind < 0 else _NODES_PER_STEP)
        edges = np.linspace(low, high, panels + 1)
        half = 0.5 * np.diff(edges)[:, None]
        times.append((edges[:-1, None] + half * (points + 1.0)).reshape(-1))
        weights.append((half * shares).reshape(-1))
    return np.concatenate(times), np.concatenate(weights)


def _padded(values: np.ndarray) -> np.ndarray:
    """Return values filled up to a power of two with the last: few shapes, so that few programs are compiled."""
    size = max(64, 1 << (values.size - 1).bit_length())
    return np.concatenate([values, np.repeat(values[-1:], size - values.size)])


class _World(NamedTuple):
    """What is the same at all times of a simulation."""

    cantilever: Cantilever
    surface: Platform | Surface
    response: Surface | None
    driven: Driven | None
    """None for a law, or without an interaction."""

    @classmethod
    def of(cls, scene: Scene) -> "_World":
        surface, response = surface_of(scene)
        resolved = isinstance(scene.interaction, Contact)
        driven = driven_by(scene.interaction, scene.cantilever, surface) if resolved else None
        return cls(scene.cantilever, surface, response, driven)

    def gaps(self, times: Any, positions: Any, velocities: Any) -> tuple[np.ndarray, np.ndarray]:
        """Return gaps and their rates of places in the lab."""
        gap, rate = to_gap(
            self.surface, self.response, State(*(jnp.asarray(p) for p in (times, positions, velocities)))
        )
        return np.asarray(gap), np.asarray(rate)


def _in_flight(world: _World, pieces: _Pieces, place: np.ndarray, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return gap and gap rate at times within flights."""
    origin = pieces.origin_us[place]
    height, speed = world.surface.position_and_velocity(origin)
    move = world.cantilever.propagator(times - origin)
    position, velocity = move(pieces.x[place] + height, pieces.rate[place] + speed)
    height, speed = world.surface.position_and_velocity(times)
    return np.asarray(position - height), np.asarray(velocity - speed)


def _in_contact(world: _World, pieces: _Pieces, place: np.ndarray, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return gap and gap rate at times within steps of contacts."""
    parts = (pieces.x, pieces.rate, pieces.origin_us, np.zeros(pieces.x.shape))
    start = Place(*(jnp.asarray(part[place]) for part in parts))
    phase = jnp.asarray(pieces.kind[place], jnp.int32)
    assert world.driven is not None  # steps of contacts are of resolved contacts  # noqa: S101
    gap, rate = places_at(world.driven, start, phase, jnp.asarray(times))
    return np.asarray(gap), np.asarray(rate)


def _check(simulation: Simulation, times: np.ndarray) -> None:
    if np.ndim(simulation.count):
        raise ValueError("a trajectory is of one simulation: pick one of the batch")
    first, last = float(simulation.start.time_us), float(simulation.final.time_us)
    rounding = 1e-9 * (1.0 + abs(last))
    if times.size and not (times.min() >= first - rounding and times.max() <= last + rounding):
        raise ValueError(f"`times_us` must lie within the simulation, {first:.9g} to {last:.9g} us")


def _pieces(world: _World, simulation: Simulation, low: float, high: float) -> _Pieces:
    """Return the pieces that cover the times from `low` to `high`."""
    rows, last = simulation.contacts, float(simulation.final.time_us)
    used = np.flatnonzero(np.asarray(rows.kind) != ContactKind.NONE)
    arrival, departure, position, velocity = (
        np.asarray(column)[used]
        for column in (
            rows.arrival_time_us,
            rows.departure_time_us,
            rows.departure_position_nm,
            rows.departure_velocity_nm_per_us,
        )
    )
    left = np.isfinite(departure)
    gap, rate = world.gaps(np.where(left, departure, 0.0), position, velocity)
    origin, place = float(simulation.start.time_us), tuple(float(part) for part in world.gaps(*simulation.start))
    shown, flights, touched = origin, [], []
    for row, (arrives, departs) in enumerate(zip(arrival, departure, strict=True)):
        flights.append((shown, arrives, _FLIGHT, origin, *place))
        stops = min(departs, last)
        if stops >= low and arrives <= high and stops > arrives:
            touched.append(row)
        origin, place = departs, (gap[row], rate[row])
        # a negative delay lets a flight begin before the last one has ended: the earlier one is kept to its end
        shown = max(arrives, departs)
    if origin < last:
        flights.append((shown, last, _FLIGHT, origin, *place))
    near = [piece for piece in flights if piece[1] >= low and piece[0] <= high and piece[1] > piece[0]]
    columns = np.array(near + _contact_pieces(world, simulation, used[touched], min(high, last))).reshape(-1, 6)
    begin, end, kind, origins, x, rates = columns[np.argsort(columns[:, 0], kind="stable")].T
    return _Pieces(begin, end, kind.astype(int), origins, x, rates)


def _contact_pieces(world: _World, simulation: Simulation, rows: np.ndarray, high: float) -> list[tuple[float, ...]]:
    """Return the pieces of some contacts: their steps, or rests on the surface of a law."""
    contacts, last = simulation.contacts, float(simulation.final.time_us)
    arrival = np.asarray(contacts.arrival_time_us)[rows]
    if world.driven is None:
        stops = np.minimum(np.asarray(contacts.departure_time_us)[rows], last)
        return [(begin, end, float(_REST), begin, 0.0, 0.0) for begin, end in zip(arrival, stops, strict=True)]
    if not rows.size:
        return []
    position, velocity = (
        np.asarray(part)[rows] for part in (contacts.arrival_position_nm, contacts.arrival_velocity_nm_per_us)
    )
    gap, rate = world.gaps(arrival, position, velocity)
    begin = Place(*(jnp.asarray(part) for part in (gap, rate, arrival, np.zeros(arrival.shape))))
    # to the end of the last step that a wanted time may lie in
    steps = contact_steps(world.driven, begin, np.full(rows.shape, int(Phase.BRIDGE)), high)
    columns = (steps.begin_us, steps.end_us, steps.phase, steps.begin_us, steps.x, steps.rate)
    return list(zip(*(column.astype(float).tolist() for column in columns), strict=True))
