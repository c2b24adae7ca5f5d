"""Damped least squares against SciPy's, bounded or not, and covariances against plain inverses."""

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.special import chdtrc

from afm_jax.solve.least_squares import Sum, chi2_tail, covariance_of, levenberg_marquardt

TIME = np.linspace(0.0, 3.0, 20)
TRUTHS = np.array([[2.0, 1.3, 0.5], [1.0, 0.4, -0.2], [3.0, 2.0, 0.9], [0.5, 0.7, 1.5]])
LOWEST, HIGHEST = np.array([0.0, 0.0, -np.inf]), np.array([np.inf, 1.6, 1.2])
FIXED = np.array([[False, False, False], [False, False, False], [False, False, False], [True, False, False]])
START = np.array([1.2, 1.0, 0.1])


def residual(place: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Return how far two decays onto a level are apart, with a bit of what neither explains."""
    model = [a * np.exp(-k * TIME) + c for a, k, c in (place, truth)]
    return model[0] - model[1] - 0.01 * np.sin(9.0 * TIME)


def slopes(place: np.ndarray) -> np.ndarray:
    a, k, _ = place
    decay = np.exp(-k * TIME)
    return np.stack([decay, -a * TIME * decay, np.ones_like(TIME)], axis=1)


def at(truth: np.ndarray):
    def evaluate(place: np.ndarray) -> Sum:
        rest = residual(place, truth)
        return Sum(float(rest @ rest), rest, slopes(place))

    return evaluate


@pytest.mark.parametrize(("truth", "fixed"), [*zip(TRUTHS, FIXED, strict=True)])
def test_searches_end_where_scipys_do(truth, fixed):
    limits = {"lowest": LOWEST, "highest": HIGHEST, "fixed": fixed}
    end = levenberg_marquardt(at(truth), START, settled=1e-18, most=60, **limits)
    assert end.distance < 1e-18
    free = ~fixed

    def rest(values):
        place = START.copy()
        place[free] = values
        return residual(place, truth)

    bounds = (LOWEST[free], HIGHEST[free])
    scipy = least_squares(rest, START[free], bounds=bounds, xtol=1e-15, ftol=1e-15, gtol=1e-15)
    # SciPy stays a little inside its bounds, and its Jacobian is numerical
    np.testing.assert_allclose(end.place[free], scipy.x, rtol=1e-6, atol=1e-6)
    np.testing.assert_array_equal(end.place[fixed], START[fixed])
    # the third decay is faster than it may be
    assert (end.place[1] == HIGHEST[1]) == (truth[1] == 2.0)


def test_covariances_are_inverses_where_there_are_some():
    random = np.random.default_rng(3)
    factor = random.normal(size=(5, 4, 3)) * [1e-8, 1.0, 1e6]
    fisher = np.einsum("snp,snq->spq", factor, factor)
    size = np.sqrt(np.einsum("spp->sp", fisher))
    unit = size[:, :, None] * size[:, None, :]
    np.testing.assert_allclose(covariance_of(fisher), np.linalg.inv(fisher / unit) / unit, rtol=1e-9)
    fisher[1, 2, :] = fisher[1, :, 2] = 0.0
    fisher[3, 0, 1] = np.nan
    found = covariance_of(fisher)
    kept = fisher[1, :2, :2] / unit[1, :2, :2]
    np.testing.assert_allclose(found[1, :2, :2], np.linalg.inv(kept) / unit[1, :2, :2], rtol=1e-9)
    assert np.all(found[1, 2] == np.inf)
    assert np.all(found[3] == np.inf)
    np.testing.assert_array_equal(covariance_of(fisher[0]), found[0])


@pytest.mark.parametrize("freedom", [1, 2, 195, 5000])
def test_the_tail_of_chi2_is_scipys(freedom):
    for chi2 in (0.0, 1e-3, 0.5 * freedom, float(freedom), 1.3 * freedom, 5.0 * freedom, 1e7, np.inf):
        # SciPy's own error where the tail is tiny
        assert chi2_tail(chi2, freedom) == pytest.approx(float(chdtrc(freedom, chi2)), rel=1e-10, abs=1e-300)
    assert np.isnan(chi2_tail(float("nan"), freedom))
