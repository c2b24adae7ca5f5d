"""Derivatives of rebound speed and delay: forward, reverse, and high-precision differences."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from afm_jax.contact.capture import capture_speed
from afm_jax.contact.collide import collide
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
    "structural_amplitude_n_per_m",
    "temperature_k",
)
SPEEDS = (13.0, 60.0)


def outputs(method, values):
    """Return rebound speeds and delays at the test's speeds, for (speed factor, parameters)."""
    factor, *parameters = values
    contact = Contact.paper(**dict(zip(NAMES, parameters, strict=True)))
    result = collide(contact, factor * jnp.array(SPEEDS), method=method)
    return jnp.stack([result.rebound_speed_nm_per_us, result.collision_delay_us])


PAPER = [1.0, *(float(getattr(exact.ContactParameters(), name)) for name in NAMES)]


@pytest.fixture(scope="module", params=["diffrax", "collocation"])
def jacobians(request):
    def both(values):
        return jax.jacfwd(lambda v: outputs(request.param, v))(values), jax.jacrev(lambda v: outputs(request.param, v))(
            values
        )

    return jax.jit(both)(PAPER)


def test_forward_and_reverse_agree(jacobians):
    forward, reverse = (np.stack(tree) for tree in jacobians)
    for ours, theirs in zip(forward.reshape(-1, 4), reverse.reshape(-1, 4), strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("name", ["approach_speed", *NAMES])
def test_derivatives_agree_with_high_precision_differences(jacobians, name):
    place = 0 if name == "approach_speed" else 1 + NAMES.index(name)
    ours = np.asarray(jacobians[0][place])
    for column, speed in enumerate(SPEEDS):
        expected = exact.differences(exact.ContactParameters(), speed, name, digits=22)
        scale = speed if name == "approach_speed" else 1.0
        assert ours[0, column] == pytest.approx(scale * float(expected.rebound_speed), rel=1e-6)
        # relative to the delay's own sensitivity; at 60 nm/us some derivatives nearly vanish
        assert ours[1, column] == pytest.approx(scale * float(expected.delay), rel=1e-6, abs=1e-8)


@pytest.mark.parametrize("name", ["viscosity_pa_s", "modulus_gpa", "adhesion_energy_j_per_m2"])
def test_capture_speed_has_derivatives(name):
    value = float(getattr(exact.ContactParameters(), name))
    slope = jax.grad(lambda x: capture_speed(Contact.paper(**{name: x})))(value)
    expected = float(exact.capture_difference(exact.ContactParameters(), name, digits=22))
    assert float(slope) == pytest.approx(expected, rel=1e-6)


def test_gradients_are_finite_whatever_the_outcome():
    speeds = jnp.array([-1.0, 1e-3, 5.0, 10.938450059, 10.9384500597, 1e4])

    def total(values, speeds):
        contact = Contact.paper(**dict(zip(NAMES, values, strict=True)))
        result = collide(contact, speeds)
        return jnp.sum(result.rebound_speed_nm_per_us) + jnp.sum(result.collision_delay_us)

    for part in jax.tree.leaves(jax.jit(jax.grad(total, argnums=(0, 1)))(PAPER[1:], speeds)):
        assert np.isfinite(np.asarray(part)).all()
