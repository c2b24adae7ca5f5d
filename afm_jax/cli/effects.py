"""`afm-jax effects SCENE.toml|PRESET`: what each effect of a scene changes and costs."""

import math
from pathlib import Path
from typing import TYPE_CHECKING

import click

from afm_jax.cli.session import Session, with_session
from afm_jax.cli.values import Finite, SceneName, Share

if TYPE_CHECKING:
    from afm_jax.effects.study import EffectStudy
    from afm_jax.scenefile.scenefile import Start


@click.command()
@click.argument("scene", metavar="SCENE.toml|PRESET", type=SceneName())
@click.option(
    "--accuracy",
    type=Share(),
    default="1%",
    show_default=True,
    help="Wanted accuracy of the amplitudes, 1% or 0.01: which effects does it not need?",
)
@click.option("--duration-us", type=Finite(), metavar="T", help="How long to follow each scene at most, in us.")
@click.option("--only", metavar="NAME,...", help="The effects to look at; all if left out.")
@click.option(
    "--write",
    metavar="FILE",
    type=click.Path(path_type=Path, dir_okay=False),
    help="Save the scene without what the accuracy does not need, and its start, as a scene file.",
)
@with_session
def command(
    session: Session, *, scene: str, accuracy: float, duration_us: float | None, only: str | None, write: Path | None
) -> None:
    """Say what each effect of a scene changes and costs.

    Each effect is left out, absent from the program, and the steady motion compared with that of the full scene: peak
    and lock-in amplitude, phase, energy lost per impact. All motions begin at the file's [start], or else at the
    scene's default one. Where nothing repeats (a ramp, several frequencies) the last fifth of the duration is compared.
    Costs are processor time of a drive period and operations of the compiled program. With --out effects.csv,
    effects.json and effects.png.
    """
    if duration_us is not None and not (duration_us > 0.0 and math.isfinite(duration_us)):
        raise click.UsageError(f"--duration-us must be a positive number, but is {duration_us:g}")
    if write is not None and not write.absolute().parent.is_dir():
        raise click.UsageError(f"--write {write}: there is no folder {write.absolute().parent}; choose another place")
    session.start_computing()
    from afm_jax.cli.effects_output import payload_of, text_of, write_files  # noqa: PLC0415
    from afm_jax.scenefile.scenefile import save_scene  # noqa: PLC0415

    names = None if only is None else [name.strip() for name in only.split(",")]
    try:
        study, start = _studied(session, scene, accuracy, duration_us, names)
    except ValueError as error:
        message = str(error)
        raise ValueError(message if message.startswith(scene) else f"{scene}: {message}") from error
    if write is not None and study.reduction is not None:
        save_scene(study.reduction.scene, write, start=start)
        session.note(f"wrote {write}")
    payload = payload_of(study, start, written=write)
    if session.out is not None:
        write_files(session, payload)
    session.emit(payload, *text_of(payload))


def _studied(
    session: Session, name: str, accuracy: float, duration_us: float | None, only: list[str] | None
) -> "tuple[EffectStudy, Start]":
    """Return the study of a scene, and the start it was made from; what is being done goes to standard error."""
    from afm_jax.cli.values import scene_and_start  # noqa: PLC0415
    from afm_jax.effects.study import study_effects  # noqa: PLC0415
    from afm_jax.motion.start import default_start, start_of  # noqa: PLC0415
    from afm_jax.scenefile.scenefile import as_in_file  # noqa: PLC0415

    scene, start = scene_and_start(name)
    told = "simulating with and without each effect (every program compiles for some seconds)"
    with session.working(told, "scenes") as report:
        if start is None:
            start = as_in_file(scene, default_start(scene))
        study = study_effects(
            scene,
            start_of(scene, start),
            duration_us=duration_us,
            accuracy=accuracy,
            only=only,
            report=report,
        )
    return study, start
