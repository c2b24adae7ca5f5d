"""The law of a fit as a function of its unknowns: its table against `ImpactLaw`, derivatives against differences."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from afm_jax.contact.contact import Contact
from afm_jax.contact.law_of_contact import tabulated
from afm_jax.impact.law import CollisionDelay, ImpactLaw
from afm_jax.impact.law_table import KNOTS, LawTable
from fitting.infer.law import closest_loss
from fitting.infer.rows import NEAREST
from fitting.models import Held
from fitting.parameters import DELAY_NAMES
from fitting.predict.contact import ContactLawModel
from fitting.predict.law import SMOOTH, FormulaLaw, LawModel, of_short_range

LASTING = {
    "r": 0.97,
    "epsilon": 113.6,
    "viscous_loss": 0.5,
    **dict(zip(DELAY_NAMES, (0.206, 5.64, 0.726), strict=True)),
}
SPEEDS = np.geomspace(14.0, 400.0, 40)


def unknowns(law: LawModel, values: dict[str, float]) -> np.ndarray:
    """Return the unknowns of a law with given parameters, and all that have priors N(0, 1) away from 0."""
    theta = 0.5 * np.random.default_rng(3).normal(size=len(law.names))
    theta[: len(law.own)] = [law.unknown_of(name, values[name]) for name in law.own]
    return theta


def all_of(table: LawTable | ImpactLaw, coordinates: np.ndarray) -> list[np.ndarray]:
    """Return approach speeds, rebound speeds and delays of a table."""
    found = jax.jit(jax.vmap(lambda table, at: table.speeds(at), in_axes=(None, 0)))(table, coordinates)
    return [np.asarray(part) for part in (found.approach, found.rebound, found.delay)]


EVERYWHERE = np.random.default_rng(1).uniform(0.0, KNOTS - 2.0, 60)
"""Coordinates between the knots, from a captured tip to 1e4 nm/us."""


@pytest.mark.parametrize(("r", "epsilon"), [(0.95, 60.0), (1.0, 122.0), (0.9981, 1e-3), (0.5, 900.0)])
def test_an_instantaneous_law_is_equation_6(r, epsilon):
    law, theta = FormulaLaw(("r", "epsilon"), lasting=False), np.array([1.0 - r**2, epsilon])
    u, w, delay = all_of(law.table(theta), EVERYWHERE)
    assert law.capture(theta) == pytest.approx(np.sqrt(epsilon) / r, rel=1e-12)
    # what is left of slow tips is a difference of squares
    assert np.all(np.abs(w**2 - (r**2 * u**2 - epsilon)) < 1e-12 * u**2)
    assert not np.any(delay)


def test_the_table_of_a_law_with_drag_and_delay_is_the_formula():
    law = FormulaLaw(tuple(LASTING))
    u, w, delay = all_of(law.table(unknowns(law, LASTING)), EVERYWHERE)
    hertz, lead, offset = (LASTING[name] for name in DELAY_NAMES)
    late = CollisionDelay(hertz, lead, offset)
    formula = ImpactLaw(LASTING["r"], LASTING["epsilon"], LASTING["viscous_loss"], late)
    rebound = np.asarray(formula.rebound_speed(u))
    np.testing.assert_allclose(w, rebound, rtol=1e-6)
    # slower than a fifth of a nm/us the lead of 1/w is anything
    sound = w > 0.2
    assert sound.mean() > 0.9
    np.testing.assert_allclose(delay[sound], np.asarray(late(u, rebound))[sound], rtol=1e-6, atol=1e-6)


def processes(law: FormulaLaw) -> FormulaLaw:
    return law.beside((20.0, 200.0), SMOOTH, of_short_range(0.4))


@pytest.fixture(
    params=[
        FormulaLaw(tuple(LASTING)),
        processes(FormulaLaw(tuple(LASTING), mass_ng=16.8)),
        processes(FormulaLaw(("epsilon", "viscous_loss", *DELAY_NAMES))),
        processes(FormulaLaw(("epsilon", "delay_lead_nm"), {"viscous_loss": 0.5, "delay_hertz": 0.2})),
        FormulaLaw(("r", "epsilon", "viscous_loss"), lasting=False),
    ],
    ids=("formula", "smooth", "lossless", "fixed", "instantaneous"),
)
def law(request) -> FormulaLaw:
    return request.param


def differences(function, theta: np.ndarray, step: float) -> np.ndarray:
    """Return the derivatives of a function by central differences, the unknowns last."""
    ahead, behind = (
        np.array([np.asarray(function(theta + side * one)) for one in step * np.eye(theta.size)])
        for side in (1.0, -1.0)
    )
    return np.moveaxis((ahead - behind) / (2.0 * step), 0, -1)


def test_derivatives_of_formulas_are_those_of_differences(law):
    theta, step = unknowns(law, LASTING), 1e-5
    found = law.at(theta, SPEEDS)
    assert len(law.names) == theta.size
    square = differences(lambda at: law.at(at, SPEEDS).square, theta, step)
    time = differences(lambda at: law.at(at, SPEEDS).time, theta, step)
    # u^2 reaches 1.6e5, of which differences keep ten digits
    np.testing.assert_allclose(found.square_slope, square, rtol=1e-6, atol=1e-5)
    np.testing.assert_allclose(found.time_slope, time, rtol=1e-6, atol=1e-9)
    coefficients, slope = law.coefficients(theta)
    np.testing.assert_allclose(
        slope, differences(lambda at: law.coefficients(at)[0], theta, step), rtol=1e-6, atol=1e-9
    )
    assert coefficients.shape == (4,)
    capture = differences(law.capture, theta, step)
    np.testing.assert_allclose(law.capture_slope(theta), capture, rtol=1e-5, atol=1e-6)
    # where the tip is captured nothing of its speed is left
    assert abs(law.at(theta, np.array([law.capture(theta)])).square[0]) < 1e-9


@pytest.fixture(scope="module")
def contact() -> ContactLawModel:
    held = (Held("tip_radius_nm", 10.0, 3.0, assumed=True),)
    return ContactLawModel(
        ("relative_humidity", "viscosity_pa_s", "modulus_gpa"), {"adhesion_energy_j_per_m2": 0.28}, held
    )


CONTACT = {"relative_humidity": 0.45, "viscosity_pa_s": 1.2e-3, "modulus_gpa": 80.0}


@pytest.mark.slow
def test_the_law_of_a_contact_and_its_derivatives_are_those_of_the_contact(contact):
    theta = np.append([contact.unknown_of(name, CONTACT[name]) for name in contact.own], 0.1)
    radius = 10.0 + 3.0 * 0.1
    numbers: dict[str, Any] = CONTACT | {"adhesion_energy_j_per_m2": 0.28, "tip_radius_nm": radius}
    impact = tabulated(Contact.paper(**numbers), jnp.asarray(1.0))
    table = contact.table(theta)
    u, w, delay = all_of(table, np.random.default_rng(2).uniform(2.0, 70.0, 40))
    exact = jax.jit(jax.vmap(impact.speeds))(jnp.asarray(u))
    # slower ones are excluded from fits
    inside = u > NEAREST * contact.capture(theta)
    assert inside.sum() > 30
    assert np.all(np.abs(w**2 - np.asarray(exact.rebound) ** 2)[inside] < 1e-5 * u[inside] ** 2)
    np.testing.assert_allclose(delay[inside], np.asarray(exact.delay)[inside], rtol=0.0, atol=1e-5)
    assert contact.capture(theta) == pytest.approx(float(impact.capture), rel=1e-9)

    found, step = contact.at(theta, SPEEDS), 1e-4
    square = differences(lambda at: contact.at(at, SPEEDS).square, theta, step)
    time = differences(lambda at: contact.at(at, SPEEDS).time, theta, step)
    np.testing.assert_allclose(found.square_slope, square, rtol=1e-4, atol=1e-3)
    np.testing.assert_allclose(found.time_slope, time, rtol=1e-3, atol=1e-6)
    slope = differences(lambda at: contact.coefficients(at)[0], theta, step)
    np.testing.assert_allclose(contact.coefficients(theta)[1], slope, rtol=1e-4, atol=1e-6)
    capture = differences(contact.capture, theta, step)
    np.testing.assert_allclose(contact.capture_slope(theta), capture, rtol=1e-4)


def test_of_the_closest_formula_no_loss_is_negative():
    """Of a law that gives 50 nm^2/us^2 epsilon vanishes, and u_out = r u_in is least squares by hand."""
    u = np.geomspace(25.0, 180.0, 30)
    rebound, weight = np.sqrt(0.9 * u**2 + 50.0), 1.0 / (0.1 + 0.01 * u)
    found = closest_loss(("r", "epsilon"), u, rebound, weight, {})
    assert found["epsilon"] == 0.0
    assert found["r"] == pytest.approx(np.sum(weight**2 * u * rebound) / np.sum((weight * u) ** 2), rel=1e-9)
