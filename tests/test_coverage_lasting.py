"""A thousand simulated experiments a model, fitted at once: 95 % intervals hold the truth 95 times of a hundred.

The truth is the fitted model itself: what is proved is the fit and its errors, not the model. Intervals are Wald's for
all thousand, and of the instantaneous law profile intervals for two hundred of them; eight are fitted one by one as
users do, and come to the values of the batch.
"""

import numpy as np
import pytest
from scipy.stats import binom, kstest

import fitting.examples
from afm_jax.impact.law import ImpactLaw
from fitting import fit, read_table
from fitting.fits.intervals import profile_intervals
from fitting.fits.minimum import model_errors_of, with_inflated_errors
from fitting.fits.objective import Objective
from fitting.models import Problem, measurement_of
from fitting.sampling.bootstrap import BatchFit, DataSets, Refit, draw_data, fit_data_sets
from fitting.tables.table import AmplitudeTable
from tests.fit_tables import amplitudes_and_errors, example_amplitudes, rows, simulated, values_of, with_amplitudes

pytestmark = pytest.mark.slow

EXPERIMENTS, PROFILED, WHOLE = 1000, 200, 8
CONTACT_EXAMPLE = fitting.examples.__path__[0] + "/amplitudes_contact.csv"
DELAY = {"delay_hertz": 0.206, "delay_lead_nm": 5.64, "delay_offset_nm": 0.726}
TRUTHS = {
    "law": {"r": 0.95, "epsilon": 60.0, "quality_factor": 40.0},
    "viscous+delay": {"epsilon": 113.6, "viscous_loss": 0.5} | DELAY | {"quality_factor": 40.0},
    "contact": {"relative_humidity": 0.45, "viscosity_pa_s": 1e-3, "modulus_gpa": 100.0},
}


def table_for(model: str) -> AmplitudeTable:
    """Return the drives of a bundled table, with errors of 1 %."""
    if model != "law":
        return read_table(CONTACT_EXAMPLE)
    example = example_amplitudes()
    return simulated(rows(example, np.arange(0, example.rows, 3)), ImpactLaw(0.95, 60.0), seed=None)


def experiment(model: str) -> Refit:
    """Return a model at its truth on the drives of a bundled table."""
    table = table_for(model)
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


def test_whole_fits_are_those_of_the_batch_and_rarely_warn(fits):
    refit, data, batch = fits
    if refit.objective.problem.lasting:
        pytest.skip("its errors are inflated at the truth, those of a fit where it ends")
    table = table_for("law")
    (quality,) = np.flatnonzero(np.isfinite(np.asarray(refit.objective.measurement.constraint_error)))
    _, error = amplitudes_and_errors(table)
    results = [
        fit(
            with_amplitudes(
                table, data.amplitude_nm[k, : table.rows, :2], error, quality_factor=data.constraint_value[k, quality]
            ),
            "law",
        )
        for k in range(WHOLE)
    ]
    deviation = np.sqrt(np.diagonal(batch.covariance, axis1=1, axis2=2))[:WHOLE]
    # a fit ends within a thousandth of an error of its minimum
    np.testing.assert_allclose(
        [values_of(one) for one in results] / deviation, (batch.values[:WHOLE]) / deviation, atol=2e-3, rtol=0
    )
    np.testing.assert_allclose([one.chi2 for one in results], batch.chi2[:WHOLE], rtol=1e-5)
    # left to chance: chi2 improbable at 1e-3, and an alarm beyond three standard deviations (0.27 %)
    assert sum(not one.valid for one in results) <= binom.ppf(1 - 1e-4, WHOLE, 1e-3)
    assert sum("correlated" in " ".join(one.warnings) for one in results) <= binom.ppf(1 - 1e-4, WHOLE, 2.7e-3)
