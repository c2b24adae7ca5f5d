"""Error against time of one scene with a resolved contact: settings of its contacts.

Runs in a process of its own on one core. Errors are achieved ones, against the finest setting, whose own error is the
difference to the second finest.
"""

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from afm_jax.apparatus.scene import Scene
from afm_jax.apparatus.surface import surface_of
from afm_jax.contact.settings import DRIVEN_SETTINGS, DrivenSetting, QuickSetting
from afm_jax.motion.observe import peaks_between_contacts
from afm_jax.motion.record import ContactKind, MotionOutcome, Simulation, State
from afm_jax.motion.simulate import _contact
from afm_jax.presets import PRESETS, preset
from afm_jax.scenefile import load_scene
from afm_jax.study.driven_batches import ROUNDS
from afm_jax.study.own_process import progress
from afm_jax.study.timing import Compiled, compiled_for, time_compiled

Row = dict[str, Any]

_TRIALS = 240
_BEYOND_US = 1e-3


class Course(NamedTuple):
    """What a setting is judged by."""

    arrival_us: float
    """Time of the last contact's arrival."""
    peak_nm: float | None
    """Largest height between the first contact and the last; None with a single contact."""
    seconds: float
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
        sweeps=level + 3,
        junction_sweeps=level + 1,
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
    named = {f"level {level}": ("quick", quick_setting(level)) for level in quick}
    named |= {
        f"accuracy {accuracy:g}": ("quick", setting)
        for accuracy, setting in DRIVEN_SETTINGS.items()
        if accuracy in accuracies
    }
    careful_ones = {f"fineness {fine:g}": ("careful", DrivenSetting(None, fine, _TRIALS)) for fine in careful}
    return named | careful_ones


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
    named = settings_of(accuracies, quick, careful)
    *_, finest = named
    courses: dict[str, Course] = {}
    until = jnp.asarray(np.inf)
    # the finest first: it says where to stop
    for name in (finest, *(key for key in named if key != finest)):
        progress(f"accuracy: {named[name][0]}, {name}")
        compiled = compiled_for(_runner(named[name][1], contacts), *world, until)
        if name == finest:
            until = _departure(compiled.run(*world, until), contacts) + _BEYOND_US
        courses[name] = _course(compiled, (*world, until), contacts, repetitions)
    second = f"fineness {careful[-2]:g}"
    rows = [
        {
            "way": way,
            "setting": name,
            "microseconds_per_contact": 1e6 * courses[name].seconds / contacts,
            "compile_s": courses[name].compile_s,
            # the reference has no error of its own here: it is that of the second finest, at most
            **(errors_of(courses[name], courses[finest]) if name != finest else {}),
        }
        for name, (way, _) in named.items()
    ]
    own = errors_of(courses[second], courses[finest])
    return {
        "rows": rows,
        "contacts": contacts,
        "arrival_us": courses[finest].arrival_us,
        "peak_nm": courses[finest].peak_nm,
        "reference": f"every contact in time, {finest}",
        "reference_error_us": own["arrival_error_us"],
        "reference_error_nm": own["peak_error_nm"],
    }


def _runner(setting: DrivenSetting, contacts: int) -> Callable[..., Simulation]:
    return partial(_contact, rows=contacts, setting=setting, rounds=ROUNDS, reverse=False)


def _departure(found: Simulation, contacts: int) -> Array:
    ended = np.asarray(found.contacts.kind) == ContactKind.IMPACT
    if not ended.all():
        reason = MotionOutcome(int(found.outcome)).sentence
        raise ValueError(f"the tip leaves only {int(ended.sum())} of {contacts} contacts: {reason}")
    return found.contacts.departure_time_us[contacts - 1]


def _course(compiled: Compiled, arguments: tuple[Any, ...], contacts: int, repetitions: int) -> Course:
    timing, found = time_compiled(compiled, *arguments, repetitions=repetitions)
    peaks = peaks_between_contacts(arguments[0], found)
    arrival = float(found.contacts.arrival_time_us[contacts - 1])
    return Course(arrival, float(peaks.max()) if peaks.size else None, timing.best_s, timing.compile_s)


def errors_of(course: Course, reference: Course) -> dict[str, float | None]:
    """Return the errors of a course against the reference: of the last arrival in us, and of the peak in nm."""
    peak = None if course.peak_nm is None or reference.peak_nm is None else abs(course.peak_nm - reference.peak_nm)
    return {"arrival_error_us": abs(course.arrival_us - reference.arrival_us), "peak_error_nm": peak}
