"""What a fit of the contact holds: at which value, how well known, and what that does to the law."""

import numpy as np
import pytest
from fitting.fits.discrepancy import HeldEffect, ModelDiscrepancy
from fitting.fits.step import system_of

from afm_jax.contact.parameters import CONTACT_PARAMETERS, EFFECTS
from fitting.models import Held, Problem, held_of, split_held
from tests.test_discrepancy import LEFT_OUT, VALUES, rows

OWN = ("relative_humidity", "modulus_gpa")
__all__ = ["rows"]


def test_a_constraint_on_what_is_held_holds_it_there_and_says_how_well():
    known = {
        "structural_amplitude_n_per_m": (60.0, 2.0),
        "relative_humidity": (0.4, 0.02),
        "quality_factor": (40.0, 1.0),
    }
    values, others, errors = split_held(OWN, {"tip_radius_nm": 20.0}, known)
    assert values == {"tip_radius_nm": 20.0, "structural_amplitude_n_per_m": 60.0}
    assert others == {"relative_humidity": (0.4, 0.02), "quality_factor": (40.0, 1.0)}
    held = {one.name: one for one in held_of(OWN, EFFECTS, values, errors)}
    assert set(held) == {one.name for one in CONTACT_PARAMETERS} - set(OWN)
    assert held["structural_amplitude_n_per_m"] == Held("structural_amplitude_n_per_m", 60.0, 2.0, assumed=False)
    # 30 % where nothing is said, of the value that is held
    assert held["tip_radius_nm"]._replace(error=6.0) == Held("tip_radius_nm", 20.0, 6.0, assumed=True)
    assert held["tip_radius_nm"].error == pytest.approx(6.0)
    dry = held_of(OWN, ("core", "jkr"), values, errors)
    assert not {"structural_amplitude_n_per_m", "temperature_k", "viscosity_pa_s"} & {one.name for one in dry}


@pytest.mark.parametrize(
    ("fixed", "pair", "said"),
    [
        ({"tip_radius_nm": 20.0}, (30.0, 1.0), "tip_radius_nm is held at 20 .* and known as 30"),
        ({}, (30.0, 0.0), "the constraint on tip_radius_nm must be a value and a positive error"),
    ],
)
def test_contradictions_about_what_is_held_are_refused(fixed, pair, said):
    with pytest.raises(ValueError, match=said):
        split_held(OWN, fixed, {"tip_radius_nm": pair})


def test_the_error_of_what_is_held_is_one_more_unknown_of_the_law(rows):
    """Effects that are those of a parameter: the two are told apart by their prior errors alone."""
    problem = Problem("viscous+delay", tuple(VALUES))
    place = np.log(np.geomspace(10.0, 300.0, 50))
    of_epsilon = HeldEffect(Held("tip_radius_nm", 100.0, 30.0, assumed=True), place, np.full(50, -7.0), np.zeros(50))
    free = np.ones(6, dtype=bool)
    jacobian = rows.jacobian.copy()
    jacobian[:-1, 0] = -rows.slopes.by_square.ravel()
    rows = rows._replace(jacobian=jacobian)
    other = ModelDiscrepancy(problem, VALUES, LEFT_OUT.speeds, held=(of_epsilon,))
    alone, held = (system_of(rows, one, free).step() for one in (LEFT_OUT, other))
    # a standard error of it takes 7 off the squared rebound speed, as 7 of epsilon do, which it makes up for
    assert held.covariance[0, 0] - alone.covariance[0, 0] == pytest.approx(49.0, rel=1e-4)
    assert held.values[0] == pytest.approx(alone.values[0], rel=1e-6)
    unknown = other.columns(np.array([40.0]), np.array([37.0])).unknown
    np.testing.assert_allclose(unknown[:, 0, -1], [-7.0, 0.0])
