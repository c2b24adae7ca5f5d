"""The accuracy study: its references, its rivals, and the command. No times are judged."""

from pathlib import Path

import numpy as np
import pytest

from afm_jax import Cantilever, ForceDrive, ImpactLaw, Platform, Scene
from afm_jax.scenefile.scenefile import load_scene, save_scene
from afm_jax.studies import accuracy
from afm_jax.studies import timing as own_process
from tests import reference_contact as exact
from tests import reference_map
from tests.answers import answer, table
from tests.reference_flight import Parameters
from tests.run_here import run_here

FORCED = Scene(
    Cantilever(90.0, 200.0, 16.8), Platform(0.0, 94.5, -30.0), ImpactLaw(0.95, 60.0), force=ForceDrive(60.0, 94.5)
)


def test_the_reference_of_the_map_is_that_of_mpmath():
    problem = accuracy.impact_times(3)
    scene = load_scene("figure2")
    cantilever, platform, law = scene.cantilever, scene.platform, scene.interaction
    known = Parameters(
        frequency_khz=float(cantilever.frequency_khz),
        quality_factor=None,
        amplitude_nm=float(platform.amplitude_nm),
        drive_frequency_khz=float(platform.frequency_khz),
        offset_nm=float(platform.offset_nm),
        r=float(law.r),
        epsilon=float(law.epsilon),
    )
    _, tips = problem.begin(problem.at)
    speeds = tips.rate + scene.platform.velocity(tips.time_us)
    for tip, guess in enumerate(problem.exact[0]):
        start = float(tips.time_us[tip]), float(speeds[tip])
        # times of up to 10 us, and slopes, to a few roundings
        assert guess == pytest.approx(float(reference_map.next_impact(known, *start, float(guess)).time_us), abs=1e-14)
        slopes = reference_map.map_jacobian(known, *start, float(guess))
        np.testing.assert_allclose(
            problem.exact[1][tip], [float(slopes[0, 0]), float(slopes[0, 1])], rtol=1e-11, atol=1e-12
        )
    assert max(problem.doubt) < 1e-12


@pytest.mark.slow
def test_the_reference_of_collisions_is_that_of_mpmath():
    problem = accuracy.rebound_speeds(3)
    speeds = np.linspace(12.0, 200.0, 3)
    for place in range(3):
        expected = exact.collision(exact.ContactParameters(), float(speeds[place]), digits=20)
        # converged to rounding: energies of 100 aJ, of which the slowest tip keeps 12
        assert problem.exact[0][place] == pytest.approx(float(expected.rebound_speed_nm_per_us), rel=1e-12)
    assert max(problem.doubt) < 1e-13


@pytest.mark.slow
@pytest.mark.parametrize("scene", ["forced", "figure9b"])
def test_law_scenes_are_measured_however_they_are_driven(scene: str, tmp_path: Path):
    """SciPy and Diffrax know nothing of steady responses and closed forms, and arrive at the same time."""
    name = scene
    if scene == "forced":
        name = str(tmp_path / "forced.toml")
        save_scene(FORCED, name)
    found = accuracy.measured(name, contacts=3, quick=True)
    for row in found.rows:
        assert "reason" not in row
        coarse = row["setting"] == "root tolerance 0.1 us"
        # times of 20 us; the slope grows where the tip is slow
        assert row["error"] < (1.0 if coarse else 1e-4 if row["of"] == "gradient" else 1e-6), row
    assert {row["method"] for row in found.rows} == {"afm-jax", "SciPy DOP853", "Diffrax Dopri8"}


@pytest.mark.slow
@pytest.mark.parametrize("problem", ["map", "collide"])
def test_achieved_errors_are_what_settings_allow(problem: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(own_process, "run_in_own_process", run_here)
    payload = answer(tmp_path, "accuracy", problem, "--quick")
    errors = {(row["of"], row["method"], row["setting"]): row["error"] for row in payload["rows"]}
    bounds = {
        # a root tolerance of 1e-13 us, and times of up to 10 us
        "map": {"root tolerance 0.1 us": 0.1, "root tolerance 1e-13 us": 1e-13},
        "collide": {"diffrax, accuracy 1e-05": 1e-5, "collocation, accuracy 1e-11": 1e-11},
    }[problem]
    for setting, bound in bounds.items():
        assert errors["value", "afm-jax", setting] <= bound
        assert errors["gradient", "afm-jax", setting] <= 10.0 * bound
    for method in ("SciPy DOP853", "Diffrax Dopri8"):
        assert 1e-14 < errors["value", method, "tolerance 1e-08"] < 1e-5
        assert 1e-12 < errors["gradient", method, "tolerance 1e-08"] < 1e-3
    assert len(table(tmp_path / "accuracy.csv")) == len(payload["rows"])
