"""Amplitude tables for the tests of the fit: the bundled one, parts of it, and tables of another law."""

import dataclasses
from collections.abc import Iterable
from functools import cache
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import fitting.examples
from afm_jax.apparatus.cantilever import Cantilever
from afm_jax.apparatus.platform import Platform
from afm_jax.apparatus.scene import Scene
from afm_jax.impact.law import ImpactLaw
from afm_jax.impact.orbits import single_impact_orbits
from fitting import fit
from fitting.infer.fit import model_of
from fitting.infer.result import FitResult, FittedParameter, WithInterval
from fitting.infer.unknowns import Model
from fitting.models import task_of
from fitting.tables.table import AmplitudeTable, read_table

EXAMPLE = Path(fitting.examples.__path__[0]) / "amplitudes_law.csv"
NOISE = 0.01


def example_amplitudes() -> AmplitudeTable:
    """Return the bundled table without its phases."""
    return dataclasses.replace(read_table(EXAMPLE), phase_deg=None, phase_error_deg=None)


@cache
def example_fit() -> FitResult:
    """Return the fit of the bundled table without its phases: made once for all tests of a process, which only read."""
    return fit(example_amplitudes(), model="law")


@pytest.fixture(scope="session")
def table() -> AmplitudeTable:
    """The bundled table without its phases."""
    return example_amplitudes()


@pytest.fixture(scope="session")
def law() -> FitResult:
    """Its fit; tests only read it."""
    return example_fit()


@pytest.fixture(scope="session")
def model() -> Model:
    """What is unknown of it by the law; tests only ask it."""
    whole = example_amplitudes()
    return model_of(whole, task_of(whole, "law"), {"fixed": {}, "held": ()})


@cache
def fit_of_every_fourth() -> FitResult:
    """Return the fit of a law's amplitudes with noise of 1 % at every fourth drive of the bundled table."""
    example = example_amplitudes()
    return fit(simulated(rows(example, slice(0, None, 4)), ImpactLaw(0.95, 60.0), seed=8), "law")


def rows(table: AmplitudeTable, keep: slice | np.ndarray, **changes: Any) -> AmplitudeTable:
    """Return some rows of a table, with changed values."""
    columns = {
        field.name: getattr(table, field.name)[keep]
        for field in dataclasses.fields(table)
        if isinstance(getattr(table, field.name), np.ndarray)
    }
    return dataclasses.replace(table, **(columns | changes))


def with_amplitudes(table: AmplitudeTable, amplitude: np.ndarray, error: np.ndarray, **changes: Any) -> AmplitudeTable:
    """Return a table with other peak and lock-in amplitudes and their errors, both of shape (rows, 2); no phases."""
    return dataclasses.replace(
        dataclasses.replace(table, phase_deg=None, phase_error_deg=None),
        peak_amplitude_nm=amplitude[:, 0],
        lockin_amplitude_nm=amplitude[:, 1],
        peak_amplitude_error_nm=error[:, 0],
        lockin_amplitude_error_nm=error[:, 1],
        **changes,
    )


def amplitudes_and_errors(table: AmplitudeTable) -> tuple[np.ndarray, np.ndarray]:
    """Return peak and lock-in amplitude of a table that has both, and their errors, each of shape (rows, 2)."""
    names = (("peak_amplitude_nm", "lockin_amplitude_nm"), ("peak_amplitude_error_nm", "lockin_amplitude_error_nm"))
    amplitude, error = (np.stack([getattr(table, name) for name in pair], axis=1) for pair in names)
    return amplitude, error


def table_of(drives: Iterable[Any], amplitude: np.ndarray, error: np.ndarray, **changes: Any) -> AmplitudeTable:
    """Return the table of a cantilever of 90 kHz and Q = 40.

    Args:
        drives: order, frequency in kHz, amplitude and offset in nm: four columns.
        amplitude: peak and lock-in amplitude in nm, shape (rows, 2).
        error: of these.
        changes: columns and settings besides, or in place of those.
    """
    order, *others = (np.asarray(column, dtype=float) for column in drives)
    columns: dict[str, Any] = dict(zip(("drive_frequency_khz", "drive_amplitude_nm", "offset_nm"), others, strict=True))
    columns |= {"peak_amplitude_nm": amplitude[:, 0], "peak_amplitude_error_nm": error[:, 0]}
    columns |= {"lockin_amplitude_nm": amplitude[:, 1], "lockin_amplitude_error_nm": error[:, 1]}
    known = {"order": order.astype(np.int64), "free_frequency_khz": 90.0, "quality_factor": 40.0}
    return AmplitudeTable(**(columns | known | changes))


