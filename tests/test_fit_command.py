"""`afm-jax fit`: what it prints, writes and returns."""

import dataclasses
import importlib.util
import math
import sys
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from scipy.stats import chi2

from afm_jax import load_law
from afm_jax.cli.fit_options import fit_settings
from afm_jax.cli.main import main
from fitting.tables.table import TABLE, read_table, write_table
from tests.answers import answer as answer_of
from tests.answers import table as records
from tests.fit_tables import EXAMPLE
from tests.html_pages import first_screen, read_page
from tests.strict_reading import strictly


def run(*arguments: object):
    return CliRunner().invoke(main, ["fit", *(str(argument) for argument in arguments)])


def shortened(path: Path, rows: int, *, without_errors: bool) -> Path:
    """Write the first rows of the bundled table, with or without its columns of errors."""
    comments = [line for line in EXAMPLE.read_text(encoding="utf-8").splitlines() if line.startswith("#")]
    kept = [name for name in records(EXAMPLE)[0] if not (without_errors and ("error" in name or "phase" in name))]
    cells = [",".join(row[name] for name in kept) for row in records(EXAMPLE)[:rows]]
    path.write_text("\n".join([*comments, ",".join(kept), *cells]) + "\n", encoding="utf-8")
    return path


@pytest.fixture(scope="module")
def reported(tmp_path_factory):
    folder = tmp_path_factory.mktemp("report")
    return answer_of(folder, "fit", EXAMPLE), folder


def test_report_is_written_and_holds_every_input(reported):
    answer, folder = reported
    assert answer["model"] == "law"
    assert answer["valid"] is True
    assert answer["degrees_of_freedom"] == 244
    for column in records(EXAMPLE)[0]:
        assert answer["input"][column] == [float(row[column]) for row in records(EXAMPLE)]
    head = {"free_frequency_khz": 90.0, "quality_factor": 40.0, "quality_factor_error": 0.4, "mass_ng": 1.0}
    assert head.items() <= answer["input"].items()
    assert "seed 1997" in " ".join(answer["input"]["remarks"])
    text = (folder / "fit.txt").read_text(encoding="utf-8")
    assert "u_out^2 = r^2 u_in^2 - epsilon" in text
    page = read_page((folder / "fit.html").read_text(encoding="utf-8"))
    # rows, law, residuals over the speed, energy of an impact
    assert sum(1 for _ in page.iter("img")) == 4
    for said in (text, first_screen(page)):
        assert "VALID" in said.splitlines()
        # made with r 0.95 and epsilon 60 (its own comments say so)
        assert "0.9494 to 0.9507" in said


def test_tables_of_the_report_hold_the_fit(reported):
    answer, folder = reported
    r, epsilon = (answer["parameters"][name]["value"] for name in ("r", "epsilon"))
    for point in records(folder / "law.csv"):
        speed, rebound, low, high, *delays = (float(number) for number in point.values())
        assert delays == [0.0, 0.0, 0.0]
        assert rebound == pytest.approx(math.sqrt(r**2 * speed**2 - epsilon), rel=1e-12)
        assert low < rebound < high
    law, whole = load_law(folder / "law.csv"), answer["law"]
    assert float(law.capture_speed_nm_per_us) == whole["capture_speed_nm_per_us"]
    assert [float(law.mass_ng or 0.0), law.origin.text] == [1.0, whole["origin"]]
    assert [float(law.slowest_nm_per_us), float(law.fastest_nm_per_us)] == whole["speed_range_nm_per_us"]
    rows = records(folder / "fit_rows.csv")
    pulls = []
    for row, given in zip(rows, records(EXAMPLE), strict=True):
        for kind in ("peak", "lockin"):
            misfit = float(row[f"predicted_{kind}_amplitude_nm"]) - float(given[f"{kind}_amplitude_nm"])
            assert float(row[f"{kind}_residual"]) == pytest.approx(
                misfit / float(given[f"{kind}_amplitude_error_nm"]), rel=1e-9
            )
            pulls.append(float(row[f"{kind}_residual"]))
        pulls.append(float(row["phase_residual"]))
        # of the N periods of a response any is locked
        turn = 360.0 / float(given["order"])
        misfit = float(row["predicted_phase_deg"]) - float(given["phase_deg"])
        misfit = (misfit + 0.5 * turn) % turn - 0.5 * turn
        assert pulls[-1] == pytest.approx(misfit / float(given["phase_error_deg"]), rel=1e-6, abs=1e-9)
    pulls.append((answer["parameters"]["quality_factor"]["value"] - 40.0) / 0.4)
    assert answer["chi2"] == pytest.approx(sum(pull**2 for pull in pulls), rel=1e-12)


