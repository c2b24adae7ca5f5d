"""What each effect of a scene changes and costs, and which of them a wanted accuracy does not need."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

from afm_jax.apparatus.scene import Scene
from afm_jax.motion.drive_period import drive_of
from afm_jax.motion.observe import Reading
from afm_jax.motion.record import State
from afm_jax.motion.settle import why_impossible
from afm_jax.motion.start import default_start
from afm_jax.parameters import require_float64
from afm_jax.study.motion_program import Operations, Programs
from afm_jax.study.observed_scene import Observed, View, observe_scene, slope_of_reading
from afm_jax.study.scene_effects import SceneEffect, effects_in

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


Progress = Callable[[str], None]


def study_effects(  # noqa: PLR0913
    scene: Scene,
    start: State | None = None,
    *,
    duration_us: float | None = None,
    accuracy: float | None = None,
    only: Sequence[str] | None = None,
    derivatives: bool = True,
    programs: Programs | None = None,
    progress: Progress = lambda _: None,
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
        progress: is told what is being done.

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
    progress("the full scene")
    full = observe_scene(programs, scene, view)
    if full.reading is None and view.settles and full.reason is not None and full.reason.startswith("nothing repeats"):
        view = view._replace(settles=False)
        full = observe_scene(programs, scene, view)
    if full.reading is None:
        raise ValueError(f"the scene has no motion to compare with: {full.reason}; give it another start")
    cost = _cost(programs, full, view, None)
    reports = []
    for effect in chosen:
        progress(effect.name)
        reports.append(_report(programs, full, view, effect, cost, derivatives=derivatives))
    reduction = None
    if accuracy is not None:
        progress("what can be left out together")
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
    turn = 360.0 / (full.orbit.periods if full.orbit is not None else 1)
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
