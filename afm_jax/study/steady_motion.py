"""What a scene settles to from a start: a periodic orbit to rounding, or the reason why there is none.

The motion is simulated until it nearly repeats; Newton's method on the map of one response period then ends the
transient, however slowly it decays. An orbit counts only if it is near the simulated motion, and attracts.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from afm_jax.apparatus.scene import Scene
from afm_jax.apparatus.surface import surface_of
from afm_jax.contact.contact import Contact
from afm_jax.contact.junction import explain_missing_junction, find_junction
from afm_jax.contact.phases import Phase
from afm_jax.motion.drive_period import drive_of
from afm_jax.motion.record import ContactKind, MotionOutcome, Simulation, State
from afm_jax.study.flight_reading import longest_flight_middle_us, state_at
from afm_jax.study.motion_program import Programs

PERIODS_AT_MOST = 400.0
"""Drive periods after which a motion that has not settled is given up."""
_PIECE = 50.0
_LONGEST_RESPONSE = 12
_NEAR = 0.05
"""Distance, of the tip's largest speed, within which an orbit belongs to a simulated motion."""
_CONVERGED = 1e-9
_NEWTON_STEPS = 12
_DIFFERENCE = 1e-5
_HELD_PERIODS = 20.0


class Orbit(NamedTuple):
    """A periodic motion that attracts."""

    start: State
    """In flight."""
    period_us: float
    periods: int
    """N: drive periods in a response period."""
    impacts: int
    """m: impacts in a response period."""
    contraction: float
    """By which a small distance from it shrinks in a response period."""
    monodromy: Float[np.ndarray, "2 2"]
    """Derivative of one response period's map: position in nm, velocity in nm/us."""
    motion: Simulation
    """One response period."""


class Followed(NamedTuple):
    """A scene followed from a start."""

    orbit: Orbit | None
    reason: str | None
    """Why there is no orbit."""
    last: Simulation | None
    """The last piece of the motion; None where nothing could be simulated."""


def why_impossible(scene: Scene) -> str | None:
    """Return why a scene cannot be simulated at all; None if it can."""
    try:
        surface_of(scene)
    except ValueError as error:
        return str(error)
    if isinstance(scene.interaction, Contact) and not bool(find_junction(scene.interaction).exists):
        return f"no junction forms: {explain_missing_junction(scene.interaction)}"
    return None


def settle(programs: Programs, scene: Scene, start: State, most_us: float) -> Followed:
    """Follow a scene until it settles.

    Args:
        programs: compiled programs.
        scene: one scene whose drive has one period.
        start: where the motion begins.
        most_us: how long to follow it at most, in us.
    """
    reason = why_impossible(scene)
    if reason is not None:
        return Followed(None, reason, None)
    piece = min(_PIECE * drive_of(scene).period_us, most_us)
    first, state, motion = float(start.time_us), start, None
    while float(state.time_us) - first < most_us * (1.0 - 1e-9):
        before = float(state.time_us)
        motion = programs.run(scene, state, min(piece, first + most_us - before))
        stopped, state = go_on(scene, motion)
        if state is None:
            return Followed(None, stopped, motion)
        orbit = _orbit_near(programs, scene, motion)
        if orbit is not None:
            return Followed(orbit, None, motion)
        if float(state.time_us) <= before:
            break
    return Followed(None, f"nothing repeats: no steady orbit within {most_us:.4g} us of the start", motion)


def go_on(scene: Scene, motion: Simulation) -> tuple[str, State | None]:
    """Return from where a motion goes on, outside contacts, or why it does not."""
    reason, row = where_to_go_on(scene, motion)
    return reason, None if reason else place_of(motion, row)


def where_to_go_on(scene: Scene, motion: Simulation) -> tuple[str, int | None]:
    """Return the contact after which a motion goes on, None for its end; or why it does not go on."""
    outcome = MotionOutcome(int(motion.outcome))
    if outcome not in (MotionOutcome.FINISHED, MotionOutcome.HELD, MotionOutcome.CONTACT_LIMIT):
        return outcome.sentence, None
    rows, count = motion.contacts, int(motion.count)
    if not bool(motion.held) and int(motion.phase) == Phase.DRY and outcome == MotionOutcome.FINISHED:
        return "", None
    left = np.flatnonzero(np.isin(np.asarray(rows.kind)[:count], (ContactKind.IMPACT, ContactKind.CHATTER)))
    arrival = float(rows.arrival_time_us[count - 1]) if count else float(motion.start.time_us)
    long = float(motion.final.time_us) - arrival > _HELD_PERIODS * drive_of(scene).period_us
    if not left.size or (bool(motion.held) and long):
        return f"the sample captures the tip (at {arrival:.4g} us)", None
    return "", int(left[-1])


