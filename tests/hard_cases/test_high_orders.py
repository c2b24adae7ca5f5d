"""Orbits of order 50, and drives of 50 and a hundredth of the resonance.

Hard: the closing conditions have fifty times as many drive periods in them as in the figures, roots crowd together, and
which flights stay above the platform is a question of fifty crests.

Right answer: every root of the closing condition by scan and 50 digits (tests/reference_orbits.py), its slope by
differences of those.
"""

from dataclasses import replace

import jax
import numpy as np
import pytest

from afm_jax.impact.orbits import single_impact_orbits
from tests.hard_cases.maps import USUAL
from tests.package_scenes import scene_of
from tests.reference_flight import mp
from tests.reference_orbits import phases_and_speeds
from tests.reference_orbits import single_impact_orbits as exact_orbits

pytestmark = pytest.mark.slow

CASES = {
    "N = 50, n = 50": (replace(USUAL, drive_frequency_khz=180.0 * 50.02), 50),
    "N = 50, n = 49.98": (replace(USUAL, drive_frequency_khz=180.0 * 49.98, offset_nm=2.0), 50),
    "N = 50, n = 1.01": (replace(USUAL, quality_factor=1e5, epsilon=0.0), 50),
    "N = 1, n = 0.01": (replace(USUAL, drive_frequency_khz=1.8, quality_factor=1e3, epsilon=0.0), 1),
}
_found = jax.jit(single_impact_orbits)


@pytest.mark.parametrize("name", CASES)
def test_all_orbits_are_found(name: str):
    p, order = CASES[name]
    exact = exact_orbits(p, order)
    mine = _found(scene_of(p), float(order))
    slots = np.flatnonzero(mine.exists)
    assert len(slots) == len(exact) > 0
    assert bool(mine.complete)
    for slot, orbit in zip(slots, exact, strict=True):
        assert bool(mine.admissible[slot]) == orbit.admissible
        assert bool(mine.stable[slot]) == orbit.stable
        # the phase of the drive is rounded after N periods of it; conditions as at low orders
        away = (float(mine.phase_rad[slot] - float(orbit.phase_rad)) + np.pi) % (2 * np.pi) - np.pi
        assert abs(away) < 1e-11 * order
        for field in ("velocity_after_nm_per_us", "approach_speed_nm_per_us", "trace", "peak_amplitude_nm"):
            assert float(getattr(mine, field)[slot]) == pytest.approx(float(getattr(orbit, field)), rel=1e-10 * order)
        assert float(mine.lockin_amplitude_nm[slot]) == pytest.approx(float(orbit.lockin_amplitude_nm), rel=1e-8)


def test_their_slopes_are_differences_of_fifty_digits():
    p, order = CASES["N = 50, n = 50"]

    def speeds(offset):
        return _found(scene_of(replace(p, offset_nm=offset)), float(order)).approach_speed_nm_per_us

    slope = np.asarray(jax.jvp(speeds, (p.offset_nm,), (1.0,))[1])
    exists = np.asarray(_found(scene_of(p), float(order)).exists)
    with mp.workdps(50):
        step = mp.mpf("1e-12")
        ends = [
            sorted(u for _, u in phases_and_speeds(replace(p, offset_nm=p.offset_nm + s), order)) for s in (step, -step)
        ]
        want = [float((above - below) / (2 * step)) for above, below in zip(*ends, strict=True)]
    assert want
    np.testing.assert_allclose(slope[exists], want, rtol=1e-7)
