"""Profile intervals of a linear model, where they are known in closed form."""

from typing import Any

import numpy as np
import pytest
from fitting.fits.intervals import at_bound, check_minimum, covariance, profile_intervals
from fitting.fits.objective import Objective
from fitting.forward import Linearised
from scipy.optimize import brentq

from fitting.models import Problem

QUANTILE = 1.959963984540054  # 97.5 % of a normal distribution: its square is the 95 % of chi2


LAW = Problem("law", ("r", "epsilon"))


class LinearObjective(Objective):
    """Residuals that are linear in the values, with one constant among them."""

    def __init__(self, design: np.ndarray, centre: np.ndarray, problem: Problem = LAW, change: Any = None):
        """Keep the matrix of the residuals and the values at which they vanish.

        `change` is a function of values, residuals and Jacobian, both of which it may change in place.
        """
        self.problem, self.change = problem, change
        self.design, self.centre = design, centre

    def at_values(self, values):
        """Return residuals and their Jacobian by the values."""
        residual = np.hstack([(values - self.centre) @ self.design.T, np.full((len(values), 1), 1.5)])
        jacobian = np.zeros((len(values), 3, 2))
        jacobian[:, :2] = self.design
        if self.change is not None:
            self.change(values, residual, jacobian)
        nowhere: Any = None
        return Linearised(prediction=nowhere, residual=residual, jacobian=jacobian)


def intervals_of(errors: tuple[float, float], correlation: float, centre: np.ndarray):
    covariance = np.array([[1.0, correlation], [correlation, 1.0]]) * np.outer(errors, errors)
    design = np.linalg.cholesky(np.linalg.inv(covariance)).T
    return profile_intervals(LinearObjective(design, centre), centre, covariance, 1.5**2)


@pytest.mark.parametrize("correlation", [0.0, 0.9])
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


@pytest.mark.parametrize("correlation", [0.9, -0.9])
def test_a_loss_that_vanishes_at_the_minimum_grows_again_where_it_has_to(correlation):
    # without its bound epsilon would be negative: the minimum lies at 0, and leaves it on one side of r
    errors, free_minimum = np.array([0.01, 3.0]), np.array([0.8, -2.0])
    scaled = np.array([[1.0, correlation], [correlation, 1.0]])
    covariance = scaled * np.outer(errors, errors)
    fisher = np.linalg.inv(covariance)

    def chi2(r):
        """Return the minimum over epsilon >= 0, which a parabola has in closed form."""
        apart = r - free_minimum[0]
        epsilon = max(free_minimum[1] - fisher[0, 1] / fisher[1, 1] * apart, 0.0)
        shift = np.array([apart, epsilon - free_minimum[1]])
        return shift @ fisher @ shift

    best_r = free_minimum[0] + fisher[0, 1] / fisher[0, 0] * free_minimum[1]
    minimum = chi2(best_r)
    objective = LinearObjective(np.linalg.cholesky(fisher).T, free_minimum)
    found, loss = profile_intervals(objective, np.array([best_r, 0.0]), covariance, float(minimum) + 1.5**2)

    def beyond(r):
        return chi2(r) - minimum - QUANTILE**2

    # within 1e-3 of the rise of chi2, 5e-4 of the distance
    assert found.low == pytest.approx(brentq(beyond, best_r - 0.1, best_r), abs=2e-5)
    assert found.high == pytest.approx(brentq(beyond, best_r, best_r + 0.1), abs=2e-5)
    assert loss.low is None
    assert loss.high is not None


CENTRE = np.array([0.8, 120.0])


@pytest.mark.parametrize("number", [np.nan, np.inf])
def test_a_side_where_chi2_is_not_finite_is_open_and_the_others_are_not(number):
    def torn(values, residual, jacobian):
        beyond = values[:, 0] > CENTRE[0]
        residual[beyond], jacobian[beyond] = number, number

    objective = LinearObjective(np.diag([100.0, 0.3]), CENTRE, change=torn)
    with np.errstate(invalid="ignore"):
        first, second = profile_intervals(objective, CENTRE, np.diag([1e-4, 9.0]), 1.5**2)
    assert first.high is None
    assert first.reason == "upper end: the search did not settle: chi2 is not finite on this side"
    assert first.low == pytest.approx(0.8 - QUANTILE * 0.01, abs=1e-5)
    assert second.low is not None
    assert second.high is not None


def test_an_interval_goes_on_along_a_bent_valley_where_a_straight_step_loses_an_orbit():
    # r is known to 0.01; epsilon follows 120 + bend (r - 0.8)^2, and 3 of its errors beside that an orbit is lost
    bend, error, stated = 4.0 * 3.0 / 0.01372**2, 3.0, 0.007

    def lost_beside(values, residual, jacobian):
        apart = values[:, 0] - 0.8
        beside = (values[:, 1] - 120.0 - bend * apart**2) / error
        residual[:, 1], jacobian[:, 1, 0] = beside, -2.0 * bend * apart / error
        lost = np.abs(beside) > 3.0
        residual[lost, 1], jacobian[lost, 1] = 300.0, 0.0

    objective = LinearObjective(np.diag([100.0, 1.0 / error]), CENTRE, change=lost_beside)
    first, _ = profile_intervals(objective, CENTRE, np.diag([stated**2, error**2]), 1.5**2)
    assert first.low == pytest.approx(0.8 - QUANTILE * 0.01, abs=1e-5)
    assert first.high == pytest.approx(0.8 + QUANTILE * 0.01, abs=1e-5)


def test_an_interval_ends_where_an_orbit_is_lost_and_what_is_undetermined_has_none():
    def lost_beyond(values, residual, jacobian):
        lost = values[:, 0] > 0.81
        residual[lost], jacobian[lost] = 300.0, 0.0

    objective = LinearObjective(np.diag([100.0, 0.3]), CENTRE, change=lost_beyond)
    first, undetermined = profile_intervals(objective, CENTRE, np.diag([1e-4, np.inf]), 1.5**2)
    assert (undetermined.low, undetermined.high) == (None, None)
    assert undetermined.reason == "the data do not determine this parameter"
    # within a hundredth of the standard error
    assert first.high == pytest.approx(0.81, abs=1e-4)
    assert first.low == pytest.approx(0.8 - QUANTILE * 0.01, abs=1e-5)


CONTACT = Problem("contact", ("relative_humidity", "modulus_gpa"), drive="force")
ALL = np.ones(2, dtype=bool)


def test_what_readings_leave_open_is_no_minimum():
    values, design = np.array([0.4, 90.0]), np.diag([50.0, 0.0])
    objective = LinearObjective(design, values, CONTACT)
    assert not check_minimum(objective, objective.problem.coordinates(values), ALL).converged
    assert np.isinf(covariance(objective, values, ALL)[1, 1])


@pytest.mark.parametrize(("drawn_to", "outward"), [(2100.0, True), (1900.0, False)])
def test_a_parameter_at_the_end_of_its_range_is_held_there(drawn_to: float, outward: bool):  # noqa: FBT001
    values = np.array([0.4, 2000.0])
    objective = LinearObjective(np.diag([50.0, 0.01]), np.array([0.4, drawn_to]), CONTACT)
    held = at_bound(objective, values)
    assert held.tolist() == [False, True]
    state = check_minimum(objective, objective.problem.coordinates(values), ~held)
    assert state.converged == state.outward == outward
    _, modulus = profile_intervals(objective, values, covariance(objective, values, ~held), 1.5**2)
    assert modulus.high is None
    assert modulus.low is not None
