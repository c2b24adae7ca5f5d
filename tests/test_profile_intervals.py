"""Intervals of linear and of bent models, where they are known in closed form."""

import math
from typing import Any

import numpy as np
import pytest
from scipy.optimize import brentq

import fitting.infer.explain
from fitting.infer.explain import Explained
from fitting.infer.instantaneous import Chi2
from fitting.infer.intervals import NO_LIMIT, Unknown, linear_interval, profile_interval
from fitting.infer.rows import plain_weights
from fitting.infer.search import Descent, Found
from fitting.infer.unknowns import Model, no_orbits
from fitting.parameters import PARAMETERS
from tests.fit_tables import model

__all__ = ["model"]
QUANTILE = 1.959963984540054  # 97.5 % of a normal distribution: its square is the 95 % of chi2
R, EPSILON = PARAMETERS["r"], PARAMETERS["epsilon"]


def itself(value: float) -> float:
    return value


def parabola(value: float, error: float, lost_beyond: float = math.inf):
    """Return an unknown, and the rise of a chi2 whose orbits are lost beyond a value."""

    def rise(y):
        return ((y - value) / error) ** 2 if y < lost_beyond else math.inf

    return rise, Unknown(value, error, itself, itself)


@pytest.mark.parametrize("stated", [0.01, 0.003, 0.05])
def test_a_parabola_ends_two_errors_away_whatever_error_is_stated(stated):
    rise, unknown = parabola(0.8, 0.01)
    interval = profile_interval(rise, R, unknown._replace(error=stated))
    # the search stops at 5e-4 of the distance
    assert [interval.low, interval.high] == pytest.approx([0.8 - QUANTILE * 0.01, 0.8 + QUANTILE * 0.01], abs=1e-5)
    assert (interval.kind, interval.reason) == ("profile", None)


@pytest.mark.parametrize("kind", ["profile", "linear"])
def test_an_end_beyond_the_range_is_open_with_a_reason(kind):
    """A restitution cannot exceed 1, epsilon not fall below 0."""

    def interval(parameter, value, error):
        rise, unknown = parabola(value, error)
        if kind == "profile":
            return profile_interval(rise, parameter, unknown)
        return linear_interval(parameter, value - QUANTILE * error, value + QUANTILE * error)

    r, epsilon = interval(R, 0.97, 0.05), interval(EPSILON, 5.0, 10.0)
    assert (r.high, r.reason, r.kind) == (None, "upper end: reaches the end of its range, 1", "limit")
    assert r.low == pytest.approx(0.97 - QUANTILE * 0.05, abs=1e-4)
    assert (epsilon.low, epsilon.reason) == (None, "lower end: reaches the end of its range, 0")
    assert epsilon.high == pytest.approx(5.0 + QUANTILE * 10.0, abs=2e-2)


def test_of_a_logarithm_the_lower_end_is_open_where_next_to_nothing_is_allowed():
    """Chi2 of ln epsilon levels off below: at a thousandth of epsilon it has risen by 3.6 of 3.84."""

    def rise(y):
        return 3.6 * (1.0 - math.exp(y)) ** 2

    unknown = Unknown(0.0, 1.0 / math.sqrt(3.6), math.log, math.exp)
    interval = profile_interval(rise, EPSILON, unknown, least=1e-3)
    assert (interval.low, interval.kind) == (None, "limit")
    assert interval.high == pytest.approx(1.0 + QUANTILE / math.sqrt(3.6), rel=1e-3)


def test_an_interval_ends_where_an_orbit_is_lost_and_is_open_where_chi2_says_nothing():
    rise, unknown = parabola(0.8, 0.01, lost_beyond=0.81)
    interval = profile_interval(rise, R, unknown)
    # within a hundredth of the standard error
    assert interval.high == pytest.approx(0.81, abs=1e-4)
    assert interval.low == pytest.approx(0.8 - QUANTILE * 0.01, abs=1e-5)
    open_above = profile_interval(lambda y: rise(min(y, 0.8)), EPSILON, unknown)
    assert (open_above.high, open_above.reason) == (None, f"upper end: {NO_LIMIT}")


