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
)
from afm_jax.dynamics.impact_orbits import many_impact_orbits
from afm_jax.outcomes import Outcome


def flown(made: Scene, time: float, velocity: float) -> tuple[float, float, float]:
    """Return time, V' and u_in of the next impact of the map, which is compared with brute force elsewhere."""
    impact = next_impact(made, time, velocity)
    assert int(impact.outcome) == Outcome.IMPACT
    approach = made.platform.velocity(impact.arrival_time_us) - impact.velocity_before_nm_per_us
    return float(impact.time_us), float(impact.velocity_after_nm_per_us), float(approach)


TWO, THREE = (
    Scene(Cantilever(90.0), Platform(2.0, 180.0 * n, -1.0), ImpactLaw(r, 0.0)) for n, r in ((1.24, 0.5), (1.57, 0.8))
)
LASTING = Scene(
    Cantilever(90.0, 40.0),
    Platform(4.0, 181.8, -1.0),
    ImpactLaw(0.9999, 0.0, 0.48, CollisionDelay(0.206, 5.64, 0.726)),
)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("made", "impacts", "order", "determinant"), [(TWO, 2, 2, 0.5**4), (THREE, 3, 4, 0.8**6), (LASTING, 1, 1, None)]
)
def test_orbits_repeat_when_they_are_flown(made: Scene, impacts: int, order: int, determinant: float | None):
    omega, found = float(made.platform.angular_frequency), many_impact_orbits(made, order, impacts)
    assert len(found.stable) > 0
    if impacts == 2:
        assert found.stable.sum() == 1
    for index in range(len(found.stable)):
        phases, after = found.reading.phase_rad[index], found.reading.velocity_after_nm_per_us[index]
        time, velocity = float(phases[0]) / omega, float(after[0])
        for place in range(1, impacts + 1):
            time, velocity, approach = flown(made, time, velocity)
            where = place % impacts
            assert np.exp(1j * omega * time) == pytest.approx(np.exp(1j * phases[where]), abs=1e-7)
            assert velocity == pytest.approx(float(after[where]), abs=1e-7)
            assert approach == pytest.approx(float(found.reading.approach_speed_nm_per_us[index, where]), abs=1e-7)
        assert omega * time - phases[0] == pytest.approx(2.0 * np.pi * order, abs=1e-7)
        # without damping and adhesion
        assert determinant is None or found.reading.determinant[index] == pytest.approx(determinant, rel=1e-8)
