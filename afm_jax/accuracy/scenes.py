"""Error against time of one scene: settings of its contacts or of its search for an impact, and ever simpler models.

Runs in a process of its own on one core. Errors are achieved ones, against the finest setting, whose own error is the
difference to the second finest. Simpler models answer one question, how high the tip gets once the motion has settled:
the orbit of the impact law in closed form, the law's map, both with the collision delay, and the resolved contact,
which is taken for true.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from afm_jax.apparatus.scene import Scene, require_sample_drive
from afm_jax.apparatus.surface import surface_of
from afm_jax.bench.problems import ROUNDS
from afm_jax.bench.study import Row, named
from afm_jax.contact.contact import Contact
from afm_jax.contact.settings import DRIVEN_SETTINGS, DrivenSetting, QuickSetting
from afm_jax.impact.first_impact import Flight, first_impact
from afm_jax.impact.lasting_impact import speeds_of_impact
from afm_jax.impact.law import CollisionDelay, ImpactLaw, Law
from afm_jax.impact.map import NextImpact, iterate_map
from afm_jax.impact.orbits import single_impact_orbits
from afm_jax.motion.contact_motion import follow_contacts
from afm_jax.motion.observe import peaks_between_contacts, peaks_of_flights
from afm_jax.motion.record import ContactKind, MotionOutcome, Simulation, State
from afm_jax.motion.settle import is_stuck
from afm_jax.motion.simulate import simulate
from afm_jax.outcomes import Outcome
from afm_jax.scenefile.presets import PRESETS, preset
from afm_jax.scenefile.scenefile import load_scene
from afm_jax.studies.timing import Compiled, compiled_for, progress, time_calls, time_compiled

_TRIALS = 240
_BEYOND_US = 1e-3


class FollowedCourse(NamedTuple):
    """What a setting is judged by."""

    arrival_us: float
    """Time of the last contact's arrival."""
    peak_nm: float | None
    """Largest height between the first contact and the last; None with a single contact."""
    seconds: float
    """For each contact."""
    compile_s: float


def scene_named(name: str) -> Scene:
    """Return the scene of a preset's name or a file."""
    return preset(name) if name in PRESETS and not Path(name).exists() else load_scene(name)


def quick_setting(level: int) -> DrivenSetting:
    """Return the quick way through contacts of a level, from 2: more nodes, and a careful way as fine beside it."""
    nodes = QuickSetting(
        inward=2 * level + 4,
        pressing=level + 3,
        releasing=level + 5,
        outward=2 * level + 4,
        tolerance=10.0 ** (-level - 2),
        iterations=level + 3,
        junction_iterations=level + 1,
        tail=3e-3,
    )
    return DrivenSetting(nodes, 0.8 + 0.7 * level, 60 + 20 * level)


def settings_of(
    accuracies: Sequence[float], quick: Sequence[int], careful: Sequence[float]
) -> dict[str, tuple[str, DrivenSetting]]:
    """Return settings by their names, each with the kind of way through contacts, coarse ones first.

    Args:
        accuracies: settings that `simulate` uses.
        quick: levels of `quick_setting`.
        careful: steps per unit of the local pace, every contact followed in time.
    """
    levels = {f"level {level}": ("quick", quick_setting(level)) for level in quick}
    chosen = {accuracy: setting for accuracy, setting in DRIVEN_SETTINGS.items() if accuracy in accuracies}
    usual = {f"accuracy {accuracy:g}": ("quick", setting) for accuracy, setting in chosen.items()}
    in_time = {f"fineness {fine:g}": ("careful", DrivenSetting(None, fine, _TRIALS)) for fine in careful}
    return levels | usual | in_time


def contact_accuracy(
    *,
    scene: str,
    start: Sequence[float],
    contacts: int,
    accuracies: Sequence[float],
    quick: Sequence[int],
    careful: Sequence[float],
    repetitions: int,
) -> dict[str, Any]:
    """Measure error and time of a contact scene.

    Args:
        scene: a file or a preset's name.
        start: time in us, height in nm and velocity in nm/us in the lab.
        contacts: the arrival of which contact is compared.
        accuracies: which of `simulate`'s settings.
        quick: levels of `quick_setting`.
        careful: finenesses, rising, at least two: the finest is the reference.
        repetitions: of each time measurement.

    Returns:
        `rows` with way, setting, microseconds_per_contact, arrival_error_us, peak_error_nm, compile_s;
        `arrival_us`, `peak_nm` of the reference and its own errors `reference_error_us`, `reference_error_nm`.
    """
    loaded, begin = scene_named(scene), State(*(jnp.asarray(value) for value in start))
    world = (loaded, *surface_of(loaded), begin)
    settings = settings_of(accuracies, quick, careful)
    *_, finest = settings
    courses: dict[str, FollowedCourse] = {}
    until = jnp.asarray(np.inf)
    # the finest first: it says where to stop
    for name in (finest, *(key for key in settings if key != finest)):
        progress(f"accuracy: {settings[name][0]}, {name}")
        compiled = compiled_for(_runner(settings[name][1], contacts), *world, until)
        if name == finest:
            until = _departure(compiled.run(*world, until), contacts) + _BEYOND_US
        courses[name] = _course(compiled, (*world, until), contacts, repetitions)
    ways = {name: settings[name][0] for name in settings}
    study = _judged({name: courses[name] for name in settings}, ways, second=f"fineness {careful[-2]:g}")
    return study | {"contacts": contacts, "reference": f"every contact in time, {finest}"}


