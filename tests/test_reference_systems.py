"""The 50-digit map is checked before anything is compared with it: closed forms, derivatives, printed equations."""

import pytest

from tests.reference_examples import DELAY, SCENES, digits, scene
from tests.reference_flight import mp
from tests.reference_systems import (
    capture_speed,
    constants,
    delay_us,
    differenced_jacobian,
    eq5,
    eq7,
    free_flight,
    iterate,
    map_jacobian,
    next_impact,
    platform_motion,
    rebound_slope,
    rebound_speed,
)


def test_free_flight_solves_its_equation_of_motion():
    p = scene()
    with mp.workdps(60):
        k, t = constants(p), mp.mpf("3.7")
        position = lambda s: free_flight(p, s, mp.mpf(3), mp.mpf(50))[0]  # noqa: E731
        z, v = free_flight(p, t, mp.mpf(3), mp.mpf(50))
        residual = mp.diff(position, t, 2) + 2 * k.decay * v + k.free**2 * z
        assert digits(v, mp.diff(position, t)) > 40  # mp.diff loses some of the 60 digits
        assert abs(residual) < mp.mpf(10) ** -35
        assert free_flight(p, 0, 3, 50) == (3, 50)


def test_platform_velocity_and_acceleration_are_derivatives():
    p = scene()
    with mp.workdps(60):
        t = mp.mpf("1.3")
        _, velocity, acceleration = platform_motion(p, t)
        assert digits(velocity, mp.diff(lambda s: platform_motion(p, s)[0], t)) > 40
        assert digits(acceleration, mp.diff(lambda s: platform_motion(p, s)[1], t)) > 40


def test_law_loses_the_energies_it_names_and_captures_where_nothing_is_left():
    p = SCENES["delayed"]
    with mp.workdps(60):
        u = mp.mpf(40)
        loss = u**2 - rebound_speed(p, u) ** 2
        exact = (1 - mp.mpf(p.r) ** 2) * u**2 + mp.mpf(p.viscous_loss) * u + mp.mpf(p.epsilon)
        assert digits(loss, exact) > 50
        assert digits(rebound_slope(p, u), mp.diff(lambda s: rebound_speed(p, s), u)) > 40
        # At the capture speed the root's argument is zero, here to the square root of the precision.
        assert abs(rebound_speed(p, capture_speed(p))) < mp.mpf(10) ** -25


def test_delay_is_near_that_of_the_contact_model():
    p = scene(delay=DELAY)
    for speed, contact in ((30, 0.0650), (40, 0.0750), (60, 0.0778), (100, 0.0746), (200, 0.0674)):
        # The law fits the contact model to 0.001 us rms; the table of physics.md has four decimals.
        assert float(delay_us(p, speed)) == pytest.approx(contact, abs=4e-3)


def test_a_guess_of_no_root_is_refused():
    with pytest.raises(ValueError, match="another root"):
        next_impact(scene(), 4, 60, 7.0)


@pytest.mark.parametrize("name", SCENES)
def test_the_two_jacobians_agree(name: str):
    p = SCENES[name]
    first = iterate(p, 4.0, 60.0, 1)[0]
    left = map_jacobian(p, 4.0, 60.0, first.arrival_time_us)
    right = differenced_jacobian(p, 4.0, 60.0, first.arrival_time_us)
    assert min(digits(left[i, j], right[i, j]) for i in range(2) for j in range(2)) > 50


def test_equations_5_and_7_make_the_jacobian():
    p = SCENES["paper"]
    impact = iterate(p, 4.0, 60.0, 1)[0]
    with mp.workdps(65):
        printed = eq7(p, impact.time_us, impact.velocity_before_nm_per_us) * eq5(p, 4.0, 60.0, impact.time_us)
        exact = map_jacobian(p, 4.0, 60.0, impact.time_us)
        assert min(digits(printed[i, j], exact[i, j]) for i in range(2) for j in range(2)) > 50
    with pytest.raises(ValueError, match="the paper's equations"):
        eq5(SCENES["damped"], 4.0, 60.0, impact.time_us)


def test_map_is_periodic_in_the_drive_and_captures_slow_tips():
    p = SCENES["delayed"]
    period = constants(p).drive_period
    here, later = iterate(p, 4.0, 60.0, 3), iterate(p, 4.0 + 1000 * period, 60.0, 3)
    # The period is known to 15 digits only outside a high-precision context.
    assert digits(later[-1].velocity_after_nm_per_us, here[-1].velocity_after_nm_per_us) > 9
    stuck = iterate(p, 0.0, 4.0, 50)
    assert stuck[-1].captured
    assert len(stuck) < 50
