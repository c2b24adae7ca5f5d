"""What a fit's verdict says beside the numbers: rows that contradict it, bounds that mean nothing, what to try next."""

import dataclasses
import re

import numpy as np
import pytest

from fitting import fit, read_table
from fitting.examples.make_contact_amplitudes import EXAMPLE as CONTACT_TABLE
from fitting.fits.verdict import Evidence, correlation_excess, judge_fit
from fitting.tables.table import AmplitudeTable
from tests.fit_tables import example_amplitudes
from tests.made_fits import made_fit, made_parameter, made_table


def evidence(model: str, table: AmplitudeTable, **changes) -> Evidence:
    fit = made_fit(model, table=table)
    known = Evidence(
        table=table,
        parameters=fit.parameters,
        convergence=fit.convergence,
        rows=fit.rows,
        chi2=fit.chi2,
        freedom=fit.degrees_of_freedom,
        p_value=fit.p_value,
        autocorrelation=0.0,
        other_minimum=None,
        error_scale=None,
        lasting="+" in model,
        robust=False,
        correlations=np.eye(len(fit.parameters)),
    )
    return dataclasses.replace(known, **changes)


def test_a_contact_whose_table_is_not_reached_is_refused():
    given = evidence("law+delay", made_table())
    assert not any("table" in reason for reason in judge_fit(given)[0])
    reasons, _ = judge_fit(dataclasses.replace(given, untabulated=(0, 2)))
    lines = f"lines {given.table.lines[0]}, {given.table.lines[2]}"
    assert any(
        reason.startswith(f"The table of the fitted contact's impacts misses its accuracy for {lines}:")
        for reason in reasons
    )


def test_a_discrepancy_that_lowers_chi2_to_first_order_alone_is_no_result():
    given = evidence("law+delay", made_table())
    assert not any("Not converged" in reason for reason in judge_fit(given)[0])
    reasons, _ = judge_fit(dataclasses.replace(given, stuck=(150.2, 120.1)))
    assert any("would lower chi2 from 150.2 to 120.1, but computed" in reason for reason in reasons)


def test_correlations_are_those_of_what_rows_do_not_have_in_common():
    given = evidence("law+delay", made_table(40))
    rows = len(given.rows.used)
    common = np.ones((rows, 2)) * 3.0
    given = dataclasses.replace(given, rows=dataclasses.replace(given.rows, residual=common))
    noise = np.random.default_rng(2).normal(size=(rows, 2))
    assert correlation_excess(common) > 4.0 > abs(correlation_excess(noise))
    for independent, correlated in ((None, True), (noise, False)):
        reasons, _ = judge_fit(dataclasses.replace(given, independent_residual=independent))
        assert any("neighbouring residuals" in reason for reason in reasons) is correlated


def test_a_row_without_an_orbit_where_the_model_has_one_is_named():
    table = made_table()
    unseen = np.zeros(table.rows)
    unseen[2] = 1.0
    blank = {
        name: np.where(unseen > 0, np.nan, getattr(table, name))
        for name in ("peak_amplitude_nm", "peak_amplitude_error_nm", "lockin_amplitude_nm", "lockin_amplitude_error_nm")
        if getattr(table, name) is not None
    }
    table = dataclasses.replace(table, no_orbit=unseen, **blank)
    given = evidence("law", table)
    for orbits, named in ((1, True), (0, False)):
        rows = dataclasses.replace(given.rows, orbits=np.full(table.rows, orbits))
        _, warnings = judge_fit(dataclasses.replace(given, rows=rows))
        said = f"No orbit was seen, though the fitted model has a steady one, for line {table.lines[2]}:"
        assert any(warning.startswith(said) for warning in warnings) is named


@pytest.mark.parametrize(("p_value", "said"), [(0.5, True), (1e-9, False)])
def test_a_bound_is_only_worth_a_word_where_the_model_explains_the_data(p_value, said):
    given = evidence("viscous", made_table(), p_value=p_value)
    assert given.parameters["epsilon"].at_bound
    _, warnings = judge_fit(given)
    assert any("at its bound" in warning for warning in warnings) is said


@pytest.mark.parametrize(("tapped", "open_ones", "refused"), [(True, 1, False), (True, 2, True), (False, 1, True)])
def test_what_taps_do_not_determine_is_named_and_no_reason_to_refuse(tapped: bool, open_ones: int, refused: bool):  # noqa: FBT001
    given = evidence("law", made_table())
    names = ("modulus_gpa", "relative_humidity")
    known = {name: made_parameter(name, 1.0) for name in names}
    for name in names[:open_ones]:
        known[name] = dataclasses.replace(known[name], interval95=(None, None), undetermined=True)
    reasons, warnings = judge_fit(dataclasses.replace(given, parameters=known, correlations=np.eye(2), tapped=tapped))
    assert any("modulus_gpa" in reason for reason in reasons) is refused
    assert any(said.startswith("Not determined by these taps: modulus_gpa,") for said in warnings) is not refused


