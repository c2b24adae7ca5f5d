"""What each effect of a scene changes and costs, and which effects a wanted accuracy does not need.

An effect is left out: it is absent from the compiled program, not multiplied by zero. The scene without it is followed
from the same start, and its steady orbit (where nothing repeats, the last fifth of the duration) is read as that of the
full scene is. What the two readings differ by is what the effect changes; what the programs' times differ by is what
it costs.
"""

import statistics
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
from afm_jax.compilation_cache import quick_options
from afm_jax.effects.scene_effects import SceneEffect, effects_in
from afm_jax.motion.follow import follow_in_pieces, joined, why_over
from afm_jax.motion.observe import MotionWindow
from afm_jax.motion.periodic import Orbit, follow_to_orbit, why_impossible
from afm_jax.motion.record import Simulation, State
from afm_jax.motion.settle import last_fifth
from afm_jax.motion.simulate import simulate
from afm_jax.motion.start import default_start
from afm_jax.motion.trajectory import dense_path
from afm_jax.units import within_turn

PERIODS_AT_MOST = 400.0
"""Drive periods after which a motion that has not settled is given up."""
_PIECE_PERIODS = 50.0
"""Drive periods simulated at a time where nothing settles."""
_TIMED_PERIODS = 50.0
_SHORTEST_REPETITION_S = 0.01
_REPETITIONS = 5
_ROWS = 1024
"""Contacts there is room for in one piece of a motion."""


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


class Operations(NamedTuple):
    """How much a compiled program has to do, each of its loops counted once."""

    operations: float
    """Floating-point operations."""
    transcendentals: float
    """Those that are exponentials, logarithms, sines and the like."""


class Cost(NamedTuple):
    """What following a scene costs."""

    time_us: float | None
    """Processor time of a drive period; None without a steady motion to time."""
    program: Operations
    scatter_us: float = 0.0
    """Standard deviation of that time from one repetition to the next."""


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
        window = last_fifth(first, first + self.duration_us, self.drive)
        return window.from_us, window.to_us


class Reading(NamedTuple):
    """What a motion shows in a window of time, in a few numbers."""

    peak_amplitude_nm: float
    """Largest height above the rest position."""
    lockin_amplitude_nm: float
    """2/T |integral z exp(-i omega t)| at the given frequency."""
    lockin_phase_deg: float
    """In [0, 360)."""
    energy_per_impact_aj: float | None
    """None without impacts."""
    impacts: int


class Observed(NamedTuple):
    """What a scene shows; without a reading the reason says why."""

    scene: Scene
    reading: Reading | None
    reason: str | None
    orbit: Orbit | None


class EffectReport(NamedTuple):
    """One effect: what leaving it out changes and saves."""

    effect: SceneEffect
    change: Change
    reason: str | None
    """Why there is no change to tell: the effect is required, or nothing steady is left without it."""
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


