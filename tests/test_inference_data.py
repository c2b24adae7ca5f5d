"""Likelihoods of a posterior's draws against another program's amplitudes; ranks of true values in posteriors."""

import numpy as np
import pytest
from scipy.stats import kstest, norm

from afm_jax.impact.law import ImpactLaw
from fitting import posterior
from fitting.infer.fit import explained_of
from tests.batched_refit import chi2_of, noise_of, readings_of, unknowns_of
from tests.coverage_of_ranks import calibrate_ranks
from tests.fit_tables import amplitudes_and_errors, fit_of_every_fourth, steady_amplitudes

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def believed():
    """A fit, its minimum, and draws of its posterior."""
    pytest.importorskip("blackjax", reason="the sampler is an extra")
    result = fit_of_every_fourth()
    return result, explained_of(result), posterior(result).chains.samples[:, ::4].reshape(-1, 3)


def test_likelihoods_are_those_of_another_programs_amplitudes(believed):
    result, explained, values = believed
    some = values[::100]
    theta = unknowns_of(explained, some)
    amplitude, error = amplitudes_and_errors(result.table)
    predicted = readings_of(explained, theta)[:, :, :2]
    chi2 = []
    for (r, epsilon, quality), here in zip(some.tolist(), predicted, strict=True):
        other = steady_amplitudes(result.table, ImpactLaw(r, epsilon), quality_factor=quality)
        assert here == pytest.approx(other, rel=1e-9)
        likelihood = norm.logpdf(amplitude, other, error) - norm.logpdf(amplitude, amplitude, error)
        # of a factor of Q
        known, off = result.table.quality_factor, result.table.quality_factor_error
        chi2.append(-2.0 * likelihood.sum() + (np.log(quality / known) * known / off) ** 2)
    assert chi2_of(explained, theta) == pytest.approx(np.array(chi2), abs=1e-6)
    z = noise_of(explained, 400, np.random.default_rng(1))[:, :, :2] / error
    assert kstest(z.ravel(), "norm").pvalue > 0.01


def test_a_right_posterior_is_not_complained_of(believed):
    _, explained, values = believed
    ranks = calibrate_ranks(explained, unknowns_of(explained, values), sets=300)
    assert ranks.p_value > 0.05
    assert ranks.gaussian_p_value > 0.05
    assert ranks.failed == 0


def test_a_posterior_that_is_too_narrow_is_noticed(believed):
    _, explained, values = believed
    theta = unknowns_of(explained, values)
    middle = theta.mean(axis=0)
    assert calibrate_ranks(explained, middle + 0.5 * (theta - middle), sets=100).p_value < 1e-3
