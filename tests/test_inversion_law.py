"""Lines through correlated speeds, against a total least squares that fits every point."""

import numpy as np
import pytest
from scipy.optimize import least_squares

from fitting.inversion.invert import POWERS, line

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
    found = line(x, covariance, np.zeros((25, 3, 0)), POWERS[model])
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
    np.testing.assert_allclose((np.array([found.epsilon, found.slope]) - every.x[:2]) / error, 0.0, atol=0.1)
    np.testing.assert_allclose([found.epsilon_error, found.slope_error], error, rtol=0.05)
    assert found.chi2 == pytest.approx(2.0 * every.cost, rel=0.02)


@pytest.mark.parametrize("model", ["viscous", "restitution"])
def test_values_without_noise_are_exact(model):
    true, _ = impacts(model, 12, 1, size=0.0)
    _, covariance = impacts(model, 12, 1)
    found = line(true, covariance, np.zeros((12, 3, 0)), POWERS[model])
    # rounding, times the condition of the terms
    np.testing.assert_allclose([found.epsilon, found.slope], [EPSILON, SLOPES[model]], rtol=1e-8)
    assert found.chi2 < 1e-12


def test_what_all_rows_share_is_found_and_widens_the_errors():
    x, covariance = impacts("viscous", 40, 2, size=0.02)
    shared = np.stack([np.zeros(40), 1e-3 * x[:, 0], np.zeros(40)], axis=1)[:, :, None]
    # measured with the shared quantity off by 1.5 standard errors: its error is counted, and the rows follow the line
    moved = x - 1.5 * shared[:, :, 0]
    found, alone = line(moved, covariance, shared, 1), line(moved, covariance, np.zeros((40, 3, 0)), 1)
    assert abs(found.epsilon - EPSILON) < 3.0 * found.epsilon_error
    assert abs(found.slope - 0.5) < 3.0 * found.slope_error
    assert found.slope_error > alone.slope_error
    assert found.chi2 < 80.0 < alone.chi2
