"""Simulated experiments, fitted one after another: 95 % intervals hold the truth 95 times of a hundred."""

import dataclasses
from typing import NamedTuple

import numpy as np
import pytest
from scipy.stats import binom, kstest

from afm_jax.impact.law import ImpactLaw
from fitting import fit
from fitting.fits.result import FitResult
from fitting.tables.table import AmplitudeTable
from tests.fit_tables import NOISE, amplitudes_and_errors, example_amplitudes, rows, simulated, with_amplitudes

pytestmark = pytest.mark.slow

EXPERIMENTS = 200
TRUTH = {"r": 0.95, "epsilon": 60.0, "quality_factor": 40.0}
ERROR_OF_Q = 0.4


class Experiments(NamedTuple):
    """The fits, and a function of them that the noise alone decides."""

    results: list[FitResult]

    def parameter(self, name: str) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return values, standard errors, and lower and upper ends of a parameter, an open end infinite."""
        found = [result.parameters[name] for result in self.results]
        low = [-np.inf if p.interval95[0] is None else p.interval95[0] for p in found]
        high = [np.inf if p.interval95[1] is None else p.interval95[1] for p in found]
        errors = [p.standard_error or np.nan for p in found]
        return np.array([p.value for p in found]), np.array(errors), np.array(low), np.array(high)


def noisy(clean: AmplitudeTable, random: np.random.Generator) -> AmplitudeTable:
    """Return a table with 1 % noise, and Q as another measurement of it would have come out."""
    amplitude, error = amplitudes_and_errors(clean)
    measured = amplitude * (1.0 + NOISE * random.normal(size=amplitude.shape))
    quality_factor = TRUTH["quality_factor"] + ERROR_OF_Q * random.normal()
    return with_amplitudes(clean, measured, error, quality_factor=quality_factor, quality_factor_error=ERROR_OF_Q)


@pytest.fixture(scope="module")
def experiments() -> Experiments:
    example = example_amplitudes()
    twenty = rows(example, np.arange(0, example.rows, 4)[:20])
    clean = simulated(twenty, ImpactLaw(TRUTH["r"], TRUTH["epsilon"]), seed=None)
    assert clean.rows == 20
    random = np.random.default_rng(20)
    return Experiments([fit(noisy(clean, random), model="law") for _ in range(EXPERIMENTS)])


@pytest.mark.parametrize("name", list(TRUTH))
def test_intervals_cover_the_truth(experiments, name):
    _, _, low, high = experiments.parameter(name)
    covered = int(np.sum((low <= TRUTH[name]) & (TRUTH[name] <= high)))
    # once in ten thousand of right intervals would lie outside on either side
    assert binom.ppf(1e-4, EXPERIMENTS, 0.95) <= covered <= binom.ppf(1 - 1e-4, EXPERIMENTS, 0.95)


@pytest.mark.parametrize("name", list(TRUTH))
def test_pulls_have_mean_0_and_width_1(experiments, name):
    value, error, _, _ = experiments.parameter(name)
    pull = (value - TRUTH[name]) / error
    assert np.all(np.isfinite(pull))
    # four standard errors of a mean and of a width
    assert abs(pull.mean()) < 4.0 / np.sqrt(EXPERIMENTS)
    assert abs(pull.std() - 1.0) < 4.0 / np.sqrt(2 * EXPERIMENTS)


def test_chi2_is_distributed_as_such(experiments):
    assert {result.degrees_of_freedom for result in experiments.results} == {2 * 20 + 1 - 3}
    # uniform, unless by a chance of one in ten thousand
    assert kstest([result.p_value for result in experiments.results], "uniform").pvalue > 1e-4


def test_right_fits_are_valid_and_warned_of_rarely(experiments):
    # chi2 improbable at 1e-3 is the only reason that is left to chance
    assert sum(not result.valid for result in experiments.results) <= binom.ppf(1 - 1e-4, EXPERIMENTS, 1e-3)
    alarms = sum("correlated" in " ".join(result.warnings) for result in experiments.results)
    # beyond three standard deviations: 0.27 %
    assert alarms <= binom.ppf(1 - 1e-4, EXPERIMENTS, 2.7e-3)
    again = fit(dataclasses.replace(experiments.results[7].table), model="law")
    assert again.chi2 == experiments.results[7].chi2
