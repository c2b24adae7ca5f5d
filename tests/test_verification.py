"""The verification itself: it passes, it fails when a formula is wrong, and its 50 digits are right."""

import inspect
import json
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from click.testing import CliRunner

from afm_jax.cli.main import main
from afm_jax.impact import jacobian as formulas
from afm_jax.verify import checks as verification
from afm_jax.verify.checks import draw_orbits
from afm_jax.verify.fifty_digits import exact_impact
from afm_jax.verify.samples import DAMPED, DELAYED, EPSILON, PAPER, draw_sample
from tests.reference_examples import SCENES
from tests.reference_flight import mp
from tests.reference_map import iterate, map_jacobian


@pytest.fixture(scope="module")
def checks() -> list[verification.Check]:
    return verification.verify(states=10_000, seed=1, exact_states=60)


def test_every_equation_is_compared_at_ten_thousand_states_and_passes(checks):
    assert not [check for check in checks if check.passed is not True]
    automatic = {check.equation: check for check in checks if check.against == "autodiff"}
    for equation in ("eq. 5", "eq. 6", "eq. 7", "eqs. 5+7"):
        assert {equation, f"{equation}, damped", f"{equation}, damped, delayed"} <= set(automatic)
    assert {"eq. 8, D", "eq. 8, T", "eq. 8, D, damped"} <= set(automatic)
    for check in automatic.values():
        assert check.points >= 10_000
        assert check.max_relative_difference is not None
        assert check.max_relative_difference <= 1e-10


def test_the_fifty_digits_cover_ordinary_and_close_states(checks):
    exact = [check for check in checks if check.against == "50 digits"]
    rows = {(check.equation, check.where) for check in exact}
    assert rows == {(name, where) for name in (*verification.EQUATIONS, "eq. 8, T") for where in ("ordinary", "close")}
    # The close states are such that rounding shows: without the error of the impact time they would not pass.
    worst = max(check.max_relative_difference or 0.0 for check in exact if check.where == "close")
    assert worst > 100.0 * verification.ROUNDING_LIMIT * EPSILON


@pytest.mark.parametrize(
    ("name", "element", "factor", "kind", "fails"),
    [
        ("eq5", (1, 0), np.nan, PAPER, {"eq. 5"}),
        ("eq7", (1, 1), -1.0, PAPER, {"eq. 7"}),
        ("flight_jacobian", (1, 1), -1.0, DAMPED, {"eq. 5, damped", "eqs. 5+7, damped"}),
        ("impact_jacobian", (0, 1), -1.0, DELAYED, {"eq. 7, damped, delayed", "eqs. 5+7, damped, delayed"}),
    ],
)
def test_a_wrong_element_is_found(monkeypatch, name, element, factor, kind, fails):
    right = getattr(formulas, name)
    factors = jnp.ones((2, 2)).at[element].set(factor)
    monkeypatch.setattr(formulas, name, lambda *args: factors * right(*args))
    # Not the program that was compiled with the right formula, and a fresh one afterwards.
    monkeypatch.setattr(formulas, "_map_jacobian", jax.jit(inspect.unwrap(formulas._map_jacobian)))
    sample = draw_sample(np.random.default_rng(2), 50, kind)
    results = verification._automatic_checks(sample)
    assert {check.equation for check in results if not check.passed} == fails


def test_a_wrong_trace_is_found(monkeypatch):
    right = formulas.eq8
    monkeypatch.setattr(formulas, "eq8", lambda *args: (right(*args)[0], 2.0 - right(*args)[1]))
    results = verification._orbit_checks(draw_orbits(np.random.default_rng(2), 50, PAPER))
    assert {check.equation for check in results if not check.passed} == {"eq. 8, T"}


def test_without_mpmath_the_rows_say_so(monkeypatch):
    monkeypatch.setitem(sys.modules, "mpmath", None)
    rows = verification._digits_checks([], "ordinary", 10)
    assert [row.passed for row in rows] == [None] * 4
    assert all("pip install 'afm-jax[verify]'" in (row.reason or "") for row in rows)


def test_command_writes_json_and_fails_on_a_wrong_formula(monkeypatch, tmp_path):
    right = formulas.eq7
    monkeypatch.setattr(formulas, "eq7", lambda *args: right(*args).T)
    options = ["--json", "--states", "20", "--exact-states", "5", "--out", str(tmp_path)]
    result = CliRunner().invoke(main, ["verify", *options])
    assert result.exit_code == 3
    payload = json.loads(result.stdout)
    assert next(row["equation"] for row in payload["checks"] if row["passed"] is False) == "eq. 7"
    assert (tmp_path / "verify.csv").exists()


@pytest.mark.parametrize("name", SCENES)
def test_fifty_digits_agree_with_those_of_the_reference(name: str):
    p = SCENES[name]
    first = iterate(p, 4.0, 60.0, 1)[0]
    exact = exact_impact(mp, vars(p), (4.0, 60.0), float(first.arrival_time_us))
    expected = map_jacobian(p, 4.0, 60.0, first.arrival_time_us)
    # Both are right to 50 digits and rounded to float64 here.
    np.testing.assert_allclose(exact["eqs. 5+7"], np.array(expected.tolist(), dtype=float), rtol=1e-14)
    np.testing.assert_allclose(exact["arrival"], float(first.arrival_time_us), rtol=1e-15)
