"""A simulation in pieces that follow each other: flights, steps of contacts, rests on the surface of a law."""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from afm_jax.apparatus.cantilever import Cantilever
from afm_jax.apparatus.platform import Platform
from afm_jax.apparatus.scene import Scene
from afm_jax.apparatus.surface import Surface, surface_of
from afm_jax.contact.contact import Contact
from afm_jax.contact.driven import Driven, Place, driven_by
from afm_jax.contact.phases import Phase
from afm_jax.motion.contact_path import contact_steps
from afm_jax.motion.frames import to_gap
from afm_jax.motion.record import ContactKind, Simulation, State

FLIGHT, REST = -1, -2


class Pieces(NamedTuple):
    """Pieces in the order of their beginnings; arrays of shape (pieces,)."""

    begin_us: np.ndarray
    end_us: np.ndarray
    kind: np.ndarray
    """`FLIGHT`, `REST`, or the phase of a step of a contact."""
    origin_us: np.ndarray
    """Time at which the tip has the place that follows."""
    x: np.ndarray
    """The gap in nm, s in the junction."""
    rate: np.ndarray


class World(NamedTuple):
    """What is the same at all times of a simulation."""

    cantilever: Cantilever
    surface: Platform | Surface
    response: Surface | None
    driven: Driven | None
    """None for a law, or without an interaction."""

    @classmethod
    def of(cls, scene: Scene) -> "World":
        """Return what is the same at all times of a scene."""
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


def pieces_between(world: World, simulation: Simulation, low: float, high: float) -> Pieces:
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
        flights.append((shown, arrives, FLIGHT, origin, *place))
        stops = min(departs, last)
        if stops >= low and arrives <= high and stops > arrives:
            touched.append(row)
        origin, place = departs, (gap[row], rate[row])
        # a negative delay lets a flight begin before the last one has ended: the earlier one is kept to its end
        shown = max(arrives, departs)
    if origin < last:
        flights.append((shown, last, FLIGHT, origin, *place))
    near = [piece for piece in flights if piece[1] >= low and piece[0] <= high and piece[1] > piece[0]]
    columns = np.array(near + _contact_pieces(world, simulation, used[touched], min(high, last))).reshape(-1, 6)
    begin, end, kind, origins, x, rates = columns[np.argsort(columns[:, 0], kind="stable")].T
    return Pieces(begin, end, kind.astype(int), origins, x, rates)


def _contact_pieces(world: World, simulation: Simulation, rows: np.ndarray, high: float) -> list[tuple[float, ...]]:
    """Return the pieces of some contacts: their steps, or rests on the surface of a law."""
    contacts, last = simulation.contacts, float(simulation.final.time_us)
    arrival = np.asarray(contacts.arrival_time_us)[rows]
    if world.driven is None:
        stops = np.minimum(np.asarray(contacts.departure_time_us)[rows], last)
        return [(begin, end, float(REST), begin, 0.0, 0.0) for begin, end in zip(arrival, stops, strict=True)]
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
