"""The fidelity ladder of a scene: the same amplitude from ever fuller models, each with its error and its time.

Orbit of the impact law (closed form), the law's map, both with the collision delay, and the resolved contact, which is
taken for true. Every rung answers one question: how high the tip gets once the motion has settled.
"""

import math
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from afm_jax.apparatus.scene import Scene, require_sample_drive
from afm_jax.contact.contact import Contact
from afm_jax.impact.law import CollisionDelay, ImpactLaw
from afm_jax.impact.orbits import single_impact_orbits
from afm_jax.impact.poincare import iterate_map
from afm_jax.motion.observe import peaks_between_contacts
from afm_jax.motion.record import MotionOutcome, State
from afm_jax.motion.settle import is_stuck
from afm_jax.motion.simulate import simulate
from afm_jax.outcome import Outcome
from afm_jax.study.law_scene_accuracy import first_departure, map_peaks
from afm_jax.study.own_process import progress
from afm_jax.study.scene_accuracy import scene_named

Row = dict[str, Any]

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
    if isinstance(known, ImpactLaw):
        plain = ImpactLaw(known.r, known.epsilon, known.viscous_loss)
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
        # the first run compiles
        peak, lowest, contacts = rung()
    except (_NoAnswer, ValueError) as failure:
        return row | {"reason": str(failure)}
    seconds = []
    for _ in range(max(repetitions, 1)):
        began = time.perf_counter()
        _ = rung()
        seconds.append(time.perf_counter() - began)
    return row | {"peak_nm": peak, "lowest_peak_nm": lowest, "contacts": contacts, "seconds": min(seconds)}


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
