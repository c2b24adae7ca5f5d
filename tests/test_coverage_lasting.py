"""A thousand simulated experiments a model, fitted at once: 95 % intervals hold the truth 95 times of a hundred.

The truth is the fitted model itself: what is proved is the fit and its errors, not the model. Intervals are Wald's for
all thousand, and of the instantaneous law profile intervals for two hundred of them.
"""

import numpy as np
import pytest
from scipy.stats import binom, kstest

import fitting.examples
from afm_jax.impact.law import ImpactLaw
from fitting import read_table
from fitting.fits.intervals import profile_intervals
from fitting.fits.minimum import model_errors_of, with_inflated_errors
from fitting.fits.objective import Objective
from fitting.models import Problem, measurement_of
from fitting.sampling.refit import Refit
from tests.batched_refit import BatchFit, DataSets, draw_data, fit_data_sets
from tests.fit_tables import example_amplitudes, rows, simulated

pytestmark = pytest.mark.slow

EXPERIMENTS, PROFILED = 1000, 200
CONTACT_EXAMPLE = fitting.examples.__path__[0] + "/amplitudes_contact.csv"
DELAY = {"delay_hertz": 0.206, "delay_lead_nm": 5.64, "delay_offset_nm": 0.726}
TRUTHS = {
    "law": {"r": 0.95, "epsilon": 60.0, "quality_factor": 40.0},
    "viscous+delay": {"epsilon": 113.6, "viscous_loss": 0.5} | DELAY | {"quality_factor": 40.0},
    "contact": {"relative_humidity": 0.45, "viscosity_pa_s": 1e-3, "modulus_gpa": 100.0},
}


def experiment(model: str) -> Refit:
    """Return a model at its truth on the drives of a bundled table, with errors of 1 %."""
    if model == "law":
        table = simulated(rows(example_amplitudes(), slice(0, None, 3)), ImpactLaw(0.95, 60.0), seed=None)
    else:
        table = read_table(CONTACT_EXAMPLE)
    problem = Problem(model, tuple(TRUTHS[model]))
    values = np.array(list(TRUTHS[model].values()))
    stated = Objective(measurement_of(table, problem), problem).following(values)
    # without the rows that a fit would set aside
    return Refit(with_inflated_errors(stated, model_errors_of(stated, values)), values)


@pytest.fixture(scope="module", params=list(TRUTHS))
def fits(request) -> tuple[Refit, DataSets, BatchFit]:
    refit = experiment(request.param)
    exists = np.asarray(refit.objective.at_values(refit.values[None]).prediction.orbits)[0] > 0
    measured = np.asarray(refit.objective.measurement.rows.measured)
    assert exists[measured.any(axis=1)].all()
    data = draw_data(refit, EXPERIMENTS, np.random.default_rng(95))
    return refit, data, fit_data_sets(refit, data)


def test_wald_intervals_cover_the_truth_and_pulls_have_mean_0_and_width_1(fits):
    refit, _, found = fits
    assert found.converged.all()
    pull = (found.values - refit.values) / np.sqrt(np.einsum("spp->sp", found.covariance))
    covered = np.mean(np.abs(pull) < 1.959964, axis=0)
    # four binomial standard deviations, and four standard errors of a mean and of a width
    assert np.all((covered >= 0.922) & (covered <= 0.978)), covered
    assert np.abs(pull.mean(axis=0)).max() < 4.0 / np.sqrt(EXPERIMENTS), pull.mean(axis=0)
    assert np.abs(pull.std(axis=0) - 1.0).max() < 4.0 / np.sqrt(2 * EXPERIMENTS), pull.std(axis=0)


def test_chi2_is_distributed_as_such(fits):
    refit, _, found = fits
    known = refit.objective.measurement
    data = int(np.asarray(known.rows.measured).sum()) + int(np.isfinite(np.asarray(known.constraint_error)).sum())
    freedom = data - len(refit.values)
    # unless by a chance of one in ten thousand
    assert kstest(found.chi2, "chi2", args=(freedom,)).pvalue > 1e-4


def test_profile_intervals_cover_the_truth(fits):
    refit, data, found = fits
    if refit.objective.problem.lasting:
        pytest.skip("two hundred profiles of a lasting model take minutes")
    objective, names = refit.objective, refit.objective.problem.names
    covered = np.zeros(len(names), dtype=int)
    for k in range(PROFILED):
        measurement = objective.measurement._replace(
            rows=objective.measurement.rows._replace(amplitude_nm=data.amplitude_nm[k]),
            constraint_value=data.constraint_value[k],
        )
        own = Objective(measurement, objective.problem, near=objective.near)
        intervals = profile_intervals(own, found.values[k], found.covariance[k], float(found.chi2[k]))
        for i, interval in enumerate(intervals):
            low = -np.inf if interval.low is None else interval.low
            high = np.inf if interval.high is None else interval.high
            covered[i] += low <= refit.values[i] <= high
    # once in ten thousand of right intervals would lie outside on either side
    limits = binom.ppf(1e-4, PROFILED, 0.95), binom.ppf(1.0 - 1e-4, PROFILED, 0.95)
    assert np.all((limits[0] <= covered) & (covered <= limits[1])), dict(zip(names, covered.tolist(), strict=True))
