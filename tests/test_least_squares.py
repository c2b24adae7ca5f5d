"""Searches side by side against SciPy's bounded least squares, and covariances against plain inverses."""

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.special import chdtrc

from afm_jax.least_squares import (
    Box,
    Searches,
    chi2_tail,
    covariance_of,
    descended,
    distance,
)
from afm_jax.solve.least_squares import Sum, levenberg_marquardt

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


def look(places: np.ndarray, some: np.ndarray) -> Searches:
    rest = np.stack([residual(place, truth) for place, truth in zip(places, TRUTHS[some], strict=True)])
    return Searches(places, rest, np.stack([slopes(place) for place in places]), np.sum(rest**2, axis=1))


def test_searches_end_where_scipys_do():
    box = Box(LOWEST, HIGHEST, FIXED)
    end = descended(look, look(np.tile(START, (4, 1)), np.arange(4)), box, settled=1e-20, most=60)
    assert np.all(distance(end, box) < 1e-20)
    for found, truth, fixed in zip(end.place, TRUTHS, FIXED, strict=True):
        free = ~fixed

        def rest(values, truth=truth, free=free):
            place = START.copy()
            place[free] = values
            return residual(place, truth)

        bounds = (LOWEST[free], HIGHEST[free])
        scipy = least_squares(rest, START[free], bounds=bounds, xtol=1e-15, ftol=1e-15, gtol=1e-15)
        # SciPy stays a little inside its bounds, and its Jacobian is numerical
        np.testing.assert_allclose(found[free], scipy.x, rtol=1e-6, atol=1e-6)
        np.testing.assert_array_equal(found[fixed], START[fixed])
    # the third decay is faster than it may be
    assert end.place[2, 1] == HIGHEST[1]


@pytest.mark.parametrize("truth", TRUTHS)
def test_a_search_alone_ends_where_scipys_does(truth):
    def here(place):
        rest = residual(place, truth)
        return Sum(float(rest @ rest), rest, slopes(place))

    end = levenberg_marquardt(here, START, settled=1e-16, most=100)
    scipy = least_squares(residual, START, args=(truth,), xtol=1e-15, ftol=1e-15, gtol=1e-15)
    np.testing.assert_allclose(end.place, scipy.x, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("number", [np.nan, np.inf])
def test_a_search_that_is_lost_leaves_the_others_alone(number):
    def spoilt(places, some):
        found = look(places, some)
        lost = some == 1
        rest = np.where(lost[:, None], number, found.residual)
        return Searches(places, rest, np.where(lost[:, None, None], number, found.jacobian), np.sum(rest**2, axis=1))

    box = Box(LOWEST, HIGHEST, FIXED)
    start = np.tile(START, (4, 1))
    with np.errstate(invalid="ignore"):
        end = descended(spoilt, spoilt(start, np.arange(4)), box, settled=1e-12, most=60)
        assert np.isnan(distance(end, box)).tolist() == [False, True, False, False]
    alone = descended(look, look(start, np.arange(4)), box, settled=1e-12, most=60)
    np.testing.assert_allclose(np.delete(end.place, 1, axis=0), np.delete(alone.place, 1, axis=0), rtol=1e-12)


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
