"""What a fit's verdict says beside the numbers: rows that contradict it, bounds that mean nothing, what to try next."""

import dataclasses
import re
from typing import Any

import numpy as np
import pytest

from fitting import fit, read_table
from fitting.examples.make_contact_amplitudes import EXAMPLE as CONTACT_TABLE
from fitting.infer.intervals import UNSETTLED
from fitting.infer.result import Convergence
from fitting.infer.verdict import Evidence, correlation_excess, judge_fit
from tests.made_fits import made_fit, made_parameter, made_table


def evidence(model: str = "law", rows: int = 4, *, residual: np.ndarray | None = None, **changes: Any) -> Evidence:
    """Return what a verdict on a made fit looks at, with other residuals and fields."""
    fit = made_fit(model, table=made_table(rows, **changes.pop("table", {})))
    if residual is not None:
        fit = dataclasses.replace(fit, rows=dataclasses.replace(fit.rows, residual=residual))
    same = ("table", "parameters", "convergence", "rows", "chi2", "p_value")
    known = Evidence(
        **{name: getattr(fit, name) for name in same},
        freedom=fit.degrees_of_freedom,
        correlations=np.eye(len(fit.parameters)),
    )
    return dataclasses.replace(known, **changes)


def reasons_of(model: str = "law", rows: int = 4, **changes: Any) -> list[str]:
    return judge_fit(evidence(model, rows, **changes))[0]


def assert_said(given: Evidence, words: str, where: str) -> None:
    """Demand words among the reasons, among the warnings, or nowhere."""
    reasons, warnings = judge_fit(given)
    assert any(words in text for text in reasons) is (where == "reasons")
    assert any(words in text for text in warnings) is (where == "warnings")


OTHER = "Another minimum explains the data about as well (chi2 7.2, here 5.0): r = 0.9, epsilon = 12; the band"
ADRIFT = Convergence(False, "optax.lbfgs 0.2", 20, 1e-6, 0.3, "chi2 lies an estimated 0.3 above its minimum")  # noqa: FBT003
RUN = "residuals run together over the approach speed (5.0"


@pytest.mark.parametrize(
    ("model", "changes", "words", "where"),
    [
        ("law+delay", {"untabulated": (0, 2)}, "impacts misses its accuracy for lines 1, 3:", "reasons"),
        ("law", {"convergence": ADRIFT}, "Not converged: chi2 lies an estimated 0.3 above", "reasons"),
        ("law", {"table": {"quality_factor_error": None}}, "is assumed to be exact", "warnings"),
        # a bound is only worth a word where the model explains the data
        ("viscous", {"p_value": 0.5}, "at its bound", "warnings"),
        ("viscous", {"p_value": 1e-9}, "at its bound", "nowhere"),
        ("law+delay", {"p_value": 1e-9}, "errors may be too small", "reasons"),
        ("law", {"other_minimum": ({"r": 0.9, "epsilon": 12.0}, 7.25)}, OTHER, "warnings"),
        ("law+delay", {"run": (5.0, 2.0), "short": 0.7}, "a model discrepancy of 70 % of the loss", "warnings"),
        ("law+delay", {"run": (5.0, 2.0), "short": 0.7}, RUN, "nowhere"),
        ("law+delay", {"run": (5.0, 4.0), "short": 0.7}, RUN, "reasons"),
        # as of a lever that is wrongly stated as undamped: a law can take up the air's loss, but not smoothly
        ("law+delay", {"run": (13.0, 2.0), "short": 1.0}, "(13.0 standard deviations; 2.0 beside", "reasons"),
        ("law", {"table": {"lockin_amplitude_nm": np.full(4, 0.02)}}, "micrometres for nanometres", "warnings"),
    ],
)
def test_a_finding_is_a_reason_or_a_warning_or_not_worth_a_word(model, changes, words, where):
    assert_said(evidence(model, **changes), words, where)


@pytest.mark.parametrize(
    ("value", "words", "where"),
    [
        (40.7, "standard errors from the given", "nowhere"),
        (41.0, "quality_factor = 41 is 2.5 standard errors from the given 40 +- 0.4", "warnings"),
        (41.3, "quality_factor = 41.3 is 3.2 standard errors from the given 40 +- 0.4", "reasons"),
    ],
)
def test_what_is_said_of_a_quality_factor_that_is_fitted_along(value, words, where):
    along = {"quality_factor": made_parameter("quality_factor", value, constraint=(40.0, 0.4))}
    assert_said(evidence(parameters=made_fit("law").parameters | along, correlations=np.eye(3)), words, where)


