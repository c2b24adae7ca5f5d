"""Tips that bounce ever lower until they rest, ride on the platform, and are let go.

Hard: infinitely many impacts in finite time, which have to be summed up; a release where gap, rate and acceleration
vanish together; and a captured tip that nothing holds.

Right answer: an event-driven loop of its own (tests/reference_law_motion.py): SciPy's DOP853 from event to event, every
impact of a series a row, a ride ends where the force on the tip changes sign.
"""

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from afm_jax.apparatus.cantilever import Cantilever
from afm_jax.apparatus.platform import Platform
from afm_jax.apparatus.scene import Scene
from afm_jax.impact.law import ImpactLaw
from afm_jax.motion.record import ContactKind, MotionOutcome
from tests.law_systems import PRESSING, PRESSING_DURATION, PRESSING_START, assert_same_rows, scene_of, simulated
from tests.reference_law_motion import Cosines, LawSystem, follow


def test_a_series_of_impacts_ends_at_rest_until_the_platform_lets_go():
    until, wall = PRESSING_START[0] + PRESSING_DURATION, PRESSING.platform.derivative
    course = follow(PRESSING, *PRESSING_START, until)
    result = simulated(scene_of(PRESSING), PRESSING_START, PRESSING_DURATION)
    assert int(result.outcome) == MotionOutcome.FINISHED
    kind = np.asarray(result.contacts.kind)
    rests = np.flatnonzero(kind == ContactKind.CHATTER)
    assert rests.size >= 2
    last = int(rests[0])
    assert last > 4
    # up to the rest impact by impact, as SciPy has them
    assert_same_rows(result, course, last)
    released = float(result.contacts.departure_time_us[last])
    arrived = float(result.contacts.arrival_time_us[last])
    exact = PRESSING.turns(released - 0.5, released + 0.5)
    # both roots to about 1e-13
    assert released == pytest.approx(exact, abs=1e-11)
    assert min(PRESSING.push(t) for t in np.linspace(arrived, released - 1e-6, 2000)) > 0.0
    assert float(result.contacts.rebound_speed_nm_per_us[last]) == 0.0
    assert float(result.contacts.departure_position_nm[last]) == pytest.approx(wall(0, exact), abs=1e-10)
    # after it, SciPy once more from the release
    onward = follow(PRESSING, exact, wall(0, exact), wall(1, exact), until)
    rows = range(last + 1, int(rests[1]))
    assert len(rows) > 2
    for row, here in zip(rows, onward.rows[: len(rows)], strict=True):
        # a flight that begins with gap ~ t^3: SciPy's 1e-13 nm is not seen in its impact
        assert float(result.contacts.arrival_time_us[row]) == pytest.approx(here[0], abs=1e-8)
        assert float(result.contacts.departure_velocity_nm_per_us[row]) == pytest.approx(here[3], abs=1e-7)


def test_a_rest_at_the_end_is_held():
    result = simulated(scene_of(PRESSING), PRESSING_START, 40.0)
    last = int(result.count) - 1
    assert int(result.outcome) == MotionOutcome.HELD
    assert int(result.contacts.kind[last]) == ContactKind.HELD
    assert float(result.contacts.departure_time_us[last]) == np.inf
    for order, value in enumerate((result.final.position_nm, result.final.velocity_nm_per_us)):
        assert float(value) == pytest.approx(PRESSING.platform.derivative(order, 43.0), abs=1e-11)


def test_a_tip_captured_without_adhesion_is_let_go_too():
    system = LawSystem(PRESSING.platform, r=0.5, viscous_loss=1.5, quality_factor=40.0)
    course = follow(system, *PRESSING_START, 75.0)
    result = simulated(scene_of(system), PRESSING_START, PRESSING_DURATION)
    assert int(result.count) == len(course.rows)
    assert_same_rows(result, course, len(course.rows))
    rebound = np.asarray(result.contacts.rebound_speed_nm_per_us)[: len(course.rows)]
    rested = np.asarray(result.contacts.departure_time_us - result.contacts.arrival_time_us)[: len(course.rows)] > 0.0
    assert rested.sum() >= 2
    np.testing.assert_array_equal(rebound == 0.0, rested)
    assert ContactKind.CHATTER not in np.asarray(result.contacts.kind)


@pytest.mark.parametrize(
    "system",
    [
        # at the top of a fast platform, which leaves the tip behind at once
        LawSystem(Cosines(0.0, 0.0, ((4.0, 181.8, 0.0),)), 0.9, quality_factor=40.0),
        # pressed by a slow one, which lets it go near its lowest point
        PRESSING,
    ],
    ids=["let go at once", "rides"],
)
def test_a_start_at_rest_on_the_platform_rides_until_it_lets_go(system):
    time = 0.0
    wall = system.platform.derivative
    start = (time, wall(0, time), wall(1, time))
    result = simulated(scene_of(system), start, 60.0)
    release = system.release(time, time + 60.0)
    assert float(result.contacts.departure_time_us[0]) == pytest.approx(release, abs=1e-11)
    assert float(result.contacts.arrival_time_us[0]) == time
    assert float(result.contacts.energy_lost_aj[0]) == 0.0
    course = follow(system, release, wall(0, release), wall(1, release), time + 60.0)
    assert len(course.rows) > 1
    for row, exact in enumerate(course.rows[:2], start=1):
        # SciPy's 1e-13 nm in a flight that begins with gap ~ t^2 or t^3
        assert float(result.contacts.arrival_time_us[row]) == pytest.approx(exact[0], abs=1e-8)
    sticky = simulated(scene_of(LawSystem(system.platform, 0.9, 40.0, quality_factor=40.0)), start, 60.0)
    assert int(sticky.outcome) == MotionOutcome.HELD
    assert int(sticky.count) == 1


def test_a_platform_that_stays_where_the_tip_rests_holds_it():
    # N = 0 throughout: no push, no pull
    scene = Scene(Cantilever(90.0, 40.0), Platform(0.0, 180.0), ImpactLaw(r=0.5, viscous_loss=0.5))
    result = simulated(scene, (0.0, 3.0, 0.0), 400.0)
    assert int(result.outcome) == MotionOutcome.HELD
    assert float(result.final.position_nm) == 0.0


def end_of_a_rest(offset: Any, r: Any) -> Any:
    """Return position and velocity after a rest, a function of what comes before it only through the release."""
    platform = Platform(5.0, 20.0, offset)
    scene = Scene(Cantilever(90.0, 40.0), platform, ImpactLaw(r))
    final = simulated(scene, PRESSING_START, 28.8).final
    return jnp.stack([final.position_nm, final.velocity_nm_per_us])


AT_REST = (4.0, 0.3)


@pytest.mark.slow
def test_slopes_after_a_rest_are_those_of_the_events():
    def ends(offset, r):
        system = LawSystem(replace(PRESSING.platform, offset=offset), r, quality_factor=40.0)
        course = follow(system, *PRESSING_START, PRESSING_START[0] + 28.8)
        return np.array([course.position, course.velocity])

    for place, slope in enumerate(jax.jit(jax.jacfwd(end_of_a_rest, argnums=(0, 1)))(*AT_REST)):
        step = 1e-3 * np.eye(2)[place]
        difference = (ends(*(AT_REST + step)) - ends(*(AT_REST - step))) / 2e-3
        assert np.all(np.abs(difference) > 1e-3)
        # second order in the step; the events are known to 1e-8 us
        np.testing.assert_allclose(slope, difference, rtol=1e-4, atol=1e-4)
