"""Dense output: where the tip is at any time of a simulation, worked out on request.

A simulation keeps its contacts alone. `dense_path` makes pieces of it in the order of time, each with a state from
which the tip is followed: flights, in closed form; steps of contacts, which are integrated once more, a place inside a
step being one step of order 8 from its beginning; rests on the surface of a law.
"""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from afm_jax.apparatus.cantilever import Cantilever
from afm_jax.apparatus.platform import Platform
from afm_jax.apparatus.scene import Scene
from afm_jax.apparatus.surface import Surface, surface_of
from afm_jax.checks import checked
from afm_jax.contact.contact import Contact
from afm_jax.contact.driven import ContactState, Driven, driven_by
from afm_jax.contact.junction import Phase, force_in_phase
from afm_jax.contact.step import TipInContact, advance, eighth_order_step
from afm_jax.motion.record import ContactKind, Simulation, State, to_gap, to_lab
from afm_jax.results import ResultTuple, public_result
from afm_jax.solve.lanes import compiled_quickly, filled, power_of_two

_BLOCK = 128
"""Trials computed in one call."""
_FINENESS = 4.5
_NEWTON_STEPS = 6
_SHORTEST_US = 1e-13
_NODES_PER_STEP = 8
_NODES_PER_PANEL = 16
_PANEL_RAD = 1.5
"""Phase of the fastest motion that one panel of a flight spans."""
FLIGHT, REST = -1, -2
_PHASES = {FLIGHT: int(Phase.DRY), REST: int(Phase.JUNCTION)}


@public_result(phase=Phase)
class Trajectory(ResultTuple):
    """Height, velocity, gap and force of the tip at given times; NumPy arrays of the times' shape."""

    time_us: np.ndarray
    position_nm: np.ndarray
    """Height of the tip above its rest position, in the lab frame."""
    velocity_nm_per_us: np.ndarray
    gap_nm: np.ndarray
    gap_rate_nm_per_us: np.ndarray
    phase: np.ndarray
    """What is between tip and sample, numbers of `Phase`.

    With a law JUNCTION while the platform holds the tip, or the collision delay lasts.
    """
    force_nn: np.ndarray
    """Force of the sample on the tip; 0 with a law, whose impacts take no time."""


class PreparedScene(NamedTuple):
    """A scene with what its motion is made of: surface, steady response, and equation of motion in contact."""

    scene: Scene
    surface: Platform | Surface
    response: Surface | None
    driven: Driven | None = None
    """None for a law, and without an interaction."""


class Pieces(NamedTuple):
    """Pieces of a motion in the order of time; arrays of shape (pieces,)."""

    begin_us: np.ndarray
    end_us: np.ndarray
    kind: np.ndarray
    """`FLIGHT`, `REST`, or the phase of a step of a contact."""
    origin_us: np.ndarray
    """Time at which the tip has the state that follows: of a flight the departure, or the start."""
    x: np.ndarray
    """The gap in nm; s = sqrt(A) in the junction."""
    rate: np.ndarray
    """Gap rate in nm/us."""

    def where(self, mask: np.ndarray) -> "Pieces":
        """Return some of the pieces, chosen by a mask or by their places."""
        return Pieces(*(column[mask] for column in self))

    def middle_of_longest(self, among: np.ndarray) -> float:
        """Return the middle in us of the longest flight among some; there must be one."""
        longest = int(np.argmax(np.where(among, self.end_us - self.begin_us, -np.inf)))
        return 0.5 * float(self.begin_us[longest] + self.end_us[longest])


class DensePath(NamedTuple):
    """The tip over a stretch of time, its contacts worked out once for all times that are asked for."""

    simulation: Simulation
    prepared: PreparedScene
    pieces: Pieces

    @property
    def scene(self) -> Scene:
        """The scene that was simulated."""
        return self.prepared.scene

    def at(self, times_us: ArrayLike) -> Trajectory:
        """Return the tip at given times in us within the stretch, of any shape.

        Raises:
            ValueError: if a time lies outside the simulation.
        """
        wanted = np.asarray(times_us, float)
        _check(self.simulation, wanted)
        if not wanted.size:
            return Trajectory(wanted, *(np.zeros(wanted.shape, kind) for kind in (float,) * 4 + (int, float)))
        times, prepared = _filled_up(wanted.reshape(-1)), self.prepared
        piece = self.pieces.where(np.clip(np.searchsorted(self.pieces.begin_us, times, side="right") - 1, 0, None))
        flown = _flight(self.scene.cantilever, prepared.surface, piece.x, piece.rate, piece.origin_us, times)
        gap, rate = (np.where(piece.kind == FLIGHT, np.asarray(part), 0.0) for part in flown)
        touching = piece.kind >= 0
        if touching.any():
            inside = Pieces(*(_filled_up(column[touching]) for column in piece))
            in_contact = _in_contact(prepared, inside, _filled_up(times[touching]))
            gap[touching], rate[touching] = (part[: int(touching.sum())] for part in in_contact)
        phase = np.select([piece.kind == kind for kind in _PHASES], list(_PHASES.values()), piece.kind)
        lab = to_lab(prepared.surface, prepared.response, times, gap, rate)
        force = np.zeros(times.shape)
        if prepared.driven is not None:
            force = _force(self.scene.interaction, prepared.driven.junction, phase, gap, rate)
        parts = (lab.position_nm, lab.velocity_nm_per_us, gap, rate, phase, force)
        return Trajectory(wanted, *(np.asarray(part)[: wanted.size].reshape(wanted.shape) for part in parts))

    def nodes(self, from_us: float, to_us: float) -> tuple[Float[np.ndarray, " nodes"], Float[np.ndarray, " nodes"]]:
        """Return times and weights in us whose weighted sums are integrals between two times of the stretch.

        Gauss-Legendre nodes in every flight and every step of a contact, so that no phase change is crossed.
        """
        cantilever, surface, pieces = self.scene.cantilever, self.prepared.surface, self.pieces
        fastest = max(float(cantilever.angular_frequency), float(surface.fastest_angular_frequency))
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


