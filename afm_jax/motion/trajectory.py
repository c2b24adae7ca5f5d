"""Dense output: where the tip is at any time of a simulation, worked out on request.

Takes a scene, its simulation and times in us; gives height and gap in nm, their rates in nm/us, force in nN and phase
of the contact then (eq. 16).

A simulation keeps its contacts alone. A `DensePath` is made of pieces in the order of time, each with a state from
which the tip is followed: flights, in closed form; resolved contacts, which are integrated once more when a time within
them is asked for, a place inside a step being one step of order 8 from its beginning; rests on the surface of a law.
"""

import math
from typing import Any, NamedTuple

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
from afm_jax.contact.junction import ContactPhase, force_in_phase
from afm_jax.contact.step import TipInContact, advance, eighth_order_step
from afm_jax.motion.record import Simulation, State, contacts_of, to_gap, to_lab, where
from afm_jax.results import ResultTuple, public_result
from afm_jax.solve.lanes import filled, power_of_two
from afm_jax.solve.newton_steps import newton_steps

_BLOCK, _FEWEST = 128, 8
"""Trials computed in one call, and contacts at least."""
_FINENESS = 4.5
_NEWTON_STEPS = 6
_SHORTEST_US = 1e-13
_NODES_PER_STEP = 8
_NODES_PER_PANEL = 16
_PANEL_RAD = 1.5
"""Phase of the fastest motion that one panel of a flight spans."""
FLIGHT, REST, CONTACT = -1, -2, -3
_PHASES = {FLIGHT: int(ContactPhase.DRY), REST: int(ContactPhase.JUNCTION)}


@public_result(phase=ContactPhase)
class Trajectory(ResultTuple):
    """Height, velocity, gap and force of the tip at given times; NumPy arrays of the times' shape."""

    time_us: np.ndarray
    position_nm: np.ndarray
    """Height of the tip above its rest position, in the lab frame."""
    velocity_nm_per_us: np.ndarray
    gap_nm: np.ndarray
    gap_rate_nm_per_us: np.ndarray
    phase: np.ndarray
    """What is between tip and sample, numbers of `ContactPhase`.

    With a law JUNCTION while the platform holds the tip, or the collision delay lasts.
    """
    force_nn: np.ndarray
    """Force of the sample on the tip; 0 with a law, whose impacts take no time."""


class Pieces(NamedTuple):
    """Pieces of a motion in the order of time; arrays of shape (pieces,)."""

    begin_us: np.ndarray
    end_us: np.ndarray
    kind: np.ndarray
    """`FLIGHT`, `REST`, a whole `CONTACT`, or the phase of a step of one."""
    origin_us: np.ndarray
    """Time at which the tip has the state that follows: of a flight the departure, or the start."""
    x: np.ndarray
    """The gap in nm; s = sqrt(A) in the junction, the height in the lab of a whole contact."""
    rate: np.ndarray
    """Gap rate in nm/us; of a whole contact the velocity in the lab."""

    def where(self, mask: Any) -> "Pieces":
        """Return some of the pieces, chosen by a mask, by their places or as a slice."""
        return Pieces(*(column[mask] for column in self))

    def joined_by(self, others: "Pieces") -> "Pieces":
        """Return these and other pieces in the order of time."""
        whole = Pieces(*map(np.concatenate, zip(self, others, strict=True)))
        return whole.where(np.argsort(whole.begin_us, kind="stable"))

    def middle_of_longest(self) -> float:
        """Return the middle in us of the longest piece; there must be one."""
        longest = int(np.argmax(self.end_us - self.begin_us))
        return 0.5 * float(self.begin_us[longest] + self.end_us[longest])


