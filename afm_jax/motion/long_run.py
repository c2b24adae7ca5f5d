"""Long simulations in pieces: until a time, or until the motion has settled; one compiled program, bounded memory.

A piece ends at a departure: the next one continues from there, so that no contact is cut in two and counted twice.
"""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from afm_jax.apparatus.scene import Scene
from afm_jax.apparatus.surface import surface_of
from afm_jax.contact.phases import Phase
from afm_jax.motion.drive_period import drive_of
from afm_jax.motion.record import ContactKind, MotionOutcome, Simulation, State
from afm_jax.motion.settled import Settled, is_stuck, settled
from afm_jax.motion.simulate import DEFAULT_ACCURACY, simulate

_PIECE_PERIODS = 256
"""Periods of the fastest motion in a piece."""
_ROOM = 1040
"""Contacts in a piece: four for every period, as `simulate` reckons."""
_HELD_LONG_ENOUGH = 12.0
"""Drive periods (and free periods) for which a tip that is held is followed, where the end is left open: reading what
it does takes longer than following it."""
_GOES_ON = (MotionOutcome.FINISHED, MotionOutcome.HELD, MotionOutcome.CONTACT_LIMIT)


class LongRun(NamedTuple):
    """A long simulation, joined; arrays of its contacts are NumPy's and have no unused rows."""

    simulation: Simulation
    verdict: Settled
    pieces: int


class _Cut(NamedTuple):
    """Where a piece is cut: how many of its contacts count, and where the next one begins."""

    contacts: int
    state: State


def follow_long(
    scene: Scene,
    start: State,
    duration_us: float,
    *,
    until_settled: bool = False,
    accuracy: float = DEFAULT_ACCURACY,
    method: str = "collocation",
    report: Callable[[float, int], None] | None = None,
) -> LongRun:
    """Return a scene followed for a duration, or until it has settled if that is earlier.

    Args:
        scene: one scene, its numbers known.
        start: the tip at the start.
        duration_us: the longest duration.
        until_settled: end with the piece in which the motion has settled, or some periods after the sample has come to
            hold the tip.
        accuracy: of `simulate`.
        method: of `simulate`.
        report: called after every piece with the time reached in us and the number of contacts so far.

    Raises:
        ValueError: as `simulate`.
    """
    surface, _ = surface_of(scene)
    fastest = max(float(scene.cantilever.angular_frequency), float(surface.fastest_angular_frequency))
    piece_us = _PIECE_PERIODS * 2.0 * math.pi / fastest
    until = float(start.time_us) + duration_us
    done: list[Any] = []
    state, stretch, pieces = start, 1.0, 0
    while True:
        left = until - float(state.time_us)
        # what is left is followed with the piece before, if it is next to nothing
        length = stretch * piece_us if left > stretch * piece_us * 1.001 else left
        room = None if stretch > 1.0 else _ROOM
        piece = simulate(scene, state, length, max_contacts=room, accuracy=accuracy, method=method)
        pieces += 1
        joined = _joined(start, [*done, _rows(piece, int(piece.count))], piece)
        last = length == left and piece.outcome != MotionOutcome.CONTACT_LIMIT
        stuck = int(piece.outcome) in _GOES_ON and is_stuck(scene, joined)
        if until_settled and stuck:
            length = min(length, _end_of_held(scene, piece) - float(state.time_us))
            rows = piece.contacts.kind.shape[0]
            piece = simulate(scene, state, length, max_contacts=rows, accuracy=accuracy, method=method)
            joined = _joined(start, [*done, _rows(piece, int(piece.count))], piece)
        if report is not None:
            report(float(piece.final.time_us), len(joined.contacts.kind))
        if last or int(piece.outcome) not in _GOES_ON:
            return LongRun(joined, settled(scene, joined), pieces)
        if until_settled:
            verdict = settled(scene, joined)
            if verdict.settled or stuck:
                return LongRun(joined, verdict, pieces)
        cut = None if stuck else _cut(piece)
        if cut is None:
            # the tip is in a contact that began with the piece, or is held: to be followed in one go
            stretch = math.ceil(left / piece_us) if stuck else 2.0 * stretch
            continue
        done.append(_rows(piece, cut.contacts))
        state, stretch = cut.state, 1.0


def _end_of_held(scene: Scene, piece: Simulation) -> float:
    """Return the time in us until which a tip that the sample holds is followed."""
    since = float(np.asarray(piece.contacts.arrival_time_us)[int(piece.count) - 1])
    free_period = 2.0 * math.pi / float(scene.cantilever.angular_frequency)
    return since + _HELD_LONG_ENOUGH * max(drive_of(scene).period_us, free_period)


def _cut(piece: Simulation) -> _Cut | None:
    """Return where to go on from: the last departure, else the end of a piece that ends in flight; None otherwise."""
    rows = piece.contacts
    left = np.flatnonzero(np.asarray(rows.kind) == ContactKind.IMPACT)
    if left.size:
        row = int(left[-1])
        place = (rows.departure_time_us, rows.departure_position_nm, rows.departure_velocity_nm_per_us)
        return _Cut(row + 1, State(*(part[row] for part in place)))
    flying = int(piece.phase) == Phase.DRY and not bool(piece.held) and piece.outcome == MotionOutcome.FINISHED
    return _Cut(int(piece.count), piece.final) if flying else None


def _rows(piece: Simulation, count: int) -> Any:
    return jax.tree.map(lambda column: np.asarray(column)[:count], piece.contacts)


def _joined(start: State, rows: list[Any], last: Simulation) -> Simulation:
    """Return the pieces as one simulation that ended as the last one did."""
    contacts = jax.tree.map(lambda *columns: np.concatenate(columns), *rows)
    return Simulation(
        start=start,
        contacts=contacts,
        count=jnp.asarray(len(contacts.kind), jnp.int32),
        final=last.final,
        phase=last.phase,
        held=last.held,
        outcome=last.outcome,
    )
