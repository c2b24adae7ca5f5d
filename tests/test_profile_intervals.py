"""Profile intervals of a linear model, where they are known in closed form."""

import numpy as np
import pytest

from fitting.intervals import profile_intervals
from fitting.models import Problem
from fitting.optimise import Objective

QUANTILE = 1.959963984540054  # 97.5 % of a normal distribution: its square is the 95 % of chi2


class LinearObjective(Objective):
    """Residuals that are linear in the values, with one constant among them."""

    def __init__(self, design: np.ndarray, centre: np.ndarray):
        """Keep the matrix of the residuals and the values at which they vanish."""
        self.problem = Problem("law", ("r", "epsilon"))
        self.design, self.centre = design, centre

    def linearise(self, coordinates):
        """Return residuals and their Jacobian by the coordinates."""
        values, slopes = self.problem.values_and_slopes(coordinates)
        residual = (values - self.centre) @ self.design.T
        constant = np.full((len(values), 1), 1.5)
        jacobian = self.design[None] * slopes[:, None, :]
        return np.hstack([residual, constant]), np.concatenate([jacobian, np.zeros((len(values), 1, 2))], axis=1)


def intervals_of(errors: tuple[float, float], correlation: float, centre: np.ndarray):
    first, second = errors
    covariance = np.array([[first**2, correlation * first * second], [correlation * first * second, second**2]])
    design = np.linalg.cholesky(np.linalg.inv(covariance)).T
    return profile_intervals(LinearObjective(design, centre), centre, covariance, 1.5**2)


@pytest.mark.parametrize("correlation", [0.0, 0.9, -0.6])
def test_intervals_of_a_linear_model_are_two_errors_wide(correlation):
    centre, errors = np.array([0.8, 120.0]), (0.01, 3.0)
    for value, error, interval in zip(centre, errors, intervals_of(errors, correlation, centre), strict=True):
        # The search stops within 1e-3 of the rise of chi2, 5e-4 of the distance.
        assert interval.low == pytest.approx(value - QUANTILE * error, abs=1e-3 * error)
        assert interval.high == pytest.approx(value + QUANTILE * error, abs=1e-3 * error)
        assert interval.reason is None


def test_an_end_beyond_the_range_is_open_with_a_reason():
    # r cannot exceed 1 and epsilon not fall below 0: the errors reach beyond both.
    r, epsilon = intervals_of((0.05, 10.0), 0.0, np.array([0.97, 5.0]))
    assert r.high is None
    assert "upper end: reaches the end of its range, 1" in str(r.reason)
    assert r.low == pytest.approx(0.97 - QUANTILE * 0.05, abs=1e-4)
    assert epsilon.low is None
    assert "lower end: reaches the end of its range, 0" in str(epsilon.reason)


def test_parameters_that_the_data_do_not_determine_have_no_interval():
    objective = LinearObjective(np.eye(2), np.array([0.8, 120.0]))
    covariance = np.diag([np.inf, 1.0])
    first, second = profile_intervals(objective, np.array([0.8, 120.0]), covariance, 1.5**2)
    assert (first.low, first.high) == (None, None)
    assert first.reason == "the data do not determine this parameter"
    assert second.high == pytest.approx(120.0 + QUANTILE, abs=1e-3)
