"""Derivatives of rebound speed and delay: forward, reverse, and high-precision differences."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from afm_jax.contact.collide import capture_speed, collide
from afm_jax.contact.contact import Contact
from tests import reference_contact as exact

NAMES = (
    "relative_humidity",
    "surface_tension_n_per_m",
    "viscosity_pa_s",
    "adhesion_energy_j_per_m2",
    "modulus_gpa",
    "tip_radius_nm",
    "bridge_forms_nm",
    "bridge_breaks_nm",
)
pytestmark = pytest.mark.slow

SPEEDS = (13.0, 60.0)


def outputs(method, values):
    """Return rebound speeds and delays at the test's speeds, for (speed factor, parameters)."""
    factor, *parameters = values
    contact = Contact.paper(**dict(zip(NAMES, parameters, strict=True)))
    result = collide(contact, factor * jnp.array(SPEEDS), method=method)
    return jnp.stack([result.rebound_speed_nm_per_us, result.collision_delay_us])


PAPER = [1.0, *(float(getattr(exact.ContactParameters(), name)) for name in NAMES)]


@pytest.fixture(scope="module")
def forward():
    return np.stack(jax.jit(jax.jacfwd(lambda values: outputs("diffrax", values)))(PAPER))


def test_forward_and_reverse_agree(forward):
    reverse = np.stack(jax.jit(jax.jacrev(lambda values: outputs("diffrax", values)))(PAPER))
    np.testing.assert_allclose(reverse, forward, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize(
    "name", ["approach_speed", "relative_humidity", "viscosity_pa_s", "modulus_gpa", "bridge_forms_nm"]
)
def test_derivatives_agree_with_high_precision_differences(forward, name):
    place = 0 if name == "approach_speed" else 1 + NAMES.index(name)
    # both speeds for the speed itself and for what is integrated; the rest at the slower one, where it matters more
    for column, speed in enumerate(SPEEDS if name in {"approach_speed", "viscosity_pa_s"} else SPEEDS[:1]):
        expected = exact.differences(exact.ContactParameters(), speed, name, digits=20)
        scale = speed if name == "approach_speed" else 1.0
        assert forward[place, 0, column] == pytest.approx(scale * float(expected.rebound_speed), rel=1e-6)
        # at 60 nm/us the delay's derivatives nearly vanish
        assert forward[place, 1, column] == pytest.approx(scale * float(expected.delay), rel=1e-6, abs=1e-8)


def test_capture_speed_has_derivatives():
    names = ("viscosity_pa_s", "modulus_gpa", "adhesion_energy_j_per_m2")
    values = [float(getattr(exact.ContactParameters(), name)) for name in names]
    slopes = jax.jacfwd(lambda x: capture_speed(Contact.paper(**dict(zip(names, x, strict=True)))))(values)
    for name, slope in zip(names, slopes, strict=True):
        expected = float(exact.capture_difference(exact.ContactParameters(), name, digits=20))
        assert float(slope) == pytest.approx(expected, rel=1e-6)


def test_gradients_keep_little_and_are_finite_whatever_the_outcome():
    hard = [-1.0, 1e-3, 5.0, 10.938450059, 10.9384500597, 1e4]
    speeds = jnp.array([*hard, *np.linspace(20.0, 60.0, 256 - len(hard))])

    def total(contact, speeds):
        result = collide(contact, speeds)
        return jnp.sum(result.rebound_speed_nm_per_us) + jnp.sum(result.collision_delay_us)

    program = jax.jit(jax.grad(total, argnums=(0, 1))).lower(Contact.paper(), speeds).compile()
    for part in jax.tree.leaves(program(Contact.paper(), speeds)):
        assert np.isfinite(np.asarray(part)).all()
    memory = program.memory_analysis()
    # 54 MB where the way itself is turned round
    assert memory is not None
    assert memory.temp_size_in_bytes < 25e6


def rebound(humidity, speed):
    return collide(Contact.paper(relative_humidity=humidity), speed).rebound_speed_nm_per_us


def test_vmap_gives_what_each_contact_gives():
    humidity, speeds = jnp.array([0.3, 0.5]), jnp.array([15.0, 11.0, 60.0])
    whole = jax.vmap(lambda h: collide(Contact.paper(relative_humidity=h), speeds))(humidity)
    for place, value in enumerate(humidity.tolist()):
        for name, part in collide(Contact.paper(relative_humidity=value), speeds)._asdict().items():
            np.testing.assert_allclose(getattr(whole, name)[place], part, rtol=1e-12, atol=1e-13, err_msg=name)


@pytest.mark.long
def test_second_derivatives_in_any_order_and_under_vmap():
    places = jnp.array([[0.3, 20.0], [0.5, 15.0]])

    def of(place):
        return rebound(*place)

    step = jnp.array([0.0, 1e-4])
    both = jax.jit(jax.vmap(lambda place: (jax.grad(of)(place), jax.hessian(of)(place))))
    slopes, forward_over_reverse = both(jnp.concatenate([places, places + step, places - step]))
    expected = (slopes[2:4] - slopes[4:]) / 2e-4
    np.testing.assert_allclose(forward_over_reverse[:2, 1], expected, rtol=1e-6)
    reverse_twice = jax.jit(jax.jacrev(jax.jacrev(of)))(places[0])
    np.testing.assert_allclose(reverse_twice, forward_over_reverse[0], rtol=1e-9)
