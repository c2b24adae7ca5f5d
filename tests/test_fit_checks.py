"""What is said of a minimum: curvature, distance, bounds, the share of Q in the errors, the band of the law."""

import dataclasses

import numpy as np
import pytest
from scipy.linalg import eigh
from scipy.optimize import least_squares

from afm_jax.strict_json import strict_json
from fitting import fit
from fitting.infer.fit import find_fit, summarise
from fitting.fits.intervals import check_minimum, covariance
from fitting.fits.objective import FINE, PLAIN, Objective, polish
from tests.fit_tables import law, objective, standard_errors_of, table, values_of
from tests.strict_reading import strictly

__all__ = ["law", "objective", "table"]
FREE = np.ones(3, dtype=bool)
STEPS = np.array([1e-6, 1e-2, 1e-3])  # of r, epsilon and Q: hundredths of a standard error and less


def differenced(objective: Objective, values: np.ndarray) -> np.ndarray:
    """Return the Jacobian of the residuals by central differences, shape (n, 3)."""
    ahead, behind = (objective.residual(values + sign * np.diag(STEPS)) for sign in (1.0, -1.0))
    return ((ahead - behind) / (2.0 * STEPS[:, None])).T


def differenced_hessian(objective: Objective, point: np.ndarray, steps: np.ndarray) -> np.ndarray:
    """Return the Hessian of chi2/2 by the optimiser's coordinates from values of chi2 alone."""

    def chi2(shift):
        return np.sum(objective.residual(objective.problem.values(point + shift)[None]) ** 2)

    hessian = np.zeros((len(point), len(point)))
    for i, along in enumerate(np.diag(steps)):
        for j, beside in enumerate(np.diag(steps)):
            even = chi2(along + beside) + chi2(-along - beside)
            odd = chi2(along - beside) + chi2(beside - along)
            hessian[i, j] = (even - odd) / (8.0 * steps[i] * steps[j])
    return hessian


@pytest.mark.parametrize("errors_away", [0.0, 20.0])
def test_hessian_is_that_of_second_differences_of_chi2(law, objective, errors_away):
    values = values_of(law) + errors_away * standard_errors_of(law) * [-1.0, 1.0, 0.0]
    point = objective.problem.coordinates(values)
    # r = 1 - y^2, epsilon = y^2, Q = exp y
    slopes = np.array([-2.0 * point[0], 2.0 * point[1], values[2]])
    jacobian = differenced(objective, values) * slopes
    # a fiftieth of a standard error: chi2 changes by 1e-3, 1e8 times its rounding
    hessian = differenced_hessian(objective, point, 0.02 * standard_errors_of(law) / np.abs(slopes))
    expected = eigh(hessian, jacobian.T @ jacobian, eigvals_only=True)
    # away from the minimum the residuals bend chi2: an eigenvalue of 1 throughout would not pass
    assert errors_away == 0.0 or np.abs(expected - 1.0).max() > 0.02
    found = check_minimum(objective, point, FREE).hessian_eigenvalues
    np.testing.assert_allclose(found, expected, atol=2e-4)


def test_away_from_the_minimum_the_checks_say_so(law, objective):
    problem = objective.problem
    assert check_minimum(objective, problem.coordinates(values_of(law)), FREE).converged
    errors = np.sqrt(np.diag(covariance(objective, values_of(law), FREE)))
    moved = values_of(law) + 0.1 * errors * [1, 0, 0]
    away = check_minimum(objective, problem.coordinates(moved), FREE)
    assert not away.converged
    # chi2 falls by this much on the way back; the estimate is exact for a parabola
    above = np.sum(objective.residual(moved[None]) ** 2) - law.chi2
    assert away.estimated_distance == pytest.approx(above, rel=0.02)


class _Spoilt(Objective):
    """An objective whose residuals or slopes are not finite, everywhere or at every place but one."""

    def __init__(self, sound: Objective, number: float, spared: np.ndarray | None = None):
        super().__init__(sound.measurement, sound.problem)
        self.number, self.spared = number, spared

    def at_values(self, values):
        found = super().at_values(values)
        spoilt = np.ones(len(values), dtype=bool) if self.spared is None else np.any(values != self.spared, axis=1)
        jacobian = np.where(spoilt[:, None, None], self.number, found.jacobian)
        return found._replace(jacobian=jacobian)


