"""What each effect of a scene changes and costs, and which effects a wanted accuracy does not need.

An effect is left out: it is absent from the compiled program, not multiplied by zero. The scene without it is followed
from the same start, and its steady orbit is read as that of the full scene is. What the two readings differ by is what
the effect changes; what the programs' times differ by is what it costs.
"""

import statistics
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from operator import attrgetter
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp

from afm_jax.apparatus.scene import DrivePeriod, Scene, drive_of
from afm_jax.checks import require_float64
from afm_jax.columns import CsvColumns, columns_of, csv_columns
from afm_jax.compilation_cache import quick_options
from afm_jax.contact.contact import Contact
from afm_jax.contact.parameters import WHY_REQUIRED
from afm_jax.impact.law import ImpactLaw
from afm_jax.motion.observe import MotionWindow
from afm_jax.motion.periodic import Orbit, follow_to_orbit
from afm_jax.motion.record import Simulation, State
from afm_jax.motion.simulate import simulate
from afm_jax.motion.start import default_start
from afm_jax.motion.trajectory import DensePath
from afm_jax.report import Cell, Section, sections, table_of
from afm_jax.results import Result, public_result
from afm_jax.saved import as_json
from afm_jax.scenefile.scenefile import scene_tables
from afm_jax.studies.timing import seconds_a_call
from afm_jax.words import counted, known

PERIODS_AT_MOST = 400.0
"""Drive periods after which a motion that has not settled is given up."""
_PERIODS_TIMED = 50.0
_REPETITIONS = 7
_ROWS = 1024
"""Contacts there is room for in one piece of a motion."""


class SceneEffect(NamedTuple):
    """One effect of a scene."""

    name: str
    path: str
    """Of the part of a scene that it is, or is in."""
    neutral: Callable[[Scene], Any]
    """What stands there without it; nothing of it is left in the program, unless it is a number of the impact law."""
    required: str | None = None
    """Why the scene cannot do without it; None: it can be left out."""

    def without(self, scene: Scene) -> Scene:
        """Return a scene without this effect."""
        return eqx.tree_at(attrgetter(self.path), scene, self.neutral(scene), is_leaf=lambda leaf: leaf is None)


_OF_LAWS = {"restitution": ("r", 1.0), "adhesion": ("epsilon", 0.0), "viscous_loss": ("viscous_loss", 0.0)}
"""Of each effect the number of the law, and its value without the effect."""
_AMPLITUDES = {"platform": "amplitude_nm", "base": "amplitude_nm", "force": "amplitude_nn"}


def effects_in(scene: Scene) -> list[SceneEffect]:
    """Return all effects that a scene has: those of its interaction first, then the air, then how it is driven."""
    effects = _of_interaction(scene.interaction)
    if scene.cantilever.quality_factor is not None:
        effects.append(_putting("air_damping", "cantilever.quality_factor"))
    driven = {name: getattr(scene, name) for name in _AMPLITUDES if getattr(scene, name) is not None}
    moving = [name for name, drive in driven.items() if getattr(drive, _AMPLITUDES[name]) != 0.0]
    for name in driven:
        if name != "platform":
            only = "it is the scene's only drive" if moving == [name] else None
            effects.append(_putting(f"{name}_drive", name)._replace(required=only))
    return effects


def _of_interaction(interaction: Any) -> list[SceneEffect]:
    if isinstance(interaction, Contact):
        terms = "interaction.forces.terms"
        return [
            SceneEffect(name, terms, partial(_terms_without, name), WHY_REQUIRED.get(name))
            for name in interaction.effects
        ]
    if not isinstance(interaction, ImpactLaw):
        return []
    effects = [_putting(name, f"interaction.{number}", neutral) for name, (number, neutral) in _OF_LAWS.items()]
    if interaction.delay is not None:
        effects.append(_putting("delay", "interaction.delay"))
    if interaction.lasts:
        effects.append(SceneEffect("delay_corrections", "interaction.delay", _plain_delay))
    return effects


def _putting(name: str, path: str, number: float | None = None) -> SceneEffect:
    """Return an effect in whose place there is nothing, or a number."""
    return SceneEffect(name, path, lambda _: None if number is None else jnp.asarray(number))


