"""Predicted readings of a table's rows and their derivatives, against the reference's orbits and finite differences."""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fitting import read_table
from fitting.examples.make_contact_amplitudes import EXAMPLE
from fitting.infer.fit import model_of
from fitting.infer.instantaneous import Chi2
from fitting.infer.rows import plain_weights, remainders_of
from fitting.infer.search import orbits_at
from fitting.infer.unknowns import Model
from fitting.models import task_of
from fitting.parameters import DELAY_NAMES
from fitting.predict.law import SMOOTH, FormulaLaw
from fitting.tables.table import AmplitudeTable
from tests.fit_tables import rows as some_rows
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


def model_for(table: AmplitudeTable, name: str, **options: Any) -> Model:
    """Return what is unknown of a table by a model."""
    return model_of(table, task_of(table, name, **options), {"fixed": {}, "held": ()})


def unknowns(values: dict[str, float]) -> np.ndarray:
    """Return 1 - r^2, epsilon, and Q in relative errors of a tenth."""
    return np.array([1.0 - values["r"] ** 2, values["epsilon"], 10.0 * np.log(values["quality_factor"] / 40.0)])


@pytest.fixture(scope="module")
def model() -> Model:
    return model_for(table(), "law")


def test_predictions_are_the_orbits_amplitudes(model):
    seen, number = Chi2(model, plain_weights(model.data, 0.0, np.zeros(len(ROWS), bool))).at(unknowns(VALUES))[0]
    for row, drive in enumerate(ROWS):
        # 20,001 samples and a parabola in the reference's peak.
        np.testing.assert_allclose(seen.readings[row, :2], amplitudes(drive, VALUES), rtol=1e-9)
    assert number.tolist() == [1, 1, 1, 0]
    (orbit,) = [o for o in single_impact_orbits(parameters(ROWS[0], VALUES), 1) if o.stable and o.admissible]
    assert seen.approach[0] == pytest.approx(float(orbit.approach_speed_nm_per_us), rel=1e-10)
    assert np.isnan(seen.approach[-1])


def residuals(model: Model, values: dict[str, float], soft: float = np.inf) -> tuple[np.ndarray, np.ndarray]:
    weights = plain_weights(model.data, 0.0, np.zeros(len(ROWS), bool))
    return Chi2(model, weights, soft).at(unknowns(values))[1:]


def test_residuals_are_misfits_in_errors_and_the_constraint(model):
    residual, _ = residuals(model, VALUES)
    predicted = np.stack([amplitudes(drive, VALUES) for drive in ROWS])
    misfit = np.where(np.isfinite(MEASURED), (predicted - MEASURED) / ERRORS, 0.0)
    # peak, lock-in and phase of each row, one for each where no orbit was seen, and three constraints
    assert residual.shape == (4 * len(ROWS) + 3,)
    of_rows = residual[: 3 * len(ROWS)].reshape(-1, 3)
    np.testing.assert_allclose(of_rows[:, :2], misfit, rtol=1e-8, atol=1e-10)
    assert not np.any(of_rows[:, 2])
    np.testing.assert_array_equal(residual[3 * len(ROWS) : -1], 0.0)
    assert residual[-1] == pytest.approx(np.log(38.0 / 40.0) / 0.1, rel=1e-12)
    # a robust fit looks for outliers by the sum of 2 s^2 (sqrt(1 + x^2/s^2) - 1) over rows
    softened = residuals(model, VALUES, 2.0)[0]
    size = np.sum(misfit**2, axis=1)
    wanted = np.sum(8.0 * (np.sqrt(1.0 + size / 4.0) - 1.0)) + residual[-1] ** 2
    assert softened @ softened == pytest.approx(wanted, rel=1e-9)


