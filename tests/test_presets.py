"""The paper's scenes by name."""

from pathlib import Path

import equinox as eqx
import pytest

from afm_jax import Contact, ImpactLaw, load_scene, save_scene
from afm_jax.scenefile import presets
from afm_jax.scenefile.scenefile import read_scene

# from the paper's captions: reduced frequency, drive amplitude, offset at the start; figures 2 and 3 are charts
CAPTIONS = {
    "figure2": (1.0, 2.0, -1.0),
    "figure3": (1.0, 2.0, -1.0),
    "figure8": (5.277, 4.0, 0.0),
    "figure9a": (0.97, 0.75, 0.0),
    "figure9b": (1.03, 0.75, 0.0),
    "figure10": (0.97, 2.0, -0.5),
    "figure11": (1.01, 4.0, -2.0),
    "dry": (0.97, 2.0, 0.0),
}
RAMPS = {"figure10": (5.0, 5500.0), "figure11": (2.0, 4000.0)}


@pytest.mark.parametrize("name", CAPTIONS)
def test_a_preset_is_the_scene_of_its_caption(name: str, tmp_path: Path):
    scene, (reduced, amplitude, offset) = presets.PRESETS[name](), CAPTIONS[name]
    # the drive is n times twice 90 kHz: one rounding
    assert float(scene.platform.frequency_khz) == pytest.approx(180.0 * reduced, rel=1e-15)
    assert [float(scene.platform.amplitude_nm), float(scene.platform.offset_nm)] == [amplitude, offset]
    assert (float(scene.platform.offset_rate_nm_per_us) != 0.0) == (name in RAMPS)
    if name in RAMPS:
        end, after = RAMPS[name]
        reached = float(scene.platform.offset_nm + after * scene.platform.offset_rate_nm_per_us)
        # two roundings of a few nm
        assert reached == pytest.approx(end, rel=1e-15)
    resolved = name in ("figure8", "figure10", "figure11", "dry")
    assert isinstance(scene.interaction, Contact if resolved else ImpactLaw)
    assert eqx.tree_equal(scene.interaction, Contact.paper()) == (resolved and name != "dry")
    assert (scene.cantilever.quality_factor is not None) == resolved
    path = tmp_path / "scene.toml"
    save_scene(scene, path, start=read_scene(name).start)
    assert eqx.tree_equal(load_scene(path), scene)
    assert read_scene(path).start == read_scene(name).start


def test_presets_are_those_of_the_captions_and_figure_8_has_a_start():
    assert set(presets.PRESETS) == set(CAPTIONS)
    assert read_scene("figure8").start == (270.0, 5.0, 80.0)
    assert read_scene("figure10").start is None
