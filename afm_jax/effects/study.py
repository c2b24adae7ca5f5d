"""What each effect of a scene changes and costs, and which of them a wanted accuracy does not need.

`simulate` as one compiled program for all scenes of the same effects, with what it costs.

A scene as the effects study sees it: followed from one start, read in one way, with and without an effect.
"""

import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.stages import Compiled

from afm_jax.apparatus.scene import DrivePeriod, Scene, drive_of
from afm_jax.checks import require_float64
from afm_jax.effects.scene_effects import Scaled, SceneEffect, effects_in
from afm_jax.motion.follow import Piece, follow_in_pieces, joined, joined_motions, place_after, why_over
from afm_jax.motion.observe import Reading, read_window
from afm_jax.motion.periodic import Orbit, follow_to_orbit, why_impossible
from afm_jax.motion.record import Simulation, State
from afm_jax.motion.settle import last_fifth
from afm_jax.motion.simulate import simulate
from afm_jax.motion.start import default_start
from afm_jax.motion.trajectory import dense_path

_ROWS = 1024
"""Contacts there is room for in one piece of a motion."""
_SHORTEST_REPETITION_S = 0.01
_REPETITIONS = 5


class Operations(NamedTuple):
    """How much a compiled program has to do, each of its loops counted once."""

    operations: float
    """Floating-point operations."""
    transcendentals: float
    """Those that are exponentials, logarithms, sines and the like."""


class Programs:
    """Compiled programs, one for every choice of effects; numbers can change without another compilation."""

    def __init__(self) -> None:
        """Begin without any program."""
        self._compiled: dict[Any, Compiled] = {}

    def run(self, scene: Scene, start: State, duration_us: float) -> Simulation:
        """Return a scene followed for a duration in us."""
        arguments = (scene, *_arrays(start, duration_us))
        return self._program(simulated, arguments)(*arguments)

    def run_with_tangent(
        self, scene: Scene, start: State, duration_us: float, scene_rate: Scene, start_rate: State
    ) -> tuple[Simulation, Simulation]:
        """Return a scene followed for a duration, and its derivative, to the same end, along a change of both."""
        arguments = (scene, *_arrays(start, duration_us), scene_rate, _arrays(start_rate, 0.0)[0])
        return self._program(simulated_with_tangent, arguments)(*arguments)

    def same(self, one: Scene, other: Scene) -> bool:
        """Say whether two scenes have one program: the same effects, whatever their numbers."""
        return jax.tree.structure(one) == jax.tree.structure(other)

    def operations(self, scene: Scene, start: State) -> Operations:
        """Return how much the compiled program of a scene has to do."""
        arguments = (scene, *_arrays(start, 1.0))
        counts = self._program(simulated, arguments).cost_analysis() or {}
        return Operations(float(counts.get("flops", 0.0)), float(counts.get("transcendentals", 0.0)))

    def time_us(self, scene: Scene, start: State, duration_us: float) -> float:
        """Return what following a scene takes of the process's own time, in us: the best of several runs."""
        arguments = (scene, *_arrays(start, duration_us))
        program = self._program(simulated, arguments)
        calls = 1 + int(_SHORTEST_REPETITION_S / max(_seconds(program, arguments, 1), 1e-6))
        return 1e6 * min(_seconds(program, arguments, calls) for _ in range(_REPETITIONS))

    def _program(self, function: Any, arguments: tuple[Any, ...]) -> Compiled:
        # equal where one compiled program serves both
        key = (function, jax.tree.structure(arguments), *(jnp.shape(leaf) for leaf in jax.tree.leaves(arguments)))
        if key not in self._compiled:
            self._compiled[key] = jax.jit(function).lower(*arguments).compile()
        return self._compiled[key]


def simulated(scene: Scene, start: State, duration_us: Any) -> Simulation:
    """Return a scene followed for a duration, all of it traced."""
    return simulate(scene, start, duration_us, max_contacts=_ROWS)


def simulated_with_tangent(
    scene: Scene, start: State, duration_us: Any, scene_rate: Scene, start_rate: State
) -> tuple[Simulation, Simulation]:
    """Return `simulated` and its derivative in forward mode, its end staying where it is; integers have zeros."""
    end = jnp.asarray(start.time_us) + duration_us

    def to_the_end(scene: Scene, start: State) -> Simulation:
        return simulated(scene, start, end - start.time_us)

    motion, rate = jax.jvp(to_the_end, (scene, start), (scene_rate, start_rate))
    # the tangents of integers carry no numbers
    real = jax.tree.map(
        lambda value, slope: slope if slope.dtype == value.dtype else jnp.zeros_like(value), motion, rate
    )
    return motion, real


def _arrays(start: State, duration_us: float) -> tuple[State, Any]:
    return State(*(jnp.asarray(part, float) for part in start)), jnp.asarray(duration_us, float)


def _seconds(program: Compiled, arguments: tuple[Any, ...], calls: int) -> float:
    began = time.process_time()
    for _ in range(calls):
        jax.block_until_ready(program(*arguments))
    return (time.process_time() - began) / calls


