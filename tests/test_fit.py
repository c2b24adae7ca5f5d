"""The fit as a whole: the bundled table, SciPy on the same residuals, bounds, identification, the contact table."""

import dataclasses
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import least_squares

import fitting.examples
from fitting import fit, read_table
from fitting.checks import check_minimum, covariance
from fitting.examples.make_amplitudes import TRUTH, example_table
from fitting.forward import linearise, measurement_of
from fitting.law_fit import problem_of
from fitting.optimise import Objective
from fitting.result import FitResult
from fitting.table import AmplitudeTable

EXAMPLE = Path(fitting.examples.__path__[0]) / "amplitudes_law.csv"


@pytest.fixture(scope="module")
def table() -> AmplitudeTable:
    return read_table(EXAMPLE)


@pytest.fixture(scope="module")
def law(table) -> FitResult:
    return fit(table, model="law")


@pytest.fixture(scope="module")
def objective(table) -> Objective:
    return Objective(measurement_of(table), problem_of(table, "law"))


def rows(table: AmplitudeTable, keep: slice | np.ndarray, **changes) -> AmplitudeTable:
    """Return some rows of a table, with changed values."""
    columns = {
        field.name: getattr(table, field.name)[keep]
        for field in dataclasses.fields(table)
        if isinstance(getattr(table, field.name), np.ndarray)
    }
    return dataclasses.replace(table, **(columns | changes))


def values_of(result: FitResult) -> np.ndarray:
    return np.array([parameter.value for parameter in result.parameters.values()])


def test_the_bundled_table_is_what_its_script_makes(table):
    made = example_table()
    assert made.rows == table.rows
    for name in ("order", "drive_frequency_khz", "drive_amplitude_nm", "offset_nm"):
        np.testing.assert_array_equal(getattr(made, name), getattr(table, name))
    for name in ("peak_amplitude_nm", "lockin_amplitude_nm", "peak_amplitude_error_nm"):
        # five digits are written: another processor's rounding may move the last one
        np.testing.assert_allclose(getattr(made, name), getattr(table, name), rtol=2e-5)


def test_the_truth_lies_in_the_intervals(law):
    assert law.valid
    assert not law.reasons
    for name, truth in TRUTH.items():
        low, high = law.parameters[name].interval95
        assert low < truth < high


def test_scipy_finds_the_same_minimum(law, objective):
    def residual(values):
        return np.asarray(objective.at_values(values[None]).residual)[0]

    scipy = least_squares(residual, [0.9, 40.0, 41.0], x_scale=[1e-3, 1.0, 1.0], xtol=1e-12, ftol=1e-12, gtol=1e-12)
    # SciPy differentiates numerically; a hundredth of a standard error is far more than that costs
    errors = np.array([parameter.standard_error for parameter in law.parameters.values()])
    assert np.all(np.abs(scipy.x - values_of(law)) < 1e-2 * errors)
    assert law.chi2 == pytest.approx(2.0 * scipy.cost, rel=1e-6)
    fisher = np.linalg.inv(scipy.jac.T @ scipy.jac)
    np.testing.assert_allclose(np.sqrt(np.diag(fisher)), errors, rtol=1e-3)  # numerical Jacobian
    scale = np.sqrt(np.outer(np.diag(fisher), np.diag(fisher)))
    np.testing.assert_allclose(law.correlations, fisher / scale, atol=2e-3)


def test_goodness_of_fit_follows_from_the_residuals(law, table):
    from scipy.stats import chi2  # noqa: PLC0415

    residual = (law.rows.predicted_nm - law.rows.measured_nm) / np.stack(
        [table.peak_amplitude_error_nm, table.lockin_amplitude_error_nm], axis=1
    )
    np.testing.assert_allclose(law.rows.residual, residual, rtol=1e-12)
    pull = (law.parameters["quality_factor"].value - 40.0) / 0.4
    assert law.chi2 == pytest.approx(np.sum(residual**2) + pull**2, rel=1e-12)
    assert law.degrees_of_freedom == 2 * table.rows + 1 - 3
    assert law.p_value == pytest.approx(chi2.sf(law.chi2, law.degrees_of_freedom), rel=1e-9)
    assert law.aic == pytest.approx(law.chi2 + 6.0, rel=1e-12)
    assert law.bic == pytest.approx(law.chi2 + 3.0 * np.log(2 * table.rows + 1), rel=1e-12)


def test_profile_interval_ends_are_where_scipy_finds_chi2_risen_by_3_84(law, objective):
    """Hold r at the end of its interval; SciPy minimises over the others."""
    for index, name in ((0, "r"), (1, "epsilon")):
        for end in law.parameters[name].interval95:

            def residual(others, index=index, end=end):
                return np.asarray(objective.at_values(np.insert(others, index, end)[None]).residual)[0]

            scale = np.delete([1e-3, 1.0, 1.0], index)
            scipy = least_squares(residual, np.delete(values_of(law), index), x_scale=scale, xtol=1e-10)
            # the search stops within a thousandth of the rise
            assert 2.0 * scipy.cost - law.chi2 == pytest.approx(3.8415, rel=5e-3)


