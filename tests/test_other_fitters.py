"""iminuit on the same residuals: the same minimum, the same errors, the same profile intervals."""

import numpy as np
import pytest

from fitting.sampling.refit import objective_of
from tests.fit_tables import fit_of_every_fourth, standard_errors_of, values_of

pytestmark = pytest.mark.slow
NAMES = ("r", "epsilon", "quality_factor")


@pytest.fixture(scope="module")
def result():
    return fit_of_every_fourth()


# away from the minimum by one to two errors each
START = (1.5, -1.0, 2.0)


@pytest.fixture(scope="module")
def minuit(result):
    """Minuit at its minimum of chi2 by values in units of the fit's errors, away from the fit's minimum by 0."""
    iminuit = pytest.importorskip("iminuit", reason="the comparison with MINOS needs iminuit")
    objective, values = objective_of(result)
    errors = standard_errors_of(result)

    def chi2(*z):
        return float(np.sum(objective.residual((values + errors * np.array(z))[None]) ** 2))

    minimiser = iminuit.Minuit(chi2, *START, name=NAMES)
    minimiser.errordef = 1.0
    minimiser.strategy = 2
    minimiser.tol = 1e-3
    minimiser.migrad()
    minimiser.hesse()
    assert minimiser.valid
    return minimiser


def test_migrad_and_hesse_find_the_same_minimum_errors_and_correlations(result, minuit):
    # Minuit stops at an estimated distance of 2e-6
    assert minuit.fval == pytest.approx(result.chi2, abs=1e-4)
    assert list(minuit.values) == pytest.approx([0.0, 0.0, 0.0], abs=0.01)
    # second derivatives against the Fisher information: they differ by the residuals times the curvature
    assert list(minuit.errors) == pytest.approx([1.0, 1.0, 1.0], rel=0.03)
    assert np.asarray(minuit.covariance.correlation()) == pytest.approx(result.correlations, abs=0.03)


def test_minos_finds_the_same_profile_intervals(result, minuit):
    minuit.minos(cl=0.95)
    values, errors = values_of(result), standard_errors_of(result)
    for k, name in enumerate(NAMES):
        ends = minuit.merrors[name]
        assert ends.is_valid
        low, high = (np.array(result.parameters[name].interval95) - values[k]) / errors[k]
        # our search stops at a thousandth of the rise of chi2, MINOS at a hundredth: half of that in the end
        assert minuit.values[name] + ends.lower == pytest.approx(low, rel=0.01)
        assert minuit.values[name] + ends.upper == pytest.approx(high, rel=0.01)
