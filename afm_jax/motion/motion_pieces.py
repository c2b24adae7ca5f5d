"""A simulation in pieces that follow each other: flights, steps of contacts, rests on the surface of a law.

Instead of its steps a contact may have the straight lines between the points that a simulation keeps of it: bridge
formed, junction formed, deepest, junction broken, bridge broken. Short against the drive period, it then costs no
second integration, and whatever is read of it is a smooth function of the simulation's numbers.
"""

from itertools import pairwise
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from afm_jax.apparatus.cantilever import Cantilever
from afm_jax.apparatus.platform import Platform
from afm_jax.apparatus.scene import Scene
from afm_jax.apparatus.surface import Surface, surface_of
from afm_jax.contact.contact import Contact
from afm_jax.contact.driven import Driven, Place, driven_by
from afm_jax.contact.junction import find_junction
from afm_jax.contact.phases import Phase
from afm_jax.motion.contact_path import contact_steps
from afm_jax.motion.frames import to_gap
from afm_jax.motion.record import ContactKind, Simulation, State

FLIGHT, REST, STRAIGHT = -1, -2, -3


class Pieces(NamedTuple):
    """Pieces in the order of their beginnings; arrays of shape (pieces,)."""

    begin_us: np.ndarray
    end_us: np.ndarray
    kind: np.ndarray
    """`FLIGHT`, `REST`, `STRAIGHT`, or the phase of a step of a contact."""
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
    """None for a law, without an interaction, and where contacts are not integrated once more."""
    kept_gaps: tuple[float, ...] | None = None
    """Where they are not: gaps in nm at which the bridge forms, the junction forms and breaks, the bridge breaks."""

    @classmethod
    def of(cls, scene: Scene, *, integrated: bool = True) -> "World":
        """Return what is the same at all times of a scene, its contacts integrated once more or straight."""
        surface, response = surface_of(scene)
        contact = scene.interaction
        if not isinstance(contact, Contact):
            return cls(scene.cantilever, surface, response, None)
        if integrated:
            return cls(scene.cantilever, surface, response, driven_by(contact, scene.cantilever, surface))
        junction = find_junction(contact)
        gaps = (contact.bridge_forms_nm, junction.forms_gap_nm, junction.breaks_gap_nm, contact.bridge_breaks_nm)
        return cls(scene.cantilever, surface, response, None, tuple(float(gap) for gap in gaps))

    def gaps(self, times: Any, positions: Any, velocities: Any) -> tuple[np.ndarray, np.ndarray]:
        """Return gaps and their rates of places in the lab."""
        gap, rate = to_gap(
            self.surface, self.response, State(*(jnp.asarray(p) for p in (times, positions, velocities)))
        )
        return np.asarray(gap), np.asarray(rate)


class Flights(NamedTuple):
    """The free flights of a simulation, in closed form, in order; arrays of shape (flights,)."""

    begin_us: np.ndarray
    end_us: np.ndarray
    origin_us: np.ndarray
    """Time at which the tip has the gap and the rate that follow: the departure, or the start."""
    gap_nm: np.ndarray
    rate: np.ndarray

    def middle_of_longest(self, among: np.ndarray) -> float:
        """Return the middle in us of the longest flight among some; there must be one."""
        longest = int(np.argmax(np.where(among, self.end_us - self.begin_us, -np.inf)))
        return 0.5 * float(self.begin_us[longest] + self.end_us[longest])


def flights_of(scene: Scene, simulation: Simulation) -> Flights:
    """Return all flights of a simulation of one scene."""
    return _flights(*surface_of(scene), simulation)


def _flights(surface: Platform | Surface, response: Surface | None, simulation: Simulation) -> Flights:
    rows = simulation.contacts
    used = np.asarray(rows.kind) != ContactKind.NONE
    arrival = np.asarray(rows.arrival_time_us)[used]
    start = [np.asarray(part, float).reshape(1) for part in simulation.start]
    departures = (rows.departure_time_us, rows.departure_position_nm, rows.departure_velocity_nm_per_us)
    origin, position, velocity = (
        np.concatenate([first, np.asarray(column)[used]]) for first, column in zip(start, departures, strict=True)
    )
    left = np.isfinite(origin)
    state = State(*(jnp.asarray(part) for part in (np.where(left, origin, 0.0), position, velocity)))
    gap, rate = (np.asarray(part) for part in to_gap(surface, response, state))
    # a negative delay lets a flight begin before the last one has ended: the earlier one is kept to its end
    begin = np.maximum(origin, np.concatenate([start[0], arrival]))
    end = np.append(arrival, float(simulation.final.time_us))
    here = left & (end > begin)
    return Flights(begin[here], end[here], origin[here], gap[here], rate[here])


