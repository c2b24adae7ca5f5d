"""What is said of a minimum: distance, bounds, the band of the law."""

import dataclasses

import numpy as np
import pytest

from afm_jax.saved import as_json
from afm_jax.strict_json import strict_json
from fitting import fit
from fitting.infer import fit as fitting_fit
from fitting.infer.closest import covariance_of_unknowns, held_at_bound
from fitting.infer.explain import Explained
from fitting.infer.instantaneous import Chi2
from fitting.infer.optimiser import OPTIMISER
from fitting.infer.rows import plain_weights
from fitting.infer.summary import convergence_of
from fitting.infer.unknowns import Model
from tests.fit_tables import chi2_residuals, law, model, standard_errors_of, table, values_of
from tests.strict_reading import strictly

__all__ = ["law", "model", "table"]
STEPS = np.array([1e-6, 1e-2, 1e-3])  # of r, epsilon and Q: hundredths of a standard error and less


def unknowns(values: np.ndarray) -> np.ndarray:
    """Return 1 - r^2, epsilon, and ln Q in its errors."""
    return np.array([1.0 - values[0] ** 2, values[1], 100.0 * np.log(values[2] / 40.0)])


def explained(model: Model, values: np.ndarray) -> Explained:
    """Return the rows as r, epsilon and Q explain them, at a minimum or not."""
    chi2 = Chi2(model, plain_weights(model.data, 0.0, np.zeros(len(model.data.read), bool)))
    end = chi2.descended(unknowns(values), np.ones(3, bool))
    return chi2.explained(end)


def differenced(table, values: np.ndarray) -> np.ndarray:
    """Return the Jacobian of the residuals by differences, central ones but where epsilon vanishes; shape (n, 3)."""
    ahead, behind = values + np.diag(STEPS), np.maximum(values - np.diag(STEPS), 0.0)
    change = [
        chi2_residuals(table, *one) - chi2_residuals(table, *other) for one, other in zip(ahead, behind, strict=True)
    ]
    return (np.array(change) / np.diag(ahead - behind)[:, None]).T


def test_away_from_the_minimum_the_checks_say_so(law, model, table):
    assert convergence_of(explained(model, values_of(law)), OPTIMISER, 1).converged
    errors = np.sqrt(np.diag(np.linalg.inv(differenced(table, values_of(law)).T @ differenced(table, values_of(law)))))
    moved = values_of(law) + 0.1 * errors * [1, 0, 0]
    away = convergence_of(explained(model, moved), OPTIMISER, 1)
    assert not away.converged
    # chi2 falls by this much on the way back; the estimate is exact for a parabola
    above = np.sum(chi2_residuals(table, *moved) ** 2) - law.chi2
    assert away.estimated_distance == pytest.approx(above, rel=0.02)
    slope = 2.0 * differenced(table, moved).T @ chi2_residuals(table, *moved)
    assert away.gradient == pytest.approx(np.max(np.abs(slope * errors)), rel=0.01)


def test_a_fit_whose_slopes_are_not_finite_is_not_valid_and_says_why(table, law, monkeypatch):
    found = fitting_fit.fit_instantaneous

    def spoilt(*arguments, **named):
        explained, best, other = found(*arguments, **named)
        end = explained.end._replace(jacobian=np.full_like(explained.end.jacobian, np.nan))
        return dataclasses.replace(explained, end=end), best, other

    monkeypatch.setattr(fitting_fit, "fit_instantaneous", spoilt)
    result = fit(table, "law")
    assert not result.valid
    assert result.reasons[0].startswith("Not converged: the slopes of the residuals are not finite")
    assert strictly(strict_json(as_json(result)))["convergence"]["reason"] == result.convergence.reason
    assert result.chi2 == pytest.approx(law.chi2)


def test_a_loss_that_vanishes_is_held_and_no_reason_against_a_minimum(model, table, law):
    """Of amplitudes that would lower chi2 by a gain in place of a loss."""
    values = values_of(law) * [1.0, 0.0, 1.0]
    found = explained(model, values)
    assert held_at_bound(found).tolist() == [False, True, False]
    covariance = covariance_of_unknowns(found)
    jacobian = differenced(table, values)
    # r and Q as if epsilon were known; epsilon as if it were free
    alone = np.linalg.inv(jacobian[:, ::2].T @ jacobian[:, ::2])
    free = np.linalg.inv(jacobian.T @ jacobian)
    slopes = np.array([-2.0 * values[0], 1.0, 100.0 / values[2]])
    expected = np.zeros((3, 3))
    expected[np.ix_([0, 2], [0, 2])] = alone * np.outer(slopes[::2], slopes[::2])
    expected[1, 1] = free[1, 1]
    np.testing.assert_allclose(covariance, expected, rtol=1e-3)


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
