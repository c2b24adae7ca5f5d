"""`afm-jax calibrate`: what it prints, writes and returns."""

from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from afm_jax.cli.main import main
from fitting.calibration.sweep import Resonance
from fitting.tables.table import parse_table
from tests.answers import answer
from tests.resonance_sweeps import FREQUENCY_KHZ, QUALITY_FACTOR, synthetic_sweep
from tests.strict_reading import strictly


def run(*arguments: object):
    return CliRunner().invoke(main, ["calibrate", *(str(argument) for argument in arguments)])


def saved(sweep: Resonance, path: Path) -> Path:
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
    # two numbers a point, eight parameters
    assert (told["valid"], told["model"], told["degrees_of_freedom"]) == (True, "phase", 2 * 120 - 8)
    for name, truth in (("frequency_khz", FREQUENCY_KHZ), ("quality_factor", QUALITY_FACTOR)):
        assert abs(told[name]["value"] - truth) < 4.0 * told[name]["standard_error"]
    names = {"calibration.json", "calibration.png", "calibration_points.csv"}
    assert names == {path.name for path in folder.iterdir()}
    written = folder / "calibration_points.csv"
    points, given = (np.genfromtxt(path, delimiter=",", names=True) for path in (written, sweep_path))
    np.testing.assert_array_equal(points["measured_amplitude"], given["amplitude_nm"])
    # noise of 0.2 %
    np.testing.assert_allclose(points["fitted_amplitude"], given["amplitude_nm"], rtol=0.0, atol=0.05)


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


def test_a_sweep_beside_the_resonance_ends_with_exit_code_3(tmp_path):
    path = saved(synthetic_sweep(noise=0.01, centre=40.0, phase=False), tmp_path / "beside.csv")
    result = run(path, "--json", "--out", tmp_path / "out")
    assert result.exit_code == 3
    assert "not valid: No resonance stands out" in result.stderr
    told = strictly(result.stdout)
    assert (told["valid"], told["table_comments"]) == (False, [])
    assert "free_frequency_khz" not in run(path).stdout
