"""The posterior against quadrature of another program's amplitudes and importance sampling."""

import dataclasses
import sys

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import quad

from afm_jax.impact.law import ImpactLaw
from fitting import fit, posterior
from fitting.sampling.posterior import log_density_of, space_around
from fitting.sampling.posterior_result import PosteriorChains, posterior_of_chains
from fitting.sampling.refit import objective_of, standard_covariance
from tests.fit_tables import (
    amplitudes_and_errors,
    example_amplitudes,
    fit_of_every_fourth,
    rows,
    simulated,
)
from tests.fit_tables import steady_amplitudes as amplitudes_of
from tests.impact_tables import drives

pytestmark = pytest.mark.slow
"""Each compiles programs of its own for a minute or more."""


@pytest.fixture(scope="module")
def exact_q():
    """A table of a law without adhesion, its quality factor exactly known."""
    every_fourth = rows(example_amplitudes(), slice(0, None, 4), quality_factor=40.0, quality_factor_error=None)
    return simulated(every_fourth, ImpactLaw(0.95, 0.0), seed=8)


@pytest.fixture(scope="module")
def law():
    return fit_of_every_fourth()


@pytest.fixture(scope="module")
def sampled(law):
    pytest.importorskip("blackjax", reason="the sampler is an extra")
    return posterior(law)


def assert_close(found, name: str, mean: float, deviation: float) -> None:
    """Demand mean and standard deviation within four standard errors of the independent samples."""
    count = found.chains.effective_samples[list(found.mean).index(name)]
    assert count > 400
    assert found.mean[name] == pytest.approx(mean, abs=4.0 * deviation / np.sqrt(count))
    assert found.standard_deviation[name] == pytest.approx(deviation, rel=4.0 / np.sqrt(2.0 * count))


def test_one_parameter_agrees_with_quadrature(exact_q):
    result = fit(exact_q, "restitution")
    found = posterior(result)
    amplitude, error = amplitudes_and_errors(exact_q)

    def density(r):
        predicted = amplitudes_of(exact_q, ImpactLaw(r, 0.0))
        return np.exp(-0.5 * (np.sum(((predicted - amplitude) / error) ** 2) - result.chi2))

    sigma = result.parameters["r"].standard_error
    assert sigma is not None
    middle = result.parameters["r"].value
    ends = middle - 7.0 * sigma, middle + 7.0 * sigma
    total = quad(density, *ends, epsrel=1e-8)[0]
    mean = quad(lambda r: r * density(r), *ends, epsrel=1e-8)[0] / total
    variance = quad(lambda r: (r - mean) ** 2 * density(r), *ends, epsrel=1e-8)[0] / total
    assert_close(found, "r", mean, np.sqrt(variance))
    count = found.chains.effective_samples[0]
    for end, share in zip(found.interval95["r"], (0.025, 0.975), strict=True):
        # four binomial deviations of the share below
        deviation = np.sqrt(0.025 * 0.975 / count)
        assert quad(density, ends[0], end, epsrel=1e-8)[0] / total == pytest.approx(share, abs=4.0 * deviation)


def test_a_loss_that_vanishes_has_a_one_sided_density(exact_q):
    result = fit(exact_q, "law")
    found = posterior(result)
    assert found.chains.samples[..., 1].min() >= 0.0
    assert found.interval95["epsilon"][0] > 0.0
    assert found.mean["epsilon"] > 0.0


def test_the_sampler_agrees_with_importance_sampling(law, sampled):
    assert sampled.converged, sampled.reasons
    assert sampled.chains.samples.shape[:2] == (4, 1000)
    # 20,000 draws: half as uncertain as two thousand samples at most
    mean, deviation = importance_sampling(objective_of(law), 20_000)
    for k, name in enumerate(law.parameters):
        assert_close(sampled, name, mean[k], deviation[k])