def _judged(courses: Mapping[str, FollowedCourse], ways: Mapping[str, str], *, second: str) -> dict[str, Any]:
    """Return rows of settings with their errors against the last one, whose own error is that of the second finest."""
    *_, finest = courses.values()
    rows = [
        {
            "way": ways[name],
            "setting": name,
            "microseconds_per_contact": 1e6 * course.seconds,
            "compile_s": course.compile_s,
            # the reference has no error of its own here: it is that of the second finest, at most
            **(errors_of(course, finest) if course is not finest else {}),
        }
        for name, course in courses.items()
    ]
    own = errors_of(courses[second], finest)
    return {
        "rows": rows,
        "arrival_us": finest.arrival_us,
        "peak_nm": finest.peak_nm,
        "reference_error_us": own["arrival_error_us"],
        "reference_error_nm": own["peak_error_nm"],
    }


def _runner(setting: DrivenSetting, contacts: int) -> Callable[..., Simulation]:
    return partial(follow_contacts, max_contacts=contacts, setting=setting, max_rounds=ROUNDS)


def _departure(found: Simulation, contacts: int) -> Array:
    ended = np.asarray(found.contacts.kind) == ContactKind.IMPACT
    if not ended.all():
        reason = MotionOutcome(int(found.outcome)).sentence
        raise ValueError(f"the tip leaves only {int(ended.sum())} of {contacts} contacts: {reason}")
    return found.contacts.departure_time_us[contacts - 1]


def _course(compiled: Compiled, arguments: tuple[Any, ...], contacts: int, repetitions: int) -> FollowedCourse:
    timing, found = time_compiled(compiled, *arguments, repetitions=repetitions)
    peaks = peaks_between_contacts(arguments[0], found)
    arrival = float(found.contacts.arrival_time_us[contacts - 1])
    return FollowedCourse(
        arrival, float(peaks.max()) if peaks.size else None, timing.best_s / contacts, timing.compile_s
    )


def errors_of(course: FollowedCourse, reference: FollowedCourse) -> dict[str, float | None]:
    """Return the errors of a course against the reference: of the last arrival in us, and of the peak in nm."""
    peak = None if course.peak_nm is None or reference.peak_nm is None else abs(course.peak_nm - reference.peak_nm)
    return {"arrival_error_us": abs(course.arrival_us - reference.arrival_us), "peak_error_nm": peak}


def law_accuracy(
    *, scene: str, start: Sequence[float], contacts: int, tolerances: Sequence[float], repetitions: int
) -> dict[str, Any]:
    """Measure error and time of a law scene: tolerances of the search for an impact; see `contact_accuracy`.

    Args:
        scene: a file or a preset's name.
        start: time in us, height in nm and velocity in nm/us in the lab.
        contacts: the arrival of which impact is compared.
        tolerances: of impact times in us, falling, at least two: the finest is the reference.
        repetitions: of each time measurement.
    """
    loaded = scene_named(scene)
    begin = first_departure(loaded, State(*(jnp.asarray(value) for value in start)))
    # the first impact ends the flight from the start
    impacts = max(contacts - 1, 1)
    courses: dict[str, FollowedCourse] = {}
    compiled = compiled_for(
        lambda scene, time, velocity, tolerance: iterate_map(
            scene, time, velocity, impacts, root_tolerance_us=tolerance
        ),
        loaded,
        *begin,
        jnp.asarray(tolerances[0]),
    )
    for name, tolerance in named("root tolerance", tolerances, " us").items():
        progress(f"accuracy: {name}")
        timing, found = time_compiled(compiled, loaded, *begin, jnp.asarray(tolerance), repetitions=repetitions)
        if int(found.outcome[-1]) not in {Outcome.IMPACT, Outcome.CAPTURED}:
            reached = int(np.sum(np.asarray(found.outcome) == Outcome.IMPACT))
            reason = Outcome(int(found.outcome[reached])).sentence
            raise ValueError(f"the motion has only {reached + 1} of {contacts} impacts: {reason}")
        peak, arrival = float(map_peaks(loaded, begin, found).max()), float(found.arrival_time_us[-1])
        courses[name] = FollowedCourse(arrival, peak, timing.best_s / impacts, timing.compile_s)
    *_, second, finest = courses
    study = _judged(courses, dict.fromkeys(courses, "map"), second=second)
    return study | {"contacts": impacts + 1, "reference": finest}


