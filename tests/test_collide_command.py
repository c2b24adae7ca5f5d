"""`afm-jax collide`: its numbers are those of the functions, its output, and how it ends."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

from afm_jax import Cantilever, Contact, Platform, Scene, save_scene
from afm_jax.cli.main import main
from afm_jax.contact.collide import capture_speed, collide
from afm_jax.contact.junction import find_junction
from tests import answers
from tests.strict_reading import strictly
from tests.test_scenefile import CANTILEVER, PLATFORM

EFFECTS = ("capillary", "structural", "core", "jkr")


def run(*arguments: object):
    return CliRunner().invoke(main, ["collide", *(str(argument) for argument in arguments)])


def answer(*arguments: object) -> dict[str, Any]:
    """Return the JSON object of a successful call; NaN and Infinity, which JSON does not have, are refused."""
    result = run(*arguments, "--json")
    assert result.exit_code == 0, result.stderr
    return strictly(result.stdout)


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("collide")


@pytest.fixture(scope="module")
def paper(out: Path) -> dict[str, Any]:
    return answers.answer(out, "collide", "--speeds", "5,12,15,20,200")


def test_numbers_are_those_of_the_functions(paper: dict[str, Any]):
    contact = Contact.paper()
    found = collide(contact, np.array(paper["approach_speed_nm_per_us"]))
    assert paper["approach_speed_nm_per_us"] == [5.0, 12.0, 15.0, 20.0, 200.0]
    for name in ("rebound_speed_nm_per_us", "collision_delay_us", "time_in_junction_us", "viscous_loss_aj"):
        np.testing.assert_allclose(paper[name][1:], getattr(found, name)[1:], rtol=1e-14, err_msg=name)
    assert paper["capture_speed_nm_per_us"] == pytest.approx(float(capture_speed(contact)), rel=1e-14)
    junction = find_junction(contact)
    for name in ("forms_gap_nm", "breaks_gap_nm", "hysteresis_aj"):
        assert paper["junction"][name] == pytest.approx(float(getattr(junction, name)), rel=1e-14)


def test_a_captured_tip_has_no_numbers_but_a_sentence(paper: dict[str, Any], out: Path):
    assert paper["captured"] == [True, False, False, False, False]
    for name in ("rebound_speed_nm_per_us", "collision_delay_us", "time_in_contact_us", "bridge_hysteresis_aj"):
        assert paper[name][0] is None
        assert None not in paper[name][1:]
    assert "the liquid bridge holds it" in paper["outcome"][0]
    assert paper["end_energy_aj"][0] < 0.0
    assert {path.name for path in out.iterdir()} == {"collide.csv", "collide.json", "collide.png"}
    rows = answers.table(out / "collide.csv")
    assert [row["captured"] for row in rows] == ["true", "false", "false", "false", "false"]
    assert rows[0]["rebound_speed_nm_per_us"] == ""
    assert [float(row["rebound_speed_nm_per_us"]) for row in rows[1:]] == paper["rebound_speed_nm_per_us"][1:]


def test_options_and_scenes_reach_the_contact(tmp_path: Path):
    path = tmp_path / "scene.toml"
    contact = Contact.paper(effects=EFFECTS, modulus_gpa=80.0, relative_humidity=0.45)
    save_scene(Scene(Cantilever(90.0, mass_ng=1.5), Platform(4.0, 180.0), contact), path)
    found = answer(path, "--speeds", "30", "--relative-humidity", "0.4", "--bridge-forms-nm", "3")
    changes = {"modulus_gpa": 80.0, "relative_humidity": 0.4, "bridge_forms_nm": 3.0}
    expected = collide(Contact.paper(effects=EFFECTS, **changes), 30.0, 1.5)
    assert found["rebound_speed_nm_per_us"] == pytest.approx([float(expected.rebound_speed_nm_per_us)], rel=1e-14)
    assert found["contact"].items() >= changes.items()
    assert found["mass_ng"] == 1.5
    static = answer("--no-viscous", "--speeds", "30")
    assert static["contact"]["effects"] == list(EFFECTS)


def test_a_spring_constant_says_the_mass_and_one_that_nothing_says_is_named_as_assumed(tmp_path):
    assert answer("--speeds", 40)["notes"][0].startswith("1 ng assumed")
    mass_ng = pytest.approx(0.5 / (2.0 * np.pi * 0.09) ** 2, rel=1e-14)
    path = tmp_path / "scene.toml"
    path.write_text(f"{CANTILEVER}spring_constant_n_per_m = 0.5\n{PLATFORM}[interaction]\nmodel = 'contact'\n")
    stated = answer(path, "--speeds", 40)
    assert "notes" not in stated
    assert stated["mass_ng"] == mass_ng


def test_that_all_are_captured_is_a_result():
    assert "All of these tips are captured; faster ones leave again." in run("--speeds", "1,2").stdout
    drowned = answer("--viscosity-pa-s", "1e6", "--speeds", "20")
    assert (drowned["captured"], drowned["capture_speed_nm_per_us"]) == ([True], None)
    assert "There is no capture speed" in drowned["capture_speed_reason"]


def test_unresolved_collisions_end_with_exit_code_3():
    result = run("--speeds", "20,1e300", "--json")
    assert result.exit_code == 3
    assert "not valid: 1 of 2 collisions: The integration did not resolve" in result.stderr
    found = json.loads(result.stdout)
    assert found["captured"] == [False, None]
    assert found["rebound_speed_nm_per_us"][1] is None
