"""Orbits of several impacts: fixed points of the map."""

import numpy as np
import pytest

from afm_jax import (
    Cantilever,
    CollisionDelay,
    ImpactLaw,
    Platform,
    Scene,
    next_impact,
    single_impact_orbits,
)
from afm_jax.dynamics.impact_orbits import many_impact_orbits
from afm_jax.outcomes import Outcome

FREE = 2.0 * np.pi * 0.09
"""Omega in rad/us."""


def scene(n: float, r: float, offset: float = -1.0, epsilon: float = 0.0) -> Scene:
    return Scene(Cantilever(90.0), Platform(2.0, 180.0 * n, offset), ImpactLaw(r, epsilon))


def flown(made: Scene, time: float, velocity: float) -> tuple[float, float, float]:
    """Return time, V' and u_in of the next impact of the map, which is compared with brute force elsewhere."""
    impact = next_impact(made, time, velocity)
    assert int(impact.outcome) == Outcome.IMPACT
    approach = made.platform.velocity(impact.arrival_time_us) - impact.velocity_before_nm_per_us
    return float(impact.time_us), float(impact.velocity_after_nm_per_us), float(approach)


@pytest.mark.slow
@pytest.mark.parametrize(("impacts", "order"), [(2, 2), (3, 4)])
def test_orbits_repeat_when_they_are_flown(impacts: int, order: int):
    n, r = 1.24, 0.5
    omega, found = 2.0 * n * FREE, many_impact_orbits(scene(n, r), order, impacts)
    if impacts == 2 and order == 2:
        assert found.stable.sum() == 1
    for index in range(len(found.stable)):
        phases, after = found.reading.phase_rad[index], found.reading.velocity_after_nm_per_us[index]
        time, velocity = float(phases[0]) / omega, float(after[0])
        for place in range(1, impacts + 1):
            time, velocity, approach = flown(scene(n, r), time, velocity)
            where = place % impacts
            assert np.exp(1j * omega * time) == pytest.approx(np.exp(1j * phases[where]), abs=1e-7)
            assert velocity == pytest.approx(float(after[where]), abs=1e-7)
            assert approach == pytest.approx(float(found.reading.approach_speed_nm_per_us[index, where]), abs=1e-7)
        assert omega * time - phases[0] == pytest.approx(2.0 * np.pi * order, abs=1e-7)
        assert found.reading.determinant[index] == pytest.approx(r ** (2 * impacts), rel=1e-8)


@pytest.mark.slow
@pytest.mark.parametrize(
    "law", [ImpactLaw(1.0, 60.0, 0.5), ImpactLaw(0.9999, 0.0, 0.48, CollisionDelay(0.206, 5.64, 0.726))]
)
def test_one_impact_is_the_single_impact_orbit(law: ImpactLaw):
    damped = Scene(Cantilever(90.0, 40.0), Platform(4.0, 181.8, -1.0), law)
    found, exact = many_impact_orbits(damped, 1, 1), single_impact_orbits(damped, 1)
    good = np.flatnonzero(np.asarray(exact.admissible))
    rank = good[np.argsort(-np.asarray(exact.peak_amplitude_nm)[good])]
    assert len(found.stable) == len(rank) > 0
    assert found.stable.tolist() == np.asarray(exact.stable)[rank].tolist()
    for name in ("phase_rad", "velocity_after_nm_per_us", "delay_us", "trace", "determinant", "peak_amplitude_nm"):
        # impacts have a column of their own
        value = getattr(found.reading, name).reshape(len(rank), -1)[:, 0]
        expected = np.asarray(getattr(exact, name))[rank]
        of_orbit = name in {"trace", "determinant", "peak_amplitude_nm"}
        rtol, atol = (1e-8, 0.0) if of_orbit else (1e-9, 1e-9)
        np.testing.assert_allclose(value, expected, rtol=rtol, atol=atol, err_msg=name)