@pytest.mark.parametrize(
    ("model", "said"),
    [
        ("law", "try the model with +delay"),
        ("law+delay", "The loss may depend on the speed otherwise (try viscous+delay), the errors"),
    ],
)
def test_what_does_not_explain_the_data_says_what_to_try_and_which_rows_are_far(model, said):
    given = evidence(model, made_table(), p_value=0.0, chi2=9e4)
    residual = np.full_like(given.rows.residual, 0.5)
    residual[1, 0] = -40.0
    (reason,) = [
        text
        for text in judge_fit(dataclasses.replace(given, rows=dataclasses.replace(given.rows, residual=residual)))[0]
        if "does not explain" in text
    ]
    assert said in reason
    assert f"farthest off: line {given.table.lines[1]} (if only a few are wrong: --robust)." in reason


def test_a_quality_factor_that_is_fitted_along_is_not_called_exact():
    table = dataclasses.replace(made_table(), quality_factor=40.0, quality_factor_error=None)
    exact = evidence("law", table)
    along = exact.parameters | {"quality_factor": made_parameter("quality_factor", 40.2)}
    for parameters, said in ((exact.parameters, True), (along, False)):
        given = dataclasses.replace(exact, parameters=parameters, correlations=np.eye(len(parameters)))
        assert any("is taken as exact" in warning for warning in judge_fit(given)[1]) is said


@pytest.mark.parametrize(
    ("value", "named", "refused"), [(40.7, False, False), (41.0, True, False), (41.3, False, True)]
)
def test_a_quality_factor_that_is_pulled_is_named_and_then_not_believed(value, named, refused):
    given = evidence("law", made_table())
    along = given.parameters | {"quality_factor": made_parameter("quality_factor", value, constraint=(40.0, 0.4))}
    reasons, warnings = judge_fit(dataclasses.replace(given, parameters=along, correlations=np.eye(len(along))))
    said = f"quality_factor = {value:g} is {(value - 40.0) / 0.4:.1f} standard errors from the given 40 +- 0.4"
    assert any(warning.startswith(said) for warning in warnings) is named
    assert any(said in reason for reason in reasons) is refused


@pytest.mark.parametrize(
    ("share", "said"), [(0.1, "errors may be too small"), (0.4, "Impacts last up to 40 % of a drive")]
)
def test_an_impact_that_lasts_long_is_not_laid_to_the_errors(share, said):
    given = dataclasses.replace(evidence("law+delay", made_table()), p_value=1e-9, contact_share=share)
    (reason,) = [text for text in judge_fit(given)[0] if "does not explain" in text]
    assert said in reason


def test_an_error_of_the_quality_factor_that_was_assumed_is_said():
    table = dataclasses.replace(made_table(), quality_factor=40.0, quality_factor_error=None)
    given = evidence("law+delay", table)
    along = given.parameters | {"quality_factor": made_parameter("quality_factor", 40.2, constraint=(40.0, 2.0))}
    _, warnings = judge_fit(dataclasses.replace(given, parameters=along, correlations=np.eye(len(along))))
    assert any("given without an error: 5 % was assumed (40 +- 2)" in warning for warning in warnings)


def with_residuals(given: Evidence, residual: np.ndarray, **changes) -> Evidence:
    rows = dataclasses.replace(given.rows, residual=residual)
    return dataclasses.replace(given, rows=rows, **changes)


@pytest.mark.slow
def test_no_option_makes_a_law_without_delay_a_measurement_of_a_contact():
    """The contact's r is 0.998; the best instantaneous law has 0.76 and most rows far off."""
    result = fit(read_table(CONTACT_TABLE), model="law", robust=True, scale_errors=True)
    assert not result.valid
    (reason,) = [text for text in result.reasons if text.startswith("The model does not explain the data: ")]
    assert "try the model with +delay" in reason
    assert "--robust" not in " ".join(result.reasons + result.warnings)
    # which of many bad minima is the best depends on roundings: 54, or 101
    assert re.search(r"errors would have to be (\d\d[\d.]*) times", reason)
    assert all(parameter.standard_error is None for parameter in result.parameters.values())
    assert all(parameter.interval95 == (None, None) for parameter in result.parameters.values())
    assert np.isnan(result.law.rebound_high_nm_per_us).all()


@pytest.mark.parametrize(
    ("model", "options", "said"),
    [
        ("restitution", {"robust": True}, "14 of 82 rows are off by more than 4 errors"),
        ("restitution", {"scale_errors": True}, "residuals over the approach speed are correlated"),
        pytest.param(
            "viscous",
            {"scale_errors": True},
            "contradicts what is known beforehand, in standard errors: quality_factor",
            marks=pytest.mark.slow,
        ),
    ],
)
def test_a_law_that_the_amplitudes_are_not_made_by_stays_invalid_with_every_option(model, options, said):
    result = fit(example_amplitudes(), model=model, **options)
    assert not result.valid
    assert said in result.reasons[0]


