"""Dense output: where the tip is at any time of a simulation, worked out on request.

A simulation keeps its contacts. Between them the flight is a closed form; the contacts asked for are integrated once
more, step by step, and a place inside a step is one step of order 8 from its beginning. Where contacts need not be
known so well they may be straight between the points that the simulation keeps of them.
"""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Int

from afm_jax.apparatus.cantilever import Cantilever
from afm_jax.apparatus.platform import Platform
from afm_jax.apparatus.scene import Scene
from afm_jax.apparatus.surface import Surface
from afm_jax.contact.contact import Contact
from afm_jax.contact.driven import Place
from afm_jax.contact.junction import Junction
from afm_jax.contact.phases import Phase, force_in_phase
from afm_jax.motion.contact_path import places_at
from afm_jax.motion.frames import to_lab
from afm_jax.motion.motion_pieces import FLIGHT, REST, STRAIGHT, Pieces, World, pieces_between
from afm_jax.motion.record import Simulation, State

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


class DensePath(NamedTuple):
    """The tip over a stretch of time, its contacts worked out once for all times that are asked for."""

    scene: Scene
    simulation: Simulation
    world: World
    pieces: Pieces

    def at(self, times_us: ArrayLike) -> Trajectory:
        """Return the tip at given times in us within the stretch, of any shape.

        Raises:
            ValueError: if a time lies outside the simulation.
        """
        wanted = np.asarray(times_us, float)
        _check(self.simulation, wanted)
        if not wanted.size:
            return Trajectory(wanted, *(np.zeros(wanted.shape, kind) for kind in (float,) * 4 + (int, float)))
        times, world, pieces = _padded(wanted.reshape(-1)), self.world, self.pieces
        place = np.clip(np.searchsorted(pieces.begin_us, times, side="right") - 1, 0, None)
        kind = pieces.kind[place]
        flown = _flown(world.cantilever, world.surface, *(part[place] for part in _starts(pieces)), times)
        gap, rate = (np.where(kind == FLIGHT, np.asarray(part), 0.0) for part in flown)
        straight = kind == STRAIGHT
        line = pieces.x[place] + pieces.rate[place] * (times - pieces.origin_us[place])
        gap, rate = np.where(straight, line, gap), np.where(straight, pieces.rate[place], rate)
        touching = kind >= 0
        if touching.any():
            count = int(touching.sum())
            found = _in_contact(world, pieces, _padded(place[touching]), _padded(times[touching]))
            gap[touching], rate[touching] = (part[:count] for part in found)
        phase = np.where(kind == FLIGHT, int(Phase.DRY), np.where(kind == REST, int(Phase.JUNCTION), kind))
        phase = np.where(straight, int(Phase.BRIDGE), phase)
        lab = _in_lab(world.surface, world.response, times, gap, rate)
        force = np.zeros(times.shape)
        if world.driven is not None:
            force = _force(self.scene.interaction, world.driven.junction, phase, gap, rate)
        parts = (lab.position_nm, lab.velocity_nm_per_us, gap, rate, phase, force)
        return Trajectory(wanted, *(np.asarray(part)[: wanted.size].reshape(wanted.shape) for part in parts))

    def nodes(self, from_us: float, to_us: float) -> tuple[Float[np.ndarray, " nodes"], Float[np.ndarray, " nodes"]]:
        """Return times and weights in us between two times of the stretch, as `nodes` does."""
        world, pieces = self.world, self.pieces
        fastest = max(float(world.cantilever.angular_frequency), float(world.surface.fastest_angular_frequency))
        in_flight, in_contact = (np.polynomial.legendre.leggauss(n) for n in (_NODES_PER_PANEL, _NODES_PER_STEP))
        times, weights = [np.zeros(0)], [np.zeros(0)]
        for begin, end, kind in zip(pieces.begin_us, pieces.end_us, pieces.kind, strict=True):
            low, high = max(begin, from_us), min(end, to_us)
            if high <= low:
                continue
            panels = math.ceil((high - low) * fastest / _PANEL_RAD) if kind < 0 else 1
            points, shares = in_flight if kind < 0 else in_contact
            edges = np.linspace(low, high, panels + 1)
            half = 0.5 * np.diff(edges)[:, None]
            times.append((edges[:-1, None] + half * (points + 1.0)).reshape(-1))
            weights.append((half * shares).reshape(-1))
        return np.concatenate(times), np.concatenate(weights)


def dense_path(
    scene: Scene, simulation: Simulation, from_us: float, to_us: float, *, integrated: bool = True
) -> DensePath:
    """Return the tip over a stretch of time, to be asked for times and nodes as often as wanted.

    A tip that is held is integrated from the beginning of its contact: a second time would cost as much again.

    Args:
        scene: the scene that was simulated.
        simulation: of one scene, not of a batch.
        from_us: beginning of the stretch.
        to_us: its end.
        integrated: integrate contacts once more; else they are straight between the points that the simulation keeps
            of them, and have no force.

    Raises:
        ValueError: if a time lies outside the simulation, or the simulation is a batch.
    """
    _check(simulation, np.array([from_us, to_us]))
    world = World.of(scene, integrated=integrated)
    return DensePath(scene, simulation, world, pieces_between(world, simulation, from_us, to_us))


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
    # without times: a stretch of no length
    ends = (wanted.min(), wanted.max()) if wanted.size else (simulation.start.time_us,) * 2
    return dense_path(scene, simulation, *(float(end) for end in ends)).at(wanted)


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
    return dense_path(scene, simulation, from_us, to_us).nodes(from_us, to_us)


def _padded(values: np.ndarray) -> np.ndarray:
    """Return values filled up to a power of two with the last: few shapes, so that few programs are compiled."""
    size = max(64, 1 << (values.size - 1).bit_length())
    return np.concatenate([values, np.repeat(values[-1:], size - values.size)])


def _starts(pieces: Pieces) -> tuple[np.ndarray, ...]:
    """Return where flights begin: gap, gap rate and time."""
    return pieces.x, pieces.rate, pieces.origin_us


@jax.jit
def _flown(
    cantilever: Cantilever,
    surface: Platform | Surface,
    gap: Float[Array, " times"],
    rate: Float[Array, " times"],
    origin_us: Float[Array, " times"],
    times_us: Float[Array, " times"],
) -> tuple[Float[Array, " times"], Float[Array, " times"]]:
    """Return gap and gap rate at times of flights that begin with a gap and a rate."""
    height, speed = surface.position_and_velocity(origin_us)
    position, velocity = cantilever.propagator(times_us - origin_us)(gap + height, rate + speed)
    height, speed = surface.position_and_velocity(times_us)
    return position - height, velocity - speed


@jax.jit
def _in_lab(
    surface: Platform | Surface,
    response: Surface | None,
    times_us: Float[Array, " times"],
    gap: Float[Array, " times"],
    rate: Float[Array, " times"],
) -> State:
    return to_lab(surface, response, times_us, gap, rate)


@jax.jit
def _force(
    contact: Contact,
    junction: Junction,
    phase: Int[Array, " times"],
    gap: Float[Array, " times"],
    rate: Float[Array, " times"],
) -> Float[Array, " times"]:
    return force_in_phase(contact, junction, phase, gap, rate)


def _in_contact(world: World, pieces: Pieces, place: np.ndarray, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
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
