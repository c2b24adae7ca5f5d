"""Intervals of linear and of bent models, where they are known in closed form."""

import math

import numpy as np
import pytest

import fitting.infer.explain
from fitting.infer.explain import Explained
from fitting.infer.intervals import NO_LIMIT, Unknown, linear_interval, profile_interval
from fitting.infer.rows import plain_weights
from fitting.infer.search import Descent, Found
from fitting.infer.unknowns import no_orbits
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


def test_an_interval_ends_where_an_orbit_is_lost_and_is_open_where_chi2_says_nothing():
    rise, unknown = parabola(0.8, 0.01, lost_beyond=0.81)
    interval = profile_interval(rise, R, unknown)
    # within a hundredth of the standard error
    assert interval.high == pytest.approx(0.81, abs=1e-4)
    assert interval.low == pytest.approx(0.8 - QUANTILE * 0.01, abs=1e-5)
    open_above = profile_interval(lambda y: rise(min(y, 0.8)), EPSILON, unknown)
    assert (open_above.high, open_above.reason) == (None, f"upper end: {NO_LIMIT}")


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
