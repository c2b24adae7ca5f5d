"""Forecasts that come true: synthetic experiments at the designed points, each fitted, scatter as was forecast."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.stats import chi2, kstest

from afm_jax.apparatus.cantilever import Cantilever
from afm_jax.impact.law import CollisionDelay, ImpactLaw
from fitting import design, drive_grid, fit, prior_of_values, simulate_experiment
from fitting.experiments.candidates import model_of, standard_errors
from fitting.experiments.design import Design
from fitting.infer.rows import weights_of
from fitting.infer.search import orbits_at
from fitting.infer.unknowns import Data
from tests.fit_tables import table_of

pytestmark = pytest.mark.slow

EXPERIMENTS = 60
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


@pytest.fixture(scope="module")
def refitted(designed) -> np.ndarray:
    """The values (experiments, p) that Gauss-Newton steps find for data with noise, Q measured anew each time."""
    prior, errors = designed.prior, by_noise(designed)
    model, begin = model_of(prior, designed.drives, prior.values)
    orbits = orbits_at(model, begin).orbits
    model = replace(model, data=data_of_readings(designed, model.data, orbits.readings))
    weights = weights_of(model, begin, orbits, np.zeros(len(designed.chosen), bool))
    known = [model.names.index(name) for name in prior.problem.names if name in KNOWN]
    strength = np.sqrt(np.diag(prior.information))[known]
    law, own = model.law, len(model.law.names)

    def values_of(theta: np.ndarray) -> np.ndarray:
        of_law = [law.value_of(name, unknown) for name, unknown in zip(law.own, theta[:own], strict=True)]
        return np.array([*of_law, *(q.at(unknown) for q, unknown in zip(model.instrument, theta[own:], strict=True))])

    def whitened(theta: np.ndarray, x: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        found = model.follow(theta, x)
        assert found.closes.all()
        off = np.where(weights.used, found.readings - model.data.read, 0.0)
        of_readings = np.einsum("nij,nj->ni", weights.whitening, off).ravel()
        slopes = (weights.whitening @ model.slopes(theta, found)).reshape(-1, theta.size)
        of_known = np.zeros((len(known), theta.size))
        of_known[np.arange(len(known)), known] = strength * [model.instrument[i - own].slope(theta[i]) for i in known]
        residual = np.append(of_readings, strength * (values_of(theta) - prior.values)[known])
        return residual, np.concatenate([slopes, of_known]), found.x

    random, answers = np.random.default_rng(11), []
    there = np.append(weights.used.ravel(), np.ones(len(known), bool))
    assert np.abs(whitened(begin, orbits.x)[0]).max() < 1e-9
    for _ in range(EXPERIMENTS):
        theta, x, noise = begin, orbits.x, random.normal(size=there.size) * there
        before, moved = prior.values, prior.values
        for _ in range(STEPS):
            residual, slopes, x = whitened(theta, x)
            before, size = moved, np.linalg.norm(slopes, axis=0)
            theta = theta + np.linalg.lstsq(slopes / size, noise - residual, rcond=None)[0] / size
            moved = values_of(theta)
        # settled to a hundredth of a standard error
        assert np.abs((moved - before) / errors).max() < 0.01
        answers.append(moved)
    return np.array(answers)


def data_of_readings(result: Design, data: Data, readings: np.ndarray) -> Data:
    """Return rows with readings, as many of them as a design has, and the errors of their noise."""
    tapping = result.prior.problem.tapping
    relative = result.noise * readings[:, :2]
    error = np.concatenate([relative, np.full((len(readings), 1), 0.01 if tapping else 0.2)], axis=1)
    read = np.where([not tapping, True, tapping], readings, np.nan)
    return replace(data, read=read, error=error)


def test_the_forecast_is_what_a_fit_states(designed):
    assert designed.valid
    assert np.all(designed.errors[-1] >= by_noise(designed) * (1.0 - 1e-9))
    if designed.prior.problem.tapping:
        return
    exact = designed.candidates.readings[designed.chosen, :2]
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
