"""`afm-jax effects SCENE.toml|PRESET`: what each effect of a scene changes and costs."""

from pathlib import Path
from typing import Any

from afm_jax.cli.command import NamedScene, Output, picture_of
from afm_jax.cli.session import Session
from afm_jax.motion.start import default_start, start_of
from afm_jax.scenefile.scenefile import as_in_file, save_scene, scene_tables
from afm_jax.studies.effects import study_effects
from afm_jax.whole_files import check_plain


def effects(
    session: Session, scene: NamedScene, *, accuracy: float, duration_us: float | None, only: str | None
) -> Output:
    """Return what each effect of a scene changes and costs."""
    start = scene.start or as_in_file(scene.scene, default_start(scene.scene))
    chosen = None if only is None else [name.strip() for name in only.split(",")]
    settings: dict[str, Any] = {"accuracy": accuracy, "duration_us": duration_us, "only": chosen}
    what = "simulating with and without each effect (every program compiles for some seconds)"
    with session.working(what, "scenes") as report:
        study = study_effects(scene.scene, start_of(scene.scene, start), report=report, **settings)
    payload = study.to_dict() | {"start": start._asdict()}
    payload["reduced"]["scene"] = scene_tables(study.reduction.scene)

    def write_reduced(path: Path) -> None:
        check_plain(path)
        save_scene(study.reduction.scene, path, start=start)

    return Output(
        payload=payload,
        text=study.printed(),
        tables=study.tables(),
        files={"effects.png": picture_of("effects:effects_figure", study), "reduced.toml": write_reduced},
        json_file="effects.json",
    )
