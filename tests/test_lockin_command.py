"""`afm-jax lockin`: what it prints, writes and returns."""

from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from matplotlib.image import imread

from afm_jax.cli.main import main
from fitting import lockin
from tests.answers import table
from tests.lockin_traces import bounce
from tests.strict_reading import strictly


def run(*arguments: object):
    return CliRunner().invoke(main, ["lockin", *(str(argument) for argument in arguments)])


def written(path: Path, *, order: int = 1, wobble: float = 0.0) -> tuple[Path, complex]:
    """Write a noisy bounce in columns between tabs, alternate periods `wobble` apart; return path and lock-in value."""
    drive = 181.8 * order
    time = np.arange(0.0, 80.0 * 1e3 / 181.8, 0.1)
    height, value = bounce(time, order=order, drive_khz=drive)
    height = height * (1.0 + wobble * (-1.0) ** np.floor((time - 1.3) * 0.1818 + 0.5))
    height = height + 0.3 * np.random.default_rng(order).standard_normal(time.size)
    head = "time_us\tdeflection_nm"
    np.savetxt(path, np.stack([time, height], 1), ("%.1f", "%.6f"), "\t", header=head, comments="")
    return path, value


def test_amplitudes_at_all_orders_are_printed_and_written(tmp_path: Path):
    path, value = written(tmp_path / "third.txt", order=3)
    out = tmp_path / "out"
    call = (path, "--drive-frequency-khz", 545.4, "--order", 3)
    result = run(*call, "--json", "--out", out)
    assert result.exit_code == 0, result.stderr
    told = strictly(result.stdout)
    assert (told["valid"], told["order"], told["orders"]) == (True, 3, list(range(1, 9)))
    assert abs(told["lockin_amplitude_nm"] - abs(value)) < 4.0 * told["lockin_amplitude_error_nm"]
    assert told["amplitudes_nm"][2] == told["lockin_amplitude_nm"]
    assert sorted(file.name for file in out.iterdir()) == ["lockin.csv", "lockin.json", "lockin.png"]
    assert strictly((out / "lockin.json").read_text(encoding="utf-8")) == told
    rows = table(out / "lockin.csv")
    assert [float(row["lockin_amplitude_nm"]) for row in rows] == told["amplitudes_nm"]
    # a drawn picture has many shades
    assert len(np.unique(imread(out / "lockin.png"))) > 50
    said = run(*call).stdout
    assert said.startswith("Order 3 of 545.4 kHz")
    assert said.splitlines()[2] == "VALID"
    assert f"{told['lockin_amplitude_nm']:.6g}" in said
    # the function takes the file, too
    assert lockin(path, drive_frequency_khz=545.4, order=3).lockin_amplitude_nm == told["lockin_amplitude_nm"]


@pytest.mark.parametrize(("order", "named"), [(1, "over 2, beside"), (2, "use --order 1")])
def test_another_order_ends_with_exit_code_3(tmp_path: Path, order: int, named: str):
    path, _ = written(tmp_path / "doubled.txt", wobble=0.03)
    result = run(path, "--drive-frequency-khz", 181.8, "--order", order, "--json")
    assert result.exit_code == 3
    assert f"not periodic at order {order}" in result.stderr
    assert named in result.stderr
    told = strictly(result.stdout)
    assert (told["valid"], told["reason"]) == (False, told["reasons"][0])
