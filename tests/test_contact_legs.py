"""The quick way through driven contacts, leg by leg, and work on a few tips of a batch, against independent ones."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from afm_jax.contact.bridge_leg import go_in
from afm_jax.contact.collide import collide
from afm_jax.contact.contact import Contact
from afm_jax.contact.driven import ContactState, Driven, driven_by, free_tip
from afm_jax.contact.junction import ContactPhase, find_junction
from afm_jax.contact.settings import DRIVEN_SETTINGS, DrivenSetting, QuickSetting, driven_setting_of
from afm_jax.contact.step import TipInContact, advance
from afm_jax.motion.contact_motion import legs_through
from afm_jax.scenefile.presets import contact_scene
from afm_jax.solve.lanes import repeat_for
from tests.reference_driven_contact import DrivenContact, follow
from tests.test_simulate_contact import column

SYSTEM = DrivenContact(amplitude_nm=4.0, drive_frequency_khz=180.0 * 5.277)


@pytest.fixture(scope="module")
def contacts():
    """Contacts of an independent integration to 12 digits: straight ones, and some that form the junction twice."""
    start = SYSTEM.start(phase_deg=270.0, height_nm=5.0, velocity_nm_per_us=60.0)
    return follow(SYSTEM, *start, contacts=16).contacts


SCENE = contact_scene(5.277, 4.0, 0.0)


@partial(jax.jit, static_argnums=2)
def through_contact(driven: Driven, state: ContactState, quick: QuickSetting) -> TipInContact:
    """Return tips after the three legs of their contact; DRY those whose legs all hold."""
    arrives = jnp.ones(state.x.shape, bool)
    return legs_through(
        DrivenSetting(quick, 5.5, 1), driven, TipInContact.arriving(driven, state, arrives), arrives, arrives, jnp.inf
    )


def at_threshold(gap_nm, gap_rate, time) -> ContactState:
    rates = jnp.asarray(gap_rate)
    return ContactState(jnp.full_like(rates, gap_nm), rates, jnp.full_like(rates, time), jnp.zeros_like(rates))


def quick_of(accuracy: float) -> QuickSetting:
    quick = driven_setting_of(accuracy).quick
    assert quick is not None
    return quick


@pytest.fixture(scope="module")
def driven():
    return driven_by(SCENE.interaction, SCENE.cantilever, SCENE.platform)


# errors allowed: of the rebound speed (relative) what the setting promises, of times in us a tenth of it
@pytest.mark.parametrize("accuracy", [1e-9, pytest.param(min(DRIVEN_SETTINGS), marks=pytest.mark.slow)])
def test_straight_contacts_are_those_of_an_independent_integration(contacts, driven, accuracy):
    arrivals = column(contacts, "arrival_time_us"), -column(contacts, "approach_speed_nm_per_us")
    leg = through_contact(driven, at_threshold(driven.forms_nm, arrivals[1], arrivals[0]), quick_of(accuracy))
    holds = np.asarray(leg.phase) == ContactPhase.DRY
    assert holds.sum() >= 8
    # what holds formed the junction once
    assert (column(contacts, "junctions")[holds] == 1).all()
    assert (column(contacts, "junctions") != 1).any()
    straight = [contact for contact, one in zip(contacts, holds, strict=True) if one]
    rebound, left = column(straight, "rebound_speed_nm_per_us"), column(straight, "departure_time_us")
    np.testing.assert_allclose(leg.state.gap_rate[holds], rebound, rtol=accuracy)
    np.testing.assert_allclose(leg.state.time_us[holds], left, rtol=0.0, atol=0.1 * accuracy)
    # the loss is a small part of the energy, and no more accurate than that
    lost = column(straight, "viscous_loss_aj")
    np.testing.assert_allclose(leg.state.viscous_loss_aj[holds], lost, rtol=10.0 * accuracy)
    # where the speed is 0 an error of it counts twice; the reference reads the turning point from its steps
    np.testing.assert_allclose(leg.deepest_gap_nm[holds], column(straight, "deepest_gap_nm"), rtol=0.0, atol=1e-5)


def test_a_leg_says_where_it_does_not_hold(driven):
    # a platform that falls away as fast as the tip comes, one that rises: the first tips turn in the bridge
    rates = [-0.1, -1.0, 20.0, jnp.nan, -60.0]
    state = at_threshold(3.5, rates, 0.5 * float(SCENE.platform.period_us))
    assert go_in(driven, state, quick_of(1e-6)).holds.tolist() == [False, False, False, False, True]


@pytest.fixture(scope="module")
def free():
    """Free tips where the bridge forms, and what `collide` says of them."""
    contact, speeds = Contact.paper(), jnp.asarray([12.5, 15.0, 22.0, 45.0, 120.0, 200.0])
    tip = free_tip(contact, find_junction(contact), jnp.asarray(1.0))
    return tip, at_threshold(tip.forms_nm, -speeds, 0.0), collide(contact, speeds, accuracy=1e-11)


def assert_leaves(state: ContactState, expected):
    """Compare with a collision: 1e-9 of the speed, 1e-10 us of the time, as driven contacts promise."""
    np.testing.assert_allclose(state.gap_rate, expected.rebound_speed_nm_per_us, rtol=1e-9)
    np.testing.assert_allclose(state.time_us, expected.time_in_contact_us, rtol=0.0, atol=1e-10)
    np.testing.assert_allclose(state.viscous_loss_aj, expected.viscous_loss_aj, rtol=1e-9)


def test_the_legs_of_driven_contacts_take_a_free_tip_where_collide_does(free):
    tip, state, expected = free
    leg = through_contact(tip, state, QuickSetting(24, 18, 30, 24, 1e-9, 12, 2, 1e-2))
    assert (np.asarray(leg.phase) == ContactPhase.DRY).all()
    assert_leaves(leg.state, expected)
    np.testing.assert_allclose(leg.deepest_gap_nm, expected.deepest_gap_nm, rtol=1e-12)


def test_steps_in_time_take_a_free_tip_where_collide_does(free):
    tip, state, expected = free

    @jax.jit
    def through(state):
        def more(touch):
            after = advance(tip, touch, jnp.asarray(100.0), 6.0)
            inside = touch.phase != ContactPhase.DRY
            return jax.tree.map(lambda new, old: jnp.where(inside, new, old), after, touch)

        touch = TipInContact.at_start(state, jnp.full(state.x.shape, ContactPhase.BRIDGE))
        return jax.lax.while_loop(lambda touch: jnp.any(touch.phase != ContactPhase.DRY), more, touch)

    touch = through(state)
    assert_leaves(touch.state, expected)
    np.testing.assert_allclose(touch.time_in_junction_us, expected.time_in_junction_us, rtol=0.0, atol=1e-10)


@pytest.mark.parametrize("block", [3, 64])
def test_the_few_get_what_each_would_alone(block):
    # halved until below the limit of its own: Collatz-like work of a very uneven number of passes
    def halved(value, limit):
        return jnp.where(value > limit, 0.5 * value, value)

    few = repeat_for(halved, lambda value, limit: value > limit, changed=0, passes=9, block=block)
    values, limit = jnp.linspace(0.5, 900.0, 40), jnp.asarray(1.0)
    together = jax.vmap(few, in_axes=(0, None))(values, limit)
    alone = jnp.stack([few(value, limit) for value in values])
    times = np.clip(np.ceil(np.log2(np.asarray(values))), 0, 9)
    # powers of two are exact
    np.testing.assert_array_equal(np.asarray(together), np.asarray(values) * 0.5**times)
    np.testing.assert_array_equal(np.asarray(alone), np.asarray(together))
    slopes = jax.vmap(partial(jax.jvp, few))((values, jnp.full_like(values, 1.0)), (jnp.ones(40), jnp.zeros(40)))[1]
    np.testing.assert_array_equal(np.asarray(slopes), 0.5**times)