class Linear(Chi2):
    """Residuals that are linear in the unknowns 1 - r^2 and epsilon."""

    design: np.ndarray
    centre: np.ndarray

    def at(self, theta, *, slopes=True) -> Any:
        """Return residuals and their Jacobian; Q has one of its own."""
        del slopes
        jacobian = np.eye(3)
        jacobian[:2, :2] = self.design
        return None, jacobian @ (theta - np.append(self.centre, 0.0)), jacobian


def linear(model: Model, design: np.ndarray, centre: np.ndarray) -> Linear:
    found = Linear(model, plain_weights(model.data, 0.0, np.zeros(len(model.data.read), bool)))
    found.design, found.centre = design, centre
    return found


@pytest.mark.parametrize("correlation", [0.9, -0.9])
def test_a_loss_that_vanishes_at_the_minimum_grows_again_where_it_has_to(model, correlation):
    # without its bound epsilon would be negative: the minimum lies at 0, and leaves it on one side of 1 - r^2
    errors, free_minimum = np.array([0.01, 3.0]), np.array([0.2, -2.0])
    scaled = np.array([[1.0, correlation], [correlation, 1.0]])
    fisher = np.linalg.inv(scaled * np.outer(errors, errors))

    def least(lost):
        """Return the minimum over epsilon >= 0, which a parabola has in closed form."""
        apart = lost - free_minimum[0]
        epsilon = max(free_minimum[1] - fisher[0, 1] / fisher[1, 1] * apart, 0.0)
        shift = np.array([apart, epsilon - free_minimum[1]])
        return shift @ fisher @ shift

    best = free_minimum[0] + fisher[0, 1] / fisher[0, 0] * free_minimum[1]
    chi2 = linear(model, np.linalg.cholesky(fisher).T, free_minimum)
    end = chi2.descended(np.array([0.3, 5.0, 1.0]))
    np.testing.assert_allclose(end.place, [best, 0.0, 0.0], atol=1e-9)
    assert end.sum.value == pytest.approx(least(best), rel=1e-9)

    def rise(lost):
        return float(
            chi2.descended(np.array([lost, 0.0, 0.0]), np.array([True, False, False])).sum.value - end.sum.value
        )

    law = model.law
    unknown = Unknown(best, 0.01, lambda r: float(law.unknown_of("r", r)), lambda y: float(law.value_of("r", y)))
    interval = profile_interval(rise, R, unknown)
    ends = [brentq(lambda y: least(y) - least(best) - QUANTILE**2, best, best + side) for side in (0.15, -0.15)]
    # within 5e-4 of the distance
    assert [interval.low, interval.high] == pytest.approx(np.sqrt(1.0 - np.array(ends)).tolist(), abs=2e-5)


def test_a_profile_goes_along_a_bent_valley_where_a_straight_step_loses_an_orbit(model, monkeypatch):
    # 1 - r^2 is known to 0.01; epsilon follows 60 + bend (1 - r^2 - 0.2)^2, and 3 of its errors beside that orbits end
    bend, error = 4.0 * 3.0 / 0.01372**2, 3.0
    count = len(model.data.read)

    def along_the_valley(model, theta, begin, weights, **_):
        del model, weights
        apart = theta[0] - 0.2
        bottom = 60.0 + bend * apart**2
        chi2 = (apart / 0.01) ** 2 if abs(theta[1] - bottom) < 3.0 * error else np.inf
        return end._replace(theta=np.array([theta[0], bottom, 0.0]), chi2=chi2, orbits=begin)

    monkeypatch.setattr(fitting.infer.explain, "descend", along_the_valley)
    weights = plain_weights(model.data, 0.0, np.zeros(count, bool))
    place, slopes = np.array([0.2, 60.0, 0.0]), np.diag([100.0, 1.0 / error, 1.0])
    end = Descent(place, no_orbits(count), 0.0, np.zeros(3), slopes)
    explained = Explained(model, end, weights, Found(end.orbits, np.ones(count, int)), 0.0, settled=True)
    assert np.isinf(along_the_valley(model, explained.beside(0, 0.2196), end.orbits, weights).chi2)
    unknown = Unknown(0.2, 0.01, itself, itself)
    interval = profile_interval(lambda y: explained.profile(0, y), EPSILON, unknown)
    assert [interval.low, interval.high] == pytest.approx([0.2 - QUANTILE * 0.01, 0.2 + QUANTILE * 0.01], abs=1e-5)
