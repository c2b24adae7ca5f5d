"""A law with r = 0: every impact is a capture, whatever the speed.

Hard: the law cannot be read backwards (1/r), the map ends at its first impact, and a motion is all rides: the tip moves
with the platform until it lets go, at once where the platform pulls.

Right answer: the event-driven loop of `tests/reference_law_motion.py`; of the next impact the search of
`tests/brute_force.py`.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from afm_jax.apparatus.cantilever import Cantilever
from afm_jax.apparatus.platform import Platform
from afm_jax.apparatus.scene import Scene
from afm_jax.impact.jacobian import map_jacobian
from afm_jax.impact.law import ImpactLaw
from afm_jax.impact.map import iterate_map, next_impact
from afm_jax.impact.orbits import single_impact_orbits
from afm_jax.motion.record import MotionOutcome
from afm_jax.outcomes import Outcome
from tests.brute_force import Flights, first_impact
from tests.law_systems import PRESSING, PRESSING_START, assert_same_rows, scene_of, simulated
from tests.reference_law_motion import Cosines, LawSystem, follow

FAST = LawSystem(Cosines(0.0, 0.0, ((4.0, 181.8, 0.0),)), r=0.0, quality_factor=40.0)
"""A platform that mostly pulls where the tip comes down."""
SLOW = LawSystem(PRESSING.platform, r=0.0, quality_factor=40.0)


def test_the_law_says_so():
    law = ImpactLaw(0.0, epsilon=3.0, viscous_loss=0.5)
    for speed in (1e-9, 1.0, 1e6):
        assert bool(law.captures(speed))
        assert float(law.rebound_speed(speed)) == float(law.rebound_slope(speed)) == 0.0
    for one in (law, ImpactLaw(0.0)):
        assert float(one.capture_speed_nm_per_us) == np.inf


@pytest.mark.slow
@pytest.mark.parametrize(
    ("system", "start"), [(FAST, (0.0, 10.0, 0.0)), (SLOW, PRESSING_START)], ids=["let go at once", "rides"]
)
def test_a_motion_is_that_of_the_events(system: LawSystem, start: tuple[float, float, float]):
    until = start[0] + 80.0
    course = follow(system, *start, until)
    result = simulated(scene_of(system), start, 80.0)
    assert int(result.outcome) == (MotionOutcome.HELD if course.held else MotionOutcome.FINISHED)
    rows = len(course.rows)
    assert int(result.count) == rows > 1
    ends = np.asarray(result.contacts.departure_time_us)[:rows]
    np.testing.assert_array_equal(np.isinf(ends), np.isinf(np.array(course.rows)[:, 2]))
    assert_same_rows(result, course, rows - int(course.held))
    assert not np.asarray(result.contacts.rebound_speed_nm_per_us)[:rows].any()
    assert float(result.final.position_nm) == pytest.approx(course.position, abs=1e-7)
    rested = ends - np.asarray(result.contacts.arrival_time_us)[:rows]
    assert (rested > 1.0).any() if system is SLOW else not rested[1:].any()


@pytest.mark.slow
def test_the_map_ends_and_orbits_are_none():
    scene = scene_of(FAST)
    rows = iterate_map(scene, 1.0, 8.0, 2)
    assert rows.outcome.tolist() == [Outcome.CAPTURED, Outcome.NOT_REACHED]
    drive = 2e-3 * np.pi * 181.8
    flight = Flights(*(np.array([value]) for value in (90.0, 40.0, 4.0, 181.8, 0.0, 1.0, 8.0)))
    arrival = float(first_impact(flight, duration_us=20.0).arrival_time_us[0])
    # the search stops at 1e-13 us
    assert float(rows.arrival_time_us[0]) == pytest.approx(arrival, abs=1e-12)
    assert float(rows.velocity_after_nm_per_us[0]) == pytest.approx(-4.0 * drive * np.sin(drive * arrival), abs=1e-10)
    # a captured tip has no next flight to be linearised
    assert np.isnan(np.asarray(map_jacobian(scene, 1.0, 8.0))).all()

    def after(r, amplitude):
        scene = Scene(Cantilever(90.0, 40.0), Platform(amplitude, 181.8), ImpactLaw(r))
        orbits = single_impact_orbits(scene, 1)
        known = jnp.where(orbits.exists, orbits.peak_amplitude_nm, 0.0).sum()
        return next_impact(scene, 1.0, 8.0).velocity_after_nm_per_us + known, orbits.exists

    slopes, exists = jax.jacfwd(after, argnums=(0, 1), has_aux=True)(0.0, 4.0)
    assert not np.asarray(exists).any()
    # only the platform's velocity at the arrival is left of the impact
    step = 1e-5
    ends = [float(after(0.0, 4.0 + sign * step)[0]) for sign in (1.0, -1.0)]
    assert float(slopes[0]) == 0.0
    assert float(slopes[1]) == pytest.approx((ends[0] - ends[1]) / (2.0 * step), rel=1e-7)