_PIECE_PERIODS = 50.0
"""Drive periods simulated at a time where nothing settles."""
_STEP = 1e-4
"""Change of strength over which a reading is differenced along the motion's derivative; its square is the error."""


class View(NamedTuple):
    """How scenes are compared: all from one start, over one duration, with one reference."""

    start: State
    duration_us: float
    drive: DrivePeriod
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
    frequency = view.drive.angular_frequency / periods_read(scene, orbit)
    return _read(scene, motion, (begin, begin + orbit.period_us), frequency)


def periods_read(scene: Scene, orbit: Orbit | None) -> int:
    """Return how many drive periods a period of what the lock-in reads has.

    Those of the orbit where the sample drives; one where base or force do, as every lock-in reads their frequency, and
    where no orbit is steady.
    """
    return 1 if orbit is None or scene.base is not None or scene.force is not None else orbit.periods


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


PERIODS_AT_MOST = 400.0
"""Drive periods after which a motion that has not settled is given up."""
_TIMED_PERIODS = 50.0


class Change(NamedTuple):
    """What changes, relative to the full scene; the phase in degrees; None: not a number."""

    peak_amplitude: float | None = None
    lockin_amplitude: float | None = None
    lockin_phase_deg: float | None = None
    energy_per_impact: float | None = None

    @property
    def of_amplitude(self) -> float | None:
        """The larger of the two amplitudes' changes, without its sign."""
        if self.peak_amplitude is None or self.lockin_amplitude is None:
            return None
        return max(abs(self.peak_amplitude), abs(self.lockin_amplitude))


class Cost(NamedTuple):
    """What following a scene costs."""

    time_us: float | None
    """Processor time of a drive period; None without a steady motion to time."""
    program: Operations


class EffectReport(NamedTuple):
    """One effect: what leaving it out changes and saves."""

    effect: SceneEffect
    change: Change
    reason: str | None
    """Why there is no change to tell: the effect is required, or nothing steady is left without it."""
    predicted: Change
    """The change to first order, by the derivative with respect to the effect's strength."""
    predicted_reason: str | None
    cost: Cost | None
    """Of the scene without it."""


class Reduction(NamedTuple):
    """What the wanted accuracy of the amplitude does not need."""

    accuracy: float
    left_out: tuple[str, ...]
    change: Change
    """Of all of them together, simulated."""
    scene: Scene
    cost: Cost


class EffectStudy(NamedTuple):
    """All effects of a scene."""

    scene: Scene
    view: View
    observed: Observed
    cost: Cost
    effects: list[EffectReport]
    reduction: Reduction | None


def study_effects(  # noqa: PLR0913
    scene: Scene,
    start: State | None = None,
    *,
    duration_us: float | None = None,
    accuracy: float | None = None,
    only: Sequence[str] | None = None,
    derivatives: bool = True,
    programs: Programs | None = None,
    report: Callable[[int, int], object] = lambda *_: None,
) -> EffectStudy:
    """Return what each effect of a scene changes and costs.

    Args:
        scene: one scene.
        start: where every motion begins, that of the scenes without an effect too; None: the scene's default.
        duration_us: how long to follow it at most; None: 400 drive periods.
        accuracy: relative accuracy of the amplitudes that is wanted; None: nothing is reduced.
        only: names of the effects to look at; None: all.
        derivatives: whether to predict changes by derivatives too, which compiles as long as two or three scenes.
        programs: compiled programs to go on with.
        report: told how many of how many scenes, with and without an effect, are done.

    Raises:
        RuntimeError: if JAX is not set to 64-bit floats, or was not when the scene was built.
        ValueError: if the scene itself has no motion to compare with, an effect of `only` is not in the scene, or the
            accuracy or the duration is not positive.
    """
    require_float64(scene)
    _check(accuracy, duration_us)
    programs = Programs() if programs is None else programs
    known = effects_in(scene)
    chosen = _chosen(known, only)
    drive = drive_of(scene)
    begin = default_start(scene) if start is None else start
    duration = PERIODS_AT_MOST * drive.period_us if duration_us is None else duration_us
    view = View(begin, duration, drive, drive.aperiodic is None)
    full = observe_scene(programs, scene, view)
    if full.reading is None and view.settles and full.reason is not None and full.reason.startswith("nothing repeats"):
        view = view._replace(settles=False)
        full = observe_scene(programs, scene, view)
    if full.reading is None:
        raise ValueError(f"the scene has no motion to compare with: {full.reason}; give it another start")
    cost = _cost(programs, full, view, None)
    reports, total = [], 1 + len(chosen) + (accuracy is not None)
    for effect in chosen:
        report(1 + len(reports), total)
        reports.append(_report(programs, full, view, effect, cost, derivatives=derivatives))
    reduction = None
    if accuracy is not None:
        report(total - 1, total)
        reduction = _reduce(programs, full, view, reports, accuracy, cost)
    return EffectStudy(scene, view, full, cost, reports, reduction)


def _check(accuracy: float | None, duration_us: float | None) -> None:
    if accuracy is not None and not 0.0 < accuracy < 1.0:
        raise ValueError(f"`accuracy` must be between 0 and 1, but is {accuracy!r}")
    if duration_us is not None and not duration_us > 0.0:
        raise ValueError(f"`duration_us` must be positive, but is {duration_us!r}")


