"""Laws in files and in scene files: written and read again, measured columns in other units, and what is none."""

import json

import equinox as eqx
import jax
import numpy as np
import pytest

import afm_jax as afm
from afm_jax import CollisionDelay, ImpactLaw, TabulatedLaw
from afm_jax.cli.scenes import as_drawn, with_fitted_law
from afm_jax.saved import as_json
from afm_jax.scenefile.law_files import save_law_csv
from afm_jax.scenefile.parameter_paths import scene_family
from tests.test_scenefile import CANTILEVER, PLATFORM

WET = ImpactLaw(0.9999, 114.0, 0.48, CollisionDelay(0.206, 5.64, 0.726))
SPEEDS = np.geomspace(13.0, 300.0, 12)
HEAD = "approach_speed_nm_per_us,rebound_speed_nm_per_us\n"
SCENE = CANTILEVER + "mass_ng = 1.5\n" + PLATFORM + "[interaction]\nmodel = 'law'\n"


@pytest.fixture(scope="module")
def law() -> TabulatedLaw:
    """A law with independent errors of 0.2 % of each rebound speed."""
    w = np.asarray(WET.rebound_speed(SPEEDS))
    return TabulatedLaw.with_errors(
        SPEEDS, w, WET.collision_delay(SPEEDS), rebound_changes=0.002 * np.diag(w), mass_ng=1.5, origin="a test"
    )


def test_a_law_is_written_and_read_again_number_for_number_and_named_by_a_scene_file(law, tmp_path):
    afm.save_law(law, tmp_path / "law.json")
    again = afm.load_law(tmp_path / "law.json")
    assert eqx.tree_equal(law, again)
    assert again.origin.text == "a test"
    told = json.loads((tmp_path / "law.json").read_text())
    assert told["speed_range_nm_per_us"] == pytest.approx([13.0, 300.0], rel=1e-14)
    (tmp_path / "deep").mkdir()
    (tmp_path / "deep" / "scene.toml").write_text(SCENE + 'file = "../law.json"\n')
    scene = afm.load_scene(tmp_path / "deep" / "scene.toml")
    assert eqx.tree_equal(scene.interaction, law)
    # written out it needs no other file
    afm.save_scene(scene, tmp_path / "whole.toml")
    assert eqx.tree_equal(afm.load_scene(tmp_path / "whole.toml"), scene)


def test_a_table_is_written_and_read_again(law, tmp_path):
    """A CSV keeps speeds, range, capture, mass, origin and whether corrections count, but no errors."""
    plain = CollisionDelay(0.2, 5.0, 0.7, corrections=False)
    other = TabulatedLaw(SPEEDS, WET.rebound_speed(SPEEDS), plain(SPEEDS, WET.rebound_speed(SPEEDS)), delay=plain)
    u = np.geomspace(13.0, 300.0, 50)
    for one in (law, other, TabulatedLaw(SPEEDS, WET.rebound_speed(SPEEDS))):
        save_law_csv(one, tmp_path / "law.csv")
        again = afm.load_law(tmp_path / "law.csv")
        np.testing.assert_allclose(again.rebound_speed(u), one.rebound_speed(u), rtol=1e-9)
        np.testing.assert_allclose(again.collision_delay(u), one.collision_delay(u), rtol=0.0, atol=1e-9)
        for name in ("capture_speed_nm_per_us", "slowest_nm_per_us", "fastest_nm_per_us"):
            np.testing.assert_allclose(getattr(again, name), getattr(one, name), rtol=1e-12)
        kept = (again.origin.text, again.mass_ng, again.lasts, again.deviations)
        assert kept == (one.origin.text, one.mass_ng, one.lasts, None)


def test_unknowns_of_a_law_are_parameters_of_its_scene(law):
    scene = afm.Scene(afm.Cantilever(90.0, 40.0, 1.5), afm.Platform(4.0, 181.8, -1.0), law)
    moved = afm.scene_family(scene, "interaction.unknown_3")(2.0).interaction
    rise = np.asarray(moved.rebound_speed(SPEEDS)) / np.asarray(law.rebound_speed(SPEEDS)) - 1.0
    # two standard errors of the third speed; the capture speed moves with it, but no other row
    np.testing.assert_allclose(rise[2], 0.004, rtol=0.05)
    np.testing.assert_allclose(np.delete(rise, 2), 0.0, atol=2e-4)


def test_samples_have_the_errors_of_the_law(law):
    laws = law.sample(jax.random.key(1), 400)
    spread = np.std(np.asarray(jax.vmap(lambda law: law.rebound_speed(SPEEDS))(laws)), axis=0)
    # 400 samples tell a standard deviation to 4 %
    np.testing.assert_allclose(spread / np.asarray(law.rebound_speed(SPEEDS)), 0.002, rtol=0.15)
    with pytest.raises(ValueError, match="nothing is known of this law's errors"):
        TabulatedLaw(SPEEDS, WET.rebound_speed(SPEEDS)).sample(jax.random.key(1), 2)


