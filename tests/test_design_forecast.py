"""Forecasts that come true: synthetic experiments at the designed points, each fitted, scatter as was forecast."""

from typing import Any

import numpy as np
import pytest
from scipy.stats import chi2, kstest

from afm_jax.apparatus.cantilever import Cantilever
from afm_jax.impact.law import CollisionDelay, ImpactLaw
from fitting import design, drive_grid, fit, prior_of_values, simulate_experiment
from fitting.experiments.candidates import standard_errors
from fitting.experiments.design import Design
from fitting.fits.objective import BATCH, Objective
from fitting.models import measurement_of
from fitting.tables.table import AmplitudeTable
from tests.fit_tables import table_of

pytestmark = pytest.mark.slow

EXPERIMENTS = 200
STEPS = 8
VALUES = {"r": 0.99, "epsilon": 122.0, "delay_hertz": 0.206, "delay_lead_nm": 5.64, "delay_offset_nm": 0.726}


TAPPED = {"epsilon": 2.0, "viscous_loss": 0.2, "delay_hertz": 0.2, "delay_lead_nm": 5.0, "delay_offset_nm": 0.6}
KNOWN = {"quality_factor": (200.0, 2.0), "tip_calibration": (1.0, 0.02), "phase_zero_deg": (0.0, 0.02)}


@pytest.fixture(scope="module", params=["sample", "force"])
def designed(request) -> Design:
    """Designs of resonances of a driven sample, and of tapping curves, the tip driven by a force."""
    if request.param == "sample":
        places = {"orders": (1, 2), "amplitudes_nm": (2.0, 5.0), "offsets_nm": (-1.0, 1.0)}
        drives = drive_grid(**places, detunings=(0.98, 0.99, 1.0, 1.02), free_frequency_khz=90.0)
        known = {"quality_factor": (40.0, 0.4)}
        given: dict[str, Any] = {"quality_factor": 40.0, "values": VALUES, "constraints": known}
        return design(prior_of_values("law+delay", free_frequency_khz=90.0, **given), drives, points=14, noise=0.003)
    places = {"orders": (1,), "amplitudes_nm": (40.0, 80.0), "heights": (0.8, 0.6, 0.4, 0.2)}
    drives = drive_grid(**places, detunings=(1.04, 1.07, 1.1), free_frequency_khz=90.0, drive="force")
    given = {"quality_factor": 200.0, "mass_ng": 16.81, "values": TAPPED, "constraints": KNOWN, "drive": "force"}
    prior = prior_of_values("viscous+delay", free_frequency_khz=90.0, **given)
    return design(prior, drives, points=14, noise=2e-4, phase_noise_deg=0.01)


def information_of(result: Design) -> np.ndarray:
    """Return the information after all points if the law were the model's own, without what that leaves out."""
    return result.prior.information + result.candidates.information[result.chosen].sum(axis=0)


def by_noise(result: Design) -> np.ndarray:
    return standard_errors(information_of(result))


def exact_table(result: Design) -> AmplitudeTable:
    """Return the readings that the prior expects at the points, without noise."""
    drives, chosen = result.drives, result.chosen
    amplitude, error = result.candidates.amplitude_nm[chosen], result.candidates.error_nm[chosen]
    if not result.prior.problem.tapping:
        return table_of(drives, amplitude, error, quality_factor_error=0.4)
    return AmplitudeTable(
        drive="force",
        drive_frequency_khz=drives.frequency_khz,
        free_amplitude_nm=drives.amplitude_nm,
        offset_nm=drives.offset_nm,
        free_frequency_khz=90.0,
        quality_factor=KNOWN["quality_factor"][0],
        quality_factor_error=KNOWN["quality_factor"][1],
        mass_ng=16.81,
        calibration={name: KNOWN[name] for name in ("tip_calibration", "phase_zero_deg")},
        lockin_amplitude_nm=amplitude[:, 1],
        lockin_amplitude_error_nm=error[:, 1],
        phase_lag_deg=amplitude[:, 2],
        phase_lag_error_deg=error[:, 2],
    )


