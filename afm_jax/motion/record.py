"""What a simulation hands out: its contacts in order, its last state, and how it ended.

Takes and gives times in us, gaps and heights in nm, velocities in nm/us, energies in aJ.

A tip on its way, of a law or through resolved contacts, is a `FollowedTip`: its contacts are written down there, round
by round of one loop (`follow_rounds`).

States of the tip are heights and velocities in the lab; `to_gap` and `to_lab` go between these and the gap over the
surface that the free tip sees (`surface_of`), `contacts_in_lab` does so for contacts.
"""

import enum
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple, Self

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from afm_jax.apparatus.platform import Platform
from afm_jax.apparatus.surface import Surface
from afm_jax.outcomes import OutcomeInWords
from afm_jax.results import Result, ResultTuple, public_result


class MotionOutcome(OutcomeInWords):
    """How a simulation ended; the `sentence` of a member says what happened and what to do."""

    FINISHED = 0, "The motion was followed to the end of its duration."
    HELD = 1, "The motion was followed to the end of its duration; the sample holds the tip there."
    CONTACT_LIMIT = 2, "The motion has more contacts than there is room for: raise max_contacts."
    STEP_LIMIT = 3, "The motion took more steps than it was given (max_rounds), or a search did not end."
    INVALID_START = 4, "The start is not finite, or inside the sample."
    NO_JUNCTION = 5, "With these parameters no junction forms: force and stiffness are equal nowhere."
    UNRESOLVED = 6, "A step left the range of the forces, or a law's delay put the tip inside the sample."


class ContactKind(enum.IntEnum):
    """What happened between one arrival at the sample and the departure that follows."""

    NONE = 0
    """The row is not used."""
    IMPACT = 1
    """The tip came and left."""
    CHATTER = 2
    """Infinitely many impacts in finite time (r < 1), then rest on the platform until it let the tip go."""
    HELD = 3
    """The tip was still held, or within its contact, when the simulation ended; there is no departure."""


@public_result()
class State(ResultTuple):
    """The tip's time in us, height above its rest position in nm and velocity upward in nm/us, all in the lab frame."""

    time_us: Float[Array, "..."]
    position_nm: Float[Array, "..."]
    velocity_nm_per_us: Float[Array, "..."]

    if TYPE_CHECKING:  # plain numbers are arrays enough

        def __new__(cls, time_us: ArrayLike, position_nm: ArrayLike, velocity_nm_per_us: ArrayLike) -> Self: ...  # noqa: D102

        def __init__(self, time_us: ArrayLike, position_nm: ArrayLike, velocity_nm_per_us: ArrayLike) -> None: ...  # noqa: D107


class ContactDetail(NamedTuple):
    """What only a resolved contact has; arrays of one row a contact."""

    junctions: Int[Array, "..."]
    """How often the junction formed."""
    junction_forms_us: Float[Array, "..."]
    """When it first formed; 0 where it did not."""
    junction_breaks_us: Float[Array, "..."]
    """When it last broke; 0 where it did not."""
    time_in_junction_us: Float[Array, "..."]
    deepest_gap_nm: Float[Array, "..."]
    """Smallest gap, negative where the tip indents the sample."""
    peak_force_nn: Float[Array, "..."]
    """Largest repulsive force, at the smallest gap."""
    bridge_hysteresis_aj: Float[Array, "..."]
    junction_hysteresis_aj: Float[Array, "..."]
    viscous_loss_aj: Float[Array, "..."]


class Contacts(NamedTuple):
    """Contacts in order; arrays with a trailing axis of rows, unused rows 0 with kind `ContactKind.NONE`.

    With a law a contact is an impact: it begins where the free flight meets the platform and ends where the next
    flight starts, the collision delay later. A resolved contact begins where the bridge forms and ends where it breaks.
    """

    kind: Int[Array, "..."]
    arrival_time_us: Float[Array, "..."]
    arrival_position_nm: Float[Array, "..."]
    arrival_velocity_nm_per_us: Float[Array, "..."]
    approach_speed_nm_per_us: Float[Array, "..."]
    """Relative to the platform."""
    departure_time_us: Float[Array, "..."]
    """Infinite where the tip is held to the end."""
    departure_position_nm: Float[Array, "..."]
    departure_velocity_nm_per_us: Float[Array, "..."]
    rebound_speed_nm_per_us: Float[Array, "..."]
    """Relative to the platform."""
    energy_lost_aj: Float[Array, "..."]
    """What the contact dissipated."""
    detail: ContactDetail | None = None


