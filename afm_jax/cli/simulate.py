"""`afm-jax simulate SCENE.toml|PRESET`: a scene in time, and what an experiment reads of it."""

from typing import Any

from afm_jax.apparatus.scene import Scene, drive_of
from afm_jax.cli.columns import columns_of
from afm_jax.cli.command import NamedScene, Output, later
from afm_jax.cli.commands.simulate import DEFAULT_PERIODS
from afm_jax.cli.session import Session
from afm_jax.cli.simulate_output import contact_rows, payload_of, stretch_written, text_of, trajectory_rows, write_trace
from afm_jax.impact.law import extrapolation_of
from afm_jax.motion.follow import LongRun, follow_long
from afm_jax.motion.observe import observe
from afm_jax.motion.record import MotionOutcome
from afm_jax.motion.settle import window_of
from afm_jax.motion.start import start_of
from afm_jax.motion.trajectory import DensePath, dense_path

draw_motion = later("afm_jax.plots.motion:draw_motion")
stretch_drawn = later("afm_jax.plots.motion:stretch_drawn")

LARGEST_OFFSET_NM = 10_000.0
"""How far a ramp may take the sample from the tip's rest position, either way."""
MOST_OSCILLATIONS = 1e7
"""Of the free tip: some minutes of computing."""


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
) -> Output:
    """Return a scene followed in time, and what an instrument reads of it."""
    until_settled = until_settled or (duration_us is None and periods is None)
    period_us = drive_of(scene.scene).period_us
    longest = duration_us if duration_us is not None else (periods or DEFAULT_PERIODS) * period_us
    _check_ramp(scene.scene, longest)
    _check_length(scene.scene, longest)
    settings = {"accuracy": accuracy, "method": method, "until_settled": until_settled}
    run = _follow(session, scene, longest, settings)
    with session.working("reading amplitudes"):
        dense = _dense(scene.scene, run, to_files=session.out is not None)
        seen = observe(scene.scene, run.simulation, harmonics=harmonics, verdict=run.verdict, dense=dense)
    payload = payload_of(scene.scene, run, seen, settings | {"longest_us": longest, "pieces": run.pieces})
    speeds = run.simulation.contacts.approach_speed_nm_per_us
    extrapolated = payload["extrapolated"] = extrapolation_of(scene.scene.interaction, speeds)
    if extrapolated is None:
        payload["null_reasons"]["extrapolated"] = "No impact is faster or slower than the law is known for."
    tables = {}
    if session.out is not None:
        stretch = stretch_written(run.simulation, seen.window)
        tables["contacts.csv"] = columns_of(*contact_rows(run.simulation))
        tables["trajectory.csv"] = columns_of(*trajectory_rows(dense, *stretch))

    def report(folder: Any, _: Any) -> Any:
        if samples:
            write_trace(session, scene.scene, run, seen.window)
        return draw_motion(scene.scene, run.simulation, folder, verdict=run.verdict, dense=dense)

    return Output(
        payload=payload,
        text=[*text_of(payload), extrapolated],
        tables=tables,
        json_file="simulate.json",
        report=report,
        not_valid=None if payload["valid"] else payload["outcome"],
    )


def _check_ramp(scene: Scene, duration_us: float) -> None:
    """Check that the ramp of the offset stays where a cantilever can be.

    Raises:
        ValueError: if it leaves that range.
    """
    rate = float(scene.platform.offset_rate_nm_per_us)
    end = float(scene.platform.offset_nm) + rate * duration_us
    if rate != 0.0 and not abs(end) <= LARGEST_OFFSET_NM:
        raise ValueError(
            f"after {duration_us:.6g} us the ramp of `offset_rate_nm_per_us` = {rate:g} has taken the offset to "
            f"{end:.6g} nm, out of the range of {LARGEST_OFFSET_NM:g} nm: simulate a shorter time or ramp slower"
        )


def _check_length(scene: Scene, duration_us: float) -> None:
    """Check that a duration can be followed.

    Raises:
        ValueError: if the tip would oscillate too often in it.
    """
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
        stretches.append(stretch_written(run.simulation, window))
        stretches.append(stretch_drawn(scene, run.simulation, run.verdict))
    begin, end = zip(*stretches, strict=True)
    return dense_path(scene, run.simulation, min(begin), max(end))
