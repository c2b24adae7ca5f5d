"""`afm-jax invert`: what it prints, writes and returns."""

from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from afm_jax.cli.main import main
from fitting import read_table, write_table
from fitting.examples.make_contact_amplitudes import EXAMPLE
from tests.answers import answer as answer_of
from tests.fit_tables import rows
from tests.strict_reading import strictly

pytestmark = pytest.mark.slow
"""Each compiles programs of its own for a minute or more."""

TABLE = read_table(EXAMPLE)


def run(*arguments: object):
    return CliRunner().invoke(main, ["invert", *(str(argument) for argument in arguments)])


@pytest.fixture(scope="module")
def reported(tmp_path_factory):
    folder = tmp_path_factory.mktemp("report")
    return answer_of(folder, "invert", EXAMPLE), folder


def test_json_holds_rows_and_lines_near_the_truth(reported):
    answer, _ = reported
    assert (answer["valid"], answer["preferred"]) == (True, "viscous")
    assert len(answer["rows"]) == 57
    # physics.md: free tips of 40, 60 and 100 nm/us leave with 38.2958, 58.7902 and 99.1735
    line, u = answer["lines"]["viscous"], np.array([40.0, 60.0, 100.0])
    found = np.sqrt(u**2 - line["epsilon"] - line["slope"] * u)
    # 0.1 % is what 1 % and 0.1 degree allow
    np.testing.assert_allclose(found, [38.2958, 58.7902, 99.1735], rtol=1e-3)
    assert abs(line["epsilon"] - 113.6) < 3.0 * line["epsilon_error"]


def test_two_rows_end_with_exit_code_3(tmp_path: Path):
    write_table(rows(TABLE, slice(0, 2)), tmp_path / "table.csv")
    result = run(tmp_path / "table.csv", "--json")
    assert result.exit_code == 3
    assert "2 rows do not determine a line" in result.stderr
    assert strictly(result.stdout)["lines"] == {}
    assert "NOT VALID" in run(tmp_path / "table.csv").stdout