def first_departure(scene: Scene, start: State) -> tuple[Array, Array]:
    """Return when a tip leaves its first impact with a law, in us, and its velocity in the lab then, in nm/us.

    A tip that starts on the platform leaves it at once: there the start is returned.

    Raises:
        ValueError: if it never meets the platform, or is captured there.
    """
    platform, law = scene.platform, scene.interaction
    assert isinstance(law, Law)  # for laws alone  # noqa: S101
    height, _ = platform.position_and_velocity(start.time_us)
    gap = start.position_nm - height
    if abs(float(gap)) < 1e-9:
        return start.time_us, start.velocity_nm_per_us
    level = jnp.zeros_like(gap)
    flight = Flight(scene.cantilever, platform, start.time_us, start.velocity_nm_per_us, gap, level)
    found = jax.jit(first_impact)(flight)
    if int(found.outcome) != Outcome.IMPACT:
        raise ValueError(f"from its start the tip has no impact: {Outcome(int(found.outcome)).sentence}")
    arrival = start.time_us + found.duration_us
    _, before = scene.cantilever.propagator(found.duration_us)(start.position_nm, start.velocity_nm_per_us)
    approach = platform.velocity(arrival) - before
    if bool(law.captures(approach)):
        raise ValueError("from its start the tip is captured at its first impact")
    impact = speeds_of_impact(law, approach, arrival, scene.cantilever, platform)
    leaves = arrival + impact.delay
    return leaves, platform.velocity(leaves) + impact.rebound


def map_peaks(scene: Scene, begin: tuple[Array, Array], found: NextImpact) -> np.ndarray:
    """Return the largest heights in nm of the flights of an iterated map, up to the last impact."""
    times = jnp.concatenate([begin[0][None], found.time_us[:-1]])
    velocities = jnp.concatenate([begin[1][None], found.velocity_after_nm_per_us[:-1]])
    flown = np.isfinite(np.asarray(found.arrival_time_us)) & np.isfinite(np.asarray(times))
    times, velocities, ends = (np.asarray(part)[flown] for part in (times, velocities, found.arrival_time_us))
    return peaks_of_flights(scene, times, np.asarray(scene.platform.position(times)), velocities, ends)


LAST = 0.2
"""Share of the flights that count, the last ones: the motion is taken for settled there."""
_DECAYS = 10.0
"""Ring-down times that a motion is followed."""
_UNDAMPED_PERIODS = 400


class _NoAnswer(Exception):  # noqa: N818
    """A rung has no amplitude; the message says why."""


def ladder_duration(scene: Scene) -> float:
    """Return how long a motion is followed in us: ten ring-down times of the cantilever."""
    decay = float(scene.cantilever.decay_rate)
    return _DECAYS / decay if decay > 0.0 else _UNDAMPED_PERIODS * float(scene.platform.period_us)


def fidelity_ladder(
    *, scene: str, start: Sequence[float], duration_us: float, law: Mapping[str, float] | None, repetitions: int
) -> dict[str, Any]:
    """Measure the ladder of a scene.

    Args:
        scene: a file or a preset's name.
        start: time in us, height in nm and velocity in nm/us in the lab.
        duration_us: how long motions are followed.
        law: of a contact scene: r, epsilon, viscous_loss and the delay's hertz, lead_nm, offset_nm.
        repetitions: of each time measurement, after a first one that compiles.

    Returns:
        `ladder`: rows with model, peak_nm (highest point in the last fifth of the flights), lowest_peak_nm (of these
        flights: as high in a periodic motion), model_error (relative, against the last row), seconds, contacts,
        reason (where there is no peak); `model_reference`: which row is taken for true.
    """
    loaded, begin = scene_named(scene), State(*(jnp.asarray(value) for value in start))
    full = loaded.interaction
    known = _law_of(law) if isinstance(full, Contact) and law is not None else full
    rungs: dict[str, Callable[[], tuple[float, float, int]]] = {}
    contacts = _expected_contacts(loaded, duration_us)
    if isinstance(known, Law):
        plain = known.without_delay()
        laws = {"": plain, **({" with delay": known} if known.delay is not None else {})}
        scenes = {
            name: eqx.tree_at(_interaction, loaded, each, is_leaf=lambda x: x is full) for name, each in laws.items()
        }
        rungs |= {f"single-impact orbit{name}": _orbit(each) for name, each in scenes.items()}
        rungs |= {f"impact map{name}": _map(each, begin, contacts, duration_us) for name, each in scenes.items()}
    if isinstance(full, Contact):
        rungs["full contact"] = _full(loaded, begin, duration_us)
    rows = [_row(name, rung, repetitions) for name, rung in rungs.items()]
    true = rows[-1].get("peak_nm")
    for row in rows[:-1]:
        if true is not None and row["peak_nm"] is not None:
            row["model_error"] = abs(row["peak_nm"] / true - 1.0)
    return {"ladder": rows, "model_reference": rows[-1]["model"], "duration_us": duration_us}