@public_result(outcome=MotionOutcome)
class Simulation(Result, eqx.Module):
    """A scene followed in time by `simulate`: where it started, its contacts in order, its last state and its outcome.

    Under `vmap` every array has the batch as first axis.
    """

    start: State
    contacts: Contacts
    count: Int[Array, "..."]
    """Number of contacts, the unfinished one of a held tip included."""
    final: State
    phase: Int[Array, "..."]
    """What is between tip and sample at the end, a `ContactPhase` (laws: JUNCTION where the platform holds the tip)."""
    outcome: Int[Array, "..."]
    """How the simulation ended, the number of a `MotionOutcome`."""

    @property
    def held(self) -> Bool[Array, "..."]:
        """Whether the tip is held at the end."""
        return self.outcome == MotionOutcome.HELD

    @property
    def broke_off(self) -> str | None:
        """Why one simulation was not followed to its end; None where it was."""
        outcome = MotionOutcome(int(self.outcome))
        return None if outcome in (MotionOutcome.FINISHED, MotionOutcome.HELD) else outcome.sentence

    def _known_rows(self) -> np.ndarray:
        """Return which rows are contacts."""
        return np.asarray(self.contacts.kind) != ContactKind.NONE

    def _unknown(self) -> dict[str, np.ndarray]:
        """Return by column which contacts have no value there: one that holds the tip to the end has no departure."""
        held = np.asarray(self.contacts.kind) == ContactKind.HELD
        unknown = {f"contacts_{name}": held for name in Contacts._fields if name.startswith(("departure_", "rebound_"))}
        if self.contacts.detail is not None:
            dry = np.asarray(self.contacts.detail.junctions) == 0
            unknown |= {f"contacts_detail_junction_{name}_us": dry for name in ("forms", "breaks")}
        return unknown


def contacts_of(simulation: Simulation) -> Any:
    """Return the `Contacts` of one simulation without unused rows, as arrays of NumPy's."""
    return jax.tree.map(lambda column: np.asarray(column)[: int(simulation.count)], simulation.contacts)


def contacts_left(simulation: Simulation) -> Any:
    """Return the `Contacts` of one simulation that the tip left, as arrays of NumPy's."""
    rows = contacts_of(simulation)
    return jax.tree.map(lambda column: column[rows.kind != ContactKind.HELD], rows)


def with_response(response: Surface | None, state: State, sign: float = 1.0) -> State:
    """Return a state with the steady response to drives of base and tip added to it, or with a sign of -1 taken off."""
    if response is None:
        return state
    steady, rate = response.position_and_velocity(state.time_us)
    return State(state.time_us, state.position_nm + sign * steady, state.velocity_nm_per_us + sign * rate)


@jax.jit
def to_gap(
    surface: Platform | Surface, response: Surface | None, state: State
) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
    """Return gap in nm and gap rate in nm/us of a state in the lab; arrays of any shape."""
    height, speed = surface.position_and_velocity(state.time_us)
    _, position, velocity = with_response(response, state, -1.0)
    return position - height, velocity - speed


@jax.jit
def to_lab(
    surface: Platform | Surface, response: Surface | None, time_us: ArrayLike, gap_nm: ArrayLike, gap_rate: ArrayLike
) -> State:
    """Return the state in the lab of a gap in nm and its rate in nm/us; arrays of any shape."""
    height, speed = surface.position_and_velocity(time_us)
    free = State(jnp.asarray(time_us), jnp.asarray(gap_nm) + height, jnp.asarray(gap_rate) + speed)
    return with_response(response, free)


