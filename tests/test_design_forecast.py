"""Forecasts of designs: the errors that a fit states, and readings of the motion in time."""

from typing import Any

import numpy as np
import pytest

from afm_jax.apparatus.cantilever import Cantilever
from afm_jax.impact.law import CollisionDelay, ImpactLaw
from fitting import design, drive_grid, fit, prior_of_values, simulate_experiment
from fitting.experiments.candidates import standard_errors
from tests.fit_tables import table_of

pytestmark = pytest.mark.slow

VALUES = {"r": 0.99, "epsilon": 122.0, "delay_hertz": 0.206, "delay_lead_nm": 5.64, "delay_offset_nm": 0.726}


TAPPED = {"epsilon": 2.0, "viscous_loss": 0.2, "delay_hertz": 0.2, "delay_lead_nm": 5.0, "delay_offset_nm": 0.6}
KNOWN = {"quality_factor": (200.0, 2.0), "tip_calibration": (1.0, 0.02), "phase_zero_deg": (0.0, 0.02)}


def test_the_forecast_is_what_a_fit_states():
    places = {"orders": (1, 2), "amplitudes_nm": (2.0, 5.0), "offsets_nm": (-1.0, 1.0)}
    drives = drive_grid(**places, detunings=(0.98, 0.99, 1.0, 1.02), free_frequency_khz=90.0)
    known = {"quality_factor": (40.0, 0.4)}
    prior = prior_of_values("law+delay", free_frequency_khz=90.0, quality_factor=40.0, values=VALUES, constraints=known)
    designed = design(prior, drives, points=14, noise=0.003)
    assert designed.valid
    exact = designed.candidates.readings[designed.chosen, :2]
    result = fit(table_of(designed.drives, exact, 0.003 * exact, quality_factor_error=0.4), "law+delay")
    assert result.valid
    stated = np.array([result.parameters[name].standard_error for name in designed.prior.problem.names], float)
    # the fit ends beside the believed law: its loss has a viscous part of its own
    np.testing.assert_allclose(designed.errors[-1], stated, rtol=0.05)
    information = designed.prior.information + designed.candidates.information[designed.chosen].sum(axis=0)
    # noise alone, without what the law leaves out
    assert np.all(designed.errors[-1] > standard_errors(information))


def test_readings_of_tapping_points_are_those_of_the_motion_in_time():
    places = {"orders": (1,), "amplitudes_nm": (40.0, 80.0), "heights": (0.8, 0.6, 0.4, 0.2)}
    drives = drive_grid(**places, detunings=(1.04, 1.07, 1.1), free_frequency_khz=90.0, drive="force")
    given: dict[str, Any] = {
        "quality_factor": 200.0,
        "mass_ng": 16.81,
        "values": TAPPED,
        "constraints": KNOWN,
        "drive": "force",
    }
    prior = prior_of_values("viscous+delay", free_frequency_khz=90.0, **given)
    designed = design(prior, drives, points=14, noise=2e-4, phase_noise_deg=0.01)
    assert designed.valid
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