def _interaction(scene: Scene) -> Any:
    return scene.interaction


def _law_of(values: Mapping[str, float]) -> ImpactLaw:
    delay = CollisionDelay(values["hertz"], values["lead_nm"], values["offset_nm"])
    return ImpactLaw(values["r"], values["epsilon"], values["viscous_loss"], delay)


def _expected_contacts(scene: Scene, duration_us: float) -> int:
    """Return how many contacts a motion near the nearest resonance has."""
    return max(math.ceil(duration_us * 2e-3 * float(scene.cantilever.frequency_khz)), 10)


def _row(model: str, rung: Callable[[], tuple[float, float, int]], repetitions: int) -> Row:
    progress(f"accuracy: {model}")
    row: Row = {"model": model, "peak_nm": None, "lowest_peak_nm": None, "seconds": None, "contacts": None}
    try:
        calls = time_calls(rung, repetitions=repetitions)
    except (_NoAnswer, ValueError) as failure:
        return row | {"reason": str(failure)}
    peak, lowest, contacts = calls.result
    return row | {"peak_nm": peak, "lowest_peak_nm": lowest, "contacts": contacts, "seconds": calls.best_s}


def _orbit(scene: Scene) -> Callable[[], tuple[float, float, int]]:
    ratio = float(scene.platform.frequency_khz) / (2.0 * float(scene.cantilever.frequency_khz))
    order = max(1, round(ratio))

    def rung() -> tuple[float, float, int]:
        found = single_impact_orbits(scene, order)
        good = np.asarray(found.exists & found.admissible & found.stable)
        if not good.any():
            raise _NoAnswer(f"there is no stable orbit of order {order}")
        # of several the fastest, as where a simulation starts by default
        fastest = int(np.argmax(np.where(good, np.asarray(found.approach_speed_nm_per_us), -np.inf)))
        peak = float(found.peak_amplitude_nm[fastest])
        return peak, peak, 1

    return rung


def _map(scene: Scene, start: State, contacts: int, duration_us: float) -> Callable[[], tuple[float, float, int]]:
    def rung() -> tuple[float, float, int]:
        require_sample_drive(scene, second_frequency=True)
        begin = first_departure(scene, start)
        found = jax.block_until_ready(iterate_map(scene, *begin, contacts))
        within = np.asarray(found.arrival_time_us) < float(start.time_us) + duration_us
        outcome = np.asarray(found.outcome)
        ended = within & (outcome != Outcome.IMPACT) & (outcome != Outcome.NOT_REACHED)
        if ended.any() or not within.any():
            place = int(np.argmax(outcome != Outcome.IMPACT))
            raise _NoAnswer(f"after {place + 1} impacts: {Outcome(int(outcome[place])).sentence}")
        peaks = map_peaks(scene, begin, found)[: int(within.sum())]
        return *_last(peaks), len(peaks)

    return rung


def _full(scene: Scene, start: State, duration_us: float) -> Callable[[], tuple[float, float, int]]:
    def rung() -> tuple[float, float, int]:
        found = jax.block_until_ready(simulate(scene, start, duration_us))
        cut = int(found.outcome) == MotionOutcome.HELD and not is_stuck(scene, found)
        if int(found.outcome) != MotionOutcome.FINISHED and not cut:
            raise _NoAnswer(f"after {int(found.count)} contacts: {MotionOutcome(int(found.outcome)).sentence}")
        return *_last(peaks_between_contacts(scene, found)), int(found.count)

    return rung


def _last(peaks: np.ndarray) -> tuple[float, float]:
    """Return the highest and the lowest of the last peaks."""
    if not peaks.size:
        raise _NoAnswer("there are too few contacts for an amplitude: follow the motion longer")
    last = peaks[-max(int(LAST * peaks.size), 1) :]
    return float(last.max()), float(last.min())
