"""A scene as the effects study sees it: followed from one start, read in one way, with and without an effect."""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from afm_jax.apparatus.scene import Scene
from afm_jax.motion.drive_period import Drive, drive_of
from afm_jax.motion.observe import Reading, read_window
from afm_jax.motion.record import Simulation, State
from afm_jax.motion.settle import (
    Orbit,
    Piece,
    follow_in_pieces,
    follow_to_orbit,
    joined,
    joined_motions,
    last_fifth,
    place_after,
    why_impossible,
    why_over,
)
from afm_jax.motion.trajectory import dense_path
from afm_jax.study.motion_program import Programs
from afm_jax.study.scene_effects import Scaled

_PIECE_PERIODS = 50.0
"""Drive periods simulated at a time where nothing settles."""
_STEP = 1e-4
"""Change of strength over which a reading is differenced along the motion's derivative; its square is the error."""


class View(NamedTuple):
    """How scenes are compared: all from one start, over one duration, with one reference."""

    start: State
    duration_us: float
    drive: Drive
    settles: bool
    """Whether steady orbits are compared, else the last fifth of the duration."""

    @property
    def window(self) -> tuple[float, float]:
        """Beginning and end, in us, of what is compared where nothing settles."""
        first = float(self.start.time_us)
        found = last_fifth(first, first + self.duration_us, self.drive)
        return found.from_us, found.to_us


class Observed(NamedTuple):
    """What a scene shows; without a reading the reason says why."""

    scene: Scene
    reading: Reading | None
    reason: str | None
    orbit: Orbit | None
    begin_us: float
    """Where the motion that was read begins."""
    pieces: tuple[Piece, ...] = ()
    """The motion that was read, where nothing settles."""


def observe_scene(programs: Programs, scene: Scene, view: View) -> Observed:
    """Return what a scene shows in a view."""
    if not view.settles:
        return _observe_last_fifth(programs, scene, view)
    own = drive_of(scene)
    if own.aperiodic is not None:
        return Observed(scene, None, own.aperiodic, None, 0.0)
    orbit, reason = follow_to_orbit(scene, view.start, view.duration_us, partial(programs.run, scene))
    if orbit is None:
        return Observed(scene, None, reason, None, float(view.start.time_us))
    return Observed(scene, _read_orbit(scene, orbit.motion, orbit, view), None, orbit, float(orbit.start.time_us))


def _observe_last_fifth(programs: Programs, scene: Scene, view: View) -> Observed:
    """Return what a scene shows at the end of the view's duration."""
    first = float(view.start.time_us)
    reason, pieces, run = why_impossible(scene), [], partial(programs.run, scene)
    if reason is None:
        piece_us = _PIECE_PERIODS * drive_of(scene).period_us
        for piece in follow_in_pieces(scene, view.start, first + view.duration_us, run, piece_us=piece_us):
            reason = why_over(piece)
            if reason is not None:
                break
            pieces = [*(done for done in pieces if done.goes_on), piece]
    if reason is not None:
        return Observed(scene, None, reason, None, first)
    reading = _read_window(scene, joined(pieces), view)
    return Observed(scene, reading, None, None, view.window[0], tuple(pieces))


def _read_window(scene: Scene, motion: Simulation, view: View) -> Reading:
    return _read(scene, motion, view.window, view.drive.angular_frequency)


def _read_orbit(scene: Scene, motion: Simulation, orbit: Orbit, view: View) -> Reading:
    """Return the reading of one response period; the window stays where it is while the scene changes."""
    begin = float(orbit.start.time_us)
    frequency = view.drive.angular_frequency / orbit.periods
    return _read(scene, motion, (begin, begin + orbit.period_us), frequency)


def _read(scene: Scene, motion: Simulation, window: tuple[float, float], angular_frequency: float) -> Reading:
    """Return a reading; contacts, short against the period, are not integrated once more for every scene."""
    dense = dense_path(scene, motion, *window, integrated=False)
    return read_window(dense, *window, angular_frequency=angular_frequency)


def slope_of_reading(programs: Programs, observed: Observed, view: View, scaled: Scaled) -> Reading | None:
    """Return the derivative of a reading with respect to s, where an effect's strength is times 1 + s.

    The motion's derivative comes from forward differentiation of `simulate`: of a steady orbit of one response period,
    with the derivative of its fixed point by the implicit function theorem, (I - M) dx = dF.

    Args:
        programs: compiled programs.
        observed: the scene, with a reading.
        view: how it was observed.
        scaled: the scene with the effect's strength times 1 + s.

    Returns:
        A `Reading` of derivatives; None where the derivative does not exist as a number.
    """
    scene, orbit = observed.scene, observed.orbit
    _, rate = jax.jvp(lambda s: scaled(scene, s), (jnp.zeros(()),), (jnp.ones(()),))
    still = State(*(jnp.zeros(()) for _ in range(3)))
    if orbit is None:
        motion, change = _with_tangent(programs, observed, rate, still)

        def read(scene: Scene, motion: Simulation) -> Reading:
            return _read_window(scene, motion, view)
    else:
        _, direct = programs.run_with_tangent(scene, orbit.start, orbit.period_us, rate, still)
        push = np.array([float(direct.final.position_nm), float(direct.final.velocity_nm_per_us)])
        move = np.linalg.solve(np.eye(2) - orbit.monodromy, push)
        along = State(jnp.zeros(()), jnp.asarray(move[0]), jnp.asarray(move[1]))
        motion, change = programs.run_with_tangent(scene, orbit.start, orbit.period_us, rate, along)

        def read(scene: Scene, motion: Simulation) -> Reading:
            return _read_orbit(scene, motion, orbit, view)

    ends = [read(_moved(scene, rate, step), _moved(motion, change, step)) for step in (_STEP, -_STEP)]
    slopes = [_slope(more, less) for more, less in zip(ends[0][:4], ends[1][:4], strict=True)]
    turned = (ends[0].lockin_phase_deg - ends[1].lockin_phase_deg + 180.0) % 360.0 - 180.0
    slope = Reading(*slopes, impacts=0)._replace(lockin_phase_deg=turned / (2.0 * _STEP))
    finite = all(np.isfinite(part) for part in slope[:3])
    return slope if finite else None


def _with_tangent(programs: Programs, observed: Observed, rate: Scene, slope: State) -> tuple[Simulation, Simulation]:
    """Return the motion of a scene, followed once more piece by piece, and its derivative along a change."""
    motions, changes = [], []
    for piece in observed.pieces:
        motion, change = programs.run_with_tangent(observed.scene, piece.motion.start, piece.length_us, rate, slope)
        slope = place_after(change, piece.row)
        motions.append(motion)
        changes.append(change)
    counts = [*(piece.contacts for piece in observed.pieces[:-1]), int(motions[-1].count)]
    return joined_motions(motions, counts), joined_motions(changes, counts)


def _slope(more: float | None, less: float | None) -> Any:
    return None if more is None or less is None else (more - less) / (2.0 * _STEP)


def _moved(tree: Any, rate: Any, step: float) -> Any:
    """Return a tree moved along its derivative; what is infinite or an integer stays."""

    def move(value: Any, slope: Any) -> Any:
        if not jnp.issubdtype(value.dtype, jnp.floating):
            return value
        return jnp.where(jnp.isfinite(slope) & jnp.isfinite(value), value + step * slope, value)

    return jax.tree.map(move, tree, rate)
