"""Collisions: the published table, mpmath at other parameters, energy, batches, outcomes."""

import jax.numpy as jnp
import numpy as np
import pytest

from afm_jax.contact.collide import capture_speed, collide
from afm_jax.contact.contact import Contact
from afm_jax.outcomes import CollisionOutcome
from afm_jax.solve.lanes import LANES
from tests import reference_contact as exact
from tests.collisions_of_eight import collide_in_eights

CAPTURE = 10.938450059496711  # mpmath, 25 digits


@pytest.mark.parametrize("method", ["diffrax", "collocation"])
def test_published_table_to_all_digits_printed(method):
    result = collide_in_eights(Contact.paper(), list(exact.PUBLISHED), method=method)
    rebound, delay = np.array(list(exact.PUBLISHED.values())).T
    # half a unit of the last digit
    np.testing.assert_allclose(result.rebound_speed_nm_per_us, rebound, rtol=0, atol=5.1e-5)
    np.testing.assert_allclose(result.collision_delay_us, delay, rtol=0, atol=5.1e-5)
    assert not result.captured.any()


def numbers_of(collisions, *names: str) -> list[np.ndarray]:
    """Return columns of the reference's collisions."""
    return [np.array([float(getattr(one, name)) for one in collisions]) for name in names]


@pytest.fixture(scope="module")
def of_mpmath():
    speeds = np.array([1.1 * CAPTURE, 12.7, 15.0, 22.0, 45.0, 200.0, 700.0])
    return speeds, [exact.collision(exact.ContactParameters(), float(speed), digits=20) for speed in speeds]


@pytest.mark.parametrize("method", ["diffrax", "collocation"])
def test_default_accuracy_is_reached_from_11_times_the_capture_speed(of_mpmath, method):
    speeds, expected = of_mpmath
    result = collide_in_eights(Contact.paper(), speeds, method=method)
    rebound, deepest, loss = numbers_of(expected, "rebound_speed_nm_per_us", "deepest_gap_nm", "viscous_loss_aj")
    delay, in_junction = numbers_of(expected, "delay_us", "time_in_junction_us")
    np.testing.assert_allclose(result.rebound_speed_nm_per_us, rebound, rtol=1e-9)
    np.testing.assert_allclose(result.collision_delay_us, delay, rtol=0, atol=1e-8)
    np.testing.assert_allclose(result.time_in_junction_us, in_junction, rtol=0, atol=1e-8)
    np.testing.assert_allclose(result.deepest_gap_nm, deepest, rtol=1e-9)
    np.testing.assert_allclose(result.viscous_loss_aj, loss, rtol=1e-7)


OTHERS = [
    {"modulus_gpa": 0.1},
    {"viscosity_pa_s": 1.005},
    {"bridge_forms_nm": 3.5, "bridge_breaks_nm": 3.5},
    {"mass_ng": 20.0},
    {"effects": ("capillary", "core", "viscous", "jkr")},
]


@pytest.mark.parametrize("changes", OTHERS, ids=str)
def test_other_contacts_agree_with_mpmath(changes):
    mass = changes.get("mass_ng", 1.0)
    contact = Contact.paper(**{name: value for name, value in changes.items() if name != "mass_ng"})
    parameters = exact.ContactParameters(**changes)
    bound = float(exact.capture_speed(parameters, digits=20))
    assert float(capture_speed(contact, mass)) == pytest.approx(bound, rel=1e-6)
    speeds = bound * np.array([1.0 - 1e-5, 1.0 + 1e-5, 1.1, 3.0])
    result = collide_in_eights(contact, speeds, mass)
    assert list(np.asarray(result.captured)) == [True, False, False, False]
    assert (result.outcome[2:] == CollisionOutcome.REBOUND).all()
    expected = [exact.collision(parameters, float(speed), digits=20) for speed in speeds[2:]]
    rebound, delay = numbers_of(expected, "rebound_speed_nm_per_us", "delay_us")
    # 1e-9 is measured at the paper's parameters; dissipation a hundred or a thousand times larger costs digits
    speed_error, time_error = (1e-6, 1e-6) if parameters.viscosity_pa_s > 0.01 else (4e-9, 2e-8)
    np.testing.assert_allclose(result.rebound_speed_nm_per_us[2:], rebound, rtol=speed_error)
    assert list(result.collision_delay_us[2:]) == pytest.approx(delay, rel=1e-7, abs=time_error)


def test_capture_speed():
    assert float(capture_speed(Contact.paper())) == pytest.approx(CAPTURE, rel=1e-9)


def test_within_a_billionth_of_capture_the_sides_are_told_apart():
    result = collide_in_eights(Contact.paper(), CAPTURE * np.array([1.0 - 1e-9, 1.0 + 1e-9]))
    assert result.outcome.tolist() == [CollisionOutcome.CAPTURED_BY_BRIDGE, CollisionOutcome.REBOUND]
    assert np.isfinite(result.collision_delay_us).all()


def test_the_energy_ledger_closes():
    speeds = np.array([11.0, 12.0, 20.0, 60.0, 200.0, 1e4])
    result = collide_in_eights(Contact.paper(modulus_gpa=1.0, adhesion_energy_j_per_m2=0.1), speeds, 2.5)
    kinetic = 0.5 * 2.5 * speeds**2
    lost = result.bridge_hysteresis_aj + result.junction_hysteresis_aj + result.viscous_loss_aj
    left = 0.5 * 2.5 * np.asarray(result.rebound_speed_nm_per_us) ** 2
    free = ~np.asarray(result.captured)
    assert free.sum() >= 3
    np.testing.assert_allclose((kinetic - lost)[free], left[free], rtol=0, atol=1e-8 * kinetic[free].min())


def test_a_static_contact_loses_its_hysteresis_at_every_speed():
    contact = Contact.paper(effects=("capillary", "structural", "core", "jkr"))
    # more than two blocks, the last one not full, in a shape of its own
    speeds = np.linspace(11.0, 300.0, 2 * (LANES + 44)).reshape(2, -1)
    result = collide(contact, speeds)
    # 55.75432 aJ: the sum of the static losses, in mpmath
    hysteresis = float(exact.junction(exact.ContactParameters()).hysteresis_aj)
    np.testing.assert_allclose(result.rebound_speed_nm_per_us, np.sqrt(speeds**2 - 2.0 * hysteresis), rtol=1e-11)


def test_contacts_without_junction_are_errors_alone_and_outcomes_in_a_batch():
    for work in (lambda contact: collide(contact, 20.0), capture_speed):
        with pytest.raises(ValueError, match=r"the contact has no junction: .*adhesion_energy_j_per_m2"):
            work(Contact.paper(adhesion_energy_j_per_m2=0.05))
    mixed = collide(Contact.paper(adhesion_energy_j_per_m2=jnp.array([0.05, 0.3])), jnp.array([20.0, 20.0]))
    assert mixed.outcome.tolist() == [CollisionOutcome.NO_JUNCTION, CollisionOutcome.REBOUND]
    assert np.isfinite(np.asarray(mixed.rebound_speed_nm_per_us)).all()


def test_impossible_speeds_are_outcomes():
    result = collide(Contact.paper(), jnp.array([-3.0, 0.0, jnp.nan, jnp.inf, 20.0]))
    assert result.outcome.tolist() == [CollisionOutcome.INVALID_START] * 4 + [CollisionOutcome.REBOUND]
    assert "positive finite" in CollisionOutcome.INVALID_START.sentence