class DensePath:
    """The tip at any time of a simulation of one scene; each contact is worked out once, when it is first asked for."""

    def __init__(self, scene: Scene, simulation: Simulation) -> None:
        """Take the scene that was simulated and its simulation.

        Raises:
            ValueError: if the simulation is a batch.
        """
        if np.ndim(simulation.count):
            raise ValueError("a trajectory is of one simulation: pick one of the batch")
        self.scene, self.simulation = scene, simulation
        self.surface, self.response = surface_of(scene)
        self.end_us = float(simulation.final.time_us)
        # the equation of motion of a resolved contact
        self.driven: Any = None
        kind, rows = REST, contacts_of(simulation)
        self.contacts = rows
        if isinstance(scene.interaction, Contact):
            self.driven, kind = driven_by(scene.interaction, scene.cantilever, self.surface), CONTACT
        begin, end = rows.arrival_time_us, np.minimum(rows.departure_time_us, self.end_us)
        arrival = (begin, rows.arrival_position_nm, rows.arrival_velocity_nm_per_us)
        contacts = Pieces(begin, end, np.full(begin.shape, kind), *arrival).where(end > begin)
        self._pieces = flights_of(scene, simulation).joined_by(contacts)

    def pieces_between(self, low: float, high: float) -> Pieces:
        """Return pieces in which there is no whole contact between two times in us: each is one of steps."""
        touched = self._pieces.kind == CONTACT
        touched &= (self._pieces.end_us >= low) & (self._pieces.begin_us <= high)
        if touched.any():
            steps = self._steps_of(self._pieces.where(touched))
            self._pieces = self._pieces.where(~touched).joined_by(steps)
        return self._pieces

    def _steps_of(self, contacts: Pieces) -> Pieces:
        """Return the steps of contacts to their ends, or to that of the simulation; each step is of one phase."""
        # few shapes, so that few programs are compiled
        lanes = power_of_two(len(contacts.x), _FEWEST)
        arrival = State(*(jnp.asarray(filled(part, lanes)) for part in contacts[3:]))
        gap, rate = to_gap(self.surface, self.response, arrival)
        place = ContactState(gap, rate, arrival.time_us, jnp.zeros(lanes))
        tip = TipInContact.arriving(self.driven, place, jnp.arange(lanes) < len(contacts.x))
        until, taken = jnp.asarray(self.end_us), [Pieces(*np.zeros((6, 0)))]
        while np.any((np.asarray(tip.phase) != ContactPhase.DRY) & (np.asarray(tip.state.time_us) < self.end_us)):
            tip, (steps, accepted) = _some_trials(self.driven, tip, until)
            taken.append(Pieces(*(np.asarray(column)[np.asarray(accepted)] for column in steps)))
        joined = Pieces(*map(np.concatenate, zip(*taken, strict=True)))
        joined = joined._replace(kind=joined.kind.astype(int))
        # a step within the rounding of its time could come to stand behind the flight after it
        return joined.where(joined.end_us - joined.begin_us > _SHORTEST_US * (1.0 + np.abs(joined.begin_us)))

    def at(self, times_us: ArrayLike) -> Trajectory:
        """Return the tip at given times in us, of any shape.

        Raises:
            ValueError: if a time lies outside the simulation.
        """
        wanted = np.asarray(times_us, float)
        first, last = float(self.simulation.start.time_us), self.end_us
        low, high = wanted.min(initial=last), wanted.max(initial=first)
        rounding = 1e-9 * (1.0 + abs(last))
        if low < first - rounding or not high <= last + rounding:
            raise ValueError(f"`times_us` must lie within the simulation, {first:.9g} to {last:.9g} us")
        # one more, so that there always is one
        pieces, times = self.pieces_between(low, high), _filled_up(np.append(wanted, last))
        piece = pieces.where(np.clip(np.searchsorted(pieces.begin_us, times, side="right") - 1, 0, None))
        flown = fly(self.scene.cantilever, self.surface, piece.x, piece.rate, piece.origin_us, times)
        gap, rate = (np.where(piece.kind == FLIGHT, np.asarray(part), 0.0) for part in flown)
        touching = piece.kind >= 0
        if touching.any():
            inside = Pieces(*(_filled_up(column[touching]) for column in piece))
            start = ContactState(*map(jnp.asarray, (inside.x, inside.rate, inside.origin_us, 0.0 * inside.x)))
            states = _states_at(self.driven, start, inside.kind, _filled_up(times[touching]))
            gap[touching], rate[touching] = (np.asarray(part)[: int(touching.sum())] for part in states)
        phase = np.select([piece.kind == kind for kind in _PHASES], list(_PHASES.values()), piece.kind)
        lab = to_lab(self.surface, self.response, times, gap, rate)
        force = np.zeros(times.shape)
        if self.driven is not None:
            force = _force(self.scene.interaction, self.driven.junction, phase, gap, rate)
        parts = (lab.position_nm, lab.velocity_nm_per_us, gap, rate, phase, force)
        return Trajectory(wanted, *(np.asarray(part)[: wanted.size].reshape(wanted.shape) for part in parts))

    def flying_at(self, time_us: float) -> State | None:
        """Return the tip in flight at a time in us, or None where it is in contact or outside the simulation."""
        if not self.simulation.start.time_us <= time_us <= self.simulation.final.time_us:
            return None
        tip = self.at(time_us)
        return State(*map(jnp.asarray, tip[:3])) if tip.phase == ContactPhase.DRY else None

    def nodes(self, from_us: float, to_us: float) -> tuple[Float[np.ndarray, " nodes"], Float[np.ndarray, " nodes"]]:
        """Return times and weights in us whose weighted sums are integrals between two times of the stretch.

        Gauss-Legendre nodes in every flight and every step of a contact, so that no phase change is crossed.
        """
        cantilever, pieces = self.scene.cantilever, self.pieces_between(from_us, to_us)
        fastest = max(float(cantilever.angular_frequency), float(self.surface.fastest_angular_frequency))
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
    return DensePath(scene, simulation).at(times_us)


