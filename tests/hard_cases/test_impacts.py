"""Impacts of a law at the ends of what can be asked for.

* Quality factors from 0.6 to 1e7: nearly no oscillation left; a decay that rounding hides.
* Amplitudes from 1e-3 to 1e6 nm: nothing in the search may have a scale of its own.
* Exact and nearly exact resonance: the flight's end and the platform's phase depend on a difference of frequencies.
* Reduced frequencies of 50 and 0.01: a hundred crossings' worth of platform in a flight; a platform that hardly moves.
* Restitutions of next to nothing and of one.
* Within 1e-12 of capture: the rebound is the root of a difference.
"""

from dataclasses import replace

import numpy as np
import pytest

from afm_jax.apparatus.cantilever import Cantilever
from afm_jax.apparatus.platform import Platform
from afm_jax.apparatus.scene import Scene
from afm_jax.impact.law import CollisionDelay, ImpactLaw
from afm_jax.impact.orbits import single_impact_orbits
from tests import brute_force, reference_flight, reference_map
from tests.hard_cases.maps import USUAL, compare, leaving
from tests.reference_flight import Parameters

pytestmark = pytest.mark.slow


CASES: dict[str, tuple[Parameters, float, float]] = {}
"""The scene, the turns of the drive at the start, and the rebound speed there in units of the top speed."""
for value in (0.6, 1e7):
    CASES[f"Q = {value:g}"] = replace(USUAL, quality_factor=value, offset_nm=0.5), 0.7, 8.0
for value in (1e-3, 1e6):
    moved = replace(USUAL, amplitude_nm=value, offset_nm=-0.3 * value, epsilon=value**2)
    CASES[f"amplitude {value:g} nm"] = moved, 0.6, 5.0
for value in (0.0, 1e-12, -1e-6):
    tuned = replace(USUAL, drive_frequency_khz=180.0 * (1.0 + value), offset_nm=0.0, quality_factor=1e6)
    CASES[f"{value:g} off resonance"] = tuned, 0.75, 20.0
for reduced, rebound in ((50.0, 2.5), (50.0, 40.0), (0.01, 30.0), (0.01, 0.5)):
    driven = replace(USUAL, drive_frequency_khz=180.0 * reduced, epsilon=0.0)
    CASES[f"n = {reduced:g}, rebound {rebound:g}"] = driven, 0.7, rebound
for value in (1e-9, 1.0 - 1e-12, 1.0):
    CASES[f"r = {value!r}"] = replace(USUAL, r=value, epsilon=0.0), 0.7, 6.0


@pytest.mark.parametrize("name", CASES)
def test_at_the_ends_of_what_can_be_asked_for(name: str):
    p, phase_turns, rebound = CASES[name]
    compare(p, *leaving(p, phase_turns, rebound))


@pytest.mark.parametrize("away", [1e-3, 1e-9])
@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_near_capture(away: float, side: float):
    # the loss that leaves, of this very impact, nothing but a little
    free = replace(USUAL, r=1.0, epsilon=0.0)
    time, velocity = leaving(free, 0.7, 6.0)
    found = brute_force.first_impact(reference_map.flights_of(free, time, velocity), duration_us=20.0)
    impact = reference_map.next_impact(free, time, velocity, float(found.arrival_time_us[0]))
    platform_speed = reference_flight.platform_motion(free, impact.arrival_time_us)[1]
    approach = float(platform_speed - impact.velocity_before_nm_per_us)
    # of the derivative: rounding over the distance from capture
    compare(replace(free, epsilon=approach**2 * (1.0 - side * away)), time, velocity, slopes=1e-9 + 1e-13 / away)


def test_the_law_within_1e_minus_12_of_capture():
    law = ImpactLaw(r=0.9, epsilon=50.0)
    p = replace(USUAL, r=0.9, epsilon=50.0)
    bound = float(reference_flight.capture_speed(p))
    for away in (1e-12, 1e-10, 1e-6):
        speed = bound * (1.0 + away)
        exact = float(reference_flight.rebound_speed(p, speed))
        # rounding of the squares over what is left of them
        assert float(law.rebound_speed(speed)) == pytest.approx(exact, rel=1e-15 / away + 1e-15)
        slope = float(reference_flight.rebound_slope(p, speed))
        assert float(law.rebound_slope(speed)) == pytest.approx(slope, rel=1e-15 / away + 1e-14)
        assert bool(law.captures(bound * (1.0 - away)))


def test_an_approach_below_its_own_rounding_is_no_orbit():
    # r = 1: the closing condition of a delay that hardly ends goes on to 1e-9 nm/us, out of velocities of 0.01
    platform = Platform(0.9789296819917331, 1.850981555539128, 0.29367890459751994)
    delay = CollisionDelay(0.23570558938570135, 4.886879915814397, 0.0, corrections=False)
    scene = Scene(Cantilever(92.5490777769564, 706821.3703142771), platform, ImpactLaw(1.0, 0.0, delay=delay))
    found = single_impact_orbits(scene, 5)
    exists = np.asarray(found.exists)
    assert exists.any()
    for name in ("trace", "determinant", "approach_speed_nm_per_us"):
        np.testing.assert_array_equal(np.isfinite(getattr(found, name)), exists)
