"""The file for ArviZ against another program's amplitudes; ranks of true values in posteriors."""

from pathlib import Path

import numpy as np
import pytest
from scipy.stats import kstest, norm

from afm_jax.impact.law import ImpactLaw
from fitting import posterior, write_inference_data
from fitting.sampling.inference_data import densities, noise_of, posterior_draws, refit_of_rows
from tests.coverage_of_ranks import calibrate_ranks
from tests.fit_tables import fit_of_every_fourth, steady_amplitudes

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def believed():
    pytest.importorskip("blackjax", reason="the sampler is an extra")
    return fit_of_every_fourth(), posterior(fit_of_every_fourth())


def values_believed(believed) -> np.ndarray:
    return posterior_draws(*believed).values.reshape(-1, 3)


def test_likelihoods_are_those_of_another_programs_amplitudes(believed):
    result, found = believed
    drawn = posterior_draws(result, found)
    r, epsilon, quality = drawn.values[2, 7]
    table = result.table
    predicted = steady_amplitudes(table, ImpactLaw(float(r), float(epsilon)), quality_factor=float(quality))
    expected = norm.logpdf(drawn.measured, predicted, drawn.error).sum(axis=1)
    assert drawn.predicted[2, 7] == pytest.approx(predicted, rel=1e-9)
    assert drawn.log_likelihood[2, 7] == pytest.approx(expected, abs=1e-7)
    known = norm.logpdf(drawn.values[2, :, 2], table.quality_factor, table.quality_factor_error)
    here = drawn.log_likelihood.sum(axis=2)[2] + known - drawn.statistics["lp"][2]
    # up to a constant it is the posterior's
    assert np.ptp(here) < 1e-8
    z = (drawn.replicated - drawn.predicted) / drawn.error
    assert kstest(z.ravel(), "norm").pvalue > 0.01


def test_a_robust_loss_is_a_distribution_of_errors(believed):
    refit, _ = refit_of_rows(believed[0])
    plain, robust = refit.objective, refit.objective.with_rows()
    robust.robust = True
    z = np.linspace(-60.0, 60.0, 200_001)
    density = np.exp(-4.0 * (np.sqrt(1.0 + z**2 / 4.0) - 1.0))
    norms = float(np.trapezoid(density, z))
    misfit = plain.amplitude_residuals(refit.values)
    error = np.asarray(plain.measurement.rows.error_nm)
    expected = -4.0 * (np.sqrt(1.0 + misfit**2 / 4.0) - 1.0) - np.log(norms * error)
    found = densities(robust, refit.values[None])
    assert found.log_likelihood[0] == pytest.approx(expected.sum(axis=1), abs=1e-8)
    noise = noise_of(robust, 400, np.random.default_rng(1))[:, 0, 0] / error[0, 0]
    assert kstest(noise, lambda x: np.interp(x, z, np.cumsum(density) / density.sum())).pvalue > 0.01
    assert calibrate_ranks(refit._replace(objective=robust), values_believed(believed), sets=20).failed < 5


def test_a_right_posterior_is_not_complained_of(believed):
    result, _ = believed
    ranks = calibrate_ranks(refit_of_rows(result)[0], values_believed(believed), sets=100)
    assert ranks.p_value > 0.05
    assert ranks.gaussian_p_value > 0.05
    assert ranks.failed == 0


@pytest.mark.filterwarnings("ignore::FutureWarning:arviz", "ignore:Estimated shape parameter of Pareto")
def test_arviz_reads_the_file_and_predicts_each_row_by_the_others(believed, tmp_path: Path):
    arviz = pytest.importorskip("arviz", reason="ArviZ is an extra")
    result, found = believed
    path = tmp_path / "posterior.nc"
    write_inference_data(result, found, path)
    data = arviz.from_netcdf(path)
    groups = {"posterior", "sample_stats", "log_likelihood", "posterior_predictive", "observed_data"}
    # a DataTree since ArviZ 1
    assert groups <= set(data.children if hasattr(data, "children") else data.groups())
    assert np.asarray(data.observed_data["peak_amplitude_nm"]) == pytest.approx(result.table.peak_amplitude_nm)
    loo = arviz.loo(data, pointwise=True)
    assert np.asarray(loo.pareto_k).shape == (result.table.rows,)
    # rows that the law explains: as many effective parameters as there are, give or take the scatter of the rows
    assert 1.0 < (loo.p if hasattr(loo, "p") else loo.p_loo) < 6.0
