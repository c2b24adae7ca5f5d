"""The quick way through driven contacts, leg by leg, and work on a few tips of a batch, against independent ones."""

from functools import partial

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from afm_jax.contact.bridge_leg import (
    GRADING,
    collocate,
    driven_way,
    go_in,
    nothing_spent,
    pass_in_steps,
    way_rates,
    way_through,
)
from afm_jax.contact.collide import collide
from afm_jax.contact.contact import Contact
from afm_jax.contact.driven import ContactState, driven_by, free_tip
from afm_jax.contact.junction import Phase, find_junction
from afm_jax.contact.settings import DRIVEN_SETTINGS, QuickSetting, driven_setting_of
from afm_jax.contact.step import TipInContact, advance, eighth_order_step
from afm_jax.motion.contact_motion import cross
from afm_jax.scenefile.presets import contact_scene
from afm_jax.solve.lanes import repeat_for
from tests.reference_driven_contact import DrivenContact, follow

SYSTEM = DrivenContact(amplitude_nm=4.0, drive_frequency_khz=180.0 * 5.277)


@pytest.fixture(scope="module")
def contacts():
    """Contacts of an independent integration to 12 digits: straight ones, and some that form the junction twice."""
    start = SYSTEM.start(phase_deg=270.0, height_nm=5.0, velocity_nm_per_us=60.0)
    return follow(SYSTEM, *start, contacts=16).contacts


def crossed(contacts, setting: QuickSetting):
    scene = contact_scene(5.277, 4.0, 0.0)
    driven = driven_by(scene.interaction, scene.cantilever, scene.platform)
    time = jnp.asarray([contact.arrival_time_us for contact in contacts])
    speed = jnp.asarray([contact.approach_speed_nm_per_us for contact in contacts])
    state = ContactState(jnp.full_like(time, driven.forms_nm), -speed, time, jnp.zeros_like(time))
    return jax.jit(cross, static_argnums=2)(driven, state, setting)


def column(contacts, name: str) -> np.ndarray:
    return np.array([getattr(contact, name) for contact in contacts])


# errors allowed: of the rebound speed (relative) what the setting promises, of times in us a tenth of it
@pytest.mark.parametrize("accuracy", [1e-6, 1e-9, pytest.param(min(DRIVEN_SETTINGS), marks=pytest.mark.slow)])
def test_straight_contacts_are_those_of_an_independent_integration(contacts, accuracy):
    quick = driven_setting_of(accuracy).quick
    assert quick is not None
    leg = crossed(contacts, quick)
    holds = np.asarray(leg.holds)
    assert holds.sum() >= 8
    # what holds formed the junction once
    assert (column(contacts, "junctions")[holds] == 1).all()
    assert not holds[column(contacts, "junctions") != 1].any()
    assert (column(contacts, "junctions") != 1).any()
    rebound, left = column(contacts, "rebound_speed_nm_per_us"), column(contacts, "departure_time_us")
    np.testing.assert_allclose(np.asarray(leg.state.gap_rate)[holds], rebound[holds], rtol=accuracy)
    np.testing.assert_allclose(np.asarray(leg.state.time_us)[holds], left[holds], rtol=0.0, atol=0.1 * accuracy)
    lost = column(contacts, "viscous_loss_aj")
    # the loss is a small part of the energy, and no more accurate than that
    np.testing.assert_allclose(np.asarray(leg.state.viscous_loss_aj)[holds], lost[holds], rtol=10.0 * accuracy)
    deepest = column(contacts, "deepest_gap_nm")
    # where the speed is 0 an error of it counts twice; the reference reads the turning point from its steps
    np.testing.assert_allclose(np.asarray(leg.deepest_gap_nm)[holds], deepest[holds], rtol=0.0, atol=1e-5)


def test_a_leg_says_where_it_does_not_hold():
    scene = contact_scene(5.277, 4.0, 0.0)
    driven = driven_by(scene.interaction, scene.cantilever, scene.platform)
    quick = driven_setting_of(1e-6).quick
    assert quick is not None
    # a platform that falls away as fast as the tip comes, one that rises: the first tips turn in the bridge
    rates = jnp.asarray([-0.1, -1.0, 20.0, jnp.nan, -60.0])
    time = jnp.full_like(rates, 0.5 * float(scene.platform.period_us))
    leg = go_in(driven, ContactState(jnp.full_like(rates, 3.5), rates, time, jnp.zeros_like(rates)), quick)
    assert np.asarray(leg.holds).tolist() == [False, False, False, False, True]


@pytest.fixture(scope="module")
def free():
    """Free tips where the bridge forms, and what `collide` says of them."""
    contact, speeds = Contact.paper(), jnp.asarray([12.5, 15.0, 22.0, 45.0, 120.0, 200.0])
    tip = free_tip(contact, find_junction(contact), jnp.asarray(1.0))
    state = ContactState(jnp.full_like(speeds, tip.forms_nm), -speeds, jnp.zeros_like(speeds), jnp.zeros_like(speeds))
    return tip, state, collide(contact, speeds, accuracy=1e-11)


