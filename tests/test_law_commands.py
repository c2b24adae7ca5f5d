"""From a law's file to what commands say of a scene: made of a contact, measured, named by a scene file or by --law."""

import json
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

import afm_jax as afm
from afm_jax.cli.main import main
from tests.test_scenefile import CANTILEVER, PLATFORM

SCENE = CANTILEVER + "quality_factor = 40\n" + PLATFORM + "offset_nm = -1\n[interaction]\nmodel = 'law'\n"
MEASURED = """# origin = laser and lamp
approach_speed_nm_per_us,rebound_speed_nm_per_us,rebound_speed_error_nm_per_us
15,9.9,0.1
20,16.5,0.1
30,27.6,0.1
60,57.0,0.2
100,95.0,0.3
"""


def run(*arguments: object) -> dict:
    result = CliRunner().invoke(main, [*(str(argument) for argument in arguments), "--json"])
    assert result.exit_code == 0, result.stderr
    return json.loads(result.stdout)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a formula's scene, a measured law, and the law made of the paper's contact with its scene."""
    folder = tmp_path_factory.mktemp("laws")
    (folder / "formula.toml").write_text(SCENE + "r = 0.9\n")
    (folder / "measured.csv").write_text(MEASURED)
    (folder / "scene.toml").write_text(SCENE + 'file = "law/law.json"\n')
    run("collide", "--make-law", "--points", "40", "--out", folder / "law")
    return folder


@pytest.mark.slow
def test_the_law_of_a_contact_is_its_collisions(folder):
    contact, laws = afm.Contact.paper(), [afm.load_law(folder / "law" / name) for name in ("law.json", "law.csv")]
    # between the table's speeds, down to 3 % above capture
    u = np.array([11.3, 12.3, 17.7, 33.3, 77.7, 155.5, 410.0])
    found = afm.collide(contact, u)
    for law in laws:
        np.testing.assert_allclose(law.rebound_speed(u), found.rebound_speed_nm_per_us, rtol=2e-4)
        np.testing.assert_allclose(law.collision_delay(u), found.collision_delay_us, rtol=0.0, atol=2e-4)
        assert float(law.capture_speed_nm_per_us) == pytest.approx(float(afm.capture_speed(contact)), rel=1e-9)
        assert law.origin.text.startswith("contact: capillary")
        assert law.mass_ng == 1.0


@pytest.mark.slow
def test_orbits_and_simulation_of_a_laws_scene_are_one_motion(folder):
    orbits = run("orbits", folder / "scene.toml", "--order", 1)
    best = orbits["orbits"][-1]
    assert best["stable"]
    assert (best["extrapolated"], orbits["extrapolated"]) == (False, None)
    told = run("simulate", folder / "scene.toml", "--periods", 40)
    assert told["peak_amplitude_nm"] == pytest.approx(best["peak_amplitude_nm"], rel=1e-6)
    assert told["lockin_amplitude_nm"] == pytest.approx(best["lockin_amplitude_nm"], rel=1e-6)
    again = run("orbits", folder / "formula.toml", "--order", 1, "--law", folder / "law")
    assert again["orbits"][-1] == best


@pytest.mark.slow
def test_a_measured_law_has_errors_and_an_end(folder):
    """Commands take its errors as unknowns, and say where it is extrapolated."""
    law, known = ("--law", folder / "measured.csv"), "Extrapolated: the law is known from 15 to 100 nm/us"
    told = run("orbits", folder / "formula.toml", "--order", 1, *law)
    slow, fast = told["orbits"]
    assert (slow["extrapolated"], fast["extrapolated"]) == (True, False)
    assert told["extrapolated"].startswith(f"{known}, but 1 of 2 impacts")
    ranges = ("--parameter", "platform.reduced_frequency=1:1.05")
    followed = run("continue", folder / "formula.toml", "--order", 1, *ranges, *law)
    # the unstable branch ends in capture, below the speeds that were measured
    assert followed["extrapolated"].startswith(known)