def test_damping_must_be_said_and_energies_need_a_mass(tmp_path, reported):
    lines = EXAMPLE.read_text(encoding="utf-8").splitlines()
    bare = [line for line in lines if not line.startswith(("# quality_factor", "# mass_ng"))]
    path = tmp_path / "bare.csv"
    path.write_text("\n".join(bare) + "\n", encoding="utf-8")
    for arguments in (["fit", path], ["fit", path, path, "--each"], ["invert", path]):
        refused = CliRunner().invoke(main, [str(argument) for argument in arguments])
        assert refused.exit_code == 2
        assert f"{path}: the quality factor is missing" in refused.stderr
        assert "'# quality_factor = 40 +- 2'" in refused.stderr
        assert "'# quality_factor = none' says that there is no air damping" in refused.stderr
        assert refused.stderr.count("\n") == 1
    stated = strictly(run(path, "--json", "--quality-factor", "40 +- 0.4").stdout)
    known = reported[0]
    assert stated["parameters"] == known["parameters"]
    assert [one["energy_aj"] for one in stated["loss"]["energies"]] == [None, None, None]
    assert stated["loss"]["energies_reason"] == "the table gives neither mass_ng nor spring_constant_n_per_m"
    assert stated["loss"]["delta_aj"] is None
    assert known["loss"]["energies_reason"] is None
    path.write_text(
        "\n".join(["# spring_constant_n_per_m = 5.4", "# quality_factor = 40 +- 0.4", *bare]), encoding="utf-8"
    )
    stiff = strictly(run(path, "--json").stdout)
    mass = 5.4 / (2e-3 * math.pi * 90.0) ** 2
    u, energy = (stiff["loss"]["energies"][0][name] for name in ("approach_speed_nm_per_us", "energy_aj"))
    r, epsilon = (stiff["parameters"][name]["value"] for name in ("r", "epsilon"))
    assert energy["value"] == pytest.approx(0.5 * mass * (u**2 * (1.0 - r**2) + epsilon), rel=1e-6)


def test_repeated_readings_count_and_tell_the_error(tmp_path, reported):
    table = read_table(EXAMPLE)
    # every row twice, the second reading two errors of the peak and one of the lock-in larger
    kept = [name for name in TABLE.names if getattr(table, name) is not None]
    again = {name: np.concatenate([column, column]) for name, column in vars(table).items() if name in kept}
    for name, errors in (("peak", 2.0), ("lockin", 1.0)):
        again[f"{name}_amplitude_nm"][table.rows :] += errors * getattr(table, f"{name}_amplitude_error_nm")
    write_table(dataclasses.replace(table, **again), tmp_path / "twice.csv")
    answer = strictly(run(tmp_path / "twice.csv", "--json").stdout)
    assert answer["degrees_of_freedom"] == 244 + 3 * table.rows
    assert answer["repeats"] == {
        "drives": table.rows,
        "rows": 2 * table.rows,
        "chi2": pytest.approx((0.5 * 2.0**2 + 0.5) * table.rows),
        "degrees_of_freedom": 3 * table.rows,
        "error_ratio": pytest.approx(math.sqrt(2.5 / 3.0)),
        "p_value": pytest.approx(chi2.sf(2.5 * table.rows, 3 * table.rows)),
    }
    assert reported[0]["repeats"] is None
    # amplitudes without errors of their own take their scatter, and it is said
    lines = (tmp_path / "twice.csv").read_text(encoding="utf-8").splitlines()
    names = next(line for line in lines if line.startswith("order"))
    kept = [i for i, name in enumerate(names.split(",")) if not name.endswith("_error_nm")]
    bare = [one if one[0] == "#" else ",".join(one.split(",")[i] for i in kept) for one in lines]
    (tmp_path / "bare.csv").write_text("\n".join(bare) + "\n", encoding="utf-8")
    said = [one for one in strictly(run(tmp_path / "bare.csv", "--json").stdout)["warnings"] if "repeated" in one]
    assert [one.split(" +- ")[0] for one in said] == [
        f"Errors from repeated readings: {name}" for name in ("peak_amplitude_nm", "lockin_amplitude_nm")
    ]