def _terms_without(name: str, scene: Scene) -> tuple[Any, ...]:
    """Return the forces of a scene's contact without one of them; they are the first of its effects, in their order."""
    named = zip(scene.interaction.forces.terms, scene.interaction.effects, strict=False)
    return tuple(term for term, effect in named if effect != name)


def _plain_delay(scene: Scene) -> Any:
    """Return a delay without what moving sample, spring and air change while an impact lasts; None if there is none."""
    return scene.interaction.delay and replace(scene.interaction.delay, corrections=False)


# --- what is compared -------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Change:
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


@dataclass(frozen=True, kw_only=True)
class Reading:
    """What a steady orbit shows, in a few numbers."""

    peak_amplitude_nm: float
    """Largest height above the rest position."""
    lockin_frequency_khz: float
    """Of the response."""
    lockin_amplitude_nm: float
    """2/T |integral z exp(-i omega t)| at that frequency."""
    lockin_phase_deg: float
    """In [0, 360/N) with N the drive periods of a response."""
    energy_per_impact_aj: float | None
    """None without impacts."""
    impacts: int
    drive_periods: int
    time_us_per_period: float | None = None
    """What computing a drive period takes: the median of several runs."""


class Observed(NamedTuple):
    """A scene, its steady orbit and what that shows; without an orbit the reason says why."""

    scene: Scene
    orbit: Orbit | None
    reason: str | None
    reading: Reading | None


@dataclass(frozen=True)
class EffectReport:
    """One effect: what leaving it out changes and costs."""

    name: str
    required: bool
    """Whether the scene cannot do without it."""
    change: Change
    reason: str | None
    """Why there is no change to tell: the effect is required, or nothing steady is left without it."""
    time_us_per_period: float | None
    """Of the scene without it; None without a motion to time."""
    needed: bool = True
    """For the wanted accuracy."""


@public_result(picture="afm_jax.plots.effects:effects_figure")
@dataclass(frozen=True)
class EffectStudy(Result):
    """All effects of a scene, and which of them an accuracy of the amplitudes does not need.

    Attributes:
        full: what the full scene shows.
        effects: each left out.
        accuracy: that is wanted, relative.
        not_needed: the effects that it does not need.
        joint_change: what leaving all of them out changes, simulated.
        reduced: the scene without them.
        reduced_time_us_per_period: what computing a drive period of it takes.
    """

    full: Reading
    effects: list[EffectReport]
    accuracy: float
    not_needed: list[str]
    joint_change: Change
    reduced: Scene
    reduced_time_us_per_period: float | None


@as_json.register
def _(study: EffectStudy) -> dict[str, Any]:
    told = {"compared": "steady orbits"} | vars(study)
    time = told.pop("reduced_time_us_per_period")
    return told | {"reduced": {"time_us_per_period": time, "scene": scene_tables(study.reduced)}}


@sections.register
def _(study: EffectStudy) -> list[Section]:
    full, joint = study.full, study.joint_change
    cells: dict[str, Cell] = {
        "effect": "name",
        "peak\nchange": lambda effect: _percent(effect.change.peak_amplitude),
        "lock-in\nchange": lambda effect: _percent(effect.change.lockin_amplitude),
        "phase\ndeg": lambda effect: effect.change.lockin_phase_deg,
        "loss/impact\nchange": lambda effect: _percent(effect.change.energy_per_impact),
        "time\nus/period": "time_us_per_period:.4g",
        "": lambda effect: "required" if effect.required else "" if effect.needed else "not needed",
    }
    summary = (
        f"Full scene: {counted(full.impacts, 'impact')} in {counted(full.drive_periods, 'drive period')}; "
        f"peak {full.peak_amplitude_nm:.5g} nm, lock-in at {full.lockin_frequency_khz:.6g} kHz "
        f"{full.lockin_amplitude_nm:.5g} nm at {full.lockin_phase_deg:.4g} deg, "
        f"{known(full.energy_per_impact_aj, '.4g')} aJ lost per impact; {known(full.time_us_per_period, '.4g')} us to "
        "compute a drive period."
    )
    reasons = [f"{effect.name}: {effect.reason}." for effect in study.effects if effect.reason is not None]
    conclusion = "every effect that can be left out is needed."
    if study.not_needed:
        conclusion = (
            f"these are not needed: {', '.join(study.not_needed)}. Without all of them the peak changes by "
            f"{_percent(joint.peak_amplitude)}, the lock-in amplitude by {_percent(joint.lockin_amplitude)}; "
            f"{known(study.reduced_time_us_per_period, '.4g')} us per drive period."
        )
    table = table_of(cells, study.effects, form=".3g")
    end = f"For amplitudes to {100.0 * study.accuracy:g} % {conclusion}"
    return [Section("", [summary, "Without the effect:", table, *reasons, end])]


