"""Likelihoods of a posterior's draws against another program's amplitudes; ranks of true values in posteriors."""

import numpy as np
import pytest
from scipy.stats import kstest, norm

from afm_jax.impact.law import ImpactLaw
from fitting import posterior
from tests.batched_refit import densities, noise_of, posterior_draws, refit_of_rows
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
    here = drawn.log_likelihood.sum(axis=2)[2] + known - drawn.log_density[2]
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