def test_away_from_the_minimum_the_checks_say_so(law, objective):
    problem = objective.problem
    free = np.ones(3, dtype=bool)
    at_minimum = check_minimum(objective, problem.coordinates(values_of(law)), free)
    assert at_minimum.converged
    # close to a parabola: the Hessian of chi2/2 is the Fisher matrix, 1 in its own units
    np.testing.assert_allclose(at_minimum.hessian_eigenvalues, 1.0, atol=0.05)
    errors = np.sqrt(np.diag(covariance(objective, values_of(law), free)))
    moved = values_of(law) + 0.1 * errors * [1, 0, 0]
    away = check_minimum(objective, problem.coordinates(moved), free)
    assert not away.converged
    # chi2 falls by this much on the way back; the estimate is exact for a parabola
    above = np.sum(np.asarray(objective.at_values(moved[None]).residual) ** 2) - law.chi2
    assert away.estimated_distance == pytest.approx(above, rel=0.02)


def test_other_models_are_refused_by_their_chi2(table):
    for model in ("restitution", "viscous"):
        result = fit(table, model=model)
        assert not result.valid
        assert result.p_value < 1e-10
        assert all(parameter.interval95 == (None, None) for parameter in result.parameters.values())
        assert all(parameter.standard_error is None for parameter in result.parameters.values())


def test_an_uncertain_quality_factor_widens_the_interval_of_r(table, law):
    exact = fit(dataclasses.replace(table, quality_factor_error=None), model="law")
    vague = fit(dataclasses.replace(table, quality_factor_error=2.0), model="law")
    errors = [result.parameters["r"].standard_error or 0.0 for result in (exact, law, vague)]
    assert 0.0 < errors[0] < 0.6 * errors[1] < 0.5 * errors[2]
    assert any("taken as exact" in warning for warning in exact.warnings)


def test_without_adhesion_epsilon_is_an_upper_limit(table):
    """The same drives with epsilon = 0: the fit ends at the bound, or so close that the interval is open there."""
    measurement = measurement_of(table)
    problem = problem_of(table, "law")
    truth = linearise(jnp.array([[0.95, 0.0, 40.0]]), measurement, problem).prediction.amplitude_nm[0]
    clean = np.asarray(truth)[: table.rows]
    bare = rows(
        table,
        slice(None),
        peak_amplitude_nm=clean[:, 0],
        lockin_amplitude_nm=clean[:, 1],
        peak_amplitude_error_nm=0.01 * clean[:, 0],
        lockin_amplitude_error_nm=0.01 * clean[:, 1],
    )
    result = fit(bare, model="law")
    epsilon = result.parameters["epsilon"]
    assert epsilon.at_bound
    low, high = epsilon.interval95
    assert low is None
    assert high is not None
    assert high > 0.0
    assert result.parameters["r"].value == pytest.approx(0.95, abs=1e-6)


def test_one_row_does_not_determine_two_parameters(table):
    result = fit(rows(table, slice(0, 1)), model="law")
    assert not result.valid
    assert any("Not identified" in reason for reason in result.reasons)
    assert result.parameters["r"].interval95 == (None, None)


def test_scaled_errors_bring_chi2_to_its_degrees_of_freedom(table):
    wide = rows(
        table,
        slice(None),
        peak_amplitude_error_nm=3.0 * table.peak_amplitude_error_nm,
        lockin_amplitude_error_nm=3.0 * table.lockin_amplitude_error_nm,
    )
    narrow, scaled = fit(table, scale_errors=True), fit(wide, scale_errors=True)
    # whatever the errors' scale was, the result is the same
    np.testing.assert_allclose(values_of(scaled), values_of(narrow), rtol=1e-6)
    assert scaled.settings["error_scale"] == pytest.approx(narrow.settings["error_scale"] / 3.0, rel=1e-4)
    assert np.isnan(scaled.p_value)


def test_a_fit_is_reproducible(table, law):
    again = fit(table, model="law")
    assert again.to_dict() == law.to_dict()


def test_the_law_without_delay_does_not_explain_contact_data(contact_table_path):
    result = fit(read_table(contact_table_path), model="law")
    assert not result.valid
    assert result.chi2 / result.degrees_of_freedom > 100.0
    assert result.p_value < 1e-100
    assert result.parameters["r"].interval95 == (None, None)
    assert "does not explain" in result.reasons[0]


def test_unknown_models_and_empty_measurements_are_errors(table):
    with pytest.raises(ValueError, match="must be one of restitution, law, viscous, but is 'jkr'"):
        fit(table, model="jkr")
