"""An oscillator in its own units: COCO's impact oscillator, and where its free motion grazes the stop."""

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