def assert_leaves(state: ContactState, expected):
    """Compare with a collision: 1e-9 of the speed, 1e-10 us of the time, as driven contacts promise."""
    np.testing.assert_allclose(state.gap_rate, expected.rebound_speed_nm_per_us, rtol=1e-9)
    np.testing.assert_allclose(state.time_us, expected.time_in_contact_us, rtol=0.0, atol=1e-10)
    np.testing.assert_allclose(state.viscous_loss_aj, expected.viscous_loss_aj, rtol=1e-9)


def test_the_legs_of_driven_contacts_take_a_free_tip_where_collide_does(free):
    tip, state, expected = free
    leg = jax.jit(cross, static_argnums=2)(tip, state, QuickSetting(24, 18, 30, 24, 1e-9, 12, 2, 1e-2))
    assert np.asarray(leg.holds).all()
    assert_leaves(leg.state, expected)
    np.testing.assert_allclose(leg.deepest_gap_nm, expected.deepest_gap_nm, rtol=1e-12)


def test_steps_in_time_take_a_free_tip_where_collide_does(free):
    tip, state, expected = free

    @jax.jit
    def through(state):
        def more(touch):
            after = advance(tip, touch, jnp.asarray(100.0), 6.0)
            inside = touch.phase != Phase.DRY
            return jax.tree.map(lambda new, old: jnp.where(inside, new, old), after, touch)

        touch = TipInContact.at_start(state, jnp.full(state.x.shape, Phase.BRIDGE))
        return jax.lax.while_loop(lambda touch: jnp.any(touch.phase != Phase.DRY), more, touch)

    touch = through(state)
    assert_leaves(touch.state, expected)
    np.testing.assert_allclose(touch.time_in_junction_us, expected.time_in_junction_us, rtol=0.0, atol=1e-10)


@pytest.mark.parametrize("inward", [True, False])
def test_both_integrators_take_a_driven_tip_through_the_bridge(inward):
    scene = contact_scene(5.277, 4.0, 0.0)
    driven = driven_by(scene.interaction, scene.cantilever, scene.platform)
    rates = jnp.asarray([40.0, 60.0, 200.0]) * (-1.0 if inward else 1.0)
    time = jnp.asarray([0.1, 0.3, 0.8]) * scene.platform.period_us
    gaps = driven.forms_nm if inward else driven.breaks_nm, driven.junction.forms_gap_nm
    state = ContactState(jnp.zeros_like(rates), rates, time, jnp.zeros_like(rates))

    @jax.jit
    def both(state):
        way = driven_way(driven, gaps, state, inward=inward)
        return pass_in_steps(way, 40), collocate(way, 30, 25).passage

    for stepped, swept in zip(*both(state), strict=True):
        np.testing.assert_allclose(stepped, swept, rtol=1e-10)
    # the drive counts: a free tip ends elsewhere
    alone = collocate(driven_way(driven._replace(drive=None), gaps, state, inward=inward), 30, 25).passage
    assert (np.abs(np.asarray(alone.energy_aj) / np.asarray(both(state)[1].energy_aj) - 1.0) > 1e-3).all()


@pytest.mark.slow
@pytest.mark.parametrize("solver", ["Dopri5", "Dopri8"])
def test_steps_in_the_gap_are_those_of_diffrax(solver):
    contact = Contact.paper()
    tip = free_tip(contact, find_junction(contact), jnp.asarray(1.0))
    speeds = jnp.asarray([15.0, 40.0, 200.0])
    gaps = tip.forms_nm, tip.junction.forms_gap_nm
    way = way_through(tip, gaps, 0.5 * speeds**2, jnp.ones_like(speeds), inward=True)
    ends = 1.0 - (1.0 - np.linspace(0.0, 1.0, 4)) ** GRADING
    solution = diffrax.diffeqsolve(
        diffrax.ODETerm(lambda fraction, state, _: way_rates(way, fraction, state)),
        getattr(diffrax, solver)(),
        0.0,
        1.0,
        None,
        nothing_spent(way),
        stepsize_controller=diffrax.StepTo(ts=jnp.asarray(ends)),
    )
    assert solution.ys is not None
    found = pass_in_steps(way, 3, solver)
    # the same sums in another order
    np.testing.assert_allclose(found.dissipated_aj, solution.ys[0][-1], rtol=1e-13)
    np.testing.assert_allclose(found.time_us, solution.ys[1][-1], rtol=1e-13)


def rates(state: ContactState) -> ContactState:
    """X'' = 2 x^3, of which x = 1/(1 + t) is a solution."""
    return ContactState(state.gap_rate, 2.0 * state.x**3, jnp.ones_like(state.x), jnp.zeros_like(state.x))


def test_a_step_in_time_is_that_of_diffrax():
    state, length = ContactState(*(jnp.array([value, 0.7]) for value in (1.0, -1.0, 0.0, 0.2))), jnp.array([0.3, 0.8])
    solver = diffrax.Dopri8()
    term = diffrax.ODETerm(lambda _, state, __: ContactState(*(length * rate for rate in rates(state))))
    memory = solver.init(term, 0.0, 1.0, state, None)
    expected = solver.step(term, 0.0, 1.0, state, None, memory, made_jump=False)[0]
    for found, wanted in zip(eighth_order_step(rates, state, length), expected, strict=True):
        np.testing.assert_allclose(found, wanted, rtol=1e-14, atol=1e-14)


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
