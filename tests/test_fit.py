"""The fit as a whole: the bundled table, its goodness of fit and intervals, other models, scaled errors."""

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.stats import chi2

from afm_jax import ImpactLaw
from afm_jax.saved import as_json
from fitting import fit
from fitting.examples.make_amplitudes import TRUTH, example_table
from tests.fit_tables import (
    amplitudes_and_errors,
    chi2_residuals,
    holds,
    law,
    rows,
    simulated,
    table,
    values_of,
    with_amplitudes,
)

__all__ = ["law", "table"]


def test_the_bundled_table_is_what_its_script_makes(table):
    made = example_table()
    for name in ("order", "drive_frequency_khz", "drive_amplitude_nm", "offset_nm", "quality_factor", "remarks"):
        np.testing.assert_array_equal(getattr(made, name), getattr(table, name))
    for ours, stored in zip(amplitudes_and_errors(made), amplitudes_and_errors(table), strict=True):
        # five digits are written: another processor's rounding may turn a last one over, here and there
        last_digit = 10.0 ** (np.floor(np.log10(stored)) - 4.0)
        assert np.all(np.abs(ours - stored) < 1.5 * last_digit)
        assert np.mean(ours != stored) < 0.1


def test_the_truth_lies_in_the_intervals(law):
    assert law.valid
    assert not law.reasons
    for name, truth in TRUTH.items():
        assert holds(law.parameters[name], truth)


def test_goodness_of_fit_follows_from_the_residuals(law, table):
    amplitude, error = amplitudes_and_errors(table)
    np.testing.assert_array_equal(law.rows.measured_nm, amplitude)
    residual = (law.rows.predicted_nm - amplitude) / error
    np.testing.assert_allclose(law.rows.residual, residual, rtol=1e-12)
    # what is known of Q is known of its logarithm
    pull = np.log(law.parameters["quality_factor"].value / 40.0) / 0.01
    assert law.chi2 == pytest.approx(np.sum(residual**2) + pull**2, rel=1e-12)
    assert law.degrees_of_freedom == 2 * table.rows + 1 - 3
    assert law.p_value == pytest.approx(chi2.sf(law.chi2, law.degrees_of_freedom), rel=1e-9)
    assert law.aic == pytest.approx(law.chi2 + 6.0, rel=1e-12)


def test_profile_interval_ends_are_where_scipy_finds_chi2_risen_by_3_84(law, table):
    """Hold r at the end of its interval; SciPy minimises over the others."""
    for index, name in ((0, "r"), (1, "epsilon")):
        for end in law.parameters[name].interval95:

            def residual(others, index=index, end=end):
                return chi2_residuals(table, *np.insert(others, index, end))

            scale = np.delete([1e-3, 1.0, 1.0], index)
            scipy = least_squares(residual, np.delete(values_of(law), index), x_scale=scale, xtol=1e-10)
            # the search stops within a thousandth of the rise
            assert 2.0 * scipy.cost - law.chi2 == pytest.approx(3.8415, rel=5e-3)


@pytest.mark.slow
def test_full_law_is_found_from_its_amplitudes(table):
    truth = ImpactLaw(0.97, 60.0, 2.0)
    found = fit(simulated(table, truth, seed=None), "full")
    for name in ("r", "epsilon", "viscous_loss"):
        parameter = found.parameters[name]
        assert parameter.value == pytest.approx(float(getattr(truth, name)), rel=1e-4), name
    assert found.chi2 < 1e-3


@pytest.mark.slow
def test_scaled_errors_bring_chi2_to_its_degrees_of_freedom(table):
    amplitude, error = amplitudes_and_errors(table)
    wide = with_amplitudes(table, amplitude, 3.0 * error)
    narrow, scaled = fit(table, scale_errors=True), fit(wide, scale_errors=True)
    # whatever the errors' scale was, the result is the same
    np.testing.assert_allclose(values_of(scaled), values_of(narrow), rtol=1e-6)
    assert scaled.settings["error_scale"] == pytest.approx(narrow.settings["error_scale"] / 3.0, rel=1e-4)
    pull = np.log(values_of(scaled)[2] / 40.0) / 0.01
    # three rounds; the constraint on Q, which is not scaled, moves the rest by less than this
    assert scaled.chi2 - pull**2 == pytest.approx(2 * table.rows - 2, rel=1e-5)
    assert np.isnan(scaled.p_value)
    assert any("errors were scaled by" in warning for warning in scaled.warnings)


def test_a_fit_is_reproducible(table, law):
    again = fit(table, model="law")
    assert as_json(again) == as_json(law)


def test_too_few_amplitudes_are_errors(table):
    peak_alone = rows(table, slice(0, 1), lockin_amplitude_nm=None, lockin_amplitude_error_nm=None)
    with pytest.raises(ValueError, match=r"1 measured amplitude cannot determine the 2 parameters"):
        fit(peak_alone, model="law")
    with pytest.raises(ValueError, match="scaling the errors needs more amplitudes than parameters"):
        fit(peak_alone, model="restitution", scale_errors=True)
