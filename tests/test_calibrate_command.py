"""`afm-jax calibrate`: what it prints, writes and returns."""

from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from afm_jax.cli.main import main
from fitting.calibration.sweep import ResonanceSweep
from fitting.tables.table import parse_table
from tests.answers import answer
from tests.html_pages import read_page, words_of
from tests.resonance_sweeps import FREQUENCY_KHZ, QUALITY_FACTOR, synthetic_sweep
from tests.strict_reading import strictly


def run(*arguments: object):
    return CliRunner().invoke(main, ["calibrate", *(str(argument) for argument in arguments)])


def saved(sweep: ResonanceSweep, path: Path) -> Path:
    columns = {"frequency_khz": sweep.frequency_khz, "amplitude_nm": sweep.amplitude, "phase_deg": sweep.phase_deg}
    known = {name: column for name, column in columns.items() if column is not None}
    np.savetxt(path, np.stack(list(known.values()), 1), "%.17g", ",", header=",".join(known), comments="")
    return path


@pytest.fixture(scope="module")
def sweep_path(tmp_path_factory) -> Path:
    sweep = synthetic_sweep(noise=2e-3, background=0.05 + 0.03j)
    return saved(sweep, tmp_path_factory.mktemp("sweep") / "sweep.csv")


@pytest.fixture(scope="module")
def reported(sweep_path, tmp_path_factory):
    folder = tmp_path_factory.mktemp("report")
    return answer(folder, "calibrate", sweep_path), folder


def test_json_and_report_say_the_same(reported, sweep_path):
    told, folder = reported
    # two numbers a point, six parameters
    assert (told["valid"], told["model"], told["degrees_of_freedom"]) == (True, "phase", 2 * 120 - 6)
    for name, truth in (("frequency_khz", FREQUENCY_KHZ), ("quality_factor", QUALITY_FACTOR)):
        assert abs(told[name]["value"] - truth) < 4.0 * told[name]["standard_error"]
    names = {"calibration.html", "calibration.txt", "calibration.json", "calibration.png", "calibration_points.csv"}
    assert names == {path.name for path in folder.iterdir()}
    assert "VALID" in (folder / "calibration.txt").read_text(encoding="utf-8").splitlines()
    page = read_page((folder / "calibration.html").read_text(encoding="utf-8"))
    assert [words_of(one) for one in page.iter("h2")][:2] == ["Picture", "Values"]
    written = folder / "calibration_points.csv"
    points, given = (np.genfromtxt(path, delimiter=",", names=True) for path in (written, sweep_path))
    np.testing.assert_array_equal(points["measured_amplitude"], given["amplitude_nm"])
    # a difference of numbers of order 5
    misfit = points["fitted_amplitude"] - given["amplitude_nm"]
    np.testing.assert_allclose(points["amplitude_misfit"], misfit, rtol=0.0, atol=1e-14)


def test_comment_lines_go_into_an_amplitude_table(reported, sweep_path):
    comments = run(sweep_path).stdout.splitlines()[-2:]
    names = "order,drive_frequency_khz,drive_amplitude_nm,offset_nm,peak_amplitude_nm,peak_amplitude_error_nm"
    read = parse_table("\n".join([*comments, names, "1,180,4,0,163.3,1.63\n"]), "table")
    frequency, quality = (reported[0][name] for name in ("frequency_khz", "quality_factor"))
    error = quality["standard_error"]
    # two digits of the error are written
    assert read.quality_factor == pytest.approx(quality["value"], abs=0.06 * error)
    assert read.quality_factor_error == pytest.approx(error, rel=0.06)
    assert read.free_frequency_khz == pytest.approx(frequency["value"], abs=0.01 * frequency["standard_error"])


def test_options_reach_the_fit(sweep_path):
    options = ("--amplitude-only", "--background", "none", "--noise", "10%", "--scale-errors")
    told = strictly(run(sweep_path, "--json", *options).stdout)
    assert (told["model"], told["background"], told["errors"]["origin"]) == ("amplitude", "none", "noise")
    assert told["chi2"] == pytest.approx(told["degrees_of_freedom"], rel=1e-9) == 120 - 3


def test_a_sweep_beside_the_resonance_ends_with_exit_code_3(tmp_path):
    path = saved(synthetic_sweep(noise=0.01, centre=40.0, phase=False), tmp_path / "beside.csv")
    result = run(path, "--json", "--out", tmp_path / "out")
    assert result.exit_code == 3
    assert "not valid: No resonance stands out" in result.stderr
    told = strictly(result.stdout)
    assert (told["valid"], told["table_comments"]) == (False, [])
    assert "free_frequency_khz" not in (tmp_path / "out" / "calibration.txt").read_text(encoding="utf-8")