@csv_columns.register
def _(study: EffectStudy) -> CsvColumns:
    rows = [vars(effect) | {f"change_{name}": x for name, x in vars(effect.change).items()} for effect in study.effects]
    return {"effects.csv": columns_of(rows, [name for name in rows[0] if name != "change"] if rows else ())}


def _percent(share: float | None) -> str:
    return "-" if share is None else f"{100.0 * share:+z.3g} %"


# --- the study --------------------------------------------------------------------------------------------------------


def study_effects(
    scene: Scene,
    start: State | None = None,
    *,
    accuracy: float = 0.01,
    duration_us: float | None = None,
    only: Sequence[str] | None = None,
    report: Callable[[int, int], object] = lambda *_: None,
) -> EffectStudy:
    """Return what each effect of a scene changes and costs.

    Args:
        scene: one scene.
        start: where every motion begins, that of the scenes without an effect too; None: the scene's default.
        accuracy: relative accuracy of the amplitudes that is wanted.
        duration_us: how long to follow it at most; None: 400 drive periods.
        only: names of the effects to look at; None: all.
        report: called with how many of how many scenes, with and without an effect, are done.

    Raises:
        RuntimeError: if JAX is not set to 64-bit floats, or was not when the scene was built.
        ValueError: if the scene itself has no motion to compare with, or an effect of `only` is not in the scene.
    """
    require_float64(scene)
    effects = {effect.name: effect for effect in effects_in(scene)}
    for name in only or ():
        if name not in effects:
            raise ValueError(f"the scene has no effect {name!r}; it has {', '.join(effects) or 'none'}")
    chosen = [effect for name, effect in effects.items() if only is None or name in only]
    view = _View(scene, start, duration_us)
    full = view.observed(scene)
    if full.reading is None:
        raise ValueError(f"the scene has no steady orbit to compare with: {full.reason}; give it another start")
    reports: dict[str, EffectReport] = {}
    for number, effect in enumerate(chosen, 1):
        report(number, len(chosen) + 2)
        told: tuple[Any, ...] = Change(), f"required: {effect.required}", None
        if effect.required is None:
            without = view.observed(effect.without(scene))
            told = *view.change(full, without), view.cost(without)
        reports[effect.name] = EffectReport(effect.name, effect.required is not None, *told)
    report(len(chosen) + 1, len(chosen) + 2)
    sizes = [(each.change.of_amplitude, effects[name]) for name, each in reports.items()]
    small = [(size, effect) for size, effect in sizes if size is not None and size < accuracy]
    not_needed, joint_change, reduced = _reduced(view, full, small, accuracy)
    for name in not_needed:
        reports[name] = replace(reports[name], needed=False)
    reading = replace(full.reading, time_us_per_period=view.cost(full))
    cost = view.cost(reduced)
    return EffectStudy(reading, [*reports.values()], accuracy, not_needed, joint_change, reduced.scene, cost)


def _reduced(
    view: "_View", full: Observed, sizes: Sequence[tuple[float, SceneEffect]], accuracy: float
) -> tuple[list[str], Change, Observed]:
    """Leave out effects from the smallest on, as long as all together change the amplitudes by less."""
    reduced, left_out, change = full, [], Change(0.0, 0.0, 0.0, 0.0)
    for _, effect in sorted(sizes, key=lambda each: each[0]):
        smaller = view.observed(effect.without(reduced.scene))
        joint, _ = view.change(full, smaller)
        if joint.of_amplitude is not None and joint.of_amplitude < accuracy:
            reduced, change = smaller, joint
            left_out.append(effect.name)
    return left_out, change, reduced


