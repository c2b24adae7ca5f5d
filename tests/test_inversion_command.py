"""`afm-jax invert`: what it prints, writes and returns."""

import json
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from matplotlib.image import imread

from afm_jax import TabulatedLaw, load_law, save_law
from afm_jax.cli.main import main
from afm_jax.units import TWO_SIDED_95
from fitting import read_table, write_table
from fitting.examples.make_contact_amplitudes import EXAMPLE
from tests.answers import answer as answer_of
from tests.answers import table as records
from tests.fit_tables import rows
from tests.html_pages import read_page, section_of, table_of, words_of
from tests.strict_reading import strictly

pytestmark = pytest.mark.slow
"""Each compiles programs of its own for a minute or more."""

TABLE = read_table(EXAMPLE)


def on_resonance(path: Path) -> Path:
    """Write the bundled rows on resonance without their phase."""
    keep = (TABLE.order == 1) & (TABLE.drive_frequency_khz == 180.0)
    write_table(rows(TABLE, keep, phase_deg=None, phase_error_deg=None), path)
    return path


def run(*arguments: object):
    return CliRunner().invoke(main, ["invert", *(str(argument) for argument in arguments)])


@pytest.fixture(scope="module")
def reported(tmp_path_factory):
    folder = tmp_path_factory.mktemp("report")
    return answer_of(folder, "invert", EXAMPLE), folder


def test_json_holds_rows_and_laws_near_the_truth(reported):
    answer, _ = reported
    assert answer["valid"] is True
    assert len(answer["rows"]) == 57
    # physics.md: free tips of 40, 60 and 100 nm/us leave with 38.2958, 58.7902 and 99.1735
    law = answer["law"]
    u, w = (np.array(law[name]) for name in ("approach_speed_nm_per_us", "rebound_speed_nm_per_us"))
    found = np.sqrt(np.array([40.0, 60.0, 100.0]) ** 2 - np.interp([40.0, 60.0, 100.0], u, u**2 - w**2))
    # 0.1 % is what 1 % and 0.1 degree allow
    np.testing.assert_allclose(found, [38.2958, 58.7902, 99.1735], rtol=1e-3)
    epsilon = law["viscous"]["parameters"]["epsilon"]
    assert abs(epsilon["value"] - 113.6) < 3.0 * epsilon["standard_error"]


def test_report_is_written(reported):
    answer, folder = reported
    told_rows = records(folder / "invert.csv")
    assert len(told_rows) == 57
    slow = [row["note"] for row in told_rows if row["regressed"] == "false"]
    assert slow
    assert all("slower than 2.5 sqrt(epsilon)" in note for note in slow)
    # the law of the report is what a scene takes
    law, told = load_law(folder / "law.csv"), answer["law"]
    rebound = law.rebound_speed(np.array(told["approach_speed_nm_per_us"]))
    np.testing.assert_allclose(rebound, told["rebound_speed_nm_per_us"], rtol=1e-6)
    first = records(folder / "law.csv")[0]
    low, high = (float(first[f"rebound_{end}_nm_per_us"]) for end in ("low", "high"))
    assert 2.0 * TWO_SIDED_95 * told["viscous"]["curve_error"][0] == pytest.approx(high - low, rel=1e-6)
    page = read_page((folder / "invert.html").read_text(encoding="utf-8"))
    for said in ((folder / "invert.txt").read_text(encoding="utf-8"), words_of(page)):
        assert "The rows support a viscous loss" in said
    assert len(table_of(section_of(page, "rows"), "Every row")) == 1 + len(told_rows)


def test_reading_on_resonance_is_compared_with_a_truth_from_a_file(tmp_path):
    path, truth = on_resonance(tmp_path / "table.csv"), tmp_path / "truth.csv"
    # captured tips stay empty, as `collide` writes them
    lines = ["approach_speed_nm_per_us,rebound_speed_nm_per_us,captured", "10,,true", "15,10.1805,false"]
    lines += ["60,58.79,false", "200,199.4561,false", "400,399.6,false"]
    truth.write_text("\n".join(lines) + "\n", encoding="utf-8")
    result = run(path, "--truth", truth, "--json")
    assert result.exit_code == 0, result.stderr
    reading = strictly(result.stdout)["resonance"]
    assert reading["reference"] == "truth"
    assert all(-0.5 < bias < -0.03 for bias in reading["bias"])


def test_two_rows_end_with_exit_code_3(tmp_path):
    write_table(rows(TABLE, slice(0, 2)), tmp_path / "table.csv")
    result = run(tmp_path / "table.csv")
    assert result.exit_code == 3
    assert "2 rows do not determine a law" in result.stderr
    assert "NOT VALID" in result.stdout


def test_a_reading_whose_phase_is_assumed_is_not_called_valid(tmp_path):
    result = run(on_resonance(tmp_path / "table.csv"))
    assert result.exit_code == 0, result.stderr
    assert "READ ON AN ASSUMPTION" in result.stdout
    assert "VALID" not in result.stdout


def test_a_fitted_law_is_drawn_over_the_rows(tmp_path):
    u, origin = np.geomspace(20.0, 700.0, 12), "law+delay fitted to other.csv"
    law = TabulatedLaw.with_errors(u, 0.99 * u, np.full(12, 0.07), rebound_changes=np.diag(0.01 * u), origin=origin)
    save_law(law, tmp_path / "law.json")
    path = tmp_path / "fit.json"
    path.write_text(json.dumps({"format": "afm-jax fit", "format_version": 2, "valid": True, "law": law.to_dict()}))
    pictures, told = [], []
    for drawn in ((), ("--law", path), ("--law", tmp_path / "law.json")):
        result = run(on_resonance(tmp_path / "table.csv"), "--json", "--out", tmp_path / "out", *drawn)
        assert result.exit_code == 0, result.stderr
        pictures.append(imread(tmp_path / "out" / "invert.png"))
        told.append(json.loads(result.stdout)["fitted_law"])
    # band and curve
    assert np.sum(np.any(pictures[0] != pictures[1], axis=2)) > 5000
    assert told[0] is None
    assert told[1] == told[2]
    assert told[1]["law"] == "a law (law+delay fitted to other.csv), known from 20 to 700 nm/us"
