"""`afm-jax simulate SCENE.toml|PRESET`: a scene in time, and what an experiment reads of it."""

import math
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np

from afm_jax.apparatus.scene import Scene, drive_of
from afm_jax.cli.approach_curve import NOISE, PHASE_NOISE_DEG, approach
from afm_jax.cli.command import Output, later
from afm_jax.cli.motion_table import MotionTable
from afm_jax.cli.scenes import NamedScene
from afm_jax.cli.session import Session
from afm_jax.cli.values import Course, Orders, Positive, Share
from afm_jax.columns import csv_columns
from afm_jax.motion.follow import follow_long
from afm_jax.motion.observe import observe
from afm_jax.motion.record import MotionOutcome
from afm_jax.motion.settle import Window
from afm_jax.motion.start import start_of
from afm_jax.motion.trajectory import DensePath
from afm_jax.saved import as_json
from afm_jax.units import RAD_PER_US_PER_KHZ

draw_motion = later("afm_jax.plots.motion:draw_motion")

_MOST_PERIODS = 2000
"""Drive periods followed at most where no duration is given."""
MOST_OSCILLATIONS = 1e7
"""Oscillations of the free tip or the drive that are followed at most: some minutes of computing."""
_TRACE_RESPONSES = 24
"""Response periods of trace.csv at most: enough for an instrument's errors from their scatter."""
_SAMPLES_A_PERIOD = 400
"""Samples of trace.csv in a drive period."""


def simulation(  # noqa: PLR0913
    session: Session,
    scene: NamedScene,
    *,
    heights: Annotated[tuple[float, ...] | None, Course(), "FROM:TO:COUNT"] = None,
    duration_us: Positive | None = None,
    periods: Positive | None = None,
    harmonics: Annotated[tuple[int, ...], Orders()] = (1,),
    accuracy: Positive = 1e-9,
    samples: Literal["uniform"] | None = None,
    noise: Annotated[float | None, Share("a relative error")] = None,
    phase_noise_deg: Positive | None = None,
) -> Output:
    """Follow a scene in time: contacts, amplitudes, phases, forces, energies.

    SCENE.toml is a scene file, PRESET the name of one of the paper's scenes (figure2, figure8, ...). The tip starts at
    the file's [start]; without one on the single-impact orbit that the law with delay predicts, if there is one.
    Amplitudes are read over the last response period if the motion has settled, else over the last fifth of the time:
    at the drive's frequency, and at the response's, which is 1/N of it if the motion repeats after N drive periods.
    With --out contacts.csv, trajectory.csv, simulate.json and pictures. A tip that sticks, or does not settle, is a
    result; exit code 3 if the simulation broke off.

    With --heights the cantilever is driven by [force] or [base], and the sample moves through heights over its rest
    position and back. The output is amplitude and lag against height; at each height the motion is followed from the
    one before until it settles (--periods at most). With --out curve.csv, with noise, as `afm-jax tapping` reads it;
    curve_points.csv, without noise; curve.json and curve.png. Exit code 3 if the tip settles at no height.

    Args:
        session: for progress and files.
        scene: the scene.
        heights: record an approach curve, both ways: heights of the sample in nm, negative below the rest position.
        duration_us: time to follow the scene, in us.
        periods: the same in periods of the drive. Without either the simulation ends when the motion has settled, or
            after 2000 periods.
        harmonics: multiples of the response frequency omega/N at which amplitude and phase are read; else 1; they
            are always read at the drive's.
        accuracy: relative accuracy of the rebound speed of every resolved contact.
        samples: write trace.csv into --out, too: the deflection over the last response periods at equal steps of time,
            as `afm-jax lockin` reads it.
        noise: with --heights: noise of the amplitudes in curve.csv; else 0.3%.
        phase_noise_deg: with --heights: noise of the lags in curve.csv; else 0.2.
    """
    if heights is not None:
        settings = {"longest_periods": periods and math.ceil(periods), "accuracy": accuracy}
        errors = {"noise": noise or NOISE, "phase_noise_deg": phase_noise_deg or PHASE_NOISE_DEG}
        return approach(session, scene, heights, settings, errors)
    until_settled = duration_us is None and periods is None
    period_us = drive_of(scene.scene).period_us
    longest = duration_us if duration_us is not None else (periods or _MOST_PERIODS) * period_us
    _check_duration(scene.scene, longest)
    settings = {"accuracy": accuracy, "until_settled": until_settled}
    start, parts = start_of(scene.scene, scene.start), "us at most" if until_settled else "us"
    begin_us = float(start.time_us)
    with session.working("simulating (the first run compiles for some seconds)", parts) as tell:

        def report_time(time_us: float, _: Any) -> None:
            tell(round(time_us - begin_us), round(longest))

        run = follow_long(scene.scene, start, longest, report=report_time, **settings)
    if int(run.simulation.outcome) == MotionOutcome.INVALID_START:
        raise ValueError("the tip cannot start there: the start is not finite, or inside the sample")
    with session.working("reading amplitudes"):
        dense = DensePath(scene.scene, run.simulation)
        seen = observe(scene.scene, run.simulation, harmonics=harmonics, verdict=run.verdict, dense=dense)
    told = MotionTable(run, seen, dense, settings | {"longest_us": longest, "pieces": run.pieces})

    def report(folder: Path) -> Any:
        for name, columns in csv_columns(told).items():
            session.write_columns(name, columns)
        if samples:
            _write_trace(session, dense, seen.window)
        return draw_motion(scene.scene, run.simulation, folder, verdict=run.verdict, dense=dense)

    return Output.of(told, payload=as_json(told), json_file="simulate.json", report=report)


def _check_duration(scene: Scene, duration_us: float) -> None:
    """Check that a scene can be followed for so long.

    Raises:
        ValueError: if the tip would oscillate too often.
    """
    frequencies = {"tip": float(scene.cantilever.frequency_khz), "drive": 1e3 / drive_of(scene).period_us}
    for what, frequency_khz in frequencies.items():
        oscillations = frequency_khz * 1e-3 * duration_us
        if not oscillations <= MOST_OSCILLATIONS:
            raise ValueError(
                f"in {duration_us:.6g} us the {what} would oscillate {oscillations:.3g} times, more than the "
                f"{MOST_OSCILLATIONS:g} that can be followed: give a shorter --duration-us or fewer --periods"
            )


def _write_trace(session: Session, dense: DensePath, window: Window) -> None:
    """Write trace.csv, the deflection over the last response periods at equal steps of time, into the `--out` folder.

    Args:
        session: whose folder.
        dense: the tip.
        window: of the observables; how long a response period is, and the end of the trace.
    """
    scene, drive = dense.scene, drive_of(dense.scene)
    response = window.periods * drive.period_us
    responses = min((window.to_us - float(dense.simulation.start.time_us)) / response, _TRACE_RESPONSES)
    begin = window.to_us - responses * response
    count = math.ceil(responses * window.periods * _SAMPLES_A_PERIOD)
    times = np.linspace(begin, window.to_us, count, endpoint=False)
    columns = {"time_us": times, "deflection_nm": dense.at(times).position_nm}
    if scene.base is not None:
        columns["drive"] = np.asarray(scene.base.position_and_velocity(times)[0])
        columns["deflection_nm"] = columns["deflection_nm"] - columns["drive"]
    elif scene.force is not None:
        columns["drive"] = np.asarray(scene.force.force(times))
    else:
        columns["platform_nm"] = np.asarray(scene.platform.position(times))
    session.write_columns(
        "trace.csv", columns, [f"drive_frequency_khz = {float(drive.angular_frequency / RAD_PER_US_PER_KHZ)!r}"]
    )
