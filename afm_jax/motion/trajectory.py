"""Dense output: where the tip is at any time of a simulation, worked out on request.

A simulation keeps its contacts alone. `DensePath` makes of it pieces in the order of time: flights, in closed form;
steps of contacts, which are integrated once more, a place inside a step being one step of order 8 from its beginning;
rests on the surface of a law. Where contacts need not be known so well they are straight lines between the points that
a simulation keeps of them (bridge formed, junction formed, deepest, junction broken, bridge broken), without a second
integration.
"""

import math
from itertools import pairwise
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, ArrayLike, Float, Int

from afm_jax.apparatus.cantilever import Cantilever
from afm_jax.apparatus.platform import Platform
from afm_jax.apparatus.scene import Scene, SceneLike, as_scene
from afm_jax.apparatus.surface import Surface, surface_of
from afm_jax.checks import checked
from afm_jax.contact.contact import Contact
from afm_jax.contact.driven import ContactState, Driven, driven_by
from afm_jax.contact.junction import Junction, Phase, find_junction, force_in_phase
from afm_jax.contact.step import TipInContact, advance, eighth_order_step
from afm_jax.motion.record import ContactKind, Simulation, State, to_gap, to_lab
from afm_jax.results import ResultTuple, public_result
from afm_jax.solve.lanes import filled, power_of_two

_BLOCK = 128
"""Trials computed in one call."""
_FINENESS = 4.5
_NEWTON_STEPS = 6
_SHORTEST_US = 1e-13


class Steps(NamedTuple):
    """Steps of contacts in the order of time, arrays of shape (steps,); each is of one phase."""

    begin_us: np.ndarray
    end_us: np.ndarray
    phase: np.ndarray
    x: np.ndarray
    """At the beginning: the gap in nm, s = sqrt(A) in the junction."""
    rate: np.ndarray
    """Gap rate in nm/us at the beginning."""


def contact_steps(driven: Driven, begin: ContactState, phase: Int[np.ndarray, " contacts"], until_us: float) -> Steps:
    """Return the steps of contacts from their beginnings to their ends, or to a time.

    Args:
        driven: the equation of motion.
        begin: where each contact begins; arrays of shape (contacts,).
        phase: phase at the beginning.
        until_us: end of the last one at the latest.
    """
    # filled up with tips in no contact to a power of two: few shapes, so that few programs are compiled
    spare = (1 << max(len(phase) - 1, 0).bit_length()) - len(phase)
    place = ContactState(*(jnp.concatenate([jnp.asarray(part), jnp.ones(spare)]) for part in begin))
    phases = np.concatenate([phase, np.full(spare, int(Phase.DRY))])
    touch = TipInContact.arriving(driven, place, jnp.asarray(phases != Phase.DRY))
    until = jnp.asarray(until_us, touch.state.x.dtype)
    parts = []
    while np.any((np.asarray(touch.phase) != Phase.DRY) & (np.asarray(touch.state.time_us) < until_us)):
        touch, record = _some_trials(driven, touch, until)
        taken, *columns = (np.asarray(part) for part in jax.tree.leaves(record))
        parts.append([column[taken] for column in columns])
    joined = [np.concatenate(columns) for columns in zip(*parts, strict=True)] if parts else [np.zeros(0)] * 6
    # a step within the rounding of its time could come to stand behind the flight after it
    last = joined[5] - joined[2] > _SHORTEST_US * (1.0 + np.abs(joined[2]))
    joined = [column[last] for column in joined]
    order = np.argsort(joined[2], kind="stable")
    x, rate, time, _, kinds, ends = (column[order] for column in joined)
    return Steps(time, ends, kinds.astype(int), x, rate)


@jax.jit
def _some_trials(driven: Driven, touch: TipInContact, until: Float[Array, ""]) -> tuple[TipInContact, tuple]:
    def once(touch, _):
        going = (touch.phase != Phase.DRY) & (touch.state.time_us < until)
        after = advance(driven, touch, until, _FINENESS)
        taken = going & (after.trial_length == 0.0)
        kept = jax.tree.map(lambda new, old: jnp.where(going, new, old), after, touch)
        return kept, (taken, *touch.state, touch.phase, after.state.time_us)

    return lax.scan(once, touch, None, length=_BLOCK)