def study_effects(
    scene: Scene,
    start: State | None = None,
    *,
    duration_us: float | None = None,
    accuracy: float | None = None,
    only: Sequence[str] | None = None,
    programs: "Programs | None" = None,
    report: Callable[[int, int], object] = lambda *_: None,
) -> EffectStudy:
    """Return what each effect of a scene changes and costs.

    Args:
        scene: one scene.
        start: where every motion begins, that of the scenes without an effect too; None: the scene's default.
        duration_us: how long to follow it at most; None: 400 drive periods.
        accuracy: relative accuracy of the amplitudes that is wanted; None: nothing is reduced.
        only: names of the effects to look at; None: all.
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
    chosen = _chosen(effects_in(scene), only)
    drive = drive_of(scene)
    begin = default_start(scene) if start is None else start
    duration = PERIODS_AT_MOST * drive.period_us if duration_us is None else duration_us
    view = View(begin, duration, drive, drive.aperiodic is None)
    full = _observe(programs, scene, view)
    if full.reading is None and view.settles and full.reason is not None and full.reason.startswith("nothing repeats"):
        view = view._replace(settles=False)
        full = _observe(programs, scene, view)
    if full.reading is None:
        raise ValueError(f"the scene has no motion to compare with: {full.reason}; give it another start")
    cost = _cost(programs, full, view, None)
    reports, total = [], 1 + len(chosen) + (accuracy is not None)
    for effect in chosen:
        report(1 + len(reports), total)
        reports.append(_report(programs, full, view, effect, cost))
    reduction = None
    if accuracy is not None:
        report(total - 1, total)
        reduction = _reduce(programs, full, view, reports, accuracy, cost)
    return EffectStudy(scene, view, full, cost, reports, reduction)


def periods_read(scene: Scene, orbit: Orbit | None) -> int:
    """Return how many drive periods a period of what the lock-in reads has.

    Those of the orbit where the sample drives; one where base or force do, as every lock-in reads their frequency, and
    where no orbit is steady.
    """
    return 1 if orbit is None or scene.base is not None or scene.force is not None else orbit.periods


def _check(accuracy: float | None, duration_us: float | None) -> None:
    if accuracy is not None and not 0.0 < accuracy < 1.0:
        raise ValueError(f"`accuracy` must be between 0 and 1, but is {accuracy!r}")
    if duration_us is not None and not duration_us > 0.0:
        raise ValueError(f"`duration_us` must be positive, but is {duration_us!r}")


def _chosen(effects: list[SceneEffect], only: Sequence[str] | None) -> list[SceneEffect]:
    names = [effect.name for effect in effects]
    for name in only or ():
        if name not in names:
            raise ValueError(f"the scene has no effect {name!r}; it has {', '.join(names) or 'none'}")
    return [effect for effect in effects if only is None or effect.name in only]


def _report(programs: "Programs", full: Observed, view: View, effect: SceneEffect, full_cost: Cost) -> EffectReport:
    """Return what leaving one effect out changes and saves."""
    if effect.required is not None:
        return EffectReport(effect, Change(), f"required: {effect.required}", None)
    without = _observe(programs, effect.without(full.scene), view)
    change, reason = _change(full, without)
    impossible = why_impossible(without.scene) is not None
    return EffectReport(
        effect, change, reason, None if impossible else _cost(programs, without, view, (full.scene, full_cost))
    )


def _reduce(
    programs: "Programs", full: Observed, view: View, reports: list[EffectReport], accuracy: float, full_cost: Cost
) -> Reduction:
    """Leave out effects from the smallest on, as long as all together change the amplitudes by less."""
    candidates = [
        (size, not report.effect.is_zero, report.effect)
        for report in reports
        if (size := report.change.of_amplitude) is not None and size < accuracy
    ]
    reduced, left_out, change = full, [], Change(0.0, 0.0, 0.0, 0.0)
    for _, _, effect in sorted(candidates, key=lambda candidate: (candidate[1], candidate[0])):
        smaller = _observe(programs, effect.without(reduced.scene), view)
        joint, _ = _change(full, smaller)
        if joint.of_amplitude is not None and joint.of_amplitude < accuracy:
            reduced, change = smaller, joint
            left_out.append(effect.name)
    cost = _cost(programs, reduced, view, (full.scene, full_cost))
    return Reduction(accuracy, tuple(left_out), change, reduced.scene, cost)


def _change(full: Observed, without: Observed) -> tuple[Change, str | None]:
    """Return what changed, and what there is to say."""
    if full.reading is None or without.reading is None:
        return Change(), without.reason
    before, after = full.reading, without.reading
    change = Change(
        after.peak_amplitude_nm / before.peak_amplitude_nm - 1.0,
        after.lockin_amplitude_nm / before.lockin_amplitude_nm - 1.0,
        _nearest_turn(after.lockin_phase_deg - before.lockin_phase_deg, full),
        _relative(before.energy_per_impact_aj, after.energy_per_impact_aj),
    )
    if full.orbit is None or without.orbit is None:
        return change, None
    kinds = [(orbit.impacts, orbit.periods) for orbit in (full.orbit, without.orbit)]
    if kinds[0] == kinds[1]:
        return change, None
    reason = f"another orbit: {kinds[1]} instead of {kinds[0]} (impacts, drive periods)"
    return change._replace(lockin_phase_deg=None), reason


def _nearest_turn(degrees: float, full: Observed) -> float:
    """Return a change of phase; which of the N equivalent periods is locked is unknown."""
    turn = 360.0 / periods_read(full.scene, full.orbit)
    return (degrees + 0.5 * turn) % turn - 0.5 * turn


def _relative(before: float | None, after: float | None) -> float | None:
    return None if before is None or after is None or before == 0.0 else after / before - 1.0


def _observe(programs: "Programs", scene: Scene, view: View) -> Observed:
    """Return what a scene shows in a view: its steady orbit, or the end of the view's duration."""
    if not view.settles:
        return _observe_last_fifth(programs, scene, view)
    aperiodic = drive_of(scene).aperiodic
    if aperiodic is not None:
        return Observed(scene, None, aperiodic, None)
    orbit, reason = follow_to_orbit(scene, view.start, view.duration_us, partial(programs.run, scene))
    if orbit is None:
        return Observed(scene, None, reason, None)
    begin = float(orbit.start.time_us)
    frequency = view.drive.angular_frequency / periods_read(scene, orbit)
    return Observed(scene, _read(scene, orbit.motion, (begin, begin + orbit.period_us), frequency), None, orbit)


