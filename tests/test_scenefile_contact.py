"""Scene files with a contact: every key and exact loops; mistakes are lines of the corpus (`tests.malformed`)."""

import tomllib
from pathlib import Path
from typing import Any

import equinox as eqx
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from afm_jax import Cantilever, Contact, Platform, Scene, load_scene, save_scene
from afm_jax.contact.parameters import EFFECTS, PAPER

HEAD = "[cantilever]\nfrequency_khz = 90\n[platform]\namplitude_nm = 4\nfrequency_khz = 181.8\n[interaction]\n"
CONTACT = HEAD + 'model = "contact"\n'
# near the paper's values, where every contact has its junction
CHANGED: dict[str, Any] = {name: 1.01 * value for name, value in PAPER.items()}


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "scene.toml"


def test_effects_are_chosen_in_any_order_and_what_is_left_out_is_the_papers(path: Path):
    path.write_text(CONTACT, encoding="utf-8")
    assert eqx.tree_equal(load_scene(path), Scene(Cantilever(90.0), Platform(4.0, 181.8), Contact.paper()))
    path.write_text(f'{CONTACT}effects = ["jkr", "viscous", "core"]\nstructural_decay_nm = 0.5\n', encoding="utf-8")
    contact = load_scene(path).interaction
    assert contact.effects == ("core", "viscous", "jkr")
    assert eqx.tree_equal(contact, Contact.paper(effects=("core", "viscous", "jkr")))


WET = [("core", "jkr"), ("capillary", "core", "jkr"), ("core", "viscous", "jkr")]
DRY = [("van_der_waals", "dmt"), ("van_der_waals", "viscous", "dmt"), ("hertz",)]


@pytest.mark.parametrize("effects", WET + DRY)
def test_loop_is_exact_for_every_choice_of_effects(path: Path, effects: tuple[str, ...]):
    if effects in WET:
        contact = Contact.paper(effects=effects, **CHANGED)
    else:
        contact = Contact.of(effects, range_nm=12.0, contact_distance_nm=0.2, hamaker_constant_aj=0.3)
    scene = Scene(Cantilever(90.0, 40.0, 1.5), Platform(4.0, 181.8, -1.0, 1e-3), contact)
    save_scene(scene, path)
    assert eqx.tree_equal(load_scene(path), scene)


@settings(max_examples=30)
@given(values=st.fixed_dictionaries({name: st.floats(0.98 * value, 1.02 * value) for name, value in CHANGED.items()}))
def test_loop_is_exact(values: dict[str, Any], tmp_path_factory: pytest.TempPathFactory):
    path = tmp_path_factory.getbasetemp() / "contact.toml"
    scene = Scene(Cantilever(90.0), Platform(4.0, 181.8), Contact.paper(**values))
    save_scene(scene, path)
    assert eqx.tree_equal(load_scene(path), scene, rtol=4e-16, atol=0.0)
    assert tomllib.loads(path.read_text("utf-8"))["interaction"] == {
        "model": "contact",
        "effects": list(EFFECTS),
        # a core constant may be a neighbour
        **values,
        "core_constant_j_m6": pytest.approx(values["core_constant_j_m6"], rel=1e-15),
    }
