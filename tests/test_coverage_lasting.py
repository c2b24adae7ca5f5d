"""A thousand simulated experiments a model, each fitted: 95 % intervals hold the truth.

The truth is the fitted model itself: what is proved is the fit and its errors, not the model. Intervals are linear ones
of all experiments, and of the instantaneous law profile intervals for two hundred of them.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pytest
from scipy.stats import binom, kstest

import fitting.examples
from afm_jax.impact.law import ImpactLaw
from afm_jax.units import TWO_SIDED_95
from fitting import fit, read_table
from fitting.infer.closest import closest_parameters
from fitting.infer.explain import Explained
from fitting.infer.fit import explained_of
from fitting.infer.instantaneous import profile
from fitting.infer.summary import Fitted, convergence_of, intervals_of
from tests.coverage_of_ranks import noise_of, refitted, with_data
from tests.fit_tables import example_amplitudes, rows, simulated

pytestmark = [pytest.mark.slow, pytest.mark.long]

EXPERIMENTS, PROFILED = 1000, 200
CONTACT_EXAMPLE = fitting.examples.__path__[0] + "/amplitudes_contact.csv"
SPEEDS = np.array([30.0, 50.0, 80.0, 120.0, 180.0])
"""Approach speeds in nm/us at which bands are asked whether they hold the law."""


class Experiments(NamedTuple):
    """A fit, the truth of many data sets, and their fits."""

    truth: Explained
    own: tuple[str, ...]
    fits: list[Explained]

    def pulls(self) -> np.ndarray:
        """Return distances of printed parameters from the true ones, in their errors, shape (sets, p)."""
        true = closest_parameters(self.truth, self.own, {}).values
        found = [closest_parameters(one, self.own, {}) for one in self.fits]
        return np.array([(one.values - true) / np.linalg.norm(one.factor, axis=1) for one in found])

    def pulls_of_law(self) -> np.ndarray:
        """Return distances of rebound speed, and of the delay if there is one, from the true ones, in their errors."""
        kinds = 2 if self.truth.model.law.lasting else 1
        true = self.truth.law_at(SPEEDS).law[:kinds]
        found = [one.law_at(SPEEDS) for one in self.fits]
        return np.array([(one.law[:kinds] - true) / np.linalg.norm(one.factor[:kinds], axis=2) for one in found])


def experiment(model: str) -> tuple[Explained, tuple[str, ...]]:
    """Return the fit of a model to a bundled table, or to a law on its drives, with errors of 1 %."""
    if model == "law":
        table = simulated(rows(example_amplitudes(), slice(0, None, 3)), ImpactLaw(0.95, 60.0), seed=None)
    else:
        table = read_table(CONTACT_EXAMPLE)
    # without the adhesion energy, which the table hardly tells from the humidity
    free = ("relative_humidity", "viscosity_pa_s", "modulus_gpa") if model == "contact" else None
    result = fit(table, model, free=free)
    # what is held is known: errors of a tenth and more of ten parameters are not linear
    result = replace(result, settings=result.settings | {"held": ()})
    return explained_of(result), tuple(result.settings["free"])


@pytest.fixture(scope="module", params=["law", "viscous+delay", "contact"])
def experiments(request) -> Experiments:
    truth, own = experiment(request.param)
    random, theta, (_, strength) = np.random.default_rng(95), truth.end.theta, truth.model.prior
    reads = truth.end.orbits.readings + noise_of(truth, EXPERIMENTS, random)
    error = np.where(strength > 0.0, 1.0 / np.where(strength > 0.0, strength, 1.0), 0.0)
    # what is known beforehand of an unknown is a measurement as well
    means = theta + error * random.normal(size=(EXPERIMENTS, theta.size))
    return Experiments(truth, own, [refitted(with_data(truth, *one)) for one in zip(reads, means, strict=True)])


def check(pulls: np.ndarray) -> None:
    """Demand coverage (0.922 to 0.978), mean and width of pulls within four standard deviations of so many sets."""
    sets = len(pulls)
    covered = np.mean(np.abs(pulls) < TWO_SIDED_95, axis=0)
    assert np.all(np.abs(covered - 0.95) < 4.0 * np.sqrt(0.95 * 0.05 / sets)), covered
    assert np.abs(pulls.mean(axis=0)).max() < 4.0 / np.sqrt(sets), pulls.mean(axis=0)
    assert np.abs(pulls.std(axis=0) - 1.0).max() < 4.0 / np.sqrt(2 * sets), pulls.std(axis=0)


def test_linear_intervals_cover_the_truth_and_pulls_have_mean_0_and_width_1(experiments):
    assert all(convergence_of(one, "", 0).converged for one in experiments.fits)
    check(experiments.pulls())


def test_bands_cover_the_true_law(experiments):
    check(experiments.pulls_of_law())


def test_chi2_is_distributed_as_such(experiments):
    truth = experiments.truth
    data = int(truth.weights.used.sum()) + int((truth.model.prior[1] > 0.0).sum())
    chi2 = [one.end.chi2 for one in experiments.fits]
    # unless by a chance of one in ten thousand
    assert kstest(chi2, "chi2", args=(data - truth.end.theta.size,)).pvalue > 1e-4


def test_profile_intervals_cover_the_truth(experiments):
    if experiments.truth.model.law.lasting:
        pytest.skip("intervals are linear where impacts last")
    true = closest_parameters(experiments.truth, experiments.own, {}).values
    covered = np.zeros(len(true), dtype=int)
    for one in experiments.fits[:PROFILED]:
        fitted = Fitted(one, one, None, profile, convergence_of(one, "", 0))
        for i, interval in enumerate(intervals_of(fitted, closest_parameters(one, experiments.own, {}))):
            low = -np.inf if interval.low is None else interval.low
            high = np.inf if interval.high is None else interval.high
            covered[i] += low <= true[i] <= high
    # once in ten thousand of right intervals would lie outside on either side
    limits = binom.ppf(1e-4, PROFILED, 0.95), binom.ppf(1.0 - 1e-4, PROFILED, 0.95)
    assert np.all((limits[0] <= covered) & (covered <= limits[1])), covered
