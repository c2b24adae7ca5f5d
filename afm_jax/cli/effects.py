"""`afm-jax effects SCENE.toml|PRESET`: what each effect of a scene changes and costs."""

from pathlib import Path

from afm_jax.cli.command import NamedScene, Output, picture_of
from afm_jax.cli.session import Session
from afm_jax.motion.start import default_start, start_of
from afm_jax.scenefile.scenefile import as_in_file, save_scene, scene_tables
from afm_jax.studies.effects import study_effects


def effects(
    session: Session,
    scene: NamedScene,
    *,
    accuracy: float,
    duration_us: float | None,
    only: str | None,
    write: Path | None,
) -> Output:
    """Return what each effect of a scene changes and costs; with ``write`` save the scene without the others."""
    start = scene.start or as_in_file(scene.scene, default_start(scene.scene))
    chosen = None if only is None else [name.strip() for name in only.split(",")]
    what = "simulating with and without each effect (every program compiles for some seconds)"
    with session.working(what, "scenes") as report:
        study = study_effects(
            scene.scene,
            start_of(scene.scene, start),
            accuracy=accuracy,
            duration_us=duration_us,
            only=chosen,
            report=report,
        )
    reduced = {"scene": scene_tables(study.reduction.scene), "file": write}
    payload = study.to_dict() | {"start": start._asdict()}
    payload["reduced"] |= reduced
    if write is not None:
        save_scene(study.reduction.scene, write, start=start)
        session.note(f"wrote {write}")
    return Output(
        payload=payload,
        text=study.printed(),
        tables=study.tables(),
        files={"effects.png": picture_of("effects:effects_figure", study)},
        json_file="effects.json",
    )
