"""Parameters by their paths in a scene file: what scenes become."""

import jax
import numpy as np
import pytest

from afm_jax.apparatus.cantilever import Cantilever
from afm_jax.apparatus.drives import ForceDrive, Tone
from afm_jax.apparatus.platform import Platform
from afm_jax.apparatus.scene import Scene
from afm_jax.contact.contact import Contact
from afm_jax.impact.law import CollisionDelay, ImpactLaw
from afm_jax.scenefile.parameter_paths import (
    parameter_values,
    scene_batch,
    scene_family,
)
from afm_jax.scenefile.scenefile import load_scene, save_scene


def law_scene(**parts) -> Scene:
    law = ImpactLaw(0.9, 20.0, 0.3, CollisionDelay(0.2, 5.0, 0.7))
    return Scene(Cantilever(90.0, 40.0), Platform(4.0, 180.0, 0.5, second=Tone(1.0, 33.0)), law, **parts)


@pytest.mark.parametrize(
    "scene",
    [
        law_scene(),
        Scene(Cantilever(90.0), Platform(0.0, 85.0), ImpactLaw(0.9), force=ForceDrive(0.5, 85.0, 10.0)),
        Scene(Cantilever(90.0, 40.0), Platform(4.0, 180.0), Contact.paper(relative_humidity=0.4)),
    ],
    ids=["law", "force", "contact"],
)
def test_every_parameter_is_the_one_of_the_file(scene: Scene, tmp_path):
    known = parameter_values(scene)
    assert "platform.reduced_frequency" in known
    for path, value in known.items():
        other = 1.01 * value if value else 0.25
        made = scene_family(scene, path)(other)
        save_scene(made, tmp_path / "made.toml")
        found = parameter_values(load_scene(tmp_path / "made.toml"))
        changed = {name for name in found if not np.isclose(found[name], known[name], rtol=1e-12, atol=0.0)}
        in_khz = path.replace("reduced_frequency", "frequency_khz")
        own = {in_khz, in_khz.replace("frequency_khz", "reduced_frequency")} & set(found)
        if path == "cantilever.frequency_khz":  # the drives keep their frequencies in kHz
            own |= {name for name in found if name.endswith("reduced_frequency")}
        if path.startswith("force.") and "frequency" in path:  # the resting platform counts in it
            own |= {"platform.frequency_khz", "platform.reduced_frequency"}
        if "force.free_amplitude_nm" in found and path.startswith(("cantilever.", "force.")) and "phase" not in path:
            own |= {"force.free_amplitude_nm"}
        if path == "force.free_amplitude_nm":
            own |= {"force.amplitude_nn"}
        assert changed == own
        assert found[path] == pytest.approx(other, rel=1e-12)


def test_a_batch_is_the_scenes_one_by_one():
    values = {"interaction.epsilon": np.array([1.0, 2.0, 3.0]), "platform.reduced_frequency": np.array([1, 2, 4.0])}
    scenes = scene_batch(law_scene(), values)
    assert {leaf.shape for leaf in jax.tree.leaves(scenes)} == {(3,)}
    np.testing.assert_array_equal(scenes.platform.frequency_khz, [180.0, 360.0, 720.0])
    np.testing.assert_array_equal(scenes.interaction.epsilon, [1.0, 2.0, 3.0])
    # the cantilever comes before reduced frequencies
    made = scene_family(law_scene(), "platform.reduced_frequency", "cantilever.frequency_khz")(1.5, 100.0)
    assert float(made.platform.frequency_khz) == pytest.approx(300.0, rel=1e-15)