@pytest.mark.parametrize(
    ("interval", "why", "where"),
    [
        ((0.9, None), "upper end: reaches the end of its range, 1", "nowhere"),
        ((0.9, None), f"upper end: {UNSETTLED}", "reasons"),
        ((None, 1.0), f"lower end: {UNSETTLED}: chi2 is not finite on this side", "reasons"),
    ],
)
def test_an_interval_whose_search_did_not_settle_makes_a_fit_invalid(interval, why, where):
    parameter = made_parameter("r", 0.95, interval95=interval, interval_reason=why)
    given = evidence(parameters=made_fit("law").parameters | {"r": parameter})
    assert_said(given, f"r is not identified: {why}", where)


def test_a_row_without_an_orbit_where_the_model_has_one_is_named():
    unseen = np.array([0.0, 0.0, 1.0, 0.0])
    amplitude = np.where(unseen > 0.0, np.nan, 50.0)
    columns = [f"{kind}_amplitude{error}_nm" for kind in ("peak", "lockin") for error in ("", "_error")]
    given = evidence(table={"no_orbit": unseen} | dict.fromkeys(columns, amplitude))
    for orbits, named in ((1, True), (0, False)):
        rows = dataclasses.replace(given.rows, orbits=np.full(4, orbits))
        _, warnings = judge_fit(dataclasses.replace(given, rows=rows))
        said = "No orbit was seen, though the fitted model has a steady one, for line 3:"
        assert any(warning.startswith(said) for warning in warnings) is named


@pytest.mark.slow
def test_no_option_makes_a_law_without_delay_a_measurement_of_a_contact():
    """The contact's r is 0.998; the best instantaneous law has 0.76 and most rows far off."""
    result = fit(read_table(CONTACT_TABLE), model="law", robust=True, scale_errors=True)
    assert not result.valid
    (reason,) = [text for text in result.reasons if text.startswith("The model does not explain the data: ")]
    # which of many bad minima is the best depends on roundings: 54, or 101
    assert re.search(r"errors would have to be (\d\d[\d.]*) times", reason)
    assert all(parameter.standard_error is None for parameter in result.parameters.values())
    assert all(parameter.interval95 == (None, None) for parameter in result.parameters.values())
    assert np.isnan(result.law.rebound_high_nm_per_us).all()


def test_correlated_residuals_invalidate_though_chi2_is_as_it_should_be():
    wave = np.sqrt(2.0) * np.sin(np.linspace(0.0, 12.0, 80))
    residual = np.stack([wave, wave], axis=1)
    (reason,) = reasons_of(rows=80, residual=residual)
    assert "neighbouring residuals in the table's order are correlated" in reason
    # the same far within the errors is of no consequence
    assert not reasons_of(rows=80, residual=0.1 * residual)
    assert not reasons_of(rows=80, residual=np.random.default_rng(3).permutation(residual))


def test_independent_residuals_are_seldom_called_correlated():
    """Unit variance, whether the two amplitudes of a row go together, some are missing, or there are outliers."""
    generator = np.random.default_rng(5)
    excess = []
    for i in range(500):
        row = generator.normal(size=(40, 1)) if i % 2 else 0.0
        residual = row + generator.normal(size=(40, 2))
        residual[generator.random((40, 2)) < 0.1] = np.nan
        residual[generator.integers(40)] = 300.0
        excess.append(correlation_excess(residual))
    # mean and variance of 500 numbers of a standard distribution, to four of their own errors
    assert abs(np.mean(excess)) < 4.0 / np.sqrt(500)
    assert np.var(excess) == pytest.approx(1.0, abs=4.0 * np.sqrt(2.0 / 500))


def test_rows_that_are_off_to_one_side_invalidate_though_chi2_is_as_it_should_be():
    random = np.random.default_rng(4)
    # what a model's own error in the weights leaves of independent noise
    calm = 0.87 * random.normal(size=(60, 2))
    off = calm.copy()
    off[::10] -= 3.0
    assert not reasons_of(rows=60, residual=calm)
    (reason,) = reasons_of(rows=60, residual=off)
    assert "off to one side" in reason
    assert "predicted below what was read for lines 1, 11" in reason
    # a robust fit is for that
    assert not any("to one side" in text for text in reasons_of(rows=60, residual=off, robust=True))
    honest = [reasons_of(rows=60, residual=random.normal(size=(60, 2))) for _ in range(20)]
    # one in three thousand
    assert sum("to one side" in text for reasons in honest for text in reasons) <= 1
