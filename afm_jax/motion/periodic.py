"""The periodic motion that a scene comes to: Newton's method on the map of one response period ends its transient.

Takes a scene, a start (us, nm, nm/us) and how long to follow it in us; gives an `Orbit`, its state in these units, or
the reason why there is none. The equation is x - F(x) = 0, F the motion of one response period.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from afm_jax.apparatus.scene import Scene, drive_of
from afm_jax.apparatus.surface import surface_of
from afm_jax.contact.contact import Contact
from afm_jax.contact.junction import ContactPhase, find_junction, require_junction
from afm_jax.motion.follow import Run, follow_in_pieces, why_over
from afm_jax.motion.record import MotionOutcome, Simulation, State
from afm_jax.motion.trajectory import DensePath, flights_of
from afm_jax.solve.newton_rows import LinearisedRows, Newton, newton_rows

_ORBIT_PIECE = 50.0
"""Drive periods after which a motion is looked at: is it near an orbit?"""
_LONGEST_RESPONSE = 12
"""Drive periods."""
_NEAR = 0.05
"""Distance, of the tip's largest speed, within which an orbit belongs to a simulated motion."""
_OVERSHOOT = 4.0
_CLOSING = Newton(rounds=12, residual_tolerance=7e-10)
"""An orbit is found where height and velocity come back to within 7e-10 of the tip's largest speed, 1e-9 together."""
_DIFFERENCE = 1e-5
"""Of the tip's largest speed: between the error of a simulated period, 1e-9 of it, and the map's curvature."""
_ATTRACTS = 1.0 - 1e-7
_LAST_FLIGHTS = 12


class Orbit(NamedTuple):
    """A periodic motion that attracts."""

    start: State
    """In flight."""
    period_us: float
    periods: int
    """N: drive periods in a response period."""
    impacts: int
    """m: impacts in a response period."""
    motion: Simulation
    """One response period."""


def why_impossible(scene: Scene) -> str | None:
    """Return why a scene cannot be simulated at all; None if it can."""
    try:
        surface_of(scene)
        if isinstance(scene.interaction, Contact):
            require_junction(scene.interaction, find_junction(scene.interaction).exists)
    except ValueError as error:
        return str(error)
    return None


def follow_to_orbit(scene: Scene, start: State, most_us: float, run: Run) -> tuple[Orbit | None, str | None]:
    """Return the periodic orbit that a scene comes to, closed to rounding, or why there is none.

    An orbit counts only if it is near the simulated motion, and attracts.

    Args:
        scene: one scene whose drive has one period.
        start: where the motion begins.
        most_us: how long to follow it at most, in us.
        run: simulates a stretch of the scene's motion.
    """
    reason = why_impossible(scene)
    if reason is not None:
        return None, reason
    piece_us = min(_ORBIT_PIECE * drive_of(scene).period_us, most_us)
    for piece in follow_in_pieces(scene, start, float(start.time_us) + most_us, run, piece_us=piece_us):
        reason = why_over(piece)
        if reason is not None:
            return None, reason
        orbit = _orbit_near(scene, piece.motion, run)
        if orbit is not None:
            return orbit, None
    return None, f"nothing repeats: no steady orbit within {most_us:.4g} us of the start"


def _orbit_near(scene: Scene, motion: Simulation, run: Run) -> Orbit | None:
    """Return the orbit that a motion is close to, of the fewest drive periods; None without one."""
    flights = flights_of(scene, motion)
    if not flights.begin_us.size:
        return None
    state = DensePath(scene, motion).flying_at(flights.where(slice(-_LAST_FLIGHTS, None)).middle_of_longest())
    if state is None:
        return None
    period = drive_of(scene).period_us
    ahead = DensePath(scene, run(state, (_LONGEST_RESPONSE + 0.5) * period))
    here, omega = np.array(state, float)[:, None], float(scene.cantilever.angular_frequency)
    for periods in range(1, _LONGEST_RESPONSE + 1):
        after = ahead.flying_at(float(state.time_us) + periods * period)
        if after is not None and _apart(here, np.array(after, float)[:, None], omega)[0] <= _NEAR:
            orbit = _orbit_of(scene, here, periods, run)
            if orbit is not None:
                return orbit
    return None


def _orbit_of(scene: Scene, near: np.ndarray, periods: int, run: Run) -> Orbit | None:
    """Return the attracting orbit of a number of drive periods near a state; None if there is none."""
    duration = periods * drive_of(scene).period_us

    def at(start: np.ndarray) -> Simulation:
        return run(State(*map(jnp.asarray, start)), duration)

    def ends(starts: np.ndarray, _: np.ndarray) -> np.ndarray:
        return np.stack([ends_in_flight(at(start)) for start in starts.T], axis=1)

    omega = float(scene.cantilever.angular_frequency)
    found = close_periods(ends, near, np.zeros(1, int), angular_frequency=omega, reach=_NEAR)
    if not (found.closed[0] and found.contraction[0] < _ATTRACTS):
        return None
    motion = at(found.starts[:, 0])
    return Orbit(motion.start, duration, periods, int(motion.count), motion)