@checked
def trajectory(scene: Scene, simulation: Simulation, times_us: ArrayLike) -> Trajectory:
    """Return height, velocity, gap and force of the tip at given times of a simulation.

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


def dense_path(scene: Scene, simulation: Simulation, from_us: float, to_us: float) -> DensePath:
    """Return the tip over a stretch of time, to be asked for times and nodes as often as wanted.

    A tip that is held is integrated from the beginning of its contact: a second time would cost as much again.

    Args:
        scene: the scene that was simulated.
        simulation: of one scene, not of a batch.
        from_us: beginning of the stretch.
        to_us: its end.

    Raises:
        ValueError: if a time lies outside the simulation, or the simulation is a batch.
    """
    _check(simulation, np.array([from_us, to_us]))
    contact, prepared = scene.interaction, PreparedScene(scene, *surface_of(scene))
    if isinstance(contact, Contact):
        prepared = prepared._replace(driven=driven_by(contact, scene.cantilever, prepared.surface))
    return DensePath(simulation, prepared, pieces_between(prepared, simulation, from_us, to_us))


def flights_of(scene: Scene, simulation: Simulation) -> Pieces:
    """Return all flights of a simulation of one scene."""
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
    gap, rate = (np.asarray(column) for column in to_gap(*surface_of(scene), state))
    # a negative delay lets a flight begin before the last one has ended: the earlier one is kept to its end
    begin = np.maximum(origin, np.concatenate([start[0], arrival]))
    end = np.append(arrival, float(simulation.final.time_us))
    columns = (begin, end, np.full(begin.shape, FLIGHT), origin, gap, rate)
    return Pieces(*columns).where(flies & (end > begin))


def fly(scene: Scene, flights: Pieces, times_us: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return heights in nm and velocities in nm/us in the lab along flights, at times of shape (times, flights)."""
    surface, response = surface_of(scene)
    origin, times = jnp.asarray(flights.origin_us), jnp.asarray(times_us)
    gap, rate = _flight(scene.cantilever, surface, jnp.asarray(flights.x), jnp.asarray(flights.rate), origin, times)
    lab = to_lab(surface, response, times, gap, rate)
    return np.asarray(lab.position_nm), np.asarray(lab.velocity_nm_per_us)


def state_at(scene: Scene, simulation: Simulation, time_us: float) -> State | None:
    """Return the tip in flight at a time, or None where it is in contact or outside the simulation."""
    flights = flights_of(scene, simulation)
    here = np.flatnonzero((flights.begin_us <= time_us) & (time_us <= flights.end_us))
    if not here.size:
        return None
    position, velocity = fly(scene, flights.where(here[:1]), np.array([[time_us]]))
    return State(*(jnp.asarray(part) for part in (time_us, position[0, 0], velocity[0, 0])))


@jax.jit
def _flight(
    cantilever: Cantilever,
    surface: Platform | Surface,
    gap: Float[Array, "..."],
    rate: Float[Array, "..."],
    origin_us: Float[Array, "..."],
    times_us: Float[Array, "..."],
) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
    """Return gap in nm and gap rate in nm/us at times of flights that have a gap and a rate at their origins."""
    height, speed = surface.position_and_velocity(origin_us)
    position, velocity = cantilever.propagator(times_us - origin_us)(gap + height, rate + speed)
    height, speed = surface.position_and_velocity(times_us)
    return position - height, velocity - speed


_force = jax.jit(force_in_phase)


