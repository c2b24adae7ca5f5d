"""The time course of one impact against SciPy in time, against `collide`, and its soft case."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from afm_jax.contact.collide import collide
from afm_jax.contact.contact import Contact
from afm_jax.contact.junction import ContactPhase, find_junction
from afm_jax.contact.time_course import time_course
from tests.reference_contact_forces import ContactParameters, constants, mp, static_force, viscous_force


@pytest.mark.parametrize("speed", [12.0, 60.0])
def test_the_course_leaves_as_collide_says(speed):
    course, result = time_course(Contact.paper(), speed), collide(Contact.paper(), speed)
    assert not course.captured
    assert np.all(np.diff(course.time_us) > 0.0)
    # collide's own accuracy: 1e-9 and 1e-8 us
    assert course.velocity_nm_per_us[-1] == pytest.approx(float(result.rebound_speed_nm_per_us), rel=1e-9)
    delay = course.time_us[-1] - course.gap_nm[-1] / course.velocity_nm_per_us[-1] - 3.5 / speed
    assert delay == pytest.approx(float(result.collision_delay_us), abs=1e-8)
    assert course.gap_nm.min() == pytest.approx(float(result.deepest_gap_nm), abs=1e-5)  # the nearest node


def test_the_way_in_is_that_of_scipy_in_time():
    course = time_course(Contact.paper(), 15.0)
    inside = (course.phase == ContactPhase.BRIDGE) & (course.velocity_nm_per_us < 0.0)
    with mp.workdps(20):
        k = constants(ContactParameters())

        def rates(_, state):
            gap, rate = state
            return [rate, float(static_force(k, gap) + viscous_force(k, gap, rate))]

        times = course.time_us[inside]
        path = solve_ivp(rates, (0.0, times[-1]), [3.5, -15.0], method="DOP853", rtol=1e-10, atol=1e-11, t_eval=times)
    np.testing.assert_allclose(course.gap_nm[inside], path.y[0], rtol=0, atol=1e-7)
    np.testing.assert_allclose(course.velocity_nm_per_us[inside], path.y[1], rtol=1e-7)


def test_force_is_the_rate_of_momentum_and_phases_follow_the_hysteresis():
    contact = Contact.paper()
    course = time_course(contact, 20.0, 2.0)
    for phase in (ContactPhase.BRIDGE, ContactPhase.JUNCTION):
        chosen = np.flatnonzero(course.phase == phase)[5:40]
        # central differences on an uneven grid
        slope = np.gradient(course.velocity_nm_per_us[chosen], course.time_us[chosen])
        scale = np.abs(course.force_nn[chosen]).max()
        np.testing.assert_allclose(2.0 * slope[1:-1], course.force_nn[chosen][1:-1], rtol=0, atol=0.02 * scale)
    junction, inwards = find_junction(contact), course.velocity_nm_per_us < 0.0
    assert set(course.phase) == set(ContactPhase)
    for way, bridge, solid in ((inwards, 3.5, junction.forms_gap_nm), (~inwards, 4.7, junction.breaks_gap_nm)):
        thresholds = (-np.inf, float(solid), bridge, np.inf)
        for phase, low, high in zip(
            (ContactPhase.JUNCTION, ContactPhase.BRIDGE, ContactPhase.DRY), thresholds, thresholds[1:], strict=False
        ):
            gap = course.gap_nm[(course.phase == phase) & way]
            # a point exactly on a threshold may count for either side
            assert np.all((gap >= low - 1e-9) & (gap <= high + 1e-9))


def test_a_soft_junction_breaks_straight_into_dry_air():
    course = time_course(Contact.paper(modulus_gpa=1.0), 60.0)
    out = course.phase[course.velocity_nm_per_us > 0.0]
    assert set(out) == {ContactPhase.JUNCTION, ContactPhase.DRY}
