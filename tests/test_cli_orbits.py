"""`afm-jax orbits`, compared with the 50-digit orbits of the references."""

import csv
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner, Result

import afm_jax
from afm_jax import Cantilever, CollisionDelay, ImpactLaw, Platform, Scene, load_scene, save_scene
from afm_jax.cli.main import main
from afm_jax.columns import columns_of, csv_cells
from afm_jax.dynamics.orbit_tables import OrbitTable
from tests.reference_examples import SCENES, scene
from tests.reference_flight import Parameters
from tests.reference_orbits import single_impact_orbits
from tests.strict_reading import strictly

KEYS = {
    *("phase_rad", "velocity_after_nm_per_us", "velocity_before_nm_per_us", "approach_speed_nm_per_us"),
    *("rebound_speed_nm_per_us", "delay_us", "peak_amplitude_nm", "lockin_amplitude_nm", "lockin_phase_deg"),
    *("trace", "determinant", "stable", "admissible", "near_double"),
}


def saved(p: Parameters, path: Path, *, offset_rate: float = 0.0) -> str:
    """Write a reference's parameters as a scene file and return its path."""
    delay = None if p.delay is None else CollisionDelay(*p.delay, corrections=False)
    law = ImpactLaw(p.r, p.epsilon, p.viscous_loss, delay)
    platform = Platform(p.amplitude_nm, p.drive_frequency_khz, p.offset_nm, offset_rate)
    save_scene(Scene(Cantilever(p.frequency_khz, p.quality_factor), platform, law), path)
    return str(path)


def orbits(*arguments: str) -> Result:
    return CliRunner().invoke(main, ["orbits", *arguments], prog_name="afm-jax")


@pytest.mark.parametrize("name", sorted(SCENES))
def test_json_is_the_references_list(name: str, tmp_path: Path):
    result = orbits(saved(SCENES[name], tmp_path / "scene.toml"), "--order", "1", "--json")
    assert result.exit_code == 0, result.stderr
    answer = strictly(result.stdout)
    expected = single_impact_orbits(SCENES[name], 1)
    assert (answer["order"], answer["reason"], answer["complete"]) == (1, None, True)
    assert len(answer["orbits"]) == len(expected) > 0
    for orbit, exact in zip(answer["orbits"], expected, strict=True):
        assert set(orbit) == KEYS
        for key in KEYS - {"near_double"}:
            # a root near a fold keeps half of float64's digits at worst; these are well separated
            np.testing.assert_allclose(orbit[key], float(getattr(exact, key)), rtol=1e-8, atol=1e-8, err_msg=key)


def test_table_and_file_show_the_same_orbits(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("COLUMNS", "400")
    path = saved(SCENES["damped"], tmp_path / "scene.toml")
    result = orbits(path, "--order", "1", "--out", str(tmp_path / "out"))
    assert result.exit_code == 0
    with (tmp_path / "out" / "orbits.csv").open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    expected = single_impact_orbits(SCENES["damped"], 1)
    assert [float(row["phase_rad"]) for row in rows] == pytest.approx([float(o.phase_rad) for o in expected], rel=1e-8)
    assert [row["stable"] for row in rows] == ["false", "true"]
    for orbit in expected:
        assert f"{float(orbit.peak_amplitude_nm):.6g}" in result.stdout
    # the same from Python, where no terminal breaks lines
    loaded = load_scene(path)
    told = OrbitTable(loaded, 1, afm_jax.single_impact_orbits(loaded, 1))
    assert told.text().split() == result.stdout.split()
    columns = told.tables()["orbits.csv"]
    assert columns_of(rows) == {name: list(map(str, csv_cells(column))) for name, column in columns.items()}


def test_no_orbit_ends_with_3_and_says_why(tmp_path: Path):
    weak = scene(amplitude_nm=0.01)
    assert single_impact_orbits(weak, 1) == []
    result = orbits(saved(weak, tmp_path / "scene.toml"), "--order", "1", "--json")
    answer = strictly(result.stdout)
    assert (result.exit_code, answer["orbits"]) == (3, [])
    assert "larger drive amplitude" in answer["reason"]
    assert result.stderr == f"afm-jax: not valid: {answer['reason']}\n"


def test_orbits_through_the_platform_do_not_count(tmp_path: Path):
    centred = scene(offset_nm=0.0)
    expected = single_impact_orbits(centred, 3)
    assert expected
    assert not any(orbit.admissible for orbit in expected)
    result = orbits(saved(centred, tmp_path / "scene.toml"), "--order", "3", "--json")
    answer = strictly(result.stdout)
    assert (result.exit_code, len(answer["orbits"])) == (3, len(expected))
    assert "try --order 1" in answer["reason"]
