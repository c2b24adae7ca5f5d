"""The regression of laws on correlated speeds, against a total least squares that fits every point."""

import re

import numpy as np
import pytest
from scipy.optimize import least_squares

from afm_jax import ImpactLaw, TabulatedLaw
from fitting.inversion.regression import (
    DELAY_TERMS,
    LOSS_TERMS,
    delay,
    distance_from,
    loss,
    regress,
)
from fitting.inversion.result import InvertedRows, read_on_resonance
from fitting.tables.csv_text import TableError
from fitting.tables.table import read_table

EPSILON, SLOPES = 113.6, {"viscous": 0.5, "restitution": 3e-3}


def impacts(model: str, rows: int, seed: int, *, size: float = 1.0):
    """Return impacts that follow a law, with correlated noise, and their covariances."""
    generator = np.random.default_rng(seed)
    u = np.geomspace(30.0, 300.0, rows)
    lost = EPSILON + SLOPES[model] * (u if model == "viscous" else u * u)
    w = np.sqrt(u * u - lost)
    tau = 0.2 * u**-0.2 - 5.6 * (1.0 / w - 1.0 / u) - 0.6 / u
    # a common error of both speeds, and a small one of their difference
    roots = size * np.array([[[0.007 * s, 0.0, 0.0], [0.0072 * s, 0.02, 0.0], [0.0, 2e-4, 5e-4]] for s in u])
    noise = np.einsum("nij,nj->ni", roots, generator.normal(size=(rows, 3)))
    return np.stack([u, w, tau], axis=1) + noise, np.einsum("nij,nkj->nik", roots, roots)


@pytest.mark.parametrize("model", ["viscous", "restitution"])
def test_laws_agree_with_a_fit_of_every_point(model):
    x, covariance = impacts(model, 25, 5)
    found = regress(loss, LOSS_TERMS[model], x, covariance, np.zeros((25, 3, 0)))
    whiten = np.linalg.inv(np.linalg.cholesky(covariance[:, :2, :2]))

    def residual(parameters):
        u = parameters[2:]
        lost = parameters[0] + parameters[1] * (u if model == "viscous" else u * u)
        apart = x[:, :2] - np.stack([u, np.sqrt(u * u - lost)], axis=1)
        return np.einsum("nij,nj->ni", whiten, apart).ravel()

    start = np.concatenate([[EPSILON, SLOPES[model]], x[:, 0]])
    every = least_squares(residual, start, x_scale=np.abs(start), xtol=1e-14, ftol=1e-14, gtol=1e-14)
    covariance_of_every = np.linalg.inv(every.jac.T @ every.jac)[:2, :2]
    # both minimise the same sum up to second order in errors of 1 %
    error = np.sqrt(np.diag(covariance_of_every))
    np.testing.assert_allclose((found.value - every.x[:2]) / error, 0.0, atol=0.1)
    np.testing.assert_allclose(np.sqrt(np.diag(found.covariance)), error, rtol=0.05)
    assert found.chi2 == pytest.approx(2.0 * every.cost, rel=0.02)


@pytest.mark.parametrize("model", ["viscous", "restitution"])
def test_values_without_noise_are_exact(model):
    true, _ = impacts(model, 12, 1, size=0.0)
    _, covariance = impacts(model, 12, 1)
    found = regress(loss, LOSS_TERMS[model], true, covariance, np.zeros((12, 3, 0)))
    # rounding, times the condition of the terms
    np.testing.assert_allclose(found.value, [EPSILON, SLOPES[model]], rtol=1e-8)
    assert found.chi2 < 1e-12
    found = regress(delay, DELAY_TERMS, true, covariance, np.zeros((12, 3, 0)))
    np.testing.assert_allclose(found.value, [0.2, 5.6, 0.6], rtol=1e-8)