def _observe_last_fifth(programs: "Programs", scene: Scene, view: View) -> Observed:
    end = float(view.start.time_us) + view.duration_us
    reason, pieces, run = why_impossible(scene), [], partial(programs.run, scene)
    if reason is None:
        piece_us = _PIECE_PERIODS * drive_of(scene).period_us
        for piece in follow_in_pieces(scene, view.start, end, run, piece_us=piece_us):
            reason = why_over(piece)
            if reason is not None:
                break
            pieces = [*(done for done in pieces if done.goes_on), piece]
    if reason is not None:
        return Observed(scene, None, reason, None)
    return Observed(scene, _read(scene, joined(pieces), view.window, view.drive.angular_frequency), None, None)


def _read(scene: Scene, simulation: Simulation, window: tuple[float, float], angular_frequency: float) -> Reading:
    """Return a reading, a smooth function of a simulation's numbers: contacts, short, are not integrated once more."""
    motion = MotionWindow(dense_path(scene, simulation, *window, integrated=False), *window)
    value = motion.height.lockin(angular_frequency)
    lost = motion.rows.energy_lost_aj[motion.begun]
    return Reading(
        peak_amplitude_nm=motion.height.largest,
        lockin_amplitude_nm=float(abs(value)),
        lockin_phase_deg=float(within_turn(np.degrees(np.angle(value)), 360.0)),
        energy_per_impact_aj=float(lost.mean()) if lost.size else None,
        impacts=int(lost.size),
    )


def _cost(programs: "Programs", observed: Observed, view: View, like: tuple[Scene, Cost] | None) -> Cost:
    """Return what following a scene costs; one whose program is that of another costs what that costs."""
    if like is not None and jax.tree.structure(observed.scene) == jax.tree.structure(like[0]):
        return like[1]
    operations = programs.operations(observed.scene, view.start)
    if observed.reading is None:
        return Cost(None, operations)
    start = view.start if observed.orbit is None else observed.orbit.start
    duration = min(_TIMED_PERIODS * view.drive.period_us, view.duration_us)
    spent, scatter = programs.time_us(observed.scene, start, duration)
    periods = duration / view.drive.period_us
    return Cost(spent / periods, operations, scatter / periods)


class Programs:
    """`simulate`, compiled once for every choice of effects; a scene's numbers change without another compilation."""

    def __init__(self) -> None:
        """Begin without any program."""
        self._compiled: dict[Any, Compiled] = {}

    def run(self, scene: Scene, start: State, duration_us: float) -> Simulation:
        """Return a scene followed for a duration in us."""
        program, arguments = self._program(scene, start, duration_us)
        return program(*arguments)

    def operations(self, scene: Scene, start: State) -> Operations:
        """Return how much the compiled program of a scene has to do."""
        counts = self._program(scene, start, 1.0)[0].cost_analysis() or {}
        return Operations(float(counts.get("flops", 0.0)), float(counts.get("transcendentals", 0.0)))

    def time_us(self, scene: Scene, start: State, duration_us: float) -> tuple[float, float]:
        """Return what following a scene takes of the process's own time, in us: the best of several, their scatter."""
        program, arguments = self._program(scene, start, duration_us)
        calls = 1 + int(_SHORTEST_REPETITION_S / max(_seconds(program, arguments, 1), 1e-6))
        times = [1e6 * _seconds(program, arguments, calls) for _ in range(_REPETITIONS)]
        return min(times), statistics.stdev(times)

    def _program(self, scene: Scene, start: State, duration_us: float) -> tuple[Compiled, tuple[Any, ...]]:
        arguments = (scene, State(*(jnp.asarray(part, float) for part in start)), jnp.asarray(duration_us, float))
        # equal where one compiled program serves both
        key = (jax.tree.structure(arguments), *(jnp.shape(leaf) for leaf in jax.tree.leaves(arguments)))
        if key not in self._compiled:
            self._compiled[key] = jax.jit(_simulated).lower(*arguments).compile(quick_options())
        return self._compiled[key], arguments


def _simulated(scene: Scene, start: State, duration_us: Any) -> Simulation:
    return simulate(scene, start, duration_us, max_contacts=_ROWS)


def _seconds(program: Compiled, arguments: tuple[Any, ...], calls: int) -> float:
    began = time.process_time()
    for _ in range(calls):
        jax.block_until_ready(program(*arguments))
    return (time.process_time() - began) / calls