class _View:
    """How scenes are compared: all from one start, over one duration, with one reference; their compiled programs."""

    def __init__(self, scene: Scene, start: State | None, duration_us: float | None) -> None:
        """Take what the full scene says."""
        self.drive: DrivePeriod = drive_of(scene)
        self.start = default_start(scene) if start is None else start
        self.duration_us = PERIODS_AT_MOST * self.drive.period_us if duration_us is None else duration_us
        # compiled once for every choice of effects; numbers change without compiling again
        self._follow = jax.jit(partial(simulate, max_contacts=_ROWS), compiler_options=quick_options())
        self._costs: dict[Any, float] = {}

    def observed(self, scene: Scene) -> Observed:
        """Return what a scene shows."""
        aperiodic, run = drive_of(scene).aperiodic, partial(self._run, scene)
        orbit, reason = None, aperiodic
        if aperiodic is None:
            orbit, reason = follow_to_orbit(scene, self.start, self.duration_us, run)
        return Observed(scene, orbit, reason, None if orbit is None else _read(scene, orbit))

    def change(self, full: Observed, without: Observed) -> tuple[Change, str | None]:
        """Return what changed, and what there is to say."""
        before, after = full.reading, without.reading
        if before is None or after is None or full.orbit is None or without.orbit is None:
            return Change(), None if without.reason is None else f"without it: {without.reason}"
        # which of the N equivalent periods is locked is unknown
        turn = 360.0 / _periods_read(full.scene, full.orbit)
        phase = (after.lockin_phase_deg - before.lockin_phase_deg + 0.5 * turn) % turn - 0.5 * turn
        lost, lost_after = before.energy_per_impact_aj, after.energy_per_impact_aj
        change = Change(
            after.peak_amplitude_nm / before.peak_amplitude_nm - 1.0,
            after.lockin_amplitude_nm / before.lockin_amplitude_nm - 1.0,
            phase,
            lost_after / lost - 1.0 if lost and lost_after is not None else None,
        )
        kinds = [(orbit.impacts, orbit.periods) for orbit in (full.orbit, without.orbit)]
        if kinds[0] == kinds[1]:
            return change, None
        reason = f"without it: another orbit, {kinds[1]} instead of {kinds[0]} (impacts, drive periods)"
        return replace(change, lockin_phase_deg=None), reason

    def cost(self, observed: Observed) -> float | None:
        """Return what following a scene's steady orbit costs; one program has one cost."""
        if observed.orbit is None:
            return None
        structure = jax.tree.structure(observed.scene)
        if structure not in self._costs:
            duration = min(_PERIODS_TIMED * self.drive.period_us, self.duration_us)
            arguments = _arguments(observed.scene, observed.orbit.start, duration)
            seconds = statistics.median(seconds_a_call(self._follow, *arguments, repetitions=_REPETITIONS))
            self._costs[structure] = 1e6 * seconds * self.drive.period_us / duration
        return self._costs[structure]

    def _run(self, scene: Scene, start: State, duration_us: float) -> Simulation:
        return self._follow(*_arguments(scene, start, duration_us))


def _arguments(scene: Scene, start: State, duration_us: float) -> tuple[Scene, State, Any]:
    """Return arguments of one type, whatever numbers they were: each type would compile again."""
    return scene, State(*(jnp.asarray(part, float) for part in start)), jnp.asarray(duration_us, float)


def _periods_read(scene: Scene, orbit: Orbit) -> int:
    """Return how many drive periods a period of what the lock-in reads has.

    Those of the orbit where the sample drives; one where base or force do, as every lock-in reads their frequency.
    """
    return orbit.periods if scene.base is None and scene.force is None else 1


def _read(scene: Scene, orbit: Orbit) -> Reading:
    """Return a reading of an orbit, by a lock-in at the drive's frequency over some periods."""
    begin = float(orbit.start.time_us)
    dense = DensePath(scene, orbit.motion)
    motion = MotionWindow(dense, begin, begin + orbit.period_us, _periods_read(scene, orbit))
    lost, line = motion.dense.contacts.energy_lost_aj[motion.begun], motion.height.at_response
    return Reading(
        peak_amplitude_nm=motion.height.largest,
        lockin_frequency_khz=line.frequency_khz,
        lockin_amplitude_nm=line.amplitude_nm,
        lockin_phase_deg=line.phase_deg,
        energy_per_impact_aj=float(lost.mean()) if lost.size else None,
        impacts=int(lost.size),
        drive_periods=orbit.periods,
    )
