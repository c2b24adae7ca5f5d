"""The posterior against another program's amplitudes and importance sampling."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from afm_jax.apparatus.cantilever import Cantilever
from afm_jax.impact.law import ImpactLaw
from afm_jax.saved import as_json
from fitting import fit, posterior
from fitting.infer.fit import explained_of
from fitting.sampling.posterior import LogDensity, log_density_of
from fitting.sampling.posterior_result import PosteriorChains, posterior_of_chains
from tests.fit_tables import _orbits as orbits_of
from tests.fit_tables import (
    amplitudes_and_errors,
    fit_of_every_fourth,
    standard_errors_of,
    values_of,
)
from tests.impact_tables import drives

pytestmark = pytest.mark.slow
"""Each compiles programs of its own for a minute or more."""


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


def test_the_sampler_agrees_with_importance_sampling(law, sampled):
    assert sampled.method == "nuts"
    assert sampled.converged, sampled.reasons
    assert sampled.chains.samples.shape[:2] == (4, 1000)
    # 20,000 draws: half as uncertain as two thousand samples at most
    mean, deviation = importance_sampling(law, 20_000)
    for k, name in enumerate(law.parameters):
        assert_close(sampled, name, mean[k], deviation[k])


def importance_sampling(result, draws: int) -> tuple[np.ndarray, np.ndarray]:
    """Return mean and standard deviation of the posterior by weighting draws of a wider Gaussian."""
    errors = standard_errors_of(result)
    cholesky = np.linalg.cholesky(1.3 * result.correlations * np.outer(errors, errors))
    z = np.random.default_rng(12).normal(size=(draws, len(errors)))
    values = values_of(result) + z @ cholesky.T
    log_weight = -0.5 * chi2_of(result, values) + 0.5 * np.sum(z**2, axis=1)
    weight = np.exp(log_weight - log_weight.max())
    weight /= weight.sum()
    assert 1.0 / np.sum(weight**2) > 0.5 * draws
    mean = weight @ values
    return mean, np.sqrt(weight @ (values - mean) ** 2)


def chi2_of(result, values: np.ndarray) -> np.ndarray:
    """Return chi2 at sets of r, epsilon and Q by another program's amplitudes; Q is known by a factor."""
    table = result.table
    amplitude, error = amplitudes_and_errors(table)
    columns = (table.order, table.drive_frequency_khz, table.drive_amplitude_nm, table.offset_nm)
    drives = [jnp.asarray(column, dtype=float) for column in columns]

    def of_amplitudes(one):
        r, epsilon, quality = one
        steady, readings = orbits_of(Cantilever(90.0, quality), ImpactLaw(r, epsilon), *drives)
        predicted = readings[jnp.arange(table.rows), jnp.argmax(steady, axis=1), :2]
        return jnp.sum(((predicted - amplitude) / error) ** 2)

    chi2 = np.asarray(jax.jit(lambda sets: jax.lax.map(of_amplitudes, sets, batch_size=100))(jnp.asarray(values)))
    return chi2 + (np.log(values[:, 2] / table.quality_factor) * table.quality_factor / table.quality_factor_error) ** 2


@pytest.fixture(scope="module")
def log_density(law) -> LogDensity:
    return log_density_of(explained_of(law))


def test_the_samplers_density_is_that_of_another_programs_amplitudes(law, log_density):
    here, there = jnp.array([0.3, -0.4, 0.2]), jnp.array([-0.6, 0.5, 0.1])
    values = np.array([log_density.values(z) for z in (here, there)])
    priors = [float(log_density.place(z)[2]) for z in (here, there)]
    chi2 = chi2_of(law, values)
    expected = -0.5 * (chi2[0] - chi2[1]) + priors[0] - priors[1]
    # amplitudes agree to 1e-9 of themselves, 1e-7 of their errors
    assert float(log_density(here) - log_density(there)) == pytest.approx(expected, abs=1e-6)


@pytest.fixture(scope="module")
def of_lasting():
    """A fit of impacts that last, and its posterior."""
    result = fit(drives(), "viscous+delay")
    return result, posterior(result)


def test_the_posterior_of_impacts_that_last_is_that_of_the_fit(of_lasting):
    result, found = of_lasting
    assert found.method == as_json(found)["method"] == "gaussian"
    assert found.converged
    errors = standard_errors_of(result)
    off = np.array(list(found.mean.values())) - values_of(result)
    # four standard errors of 4000 draws
    assert np.all(np.abs(off) < 4.0 * errors / np.sqrt(4000))
    np.testing.assert_allclose(list(found.standard_deviation.values()), errors, rtol=4.0 / np.sqrt(8000))
    assert np.corrcoef(found.chains.samples.reshape(-1, len(errors)).T) == pytest.approx(result.correlations, abs=0.07)


def test_samples_are_given_to_arviz(of_lasting):
    pytest.importorskip("arviz", reason="it is no dependency")
    _, found = of_lasting
    given = found.to_arviz()["posterior"]
    assert set(given.data_vars) == set(found.mean)
    assert (given.sizes["chain"], given.sizes["draw"]) == (4, 1000)
    np.testing.assert_array_equal(given["epsilon"], found.chains.samples[:, :, list(found.mean).index("epsilon")])


def test_chains_that_disagree_are_not_believed():
    random = np.random.default_rng(1)
    samples = random.normal(size=(4, 100, 1))
    fine = PosteriorChains(samples, np.array([1.001]), np.array([380.0]), 0, 0)
    assert posterior_of_chains(fine, ("r",), "nuts").converged
    bad = {"r_hat": np.array([np.nan])}, {"effective_samples": np.array([20.0])}, {"divergences": 20}
    for changes in bad:
        found = posterior_of_chains(dataclasses.replace(fine, **changes), ("r",), "nuts")
        assert not found.converged
        assert len(found.reasons) == 1
