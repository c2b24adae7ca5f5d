"""Fits at the edges: closed forms, parameters at their bound, what amplitudes cannot tell, rows without an orbit."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import least_squares

from afm_jax.impact.law import ImpactLaw
from fitting import fit
from fitting.infer import fit as fitting_fit
from fitting.infer.instantaneous import Chi2
from fitting.infer.result import FitResult
from fitting.tables.table import AmplitudeTable
from tests.fit_tables import (
    amplitudes_and_errors,
    chi2_residuals,
    rows,
    simulated,
    standard_errors_of,
    table,
    table_of,
    values_of,
    with_amplitudes,
)

__all__ = ["table"]


def on_resonance(r: float) -> AmplitudeTable:
    """Return amplitudes without air damping or adhesion, 1 % errors: V' = W (1 + r)/(1 - r), half a free period.

    The tip is at rest height at the impact, so that W = omega sqrt(beta^2 - sigma^2); its half wave of height
    V'/Omega has the component 4/(3 pi) at the response frequency 2 Omega.
    """
    order = np.array([1, 1, 2, 2, 3, 3])
    beta, sigma = np.array([1.0, 3.0, 1.5, 4.0, 2.0, 5.0]), np.array([0.0, 1.0, -0.5, 2.0, 0.5, -1.0])
    platform_speed = 2e-3 * np.pi * 180.0 * order * np.sqrt(beta**2 - sigma**2)
    peak = platform_speed * (1.0 + r) / (1.0 - r) / (2e-3 * np.pi * 90.0)
    both = peak[:, None] * [1.0, 4.0 / (3.0 * np.pi)]
    return table_of((order, 180.0 * order, beta, sigma), both, 0.01 * both, quality_factor=None)


@pytest.mark.parametrize("r", [0.5, 0.99])
def test_restitution_on_resonance_is_that_of_the_closed_form(r):
    result = fit(on_resonance(r), model="restitution")
    assert result.valid
    assert result.parameters["r"].value == pytest.approx(r, rel=1e-10)
    # d ln(amplitude)/dr = 2/(1 - r^2), for twelve amplitudes with 1 %
    assert result.parameters["r"].standard_error == pytest.approx(0.01 * (1 - r**2) / 2 / np.sqrt(12), rel=1e-8)
    low, high = result.parameters["r"].interval95
    gain = (1 + r) / (1 - r)
    for end, side in ((low, -1), (high, 1)):
        # chi2 is 12 (g/g0 - 1)^2/0.01^2 for g = (1 + r)/(1 - r); the search stops within a thousandth of its rise
        edge = gain * (1 + side * 0.01 * 1.959964 / np.sqrt(12))
        assert end - r == pytest.approx((edge - 1) / (edge + 1) - r, rel=1e-3)


def test_without_adhesion_epsilon_is_an_upper_limit(table):
    bare = simulated(table, ImpactLaw(0.95, 0.0), seed=None)
    result = fit(bare, model="law")
    epsilon = result.parameters["epsilon"]
    assert result.valid
    assert epsilon.at_bound
    assert epsilon.standard_error is None
    low, high = epsilon.interval95
    assert low is None
    assert high is not None
    assert "reaches the end of its range, 0" in str(epsilon.interval_reason)
    assert any("epsilon is at its bound" in warning for warning in result.warnings)
    assert result.parameters["r"].value == pytest.approx(0.95, abs=1e-6)
    scipy = least_squares(lambda at: chi2_residuals(bare, at[0], high, at[1]), [0.95, 40.0], x_scale=[1e-2, 0.4])
    # the search stops within a thousandth
    assert 2.0 * scipy.cost - result.chi2 == pytest.approx(3.8415, rel=5e-3)


@pytest.fixture(scope="module")
def few(table) -> AmplitudeTable:
    return rows(table, slice(0, 30))


@pytest.fixture(scope="module")
def fit_of_few(few) -> FitResult:
    return fit(few, model="law")


def test_a_row_without_orbit_counts_its_whole_amplitude_and_is_named(few, fit_of_few):
    last = {name: getattr(few, name)[-1] for name in vars(few) if isinstance(getattr(few, name), np.ndarray)}
    # far too slow to leave the sample
    last |= {"drive_amplitude_nm": 0.1, "peak_amplitude_nm": 5.0, "peak_amplitude_error_nm": 2.0, "lines": 99}
    last |= {"lockin_amplitude_nm": np.nan, "lockin_amplitude_error_nm": np.nan}
    more = replace(few, **{name: np.append(getattr(few, name), value) for name, value in last.items()})
    without, result = fit_of_few, fit(more, model="law")
    assert without.valid
    assert not result.valid
    assert result.reasons == ["No stable orbit at the fitted law for line 99."]
    assert np.isnan(result.rows.predicted_nm[-1]).all()
    assert result.chi2 == pytest.approx(without.chi2 + (5.0 / 2.0) ** 2, rel=1e-9)
    assert result.degrees_of_freedom == without.degrees_of_freedom + 1
    # a penalty without slope moves nothing; both fits stop within 1e-5 errors of the minimum
    assert np.all(np.abs(values_of(result) - values_of(without)) < 1e-4 * standard_errors_of(without))


def test_blank_cells_weigh_as_much_as_infinite_errors(few):
    amplitude, error = amplitudes_and_errors(few)
    blank = np.zeros_like(amplitude, dtype=bool)
    blank[::3, 0], blank[1::3, 1] = True, True
    cells = with_amplitudes(few, np.where(blank, np.nan, amplitude), np.where(blank, np.nan, error))
    result = fit(cells, model="law")
    vague = fit(with_amplitudes(few, amplitude, np.where(blank, 1e9, error)), model="law")
    assert np.all(np.abs(values_of(result) - values_of(vague)) < 1e-4 * standard_errors_of(vague))
    np.testing.assert_allclose(standard_errors_of(result), standard_errors_of(vague), rtol=1e-6)
    assert result.degrees_of_freedom == vague.degrees_of_freedom - 20
    np.testing.assert_array_equal(np.isnan(result.rows.residual), blank)


@pytest.mark.slow
def test_band_and_intervals_hold_another_minimum_that_the_data_hardly_tell(table, monkeypatch: pytest.MonkeyPatch):
    found, alone = fitting_fit.fit_instantaneous, fit(table, "law")
    best = values_of(alone)
    other = best + np.array([-0.02, 10.0, 0.0])

    def as_if_chi2_said_next_to_nothing(*arguments, **named):
        explained, optax, _ = found(*arguments, **named)
        theta = np.array([1.0 - other[0] ** 2, other[1], explained.end.theta[2]])
        chi2 = Chi2(explained.model, explained.weights)
        return explained, optax, chi2.explained(chi2.descended(theta, np.ones(3, bool)))

    monkeypatch.setattr(fitting_fit, "fit_instantaneous", as_if_chi2_said_next_to_nothing)
    both = fit(table, "law")
    square = (other[0] * both.law.approach_speed_nm_per_us) ** 2 - other[1]
    theirs = np.sqrt(np.where(square > 0.0, square, np.nan))
    assert not np.any(theirs < both.law.rebound_low_nm_per_us)
    assert np.any(theirs < alone.law.rebound_low_nm_per_us)
    for i, name in enumerate(("r", "epsilon")):
        # what is no minimum has no end to one side
        low, high = both.parameters[name].interval95
        assert low is None or low < min(best[i], other[i])
        assert high is None or high > max(best[i], other[i])
        assert 1.96 * (both.parameters[name].standard_error or 0.0) > abs(other[i] - best[i])
    assert any("the band of the law and the intervals hold both" in warning for warning in both.warnings)