def test_errors_of_repeated_experiments_are_those_stated():
    nothing = np.zeros((25, 3, 0))
    found = [regress(loss, LOSS_TERMS["viscous"], *impacts("viscous", 25, seed), nothing) for seed in range(300)]
    pulls = np.array([(one.value - [EPSILON, 0.5]) / np.sqrt(np.diag(one.covariance)) for one in found])
    # the standard deviation of 300 pulls is known to 4 %
    np.testing.assert_allclose(pulls.std(axis=0), 1.0, atol=0.16)
    np.testing.assert_allclose(pulls.mean(axis=0), 0.0, atol=0.25)
    assert np.mean([one.chi2 for one in found]) == pytest.approx(23.0, rel=0.06)


def test_what_all_rows_share_is_found_and_widens_the_errors():
    x, covariance = impacts("viscous", 40, 2, size=0.02)
    shared = np.stack([np.zeros(40), 1e-3 * x[:, 0], np.zeros(40)], axis=1)[:, :, None]
    # measured with the shared quantity off by 1.5 standard errors: taken back, the rows follow the law
    found = regress(loss, LOSS_TERMS["viscous"], x - 1.5 * shared[:, :, 0], covariance, shared)
    assert found.pulls[0] == pytest.approx(1.5, abs=0.1)
    # three standard errors of the small noise
    np.testing.assert_allclose(found.value, [EPSILON, 0.5], rtol=0.02)
    assert np.all(np.diag(found.covariance) > np.diag(found.random_covariance))


def test_rows_of_one_speed_leave_errors_infinite():
    x, covariance = impacts("viscous", 5, 1)
    same, errors = np.repeat(x[:1], 5, axis=0), np.repeat(covariance[:1], 5, axis=0)
    found = regress(loss, LOSS_TERMS["viscous"], same, errors, np.zeros((5, 3, 0)))
    assert np.all(np.isinf(found.covariance))


def beside(law):
    """Return how far 57 rows of the viscous law, 30 to 300 nm/us, are from a law."""
    table = read_table("fitting/examples/amplitudes_contact.csv")
    x, covariance = impacts("viscous", 57, 3)
    rest = {"shared": np.zeros((57, 3, 0)), "shared_names": (), "chi2": np.ones(57), "note": ("",) * 57}
    rows = InvertedRows(impact=x, covariance=covariance, regressed=np.ones(57, bool), **rest)
    return distance_from(law, table, rows, read_on_resonance(table, law=None, reference="none"))


def viscous(low, high, epsilon, error=0.0) -> TabulatedLaw:
    """Return the table of a viscous law over some speeds, each of its rebounds known with an error in nm/us."""
    u = np.linspace(low, high, 20)
    w = np.sqrt(u * u - epsilon - 0.5 * u)
    return TabulatedLaw.with_errors(u, w, rebound_changes=error * np.eye(20), origin="other.csv")


def test_the_law_of_the_rows_agrees_with_them():
    found = beside(viscous(20.0, 400.0, EPSILON))
    assert (found.rows_compared, found.agrees, found.extrapolated) == (57, True, None)
    # of a normal deviate 0.67; the median of 57 is known to 0.1
    far = found.median_distance_in_errors
    assert far == pytest.approx(0.67, abs=0.4)
    # a formula is a law, too
    assert beside(ImpactLaw(1.0, EPSILON, 0.5)).median_distance_in_errors == pytest.approx(far, rel=1e-6)
    unsure = beside(viscous(20.0, 400.0, EPSILON, error=3.0))
    assert (unsure.median_distance_in_errors or 1.0) < 0.2 * (far or 1.0)


def test_a_law_of_other_impacts_is_far_from_the_rows():
    found = beside(viscous(20.0, 100.0, 10.0))
    assert not found.agrees
    assert 20 < found.rows_compared < 40
    said = r"Extrapolated: the law is known from 20 to 100 nm/us, but \d+ of 57 impacts come at 10\d\.\d to 29\d nm/us"
    assert re.match(said, found.extrapolated or "")
    # and one of other speeds is refused
    said = r"a law \(other\.csv\), known from 400 to 900 nm/us, says nothing about .*come at 30.* to .* nm/us; give"
    with pytest.raises(TableError, match=said):
        beside(viscous(400.0, 900.0, EPSILON))
