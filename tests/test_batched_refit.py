"""Many synthetic tables of one fit: data as they are meant, fits as of tables, errors of the Fisher information."""

import numpy as np
import pytest

from afm_jax.impact.law import ImpactLaw
from fitting import fit
from fitting.infer.closest import closest_parameters
from fitting.infer.explain import Explained
from fitting.infer.fit import explained_of
from fitting.infer.result import FitResult
from tests.batched_refit import chi2_of, draw_data, fit_data_sets, refitted
from tests.fit_tables import (
    example_amplitudes,
    fit_of_every_fourth,
    rows,
    simulated,
    standard_errors_of,
    values_of,
)

pytestmark = pytest.mark.slow
"""Each compiles programs of its own for a minute or more."""

SAMPLES = 200


@pytest.fixture(scope="module")
def result() -> FitResult:
    return fit_of_every_fourth()


@pytest.fixture(scope="module")
def explained(result) -> Explained:
    return explained_of(result)


def fitted_values(found: Explained) -> np.ndarray:
    """Return the parameters as a fit prints them."""
    return closest_parameters(found, ("r", "epsilon"), {}).values


@pytest.mark.parametrize("robust", [False, True])
def test_the_minimum_is_found_again_with_the_rows_and_errors_of_the_fit(result, robust):
    fitted = fit(result.table, "law", robust=robust, scale_errors=not robust)
    again = explained_of(fitted)
    # errors are scaled three times there, once here
    assert fitted_values(again) == pytest.approx(values_of(fitted), rel=1e-9)
    assert again.end.chi2 == pytest.approx(fitted.chi2, rel=1e-9)


def test_data_scatter_about_the_fitted_readings_and_about_what_is_known(result, explained):
    data = draw_data(explained, 4000, np.random.default_rng(1))
    pull = (data.read[:, :, :2] - result.rows.predicted_nm) / result.rows.error_nm
    # five standard errors of a mean and of a width
    assert np.abs(pull.mean(axis=0)).max() < 5.0 / np.sqrt(4000)
    assert np.abs(pull.std(axis=0) - 1.0).max() < 5.0 / np.sqrt(8000)
    quality_factor = explained.model.instrument[0].at(data.mean[:, 2])
    assert quality_factor.mean() == pytest.approx(values_of(result)[2], abs=5.0 * 0.4 / np.sqrt(4000))
    assert quality_factor.std() == pytest.approx(0.4, rel=5.0 / np.sqrt(8000))
    np.testing.assert_array_equal(data.mean[:, :2], np.tile(explained.end.theta[:2], (4000, 1)))


def test_the_tables_own_data_give_the_fit(result, explained):
    found = refitted(explained)
    assert found.end.chi2 == pytest.approx(result.chi2, rel=1e-9)
    assert chi2_of(explained, found.end.theta[None])[0] == pytest.approx(result.chi2, rel=1e-9)
    # a fit ends within a thousandth of an error of its minimum
    apart = (fitted_values(found) - values_of(result)) / standard_errors_of(result)
    np.testing.assert_allclose(apart, 0.0, atol=2e-3)


def test_errors_agree_with_the_fisher_information(result, explained):
    found = fit_data_sets(explained, draw_data(explained, SAMPLES, np.random.default_rng(4)))
    values = np.array([fitted_values(one) for one in found])
    # four standard errors of a width: this problem is close to linear
    errors, tolerance = standard_errors_of(result), 4.0 / np.sqrt(2 * SAMPLES)
    assert values.std(axis=0, ddof=1) == pytest.approx(errors, rel=tolerance)
    off = values.mean(axis=0) - values_of(result)
    np.testing.assert_array_less(np.abs(off), 4.0 * np.asarray(errors) / np.sqrt(SAMPLES))
    # a 2.5 % quantile of 200 draws scatters by 0.19 errors
    ends = np.quantile(values, [0.025, 0.975], axis=0).T
    stated = np.array([parameter.interval95 for parameter in result.parameters.values()])
    assert np.all(np.abs(ends - stated) < 4.0 * 0.19 * np.asarray(errors)[:, None])
    correlations = np.corrcoef(values.T)
    assert correlations == pytest.approx(result.correlations, abs=4.0 / np.sqrt(SAMPLES))


def test_a_parameter_at_its_bound_stays_inside():
    lossless = simulated(rows(example_amplitudes(), slice(0, None, 3)), ImpactLaw(0.95, 0.0), seed=None)
    explained = explained_of(fit(lossless, "law"))
    # no noise: the fit is at the truth, no adhesion, within what a thousandth of an error says
    assert explained.end.theta[1] < 1e-2
    found = fit_data_sets(explained, draw_data(explained, SAMPLES, np.random.default_rng(6)))
    epsilon = np.array([one.end.theta[1] for one in found])
    assert epsilon.min() == 0.0
    # half of the noise would want it negative; four binomial standard deviations
    assert abs(np.mean(epsilon < 1e-2) - 0.5) < 4.0 * np.sqrt(0.25 / SAMPLES)
