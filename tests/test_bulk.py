"""Many fits at once: each is that of its table alone, whatever the instrument, the draw and the process."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner, Result

import fitting
from afm_jax.cli.main import main
from afm_jax.sweeps.plan import plan_of
from fitting.bulk import _with_instrument, table_input
from fitting.tables.table import AmplitudeTable, read_table, write_table
from tests.answers import table as records

AXIS = {"parameter": "table.quality_factor", "list": [38.0, 42.0]}


def table(scale: float = 1.0) -> AmplitudeTable:
    """Return the bundled table of an instantaneous law, amplitudes scaled."""
    bundled = read_table(Path(str(fitting.__file__)).parent / "examples" / "amplitudes_law.csv")
    assert bundled.peak_amplitude_nm is not None
    return replace(bundled, peak_amplitude_nm=scale * bundled.peak_amplitude_nm)


def test_instruments_change_what_they_say():
    plain = table()
    other = _with_instrument(plain, {"table.quality_factor": 30.0, "table.tip_calibration": 1.1})
    assert (other.quality_factor, other.free_frequency_khz) == (30.0, plain.free_frequency_khz)
    assert plain.peak_amplitude_nm is not None
    assert other.peak_amplitude_nm is not None
    np.testing.assert_allclose(other.peak_amplitude_nm, 1.1 * plain.peak_amplitude_nm, rtol=1e-15)
    np.testing.assert_array_equal(other.drive_amplitude_nm, plain.drive_amplitude_nm)


def test_impossible_sweeps_over_tables_are_named():
    for axis, message in (
        ({"parameter": "interaction.r", "linear": [0.1, 0.2, 3]}, "interaction.r cannot be an axis of tables"),
        (AXIS | {"list": [-1.0]}, "table.quality_factor must be positive"),
    ):
        with pytest.raises(ValueError, match=message):
            plan_of(table_input([table()], {}, axes=[axis]))


def fit_each(*arguments: object) -> Result:
    return CliRunner().invoke(main, ["fit", "--each", *map(str, arguments)], prog_name="afm-jax")


@pytest.mark.slow
def test_every_fit_is_that_of_its_table_alone(tmp_path: Path):
    tables = [table(), table(1.02)]
    found = fitting.fit_each(tables, "law", axes=[AXIS], out=tmp_path / "kept")
    for number, own in enumerate(tables):
        alone = fitting.fit(replace(own, quality_factor=42.0), "law")
        there = found.isel(table=number).sel(table_quality_factor=42.0)
        for name in ("r", "epsilon"):
            parameter = alone.parameters[name]
            wanted = parameter.value, parameter.standard_error, *parameter.interval95
            told = [float(there[name + ending]) for ending in ("", "_error", "_low", "_high")]
            np.testing.assert_array_equal(told, [np.nan if part is None else part for part in wanted])
        assert float(there["chi2"]) == alone.chi2
        assert str(there["message"].values) == " ".join(alone.reasons)
    files = [tmp_path / f"{number}.csv" for number in range(2)]
    for own, path in zip(tables, files, strict=True):
        write_table(own, path)
    result = fit_each(*files, "--model", "law", "--workers", 1, "--out", tmp_path / "out")
    assert result.exit_code in (0, 3), result.stderr
    told = records(tmp_path / "out" / "fits.csv")
    assert [float(row["r"]) for row in told] == [fitting.fit(own, "law").parameters["r"].value for own in tables]


@pytest.mark.slow
def test_fits_of_drawn_tables_scatter_by_their_errors():
    found = fitting.fit_each([table()], "law", resamples=6, seed=3).isel(table=0)
    # noise about noise would make it 2
    assert 0.8 < float((found["chi2"] / found["degrees_of_freedom"]).mean()) < 1.2
    assert int((found["outcome"] == 0).sum()) >= 5
    assert 0.4 < float(found["r"].std() / found["r_error"].mean()) < 1.8
    wrong = fitting.fit_each([table(1.1)], "law", resamples=1).isel(table=0, resample=0)
    assert int(wrong["outcome"]) == -1
    assert "is not valid (The model does not explain the data" in str(wrong["message"].values)
