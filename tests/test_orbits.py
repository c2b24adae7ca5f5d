"""Single-impact orbits: the same as the reference's, fixed points of the map, stable where the map converges."""

from typing import Any

import jax
import numpy as np
import pytest
from click.testing import CliRunner

from afm_jax import save_scene
from afm_jax.apparatus.cantilever import Cantilever
from afm_jax.apparatus.platform import Platform
from afm_jax.apparatus.scene import Scene
from afm_jax.cli.main import main
from afm_jax.impact.law import ImpactLaw
from afm_jax.impact.map import next_impact
from afm_jax.impact.orbits import single_impact_orbits
from afm_jax.outcomes import Outcome
from tests import reference_orbits
from tests.package_scenes import bouncing, scene_of
from tests.reference_examples import DELAY, SCENES, scene

SOFT = {"quality_factor": None, "r": 0.5, "epsilon": 1.0}  # the charts of the paper
CASES = {
    "paper, order 1": (SCENES["paper"], 1),
    "paper, order 2": (SCENES["paper"], 2),
    "figure 3": (scene(0.8, **SOFT), 1),
    "figure 3, order 3": (scene(0.8, **SOFT), 3),
    "figure 2": (scene(1.02, **{**SOFT, "epsilon": 0.0}), 1),
    "minus sign of eq. 9": (scene(1.01, **SOFT), 1),
    "both signs of eq. 9": (scene(1.1, **SOFT, offset_nm=1.0, amplitude_nm=0.75), 3),
    "resonance": (scene(1.0, **SOFT, offset_nm=2.0), 1),
    "resonance, order 3": (scene(3.0, quality_factor=None, r=0.8, epsilon=1.0, offset_nm=-2.0), 3),
    "resonance, order 5 through the sample": (scene(3.0, quality_factor=None, r=0.8, epsilon=1.0, offset_nm=-2.0), 5),
    "no orbit: whole free periods": (scene(1.0, **SOFT), 2),
    "viscous, undamped": (scene(1.99, quality_factor=None, r=0.9999, viscous_loss=0.48, offset_nm=3.0), 2),
    "damped": (scene(1.03, offset_nm=2.0), 1),
    "damped resonance": (scene(1.0), 1),
    "damped, order 5": (scene(5.05, offset_nm=0.0), 5),
    "damped, captured": (scene(1.01, amplitude_nm=0.5), 1),
    "viscous": (SCENES["viscous"], 1),
    "delayed": (SCENES["delayed"], 1),
    "delayed, order 3": (scene(3.02, delay=DELAY, offset_nm=2.0), 3),
    "late and slow": (scene(1.1, delay=(0.3, 0.0, 0.0), r=0.9, epsilon=10.0, offset_nm=1.0), 1),
}
NONE = ("paper, order 2", "no orbit: whole free periods", "damped, captured")
NUMBERS = (
    "velocity_after_nm_per_us",
    "velocity_before_nm_per_us",
    "approach_speed_nm_per_us",
    "rebound_speed_nm_per_us",
    "delay_us",
    "trace",
    "determinant",
    "peak_amplitude_nm",
    "lockin_amplitude_nm",
)


def turned(angle: Any, full: float) -> float:
    """Return an angle between minus and plus half a turn."""
    return (float(angle) + 0.5 * full) % full - 0.5 * full


