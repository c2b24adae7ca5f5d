"""Designs on the instantaneous law: information, forecasts and choices against another search for the orbits."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest

from afm_jax.impact.law import ImpactLaw
from afm_jax.saved import as_json
from fitting import design, drive_grid, fit, prior_of_values
from fitting.experiments.candidates import Candidates, candidates_of, explained
from fitting.experiments.design import Design
from fitting.experiments.prior import Prior, prior_of_fit
from fitting.simulated.experiment import Drives
from tests.fit_tables import steady_readings, table_of

LAW = {"r": 0.95, "epsilon": 60.0}
QUALITY_FACTOR = (40.0, 0.4)
NOISE = 0.01


def law_prior(**changes) -> Prior:
    given = {"values": LAW, "constraints": {"quality_factor": QUALITY_FACTOR}} | changes
    return prior_of_values("law", free_frequency_khz=90.0, quality_factor=QUALITY_FACTOR[0], **given)


@pytest.fixture(scope="module")
def drives() -> Drives:
    return drive_grid(
        orders=(1, 2),
        amplitudes_nm=(2.0, 5.0),
        offsets_nm=(-1.0, 1.0),
        detunings=(0.97, 0.99, 1.0, 1.02, 1.05),
        free_frequency_khz=90.0,
    )


@pytest.fixture(scope="module")
def of_law(drives) -> Design:
    return design(law_prior(), drives, points=5, noise=NOISE)


def looked_at(drives: Drives, *, prior: Prior | None = None, noise: float = NOISE, **what: Any) -> Candidates:
    """Return drives as candidates of a prior, read as is said."""
    prior, largest = prior or law_prior(), what.pop("largest_nm", np.inf)
    return candidates_of(prior, drives, explained(prior, drives, noise=noise, **what), largest)


POINT = np.array([LAW["r"], LAW["epsilon"], QUALITY_FACTOR[0]])


def other_amplitudes(drives: Drives, point: np.ndarray = POINT) -> np.ndarray:
    """Return the amplitudes of `single_impact_orbits`, the search that the fit does not use, at r, epsilon and Q."""
    r, epsilon, quality_factor = point.tolist()
    return steady_readings(drives, ImpactLaw(r, epsilon), quality_factor)[:, :2]


def errors_of(forecasts: Mapping[str, Mapping[str, Any]]) -> np.ndarray:
    """Return the standard errors; NaN where there is none."""
    return np.array([forecast["standard_error"] for forecast in forecasts.values()], dtype=float)


def test_readings_and_information_are_those_of_other_orbits(of_law, drives):
    found = of_law.candidates
    usable = np.flatnonzero(found.usable)
    assert usable.size > 20
    exact = other_amplitudes(drives)
    np.testing.assert_allclose(found.readings[usable, :2], exact[usable], rtol=1e-9)
    slopes = []
    for step in np.diag(1e-5 * POINT):
        up, down = (other_amplitudes(drives, POINT + sign * step) for sign in (1.0, -1.0))
        slopes.append((up - down) / (2.0 * step.sum()))
    wanted = np.stack(slopes, axis=-1)[usable] / (NOISE * exact[usable])[:, :, None]
    # central differences with steps of 1e-5: errors of 1e-10 of the third derivative, rounding 1e-9
    largest = np.abs(wanted).max(axis=(0, 1))
    np.testing.assert_allclose(found.slope[usable, :2] / largest, wanted / largest, rtol=1e-5, atol=1e-6)


def test_drives_are_left_out_for_a_reason(drives, of_law):
    # an orbit that other orbits' search does not find, or too large a one, is not planned with
    exact = other_amplitudes(drives)
    missing = [why == "no orbit" for why in of_law.candidates.why_not]
    assert missing == np.isnan(exact[:, 0]).tolist()
    limited = looked_at(drives, largest_nm=100.0)
    assert np.nanmax(exact[limited.usable, 0]) <= 100.0
    assert limited.left_out["too large"] > 0
    unsure = looked_at(drives, prior=law_prior(uncertainty=0.9))
    assert unsure.usable.sum() < of_law.candidates.usable.sum()


def test_a_fit_is_added_to(drives, of_law):
    exact = other_amplitudes(of_law.drives)
    result = fit(table_of(of_law.drives, exact, NOISE * exact, quality_factor_error=QUALITY_FACTOR[1]), "law")
    stated = as_json(result)["parameters"]
    assert [*stated] == [*of_law.expected]
    # without noise the fit ends at the believed law: its own minimum is good to 1e-5 standard errors
    np.testing.assert_allclose(errors_of(stated), errors_of(of_law.expected), rtol=1e-4)
    again = design(prior_of_fit(result), drives, points=3, noise=NOISE)
    # a covariance through its correlations and back
    np.testing.assert_allclose(again.errors[0], errors_of(stated), rtol=1e-6)
    assert again.candidates.left_out["measured"] == 5
    assert not {*again.chosen.tolist()} & {*of_law.chosen.tolist()}
    # as good as both measured at once
    together = of_law.prior.information + of_law.candidates.information[[*of_law.chosen, *again.chosen]].sum(axis=0)
    wanted = np.sqrt(np.diag(np.linalg.inv(together)))
    # the fit ends within 1e-5 standard errors of the believed law
    np.testing.assert_allclose(again.errors[-1], wanted, rtol=1e-3)