@pytest.mark.parametrize("number", [np.nan, np.inf])
def test_numbers_that_are_not_finite_are_an_outcome(law, objective, number):
    values = values_of(law)
    point = objective.problem.coordinates(values)
    everywhere, around = _Spoilt(objective, number), _Spoilt(objective, number, objective.problem.values(point))
    with np.errstate(over="ignore", invalid="ignore"):
        found = [check_minimum(spoilt, point, FREE) for spoilt in (everywhere, around)]
        end = polish(everywhere, point[None], PLAIN, settled=FINE)
        assert np.all(covariance(everywhere, values, FREE) == np.inf)
    assert [(one.converged, one.reason) for one in found] == [
        (False, "the slopes of the residuals are not finite where the search ended"),
        (False, "chi2 has no finite curvature where the search ended"),
    ]
    np.testing.assert_array_equal(end.coordinates, point[None])


def test_a_fit_whose_slopes_are_not_finite_is_not_valid_and_says_why(table, law, objective):
    found = find_fit(table, "law")
    spoilt = dataclasses.replace(found, objective=_Spoilt(objective, np.nan))
    result = summarise(table, spoilt)
    assert not result.valid
    assert result.reasons[0].startswith("Not converged: the slopes of the residuals are not finite")
    assert strictly(strict_json(result.to_dict()))["convergence"]["reason"] == result.convergence.reason
    assert result.chi2 == pytest.approx(law.chi2)


def test_a_bound_that_chi2_pushes_inward_from_is_no_minimum_unless_it_holds_hardly_anything_back(objective):
    """SciPy's minimum, and a loss held a thousandth of its error below it: a millionth of chi2 is to be had."""
    best = least_squares(
        lambda values: objective.residual(values[None])[0], [0.94, 60.0, 40.0], x_scale=[1e-3, 1.0, 1.0], xtol=1e-12
    )
    error = np.sqrt(np.linalg.inv(best.jac.T @ best.jac)[1, 1])
    for share, well in ((1e-3, True), (0.5, False)):
        values = best.x - np.array([0.0, share * error, 0.0])
        held = check_minimum(objective, objective.problem.coordinates(values), np.array([True, False, True]))
        assert held.converged == held.outward == well


def test_errors_hold_the_share_of_an_uncertain_quality_factor(table, law, objective):
    """The Fisher matrix in blocks: var(r) = exact + (what Q leaves to r)^2/(what all say of Q)."""
    exact = fit(dataclasses.replace(table, quality_factor_error=None), model="law")
    assert any("taken as exact" in warning for warning in exact.warnings)
    jacobian = differenced(objective, values_of(law))[:-1]  # without the constraint
    of_law, of_q = jacobian[:, :2], jacobian[:, 2]
    inverse = np.linalg.inv(of_law.T @ of_law)
    slope = inverse @ of_law.T @ of_q
    left = of_q @ of_q - of_q @ of_law @ slope
    predicted = np.sqrt(np.diag(inverse) + slope**2 / (left + 0.4**-2))
    # at 40 exactly the slopes differ by the shift of Q, a tenth of its error
    np.testing.assert_allclose(standard_errors_of(exact), np.sqrt(np.diag(inverse)), rtol=2e-2)
    np.testing.assert_allclose(standard_errors_of(law)[:2], predicted, rtol=1e-4)  # numerical Jacobian
    assert standard_errors_of(exact)[0] < 0.6 * standard_errors_of(law)[0]


def test_the_law_and_its_band_are_those_of_the_squared_law(law):
    (r, epsilon), errors = values_of(law)[:2], standard_errors_of(law)[:2]
    speed, rebound = law.law.approach_speed_nm_per_us, law.law.rebound_speed_nm_per_us
    np.testing.assert_allclose(rebound, np.sqrt(r**2 * speed**2 - epsilon), rtol=1e-12)
    slope = np.stack([r * speed**2 / rebound, -0.5 / rebound])
    matrix = law.correlations[:2, :2] * np.outer(errors, errors)
    width = 1.959964 * np.sqrt(np.einsum("pn,pq,qn->n", slope, matrix, slope))
    np.testing.assert_allclose(law.law.rebound_high_nm_per_us - rebound, width, rtol=1e-6)
    np.testing.assert_allclose(rebound - law.law.rebound_low_nm_per_us, width, rtol=1e-6)
    reached = law.rows.approach_speed_nm_per_us
    assert speed[0] == pytest.approx(0.8 * reached.min())
    assert speed[-1] == pytest.approx(1.2 * reached.max())