def contacts_in_lab(
    surface: Platform | Surface,
    response: Surface | None,
    kind: ArrayLike,
    arrival: State,
    departure: State,
    energy_lost_aj: Float[Array, "..."],
    detail: ContactDetail | None = None,
) -> Contacts:
    """Return contacts in the lab, from gaps and gap rates; arrays of any shape.

    Args:
        surface: what the free tip sees (`surface_of`).
        response: the steady response to drives of base and tip, or None.
        kind: numbers of `ContactKind`.
        arrival: time, gap and gap rate at the beginnings.
        departure: time, gap and gap rate at the ends; anything where the tip is held.
        energy_lost_aj: what each dissipated.
        detail: of resolved contacts.
    """
    kind = jnp.asarray(kind, jnp.int32)
    used = kind != ContactKind.NONE
    has_left = used & (kind != ContactKind.HELD)
    came = to_lab(surface, response, *arrival)
    went = to_lab(surface, response, jnp.where(has_left, departure.time_us, 0.0), *departure[1:])
    approach = jnp.maximum(-arrival.velocity_nm_per_us, 0.0)  # of a tip that rests, rounding
    return Contacts(
        kind=kind,
        arrival_time_us=arrival.time_us,
        arrival_position_nm=jnp.where(used, came.position_nm, 0.0),
        arrival_velocity_nm_per_us=jnp.where(used, came.velocity_nm_per_us, 0.0),
        approach_speed_nm_per_us=jnp.where(used, approach, 0.0),
        departure_time_us=jnp.where(kind == ContactKind.HELD, jnp.inf, departure.time_us),
        departure_position_nm=jnp.where(has_left, went.position_nm, 0.0),
        departure_velocity_nm_per_us=jnp.where(has_left, went.velocity_nm_per_us, 0.0),
        rebound_speed_nm_per_us=jnp.where(has_left, departure.velocity_nm_per_us, 0.0),
        energy_lost_aj=energy_lost_aj,
        detail=detail,
    )


_EACH = 8
"""Rounds between two checks whether all tips of a batch have arrived at the end."""


class FollowedTip(NamedTuple):
    """A tip that is followed, and its contacts so far; scalars of one tip, but for the rows."""

    tip: Any
    """Where the next round begins: a tree of scalars."""
    rows: Float[Array, "rows columns"]
    contacts: Int[Array, ""]
    """Rows that are filled."""
    outcome: Int[Array, ""]
    """A `MotionOutcome`."""
    done: Bool[Array, ""]

    @classmethod
    def begun(cls, tip: Any, row: Any, outcome: Array, *, rows: int) -> "FollowedTip":
        """Return a tip at its start, with room for so many rows like a given one; a start with a fault is an end."""
        columns, none = as_vector(row)[0], jnp.zeros((), jnp.int32)
        empty = jnp.zeros((rows, *columns.shape), columns.dtype)
        return cls(tip, empty, none, outcome, outcome != MotionOutcome.FINISHED)

    def after(self, tip: Any, row: Any, ends: Array, outcome: Array, over: Array) -> "FollowedTip":
        """Return the course a round later; it ends as it was before a contact that has no room.

        Args:
            tip: where the next round begins.
            row: of the contact that the round ends.
            ends: whether it ends one.
            outcome: of the motion, if it is over.
            over: whether it is.
        """
        room = self.rows.shape[0]
        full = ends & (self.contacts >= room)
        outcome = jnp.where(full, MotionOutcome.CONTACT_LIMIT, outcome)
        place = jnp.where(ends, self.contacts, room)
        return FollowedTip(
            tip=where(full, self.tip, tip),
            rows=self.rows.at[place].set(as_vector(row)[0], mode="drop"),
            contacts=jnp.where(ends & ~full, self.contacts + 1, self.contacts),
            outcome=jnp.where(self.done, self.outcome, outcome).astype(jnp.int32),
            done=self.done | over | full,
        )


def follow_rounds(one_round: Callable[..., Any], course: FollowedTip, *, rounds: int, reverse: bool) -> FollowedTip:
    """Return a course after so many rounds, or as soon as it is done; in a batch all courses.

    Args:
        one_round: what a round makes of a course; one that is done stays as it is.
        course: at the start.
        rounds: at most, filled up to blocks of eight.
        reverse: make it differentiable in reverse mode: all rounds are run, in blocks that are recomputed backwards.
    """
    blocks = -(-rounds // _EACH)

    def block(course, _=None):
        return lax.scan(lambda state, _: (one_round(state), None), course, length=_EACH)

    if reverse:
        course, _ = lax.scan(jax.checkpoint(block), course, length=blocks)
    else:
        _, course = lax.while_loop(
            lambda state: ~state[1].done & (state[0] < blocks),
            lambda state: (state[0] + 1, block(state[1])[0]),
            (0, course),
        )
    outcome = jnp.where(course.done, course.outcome, MotionOutcome.STEP_LIMIT)
    return course._replace(outcome=outcome.astype(jnp.int32))


def where(condition: Array, new: Any, old: Any) -> Any:
    """Return a tree with the leaves of one where a condition holds, else those of another."""
    return jax.tree.map(partial(jnp.where, condition), new, old)


def as_vector(row: Any) -> tuple[Array, Any]:
    """Return a row, a tree of scalars, as one vector of floats, and the function that makes a row of it again."""
    return ravel_pytree(jax.tree.map(lambda part: part.astype(float), row))
