"""Many synthetic tables fitted at once: data as they are meant, fits as of tables, errors of the Fisher information."""

import numpy as np
import pytest

from afm_jax.impact.law import ImpactLaw
from fitting import fit
from fitting.sampling.refit import compact, objective_of
from tests.batched_refit import DataSets, draw_data, fit_data_sets
from tests.fit_tables import (
    example_amplitudes,
    example_fit,
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
def result():
    return fit_of_every_fourth()


@pytest.mark.parametrize("robust", [False, True])
def test_the_objective_is_rebuilt_with_the_rows_and_errors_of_the_fit(result, robust):
    fitted = fit(result.table, "law", robust=robust, scale_errors=not robust)
    refit = objective_of(fitted)
    assert refit.values == pytest.approx(values_of(fitted), rel=0.0, abs=0.0)
    # the same program at the same values: rounding of the sum only
    assert np.sum(refit.objective.residual(refit.values[None]) ** 2) == pytest.approx(fitted.chi2, rel=1e-12)


def test_rows_that_say_nothing_are_left_out():
    refit = objective_of(example_fit())
    used = np.asarray(refit.objective.measurement.rows.measured).copy()
    assert used.shape == (96, 2)
    assert compact(refit) is refit
    used[:50] = False
    fewer = refit._replace(objective=refit.objective.with_rows(measured=used))
    kept = compact(fewer).objective
    assert np.asarray(kept.measurement.rows.order).shape == (32,)
    chi2, chi2_kept = (np.sum(o.residual(refit.values[None]) ** 2) for o in (fewer.objective, kept))
    # the same residuals in another order
    assert chi2_kept == pytest.approx(chi2, rel=1e-12)


def test_data_scatter_about_the_fitted_amplitudes_and_constraints(result):
    refit = objective_of(result)
    data = draw_data(refit, 4000, np.random.default_rng(1))
    amplitudes = data.amplitude_nm[:, : result.table.rows]
    pull = (amplitudes - result.rows.predicted_nm) / result.rows.error_nm
    # five standard errors of a mean and of a width
    assert np.abs(pull.mean(axis=0)).max() < 5.0 / np.sqrt(4000)
    assert np.abs(pull.std(axis=0) - 1.0).max() < 5.0 / np.sqrt(8000)
    quality_factor = data.constraint_value[:, 2]
    assert quality_factor.mean() == pytest.approx(values_of(result)[2], abs=5.0 * 0.4 / np.sqrt(4000))
    assert quality_factor.std() == pytest.approx(0.4, rel=5.0 / np.sqrt(8000))


def test_the_tables_own_data_give_the_fit(result):
    refit = objective_of(result)
    known = refit.objective.measurement
    own = DataSets(np.asarray(known.rows.amplitude_nm)[None], np.asarray(known.constraint_value)[None])
    found = fit_data_sets(refit, own)
    assert found.chi2[0] == pytest.approx(result.chi2, rel=1e-9)
    # a fit ends within a thousandth of an error of its minimum
    apart = (found.values[0] - values_of(result)) / standard_errors_of(result)
    np.testing.assert_allclose(apart, 0.0, atol=2e-3)


def test_errors_agree_with_the_fisher_information(result):
    refit = compact(objective_of(result))
    found = fit_data_sets(refit, draw_data(refit, SAMPLES, np.random.default_rng(4)))
    assert found.converged.all()
    # four standard errors of a width: this problem is close to linear
    errors, tolerance = standard_errors_of(result), 4.0 / np.sqrt(2 * SAMPLES)
    assert found.values.std(axis=0, ddof=1) == pytest.approx(errors, rel=tolerance)
    off = found.values.mean(axis=0) - values_of(result)
    np.testing.assert_array_less(np.abs(off), 4.0 * np.asarray(errors) / np.sqrt(SAMPLES))
    # a 2.5 % quantile of 200 draws scatters by 0.19 errors
    ends = np.quantile(found.values, [0.025, 0.975], axis=0).T
    stated = np.array([parameter.interval95 for parameter in result.parameters.values()])
    assert np.all(np.abs(ends - stated) < 4.0 * 0.19 * np.asarray(errors)[:, None])
    correlations = np.corrcoef(found.values.T)
    assert correlations == pytest.approx(result.correlations, abs=4.0 / np.sqrt(SAMPLES))


def test_a_parameter_at_its_bound_stays_inside():
    lossless = simulated(rows(example_amplitudes(), slice(0, None, 3)), ImpactLaw(0.95, 0.0), seed=None)
    refit = objective_of(fit(lossless, "law"))
    # no noise: the fit is at the truth, no adhesion, within what a thousandth of an error says
    assert refit.values[1] < 1e-2
    found = fit_data_sets(refit, draw_data(refit, SAMPLES, np.random.default_rng(6)))
    assert found.converged.all()
    epsilon = found.values[:, 1]
    assert epsilon.min() == 0.0
    # half of the noise would want it negative; four binomial standard deviations
    assert abs(np.mean(epsilon < 1e-2) - 0.5) < 4.0 * np.sqrt(0.25 / SAMPLES)
