"""Impacts of a law at the ends of what can be asked for.

* Quality factors from 0.6 to 1e7: nearly no oscillation left; a decay that rounding hides.
* Amplitudes from 1e-3 to 1e6 nm: nothing in the search may have a scale of its own.
* Exact and nearly exact resonance: the flight's end and the platform's phase depend on a difference of frequencies.
* Reduced frequencies of 50 and 0.01: a hundred crossings' worth of platform in a flight; a platform that hardly moves.
* Within 1e-12 of capture: the rebound is the root of a difference.
"""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.optimize import brentq

from afm_jax.impact.law import ImpactLaw
from tests import reference_flight
from tests.hard_cases.maps import USUAL, compare, leaving

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("quality_factor", [0.6, 1.0, 1e3, 1e7])
def test_quality_factors(quality_factor: float):
    p = replace(USUAL, quality_factor=quality_factor, offset_nm=0.5)
    compare(p, *leaving(p, 0.7, 8.0))


@pytest.mark.parametrize("amplitude_nm", [1e-3, 1.0, 1e3, 1e6])
def test_amplitudes(amplitude_nm: float):
    p = replace(USUAL, amplitude_nm=amplitude_nm, offset_nm=-0.3 * amplitude_nm, epsilon=amplitude_nm**2)
    compare(p, *leaving(p, 0.6, 5.0))


@pytest.mark.parametrize("away", [0.0, 1e-15, 1e-12, 1e-9, -1e-6])
def test_resonance(away: float):
    p = replace(USUAL, drive_frequency_khz=180.0 * (1.0 + away), offset_nm=0.0, quality_factor=1e6)
    compare(p, *leaving(p, 0.75, 20.0))


@pytest.mark.parametrize(("reduced", "rebound"), [(50.0, 2.5), (50.0, 40.0), (0.01, 30.0), (0.01, 0.5)])
def test_fast_and_slow_platforms(reduced: float, rebound: float):
    p = replace(USUAL, drive_frequency_khz=180.0 * reduced, epsilon=0.0)
    compare(p, *leaving(p, 0.7, rebound))


@pytest.mark.parametrize("away", [1e-3, 1e-6, 1e-9])
@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_near_capture(away: float, side: float):
    # the loss that leaves, of this very impact, nothing but a little
    free = replace(USUAL, r=1.0, epsilon=0.0)
    time, velocity = leaving(free, 0.7, 6.0)
    k = reference_flight.constants(free)

    def gap(t):
        p11, p12, _, _ = reference_flight.propagator(k, t - time)
        start = reference_flight.platform(k, time)[0]
        return float(p11 * start + p12 * velocity - reference_flight.platform(k, t)[0])

    times = time + np.linspace(0.3, 20.0, 4000)
    first = int(np.flatnonzero(np.array([gap(t) for t in times]) < 0.0)[0])
    arrival: Any = brentq(gap, times[first - 1], times[first], xtol=1e-15)
    _, _, p21, p22 = reference_flight.propagator(k, arrival - time)
    speed = reference_flight.platform(k, arrival)[1]
    approach = float(speed - p21 * reference_flight.platform(k, time)[0] - p22 * velocity)
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
