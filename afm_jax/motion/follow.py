"""Long motions, followed piece by piece until they are over, have settled, or are enough.

Takes a scene, a start (us, nm, nm/us) and a duration in us; gives the joined `Simulation` and whether it has settled.
Equations: those of `simulate`, which follows each piece.

A piece ends at a departure, and the next one continues from there, so that no contact is cut in two and counted twice.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from afm_jax.apparatus.scene import Scene
from afm_jax.apparatus.surface import surface_of
from afm_jax.contact.junction import ContactPhase
from afm_jax.motion.record import ContactKind, MotionOutcome, Simulation, State, contacts_of
from afm_jax.motion.settle import Settled, held_since, is_stuck, settled, slower_period_us
from afm_jax.motion.simulate import DEFAULT_ACCURACY, simulate

_PIECE_PERIODS = 256
"""Periods of the fastest motion in a piece."""
_ROOM = 1040
"""Contacts in a piece: four for every period, as `simulate` reckons."""
_LITTLE = 1.001
"""A remainder next to nothing is followed with the piece before it."""
_HELD_LONG_ENOUGH = 12.0
"""Drive periods (and free periods) for which a tip that is held is followed, where the end is left open: reading what
it does takes longer than following it."""

Run = Callable[[State, float], Simulation]
"""Of a start and a duration in us: the motion of one scene."""


class Piece(NamedTuple):
    """A stretch of a motion, simulated at once."""

    motion: Simulation
    length_us: float
    contacts: int
    """Number of its contacts up to where the next piece begins."""
    goes_on_from: State | None
    """Where the next piece begins; None where the motion is over, or in a contact that began with the piece."""
    stuck: bool
    """Whether the sample holds the tip at the end (`is_stuck`)."""


class LongRun(NamedTuple):
    """A long simulation, joined; arrays of its contacts are NumPy's and have no unused rows."""

    simulation: Simulation
    verdict: Settled
    pieces: int


def follow_in_pieces(
    scene: Scene, start: State, until_us: float, run: Run, *, piece_us: float = math.inf
) -> Iterator[Piece]:
    """Follow a scene piece by piece to a time, or until it breaks off; give every piece once it is done.

    A piece from which the motion cannot go on, the tip being in a contact that began with it, is done again, twice as
    long; in one go to the end where the sample holds the tip. Whoever has seen enough asks for no more.

    Args:
        scene: one scene, its numbers known.
        start: the tip at the start.
        until_us: the end.
        run: simulates a stretch of the scene's motion.
        piece_us: how long a piece is; ends where there is no more room for contacts, too.
    """
    state, stretch = start, 1.0
    while True:
        to_end = until_us - float(state.time_us)
        length = stretch * piece_us if to_end > stretch * piece_us * _LITTLE else to_end
        motion = run(state, length)
        full, stuck = bool(motion.outcome == MotionOutcome.CONTACT_LIMIT), is_stuck(scene, motion)
        departures = np.flatnonzero(np.asarray(motion.contacts.kind) == ContactKind.IMPACT)
        onward, contacts = None, int(motion.count)
        if departures.size and not stuck and (full or motion.broke_off is None):
            onward, contacts = state_after(motion, int(departures[-1])), int(departures[-1]) + 1
        elif motion.outcome == MotionOutcome.FINISHED and motion.phase == ContactPhase.DRY:
            onward = motion.final
        yield Piece(motion, length, contacts, onward, stuck)
        if not (full or motion.broke_off is None) or (length == to_end and not (full and onward)):
            return
        if onward is not None:
            state, stretch = onward, 1.0
        else:
            stretch = math.ceil(to_end / piece_us) if stuck else 2.0 * stretch


def state_after(motion: Simulation, row: int) -> State:
    """Return the tip at its departure from a contact, given its row."""
    rows = motion.contacts
    return State(rows.departure_time_us[row], rows.departure_position_nm[row], rows.departure_velocity_nm_per_us[row])


def joined(pieces: Sequence[Piece]) -> Simulation:
    """Return pieces that follow each other as one simulation that ended as the last one did; arrays of NumPy's."""
    *before, last = pieces
    parts = [jax.tree.map(lambda column, n=part.contacts: column[:n], contacts_of(part.motion)) for part in before]
    rows = jax.tree.map(lambda *columns: np.concatenate(columns), *parts, contacts_of(last.motion))
    count = jnp.asarray(len(rows.kind), jnp.int32)
    return replace(last.motion, start=pieces[0].motion.start, contacts=rows, count=count)


def why_over(piece: Piece) -> str | None:
    """Return why a motion does not go on after a piece; None where it does, or could have."""
    if piece.stuck:
        return f"the sample captures the tip (at {held_since(piece.motion):.4g} us)"
    full = piece.motion.outcome == MotionOutcome.CONTACT_LIMIT
    return None if full else piece.motion.broke_off


def follow_long(
    scene: Scene,
    start: State,
    duration_us: float,
    *,
    until_settled: bool = False,
    enough: Callable[[Simulation], bool] = lambda _: False,
    accuracy: float = DEFAULT_ACCURACY,
    report: Callable[[float, int], None] | None = None,
) -> LongRun:
    """Return a scene followed for a duration, or until it has settled or is enough if that is earlier.

    Args:
        scene: one scene, its numbers known.
        start: the tip at the start.
        duration_us: the longest duration.
        until_settled: end with the piece in which the motion has settled, or some periods after the sample has come to
            hold the tip.
        enough: asked after every piece of the motion so far: whether to stop.
        accuracy: of `simulate`.
        report: called after every piece with the time reached in us and the number of contacts so far.

    Raises:
        ValueError: as `simulate`.
    """
    surface, _ = surface_of(scene)
    fastest = max(float(scene.cantilever.angular_frequency), float(surface.fastest_angular_frequency))
    piece_us = _PIECE_PERIODS * 2.0 * math.pi / fastest

    def run(state: State, length_us: float) -> Simulation:
        room = _ROOM if length_us <= piece_us * _LITTLE else None
        return simulate(scene, state, length_us, max_contacts=room, accuracy=accuracy)

    count, pieces, whole = 0, [], None
    for piece in follow_in_pieces(scene, start, float(start.time_us) + duration_us, run, piece_us=piece_us):
        if until_settled and piece.stuck:
            piece = _shortened(scene, piece, run)  # noqa: PLW2901
        count, pieces = count + 1, [*(done for done in pieces if done.goes_on_from), piece]
        whole = joined(pieces)
        if report is not None:
            report(float(whole.final.time_us), len(whole.contacts.kind))
        if enough(whole) or (until_settled and (piece.stuck or settled(scene, whole).settled)):
            break
    assert whole is not None  # there is one piece at least  # noqa: S101
    return LongRun(whole, settled(scene, whole), count)


def _shortened(scene: Scene, piece: Piece, run: Run) -> Piece:
    """Return a piece at whose end the sample holds the tip, followed no longer than shows what the tip does."""
    start, motion = piece.motion.start, piece.motion
    end_us = held_since(motion) + _HELD_LONG_ENOUGH * slower_period_us(scene)
    return piece._replace(motion=run(start, min(piece.length_us, end_us - float(start.time_us))))
