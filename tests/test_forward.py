"""Predicted amplitudes of a table's rows and their derivatives, against the reference's orbits."""

import numpy as np
import pytest

from fitting.forward import Linearised, _filling, linearise
from fitting.models import ROWS_PER_PROGRAM, Problem, measurement_of
from fitting.tables.table import AmplitudeTable
from tests.fit_tables import table_of
from tests.reference_examples import scene
from tests.reference_flight import Parameters
from tests.reference_orbits import single_impact_orbits

VALUES = {"r": 0.98, "epsilon": 100.0, "quality_factor": 38.0}
ROWS = [(1, 1.01, 4.0, -1.0), (1, 1.03, 3.0, 1.0), (2, 2.02, 4.0, 0.0), (1, 1.01, 0.1, 0.0)]  # the last: no orbit


def parameters(row: tuple[int, float, float, float], values: dict[str, float]) -> Parameters:
    _, reduced, amplitude, offset = row
    return scene(reduced, amplitude_nm=amplitude, offset_nm=offset, **values)


def amplitudes(row: tuple[int, float, float, float], values: dict[str, float]) -> np.ndarray:
    """Return peak and lock-in amplitude of the steady orbit; 0 where there is none."""
    steady = [o for o in single_impact_orbits(parameters(row, values), row[0]) if o.stable and o.admissible]
    assert len(steady) <= 1
    return np.array([[o.peak_amplitude_nm, o.lockin_amplitude_nm] for o in steady] or [[0.0, 0.0]])[0]


MEASURED = np.array([[100.0, 40.0], [80.0, 30.0], [np.nan, 25.0], [5.0, 2.0]])  # peak and lock-in, nm
ERRORS = np.array([[2.0, 0.5], [1.0, 1.0], [np.nan, 4.0], [0.5, 0.25]])


def table() -> AmplitudeTable:
    order, reduced, amplitude, offset = zip(*ROWS, strict=True)
    drives = (order, 180.0 * np.array(reduced), amplitude, offset)
    return table_of(drives, MEASURED, ERRORS, quality_factor_error=4.0)


@pytest.fixture(scope="module")
def linear() -> Linearised:
    problem = Problem("law", tuple(VALUES))
    return linearise(np.array([list(VALUES.values())]), measurement_of(table(), problem), problem)


def test_predictions_are_the_orbits_amplitudes(linear):
    for row, drive in enumerate(ROWS):
        # 20,001 samples and a parabola in the reference's peak.
        np.testing.assert_allclose(linear.prediction.amplitude_nm[0, row], amplitudes(drive, VALUES), rtol=1e-9)
    assert [int(n) for n in linear.prediction.orbits[0, : len(ROWS)]] == [1, 1, 1, 0]
    (orbit,) = [o for o in single_impact_orbits(parameters(ROWS[0], VALUES), 1) if o.stable and o.admissible]
    speed = float(linear.prediction.approach_speed_nm_per_us[0, 0])
    assert speed == pytest.approx(float(orbit.approach_speed_nm_per_us), rel=1e-10)


def test_only_rows_that_fill_a_table_up_are_left_out():
    rows = measurement_of(table(), Problem("law", tuple(VALUES))).rows
    assert _filling(rows) == ROWS_PER_PROGRAM - len(ROWS)
    # a drive without a reading is asked for all the same; rows set aside on one drive are asked once
    assert _filling(rows._replace(measured=np.zeros_like(rows.measured))) == ROWS_PER_PROGRAM - len(ROWS)
    nowhere = np.arange(ROWS_PER_PROGRAM) == ROWS_PER_PROGRAM - 1
    assert _filling(rows._replace(no_orbit=nowhere)) == 0


def test_residuals_are_misfits_in_errors_and_the_constraint(linear):
    predicted = np.stack([amplitudes(drive, VALUES) for drive in ROWS])
    misfit = np.where(np.isfinite(MEASURED), (predicted - MEASURED) / ERRORS, 0.0)
    residual = np.asarray(linear.residual[0])
    # two amplitudes of each padded row, a residual for each where no orbit was seen, three constraints
    assert residual.shape == (3 * ROWS_PER_PROGRAM + 3,)
    np.testing.assert_allclose(residual[: 2 * len(ROWS)].reshape(-1, 2), misfit, rtol=1e-8, atol=1e-10)
    np.testing.assert_array_equal(residual[2 * len(ROWS) : -1], 0.0)
    assert residual[-1] == pytest.approx((38.0 - 40.0) / 4.0, rel=1e-14)


@pytest.mark.parametrize("column", range(3))
def test_jacobian_is_that_of_differences(linear, column):
    name = list(VALUES)[column]
    step = 1e-4 * VALUES[name]
    found = np.asarray(linear.jacobian[0, :, column])
    for row in range(3):
        ahead, behind = (amplitudes(ROWS[row], VALUES | {name: VALUES[name] + h}) for h in (step, -step))
        slope = (ahead - behind) / (2 * step)
        expected = np.where(np.isfinite(ERRORS[row]), slope / ERRORS[row], 0.0)
        # Differences: 1e-8 of the value times its third logarithmic derivative.
        np.testing.assert_allclose(found[2 * row : 2 * row + 2], expected, rtol=1e-4)
    assert found[-1] == (0.25 if name == "quality_factor" else 0.0)