@pytest.fixture(scope="module")
def refitted(designed) -> np.ndarray:
    """The values (experiments, p) that Gauss-Newton steps find for data with noise, Q measured anew each time."""
    prior, errors = designed.prior, by_noise(designed)
    searching = Objective(measurement_of(exact_table(designed), prior.problem), prior.problem)
    objective = searching.following(prior.values)
    random = np.random.default_rng(11)
    answers = []
    for _ in range(EXPERIMENTS // BATCH):
        values, step, noise = np.repeat(prior.values[None], BATCH, axis=0), np.zeros(0), np.zeros(0)
        for count in range(STEPS):
            linear = objective.at_values(values)
            jacobian = np.asarray(linear.jacobian) * errors
            if count == 0:
                assert np.abs(linear.residual).max() < 1e-9
                # of each reading and of the constraint; nothing where a padded row has no reading
                noise = random.normal(size=linear.residual.shape) * jacobian.any(axis=2)
            pairs = zip(jacobian, noise - linear.residual, strict=True)
            step = np.array([np.linalg.lstsq(slopes, missing, rcond=None)[0] for slopes, missing in pairs])
            values = values + errors * step
        # settled to a hundredth of a standard error
        assert np.abs(step).max() < 0.01
        answers.append(values)
    return np.concatenate(answers)


def test_the_forecast_is_what_a_fit_states(designed):
    assert designed.valid
    assert np.all(designed.errors[-1] >= by_noise(designed) * (1.0 - 1e-9))
    if designed.prior.problem.tapping:
        return
    exact = designed.candidates.amplitude_nm[designed.chosen]
    result = fit(table_of(designed.drives, exact, 0.003 * exact, quality_factor_error=0.4), "law+delay")
    assert result.valid
    stated = np.array([result.parameters[name].standard_error for name in designed.prior.problem.names], float)
    # the fit ends beside the believed law: its loss has a viscous part of its own
    np.testing.assert_allclose(designed.errors[-1], stated, rtol=0.05)
    assert np.all(designed.errors[-1] > by_noise(designed))


def test_scatter_is_the_forecast(designed, refitted):
    pulls = (refitted - designed.prior.values) / by_noise(designed)
    # once in ten thousand of right forecasts would lie outside on either side
    low, high = chi2.ppf([1e-4, 1.0 - 1e-4], EXPERIMENTS - 1) / (EXPERIMENTS - 1)
    ratio = pulls.var(axis=0)
    assert np.all((low < ratio) & (ratio < high)), dict(zip(designed.prior.problem.names, ratio, strict=True))
    # the mean is off by no more than four of its standard errors
    assert np.all(np.abs(pulls.mean(axis=0)) < 4.0 / np.sqrt(EXPERIMENTS)), pulls.mean(axis=0)
    # and all together
    miss = refitted - designed.prior.values
    distance = np.einsum("sp,pq,sq->s", miss, information_of(designed), miss)
    assert kstest(distance, chi2(len(designed.prior.values)).cdf).pvalue > 1e-3


def test_readings_of_tapping_points_are_those_of_the_motion_in_time(designed):
    if not designed.prior.problem.tapping:
        pytest.skip("of a cantilever that is driven itself")
    delay = CollisionDelay(TAPPED["delay_hertz"], TAPPED["delay_lead_nm"], TAPPED["delay_offset_nm"])
    law = ImpactLaw(1.0, TAPPED["epsilon"], TAPPED["viscous_loss"], delay)
    made = simulate_experiment(
        law, Cantilever(90.0, 200.0, 16.81), designed.drives, drive="force", noise=2e-4, phase_noise_deg=0.01
    )
    assert not made.left_out
    points = designed.points()
    for name in ("lockin_amplitude_nm", "phase_lag_deg"):
        # followed until a millionth is left
        found, seen = [point[f"expected_{name}"] for point in points], getattr(made.exact, name)
        np.testing.assert_allclose(found, seen, rtol=1e-5, atol=1e-5)
