"""`afm-jax effects SCENE.toml|PRESET`: what each effect of a scene changes and costs."""

from pathlib import Path

from afm_jax.cli.command import NamedScene, Output, picture_of
from afm_jax.cli.session import Session
from afm_jax.effects.effect_table import EffectTable
from afm_jax.effects.study import study_effects
from afm_jax.motion.start import default_start, start_of
from afm_jax.scenefile.scenefile import as_in_file, save_scene


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
    with session.working(
        "simulating with and without each effect (every program compiles for some seconds)", "scenes"
    ) as report:
        start = scene.start or as_in_file(scene.scene, default_start(scene.scene))
        study = study_effects(
            scene.scene,
            start_of(scene.scene, start),
            duration_us=duration_us,
            accuracy=accuracy,
            only=None if only is None else [name.strip() for name in only.split(",")],
            report=report,
        )
    table = EffectTable(study)
    told = table.to_dict() | {"start": start._asdict()}
    if write is not None and study.reduction is not None:
        save_scene(study.reduction.scene, write, start=start)
        session.note(f"wrote {write}")
        told["reduced"] = {**told["reduced"], "file": write}
    return Output(
        payload=told,
        text=table.printed(),
        tables=table.tables(),
        files={"effects.png": picture_of("effects:effects_figure", table)},
        json_file="effects.json",
    )
