"""What `afm-jax simulate` hands out: the JSON object, the text, the files."""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from afm_jax.apparatus.scene import DrivePeriod, Scene, drive_of
from afm_jax.cli.session import Session
from afm_jax.contact.junction import Phase
from afm_jax.motion.follow import LongRun
from afm_jax.motion.observe import OBSERVABLES, Observables, why_absent
from afm_jax.motion.record import ContactKind, MotionOutcome, Simulation
from afm_jax.motion.settle import Window
from afm_jax.motion.trajectory import DensePath, dense_path
from afm_jax.scenefile.scenefile import scene_tables
from afm_jax.units import RAD_PER_US_PER_KHZ

_WHOLE_PERIODS = 50
"""Drive periods up to which the whole simulation goes into trajectory.csv."""
_POINTS = 2001
_MOST_NODES = 100_000
"""Rows of trajectory.csv within contacts, from which on only every second, third, ... is kept."""
_TRACE_RESPONSES = 24
"""Response periods of trace.csv at most: enough for an instrument's errors from their scatter."""
_SAMPLES_A_PERIOD = 400
"""Of the drive."""


def payload_of(scene: Scene, run: LongRun, seen: Observables, settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return the JSON object of a simulation."""
    simulation, verdict = run.simulation, run.verdict
    outcome = MotionOutcome(int(simulation.outcome))
    final = simulation.final
    return {
        "impacts": int(simulation.count),
        "stuck": verdict.stuck,
        "settled": verdict.settled,
        "order": verdict.periods,
        "contacts_per_response": verdict.contacts,
        "settled_reason": verdict.reason,
        "remaining_distance": verdict.remaining,
        **{observable.name: getattr(seen, observable.name) for observable in OBSERVABLES},
        "drive_frequency_khz": seen.drive_frequency_khz,
        "response_frequency_khz": seen.response_frequency_khz,
        "harmonics": [harmonic._asdict() for harmonic in seen.harmonics],
        "deflection_harmonics": seen.deflection_harmonics and [each._asdict() for each in seen.deflection_harmonics],
        "window": {**seen.window._asdict(), "contacts": seen.contacts},
        "null_reasons": _reasons(scene, seen),
        "start": {name: float(value) for name, value in simulation.start._asdict().items()},
        "final": {
            **{name: float(value) for name, value in final._asdict().items()},
            "phase": Phase(int(simulation.phase)).name.lower(),
        },
        "outcome": outcome.sentence,
        "valid": outcome in (MotionOutcome.FINISHED, MotionOutcome.HELD),
        "scene": scene_tables(scene),
        "settings": dict(settings),
    }


def _reasons(scene: Scene, seen: Observables) -> dict[str, str]:
    """Return for every key that is null why."""
    reasons, verdict = why_absent(scene, seen), seen.settled
    if verdict.periods is None:
        reasons["order"] = reasons["contacts_per_response"] = verdict.reason
    if verdict.remaining is None:
        reasons["remaining_distance"] = "the tip is held" if verdict.stuck else verdict.reason
    return reasons


def _frequency(payload: Mapping[str, Any], multiple: int) -> str:
    """Return the name of a multiple of the response frequency, with its value."""
    order = payload["window"]["periods"]
    khz = f"{multiple * payload['drive_frequency_khz'] / order:.6g} kHz"
    if multiple == order:
        return f"the drive's frequency ({khz})"
    if multiple == 1:
        return f"the response frequency ({khz}, 1/{order} of the drive's)"
    if multiple % order == 0:
        return f"{multiple // order} times the drive's frequency ({khz})"
    return f"{multiple} times the response frequency ({khz}, {multiple}/{order} of the drive's)"


def _lockin_lines(payload: Mapping[str, Any]) -> list[str]:
    """Return what a lock-in reads of the height: at the drive's frequency, the response's, and those asked for."""
    order = payload["window"]["periods"]
    read = {each["multiple"]: (each["amplitude_nm"], each["phase_deg"]) for each in payload["harmonics"]}
    read[1] = payload["lockin_amplitude_nm"], payload["lockin_phase_deg"]
    read[order] = payload["drive_lockin_amplitude_nm"], payload["drive_lockin_phase_deg"]
    first = (order, 1) if payload["phase_lag_deg"] is not None else (1, order)
    return [
        f"At {_frequency(payload, multiple)}: {read[multiple][0]:.6g} nm, {read[multiple][1]:.6g} deg."
        for multiple in dict.fromkeys((*first, *read))
    ]


def _over_a_response(payload: Mapping[str, Any]) -> list[str]:
    """Return the lines of what is read over whole response periods."""
    lines, order = _lockin_lines(payload), payload["window"]["periods"]
    if payload["peak_deflection_nm"] is not None:
        at = {
            _frequency(payload, order): "deflection_drive_lockin",
            _frequency(payload, 1): "deflection_lockin",
        }
        read = (
            f"at {where} {payload[f'{key}_amplitude_nm']:.6g} nm, {payload[f'{key}_phase_deg']:.6g} deg"
            for where, key in at.items()
        )
        lines.append(
            f"Against the moving base: peak deflection {payload['peak_deflection_nm']:.6g} nm; {'; '.join(read)}."
        )
    if payload["phase_lag_deg"] is not None:
        what = (
            "the height behind the force" if payload["peak_deflection_nm"] is None else "the deflection behind the base"
        )
        lines.append(f"Phase lag of {what} at the drive's frequency: {payload['phase_lag_deg']:.6g} deg.")
    if payload["peak_force_nn"] is not None:
        lines.append(
            f"In contact for {payload['time_in_contact_us']:.4g} us of a response period "
            f"({100.0 * payload['contact_share']:.3g} %); forces from {payload['most_attractive_force_nn']:.4g} to "
            f"{payload['peak_force_nn']:.4g} nN."
        )
    lines.append(
        f"Energy of a drive period: {payload['given_by_drives_aj']:.5g} aJ given; "
        f"{payload['dissipated_in_air_aj']:.5g} taken by air, {payload['dissipated_in_contact_aj']:.5g} by the sample."
    )
    return lines


def text_of(payload: Mapping[str, Any]) -> list[str]:
    """Return a short summary of a simulation, a line each."""
    final, window = payload["final"], payload["window"]
    head = "Settled" if payload["settled"] else "Not settled"
    plural = "" if payload["impacts"] == 1 else "s"
    lines = [
        f"{payload['impacts']} contact{plural} from {payload['start']['time_us']:.6g} to {final['time_us']:.6g} us.",
        f"{head}: {payload['settled_reason']}.",
    ]
    mean = f"mean height {payload['mean_height_nm']:.6g} nm, " if window["responses"] else ""
    lines.append(
        f"Peak amplitude {payload['peak_amplitude_nm']:.6g} nm, {mean}"
        f"from {window['from_us']:.6g} to {window['to_us']:.6g} us."
    )
    if window["responses"]:
        lines += _over_a_response(payload)
    else:
        lines.append(
            "Less than a response period: means, energies, amplitudes and phases would be of a part; "
            "follow the motion longer."
        )
    lines.append(
        f"At the end: {final['position_nm']:.6g} nm, {final['velocity_nm_per_us']:.6g} nm/us, {final['phase']}"
        f"{'; the sample holds the tip' if payload['stuck'] else ''}."
    )
    return lines


def contact_rows(simulation: Simulation) -> tuple[list[dict[str, Any]], list[str]]:
    """Return all contacts as rows, and their columns; times of what did not happen are None."""
    contacts = simulation.contacts
    table = {name: value for name, value in contacts._asdict().items() if name != "detail"}
    if contacts.detail is not None:
        table |= contacts.detail._asdict()
    lists = {name: np.asarray(column)[: int(simulation.count)].tolist() for name, column in table.items()}
    rows = [dict(zip(lists, values, strict=True)) for values in zip(*lists.values(), strict=True)]
    for row in rows:
        kind = row["kind"] = ContactKind(row["kind"]).name.lower()
        if kind == "held":
            row.update(dict.fromkeys((name for name in row if name.startswith(("departure", "rebound"))), None))
        if not row.get("junctions", 1):
            row.update(junction_forms_us=None, junction_breaks_us=None)
    return rows, list(lists)


def stretch_written(simulation: Simulation, window: Window) -> tuple[float, float]:
    """Return from when to when, in us, the tip is written down: a short simulation, else the window of observables."""
    first, last = float(simulation.start.time_us), float(simulation.final.time_us)
    period = (window.to_us - window.from_us) / max(window.periods * window.responses, 1)
    short = last - first <= _WHOLE_PERIODS * period
    return (first, last) if short else (window.from_us, window.to_us)


def trajectory_rows(dense: DensePath, begin: float, end: float) -> tuple[list[dict[str, Any]], list[str]]:
    """Return the tip between two times in us as rows, and their columns; dense in contacts."""
    inner, _ = dense.nodes(begin, end)
    # a tip that is held rings through the whole stretch
    inner = inner[:: math.ceil((inner.size + 1) / _MOST_NODES)]
    path = dense.at(np.union1d(np.linspace(begin, end, _POINTS), inner))
    lists = {name: value.tolist() for name, value in path._asdict().items()}
    rows = [dict(zip(lists, values, strict=True)) for values in zip(*lists.values(), strict=True)]
    for row in rows:
        row["phase"] = Phase(row["phase"]).name.lower()
    return rows, list(lists)


def write_trace(session: Session, scene: Scene, run: LongRun, window: Window) -> None:
    """Write trace.csv, the deflection over the last response periods at equal steps of time, into the `--out` folder.

    Args:
        session: whose folder.
        scene: the scene.
        run: its simulation.
        window: of the observables; how long a response period is, and the end of the trace.
    """
    drive = drive_of(scene)
    response = window.periods * drive.period_us
    responses = min((window.to_us - float(run.simulation.start.time_us)) / response, _TRACE_RESPONSES)
    begin = window.to_us - responses * response
    count = math.ceil(responses * window.periods * _SAMPLES_A_PERIOD)
    path = dense_path(scene, run.simulation, begin, window.to_us)
    times = np.linspace(begin, window.to_us, count, endpoint=False)
    deflection = path.at(times).position_nm
    columns = {"time_us": times, "deflection_nm": deflection}
    if scene.base is not None:
        columns["drive"] = np.asarray(scene.base.position_and_velocity(times)[0])
        columns["deflection_nm"] = deflection - columns["drive"]
    elif scene.force is not None:
        columns["drive"] = np.asarray(scene.force.force(times))
    else:
        columns["platform_nm"] = np.asarray(scene.platform.position(times))
    session.write_columns("trace.csv", columns, _trace_comments(scene, drive))


def _trace_comments(scene: Scene, drive: DrivePeriod) -> list[str]:
    """Return what a trace says of its measurement, a setting each."""
    cantilever, platform = scene.cantilever, scene.platform
    known = {"drive_frequency_khz": drive.angular_frequency / RAD_PER_US_PER_KHZ}
    if scene.base is None and scene.force is None and drive.aperiodic is None and platform.second is None:
        known |= {"drive_amplitude_nm": platform.amplitude_nm, "offset_nm": platform.offset_nm}
    known |= {"free_frequency_khz": cantilever.frequency_khz, "mass_ng": cantilever.mass_ng}
    if cantilever.quality_factor is not None:
        known["quality_factor"] = cantilever.quality_factor
    damping = ["quality_factor = none"] if cantilever.quality_factor is None else []
    return [*(f"{name} = {float(value)!r}" for name, value in known.items()), *damping]
