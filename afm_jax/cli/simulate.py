"""`afm-jax simulate SCENE.toml|PRESET`: a scene in time, and what an experiment reads of it."""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from afm_jax.apparatus.scene import DrivePeriod, Scene, drive_of
from afm_jax.cli.approach_curve import NOISE, PHASE_NOISE_DEG, approach
from afm_jax.cli.command import NamedScene, Output, later
from afm_jax.cli.commands.simulate import DEFAULT_PERIODS
from afm_jax.cli.session import Session
from afm_jax.contact.junction import Phase
from afm_jax.impact.law import extrapolation_of
from afm_jax.motion.follow import LongRun, follow_long
from afm_jax.motion.observe import OBSERVABLES, Observables, observe, why_absent
from afm_jax.motion.record import ContactKind, MotionOutcome, Simulation
from afm_jax.motion.settle import Window, window_of
from afm_jax.motion.start import start_of
from afm_jax.motion.trajectory import DensePath, dense_path
from afm_jax.scenefile.scenefile import scene_tables
from afm_jax.units import RAD_PER_US_PER_KHZ

draw_motion = later("afm_jax.plots.motion:draw_motion")
stretch_drawn = later("afm_jax.plots.motion:stretch_drawn")

LARGEST_OFFSET_NM = 10_000.0
"""How far a ramp may take the sample from the tip's rest position, either way."""
MOST_OSCILLATIONS = 1e7
"""Oscillations of the free tip or the drive that are followed at most: some minutes of computing."""
_WHOLE_PERIODS = 50
"""Drive periods up to which the whole simulation goes into trajectory.csv."""
_POINTS = 2001
"""Rows of trajectory.csv at equal steps of time."""
_MOST_NODES = 100_000
"""Rows of trajectory.csv within contacts, from which on only every second, third, ... is kept."""
_TRACE_RESPONSES = 24
"""Response periods of trace.csv at most: enough for an instrument's errors from their scatter."""
_SAMPLES_A_PERIOD = 400
"""Samples of trace.csv in a drive period."""


def simulation(  # noqa: PLR0913
    session: Session,
    scene: NamedScene,
    *,
    duration_us: float | None,
    periods: float | None,
    until_settled: bool,
    harmonics: tuple[int, ...],
    accuracy: float,
    method: str,
    samples: str | None,
    heights: tuple[float, ...] | None,
    noise: float | None,
    phase_noise_deg: float | None,
) -> Output:
    """Return a scene followed in time, and what an instrument reads of it; with heights an approach curve."""
    if heights is not None:
        settings = {"longest_periods": periods and math.ceil(periods), "accuracy": accuracy, "method": method}
        errors = {"noise": noise or NOISE, "phase_noise_deg": phase_noise_deg or PHASE_NOISE_DEG}
        return approach(session, scene, heights, settings, errors)
    until_settled = until_settled or (duration_us is None and periods is None)
    period_us = drive_of(scene.scene).period_us
    longest = duration_us if duration_us is not None else (periods or DEFAULT_PERIODS) * period_us
    _check_duration(scene.scene, longest)
    settings = {"accuracy": accuracy, "method": method, "until_settled": until_settled}
    run = _follow(session, scene, longest, settings)
    with session.working("reading amplitudes"):
        dense = _dense(scene.scene, run, to_files=session.out is not None)
        seen = observe(scene.scene, run.simulation, harmonics=harmonics, verdict=run.verdict, dense=dense)
    payload = _payload(scene.scene, run, seen, settings | {"longest_us": longest, "pieces": run.pieces})
    speeds = run.simulation.contacts.approach_speed_nm_per_us
    extrapolated = payload["extrapolated"] = extrapolation_of(scene.scene.interaction, speeds)
    if extrapolated is None:
        payload["null_reasons"]["extrapolated"] = "No impact is faster or slower than the law is known for."
    tables = {}
    if session.out is not None:
        stretch = _stretch_written(run.simulation, seen.window)
        tables["contacts.csv"] = _contact_columns(run.simulation)
        tables["trajectory.csv"] = _trajectory_columns(dense, *stretch)

    def report(folder: Path, _: Any) -> Any:
        if samples:
            _write_trace(session, scene.scene, run, seen.window)
        return draw_motion(scene.scene, run.simulation, folder, verdict=run.verdict, dense=dense)

    return Output(
        payload=payload,
        text=[*text_of(payload), extrapolated],
        tables=tables,
        json_file="simulate.json",
        report=report,
        not_valid=None if payload["valid"] else payload["outcome"],
    )