@pytest.mark.parametrize("name", CASES)
def test_orbits_are_those_of_the_reference(name):
    """The admissible ones are fixed points of the map; the flights of others end in the sample before their impact."""
    p, order = CASES[name]
    exact, made = reference_orbits.single_impact_orbits(p, order), scene_of(p)
    mine = single_impact_orbits(made, order)
    slots = np.flatnonzero(mine.exists)
    assert len(slots) == len(exact)
    assert bool(exact) == (name not in NONE)
    assert bool(mine.complete)
    period = order * float(made.platform.period_us)
    for slot, orbit in zip(slots, exact, strict=True):
        assert bool(mine.admissible[slot]) == orbit.admissible
        assert bool(mine.stable[slot]) == orbit.stable
        # Conditions of these roots are below 1e4; their trace near capture has u_in/u_out = 100 times more.
        assert turned(mine.phase_rad[slot] - float(orbit.phase_rad), 2 * np.pi) == pytest.approx(0.0, abs=1e-11)
        assert 0.0 <= float(mine.phase_rad[slot]) < 2 * np.pi
        for field in NUMBERS:
            assert float(getattr(mine, field)[slot]) == pytest.approx(float(getattr(orbit, field)), rel=1e-10)
        # Degrees: 1e-11 of a turn; zero and 360/N are the same.
        assert turned(mine.lockin_phase_deg[slot] - orbit.lockin_phase_deg, 360 / order) == pytest.approx(0.0, abs=1e-8)
        start = float(mine.phase_rad[slot] / made.platform.angular_frequency)
        impact = next_impact(made, start, mine.velocity_after_nm_per_us[slot])
        if orbit.admissible:
            assert int(impact.outcome) == Outcome.IMPACT
            assert float(impact.time_us) == pytest.approx(start + period, abs=1e-10)
            for field in ("velocity_before_nm_per_us", "velocity_after_nm_per_us"):
                # The map's condition, up to 1e3 near capture.
                assert float(getattr(impact, field)) == pytest.approx(float(getattr(mine, field)[slot]), rel=1e-10)
        else:
            inside = int(impact.outcome) == Outcome.DELAY_EXCEEDS_FLIGHT
            assert inside or float(impact.time_us) < start + period - 1e-3


@pytest.mark.parametrize("quality_factor", [None, 1e12])
def test_resonance_is_closed_form(quality_factor):
    made = Scene(Cantilever(90.0, quality_factor), Platform(2.0, 180.0), ImpactLaw(r=0.8))
    orbits = single_impact_orbits(made, 1)
    top = 2.0 * 2e-3 * np.pi * 180.0
    best = int(np.flatnonzero(orbits.admissible)[-1])
    # V' = W (1 + r)/(1 - r); with Q = 1e12 the air takes 2 Omega T/(2 Q (1 - r)) = 3e-11.
    assert float(orbits.velocity_after_nm_per_us[best]) == pytest.approx(top * 9.0, rel=1e-10)
    assert float(orbits.phase_rad[best]) == pytest.approx(1.5 * np.pi, abs=1e-9)
    assert float(orbits.determinant[best]) == pytest.approx(0.64, rel=1e-9)
    height = top * 9.0 / (2e-3 * np.pi * 90.0)
    assert float(orbits.peak_amplitude_nm[best]) == pytest.approx(height, rel=1e-9)
    # |sin| has the fundamental 4/(3 pi); highest half a period after impact, at omega t = 5 pi/2.
    assert float(orbits.lockin_amplitude_nm[best]) == pytest.approx(height * 4 / (3 * np.pi), rel=1e-9)
    assert float(orbits.lockin_phase_deg[best]) == pytest.approx(270.0, abs=1e-7)


@pytest.mark.parametrize("order", [0, 1.5, float("nan"), np.array([1, 2])])
def test_orders_that_are_none_are_refused(order):
    with pytest.raises(ValueError, match=r"^`order` must be a positive integer, but is "):
        single_impact_orbits(bouncing(), order)


def test_a_ramp_has_no_orbit():
    ramp = scene_of(SCENES["damped"], offset_rate_nm_per_us=0.5)
    with pytest.raises(ValueError, match=r"`offset_rate_nm_per_us` must be 0 for a periodic orbit, but is 0\.5"):
        single_impact_orbits(ramp, 1)
    # A traced ramp cannot raise; it gives no orbit.
    orbits = jax.jit(lambda one: single_impact_orbits(one, 1))(ramp)
    assert not np.any(orbits.exists)


@pytest.mark.parametrize(
    ("p", "order", "said"),
    [(scene(amplitude_nm=0.01), 1, "larger drive amplitude"), (scene(offset_nm=0.0), 3, "try --order 1")],
    ids=["none", "through the sample"],
)
def test_the_command_says_why_no_orbit_counts(p, order, said, tmp_path):
    save_scene(scene_of(p), tmp_path / "scene.toml")
    result = CliRunner().invoke(main, ["orbits", str(tmp_path / "scene.toml"), "--order", str(order)])
    assert result.exit_code == 3
    assert said in result.stderr
