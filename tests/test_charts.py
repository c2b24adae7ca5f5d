"""Stability charts of single-impact orbits (figures 2, 3, 9): 50-digit orbits and closed forms."""

from functools import cache, partial
from typing import Any

import numpy as np
import pytest

from afm_jax.dynamics.charts import StabilityChart, batch_of_scenes, orbit_verdicts, stability_chart
from afm_jax.scenefile.presets import law_scene
from tests.reference_flight import Parameters
from tests.reference_orbits import single_impact_orbits


@cache
def chart_of(epsilon: float) -> StabilityChart:
    # Off round numbers: where n is N/2k the flight lasts k free periods, every state returns, and rounding decides.
    return stability_chart(
        partial(law_scene, epsilon=epsilon),
        x_values=np.linspace(0.326, 6.476, 124),
        y_values=np.linspace(0.025, 2.975, 60),
        last_order=14,
    )


@pytest.mark.parametrize("epsilon", [0.0, 1.0])
def test_verdicts_are_those_of_the_50_digit_orbits(epsilon: float):
    chart = chart_of(epsilon)
    frequency, amplitude = chart.points()
    generator = np.random.default_rng(11)
    # Stable for half of the points, anything for the others; the order nearest to resonance has most to tell.
    stable = generator.choice(np.flatnonzero(chart.any_stable), 10, replace=False)
    for point in (*stable, *generator.choice(frequency.size, 10, replace=False)):
        order = int(chart.lowest_stable_order.ravel()[point]) or max(1, round(float(frequency[point])))
        drive: Any = {"amplitude_nm": float(amplitude[point]), "drive_frequency_khz": float(180.0 * frequency[point])}
        parameters = Parameters(
            frequency_khz=90.0, quality_factor=None, offset_nm=-1.0, r=0.5, epsilon=epsilon, **drive
        )
        orbits = [orbit for orbit in single_impact_orbits(parameters, order) if orbit.admissible]
        assert chart.verdicts.admissible[order - 1, point] == bool(orbits)
        steady = [orbit for orbit in orbits if orbit.stable]
        assert chart.verdicts.stable[order - 1, point] == bool(steady)
        if steady:
            highest = max(steady, key=lambda orbit: orbit.peak_amplitude_nm)
            # the reference samples its peak; a root near a fold keeps half of float64's digits at worst
            peak = chart.verdicts.peak_amplitude_nm[order - 1, point]
            np.testing.assert_allclose(peak, highest.peak_amplitude_nm, rtol=1e-7)
            multipliers = np.roots([1.0, -float(highest.trace), float(highest.determinant)])
            largest = chart.verdicts.largest_multiplier[order - 1, point]
            assert largest == pytest.approx(np.abs(multipliers).max(), abs=1e-7)


@pytest.mark.parametrize("order", [1, 2, 3, 6])
def test_at_resonance_an_orbit_needs_a_drive_that_reaches_the_rest_position(order: int):
    """Omega = omega/2N: the tangent of eq. 9 is infinite, so the impact height is 0, beta cos(omega t) = -sigma."""
    amplitude = np.array([0.9, 0.999, 1.001, 1.1])
    scenes = batch_of_scenes(law_scene, np.full(4, float(order)), amplitude)
    verdicts = orbit_verdicts(scenes, [order])
    assert verdicts.stable[0].tolist() == [False, False, True, True]
    # Half a free period above the rest position, leaving at V' = v_p (1 + r)/(1 - r) (eq. 1 with V = -V').
    platform_speed = 2e-3 * np.pi * 180.0 * order * np.sqrt(amplitude[2:] ** 2 - 1.0)
    height = 3.0 * platform_speed / (2e-3 * np.pi * 90.0)
    # V' is a closed form; rounding only
    np.testing.assert_allclose(verdicts.peak_amplitude_nm[0, 2:], height, rtol=1e-9)