@pytest.mark.slow
def test_a_drift_of_the_phase_is_noticed_and_fitted_along(tmp_path, reported):
    table = read_table(EXAMPLE)
    drift = 2.0 * np.linspace(0.0, 1.0, table.rows)
    drifted = dataclasses.replace(table, phase_deg=(np.asarray(table.phase_deg) + drift) % (360.0 / table.order))
    write_table(drifted, tmp_path / "drift.csv")
    assert not any("follow the rows" in note for note in reported[0]["warnings"])
    (note,) = [one for one in strictly(run(tmp_path / "drift.csv", "--json").stdout)["warnings"] if "follow" in one]
    assert "phase +" in note
    assert "say `# rows = in order of time`" in note
    write_table(dataclasses.replace(drifted, rows_in_order_of_time=True), tmp_path / "drift.csv")
    answer = strictly(run(tmp_path / "drift.csv", "--json").stdout)
    assert answer["valid"]
    found = answer["parameters"]["phase_drift_deg"]
    assert found["constraint"] == [0.0, 3.0]
    assert abs(found["value"] - 2.0) < 2.5 * found["standard_error"] < 0.5
    for name, truth in (("r", 0.95), ("epsilon", 60.0)):
        low, high = answer["parameters"][name]["interval95"]
        assert low < truth < high
    assert not any("follow the rows" in note for note in answer["warnings"])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("columns", "factor", "words"),
    [
        (("peak_amplitude", "lockin_amplitude"), 1e-3, "the tip's amplitudes times 1000 (micrometres were written"),
        (("drive_amplitude",), 0.5**0.5, "the drive's amplitude times sqrt 2 (rms"),
        (("drive_frequency",), 1e3, "the drive's frequency over 1000 (Hz"),
    ],
)
def test_a_table_in_other_units_is_told_which(tmp_path, columns, factor, words):
    table = read_table(EXAMPLE)
    names = [f"{column}{end}_{unit}" for column in columns for end in ("", "_error") for unit in ("nm", "khz")]
    scaled = {name: factor * column for name in names if (column := getattr(table, name, None)) is not None}
    assert scaled
    write_table(dataclasses.replace(table, **scaled), tmp_path / "other.csv")
    result = run(tmp_path / "other.csv", "--json")
    assert result.exit_code == 3
    (said,) = [reason for reason in strictly(result.stdout)["reasons"] if "Check the units" in reason]
    assert said.startswith(f"With {words}")


@pytest.mark.slow
def test_one_of_several_tables_in_other_units_is_named(tmp_path):
    table = read_table(EXAMPLE)
    parts = []
    for name, rows in (("first.csv", slice(0, None, 2)), ("second.csv", slice(1, None, 2))):
        own = {one: np.asarray(getattr(table, one))[rows] for one in TABLE.names if getattr(table, one) is not None}
        if name == "second.csv":
            own = {one: 2.0 * column if one.startswith(("peak", "lockin")) else column for one, column in own.items()}
        write_table(dataclasses.replace(table, **own), tmp_path / name)
        parts.append(tmp_path / name)
    result = run(*parts, "--json")
    assert result.exit_code == 3
    (said,) = [reason for reason in strictly(result.stdout)["reasons"] if "Check its units" in reason]
    assert said.startswith("second.csv: With the tip's amplitudes halved (peak to peak")


def test_errors_come_from_the_noise_option(tmp_path):
    bare = shortened(tmp_path / "bare.csv", 30, without_errors=True)
    first, second = (strictly(run(bare, "--json", "--noise", share).stdout) for share in ("1%", "0.02"))
    assert first["valid"] is True
    assert first["input"]["peak_amplitude_error_nm"] == pytest.approx(
        [0.01 * peak for peak in first["input"]["peak_amplitude_nm"]], rel=1e-12
    )
    # twice the errors: a quarter of chi2, but for the constraint on Q
    assert second["chi2"] == pytest.approx(first["chi2"] / 4.0, rel=2e-2)
    errors = [answer["parameters"]["epsilon"]["standard_error"] for answer in (first, second)]
    assert errors[1] == pytest.approx(2.0 * errors[0], rel=5e-2)


@pytest.mark.parametrize(
    ("option", "package", "said"),
    [
        ("--arviz", "h5netcdf", "a file for ArviZ needs the package h5netcdf: pip install 'afm-jax[arviz]'"),
        ("--posterior", "blackjax", "sampling a posterior needs the package blackjax: pip install 'afm-jax[nuts]'"),
    ],
)
def test_packages_are_asked_for_before_the_fit(tmp_path, monkeypatch, option, package, said):
    have = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == package else have(name))
    monkeypatch.setitem(sys.modules, package, None)
    result = run("--example", option, *([tmp_path / "posterior.nc"] if option == "--arviz" else []))
    assert (result.exit_code, result.stdout) == (2, "")
    assert result.stderr.splitlines() == [f"afm-jax: {said}"]


def test_a_contact_without_an_effect_is_not_fitted_by_its_parameters():
    options = {"scale_errors": False, "robust": False, "constrain": (), "free": None}
    settings = fit_settings("contact", options | {"left_out": ("viscous",), "fix": (("modulus_gpa", 90.0),)})
    assert settings["free"] == ("relative_humidity", "adhesion_energy_j_per_m2")
    assert settings["effects"] == ("capillary", "structural", "core", "jkr")


def test_what_an_invalid_fit_leaves_out_is_said(tmp_path):
    result = run(shortened(tmp_path / "one.csv", 1, without_errors=False), "--bootstrap", "50", "--posterior")
    assert result.exit_code == 3
    assert "(1 row)" in result.stdout
    assert "not valid: Not identified: the amplitudes do not determine r and epsilon" in result.stderr
    assert "no bootstrap: the fit is not valid" in result.stderr
    assert "no posterior: the fit is not valid" in result.stderr
