"""Driven contacts per second: batches of bouncing tips, contacts that turn in the bridge, stuck tips, SciPy beside.

The flights between the contacts are part of the time. Errors are those of one contact each, from the same arrival, so
that no chaos multiplies them; contacts that turn in the bridge are shown apart.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from afm_jax.apparatus.scene import Scene
from afm_jax.bench.problems import SingleContacts, batch_run, bouncing_starts, single_contacts, spread_starts
from afm_jax.bench.scipy_contacts import contact_contestants
from afm_jax.bench.study import Row, measured
from afm_jax.compilation_cache import quick_options
from afm_jax.contact.settings import DRIVEN_SETTINGS, DrivenSetting
from afm_jax.motion.record import ContactKind, MotionOutcome, Simulation, State
from afm_jax.motion.simulate import simulate
from afm_jax.scenefile.presets import contact_scene
from afm_jax.studies.timing import Compiled, compiled_for, progress, time_calls, time_compiled

REFERENCE = DrivenSetting(None, 8.0, 240)
"""Every contact in time, in fine steps; the tests compare it with an independent integration."""
COARSER_REFERENCE = DrivenSetting(None, 6.0, 240)
DRIVE_AMPLITUDE_NM = 4.0
LOW_ORDER, HIGH_ORDER = 1.01, 5.277
"""Reduced frequencies: without contacts that turn in the bridge, and with some."""
AIMED_ACCURACY = 1e-6


def scenes_one_core(
    *,
    batch: int,
    periods: Mapping[str, int],
    rows: int,
    repetitions: int,
    long_periods: int,
    scipy_contacts: int,
    accuracies: Sequence[float] = (1e-6, 1e-9),
) -> dict[str, Any]:
    """Measure everything of the benchmark of driven scenes; to be run in a process of its own.

    Args:
        batch: how many tips at once.
        periods: drive periods of each scene, by its reduced frequency as text.
        rows: most contacts of a tip.
        repetitions: of each measurement.
        long_periods: drive periods of the one long motion.
        scipy_contacts: how many contacts SciPy follows.
        accuracies: which of `simulate`'s settings to measure.

    Returns:
        `rows` with what, scene, batch, contacts, microseconds_per_contact, compile_s, seconds, turning_share,
        held_share, and of straight and turning contacts each the median, 99 % and worst error of the rebound speed
        (relative) and of the departure time (us); `reference_error`, `reference_error_us`: of the reference's own.
    """
    first = contact_scene(LOW_ORDER, DRIVE_AMPLITUDE_NM, 0.0)
    arguments = (first, spread_starts(first, batch), jnp.zeros(batch))
    runs = {}
    for name, setting in [*((accuracy, DRIVEN_SETTINGS[accuracy]) for accuracy in accuracies), *_REFERENCES.items()]:
        progress(f"bench: scenes, compiling {name}")
        # as `simulate` compiles its own programs
        runs[name] = compiled_for(batch_run(setting, rows), *arguments, options=quick_options())
    table, own = [], []
    for reduced, count in periods.items():
        scene = contact_scene(float(reduced), DRIVE_AMPLITUDE_NM, 0.0)
        more, own_errors = _scene(f"n = {reduced}", scene, runs, batch, count, repetitions, scipy_contacts)
        table += more
        own.append(own_errors)
        if long_periods:
            table.append(_long(f"n = {reduced}", scene, long_periods, repetitions))
    worst = [max((pair[place] for pair in own), default=None) for place in (0, 1)]
    return {"rows": table, "reference_error": worst[0], "reference_error_us": worst[1]}


_REFERENCES = {"reference": REFERENCE, "coarser": COARSER_REFERENCE}


def _scene(
    name: str,
    scene: Scene,
    runs: Mapping[Any, Compiled],
    batch: int,
    periods: int,
    repetitions: int,
    scipy_contacts: int,
) -> tuple[list[Row], tuple[float, float]]:
    """Measure one scene; return its rows and the reference's own errors."""
    duration = periods * float(scene.platform.period_us)
    settings = [accuracy for accuracy in runs if accuracy not in _REFERENCES]
    progress(f"bench: scenes, {name}, finding tips that keep bouncing")
    # chaotic tips: one that is held with one setting is free with another, so that each has its own starts
    bouncing = {accuracy: bouncing_starts(scene, runs[accuracy].run, batch, duration) for accuracy in settings}
    finest, (starts, _) = runs[min(settings)].run, bouncing[min(settings)]
    found = finest(scene, starts, starts.time_us + duration)
    single = single_contacts(scene, found, batch)
    reference, coarser = (runs[key].run(scene, single.starts, single.until_us) for key in _REFERENCES)
    rows = []
    for accuracy in settings:
        own, held = bouncing[accuracy]
        tips = {"bouncing tips": own}
        if held:
            tips["tips as they come, held ones too"] = spread_starts(scene, batch)
        for kind, begin in tips.items():
            progress(f"bench: scenes, {name}, accuracy {accuracy:g}, {kind}")
            row = _timed(runs[accuracy], (scene, begin, begin.time_us + duration), repetitions)
            row |= {"what": f"{kind}, accuracy {accuracy:g}", "scene": name, "periods": periods}
            if kind == "bouncing tips":
                one = runs[accuracy].run(scene, single.starts, single.until_us)
                row |= contact_errors(one, reference, single)
            rows.append(row)
    for row in measured(f"bench: scenes, {name}", contact_contestants(scene, reference, single, scipy_contacts)):
        tolerance = row.pop("setting").removeprefix("tolerance ")
        what = f"{row.pop('method')} with events, the contact alone, rtol {tolerance}"
        rows.append({"what": what, "scene": name, "batch": 1} | row)
    errors = contact_errors(coarser, reference, single)
    parts = [
        [errors.get(f"{part}_{column}_worst") or 0.0 for part in ("straight", "turning")]
        for column in ("rebound_error", "time_error_us")
    ]
    return rows, (max(parts[0]), max(parts[1]))


