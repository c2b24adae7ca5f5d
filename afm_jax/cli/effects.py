"""`afm-jax effects SCENE.toml|PRESET`: what each effect of a scene changes and costs."""

from dataclasses import replace
from pathlib import Path
from typing import Annotated

from afm_jax.cli.command import Output
from afm_jax.cli.scenes import NamedScene
from afm_jax.cli.session import Session
from afm_jax.cli.values import Names, Positive, Share
from afm_jax.motion.start import default_start, start_of
from afm_jax.saved import as_json
from afm_jax.scenefile.scenefile import as_in_file, save_scene
from afm_jax.studies.effects import study_effects
from afm_jax.whole_files import check_plain


def effects(
    session: Session,
    scene: NamedScene,
    *,
    accuracy: Annotated[float, Share()] = 0.01,
    duration_us: Positive | None = None,
    only: Annotated[tuple[str, ...] | None, Names(), "NAME,..."] = None,
) -> Output:
    """Say what each effect of a scene changes and costs.

    Each effect is left out in turn, and the steady motion is compared with that of the full scene: peak and lock-in
    amplitude, phase, energy lost per impact. All motions begin at the file's [start], or else at the scene's default
    one; a motion that does not repeat (a ramp, several frequencies, chaos) is refused. Costs are times to compute a
    drive period, the median of several runs. With --out effects.csv, effects.json, effects.png and reduced.toml: the
    scene, and its start, without the effects that the accuracy does not need.

    Args:
        session: for progress.
        scene: the scene.
        accuracy: wanted accuracy of the amplitudes, 1% or 0.01; the output names the effects that it does not need.
        duration_us: longest time to follow each scene, in us.
        only: the effects to study; else all.
    """
    start = scene.start or as_in_file(scene.scene, default_start(scene.scene))
    what = "simulating with and without each effect (every program compiles for some seconds)"
    with session.working(what, "scenes") as report:
        study = study_effects(
            scene.scene,
            start_of(scene.scene, start),
            accuracy=accuracy,
            duration_us=duration_us,
            only=only,
            report=report,
        )

    def write_reduced(path: Path) -> None:
        check_plain(path)
        save_scene(study.reduced, path, start=start)

    output = Output.of(study, "effects", payload=as_json(study) | {"start": start._asdict()})
    return replace(output, files={**output.files, "reduced.toml": write_reduced})
