"""From parameters to predicted amplitudes: each row's steady single-impact orbit, on the branch that was measured."""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from afm_jax.apparatus.cantilever import Cantilever
from afm_jax.apparatus.platform import Platform
from afm_jax.impact.orbit_closure import OrbitProblem, speeds_at
from afm_jax.impact.orbit_state import amplitudes, steady_orbits
from fitting.models import Problem
from fitting.table import AmplitudeTable

_ROWS_PER_PROGRAM = 32
"""Rows are padded to multiples of this, so that tables of similar size share one compiled program."""


class Rows(NamedTuple):
    """A table as arrays of shape (rows,), and measured values and errors of shape (rows, 2): peak, lock-in.

    What was not measured, and every padded row, has ``measured`` False; its value and error are 1.
    """

    order: Float[Array, " rows"]
    drive_frequency_khz: Float[Array, " rows"]
    drive_amplitude_nm: Float[Array, " rows"]
    offset_nm: Float[Array, " rows"]
    amplitude_nm: Float[Array, "rows 2"]
    error_nm: Float[Array, "rows 2"]
    measured: Bool[Array, "rows 2"]


class Measurement(NamedTuple):
    """Everything a prediction is compared with: the rows, the cantilever, and what constrains its quality factor."""

    rows: Rows
    cantilever: Cantilever
    quality_factor: Float[Array, ""]
    quality_factor_error: Float[Array, ""]


class Prediction(NamedTuple):
    """Predicted amplitudes of shape (rows, 2), 0 where there is no orbit; the rest has shape (rows,).

    ``orbits`` counts the stable admissible orbits; ``near_fold`` and ``approach_speed_nm_per_us`` are those of the
    chosen one.
    """

    amplitude_nm: Float[Array, "rows 2"]
    orbits: Int[Array, " rows"]
    near_fold: Bool[Array, " rows"]
    approach_speed_nm_per_us: Float[Array, " rows"]


def measurement_of(table: AmplitudeTable) -> Measurement:
    """Return a table as padded arrays (float64)."""
    size = -(-table.rows // _ROWS_PER_PROGRAM) * _ROWS_PER_PROGRAM

    def padded(column, filler=None):
        column = np.asarray(column, float)
        filler = column[-1] if filler is None else filler
        return jnp.asarray(np.concatenate([column, np.full(size - column.shape[0], filler)]))

    def pair(peak, lockin):
        columns = [np.full(table.rows, np.nan) if c is None else c for c in (peak, lockin)]
        return jnp.stack([padded(column, np.nan) for column in columns], axis=1)

    amplitude = pair(table.peak_amplitude_nm, table.lockin_amplitude_nm)
    error = pair(table.peak_amplitude_error_nm, table.lockin_amplitude_error_nm)
    measured = jnp.isfinite(amplitude)
    quality_factor = table.quality_factor
    return Measurement(
        rows=Rows(
            order=padded(table.order),
            drive_frequency_khz=padded(table.drive_frequency_khz),
            drive_amplitude_nm=padded(table.drive_amplitude_nm),
            offset_nm=padded(table.offset_nm),
            amplitude_nm=jnp.where(measured, amplitude, 1.0),
            error_nm=jnp.where(measured, error, 1.0),
            measured=measured,
        ),
        cantilever=Cantilever(table.free_frequency_khz, quality_factor, table.mass_ng),
        quality_factor=jnp.asarray(1.0 if quality_factor is None else float(quality_factor)),
        quality_factor_error=jnp.asarray(1.0 if table.quality_factor_error is None else table.quality_factor_error),
    )


def predict(values: Float[Array, " p"], measurement: Measurement, problem: Problem) -> Prediction:
    """Return the amplitudes that parameters predict for every row.

    Of a row's stable admissible orbits (there can be several) the one that explains its measured amplitudes best
    counts; a row without any is predicted as 0, which misses the measurement by all of it: a fixed penalty.
    Derivatives run through the orbit by the implicit function theorem.
    """
    law = problem.law(values)
    cantilever = problem.cantilever(values, measurement.cantilever)

    def one(row: Rows) -> Prediction:
        platform = Platform(row.drive_amplitude_nm, row.drive_frequency_khz, row.offset_nm)
        orbit = OrbitProblem(cantilever, platform, law, row.order)
        roots = steady_orbits(orbit)
        # Choosing the branch needs no derivatives; the chosen one gets them below.
        candidates = jax.vmap(amplitudes, in_axes=(0, None))(roots.coordinate, lax.stop_gradient(orbit))
        misfit = jnp.where(row.measured, (candidates - row.amplitude_nm) / row.error_nm, 0.0)
        slot = jnp.argmin(jnp.where(roots.steady, jnp.sum(misfit**2, axis=1), jnp.inf))
        exists, coordinate = roots.steady[slot], roots.coordinate[slot]
        return Prediction(
            amplitude_nm=jnp.where(exists, amplitudes(coordinate, orbit), 0.0),
            orbits=jnp.sum(roots.steady, dtype=jnp.int32),
            near_fold=exists & roots.near_double[slot],
            approach_speed_nm_per_us=speeds_at(coordinate, law).approach,
        )

    return jax.vmap(one)(measurement.rows)


def residuals(
    values: Float[Array, " p"], measurement: Measurement, problem: Problem
) -> tuple[Float[Array, " n"], Prediction]:
    """Return the normalised residuals (predicted - measured)/error of all amplitudes and of the constraint on Q.

    Shape (2 rows + 1,); 0 where nothing was measured. The sum of squares is chi2. The prediction comes beside them.
    """
    rows = measurement.rows
    prediction = predict(values, measurement, problem)
    misfit = jnp.where(rows.measured, (prediction.amplitude_nm - rows.amplitude_nm) / rows.error_nm, 0.0)
    constraint = jnp.zeros(1, values.dtype)
    if "quality_factor" in problem.names:
        fitted = values[problem.names.index("quality_factor")]
        constraint = ((fitted - measurement.quality_factor) / measurement.quality_factor_error)[None]
    return jnp.concatenate([misfit.ravel(), constraint]), prediction


class Linearised(NamedTuple):
    """Residuals (sets, n), their Jacobian by the parameters' values (sets, n, p), and predictions (sets, ...)."""

    residual: Float[Array, "sets n"]
    jacobian: Float[Array, "sets n p"]
    prediction: Prediction


@partial(jax.jit, static_argnames=("problem",))
def linearise(values: Float[Array, "sets p"], measurement: Measurement, problem: Problem) -> Linearised:
    """Return residuals, their Jacobian (forward mode through the implicit roots) and predictions for several sets."""

    def one(point):
        def twice(v):
            value, prediction = residuals(v, measurement, problem)
            return value, (value, prediction)

        jacobian, (value, prediction) = jax.jacfwd(twice, has_aux=True)(point)
        return Linearised(value, jacobian, prediction)

    return jax.vmap(one)(values)