def importance_sampling(refit, draws: int) -> tuple[np.ndarray, np.ndarray]:
    """Return mean and standard deviation of the posterior by weighting draws of a wider Gaussian."""
    cholesky = np.linalg.cholesky(1.3 * standard_covariance(refit))
    z = np.random.default_rng(12).normal(size=(draws, len(refit.values)))
    values = refit.values + z @ cholesky.T
    chi2 = np.sum(refit.objective.residual(values) ** 2, axis=1)
    log_weight = -0.5 * chi2 + 0.5 * np.sum(z**2, axis=1)
    weight = np.exp(log_weight - log_weight.max())
    weight /= weight.sum()
    assert 1.0 / np.sum(weight**2) > 0.5 * draws
    mean = weight @ values
    return mean, np.sqrt(weight @ (values - mean) ** 2)


@pytest.fixture(scope="module")
def space(law):
    refit = objective_of(law)
    return space_around(refit.objective.problem, refit.values, standard_covariance(refit))


@pytest.mark.parametrize("tie", [1.0, np.nan])
def test_parameters_that_are_one_have_no_space(law, tie):
    refit = objective_of(law)
    values, error = refit.values, 0.01 * refit.values
    tied = tie * np.outer(error, error)
    with pytest.raises(ValueError, match="hardly tell r, epsilon, quality_factor apart"):
        space_around(refit.objective.problem, values, tied)


def test_the_samplers_density_is_the_objectives(law, space):
    refit = objective_of(law)
    log_density = log_density_of(refit, standard_covariance(refit))
    here, there = np.array([0.3, -0.4, 0.2]), np.array([-0.6, 0.5, 0.1])
    values, priors = zip(*(space.values_and_log_prior(jnp.asarray(z)) for z in (here, there)), strict=True)
    chi2 = np.sum(refit.objective.residual(np.array(values)) ** 2, axis=1)
    expected = -0.5 * (chi2[0] - chi2[1]) + float(priors[0] - priors[1])
    found = float(log_density(jnp.asarray(here)) - log_density(jnp.asarray(there)))
    # the same sums in another order
    assert found == pytest.approx(expected, rel=1e-9)


def test_the_prior_is_the_derivative_of_the_values(space):
    z, step = np.array([0.3, -0.4, 0.2]), 1e-5

    def values(shift):
        return np.asarray(space.values_and_log_prior(jnp.asarray(z + shift))[0])

    jacobian = np.array([values(shift) - values(-shift) for shift in step * np.eye(3)]) / (2.0 * step)
    _, log_prior = space.values_and_log_prior(jnp.asarray(z))
    # up to the constant determinant of axes and errors; central differences to 1e-10
    constant = np.linalg.slogdet(space.axes)[1] + np.sum(np.log(space.errors))
    assert np.linalg.slogdet(jacobian)[1] - constant == pytest.approx(float(log_prior), abs=1e-6)


@pytest.mark.xfail(strict=True, reason="the redrawn fit: posterior and intervals of one residual")
def test_the_posterior_of_impacts_that_last_is_that_of_the_fit():
    """Its Gaussian approximation starts at the fit's values and is as wide as the fit's errors."""
    result = fit(drives(), "viscous+delay")
    refit = objective_of(result)
    matrix = standard_covariance(refit)
    linear = refit.objective.at_values(refit.values[None])
    to_the_mode = -matrix @ np.asarray(linear.jacobian)[0].T @ np.asarray(linear.residual)[0]
    errors = np.array([parameter.standard_error for parameter in result.parameters.values()])
    assert np.all(np.abs(to_the_mode) < 0.5 * errors)
    np.testing.assert_allclose(np.sqrt(np.diag(matrix)), errors, rtol=0.25)


def test_chains_that_disagree_are_not_believed():
    random = np.random.default_rng(1)
    samples = random.normal(size=(4, 100, 1))
    fine = PosteriorChains(samples, np.array([1.001]), np.array([380.0]), 0, 0)
    assert posterior_of_chains(fine, ("r",)).converged
    bad = {"r_hat": np.array([np.nan])}, {"effective_samples": np.array([20.0])}, {"divergences": 20}
    for changes in bad:
        found = posterior_of_chains(dataclasses.replace(fine, **changes), ("r",))
        assert not found.converged
        assert len(found.reasons) == 1


def test_wrong_calls_are_refused_in_one_line(law, monkeypatch):
    monkeypatch.setitem(sys.modules, "blackjax", None)
    with pytest.raises(ImportError, match=r"pip install 'afm-jax\[nuts\]'"):
        posterior(law)
