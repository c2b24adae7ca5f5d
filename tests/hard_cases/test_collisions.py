"""Collisions at the edges: turning in the bridge, strong drag, extreme speeds, missing viscosity, 32 bits."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from afm_jax.contact.collide import collide
from afm_jax.contact.contact import Contact
from afm_jax.contact.junction import find_junction
from afm_jax.outcomes import CollisionOutcome
from tests import reference_contact as exact
from tests.collisions_of_eight import collide_in_eights


def crossed_in_time(contact, speed, inner_nm):
    """Return speed and time at which SciPy leaves the bridge again, in time and with events; None if it does not."""
    static = jax.jit(lambda gap, rate: contact.forces(gap, rate))  # noqa: PLW0108 (modules with arrays do not hash)

    def rates(_, state):
        return [state[1], float(static(state[0], state[1]))]

    def crossing(gap_nm, direction):
        def event(_, state):
            return state[0] - gap_nm

        vars(event).update(terminal=True, direction=direction)
        return event

    leaves, deep = crossing(float(contact.bridge_breaks_nm), 1.0), crossing(inner_nm, -1.0)
    start = [float(contact.bridge_forms_nm), -speed]
    path = solve_ivp(rates, (0.0, 40.0), start, method="DOP853", rtol=1e-11, atol=1e-13, events=[leaves, deep])
    assert not path.t_events[1].size, "the tip reached the junction"
    return (path.y_events[0][0][1], path.t_events[0][0]) if path.t_events[0].size else None


@pytest.mark.parametrize("speed", [1.7, 3.0])
def test_a_sharp_tip_turns_in_the_bridge(speed):
    # R = 5 nm: the structural force is a barrier of some 20 aJ
    contact = Contact.paper(tip_radius_nm=5.0)
    result = collide_in_eights(contact, speed)
    assert int(result.outcome[0]) == CollisionOutcome.TURNED_IN_BRIDGE
    left = crossed_in_time(contact, speed, float(find_junction(contact).forms_gap_nm))
    assert left is not None
    rebound, time = left
    assert result.rebound_speed_nm_per_us[0] == pytest.approx(rebound, rel=1e-8)
    delay = time - float(contact.bridge_forms_nm) / speed - float(contact.bridge_breaks_nm) / rebound
    assert result.collision_delay_us[0] == pytest.approx(delay, abs=1e-7)
    assert result.junction_hysteresis_aj[0] == 0.0
    assert result.deepest_gap_nm[0] > float(find_junction(contact).forms_gap_nm)


def test_a_sharp_and_slow_tip_is_captured_by_the_bridge():
    contact = Contact.paper(tip_radius_nm=5.0)
    result = collide_in_eights(contact, 1.6)
    assert crossed_in_time(contact, 1.6, float(find_junction(contact).forms_gap_nm)) is None
    assert int(result.outcome[0]) == CollisionOutcome.CAPTURED_BY_BRIDGE


@pytest.mark.parametrize("changes", [{}, {"relative_humidity": 0.01}, {"relative_humidity": 0.99}], ids=str)
def test_very_fast_and_very_slow_tips(changes):
    result = collide_in_eights(Contact.paper(**changes), [1e-6, 1e-2, 1.0, 1e4, 1e6])
    assert list(np.asarray(result.captured)) == [True, True, True, False, False]
    expected = exact.collision(exact.ContactParameters(**changes), 1e4, digits=20)
    assert float(result.rebound_speed_nm_per_us[3]) == pytest.approx(float(expected.rebound_speed_nm_per_us), rel=1e-12)
    assert float(result.collision_delay_us[3]) == pytest.approx(float(expected.delay_us), rel=1e-9)
    for part in result:
        assert np.isfinite(np.asarray(part)).all()


def test_syrup_captures_every_tip_of_an_afm():
    result = collide_in_eights(Contact.paper(viscosity_pa_s=1.005), [1.0, 12.0, 60.0, 200.0, 260.0])
    # mpmath: capture speed 271.337 nm/us (test_collide.py)
    assert np.asarray(result.captured).all()
    thick = collide_in_eights(Contact.paper(viscosity_pa_s=1e3), [12.0, 200.0])
    assert (np.asarray(thick.captured) | (np.asarray(thick.outcome) == CollisionOutcome.UNRESOLVED)).all()


def test_core_far_inside_needs_no_more_than_a_small_gap():
    parameters = exact.ContactParameters(core_constant_j_m6=1e-84)
    result = collide_in_eights(Contact.paper(core_constant_j_m6=1e-84), 30.0)
    expected = exact.collision(parameters, 30.0, digits=20)
    assert result.rebound_speed_nm_per_us[0] == pytest.approx(float(expected.rebound_speed_nm_per_us), rel=1e-8)


@pytest.mark.slow
def test_thirty_two_bits_keep_four_digits():
    speeds = np.linspace(12.0, 200.0, 40)
    wide = collide_in_eights(Contact.paper(), speeds)
    with jax.enable_x64(new_val=False), jax.numpy_dtype_promotion("standard"):
        narrow = collide(Contact.paper(), jnp.asarray(speeds, jnp.float32), accuracy=1e-6)
        rebound, delay = np.asarray(narrow.rebound_speed_nm_per_us), np.asarray(narrow.collision_delay_us)
    assert rebound.dtype == np.float32
    assert not np.asarray(narrow.captured).any()
    # measured: 3e-6 relative and 2e-5 us; energies of 100 aJ leave 1e-5 aJ
    np.testing.assert_allclose(rebound, wide.rebound_speed_nm_per_us, rtol=3e-5)
    np.testing.assert_allclose(delay, wide.collision_delay_us, rtol=0, atol=2e-4)
