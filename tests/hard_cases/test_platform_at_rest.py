"""A platform that does not move, and touching at the start.

Hard: nothing sets the scale of a platform at rest (its top speed is 0), and a flight that begins at a speed of 1e-6
ends before its gap is more than rounding.

Right answers: closed forms of the free vibration, and 50 digits.
"""

from dataclasses import replace

import numpy as np
import pytest

from afm_jax.apparatus.cantilever import Cantilever
from afm_jax.apparatus.platform import Platform
from afm_jax.apparatus.scene import Scene
from afm_jax.impact.law import ImpactLaw
from afm_jax.motion.record import MotionOutcome
from afm_jax.motion.simulate import simulate
from afm_jax.motion.start import state
from afm_jax.outcomes import Outcome
from tests.hard_cases.maps import USUAL, both, compare, leaving

pytestmark = pytest.mark.slow

OMEGA = 2e-3 * np.pi * 90.0


@pytest.mark.parametrize("quality_factor", [0.6, 40.0, np.inf])
@pytest.mark.parametrize("r", [1e-12, 1.0])
def test_every_flight_lasts_half_a_ringing_period(quality_factor: float, r: float):
    scene = Scene(Cantilever(90.0, quality_factor), Platform(0.0, 181.8), ImpactLaw(r, 0.0))
    decay = 0.5 * OMEGA / quality_factor
    half = np.pi / np.sqrt(OMEGA**2 - decay**2)
    kept = r * np.exp(-decay * half)
    for speed in (1e-6, 1.0, 1e6):
        impact, jacobian = both(scene, 3.0, speed)
        assert int(impact.outcome) == Outcome.IMPACT
        assert float(impact.time_us) == pytest.approx(3.0 + half, abs=2e-13)
        assert float(impact.velocity_after_nm_per_us) == pytest.approx(kept * speed, rel=1e-12)
        # whenever it begins, however fast: a flight as long, in proportion
        np.testing.assert_allclose(np.asarray(jacobian)[0], [1.0, 0.0], atol=1e-12 * max(1.0, 1.0 / speed))
        assert float(jacobian[1, 1]) == pytest.approx(kept, rel=1e-12)


@pytest.mark.parametrize("rebound", [1e-2, 1e-6])
def test_a_start_that_hardly_leaves_the_platform(rebound: float):
    # at three tenths of a turn the platform presses: the tip is back after 2 u/(N/m)
    p = replace(USUAL, epsilon=0.0)
    # derivatives: rounding of the gap over its height, which goes as the square of the rebound
    compare(p, *leaving(p, 0.3, rebound), slopes=1e-9 + 1e-16 / rebound**2)


def test_a_tip_laid_on_a_platform_that_pushes_rests_and_one_that_is_lifted_leaves():
    # where the platform lies below rest the spring pulls the tip off: z = -2 cos(Omega t), back after a whole period
    scene = Scene(Cantilever(90.0), Platform(0.0, 181.8, -2.0), ImpactLaw(1.0))
    leaves = simulate(scene, state(0.0, -2.0, 0.0), 15.0, max_contacts=8)
    assert int(leaves.outcome) == MotionOutcome.FINISHED
    assert float(leaves.final.position_nm) == pytest.approx(-2.0 * np.cos(15.0 * OMEGA), abs=1e-6)
    pressed = Scene(Cantilever(90.0), Platform(0.0, 181.8, 2.0), ImpactLaw(1.0))
    rests = simulate(pressed, state(0.0, 2.0, 0.0), 15.0, max_contacts=8)
    assert int(rests.outcome) == MotionOutcome.HELD
    assert float(rests.final.position_nm) == 2.0