@jax.jit
def places_at(
    driven: Driven, start: ContactState, phase: Int[Array, " times"], time_us: Float[Array, " times"]
) -> tuple[Float[Array, " times"], Float[Array, " times"]]:
    """Return gap in nm and its rate in nm/us at times within steps, by one step of order 8 from where each began.

    Args:
        driven: the equation of motion.
        start: where the step that holds a time began.
        phase: its phase.
        time_us: the times.
    """
    solid = phase == Phase.JUNCTION

    def stepped(length):
        return eighth_order_step(lambda place: driven.rates(place, solid), start, length)

    # in the junction the variable is fictitious time: its value at a time is a root
    rate = driven.rates(start, solid).time_us

    def newton(_, length):
        end = stepped(length)
        passing = driven.rates(end, solid).time_us
        # time stands still at the fold
        return length + (time_us - end.time_us) / jnp.where(passing == 0.0, 1.0, passing)

    elapsed = time_us - start.time_us
    first = elapsed / jnp.where(solid, jnp.maximum(rate, 1e-3), 1.0)
    if driven.solid.reversible:
        # time stands still where a dry contact begins, and grows with the square of the variable
        s_rate = driven.rates(start, solid).x
        _, growth = jax.jvp(driven.solid.depth_slope, (start.x,), (s_rate,))
        root = jnp.sqrt(jnp.maximum(rate * rate + 2.0 * growth * elapsed, 0.0))
        first = jnp.where(solid, 2.0 * elapsed / jnp.maximum(rate + root, 1e-9), first)
    length = lax.fori_loop(0, _NEWTON_STEPS, newton, first)
    end = stepped(length)
    return driven.gap(end.x, phase), end.gap_rate


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
    """A scene prepared for evaluation at many times: surface, response, and equation of motion in contact."""

    cantilever: Cantilever
    surface: Platform | Surface
    response: Surface | None
    driven: Driven | None
    """None for a law, without an interaction, and where contacts are not integrated once more."""
    kept_gaps: tuple[float, ...] | None = None
    """Where they are not: gaps in nm at which the bridge forms, the junction forms and breaks, the bridge breaks."""

    @classmethod
    def of(cls, scene: Scene, *, integrated: bool = True) -> "World":
        """Return a scene prepared, its contacts to be integrated once more or straight."""
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
        states = State(*(jnp.asarray(column) for column in (times, positions, velocities)))
        gap, rate = to_gap(self.surface, self.response, states)
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
    flies = np.isfinite(origin)
    state = State(*(jnp.asarray(column) for column in (np.where(flies, origin, 0.0), position, velocity)))
    gap, rate = (np.asarray(column) for column in to_gap(surface, response, state))
    # a negative delay lets a flight begin before the last one has ended: the earlier one is kept to its end
    begin = np.maximum(origin, np.concatenate([start[0], arrival]))
    end = np.append(arrival, float(simulation.final.time_us))
    exists = flies & (end > begin)
    return Flights(*(column[exists] for column in (begin, end, origin, gap, rate)))


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
        return [piece for points in corners for piece in _straight_pieces(points)]
    if world.driven is None:
        return [(begin, end, float(REST), begin, 0.0, 0.0) for begin, end in zip(arrival, stops, strict=True)]
    if not rows.size:
        return []
    position, velocity = (
        np.asarray(part)[rows] for part in (contacts.arrival_position_nm, contacts.arrival_velocity_nm_per_us)
    )
    gap, rate = world.gaps(arrival, position, velocity)
    begin = ContactState(*(jnp.asarray(part) for part in (gap, rate, arrival, np.zeros(arrival.shape))))
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


_NODES_PER_STEP = 8
_NODES_PER_PANEL = 16
_PANEL_RAD = 1.5
"""Phase of the fastest motion that one panel of a flight spans."""


@public_result(phase=Phase)
class Trajectory(ResultTuple):
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
        times, world, pieces = _filled_up(wanted.reshape(-1)), self.world, self.pieces
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
            found = _in_contact(world, pieces, _filled_up(place[touching]), _filled_up(times[touching]))
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
        """Return times and weights in us whose weighted sums are integrals between two times of the stretch.

        Gauss-Legendre nodes in every flight and every step of a contact, so that no phase change is crossed.
        """
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


@checked
def trajectory(scene: SceneLike, simulation: Simulation, times_us: ArrayLike) -> Trajectory:
    """Return the tip at given times.

    Args:
        scene: the scene that was simulated.
        simulation: of one scene, not of a batch.
        times_us: times in us within the simulation, of any shape.

    Raises:
        ValueError: if a time lies outside the simulation, or the simulation is a batch.
    """
    scene = as_scene(scene)
    wanted = np.asarray(times_us, float)
    # without times: a stretch of no length
    ends = (wanted.min(), wanted.max()) if wanted.size else (simulation.start.time_us,) * 2
    return dense_path(scene, simulation, *(float(end) for end in ends)).at(wanted)


def _filled_up(values: np.ndarray) -> np.ndarray:
    return filled(values, power_of_two(values.size, 64))


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
    start = ContactState(*(jnp.asarray(part[place]) for part in parts))
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