def _timed(compiled: Compiled, arguments: tuple[Scene, State, Array], repetitions: int) -> Row:
    timing, found = time_compiled(compiled, *arguments, repetitions=repetitions)
    outcome = np.asarray(found.outcome)
    ended = int(np.sum(np.asarray(found.contacts.kind) == ContactKind.IMPACT))
    return {
        "batch": int(outcome.size),
        "contacts": ended,
        "seconds": timing.best_s,
        "microseconds_per_contact": 1e6 * timing.best_s / ended if ended else None,
        "median_microseconds_per_contact": 1e6 * timing.median_s / ended if ended else None,
        "compile_s": timing.compile_s,
        "held_share": float(np.mean(outcome == MotionOutcome.HELD)),
        "failed": int(np.sum((outcome != MotionOutcome.FINISHED) & (outcome != MotionOutcome.HELD))),
    }


def contact_errors(found: Simulation, reference: Simulation, single: SingleContacts) -> Row:
    """Return errors of single contacts: median, 99 % and worst, of those that go straight through and those that turn.

    Args:
        found: the contacts, each the first of its tip.
        reference: the same contacts, more accurate.
        single: which of them turn.

    Returns:
        `turning_share`; `different`: contacts that end otherwise, or with another number of junctions; and the errors.
    """
    columns = [_first_contacts(each) for each in (found, reference)]
    (kind, junctions, rebound, left), (kind_of, junctions_of, rebound_of, left_of) = columns
    same = (kind == kind_of) & (junctions == junctions_of) & (kind_of == ContactKind.IMPACT)
    row: Row = {"turning_share": float(np.mean(single.turning)), "different": int(np.sum(~same))}
    for part, chosen in (("straight", same & ~single.turning), ("turning", same & single.turning)):
        if not chosen.any():
            continue
        errors = {
            "rebound_error": np.abs(rebound[chosen] / rebound_of[chosen] - 1.0),
            "time_error_us": np.abs(left[chosen] - left_of[chosen]),
        }
        for column, values in errors.items():
            shares = {"median": 50.0, "99": 99.0, "worst": 100.0}
            row |= {f"{part}_{column}_{key}": float(np.percentile(values, at)) for key, at in shares.items()}
    return row


def _first_contacts(found: Simulation) -> list[np.ndarray]:
    contacts = found.contacts
    assert contacts.detail is not None  # resolved contacts have details  # noqa: S101
    columns = (
        contacts.kind,
        contacts.detail.junctions,
        contacts.rebound_speed_nm_per_us,
        contacts.departure_time_us,
    )
    return [np.asarray(column)[:, 0] for column in columns]


def _long(name: str, scene: Scene, periods: int, repetitions: int) -> Row:
    """Measure one long motion as a caller of `simulate` sees it."""
    progress(f"bench: scenes, {name}, one tip for {periods} drive periods")
    starts = spread_starts(scene, 1)
    start, duration = State(*(part[0] for part in starts)), periods * float(scene.platform.period_us)
    calls = time_calls(lambda: simulate(scene, start, duration), repetitions=repetitions)
    motion: Simulation = calls.result
    contacts = int(motion.count)
    return {
        "what": f"one tip, {periods} drive periods",
        "scene": name,
        "batch": 1,
        "periods": periods,
        "contacts": contacts,
        "seconds": calls.best_s,
        "microseconds_per_contact": 1e6 * calls.best_s / max(contacts, 1),
        "compile_s": calls.compile_s,
        "held_share": float(motion.held),
        "failed": int(int(motion.outcome) not in {MotionOutcome.FINISHED, MotionOutcome.HELD}),
    }


def aims(rows: Sequence[Row]) -> list[tuple[str, float | None, float]]:
    """Return what was aimed at: name, reached (None if not measured), largest allowed."""
    wanted: list[tuple[str, float | None, float]] = []
    for scene in dict.fromkeys(row["scene"] for row in rows):
        by_name = {row["what"]: row for row in rows if row["scene"] == scene}
        quick = by_name.get(f"bouncing tips, accuracy {AIMED_ACCURACY:g}", {})
        wanted.append((f"driven contact, {scene}, us at 1e-6", quick.get("microseconds_per_contact"), 12.0))
        for part in ("straight", "turning"):
            if f"{part}_rebound_error_99" not in quick:
                continue
            errors = (quick[f"{part}_rebound_error_99"], quick[f"{part}_time_error_us_99"])
            wanted += [
                (f"driven contact, {scene}, {part}, 99 % of rebound errors at 1e-6", errors[0], AIMED_ACCURACY),
                (f"driven contact, {scene}, {part}, 99 % of time errors, us", errors[1], 0.1 * AIMED_ACCURACY),
            ]
        long = next((row for what, row in by_name.items() if what.startswith("one tip")), None)
        if long is not None and long["periods"] == 1000:
            wanted.append((f"1000 drive periods, {scene}, seconds", long["seconds"], 1.0))
    return wanted
