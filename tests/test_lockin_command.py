"""`afm-jax lockin`: what it prints, writes and returns."""

from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from matplotlib.image import imread

from afm_jax.cli.main import main
from fitting import read_table
from tests.html_pages import read_page, words_of
from tests.lockin_traces import bounce
from tests.strict_reading import strictly

COMMENTS = "# free_frequency_khz = 90\n# quality_factor = 40 +- 2\n# drive_amplitude_nm = 4\n# offset_nm = -1\n"


def run(*arguments: object):
    return CliRunner().invoke(main, ["lockin", *(str(argument) for argument in arguments)])


def written(path: Path, *, order: int = 1, wobble: float = 0.0, comments: str = COMMENTS) -> tuple[Path, complex]:
    """Write a noisy bounce whose alternate periods differ by `wobble`; return its path and lock-in value."""
    drive = 181.8 * order
    time = np.arange(0.0, 80.0 * 1e3 / 181.8, 0.1)
    height, value = bounce(time, order=order, drive_khz=drive)
    height = height * (1.0 + wobble * (-1.0) ** np.floor((time - 1.3) * 0.1818 + 0.5))
    height = height + 0.3 * np.random.default_rng(order).standard_normal(time.size)
    platform = -1.0 + 4.0 * np.cos(2e-3 * np.pi * drive * time)
    head = f"{comments}# drive_frequency_khz = {drive!r}\ntime_us,deflection_nm,platform_nm"
    np.savetxt(path, np.stack([time, height, platform], 1), ("%.1f", "%.6f", "%.6f"), ",", header=head, comments="")
    return path, value


@pytest.fixture(scope="module")
def reported(tmp_path_factory):
    folder = tmp_path_factory.mktemp("traces")
    first, one = written(folder / "first.csv")
    third, three = written(folder / "third.csv", order=3)
    doubled, _ = written(folder / "doubled.csv", wobble=0.02)
    out = folder / "out"
    return run(third, doubled, first, "--json", "--out", out), out, {"first": one, "third": three}


def test_json_of_several_traces(reported):
    result, _, values = reported
    assert result.exit_code == 3
    last = result.stderr.strip().splitlines()[-1]
    assert last.startswith("afm-jax: not valid: ")
    assert "doubled.csv: a (2,2) orbit: the period of a (1,1) orbit doubled" in last
    third, doubled, first = strictly(result.stdout)["traces"]
    assert (doubled["steady"], doubled["kind"], doubled["impacts_per_period"]) == (False, "period_multiplied", 2)
    for trace, name, order in ((first, "first", 1), (third, "third", 3)):
        assert trace["source"].endswith(f"{name}.csv")
        assert (trace["steady"], trace["order"], trace["phase_reference"]) == (True, order, "column")
        assert abs(trace["lockin_amplitude_nm"] - abs(values[name])) < 4.0 * trace["lockin_amplitude_error_nm"]
        assert abs(trace["peak_amplitude_nm"] - 70.0) < 4.0 * trace["peak_amplitude_error_nm"]


def test_the_table_is_one_that_the_fitter_reads(reported):
    result, out, _ = reported
    table = read_table(out / "amplitudes.csv")
    assert table.order.tolist() == [1, 3]
    assert (table.free_frequency_khz, table.quality_factor, table.quality_factor_error) == (90.0, 40.0, 2.0)
    np.testing.assert_array_equal(table.drive_frequency_khz, [181.8, 181.8 * 3])
    np.testing.assert_array_equal(table.drive_amplitude_nm, 4.0)
    np.testing.assert_array_equal(table.offset_nm, -1.0)
    read = {trace["order"]: trace for trace in strictly(result.stdout)["traces"] if trace["steady"]}
    for name in ("peak_amplitude_nm", "lockin_amplitude_nm", "lockin_amplitude_error_nm", "phase_deg"):
        np.testing.assert_array_equal(getattr(table, name), [read[1][name], read[3][name]])


def test_files_of_the_report(reported):
    result, out, _ = reported
    names = [f"lockin_{name}.png" for name in ("doubled", "first", "third")]
    assert sorted(path.name for path in out.iterdir()) == ["amplitudes.csv", "lockin.html", "lockin.json", *names]
    assert strictly((out / "lockin.json").read_text(encoding="utf-8")) == strictly(result.stdout)
    page = read_page((out / "lockin.html").read_text(encoding="utf-8"))
    assert [words_of(one) for one in page.iter("h2")] == ["third", "doubled", "first"]
    assert len(list(page.iter("img"))) == 3
    # a drawn picture has many shades
    assert len(np.unique(imread(out / "lockin_third.png"))) > 50


def test_text_says_the_verdict_first_and_a_table_needs_what_the_fitter_needs(tmp_path):
    path, _ = written(tmp_path / "bare.csv", comments="")
    out = tmp_path / "out"
    result = run(path, "--out", out)
    assert result.exit_code == 0, result.stderr
    # a line breaks behind a long path
    assert " ".join(result.stdout.split()).startswith(f"{path}: STEADY: a steady (1,1) orbit")
    assert "no amplitudes.csv" in result.stderr
    assert "free_frequency_khz is not known" in result.stderr
    assert not (out / "amplitudes.csv").exists()
    # drive and offset come from the platform's column
    given = ["--free-frequency-khz", 90, "--quality-factor", "none", "--spring-constant-n-per-m", 5.4]
    assert run(path, "--out", out, *given).exit_code == 0
    table = read_table(out / "amplitudes.csv")
    assert (table.quality_factor, table.spring_constant_n_per_m) == (None, 5.4)
    np.testing.assert_allclose(np.asarray(table.drive_amplitude_nm), 4.0, rtol=1e-6)
    np.testing.assert_allclose(table.offset_nm, -1.0, rtol=1e-6)
    twice = run(path, *given, "--mass-ng", 20)
    assert twice.exit_code == 2
    assert "mass_ng = 20 and spring_constant_n_per_m = 5.4 contradict each other" in twice.stderr