def _chosen(known: list[SceneEffect], only: Sequence[str] | None) -> list[SceneEffect]:
    names = [effect.name for effect in known]
    for name in only or ():
        if name not in names:
            raise ValueError(f"the scene has no effect {name!r}; it has {', '.join(names) or 'none'}")
    return [effect for effect in known if only is None or effect.name in only]


def _report(
    programs: Programs, full: Observed, view: View, effect: SceneEffect, cost: Cost, *, derivatives: bool
) -> EffectReport:
    """Return what leaving one effect out changes and saves."""
    if effect.required is not None:
        return EffectReport(effect, Change(), f"required: {effect.required}", Change(), effect.required, None)
    scene = effect.without(full.scene)
    less = observe_scene(programs, scene, view)
    change, reason = _change(full, less)
    predicted, why = Change(), "not asked for"
    if derivatives:
        predicted, why = _predicted(programs, full, view, effect)
    own = None if why_impossible(scene) is not None else _cost(programs, less, view, (full.scene, cost))
    return EffectReport(effect, change, reason, predicted, why, own)


def _change(full: Observed, less: Observed) -> tuple[Change, str | None]:
    """Return what changed, and what there is to say."""
    one, other = full.reading, less.reading
    if one is None or other is None:
        return Change(), less.reason
    change = Change(
        other.peak_amplitude_nm / one.peak_amplitude_nm - 1.0,
        other.lockin_amplitude_nm / one.lockin_amplitude_nm - 1.0,
        _turn(other.lockin_phase_deg - one.lockin_phase_deg, full),
        _relative(one.energy_per_impact_aj, other.energy_per_impact_aj),
    )
    if full.orbit is None or less.orbit is None:
        return change, None
    mine, its = ((orbit.impacts, orbit.periods) for orbit in (full.orbit, less.orbit))
    if mine == its:
        return change, None
    return change._replace(lockin_phase_deg=None), f"another orbit: {its} instead of {mine} (impacts, drive periods)"


def _turn(degrees: float, full: Observed) -> float:
    """Return a change of phase; which of the N equivalent periods is locked is unknown."""
    turn = 360.0 / periods_read(full.scene, full.orbit)
    return (degrees + 0.5 * turn) % turn - 0.5 * turn


def _relative(one: float | None, other: float | None) -> float | None:
    return None if one is None or other is None or one == 0.0 else other / one - 1.0


def _predicted(programs: Programs, full: Observed, view: View, effect: SceneEffect) -> tuple[Change, str | None]:
    """Return the change to first order: the strength times 1 + s, at s = -1."""
    reading = full.reading
    assert reading is not None  # checked before anything is compared  # noqa: S101
    if effect.scaled is None:
        return Change(), "no strength is known of this force"
    if full.orbit is None and drive_of(full.scene).aperiodic is None:
        return Change(), "the motion is broadband: what it does later has no useful derivative"
    slope: Reading | None = slope_of_reading(programs, full, view, effect.scaled)
    if slope is None:
        return Change(), "the derivative is not finite"
    lost = slope.energy_per_impact_aj
    return Change(
        -slope.peak_amplitude_nm / reading.peak_amplitude_nm,
        -slope.lockin_amplitude_nm / reading.lockin_amplitude_nm,
        -slope.lockin_phase_deg,
        -lost / reading.energy_per_impact_aj if lost is not None and reading.energy_per_impact_aj else None,
    ), None


def _cost(programs: Programs, observed: Observed, view: View, like: tuple[Scene, Cost] | None) -> Cost:
    """Return what following a scene costs; one whose program is that of another costs what that costs."""
    if like is not None and programs.same(observed.scene, like[0]):
        return like[1]
    counted = programs.operations(observed.scene, view.start)
    if observed.reading is None:
        return Cost(None, counted)
    start = view.start if observed.orbit is None else observed.orbit.start
    duration = min(_TIMED_PERIODS * view.drive.period_us, view.duration_us)
    spent = programs.time_us(observed.scene, start, duration)
    return Cost(spent / (duration / view.drive.period_us), counted)


def _reduce(
    programs: Programs, full: Observed, view: View, reports: list[EffectReport], accuracy: float, cost: Cost
) -> Reduction:
    """Leave out effects from the smallest on, as long as all together change the amplitudes by less."""
    candidates = [
        (size, not report.effect.is_zero, report.effect)
        for report in reports
        if (size := report.change.of_amplitude) is not None and size < accuracy
    ]
    scene, left_out, change, best = full.scene, [], Change(0.0, 0.0, 0.0, 0.0), full
    for _, _, effect in sorted(candidates, key=lambda candidate: (candidate[1], candidate[0])):
        smaller = observe_scene(programs, effect.without(scene), view)
        joint, _ = _change(full, smaller)
        if joint.of_amplitude is not None and joint.of_amplitude < accuracy:
            scene, best, change = smaller.scene, smaller, joint
            left_out.append(effect.name)
    return Reduction(accuracy, tuple(left_out), change, scene, _cost(programs, best, view, (full.scene, cost)))