def _check_duration(scene: Scene, duration_us: float) -> None:
    """Check that a scene can be followed for so long.

    Raises:
        ValueError: if the ramp of the offset leaves what a cantilever can reach, or the tip would oscillate too often.
    """
    rate = float(scene.platform.offset_rate_nm_per_us)
    end = float(scene.platform.offset_nm) + rate * duration_us
    if rate != 0.0 and not abs(end) <= LARGEST_OFFSET_NM:
        raise ValueError(
            f"after {duration_us:.6g} us the ramp of `offset_rate_nm_per_us` = {rate:g} has taken the offset to "
            f"{end:.6g} nm, out of the range of {LARGEST_OFFSET_NM:g} nm: simulate a shorter time or ramp slower"
        )
    frequencies = {"tip": float(scene.cantilever.frequency_khz), "drive": 1e3 / drive_of(scene).period_us}
    for what, frequency_khz in frequencies.items():
        oscillations = frequency_khz * 1e-3 * duration_us
        if not oscillations <= MOST_OSCILLATIONS:
            raise ValueError(
                f"in {duration_us:.6g} us the {what} would oscillate {oscillations:.3g} times, more than the "
                f"{MOST_OSCILLATIONS:g} that can be followed: give a shorter --duration-us or fewer --periods"
            )


def _follow(session: Session, scene: NamedScene, longest_us: float, settings: dict[str, Any]) -> LongRun:
    """Return the simulation; progress of long runs goes to standard error."""
    start = start_of(scene.scene, scene.start)
    begin_us, parts = float(start.time_us), "us at most" if settings["until_settled"] else "us"
    with session.working("simulating (the first run compiles for some seconds)", parts) as tell:
        run = follow_long(
            scene.scene,
            start,
            longest_us,
            report=lambda time_us, _: tell(round(time_us - begin_us), round(longest_us)),
            **settings,
        )
    if int(run.simulation.outcome) == MotionOutcome.INVALID_START:
        raise ValueError("the tip cannot start there: the start is not finite, or inside the sample")
    return run


def _dense(scene: Scene, run: LongRun, *, to_files: bool) -> DensePath:
    """Return the tip over all that is read, written and drawn of it: its contacts are integrated once more, once."""
    window = window_of(scene, run.simulation, run.verdict)
    stretches = [(window.from_us, window.to_us)]
    if to_files:
        stretches.append(_stretch_written(run.simulation, window))
        stretches.append(stretch_drawn(scene, run.simulation, run.verdict))
    begin, end = zip(*stretches, strict=True)
    return dense_path(scene, run.simulation, min(begin), max(end))


def _payload(scene: Scene, run: LongRun, seen: Observables, settings: Mapping[str, Any]) -> dict[str, Any]:
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


def _contact_columns(simulation: Simulation) -> dict[str, list[Any]]:
    """Return the columns of all contacts; times of what did not happen are None."""
    contacts = simulation.contacts
    table = {name: value for name, value in contacts._asdict().items() if name != "detail"}
    if contacts.detail is not None:
        table |= contacts.detail._asdict()
    columns = {name: np.asarray(column)[: int(simulation.count)].tolist() for name, column in table.items()}
    columns["kind"] = [ContactKind(kind).name.lower() for kind in columns["kind"]]
    left_again = [kind != "held" for kind in columns["kind"]]
    for name, values in columns.items():
        if name.startswith(("departure", "rebound")):
            happened = left_again
        elif name in ("junction_forms_us", "junction_breaks_us"):
            happened = columns["junctions"]
        else:
            continue
        columns[name] = [value if flag else None for value, flag in zip(values, happened, strict=True)]
    return columns


def _stretch_written(simulation: Simulation, window: Window) -> tuple[float, float]:
    """Return from when to when, in us, the tip is written down: a short simulation, else the window of observables."""
    first, last = float(simulation.start.time_us), float(simulation.final.time_us)
    period = (window.to_us - window.from_us) / max(window.periods * window.responses, 1)
    short = last - first <= _WHOLE_PERIODS * period
    return (first, last) if short else (window.from_us, window.to_us)


def _trajectory_columns(dense: DensePath, begin: float, end: float) -> dict[str, Any]:
    """Return the columns of the tip between two times in us; dense in contacts."""
    inner, _ = dense.nodes(begin, end)
    # a tip that is held rings through the whole stretch
    inner = inner[:: math.ceil((inner.size + 1) / _MOST_NODES)]
    columns = dense.at(np.union1d(np.linspace(begin, end, _POINTS), inner))._asdict()
    return columns | {"phase": [Phase(phase).name.lower() for phase in columns["phase"].tolist()]}


def _write_trace(session: Session, scene: Scene, run: LongRun, window: Window) -> None:
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
    settings = {"drive_frequency_khz": drive.angular_frequency / RAD_PER_US_PER_KHZ}
    if scene.base is None and scene.force is None and drive.aperiodic is None and platform.second is None:
        settings |= {"drive_amplitude_nm": platform.amplitude_nm, "offset_nm": platform.offset_nm}
    settings |= {"free_frequency_khz": cantilever.frequency_khz, "mass_ng": cantilever.mass_ng}
    if cantilever.quality_factor is not None:
        settings["quality_factor"] = cantilever.quality_factor
    damping = ["quality_factor = none"] if cantilever.quality_factor is None else []
    return [*(f"{name} = {float(value)!r}" for name, value in settings.items()), *damping]
