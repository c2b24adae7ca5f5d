"""`afm-jax simulate SCENE.toml|PRESET`: a scene in time, and what an experiment reads of it."""

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from afm_jax.cli.main import NotValid
from afm_jax.cli.options import LAW
from afm_jax.cli.session import Session, with_session
from afm_jax.cli.values import Finite, SceneName

METHODS = ("collocation", "diffrax")
"""Of `simulate`; said here as well, because the command's help must not wait for JAX."""

if TYPE_CHECKING:
    from afm_jax.apparatus.scene import Scene
    from afm_jax.motion.follow import LongRun
    from afm_jax.motion.trajectory import DensePath
    from afm_jax.scenefile.scenefile import Start

DEFAULT_PERIODS = 2000
"""Drive periods followed at most where no duration is given."""
LARGEST_OFFSET_NM = 10_000.0
"""How far a ramp may take the sample from the tip's rest position, either way."""
MOST_OSCILLATIONS = 1e7
"""Of the free tip: some minutes of computing."""
"""Pieces of a long run between two lines on standard error."""


class Multiples(click.ParamType):
    """Positive integers in a comma list."""

    name = "list"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[int, ...]:
        """Return the integers that a text says, without repetitions.

        Raises:
            click.BadParameter: if one is none, or not from 1 to 1000.
        """
        parts = [part.strip() for part in str(value).split(",")]
        if not all(part.isascii() and part.isdigit() and len(part) < 5 and 1 <= int(part) <= 1000 for part in parts):
            self.fail(f"must be integers from 1 to 1000 as in 1,2,3, but is {value}", param, ctx)
        return tuple(dict.fromkeys(int(part) for part in parts))


@click.command()
@click.argument("scene", metavar="SCENE.toml|PRESET", type=SceneName())
@click.option("--duration-us", type=Finite(), metavar="T", help="How long to follow the scene, in us.")
@click.option("--periods", type=Finite(), metavar="P", help="How long, in periods of the drive.")
@click.option(
    "--until-settled",
    is_flag=True,
    help=f"End when the motion has settled; at the latest after the duration, or {DEFAULT_PERIODS} drive periods. "
    "This is what happens without a duration.",
)
@click.option(
    "--harmonics",
    type=Multiples(),
    default="1",
    show_default=True,
    metavar="K,...",
    help="Multiples of the response frequency omega/N at which amplitude and phase are read, besides the drive's "
    "(N times it), which always is.",
)
@click.option(
    "--accuracy",
    type=Finite(positive=True),
    default=1e-9,
    show_default=True,
    help="Of every resolved contact: relative of the rebound speed.",
)
@click.option(
    "--method",
    type=click.Choice(METHODS),
    default=METHODS[0],
    show_default=True,
    help="The way through a resolved contact: leg by leg, or in time throughout with Diffrax's Dopri8 (slower).",
)
@click.option(
    "--samples",
    type=click.Choice(["uniform"]),
    help="Write trace.csv into --out, too: the deflection over the last response periods at equal steps of time, as "
    "`afm-jax lockin` reads it.",
)
@LAW
@with_session
def command(  # noqa: PLR0913
    session: Session,
    *,
    scene: str,
    duration_us: float | None,
    periods: float | None,
    until_settled: bool,
    harmonics: tuple[int, ...],
    accuracy: float,
    method: str,
    samples: str | None,
    law: Path | None,
) -> None:
    """Follow a scene in time: contacts, amplitudes, phases, forces, energies.

    SCENE.toml is a scene file, PRESET the name of one of the paper's scenes (figure2, figure8, ...). The start is the
    file's [start]; without one the tip starts on the single-impact orbit that the law with delay predicts, if there is
    one. Amplitudes are read over the last response period once the motion has settled, else over the last fifth, at the
    drive's frequency and at the response's, which is 1/N of it where the motion repeats after N drive periods. With
    --out contacts.csv, trajectory.csv, simulate.json and pictures. A tip that sticks, or does not settle, is a result;
    exit code 3 if the simulation broke off.
    """
    for name, value in (("--duration-us", duration_us), ("--periods", periods)):
        if value is not None and not (value > 0.0 and math.isfinite(value)):
            raise click.UsageError(f"{name} must be a positive number, but is {value:g}")
    if duration_us is not None and periods is not None:
        raise click.UsageError("--duration-us and --periods say the same: give one of them")
    if samples and session.out is None:
        raise click.UsageError("--samples writes a trace: say into which folder by --out DIR")
    session.start_computing()
    from afm_jax.apparatus.scene import drive_of  # noqa: PLC0415
    from afm_jax.cli.values import scene_and_start  # noqa: PLC0415
    from afm_jax.impact.law import extrapolation_of  # noqa: PLC0415
    from afm_jax.motion.observe import observe  # noqa: PLC0415

    loaded, told = scene_and_start(scene)
    from afm_jax.cli.fitted_law import with_fitted_law  # noqa: PLC0415

    loaded, _ = with_fitted_law(loaded, law)
    period = drive_of(loaded).period_us
    until_settled = until_settled or (duration_us is None and periods is None)
    longest = duration_us if duration_us is not None else (periods or DEFAULT_PERIODS) * period
    settings = {"accuracy": accuracy, "method": method, "until_settled": until_settled}
    try:
        _check_ramp(loaded, longest)
        _check_length(loaded, longest)
        run = _follow(session, loaded, told, longest, settings)
        with session.working("reading amplitudes"):
            dense = _dense(loaded, run, to_files=session.out is not None)
            seen = observe(loaded, run.simulation, harmonics=harmonics, verdict=run.verdict, dense=dense)
    except ValueError as error:
        raise ValueError(f"{scene}: {error}") from error
    from afm_jax.cli.simulate_output import payload_of, text_of, write_files, write_trace  # noqa: PLC0415

    settings = {
        "accuracy": accuracy,
        "method": method,
        "until_settled": until_settled,
        "longest_us": longest,
        "pieces": run.pieces,
    }
    payload = payload_of(loaded, run, seen, settings)
    beyond = extrapolation_of(loaded.interaction, run.simulation.contacts.approach_speed_nm_per_us)
    payload["extrapolated"] = beyond
    if beyond is None:
        payload["null_reasons"]["extrapolated"] = "No impact is faster or slower than the law is known for."
    if session.out is not None:
        write_files(session, run, seen, dense, payload)
        if samples:
            write_trace(session, loaded, run, seen.window)
        _draw(session, loaded, run, dense)
    session.emit(payload, *text_of(payload), beyond)
    if not payload["valid"]:
        raise NotValid(payload["outcome"])


