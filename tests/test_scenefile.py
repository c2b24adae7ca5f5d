"""Scene files: every key is read, and the loop is exact; mistakes are lines of the corpus (`tests.malformed`)."""

import tomllib
from pathlib import Path

import equinox as eqx
import numpy as np
import pytest

from afm_jax import Cantilever, CollisionDelay, ImpactLaw, Platform, Scene, load_scene, save_scene

CANTILEVER = "[cantilever]\nfrequency_khz = 90\n"
PLATFORM = "[platform]\namplitude_nm = 4\nfrequency_khz = 181.8\n"
LAW = '[interaction]\nmodel = "law"\nr = 0.998\n'
DELAY = "[interaction.delay]\nhertz = 0.206\nlead_nm = 5.64\noffset_nm = 0.726\n"


@pytest.fixture
def written(tmp_path: Path):
    """Write a scene file and return its path."""

    def write(text: str | bytes) -> Path:
        path = tmp_path / "scene.toml"
        path.write_bytes(text if isinstance(text, bytes) else text.encode("utf-8"))
        return path

    return write


def test_reads_every_key_and_what_is_left_out_is_absent(written):
    scene = load_scene(
        written(
            "[cantilever]\nfrequency_khz = 90\nquality_factor = 40\nmass_ng = 1.5\n"
            "[platform]\namplitude_nm = 4\nfrequency_khz = 181.8\noffset_nm = -1\noffset_rate_nm_per_us = 1e-3\n"
            '[interaction]\nmodel = "law"\nr = 0.998\nepsilon = 122\nviscous_loss = 0.5\n' + DELAY
        )
    )
    law = ImpactLaw(r=0.998, epsilon=122.0, viscous_loss=0.5, delay=CollisionDelay(0.206, 5.64, 0.726))
    assert eqx.tree_equal(scene, Scene(Cantilever(90.0, 40.0, 1.5), Platform(4.0, 181.8, -1.0, 1e-3), law))
    # byte order mark and lines of Windows are no mistake
    text = (CANTILEVER + PLATFORM + LAW).replace("\n", "\r\n")
    scene = load_scene(written(b"\xef\xbb\xbf" + text.encode()))
    assert eqx.tree_equal(scene, Scene(Cantilever(90.0), Platform(4.0, 181.8), ImpactLaw(r=0.998)))


def test_a_delay_has_its_corrections_unless_they_are_left_out(written):
    for line, corrected in (("", True), ("corrections = true\n", True), ("corrections = false\n", False)):
        scene = load_scene(written(CANTILEVER + PLATFORM + LAW + DELAY + line))
        assert scene.interaction.delay.corrections is corrected


def test_reduced_frequency_counts_in_twice_the_free_frequency(written):
    scene = load_scene(written(CANTILEVER + "[platform]\namplitude_nm = 4\nreduced_frequency = 5.277\n" + LAW))
    # one rounding of the product is all that may differ
    np.testing.assert_allclose(scene.platform.frequency_khz, 949.86, rtol=3e-16, atol=0.0)


def test_saved_file_has_the_keys_of_the_format(tmp_path: Path):
    save_scene(Scene(Cantilever(90.0), Platform(4.0, 180.0), ImpactLaw(r=0.5)), tmp_path / "scene.toml")
    assert tomllib.loads((tmp_path / "scene.toml").read_text("utf-8")) == {
        "cantilever": {"frequency_khz": 90.0, "mass_ng": 1.0},
        "platform": {"amplitude_nm": 4.0, "frequency_khz": 180.0, "offset_nm": 0.0, "offset_rate_nm_per_us": 0.0},
        "interaction": {"model": "law", "r": 0.5, "epsilon": 0.0, "viscous_loss": 0.0},
    }