def test_a_robust_fit_whose_other_rows_are_not_explained_is_not_valid():
    given = evidence("law", made_table(40), robust=True)
    residual = 2.0 * np.random.default_rng(6).choice([-1.0, 1.0], size=(40, 2))
    residual[3] = 40.0
    (reason,) = judge_fit(with_residuals(given, residual))[0]
    # 78 readings of two errors each
    assert "without outliers chi2/dof = 4.11 (probability" in reason


def test_correlated_residuals_invalidate_though_chi2_is_as_it_should_be():
    table = made_table(80)
    given = evidence("law", table)
    wave = np.sqrt(2.0) * np.sin(np.linspace(0.0, 12.0, table.rows))
    waved = with_residuals(given, np.stack([wave, wave], axis=1))
    (reason,) = judge_fit(waved)[0]
    assert "--robust" not in reason
    # the same far within the errors is of no consequence
    assert not judge_fit(with_residuals(given, 0.1 * np.stack([wave, wave], axis=1)))[0]
    scattered = np.random.default_rng(3).permutation(waved.rows.residual)
    assert not judge_fit(with_residuals(given, scattered))[0]


def test_independent_residuals_are_seldom_called_correlated():
    """Unit variance, whether the two amplitudes of a row go together, some are missing, or there are outliers."""
    generator = np.random.default_rng(5)
    excess = []
    for i in range(2000):
        row = generator.normal(size=(40, 1)) if i % 2 else 0.0
        residual = row + generator.normal(size=(40, 2))
        residual[generator.random((40, 2)) < 0.1] = np.nan
        residual[generator.integers(40)] = 300.0
        excess.append(correlation_excess(residual))
    # mean and variance of 2000 numbers of a standard distribution, to four of their own errors
    assert abs(np.mean(excess)) < 4.0 / np.sqrt(2000)
    assert np.var(excess) == pytest.approx(1.0, abs=4.0 * np.sqrt(2.0 / 2000))


@pytest.mark.parametrize(("share", "advised"), [(0.2, True), (0.8, False)])
def test_robust_loss_is_advised_only_where_the_rest_is_explained(share, advised):
    table = made_table(40)
    given = evidence("law", table, p_value=0.0, chi2=9e4)
    generator = np.random.default_rng(1)
    residual = np.where(generator.random((40, 1)) < share, 30.0, 0.5) * generator.choice([-1.0, 1.0], size=(40, 2))
    (reason,) = judge_fit(with_residuals(given, residual))[0]
    assert ("if only a few are wrong: --robust" in reason) is advised


def test_another_minimum_is_named_with_its_chi2():
    given = evidence("law", made_table(), other_minimum=({"r": 0.9, "epsilon": 12.0}, 7.25))
    said = "Another minimum explains the data about as well (chi2 7.2, here 5.0): r = 0.9, epsilon = 12; the band"
    assert any(warning.startswith(said) for warning in judge_fit(given)[1])


def test_rows_that_are_off_to_one_side_invalidate_though_chi2_is_as_it_should_be():
    table = made_table(60)
    given = evidence("law", table)
    random = np.random.default_rng(4)
    # what a model's own error in the weights leaves of independent noise
    calm = 0.87 * random.normal(size=(60, 2))
    off = calm.copy()
    off[::10] -= 3.0
    assert not judge_fit(with_residuals(given, calm))[0]
    (reason,) = judge_fit(with_residuals(given, off))[0]
    assert "off to one side" in reason
    assert f"predicted below what was read for lines {table.lines[0]}, {table.lines[10]}" in reason
    # a robust fit is for that
    assert not any("to one side" in text for text in judge_fit(with_residuals(given, off, robust=True))[0])
    honest = [judge_fit(with_residuals(given, random.normal(size=(60, 2))))[0] for _ in range(200)]
    # one in three thousand
    assert sum("to one side" in text for reasons in honest for text in reasons) <= 1


@pytest.mark.parametrize(("left", "refused"), [(2.0, False), (4.0, True)])
def test_residuals_that_run_together_over_the_speed_are_said_and_count(left, refused):
    given = dataclasses.replace(evidence("law+delay", made_table()), run=(5.0, left), short=0.7)
    reasons, warnings = judge_fit(given)
    assert any("residuals run together over the approach speed (5.0" in text for text in reasons) is refused
    assert any("a model discrepancy of 70 % of the loss" in text for text in warnings)


def test_a_search_that_ends_at_no_minimum_is_not_said_to_be_infinitely_far_from_one():
    given = evidence("law", made_table())
    adrift = dataclasses.replace(given.convergence, converged=False, estimated_distance=float("inf"))
    (reason,) = judge_fit(dataclasses.replace(given, convergence=adrift))[0]
    assert reason == "Not converged: chi2 bends downwards where the search ended, which is no minimum."


def test_an_interval_holds_that_of_another_minimum():
    one, other = made_parameter("r", 0.95), made_parameter("r", 0.97)
    both = one.containing(other)
    assert both.value == one.value
    assert both.interval95 == (one.interval95[0], other.interval95[1])
    assert both.standard_error is not None
    assert both.value + 1.96 * both.standard_error >= 0.97 + 1.95 * 0.0097
    assert one.containing(dataclasses.replace(other, interval95=(None, None))).interval95 == (None, None)