def place_of(motion: Simulation, row: int | None) -> State:
    """Return where the tip departs after a contact, or is at the end; of a motion's derivative: how that changes."""
    rows = motion.contacts
    if row is None:
        return State(*motion.final)
    return State(rows.departure_time_us[row], rows.departure_position_nm[row], rows.departure_velocity_nm_per_us[row])


def _orbit_near(programs: Programs, scene: Scene, motion: Simulation) -> Orbit | None:
    """Return the orbit that a motion is close to, of the fewest drive periods; None without one."""
    middle = longest_flight_middle_us(scene, motion)
    state = None if middle is None else state_at(scene, motion, middle)
    if state is None:
        return None
    period = drive_of(scene).period_us
    ahead = programs.run(scene, state, (_LONGEST_RESPONSE + 0.5) * period)
    for periods in range(1, _LONGEST_RESPONSE + 1):
        after = state_at(scene, ahead, float(state.time_us) + periods * period)
        if after is not None and _distance(scene, state, after) <= _NEAR:
            orbit = _newton(programs, scene, state, periods)
            if orbit is not None:
                return orbit
    return None


def _newton(programs: Programs, scene: Scene, near: State, periods: int) -> Orbit | None:
    """Return the attracting fixed point of a response period's map near a state; None if there is none."""
    duration, state = periods * drive_of(scene).period_us, near
    for _ in range(_NEWTON_STEPS):
        motion = programs.run(scene, state, duration)
        if bool(motion.held) or int(motion.phase) != Phase.DRY or int(motion.outcome) != MotionOutcome.FINISHED:
            return None
        matrix = _monodromy(programs, scene, state, duration)
        gone = _vector(motion.final) - _vector(state)
        if _distance(scene, state, motion.final) <= _CONVERGED:
            contraction = float(np.max(np.abs(np.linalg.eigvals(matrix))))
            if not contraction < 1.0 - 1e-7 or _distance(scene, near, state) > _NEAR:
                return None
            return Orbit(state, duration, periods, int(motion.count), contraction, matrix, motion)
        try:
            step = np.linalg.solve(np.eye(2) - matrix, gone)
        except np.linalg.LinAlgError:
            return None
        position, velocity = _vector(state) + step
        state = State(state.time_us, jnp.asarray(position), jnp.asarray(velocity))
        if not _distance(scene, near, state) <= 4.0 * _NEAR:
            return None
    return None


def _monodromy(programs: Programs, scene: Scene, state: State, duration_us: float) -> Float[np.ndarray, "2 2"]:
    """Return the derivative of the map of a duration, by central differences."""
    scale = _speed(scene, state)
    steps = (_DIFFERENCE * scale / float(scene.cantilever.angular_frequency), _DIFFERENCE * scale)
    columns = []
    for axis, step in enumerate(steps):
        move = np.eye(2)[axis] * step
        ends = []
        for sign in (1.0, -1.0):
            position, velocity = _vector(state) + sign * move
            moved = State(state.time_us, jnp.asarray(position), jnp.asarray(velocity))
            ends.append(_vector(programs.run(scene, moved, duration_us).final))
        columns.append((ends[0] - ends[1]) / (2.0 * step))
    return np.stack(columns, axis=1)


def _vector(state: State) -> Float[np.ndarray, "2"]:
    return np.array([float(state.position_nm), float(state.velocity_nm_per_us)])


def _speed(scene: Scene, state: State) -> float:
    """Return the largest speed of a free vibration through a state, or what the drive makes, in nm/us."""
    position, velocity = _vector(state)
    omega = float(scene.cantilever.angular_frequency)
    return max(float(np.hypot(omega * position, velocity)), 1e-3 * omega)


def _distance(scene: Scene, one: State, other: State) -> float:
    """Return the distance of two states, of the largest speed."""
    position, velocity = _vector(other) - _vector(one)
    omega = float(scene.cantilever.angular_frequency)
    return float(np.hypot(omega * position, velocity)) / _speed(scene, one)
