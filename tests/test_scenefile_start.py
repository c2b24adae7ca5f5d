"""The start of a scene file: kept exactly."""

from pathlib import Path

import numpy as np
import pytest

from afm_jax import load_scene, save_scene
from afm_jax.scenefile.scenefile import Start, read_scene

HEAD = (
    "[cantilever]\nfrequency_khz = 90\n[platform]\namplitude_nm = 4\nfrequency_khz = 180\noffset_rate_nm_per_us = 0.5\n"
)
INTERACTIONS = {"law": 'model = "law"\nr = 0.9\n', "contact": 'model = "contact"\n', "none": 'model = "none"\n'}
# beta omega, with the ramp, where the platform moves up and down fastest: phase 270 and 90 degrees
UP, DOWN = 0.5 + 4 * 2e-3 * np.pi * 180, 0.5 - 4 * 2e-3 * np.pi * 180


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "scene.toml"


def write(path: Path, interaction: str, start: Start) -> None:
    lines = "".join(f"{key} = {value!r}\n" for key, value in start._asdict().items())
    path.write_text(f"{HEAD}[interaction]\n{INTERACTIONS[interaction]}[start]\n{lines}", encoding="utf-8")


GOOD = [
    ("law", Start(270.0, 5.0, -80.0)),
    ("law", Start(270.0, 0.0, UP + 1e-6)),
    ("law", Start(90.0 + 720.0, 0.0, DOWN + 1e-6)),
    ("contact", Start(-90.0, 0.1237, -40.0)),
    ("none", Start(0.1, -70.3, -1e3)),
]


@pytest.mark.parametrize(("interaction", "start"), GOOD)
def test_loop_is_exact(path: Path, interaction: str, start: Start):
    write(path, interaction, start)
    assert read_scene(path).start == start
    scene = load_scene(path)
    path.unlink()
    save_scene(scene, path, start=start)
    assert read_scene(path).start == start
    save_scene(scene, path)
    assert read_scene(path).start is None