def pieces_between(prepared: PreparedScene, simulation: Simulation, low: float, high: float) -> Pieces:
    """Return the pieces that cover the times from `low` to `high`."""
    rows, last = simulation.contacts, float(simulation.final.time_us)
    flights = flights_of(prepared.scene, simulation)
    flights = flights.where((flights.end_us >= low) & (flights.begin_us <= high))
    arrival = np.asarray(rows.arrival_time_us)
    stops = np.minimum(np.asarray(rows.departure_time_us), last)
    touched = (np.asarray(rows.kind) != ContactKind.NONE) & (stops >= low) & (arrival <= high) & (stops > arrival)
    touched = np.flatnonzero(touched)
    if prepared.driven is not None and touched.size:
        # to the end of the last step that a wanted time may lie in
        contacts = _integrated_contacts(prepared, simulation, touched, min(high, last))
    else:
        begin, still = arrival[touched], np.zeros(touched.shape)
        contacts = Pieces(begin, stops[touched], np.full(begin.shape, REST), begin, still, still)
    both = Pieces(*(np.concatenate(columns) for columns in zip(flights, contacts, strict=True)))
    return both.where(np.argsort(both.begin_us, kind="stable"))


def _integrated_contacts(prepared: PreparedScene, simulation: Simulation, rows: np.ndarray, until_us: float) -> Pieces:
    """Return the steps of contacts from their beginnings to their ends, or to a time; each step is of one phase."""
    driven, contacts = prepared.driven, simulation.contacts
    assert driven is not None  # its contacts are to be integrated  # noqa: S101
    columns = (contacts.arrival_time_us, contacts.arrival_position_nm, contacts.arrival_velocity_nm_per_us)
    arrival = State(*(jnp.asarray(np.asarray(column)[rows]) for column in columns))
    gap, rate = to_gap(prepared.surface, prepared.response, arrival)
    # filled up with tips in no contact to a power of two: few shapes, so that few programs are compiled
    spare = jnp.ones((1 << max(len(rows) - 1, 0).bit_length()) - len(rows))
    parts = (gap, rate, arrival.time_us, jnp.zeros(rows.shape))
    place = ContactState(*(jnp.concatenate([part, spare]) for part in parts))
    tip = TipInContact.arriving(driven, place, jnp.arange(len(place.x)) < len(rows))
    until, taken = jnp.asarray(until_us, tip.state.x.dtype), [Pieces(*np.zeros((6, 0)))]
    while np.any((np.asarray(tip.phase) != Phase.DRY) & (np.asarray(tip.state.time_us) < until_us)):
        tip, (steps, accepted) = _some_trials(driven, tip, until)
        taken.append(Pieces(*(np.asarray(column)[np.asarray(accepted)] for column in steps)))
    joined = Pieces(*(np.concatenate(columns) for columns in zip(*taken, strict=True)))
    joined = joined._replace(kind=joined.kind.astype(int))
    # a step within the rounding of its time could come to stand behind the flight after it
    return joined.where(joined.end_us - joined.begin_us > _SHORTEST_US * (1.0 + np.abs(joined.begin_us)))


@compiled_quickly()
def _some_trials(
    driven: Driven, tip: TipInContact, until: Float[Array, ""]
) -> tuple[TipInContact, tuple[tuple[Array, ...], Bool[Array, "trials contacts"]]]:
    """Return tips after some trial steps, these steps as columns of `Pieces`, and which of them were accepted."""

    def once(tip, _):
        going = (tip.phase != Phase.DRY) & (tip.state.time_us < until)
        after = advance(driven, tip, until, _FINENESS)
        place, begin = tip.state, tip.state.time_us
        step = (begin, after.state.time_us, tip.phase, begin, place.x, place.gap_rate)
        moved = jax.tree.map(lambda new, old: jnp.where(going, new, old), after, tip)
        return moved, (step, going & (after.trial_length == 0.0))

    return lax.scan(once, tip, None, length=_BLOCK)


def _in_contact(prepared: PreparedScene, piece: Pieces, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return gap and gap rate at times within steps of contacts, each with the step that it lies in."""
    start = ContactState(*(jnp.asarray(part) for part in (piece.x, piece.rate, piece.origin_us, 0.0 * piece.x)))
    phase = jnp.asarray(piece.kind, jnp.int32)
    assert prepared.driven is not None  # steps of contacts are of resolved contacts  # noqa: S101
    gap, rate = _states_at(prepared.driven, start, phase, jnp.asarray(times))
    return np.asarray(gap), np.asarray(rate)


@jax.jit
def _states_at(
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


def _filled_up(values: np.ndarray) -> np.ndarray:
    return filled(values, power_of_two(values.size, 64))


def _check(simulation: Simulation, times: np.ndarray) -> None:
    if np.ndim(simulation.count):
        raise ValueError("a trajectory is of one simulation: pick one of the batch")
    first, last = float(simulation.start.time_us), float(simulation.final.time_us)
    rounding = 1e-9 * (1.0 + abs(last))
    if times.size and not (times.min() >= first - rounding and times.max() <= last + rounding):
        raise ValueError(f"`times_us` must lie within the simulation, {first:.9g} to {last:.9g} us")
