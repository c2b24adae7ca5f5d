"""Error against time of one scene with an impact law: tolerances of the search for an impact; see `scene_accuracy`."""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from afm_jax.apparatus.scene import Scene
from afm_jax.impact.first_impact import Flight, first_impact
from afm_jax.impact.lasting_impact import LawImpact, speeds_of_impact
from afm_jax.impact.law import ImpactLaw
from afm_jax.impact.poincare import NextImpact, iterate_map
from afm_jax.motion.observe import peaks_of_flights
from afm_jax.motion.record import State
from afm_jax.outcome import Outcome
from afm_jax.study.own_process import progress
from afm_jax.study.scene_accuracy import Course, errors_of, scene_named
from afm_jax.study.timing import compiled_for, time_compiled


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
    courses = []
    compiled = compiled_for(
        lambda scene, time, velocity, tolerance: iterate_map(
            scene, time, velocity, impacts, root_tolerance_us=tolerance
        ),
        loaded,
        *begin,
        jnp.asarray(tolerances[0]),
    )
    for tolerance in tolerances:
        progress(f"accuracy: root tolerance {tolerance:g}")
        timing, found = time_compiled(compiled, loaded, *begin, jnp.asarray(tolerance), repetitions=repetitions)
        if int(found.outcome[-1]) not in {Outcome.IMPACT, Outcome.CAPTURED}:
            reached = int(np.sum(np.asarray(found.outcome) == Outcome.IMPACT))
            reason = Outcome(int(found.outcome[reached])).sentence
            raise ValueError(f"the motion has only {reached + 1} of {contacts} impacts: {reason}")
        peaks = map_peaks(loaded, begin, found)
        arrival = float(found.arrival_time_us[-1])
        courses.append(Course(arrival, float(peaks.max()), timing.best_s, timing.compile_s))
    finest = courses[-1]
    rows = [
        {
            "way": "map",
            "setting": f"root tolerance {tolerance:g} us",
            "microseconds_per_contact": 1e6 * course.seconds / impacts,
            "compile_s": course.compile_s,
            **(errors_of(course, finest) if course is not finest else {}),
        }
        for tolerance, course in zip(tolerances, courses, strict=True)
    ]
    own = errors_of(courses[-2], finest)
    return {
        "rows": rows,
        "contacts": impacts + 1,
        "arrival_us": finest.arrival_us,
        "peak_nm": finest.peak_nm,
        "reference": f"root tolerance {tolerances[-1]:g} us",
        "reference_error_us": own["arrival_error_us"],
        "reference_error_nm": own["peak_error_nm"],
    }


def first_departure(scene: Scene, start: State) -> tuple[Array, Array]:
    """Return when a tip leaves its first impact with a law, in us, and its velocity in the lab then, in nm/us.

    A tip that starts on the platform leaves it at once: there the start is returned.

    Raises:
        ValueError: if it never meets the platform, or is captured there.
    """
    platform, law = scene.platform, scene.interaction
    assert isinstance(law, ImpactLaw)  # for laws alone  # noqa: S101
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
    impact = speeds_of_impact(LawImpact(law), approach, arrival, scene.cantilever, platform)
    leaves = arrival + impact.delay
    return leaves, platform.velocity(leaves) + impact.rebound


def map_peaks(scene: Scene, begin: tuple[Array, Array], found: NextImpact) -> np.ndarray:
    """Return the largest heights in nm of the flights of an iterated map, up to the last impact."""
    times = jnp.concatenate([begin[0][None], found.time_us[:-1]])
    velocities = jnp.concatenate([begin[1][None], found.velocity_after_nm_per_us[:-1]])
    flown = np.isfinite(np.asarray(found.arrival_time_us)) & np.isfinite(np.asarray(times))
    times, velocities, ends = (np.asarray(part)[flown] for part in (times, velocities, found.arrival_time_us))
    return peaks_of_flights(scene, times, np.asarray(scene.platform.position(times)), velocities, ends)
