"""The argument SCENE.toml|PRESET: a scene file, or one of the paper's scenes by its name."""

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from afm_jax.apparatus.scene import Scene
    from afm_jax.scenefile_start import Start


def scene_and_start(name: str) -> "tuple[Scene, Start | None]":
    """Return the scene that an argument names, and the start that comes with it; None where it is to be chosen.

    Args:
        name: a path, or a name of `afm_jax.presets.PRESETS` where there is no file of that name.

    Raises:
        ValueError: if there is neither such a file nor such a preset, or the file is no valid scene file.
    """
    from afm_jax.presets import PRESETS, preset, preset_start  # noqa: PLC0415
    from afm_jax.scenefile import load_scene_and_start  # noqa: PLC0415

    if Path(name).exists() or name.endswith(".toml") or len(Path(name).parts) > 1:
        return load_scene_and_start(name)
    if name not in PRESETS:
        raise ValueError(f"{name}: there is no such file or preset; presets are {', '.join(PRESETS)}")
    return preset(name), preset_start(name)
