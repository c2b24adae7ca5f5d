"""`afm-jax design`: what it prints, writes and returns."""

import pytest
from click.testing import CliRunner

from afm_jax.cli.main import main
from tests.answers import answer as answer_of
from tests.strict_reading import strictly

pytestmark = pytest.mark.slow
"""Each compiles programs of its own for a minute or more."""

FEW = ("--orders", "1,2", "--detuning", "0.98:1.02:0.01", "--drive-nm", "2,5", "--offsets-nm", "-1,1")
CANTILEVER = ("--free-frequency-khz", 90, "--quality-factor", "40 +- 0.4")


def run(*arguments: object):
    return CliRunner().invoke(main, ["design", *(str(argument) for argument in arguments)])


@pytest.fixture(scope="module")
def reported(tmp_path_factory):
    folder = tmp_path_factory.mktemp("design")
    return answer_of(folder, "design", *CANTILEVER, *FEW, "--r", 0.99, "--points", 6), folder


def test_json_holds_points_and_what_they_promise(reported):
    answer, _ = reported
    assert (answer["valid"], answer["model"], answer["interest"]) == (True, "law+delay", ["r", "epsilon"])
    assert len(answer["points"]) == 6
    assert answer["candidates"] + sum(answer["left_out"].values()) == 2 * 5 * 2 * 2
    for name in answer["interest"]:
        assert answer["points"][-1]["standard_errors"][name] == answer["expected"][name]["standard_error"]
    assert any("epsilon" in warning and "taken from the paper" in warning for warning in answer["warnings"])


def test_nothing_to_measure_is_not_valid():
    found = run(*CANTILEVER, "--orders", 1, "--detuning", 1, "--drive-nm", 0.001, "--offsets-nm", 0, "--json")
    assert found.exit_code == 3
    nothing = {"valid": False, "points": [], "candidates": 0, "left_out": {"no orbit": 1}}
    assert nothing.items() <= strictly(found.stdout).items()
    assert "not valid: No drive can be planned with" in found.stderr