@pytest.mark.parametrize("soft", [2.0, 0.3])
def test_jacobian_of_softened_residuals_is_that_of_differences(model, soft):
    _, jacobian = residuals(model, VALUES, soft)
    slopes = [-2.0 * VALUES["r"], 1.0, 10.0 / VALUES["quality_factor"]]
    for column, (name, value) in enumerate(VALUES.items()):
        step = 1e-5 * value
        ahead, behind = (residuals(model, VALUES | {name: value + h}, soft)[0] for h in (step, -step))
        expected = (ahead - behind) / (2.0 * step)
        np.testing.assert_allclose(jacobian[:, column] * slopes[column], expected, rtol=1e-5, atol=1e-7)


LASTING = {
    "epsilon": 110.0,
    "viscous_loss": 0.6,
    **dict(zip(DELAY_NAMES, (0.2, 5.5, 0.7), strict=True)),
}
TAPPED = Path("fitting/examples/tapping_contact.csv")
"""Of a tip of 16.8 ng."""
OF_TAPPED = LASTING | {"epsilon": 1.9, "viscous_loss": 0.1, "delay_hertz": 0.63}
_KNOWN = {
    "quality_factor": (40.0, 1.0),
    "tip_calibration": (1.0, 0.02),
    "drive_calibration": (1.0, 0.02),
    "offset_origin_nm": (0.0, 0.3),
    "free_frequency_khz": (90.0, 0.02),
    "phase_zero_deg": (0.0, 0.5),
}


def lasting_table(drive: str) -> AmplitudeTable:
    """Return amplitudes and phases in order of time: of the bundled contact tables, every quantity an unknown."""
    sample = drive == "sample"
    whole = read_table(EXAMPLE if sample else TAPPED)
    part = some_rows(whole, slice(0, None, 5 if sample else 2))
    known = {name: pair for name, pair in _KNOWN.items() if not (sample and name == "offset_origin_nm")}
    quality, error = known.pop("quality_factor") if sample else (200.0, 2.0)
    changes = {"drive": drive, "quality_factor": quality, "quality_factor_error": error}
    changes |= {"free_frequency_error_khz": known.pop("free_frequency_khz")[1], "calibration": known}
    return dataclasses.replace(part, **changes, rows_in_order_of_time=True)


@pytest.fixture(scope="module", params=["sample", "force", "base"])
def lasting(request) -> tuple[Model, np.ndarray]:
    """A law with smooth functions and remainders, unknowns away from their means, and the instrument's."""
    table = lasting_table(request.param)
    begin = model_for(table, "viscous+delay")
    assert isinstance(begin.law, FormulaLaw)
    law = begin.law.beside((20.0, 250.0), SMOOTH)
    whole = dataclasses.replace(begin, law=law, remainders=np.zeros((2, table.rows, 7)))
    theta = 0.3 * np.random.default_rng(4).normal(size=len(whole.names))
    values = LASTING if request.param == "sample" else OF_TAPPED
    theta[: len(law.own)] = [law.unknown_of(name, values[name]) for name in law.own]
    found = orbits_at(whole, theta)
    return dataclasses.replace(whole, remainders=remainders_of(whole, theta, found.orbits)), theta


@pytest.mark.slow
def test_slopes_of_readings_are_those_of_orbits_that_are_searched_for_anew(lasting):
    model, theta = lasting
    there = orbits_at(model, theta)
    slopes, rows = model.slopes(theta, there.orbits), there.exists & ~model.data.row.free
    assert {"phase_drift_deg", "tip_calibration", "remainder_6", "loss_0"} <= set(model.names)
    assert rows.sum() >= 8
    step = 1e-4
    for k, name in enumerate(model.names):
        ahead, behind = (orbits_at(model, theta + side * np.eye(theta.size)[k]) for side in (step, -step))
        both = rows & ahead.exists & behind.exists
        # one may be about to end
        assert both.sum() >= rows.sum() - 1
        expected = (ahead.orbits.readings - behind.orbits.readings)[both] / (2.0 * step)
        # nm and degrees per standard error: Newton's method leaves 1e-9 of them
        np.testing.assert_allclose(slopes[both, :, k], expected, rtol=2e-5, atol=2e-5, err_msg=name)
