"""`afm-jax fit`: what it prints, writes and returns."""

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from scipy.stats import chi2 as chi2_distribution

from afm_jax.cli.main import main
from fitting import fit
from fitting.tables.table import TABLE, read_table, write_table
from tests.answers import answer as answer_of
from tests.answers import table as records
from tests.fit_tables import EXAMPLE, holds
from tests.html_pages import first_screen, read_page, section_of, words_of
from tests.strict_reading import strictly


def run(*arguments: object):
    return CliRunner().invoke(main, ["fit", *(str(argument) for argument in arguments)])


def shortened(path: Path, count: int | None = None, whole: Path = EXAMPLE) -> Path:
    """Write the first rows of a table, the bundled one or another, without its columns of errors and phases."""
    comments = [line for line in whole.read_text(encoding="utf-8").splitlines() if line.startswith("#")]
    kept = [name for name in records(whole)[0] if "error" not in name and "phase" not in name]
    cells = [",".join(row[name] for name in kept) for row in records(whole)[:count]]
    path.write_text("\n".join([*comments, ",".join(kept), *cells]) + "\n", encoding="utf-8")
    return path


def column(path: Path, name: str) -> np.ndarray:
    """Return the numbers of a column of a CSV file."""
    return np.array([float(row[name]) for row in records(path)])


@pytest.fixture(scope="module")
def reported(tmp_path_factory):
    folder = tmp_path_factory.mktemp("report")
    return answer_of(folder, "fit", EXAMPLE), folder


def test_report_is_written_and_holds_every_input(reported):
    answer, folder = reported
    assert answer["model"] == "law"
    assert answer["degrees_of_freedom"] == 244
    assert not any("follow the rows" in note for note in answer["warnings"])
    for name in records(EXAMPLE)[0]:
        assert answer["input"][name] == column(EXAMPLE, name).tolist()
    head = {"free_frequency_khz": 90.0, "quality_factor": 40.0, "quality_factor_error": 0.4, "mass_ng": 1.0}
    assert head.items() <= answer["input"].items()
    page = read_page((folder / "fit.html").read_text(encoding="utf-8"))
    # rows, law, residuals over the speed
    assert sum(1 for _ in page.iter("img")) == 3
    assert "VALID" in first_screen(page).splitlines()
    text = (folder / "fit.txt").read_text(encoding="utf-8")
    assert "VALID" in text.splitlines()
    for said in (text, words_of(section_of(page, "parameters"))):
        # made with r 0.95 and epsilon 60 (its own comments say so)
        assert "0.9494 to 0.9507" in said


def test_tables_of_the_report_hold_the_fit(reported):
    answer, folder = reported
    r, epsilon = (answer["parameters"][name]["value"] for name in ("r", "epsilon"))
    of_law = np.array([list(point.values()) for point in records(folder / "law.csv")], dtype=float)
    speed, rebound, low, high, *delays = of_law.T
    assert not np.any(delays)
    np.testing.assert_allclose(rebound, np.sqrt(r**2 * speed**2 - epsilon), rtol=1e-12)
    assert np.all((low < rebound) & (rebound < high))
    # what is known of Q is known of its logarithm
    chi2 = (np.log(answer["parameters"]["quality_factor"]["value"] / 40.0) / 0.01) ** 2
    for kind, unit, absolute in (
        ("peak_amplitude", "nm", 1e-12),
        ("lockin_amplitude", "nm", 1e-12),
        ("phase", "deg", 1e-9),
    ):
        misfit = column(folder / "fit_rows.csv", f"predicted_{kind}_{unit}") - column(EXAMPLE, f"{kind}_{unit}")
        if kind == "phase":
            # of the N periods of a response any is locked
            turn = 360.0 / column(EXAMPLE, "order")
            misfit = (misfit + 0.5 * turn) % turn - 0.5 * turn
        residual = column(folder / "fit_rows.csv", f"{kind.split('_')[0]}_residual")
        misfit /= column(EXAMPLE, f"{kind}_error_{unit}")
        np.testing.assert_allclose(residual, misfit, rtol=1e3 * absolute, atol=absolute)
        chi2 += np.sum(residual**2)
    assert answer["chi2"] == pytest.approx(chi2, rel=1e-12)


def test_energies_need_a_mass(tmp_path, reported):
    lines = EXAMPLE.read_text(encoding="utf-8").splitlines()
    bare = [line for line in lines if not line.startswith(("# quality_factor", "# mass_ng"))]
    path = tmp_path / "bare.csv"
    path.write_text("\n".join(bare) + "\n", encoding="utf-8")
    stated = strictly(run(path, "--json", "--quality-factor", "40 +- 0.4").stdout)
    assert stated["parameters"] == reported[0]["parameters"]
    assert [one["energy_aj"] for one in stated["loss"]["energies"]] == [None, None, None]
    assert stated["loss"]["energies_reason"] == "the table gives neither mass_ng nor spring_constant_n_per_m"
    head = ["# spring_constant_n_per_m = 5.4", "# quality_factor = 40 +- 0.4"]
    path.write_text("\n".join([*head, *bare]), encoding="utf-8")
    stiff = strictly(run(path, "--json").stdout)
    mass = 5.4 / (2e-3 * math.pi * 90.0) ** 2
    u, energy = (stiff["loss"]["energies"][0][name] for name in ("approach_speed_nm_per_us", "energy_aj"))
    r, epsilon = (stiff["parameters"][name]["value"] for name in ("r", "epsilon"))
    assert energy["value"] == pytest.approx(0.5 * mass * (u**2 * (1.0 - r**2) + epsilon), rel=1e-6)


@pytest.mark.slow
def test_repeated_readings_count_and_tell_the_error(tmp_path):
    table = read_table(EXAMPLE)
    # every row twice, the second reading two errors of the peak and one of the lock-in larger
    again = {name: np.tile(getattr(table, name), 2) for name in TABLE.names if getattr(table, name) is not None}
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
        "p_value": pytest.approx(chi2_distribution.sf(2.5 * table.rows, 3 * table.rows)),
    }
    # amplitudes without errors of their own take their scatter, and it is said
    bare = shortened(tmp_path / "bare.csv", whole=tmp_path / "twice.csv")
    said = " ".join(strictly(run(bare, "--json").stdout)["warnings"])
    for name in ("peak_amplitude_nm", "lockin_amplitude_nm"):
        assert said.count(f"Errors from repeated readings: {name} +- ") == 1


@pytest.mark.slow
def test_a_drift_of_the_phase_is_noticed_and_fitted_along():
    table = read_table(EXAMPLE)
    drift = 2.0 * np.linspace(0.0, 1.0, table.rows)
    drifted = dataclasses.replace(table, phase_deg=(np.asarray(table.phase_deg) + drift) % (360.0 / table.order))
    (note,) = [one for one in fit(drifted).warnings if "follow" in one]
    assert "phase +" in note
    assert "say `# rows = in order of time`" in note
    result = fit(dataclasses.replace(drifted, rows_in_order_of_time=True))
    assert result.valid
    found = result.parameters["phase_drift_deg"]
    assert found.constraint == (0.0, 3.0)
    assert abs(found.value - 2.0) < 2.5 * (found.standard_error or np.inf) < 0.5
    for name, truth in (("r", 0.95), ("epsilon", 60.0)):
        assert holds(result.parameters[name], truth), name
    assert not any("follow the rows" in note for note in result.warnings)
