"""The HTML report: valid, self-contained, honest on its first screen, complete below."""

import base64
import dataclasses
from typing import Any

import equinox as eqx
import numpy as np
import pytest

from afm_jax import report
from fitting.infer.comparison import Comparison
from fitting.infer.result import FitResult
from fitting.report.plots import law_figure, rows_figure, speed_figure
from fitting.report.words import band_width, interval_in_words
from fitting.sampling.posterior_result import PosteriorChains, posterior_of_chains
from tests.html_pages import first_screen, read_page, section_of, table_of, words_of
from tests.made_fits import SPEEDS, VALUES, made_fit, made_parameter, made_table

EMPTY = base64.b64encode(b'<svg xmlns="http://www.w3.org/2000/svg"/>').decode()


def page_of(fit: FitResult, *extras: Any) -> str:
    """Return the page of a fit without its pictures' points, which take seconds to draw."""
    return report.page_of(fit, *extras, drawn=dict.fromkeys(report.pictures_of(fit), EMPTY))


def not_valid(model: str) -> FitResult:
    """Return a fit that explains nothing: no errors, no band."""
    unknown = {"standard_error": None, "interval95": (None, None), "interval_reason": "the model does not explain"}
    return made_fit(
        model,
        width=np.nan,
        valid=False,
        reasons=["The model does not explain the data: a < b."],
        p_value=0.0,
        chi2=9e4,
        parameters={name: made_parameter(name, value, **unknown) for name, value in VALUES[model].items()},
        correlations=np.full(2 * (len(VALUES[model]),), np.nan),
    )


def with_odd_rows() -> FitResult:
    """Return a fit whose rows are each odd in another way."""
    peak = np.array([50.0, 90.0, 140.0, np.nan])
    amplitudes = {"peak_amplitude_nm": peak, "lockin_amplitude_nm": 0.4 * peak}
    errors = {f"{name[:-3]}_error_nm": 0.01 * column for name, column in amplitudes.items()}
    table = made_table(**amplitudes, **errors, no_orbit=np.array([0.0, 0.0, 0.0, 1.0]))
    fit = made_fit("law+delay", table=table)
    rows = dataclasses.replace(
        fit.rows,
        set_aside=np.array([True, False, False, False]),
        used=np.array([False, True, True, False]),
        residual=np.array([[np.nan, np.nan], [4.5, 0.1], [0.2, -0.3], [np.nan, np.nan]]),
        orbits=np.array([1, 2, 0, 1]),
        near_fold=np.array([False, True, False, False]),
        approach_speed_nm_per_us=np.array([9.0, 40.0, np.nan, 95.0]),
    )
    return dataclasses.replace(fit, rows=rows)


@pytest.mark.parametrize("model", VALUES)
@pytest.mark.parametrize("valid", [True, False])
def test_every_kind_of_fit_is_a_valid_page(model, valid):
    fit = made_fit(model) if valid else not_valid(model)
    page = read_page(page_of(fit))
    seen = first_screen(page)
    said = {"NOT VALID": not valid, "a < b": not valid, "not a measurement of the law": not valid}
    assert {words: words in seen for words in said} == said
    goodness = words_of(section_of(page, "goodness"))
    assert ("no band can be given" in goodness) is not valid
    if model == "law":
        assert "u_out² = r² u_in² - epsilon" in seen


def test_width_of_the_band_is_the_worst_over_the_measured_speeds():
    fit = made_fit("law")
    law = fit.law
    # a band that widens with speed: 1 % at the slowest row, 10 % at the fastest, more beyond
    share = np.interp(np.log(law.approach_speed_nm_per_us), np.log(SPEEDS[[0, -1]]), [0.01, 0.1])
    share[-5:] = 0.5
    high = law.rebound_speed_nm_per_us * (1.0 + share)
    law = eqx.tree_at(lambda law: law.rebound_high_nm_per_us, law, high)
    width = band_width(dataclasses.replace(fit, law=law))
    assert width is not None
    # the fastest row lies between two points of the law, over which the share rises by a hundredth of itself
    assert width == pytest.approx((SPEEDS[0], SPEEDS[-1], 0.1, SPEEDS[-1]), rel=1e-2)


def test_rows_that_were_not_used_do_not_count_as_measured_speeds():
    odd = with_odd_rows()
    width = band_width(odd)
    assert width is not None
    assert width[:2] == (40.0, 40.0)
    nothing = dataclasses.replace(odd, rows=dataclasses.replace(odd.rows, used=np.zeros(4, dtype=bool)))
    assert band_width(nothing) is None
    assert all(figure(nothing).axes for figure in (rows_figure, law_figure, speed_figure))
    assert "measured at no speed" in str(nothing)


def test_limits_read_plainly():
    for ends, reason, said in (
        ((None, 9.169), "lower end: reaches the end of its range, 0", "below 9.17  nm; 0 is not excluded"),
        ((2.0, None), "upper end: the search did not settle", "above 2.00  nm; upper end: the search did not"),
    ):
        parameter = made_parameter("r", 0.95, interval95=ends, interval_reason=reason)
        assert interval_in_words(parameter, "nm").startswith(said)


def test_a_fit_without_orbits_says_so_in_place_of_chi2():
    text = str(made_fit("law", chi2=np.inf, valid=False, reasons=["no orbits"]))
    assert "No orbits were found at the fitted law." in text
    assert "inf" not in text


def test_every_text_is_shown_as_it_is_and_does_nothing():
    hostile = '<script>alert("1")</script> & <img src=x onerror=y> \x0b\x7f'
    table = made_table(remarks=(hostile,), source="strange\udc80 <b>.csv")
    fit = made_fit("law", table=table, warnings=[hostile], settings={hostile: hostile}, versions={"a": hostile})
    root = read_page(page_of(fit))
    shown = '<script>alert("1")</script> & <img src=x onerror=y> \ufffd\ufffd'
    # the remark, the warning, the setting's name and value, the version
    assert words_of(root).count(shown) == 5
    assert "strange\ufffd <b>.csv" in first_screen(root)


def test_other_models_and_samples_are_shown():
    row = {"degrees_of_freedom": 6, "valid": True, "aic": 9.0, "delta_aic": 0.0}
    rows = [row | {"model": "law", "chi2": 5.0}, row | {"model": "viscous", "chi2": 7.25}]
    models = Comparison(rows, "The data do not tell r < 1 from viscous loss.", {})
    drawn = np.linspace(0.9, 0.99, 41)[:, None] * [1.0, 70.0]
    chains = PosteriorChains(drawn[None], np.array([1.31, np.nan]), np.array([50.0, 60.0]), 0, 77)
    found = posterior_of_chains(chains, ("r", "epsilon"), "nuts")
    root = read_page(page_of(made_fit("law"), models, found))
    assert models.verdict in words_of(section_of(root, "comparison"))
    assert [row[1] for row in table_of(root, "Models")] == ["chi2/dof", "5.0/6", "7.2/6"]
    sampled = section_of(root, "posterior")
    assert table_of(sampled, "By parameter")[1][2:] == ["0.90225", "0.98775"]
    assert "Not converged" in words_of(sampled)
    assert models.verdict in report.text_of(made_fit("law"), models, found)
