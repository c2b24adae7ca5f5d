"""Other programs on chi2 of the paper's map: the same minimum from four starts, the same errors and intervals."""

import numpy as np
import pytest
from scipy.optimize import least_squares

from fitting.infer.instantaneous import Chi2
from fitting.infer.rows import plain_weights
from tests.fit_tables import chi2_residuals, law, model, standard_errors_of, table, values_of

__all__ = ["law", "model", "table"]
NAMES = ("r", "epsilon", "quality_factor")
STARTS = np.random.default_rng(0).uniform([0.85, 10.0, 39.0], [0.99, 150.0, 41.0], (4, 3))


def errors_from(law, values) -> np.ndarray:
    """Return how far values are from the fitted ones, in standard errors."""
    return (np.array(values) - values_of(law)) / standard_errors_of(law)


def migrad(table, start):
    """Return Minuit where MIGRAD has found the minimum."""
    iminuit = pytest.importorskip("iminuit", reason="the comparison with MIGRAD and MINOS needs iminuit")
    minimiser = iminuit.Minuit(lambda *values: float(np.sum(chi2_residuals(table, *values) ** 2)), *start, name=NAMES)
    minimiser.limits = [(0.0, 1.0), (0.0, None), (1.0, None)]
    # an estimated distance of 2e-7 is half a thousandth of an error
    minimiser.errors, minimiser.tol, minimiser.strategy = [1e-3, 1.0, 0.4], 1e-4, 2
    minimiser.migrad()
    assert minimiser.valid
    return minimiser


def test_the_fit_ends_at_one_minimum_from_four_starts(law, model):
    chi2 = Chi2(model, plain_weights(model.data, 0.0, np.zeros(len(model.data.read), bool)))
    for r, epsilon, quality in STARTS:
        best = chi2.minimised(np.array([1.0 - r**2, epsilon, 100.0 * np.log(quality / 40.0)])).place
        end = chi2.descended(best).place
        assert np.abs(errors_from(law, [np.sqrt(1.0 - end[0]), end[1], 40.0 * np.exp(0.01 * end[2])])).max() < 1e-3
    assert law.convergence.optimiser.startswith("optax.lbfgs")
    assert law.convergence.iterations > 0
    assert law.convergence.gradient < 1e-3


def test_scipy_finds_this_minimum_from_four_starts_and_the_same_errors(law, table):
    settings = {"bounds": ([0.0, 0.0, 1.0], [1.0, np.inf, np.inf]), "x_scale": [1e-3, 1.0, 1.0]}
    ends = [
        least_squares(lambda values: chi2_residuals(table, *values), start, xtol=1e-12, ftol=1e-12, **settings)
        for start in STARTS
    ]
    for end in ends:
        assert np.abs(errors_from(law, end.x)).max() < 1e-3
        assert law.chi2 == pytest.approx(2.0 * end.cost, rel=1e-6)
    covariance = np.linalg.inv(ends[0].jac.T @ ends[0].jac)
    errors = np.sqrt(np.diag(covariance))
    np.testing.assert_allclose(errors, standard_errors_of(law), rtol=1e-3)  # numerical Jacobian
    np.testing.assert_allclose(law.correlations, covariance / np.outer(errors, errors), atol=2e-3)


def test_migrad_finds_this_minimum_from_two_starts(law, table):
    for start in STARTS[:2]:
        minimiser = migrad(table, start)
        assert np.abs(errors_from(law, minimiser.values)).max() < 1e-3
        assert minimiser.fval == pytest.approx(law.chi2, abs=1e-5)


def test_hesse_and_minos_find_the_same_errors_and_profile_intervals(law, table):
    minimiser = migrad(table, STARTS[0])
    minimiser.hesse()
    # second derivatives against the Fisher information: they differ by the residuals times the curvature
    assert list(minimiser.errors) == pytest.approx(standard_errors_of(law), rel=0.03)
    assert np.asarray(minimiser.covariance.correlation()) == pytest.approx(law.correlations, abs=0.03)
    minimiser.minos(cl=0.95)
    for name, error in zip(NAMES, standard_errors_of(law), strict=True):
        parameter, ends = law.parameters[name], minimiser.merrors[name]
        assert ends.is_valid
        # our search stops at a thousandth of the rise of chi2, MINOS at a hundredth: half of that in the end
        found = (np.array(parameter.interval95) - parameter.value) / error
        assert [ends.lower / error, ends.upper / error] == pytest.approx(found.tolist(), rel=0.01)
