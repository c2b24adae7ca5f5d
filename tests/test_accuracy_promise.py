"""`accuracy=` of collisions holds for contacts, masses and speeds that no setting was chosen by, near capture included.

Judged against many small steps, whose own error is measured by fewer of them; the contact itself is compared with
independent integrations elsewhere (tests/reference_contact.py).
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from afm_jax.contact.collide import Collision, batch_of, capture_speed, collide
from afm_jax.contact.contact import Contact
from afm_jax.contact.settings import METHODS, Setting
from tests.driven_contacts import exact, how_far_off, random_tips, through

TIPS = 400
HELD_SHARE = 0.995
LEVELS = (1e-3, 1e-6, 1e-9, 1e-11)


@pytest.fixture(scope="module")
def tips() -> tuple[Contact, jax.Array, jax.Array, np.ndarray]:
    """Contacts, masses in ng, speeds in nm/us, and how much rounding of the speed alone moves the rebound speed."""
    draw = np.random.default_rng(7)

    def between(low: float, high: float) -> jax.Array:
        return jnp.asarray(np.exp(draw.uniform(np.log(low), np.log(high), TIPS)))

    contact = Contact.paper(
        relative_humidity=between(0.2, 0.8),
        adhesion_energy_j_per_m2=between(0.15, 0.6),
        viscosity_pa_s=between(1e-4, 1e-2),
        modulus_gpa=between(30.0, 300.0),
    )
    contact = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (TIPS,)), contact)
    mass = between(0.3, 10.0)
    above = between(1e-7, 20.0)
    speeds = jax.jit(jax.vmap(capture_speed))(contact, mass) * (1.0 + above)
    square = (1.0 + np.asarray(above)) ** 2
    return contact, mass, speeds, 3.0 * np.finfo(float).eps * square / (square - 1.0)


@pytest.fixture(scope="module")
def reference(tips) -> Collision:
    contact, mass, speeds, rounding = tips
    finer, coarser = (
        batch_of(contact, mass, speeds, Setting("steps", steps, steps, 64, careful=True)) for steps in (512, 384)
    )
    assert not np.asarray(finer.captured).any()
    rebound, delay = errors(coarser, finer, rounding)
    assert np.mean((rebound < 5e-12) & (delay < 5e-12)) >= HELD_SHARE
    return finer


def errors(found: Collision, exact: Collision, rounding: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return relative errors of rebound speeds, and errors of delays in us or relative to delays of more than 1 us."""
    rebound = np.abs(np.asarray(found.rebound_speed_nm_per_us) / np.asarray(exact.rebound_speed_nm_per_us) - 1.0)
    lasted = np.maximum(np.abs(np.asarray(exact.collision_delay_us)), 1.0)
    delay = np.abs(np.asarray(found.collision_delay_us) - np.asarray(exact.collision_delay_us)) / lasted
    return np.maximum(rebound - rounding, 0.0), np.maximum(delay - rounding, 0.0)


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS)
@pytest.mark.long
def test_every_level_holds_for_random_contacts(tips, reference, method):
    contact, mass, speeds, rounding = tips
    for accuracy in LEVELS:
        found = collide(contact, speeds, mass, accuracy=accuracy, method=method)
        rebound, delay = errors(found, reference, rounding)
        assert np.mean(rebound <= accuracy) >= HELD_SHARE, accuracy
        assert np.mean(delay <= 10.0 * accuracy) >= HELD_SHARE, accuracy


@pytest.mark.slow
@pytest.mark.long
def test_every_level_holds_for_random_driven_contacts():
    tips = random_tips(64, 11)
    right = exact(tips)
    assert np.isfinite(right[0]).sum() > 20
    for accuracy in (1e-6, 1e-9, 1e-11):
        off = how_far_off(jax.tree.map(np.asarray, through(jax.tree.map(jnp.asarray, tips), accuracy)), right)
        # python -m tests.driven_contacts --tips 1024 tells at which share
        assert off.max() <= accuracy, accuracy
