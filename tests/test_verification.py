"""The verification itself: it passes, and it fails when a formula is wrong."""

import inspect
import json

import jax.numpy as jnp
import numpy as np
import pytest
from click.testing import CliRunner

from afm_jax.cli.main import main
from afm_jax.impact import jacobian as formulas
from afm_jax.studies.verify import Verification, checks_of, verify


@pytest.fixture(scope="module")
def verification() -> Verification:
    return verify(states=10_000, seed=1)


def test_every_equation_is_compared_at_ten_thousand_states_and_passes(verification: Verification):
    assert verification.reason is None
    checks = {check.equation: check for check in verification.checks}
    assert set(checks) == {"eq. 5", "eq. 6", "eq. 7", "eqs. 5+7", "eq. 8, D", "eq. 8, T"}
    for check in checks.values():
        assert check.passed
        assert check.points >= 10_000
        assert check.max_relative_difference <= 1e-10


@pytest.mark.parametrize(
    ("name", "element", "factor", "fails"),
    [
        ("eq5", (1, 0), np.nan, {"eq. 5"}),
        pytest.param("eq7", (1, 1), -1.0, {"eq. 7"}, marks=pytest.mark.slow),
        pytest.param("flight_jacobian", (1, 1), -1.0, {"eqs. 5+7"}, marks=pytest.mark.slow),
        pytest.param("impact_jacobian", (1, 1), -1.0, {"eqs. 5+7"}, marks=pytest.mark.slow),
    ],
)
def test_a_wrong_element_is_found(monkeypatch, name, element, factor, fails):
    right = getattr(formulas, name)
    factors = jnp.ones((2, 2)).at[element].set(factor)
    monkeypatch.setattr(formulas, name, lambda *args: factors * right(*args))
    # not the program that was compiled with the right formula, and a fresh one afterwards
    monkeypatch.setattr(formulas, "_map_jacobian", inspect.unwrap(formulas._map_jacobian))
    assert {check.equation for check in checks_of(50, 2) if not check.passed} == fails


def test_a_wrong_trace_is_found(monkeypatch):
    right = formulas.eq8
    monkeypatch.setattr(formulas, "eq8", lambda *args: (right(*args)[0], 2.0 - right(*args)[1]))
    assert {check.equation for check in checks_of(50, 2) if not check.passed} == {"eq. 8, T"}


def test_command_writes_json_and_fails_on_a_wrong_formula(monkeypatch, tmp_path):
    right = formulas.eq7
    monkeypatch.setattr(formulas, "eq7", lambda *args: right(*args).T)
    options = ["--json", "--states", "20", "--out", str(tmp_path)]
    result = CliRunner().invoke(main, ["verify", *options])
    assert result.exit_code == 3
    payload = json.loads(result.stdout)
    assert [row["equation"] for row in payload["checks"] if not row["passed"]] == ["eq. 7"]
    assert {"equation", "points", "max_relative_difference"} <= set(payload["checks"][0])
    assert (tmp_path / "verify.csv").exists()
