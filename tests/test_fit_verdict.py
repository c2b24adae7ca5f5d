"""What a fit's verdict says beside the numbers: rows that contradict it, bounds that mean nothing, what to try next."""

import dataclasses

import numpy as np
import pytest

from fitting.table import AmplitudeTable
from fitting.verdict import Evidence, judge_fit
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
