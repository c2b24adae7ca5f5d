"""An oscillator in its own units, against results of others: COCO, Budd and Dux, Salapaka, Simpson and Ghosh."""

import re
from pathlib import Path

import numpy as np
import pytest

from afm_jax import (
    ParameterRange,
    continue_orbits,
    dimensionless_scene,
    load_scene,
    single_impact_orbits,
)
from afm_jax.impact.orbits import SingleImpactOrbits

COCO = {1.0: 1.695732937595, 0.5: 0.837016023200, 0.2: 0.298612852056}
"""Impact speeds of period-1 orbits by the force's amplitude: k 1, c 0.1, omega 1, stop at 1, restitution 0.8."""


def stable_speed(orbits: SingleImpactOrbits) -> float:
    (speed,) = np.asarray(orbits.approach_speed_nm_per_us)[np.asarray(orbits.stable)]
    return float(speed)


@pytest.mark.parametrize("force", COCO)
def test_impact_speeds_are_those_of_coco(force: float):
    scene = dimensionless_scene(1.0, 0.05, 0.8, gap=1.0, force=force)
    assert stable_speed(single_impact_orbits(scene, 1)) == pytest.approx(COCO[force], abs=2e-12)


def test_the_page_shows_the_same_oscillator(tmp_path):
    page = (Path(__file__).parent.parent / "notebooks" / "pages" / "oscillator.md").read_text(encoding="utf-8")
    (toml,) = re.findall(r"```toml\n(.*?)```", page, re.DOTALL)
    (tmp_path / "oscillator.toml").write_text(toml, encoding="utf-8")
    orbits = single_impact_orbits(load_scene(tmp_path / "oscillator.toml"), 1)
    assert stable_speed(orbits) == pytest.approx(COCO[0.5], abs=2e-12)


@pytest.mark.parametrize("omega", [0.6, 1.0, 1.3])
def test_free_motion_grazes_where_its_amplitude_is_the_gap(omega: float):
    scene = dimensionless_scene(omega, 0.05, 0.8, gap=1.0)
    found = continue_orbits(scene, 1, ParameterRange("force.amplitude_nn", 0.01, 1.0), impacts=0)
    (point,) = [point for point in found.special if point.kind == "grazing"]
    assert point.parameter == pytest.approx(np.hypot(1.0 - omega**2, 0.1 * omega), rel=1e-12)


@pytest.mark.parametrize(
    ("name", "value"), [("omega", 0.0), ("damping_ratio", 1.0), ("damping_ratio", -0.1), ("r", 1.5), ("force", -1.0)]
)
def test_impossible_numbers_are_named(name: str, value: float):
    with pytest.raises(ValueError, match=f"`{name}` must"):
        dimensionless_scene(**{"omega": 1.0, "damping_ratio": 0.05, "r": 0.8, "gap": 1.0, name: value})


def undamped_speeds(omega: float, r: float, order: int, stop: float) -> list[float]:
    """Return impact speeds of one impact in so many periods without damping, admissible or not, and where they fold.

    Budd and Dux, Nonlinearity 7, 1191 (1994); `OneNParams` of github.com/FelixDux/impact-oscillator. Force 1.
    """
    period, gamma, lost = 2.0 * np.pi * order / omega, 1.0 / (1.0 - omega**2), (1.0 - r) / omega
    turned = (1.0 + r) * np.sin(period) / (1.0 - np.cos(period))
    root = 2.0 * np.sqrt(complex((gamma * turned) ** 2 - (stop**2 - gamma**2) * lost**2))
    both = (-2.0 * turned * stop + np.array([-root, root])) / (turned**2 + lost**2)
    return [float(speed.real) for speed in both if speed.imag == 0.0 and speed.real > 0.0]


@pytest.mark.parametrize(("stop", "admissible"), [(0.0, 1), (0.2, 2), (-0.06, 0), (0.4, 0)])
def test_undamped_impact_speeds_are_those_of_budd_and_dux(stop: float, admissible: int):
    orbits = single_impact_orbits(dimensionless_scene(3.7, 0.0, 0.8, gap=stop), 2)
    speeds = np.asarray(orbits.approach_speed_nm_per_us)[np.asarray(orbits.exists)]
    np.testing.assert_allclose(np.sort(speeds), undamped_speeds(3.7, 0.8, 2, stop), rtol=1e-12)
    # the counts are those of the program's own tests
    assert np.asarray(orbits.admissible).sum() == admissible


def off_a_line(quality_factor: float) -> np.ndarray:
    """Return how far amplitude and sine of the lag of tapping tips are from lines over the gap; free amplitude 1."""
    gaps = np.linspace(0.1, 0.95, 6)
    readings = []
    for gap in gaps:
        scene = dimensionless_scene(1.0, 0.5 / quality_factor, 0.7, gap=float(gap), force=1.0 / quality_factor)
        orbits = single_impact_orbits(scene, 1)
        assert orbits.phase_lag_deg is not None
        both = np.asarray(orbits.drive_lockin_amplitude_nm), np.sin(np.radians(np.asarray(orbits.phase_lag_deg)))
        (orbit,) = np.stack(both)[:, np.asarray(orbits.stable)].T
        readings.append(orbit)
    lines = np.polyfit(gaps, np.stack(readings), 1)
    return np.abs(np.stack(readings) - np.outer(gaps, lines[0]) - lines[1]).max(axis=0)


def test_amplitude_and_sine_of_the_lag_are_linear_in_the_gap():
    """Salapaka, Chen and Cleveland, Phys. Rev. B 61, 1106 (2000): on resonance, to the first order of 1/Q."""
    coarse, fine = off_a_line(100.0), off_a_line(400.0)
    assert (fine < [2e-4, 4e-3]).all()
    np.testing.assert_allclose(coarse / fine, 4.0, rtol=0.1)


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "away"), [("fold", -0.01), ("period_doubling", 0.04)])
def test_at_resonance_folds_and_doublings_leave_grazing_quadratically(kind: str, away: float):
    """Simpson and Ghosh, arXiv 2602.22797: tangent where the force has twice the damped natural frequency."""
    beyond = []
    for far in (away, 0.5 * away):
        omega = 2.0 * np.sqrt(1.0 - 0.05**2) + far
        grazing = np.hypot(1.0 - omega**2, 0.1 * omega)
        scene = dimensionless_scene(omega, 0.05, 0.8, gap=1.0)
        found = continue_orbits(scene, 1, ParameterRange("force.amplitude_nn", 0.95 * grazing, 1.05 * grazing))
        (point,) = [point for point in found.special if point.kind == kind]
        beyond.append(point.parameter - grazing)
    assert np.log2(beyond[0] / beyond[1]) == pytest.approx(2.0, abs=0.05)
