"""iminuit and lmfit on the same residuals: the same minimum, the same errors, the same profile intervals."""

import numpy as np
import pytest

from fitting.sampling.bootstrap import objective_of
from tests.fit_tables import fit_of_every_fourth, standard_errors_of, values_of

NAMES = ("r", "epsilon", "quality_factor")


@pytest.fixture(scope="module")
def result():
    return fit_of_every_fourth()


@pytest.fixture(scope="module")
def residual(result):
    """The residuals of the fit as a function of values in units of its errors, away from the minimum by 0."""
    objective, values = objective_of(result)
    errors = standard_errors_of(result)

    def of(z):
        return objective.residual((values + errors * np.asarray(z))[None])[0]

    return of


ORIGIN = 10.0
"""Added to lmfit's parameters, whose differences are steps relative to the parameters."""
# away from the minimum by one to two errors each
START = (1.5, -1.0, 2.0)


@pytest.fixture(scope="module")
def minuit(residual):
    iminuit = pytest.importorskip("iminuit", reason="the comparison with MINOS needs iminuit")
    minimiser = iminuit.Minuit(lambda *z: float(np.sum(residual(z) ** 2)), *START, name=NAMES)
    minimiser.errordef = 1.0
    minimiser.strategy = 2
    minimiser.tol = 1e-3
    minimiser.migrad()
    minimiser.hesse()
    assert minimiser.valid
    return minimiser


@pytest.mark.slow
def test_migrad_finds_the_same_minimum(result, minuit):
    # Minuit stops at an estimated distance of 2e-6
    assert minuit.fval == pytest.approx(result.chi2, abs=1e-4)
    assert list(minuit.values) == pytest.approx([0.0, 0.0, 0.0], abs=0.01)


@pytest.mark.slow
def test_hesse_finds_the_same_errors_and_correlations(result, minuit):
    # second derivatives against the Fisher information: they differ by the residuals times the curvature
    assert list(minuit.errors) == pytest.approx([1.0, 1.0, 1.0], rel=0.03)
    assert np.asarray(minuit.covariance.correlation()) == pytest.approx(result.correlations, abs=0.03)


@pytest.mark.slow
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


@pytest.fixture(scope="module")
def lmfit_result(residual):
    lmfit = pytest.importorskip("lmfit", reason="the comparison with lmfit's least squares needs lmfit")
    start = lmfit.Parameters()
    for name, value in zip(NAMES, START, strict=True):
        start.add(name, value=ORIGIN + value)
    minimiser = lmfit.Minimizer(
        lambda p: residual([p[name].value - ORIGIN for name in NAMES]), start, scale_covar=False
    )
    # steps of 1e-4 of the parameters: a thousandth of an error
    return minimiser, minimiser.leastsq(ftol=1e-12, xtol=1e-10, epsfcn=1e-8)


@pytest.mark.slow
def test_lmfit_finds_the_same_minimum_and_errors(result, lmfit_result):
    _, found = lmfit_result
    assert found.success
    assert found.chisqr == pytest.approx(result.chi2, abs=1e-5)
    values = [found.params[name].value - ORIGIN for name in NAMES]
    assert values == pytest.approx([0.0, 0.0, 0.0], abs=2e-3)
    # the same Fisher information by forward differences of MINPACK
    assert [found.params[name].stderr for name in NAMES] == pytest.approx([1.0, 1.0, 1.0], rel=1e-3)


@pytest.mark.slow
def test_lmfit_finds_the_same_profile_intervals(result, lmfit_result):
    lmfit = pytest.importorskip("lmfit")
    minimiser, found = lmfit_result
    # 95 % of lmfit's F test with its 40 degrees of freedom is not that of chi2: ask for the rise itself
    ends = lmfit.conf_interval(
        minimiser, found, sigmas=[0.95], prob_func=lambda best, new: 0.95 * (new.chisqr - best.chisqr) / 3.841459
    )
    for name, value, error in zip(NAMES, values_of(result), standard_errors_of(result), strict=True):
        low, high = ((end - value) / error for end in result.parameters[name].interval95)
        # lmfit's root finder stops at 1e-2 in the probability, which here is 1e-2 of the rise
        assert ends[name][0][1] - ORIGIN == pytest.approx(low, rel=0.01)
        assert ends[name][-1][1] - ORIGIN == pytest.approx(high, rel=0.01)
