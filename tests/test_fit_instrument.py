"""What a fit makes of the instrument's errors, of outliers and of drives on which no orbit was seen."""

import dataclasses

import numpy as np
import pytest

from afm_jax.impact.law import ImpactLaw
from fitting import fit
from fitting.infer.result import FitResult
from fitting.tables.table import AmplitudeTable
from tests.fit_tables import (
    amplitudes_and_errors,
    example_amplitudes,
    holds,
    rows,
    simulated,
    standard_errors_of,
    values_of,
)
from tests.fit_tables import with_amplitudes as table_with

pytestmark = pytest.mark.slow
"""Each compiles programs of its own for a minute or more."""

LAW = ImpactLaw(0.95, 60.0)
AMPLITUDES = tuple(f"{kind}_amplitude{error}_nm" for kind in ("peak", "lockin") for error in ("", "_error"))


@pytest.fixture(scope="module")
def table() -> AmplitudeTable:
    """Return a made table with noise of 1 %; its Q is known to 1 %."""
    return simulated(example_amplitudes(), LAW, seed=11)


@pytest.fixture(scope="module")
def plain(table) -> FitResult:
    return fit(table, model="law")


def test_a_wrong_calibration_of_the_tip_is_found(table):
    amplitude, error = amplitudes_and_errors(table)
    off = table_with(table, 1.04 * amplitude, 1.04 * error, calibration={"tip_calibration": (1.0, 0.05)})
    assert not fit(dataclasses.replace(off, calibration={}), model="law").valid
    result = fit(off, model="law")
    assert result.valid
    assert list(result.parameters) == ["r", "epsilon", "quality_factor", "tip_calibration"]
    for name, truth in {"r": 0.95, "epsilon": 60.0, "tip_calibration": 1.04}.items():
        assert holds(result.parameters[name], truth), name
    calibration, quality = (result.parameters[name].value for name in ("tip_calibration", "quality_factor"))
    pulls = ((calibration - 1.0) / 0.05) ** 2 + (np.log(quality / 40.0) / 0.01) ** 2
    assert result.chi2 == pytest.approx(np.nansum(result.rows.residual**2) + pulls, rel=1e-12)
    assert result.degrees_of_freedom == 2 * table.rows + 2 - 4


def test_a_wrong_calibration_of_drive_and_offsets_is_found(table):
    """The stated drive is 5 % less than the true one, the stated offsets lack 0.3 nm."""
    drive, offset = table.drive_amplitude_nm / 1.05, table.offset_nm - 0.3
    stated = dataclasses.replace(table, drive_amplitude_nm=drive, offset_nm=offset)
    result = fit(stated, model="law", constraints={"drive_calibration": (1.0, 0.1), "offset_origin_nm": (0.0, 1.0)})
    assert result.valid
    truth = {"r": 0.95, "epsilon": 60.0, "drive_calibration": 1.05, "offset_origin_nm": 0.3}
    for name, value in truth.items():
        # three errors, of four parameters
        assert abs(result.parameters[name].value - value) < 3.0 * (result.parameters[name].standard_error or 0.0)


def with_unseen(table: AmplitudeTable, drive_nm: float) -> AmplitudeTable:
    """Return a table with its last row once more, at another drive, on which no orbit was seen."""
    columns = {name: np.append(np.asarray(getattr(table, name)), np.nan) for name in AMPLITUDES}
    columns["drive_amplitude_nm"] = np.append(np.asarray(table.drive_amplitude_nm), drive_nm)
    columns["no_orbit"] = np.append(np.zeros(table.rows), 1.0)
    again = np.append(np.arange(table.rows), -1)
    return rows(table, again, **columns, lines=np.arange(1, table.rows + 2))


def test_an_orbit_that_was_not_seen_counts_three_errors(table, plain):
    drive = 1.001 * float(table.drive_amplitude_nm[-1])  # another drive than the last row's, as good as the same
    result = fit(with_unseen(table, drive), model="law")
    assert result.chi2 == pytest.approx(plain.chi2 + 9.0, rel=1e-6)
    assert np.all(np.abs(values_of(result) - values_of(plain)) < 1e-3 * standard_errors_of(plain))


def test_outliers_hardly_move_a_robust_fit_and_are_named(table, plain):
    # three amplitudes that are far off
    amplitude, error = amplitudes_and_errors(table)
    amplitude[[5, 30, 60], [0, 1, 0]] *= [1.3, 0.75, 1.5]
    spoilt = table_with(table, amplitude, error)
    plainly, robust = fit(spoilt, model="law"), fit(spoilt, model="law", robust=True)
    shift = np.abs(values_of(robust) - values_of(plain)) / standard_errors_of(plain)
    assert shift.max() < 1.0
    assert shift.max() < np.abs(values_of(plainly) - values_of(plain)).max()
    assert (plainly.valid, robust.valid) == (False, True)
    (said,) = [warning for warning in robust.warnings if "Robust fit" in warning]
    named = ", ".join(str(int(spoilt.lines[row])) for row in (5, 30, 60))
    assert f"outliers are left out: lines {named}" in said
    # their rows are left out, and nothing else
    assert np.flatnonzero(robust.rows.set_aside).tolist() == [5, 30, 60]
    kept = ~robust.rows.set_aside
    amplitude, error = amplitudes_and_errors(rows(spoilt, kept))
    residual = (robust.rows.predicted_nm[kept] - amplitude) / error
    np.testing.assert_allclose(robust.rows.residual[kept], residual, rtol=1e-12)
    pull = np.log(robust.parameters["quality_factor"].value / 40.0) / 0.01
    assert robust.chi2 == pytest.approx(np.sum(residual**2) + pull**2, rel=1e-9)
    alone = fit(rows(spoilt, kept), model="law")
    np.testing.assert_allclose(values_of(robust), values_of(alone), rtol=1e-6)


def test_as_many_outliers_as_may_be_do_not_hide_behind_the_rows_they_pull(table, plain):
    """By plain least squares three rows in ten are beyond four errors here."""
    amplitude, error = amplitudes_and_errors(table)
    wrong = np.sort(np.random.default_rng(0).choice(table.rows, 8, replace=False))
    amplitude[wrong] *= 1.5
    result = fit(table_with(table, amplitude, error), model="law", robust=True)
    assert result.valid
    assert np.flatnonzero(result.rows.set_aside).tolist() == wrong.tolist()
    assert np.all(np.abs(values_of(result) - values_of(plain)) < standard_errors_of(plain))