READINGS = (
    "peak_amplitude_nm",
    "lockin_amplitude_nm",
    "lockin_phase_deg",
    "approach_speed_nm_per_us",
    "rebound_speed_nm_per_us",
)


def steady_readings(drives: Iterable[Any], law: ImpactLaw, quality_factor: float | None = 40.0) -> np.ndarray:
    """Return `READINGS` of the one steady orbit of each drive, as in `table_of`, shape (rows, 5); NaN without any."""
    cantilever = Cantilever(90.0, quality_factor)
    columns = [jnp.asarray(column, dtype=float) for column in drives]
    steady, readings = (np.asarray(a) for a in _orbits(cantilever, law, *columns))
    assert np.all(steady.sum(axis=1) <= 1)
    first = readings[np.arange(len(readings)), np.argmax(steady, axis=1)]
    return np.where(np.any(steady, axis=1, keepdims=True), first, np.nan)


def steady_amplitudes(table: AmplitudeTable, law: ImpactLaw, quality_factor: float = 40.0) -> np.ndarray:
    """Return peak and lock-in amplitude (rows, 2) of each row's one steady orbit; NaN where there is none."""
    assert table.free_frequency_khz == 90.0
    drives = (table.order, table.drive_frequency_khz, table.drive_amplitude_nm, table.offset_nm)
    return steady_readings(drives, law, quality_factor)[:, :2]


def chi2_residuals(table: AmplitudeTable, r: float, epsilon: float, quality_factor: float) -> np.ndarray:
    """Return (amplitude - read)/error of a table by the paper's map, amplitudes without an orbit 0, and ln Q's own."""
    amplitude, error = amplitudes_and_errors(table)
    predicted = np.nan_to_num(steady_amplitudes(table, ImpactLaw(r, epsilon), quality_factor))
    assert table.quality_factor is not None
    assert table.quality_factor_error is not None
    of_q = np.log(quality_factor / table.quality_factor) / (table.quality_factor_error / table.quality_factor)
    return np.append(((predicted - amplitude) / error).ravel(), of_q)


@jax.jit
def _orbits(cantilever: Cantilever, law: ImpactLaw, *drives: jax.Array):
    def one(order, frequency_khz, drive_nm, offset_nm):
        orbits = single_impact_orbits(Scene(cantilever, Platform(drive_nm, frequency_khz, offset_nm), law), order)
        readings = jnp.stack([getattr(orbits, name) for name in READINGS], axis=-1)
        return orbits.stable & orbits.admissible, readings

    return jax.vmap(one)(*drives)


def simulated(table: AmplitudeTable, law: ImpactLaw, *, seed: int | None) -> AmplitudeTable:
    """Return the amplitudes of a law at a table's drives, with 1 % errors and as much noise (none without a seed).

    Drives without a steady orbit are left out.
    """
    clean = steady_amplitudes(table, law)
    kept = np.isfinite(clean[:, 0])
    clean = clean[kept]
    noise = 0.0 if seed is None else np.random.default_rng(seed).normal(size=clean.shape)
    return with_amplitudes(rows(table, kept), clean * (1.0 + NOISE * noise), NOISE * clean)


def values_of(result: FitResult) -> np.ndarray:
    """Return the fitted values in the order of the parameters."""
    return np.array([parameter.value for parameter in result.parameters.values()])


def standard_errors_of(result: FitResult) -> np.ndarray:
    """Return the standard errors in the order of the parameters; NaN where there is none."""
    return np.array([parameter.standard_error or np.nan for parameter in result.parameters.values()])


def holds(parameter: FittedParameter | WithInterval, value: float) -> bool:
    """Whether an interval with two ends holds a value."""
    low, high = parameter.interval95
    return low is not None and high is not None and low < value < high