def test_measured_columns(tmp_path):
    w, late = np.asarray(WET.rebound_speed(SPEEDS)), np.asarray(WET.collision_delay(SPEEDS))
    rows = "\n".join("\t".join(map(repr, row)) for row in np.stack([SPEEDS, w, late], axis=1).tolist())
    head = "# mass_ng = 1.2\n# origin = laser and lamp\n"
    head += "approach_speed_nm_per_us\trebound_speed_nm_per_us\tcollision_delay_us\n"
    (tmp_path / "law.csv").write_text(head + rows)
    law = afm.load_law(tmp_path / "law.csv")
    np.testing.assert_allclose(law.rebound_speed(SPEEDS), w, rtol=1e-12)
    np.testing.assert_allclose(law.collision_delay(SPEEDS), late, rtol=1e-9)
    assert law.mass_ng is not None
    assert float(law.mass_ng) == 1.2
    assert law.origin.text == "laser and lamp"


def test_a_law_of_another_mass_and_a_batch_of_laws_are_refused(law, tmp_path):
    afm.save_law(law, tmp_path / "law.json")
    (tmp_path / "scene.toml").write_text(SCENE.replace("1.5", "2") + 'file = "law.json"\n')
    with pytest.raises(afm.SceneError, match=r"\[interaction\] the law is that of a tip of 1\.5 ng, but .* is 2"):
        afm.load_scene(tmp_path / "scene.toml")
    with pytest.raises(ValueError, match=r"the law is that of a tip of 1\.5 ng"):
        afm.Scene(afm.Cantilever(90.0), afm.Platform(4.0, 181.8), law)
    batch = law.sample(jax.random.key(1), 3)
    with pytest.raises(ValueError, match="holds one scene: save them one by one"):
        afm.save_scene(afm.Scene(afm.Cantilever(90.0, 40.0, 1.5), afm.Platform(4.0, 181.8), batch), tmp_path / "b.toml")


def test_a_fit_of_instantaneous_impacts_tells_delays_of_0(tmp_path):
    instant = TabulatedLaw(SPEEDS, WET.rebound_speed(SPEEDS), mass_ng=1.5)
    told = as_json(instant) | {"collision_delay_us": [0.0] * 12}
    fit = {"format": "afm-jax fit", "format_version": 2, "valid": True, "law": told}
    (tmp_path / "fit.json").write_text(json.dumps(fit))
    assert eqx.tree_equal(afm.load_law(tmp_path / "fit.json"), instant)


def test_the_table_of_collisions_is_a_law(tmp_path):
    """What `collide --out` writes, captured tips left empty."""
    head = "approach_speed_nm_per_us,rebound_speed_nm_per_us,collision_delay_us,captured,outcome,end_energy_aj"
    rows = ["8,,,true,captured,-1.5", "20,16.7,0.01,false,free,1.0", "30,28.0,0.012,false,free,1.0"]
    rows += ["50,48.7,0.013,false,free,1.0", "200,199.6,0.014,false,free,1.0"]
    (tmp_path / "collide.csv").write_text("\n".join([head, *rows]) + "\n")
    law = afm.load_law(tmp_path / "collide.csv")
    assert 8.0 <= float(law.capture_speed_nm_per_us) < 20.0
    assert float(law.rebound_speed(30.0)) == pytest.approx(28.0, rel=1e-12)


def test_a_scene_and_one_with_a_drawn_law_run_in_the_same_programs(tmp_path):
    """Their numbers have the same shapes: a law's errors would compile every program of a diagram a second time."""
    head = "approach_speed_nm_per_us,rebound_speed_nm_per_us,rebound_speed_error_nm_per_us\n"
    (tmp_path / "law.csv").write_text(head + "12,4.7,0.1\n20,16.7,0.1\n50,48.7,0.1\n200,199.6,0.1\n")
    scene = afm.Scene(afm.Cantilever(90.0, 40.0), afm.Platform(5.0, 190.0), afm.ImpactLaw(0.9))
    made, known = with_fitted_law(scene, tmp_path / "law.csv")
    assert known is not None
    one = scene_family(made, *known.paths)(*np.zeros(len(known.paths)))
    assert jax.tree.structure(as_drawn(made)) == jax.tree.structure(one)
    assert jax.tree.map(jax.numpy.shape, as_drawn(made)) == jax.tree.map(jax.numpy.shape, one)
    assert as_drawn(scene) is scene