def flights_of(scene: Scene, simulation: Simulation) -> Pieces:
    """Return all flights of a simulation of one scene."""
    rows = contacts_of(simulation)
    first = [np.asarray(part, float).reshape(1) for part in simulation.start]
    departures = (rows.departure_time_us, rows.departure_position_nm, rows.departure_velocity_nm_per_us)
    origin, position, velocity = map(np.concatenate, zip(first, departures, strict=True))
    flies = np.isfinite(origin)
    state = State(*(jnp.asarray(column) for column in (np.where(flies, origin, 0.0), position, velocity)))
    gap, rate = (np.asarray(column) for column in to_gap(*surface_of(scene), state))
    # a negative delay lets a flight begin before the last one has ended: the earlier one is kept to its end
    begin = np.maximum(origin, np.concatenate([first[0], rows.arrival_time_us]))
    end = np.append(rows.arrival_time_us, float(simulation.final.time_us))
    columns = (begin, end, np.full(begin.shape, FLIGHT), origin, gap, rate)
    return Pieces(*columns).where(flies & (end > begin))


@jax.jit
def fly(
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


@jax.jit
def _some_trials(
    driven: Driven, tip: TipInContact, until: Float[Array, ""]
) -> tuple[TipInContact, tuple[tuple[Array, ...], Bool[Array, "trials contacts"]]]:
    """Return tips after some trial steps, these steps as columns of `Pieces`, and which of them were accepted."""

    def once(tip, _):
        going = (tip.phase != ContactPhase.DRY) & (tip.state.time_us < until)
        after = advance(driven, tip, until, _FINENESS)
        place, begin = tip.state, tip.state.time_us
        step = (begin, after.state.time_us, tip.phase, begin, place.x, place.gap_rate)
        return where(going, after, tip), (step, going & (after.trial_length == 0.0))

    return lax.scan(once, tip, None, length=_BLOCK)


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
    solid = phase == ContactPhase.JUNCTION

    def stepped(length):
        return eighth_order_step(lambda place: driven.rates(place, solid), start, length)

    # in the junction the variable is fictitious time: its value at a time is a root
    rates = driven.rates(start, solid)

    def late(length):
        # time stands still at the fold
        end = stepped(length)
        return end.time_us - time_us, driven.rates(end, solid).time_us

    elapsed = time_us - start.time_us
    # time stands still where a dry contact begins, and grows with the square of the variable
    _, growth = jax.jvp(driven.solid.depth_slope, (start.x,), (rates.x,))
    root = jnp.sqrt(jnp.maximum(rates.time_us**2 + 2.0 * growth * elapsed, 0.0))
    first = jnp.where(solid, 2.0 * elapsed / jnp.maximum(rates.time_us + root, 1e-9), elapsed)
    end = stepped(newton_steps(late, first, _NEWTON_STEPS))
    return driven.gap(end.x, phase), end.gap_rate


def _filled_up(values: np.ndarray) -> np.ndarray:
    return filled(values, power_of_two(values.size, 64))