def ends_in_flight(motion: Simulation) -> np.ndarray:
    """Return position and velocity at the end of a motion, a column each of a batch; NaN if not in flight then."""
    free = (np.asarray(motion.outcome) == MotionOutcome.FINISHED) & (np.asarray(motion.phase) == ContactPhase.DRY)
    return np.where(free, np.stack([motion.final.position_nm, motion.final.velocity_nm_per_us]), np.nan)


class ClosedPeriods(NamedTuple):
    """Where a search for periodic motions ended, one entry a row."""

    starts: Float[np.ndarray, "3 rows"]
    """Time, position and velocity."""
    closed: Bool[np.ndarray, " rows"]
    """Whether the motion comes back to its start."""
    contraction: Float[np.ndarray, " rows"]
    """Largest modulus of the multipliers of the linearised map; infinite where it is not known."""


def close_periods(
    ends: Callable[[Float[np.ndarray, "3 n"], Int[np.ndarray, " n"]], Float[np.ndarray, "2 n"]],
    starts: Float[np.ndarray, "3 rows"],
    rows: Int[np.ndarray, " rows"],
    *,
    angular_frequency: float,
    reach: float = math.inf,
) -> ClosedPeriods:
    """Return starts whose motion comes back to them.

    Newton's method on x - F(x) = 0, x = (z, v), with the slopes of F by central differences.

    Args:
        ends: F: of starts and the numbers of their scenes, position and velocity one response period later; NaN where
            there is none.
        starts: first guesses: time in us, position in nm and velocity in nm/us.
        rows: the numbers of their scenes.
        angular_frequency: of the free tip in rad/us; turns lengths into velocities.
        reach: how far from its first guess a start may end, of the tip's largest speed; on the way four times as far.
    """

    def linearised(states: Float[np.ndarray, "open 2"], lanes: Int[np.ndarray, " open"]) -> LinearisedRows:
        trials = np.concatenate([starts[:1, lanes], states.T])
        gap, slopes = np.full_like(states, np.nan), np.full((len(lanes), 2, 2), np.nan)
        near = _apart(starts[:, lanes], trials, angular_frequency) <= _OVERSHOOT * reach
        if near.any():
            gap[near], slopes[near] = _map_of(ends, trials[:, near], rows[lanes[near]], angular_frequency)
        size = (_speed(trials, angular_frequency) / np.array([[angular_frequency], [1.0]])).T
        return LinearisedRows(gap / size, (slopes - np.eye(2)) / size[:, :, None], list(slopes))

    roots = newton_rows(linearised, starts[1:].T, _CLOSING)
    slopes = np.array([np.full((2, 2), np.nan) if slope is None else slope for slope in roots.details])
    finite = np.isfinite(slopes).all(axis=(1, 2))
    contraction = np.full(len(rows), np.inf)
    contraction[finite] = np.abs(np.linalg.eigvals(slopes[finite])).max(axis=1)
    ending = np.concatenate([starts[:1], roots.x.T])
    closed = roots.converged & (_apart(starts, ending, angular_frequency) <= reach)
    return ClosedPeriods(ending, closed, contraction)


def _map_of(
    ends: Callable[..., np.ndarray], starts: Float[np.ndarray, "3 n"], rows: Int[np.ndarray, " n"], omega: float
) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "n 2 2"]]:
    """Return by how much position and velocity change in a period, and the slopes of where they end."""
    steps = _DIFFERENCE * _speed(starts, omega) * np.array([[1.0 / omega], [1.0]])
    moves = np.concatenate([np.zeros((1, 2)), np.eye(2), -np.eye(2)])
    # trials[:, k]: the starts, and then moved
    trials = np.stack(
        [starts + np.concatenate([np.zeros(starts[:1].shape), move[:, None] * steps]) for move in moves], 1
    )
    after = ends(trials.reshape(3, -1), np.tile(rows, len(moves))).reshape(2, len(moves), -1)
    jacobian = (after[:, 1:3] - after[:, 3:]) / (2.0 * steps)
    return (after[:, 0] - starts[1:]).T, np.moveaxis(jacobian, -1, 0)


def _speed(starts: Float[np.ndarray, "3 n"], omega: float) -> Float[np.ndarray, " n"]:
    """Return the largest speeds in nm/us of free vibrations through states; 1e-3 nm of amplitude at least."""
    return np.maximum(np.hypot(omega * starts[1], starts[2]), 1e-3 * omega)


def _apart(one: Float[np.ndarray, "3 n"], other: Float[np.ndarray, "3 n"], omega: float) -> Float[np.ndarray, " n"]:
    """Return the distances of states, of the largest speed of the first."""
    _, position, velocity = other - one
    return np.hypot(omega * position, velocity) / _speed(one, omega)