def fly(scene: Scene, flights: Flights, times_us: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return heights in nm and velocities in nm/us in the lab along flights, at times of shape (times, flights)."""
    surface, response = surface_of(scene)
    height, speed = (np.asarray(part) for part in surface.position_and_velocity(jnp.asarray(flights.origin_us)))
    move = scene.cantilever.propagator(jnp.asarray(times_us - flights.origin_us))
    position, velocity = move(jnp.asarray(flights.gap_nm + height), jnp.asarray(flights.rate + speed))
    if response is not None:
        steady, rate = response.position_and_velocity(jnp.asarray(times_us))
        position, velocity = position + steady, velocity + rate
    return np.asarray(position), np.asarray(velocity)


def state_at(scene: Scene, simulation: Simulation, time_us: float) -> State | None:
    """Return the tip in flight at a time, or None where it is in contact or outside the simulation."""
    flights = flights_of(scene, simulation)
    here = np.flatnonzero((flights.begin_us <= time_us) & (time_us <= flights.end_us))
    if not here.size:
        return None
    position, velocity = fly(scene, Flights(*(part[here[:1]] for part in flights)), np.array([[time_us]]))
    return State(*(jnp.asarray(part) for part in (time_us, position[0, 0], velocity[0, 0])))


def pieces_between(world: World, simulation: Simulation, low: float, high: float) -> Pieces:
    """Return the pieces that cover the times from `low` to `high`."""
    rows, last = simulation.contacts, float(simulation.final.time_us)
    flown = _flights(world.surface, world.response, simulation)
    near = (flown.end_us >= low) & (flown.begin_us <= high)
    flights = (flown.begin_us, flown.end_us, np.full(near.shape, float(FLIGHT)), *flown[2:])
    arrival = np.asarray(rows.arrival_time_us)
    stops = np.minimum(np.asarray(rows.departure_time_us), last)
    touched = (np.asarray(rows.kind) != ContactKind.NONE) & (stops >= low) & (arrival <= high) & (stops > arrival)
    contacts = _contact_pieces(world, simulation, np.flatnonzero(touched), min(high, last))
    columns = np.concatenate([np.stack(flights, axis=1)[near], np.reshape(contacts, (-1, 6))])
    begin, end, kind, origins, x, rates = columns[np.argsort(columns[:, 0], kind="stable")].T
    return Pieces(begin, end, kind.astype(int), origins, x, rates)


def _contact_pieces(world: World, simulation: Simulation, rows: np.ndarray, high: float) -> list[tuple[float, ...]]:
    """Return the pieces of some contacts: their steps, their straight lines, or rests on the surface of a law."""
    contacts, last = simulation.contacts, float(simulation.final.time_us)
    arrival = np.asarray(contacts.arrival_time_us)[rows]
    stops = np.minimum(np.asarray(contacts.departure_time_us)[rows], last)
    if world.kept_gaps is not None:
        ends = zip(rows.tolist(), stops.tolist(), strict=True)
        corners = [_corners(simulation, row, end, world.kept_gaps) for row, end in ends]
        return [piece for each in corners for piece in _straight_pieces(each)]
    if world.driven is None:
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


def _corners(simulation: Simulation, row: int, stops_us: float, gaps: tuple[float, ...]) -> list[tuple[float, float]]:
    """Return the times and gaps that a simulation keeps of a contact."""
    rows = simulation.contacts
    detail, arrival = rows.detail, float(rows.arrival_time_us[row])
    assert detail is not None  # contacts that are resolved have details  # noqa: S101
    bridge_forms, junction_forms, junction_breaks, bridge_breaks = gaps
    deepest, forms, breaks = (
        float(column[row]) for column in (detail.deepest_gap_nm, detail.junction_forms_us, detail.junction_breaks_us)
    )
    middle = [(0.5 * (arrival + stops_us), deepest)]
    if int(detail.junctions[row]) and arrival < forms < breaks < stops_us:
        middle = [(forms, junction_forms), (0.5 * (forms + breaks), deepest), (breaks, junction_breaks)]
    return [(arrival, bridge_forms), *middle, (stops_us, bridge_breaks)]


def _straight_pieces(corners: list[tuple[float, float]]) -> list[tuple[float, ...]]:
    return [
        (begin, end, float(STRAIGHT), begin, gap, (next_gap - gap) / (end - begin))
        for (begin, gap), (end, next_gap) in pairwise(corners)
        if end > begin
    ]