def _check_ramp(scene: "Scene", duration_us: float) -> None:
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


def _check_length(scene: "Scene", duration_us: float) -> None:
    """Check that a duration can be followed.

    Raises:
        ValueError: if the tip would oscillate too often in it.
    """
    from afm_jax.apparatus.scene import drive_of  # noqa: PLC0415

    frequencies = {"tip": float(scene.cantilever.frequency_khz), "drive": 1e3 / drive_of(scene).period_us}
    for what, frequency_khz in frequencies.items():
        oscillations = frequency_khz * 1e-3 * duration_us
        if not oscillations <= MOST_OSCILLATIONS:
            raise ValueError(
                f"in {duration_us:.6g} us the {what} would oscillate {oscillations:.3g} times, more than the "
                f"{MOST_OSCILLATIONS:g} that can be followed: give a shorter --duration-us or fewer --periods"
            )


def _follow(
    session: Session,
    scene: "Scene",
    told: "Start | None",
    longest_us: float,
    settings: dict[str, Any],
) -> "LongRun":
    """Return the simulation; progress of long runs goes to standard error."""
    from afm_jax.motion.follow import follow_long  # noqa: PLC0415
    from afm_jax.motion.start import start_of  # noqa: PLC0415

    start = start_of(scene, told)
    begin_us, parts = float(start.time_us), "us at most" if settings["until_settled"] else "us"
    with session.working("simulating (the first run compiles for some seconds)", parts) as tell:
        run = follow_long(
            scene,
            start,
            longest_us,
            report=lambda time_us, _: tell(round(time_us - begin_us), round(longest_us)),
            **settings,
        )
    if int(run.simulation.outcome) == _invalid_start():
        raise ValueError("the tip cannot start there: the start is not finite, or inside the sample")
    return run


def _dense(scene: "Scene", run: "LongRun", *, to_files: bool) -> "DensePath":
    """Return the tip over all that is read, written and drawn of it: its contacts are integrated once more, once."""
    from afm_jax.motion.settle import window_of  # noqa: PLC0415
    from afm_jax.motion.trajectory import dense_path  # noqa: PLC0415

    window = window_of(scene, run.simulation, run.verdict)
    stretches = [(window.from_us, window.to_us)]
    if to_files:
        from afm_jax.cli.simulate_output import stretch_written  # noqa: PLC0415
        from afm_jax.plots.motion import stretch_drawn  # noqa: PLC0415

        stretches.append(stretch_written(run.simulation, window))
        stretches.append(stretch_drawn(scene, run.simulation, run.verdict))
    begin, end = zip(*stretches, strict=True)
    return dense_path(scene, run.simulation, min(begin), max(end))


def _invalid_start() -> int:
    from afm_jax.motion.record import MotionOutcome  # noqa: PLC0415

    return int(MotionOutcome.INVALID_START)


def _draw(session: Session, scene: "Scene", run: "LongRun", dense: "DensePath") -> None:
    """Draw the pictures of a simulation."""
    if session.out is None:
        return
    from afm_jax.plots.motion import draw_motion  # noqa: PLC0415

    for path in draw_motion(scene, run.simulation, session.out, verdict=run.verdict, dense=dense):
        session.note(f"wrote {path}")
