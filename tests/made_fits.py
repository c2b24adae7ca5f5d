"""Results of fits made by hand, without a fit: every kind that a report must be able to show."""

import dataclasses
from typing import Any

import numpy as np

from afm_jax.impact.law import CollisionDelay, ImpactLaw
from afm_jax.units import TWO_SIDED_95
from fitting.infer.law import LawWithErrors
from fitting.infer.result import Convergence, FitResult, FittedLaw, FittedParameter, FittedRows
from fitting.parameters import DELAY_NAMES, PARAMETERS
from fitting.tables.table import AmplitudeTable
from tests.fit_tables import amplitudes_and_errors, table_of

VALUES = {
    "restitution": {"r": 0.93},
    "law": {"r": 0.987654321, "epsilon": 61.23456789},
    "viscous": {"epsilon": 0.0, "viscous_loss": 0.58371},
    "law+delay": {"r": 0.998316817, "epsilon": 108.9187}
    | dict(zip(DELAY_NAMES, (0.2036519, -6.14712, 0.575123), strict=True)),
    "contact": {"relative_humidity": 0.479, "viscosity_pa_s": 1.08e-3},
}
SPEEDS = np.array([24.0, 40.0, 95.0, 260.0])


def made_fit(model: str, *, width: float = 1e-3, table: AmplitudeTable | None = None, **changes: Any) -> FitResult:
    """Return a valid fit of a model to four rows whose law has a band of a constant relative half-width.

    Args:
        model: a key of `VALUES`.
        width: half-width of the bands of rebound speed and delay, relative.
        table: the table; None for one of four rows.
        changes: fields of the result to be replaced.
    """
    table = made_table() if table is None else table
    names = VALUES[model]
    size = len(names)
    result = FitResult(
        model=model,
        parameters={name: made_parameter(name, value) for name, value in names.items()},
        correlations=np.full((size, size), 0.95) + 0.05 * np.eye(size),
        chi2=5.0,
        degrees_of_freedom=6,
        p_value=0.54,
        aic=9.0,
        valid=True,
        reasons=[],
        warnings=[],
        law=made_law(names, width=width, lasting="+" in model or model == "contact"),
        rows=made_rows(table),
        convergence=Convergence(True, "optax.lbfgs 0.2", 20, 1e-6, 1e-12),  # noqa: FBT003
        table=table,
        settings={"model": model, "error_scale": None, "constraints": {"quality_factor": (40.0, 0.4)}},
        versions={"afm-jax": "0.0"},
    )
    return dataclasses.replace(result, **changes)


def made_parameter(name: str, value: float, **changes: Any) -> FittedParameter:
    """Return a parameter with one per cent of error; a loss of zero is at its bound."""
    bound = value == 0.0
    error = None if bound else 0.01 * abs(value)
    interval = (None, 0.3) if bound else (value - 0.02 * abs(value), value + 0.02 * abs(value))
    parameter = FittedParameter(
        value=3e-15 if bound else value,
        unit=PARAMETERS[name].unit,
        standard_error=error,
        interval95=interval,
        interval_reason="lower end: reaches the end of its range, 0" if bound else None,
        interval_kind="limit" if bound else "profile",
        undetermined=False,
        at_bound=bound,
        constraint=None,
    )
    return dataclasses.replace(parameter, **changes)


def made_law(values: dict[str, float], *, width: float, lasting: bool) -> FittedLaw:
    """Return the law of the parameters from 0.8 times the slowest to 1.2 times the fastest row."""
    law = ImpactLaw(values.get("r", 1.0), values.get("epsilon", 0.0), values.get("viscous_loss", 0.0))
    hertz, lead, offset = (values.get(name, 0.1) for name in DELAY_NAMES)
    late = CollisionDelay(hertz, lead, offset)

    def at(u: np.ndarray) -> LawWithErrors:
        w = np.asarray(law.rebound_speed(u))
        both = np.stack([w, np.asarray(late(u, w)) if lasting else np.zeros_like(u)])
        errors = width / TWO_SIDED_95 * np.abs(both)[:, :, None]
        return LawWithErrors(both, errors, float(law.capture_speed_nm_per_us), np.zeros(1))

    return FittedLaw(at, SPEEDS, delay=late if lasting else None, mass_ng=1.0, origin="made")


def made_table(rows: int = 4, **changes: Any) -> AmplitudeTable:
    """Return a table whose last amplitude was read by the lock-in only."""
    peak = np.linspace(50.0, 180.0, rows)
    peak[-1] = np.nan
    lockin = np.linspace(20.0, 80.0, rows)
    drives = np.ones(rows), np.linspace(170.0, 190.0, rows), np.full(rows, 4.0), np.full(rows, 1.0 / 3.0)
    amplitude = np.stack([peak, lockin], axis=1)
    known = {"quality_factor_error": 0.4, "mass_ng": 1.0, "remarks": ("measured on a Tuesday",)}
    return table_of(drives, amplitude, 0.01 * amplitude, **(known | changes))


def made_rows(table: AmplitudeTable) -> FittedRows:
    """Return rows that fit to half an error."""
    measured = amplitudes_and_errors(table)[0]
    error = 0.01 * measured
    return FittedRows(
        predicted_nm=measured + 0.5 * error,
        measured_nm=measured,
        residual=0.5 * error / error,
        error_nm=error,
        model_error=np.zeros(table.rows),
        used=np.ones(table.rows, dtype=bool),
        set_aside=np.zeros(table.rows, dtype=bool),
        approach_speed_nm_per_us=np.resize(SPEEDS, table.rows),
        orbits=np.ones(table.rows, dtype=np.int64),
        near_fold=np.zeros(table.rows, dtype=bool),
    )
