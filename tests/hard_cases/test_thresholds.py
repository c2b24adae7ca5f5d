"""Contacts whose thresholds coincide, and stiff ones.

Hard: where the bridge breaks just where the junction does, the way out has a leg of length zero on one side and none
on the other; a stiff core or a stiff solid has scales a hundred times shorter than the paper's contact.

Right answer: tests/reference_contact.py, Taylor steps and quadrature in mpmath; of slopes, its differences.
"""

from typing import Any

import jax
import jax.numpy as jnp
import pytest

from afm_jax.contact.collide import collide
from afm_jax.contact.contact import Contact
from afm_jax.contact.junction import find_junction
from afm_jax.outcomes import CollisionOutcome
from tests import reference_contact as exact
from tests.collisions_of_eight import collide_in_eights

pytestmark = pytest.mark.slow

# about where the junction of the paper's contact breaks; below, to all digits
BREAKS_NM = 0.504203


def compare(changes: dict[str, Any], speed: float) -> None:
    mine = collide_in_eights(Contact.paper(**changes), speed)
    expected = exact.collision(exact.ContactParameters(**changes), speed, digits=20)
    assert int(mine.outcome[0]) == CollisionOutcome.REBOUND
    # the promise of 1e-9; a stiff contact is the same one on a shorter scale
    assert mine.rebound_speed_nm_per_us[0] == pytest.approx(float(expected.rebound_speed_nm_per_us), rel=4e-9)
    assert mine.collision_delay_us[0] == pytest.approx(float(expected.delay_us), abs=2e-8)


@pytest.mark.parametrize("away", [-1e-3, 0.0, 1e-15])
def test_the_bridge_breaks_where_the_junction_does(away: float):
    breaks = float(find_junction(Contact.paper()).breaks_gap_nm)
    assert breaks == pytest.approx(BREAKS_NM, abs=1e-5)
    compare({"bridge_forms_nm": 0.3, "bridge_breaks_nm": breaks * (1.0 + away)}, 14.0)


@pytest.mark.parametrize(
    "changes",
    [
        {"bridge_forms_nm": 0.13, "bridge_breaks_nm": 0.13},
        {"core_constant_j_m6": 1e-72, "modulus_gpa": 1e4},
        {"modulus_gpa": 1e5, "adhesion_energy_j_per_m2": 3.0},
    ],
    ids=str,
)
def test_coinciding_and_stiff_contacts(changes: dict[str, Any]):
    compare(changes, 60.0)


NAMES = ("bridge_breaks_nm", "modulus_gpa")


@jax.jit
def _slopes(values):
    def ends(values):
        result = collide(Contact.paper(bridge_forms_nm=0.3, **values), jnp.array([60.0]))
        return result.rebound_speed_nm_per_us[0], result.collision_delay_us[0]

    return jax.jacfwd(ends)(values)


@pytest.mark.parametrize("changes", [{"bridge_breaks_nm": 0.5043}, {"modulus_gpa": 1e4}])
def test_their_slopes(changes: dict[str, float]):
    values: Any = {"bridge_breaks_nm": 4.7, "modulus_gpa": 100.0} | changes
    mine = _slopes(values)
    for name in NAMES:
        parameters = exact.ContactParameters(bridge_forms_nm=0.3, **values)
        want = exact.differences(parameters, 60.0, name, digits=20)
        for ours, theirs in zip(mine, (want.rebound_speed, want.delay), strict=True):
            assert float(ours[name]) == pytest.approx(float(theirs), rel=1e-6, abs=1e-10)
