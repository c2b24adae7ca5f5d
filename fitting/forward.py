"""From parameters to predicted amplitudes: each row's steady single-impact orbit, on the branch that was measured."""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
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
        return np.concatenate([column, np.full(size - column.shape[0], filler)])

    def pair(peak, lockin):
        columns = [np.full(table.rows, np.nan) if c is None else c for c in (peak, lockin)]
        return np.stack([padded(column, np.nan) for column in columns], axis=1)

    # NumPy up to here: every JAX operation outside a compiled program would be compiled by itself.
    amplitude = pair(table.peak_amplitude_nm, table.lockin_amplitude_nm)
    error = pair(table.peak_amplitude_error_nm, table.lockin_amplitude_error_nm)
    measured = np.isfinite(amplitude)
    quality_factor = table.quality_factor
    return Measurement(
        rows=Rows(
            order=jnp.asarray(padded(table.order)),
            drive_frequency_khz=jnp.asarray(padded(table.drive_frequency_khz)),
            drive_amplitude_nm=jnp.asarray(padded(table.drive_amplitude_nm)),
            offset_nm=jnp.asarray(padded(table.offset_nm)),
            amplitude_nm=jnp.asarray(np.where(measured, amplitude, 1.0)),
            error_nm=jnp.asarray(np.where(measured, error, 1.0)),
            measured=jnp.asarray(measured),
        ),
        cantilever=Cantilever(table.free_frequency_khz, quality_factor, table.mass_ng),
        quality_factor=jnp.asarray(1.0 if quality_factor is None else float(quality_factor)),
        quality_factor_error=jnp.asarray(1.0 if table.quality_factor_error is None else table.quality_factor_error),
    )


class Linearised(NamedTuple):
    """Residuals (sets, n), their Jacobian by the parameters' values (sets, n, p), and predictions (sets, ...).

    The residuals are (predicted - measured)/error of all amplitudes, row by row, 0 where nothing was measured; the last
    one is the constraint on Q. The sum of their squares is chi2.
    """

    residual: Float[Array, "sets n"]
    jacobian: Float[Array, "sets n p"]
    prediction: Prediction


class _Branch(NamedTuple):
    """The orbit that a row is taken to be on: its coordinate, whether there is one, and how many there are."""

    coordinate: Float[Array, ""]
    exists: Bool[Array, ""]
    orbits: Int[Array, ""]
    near_fold: Bool[Array, ""]


@partial(jax.jit, static_argnames=("problem",))
def linearise(values: Float[Array, "sets p"], measurement: Measurement, problem: Problem) -> Linearised:
    """Return residuals, their Jacobian (forward mode through the implicit roots) and predictions for several sets."""
    sets, rows = values.shape[0], measurement.rows.order.shape[0]

    def one(point: Float[Array, " p"], row: Rows):
        branch = _branch(_orbit_problem(point, row, measurement, problem), row)

        def twice(v):
            prediction = _prediction(branch, _orbit_problem(v, row, measurement, problem))
            return prediction.amplitude_nm, prediction

        # The search stays outside the differentiation: a program that compiles in half the time.
        return jax.jacfwd(twice, has_aux=True)(point)

    # One vmap over all pairs of a set and a row, not two nested ones: tracing costs as much as a fit otherwise.
    every_row = jax.tree.map(lambda column: jnp.concatenate([column] * sets), measurement.rows)
    slope, prediction = jax.vmap(one)(jnp.repeat(values, rows, axis=0), every_row)
    weight = jnp.where(every_row.measured, 1.0 / every_row.error_nm, 0.0)
    misfit = weight * (prediction.amplitude_nm - every_row.amplitude_nm)
    constraint, constraint_slope = _constraint(values, measurement, problem)
    return Linearised(
        residual=jnp.concatenate([misfit.reshape(sets, -1), constraint[:, None]], axis=1),
        jacobian=jnp.concatenate(
            [(weight[:, :, None] * slope).reshape(sets, 2 * rows, -1), constraint_slope[:, None]], axis=1
        ),
        prediction=jax.tree.map(lambda leaf: leaf.reshape(sets, rows, *leaf.shape[1:]), prediction),
    )


def _orbit_problem(values: Float[Array, " p"], row: Rows, measurement: Measurement, problem: Problem) -> OrbitProblem:
    platform = Platform(row.drive_amplitude_nm, row.drive_frequency_khz, row.offset_nm)
    return OrbitProblem(problem.cantilever(values, measurement.cantilever), platform, problem.law(values), row.order)


def _branch(orbit: OrbitProblem, row: Rows) -> _Branch:
    """Choose among a row's steady orbits; no derivatives.

    There can be several: the one that explains the measured amplitudes best counts. A row without any is predicted as
    0, which misses the measurement by all of it: a fixed penalty.
    """
    roots = steady_orbits(orbit)
    misfit = jnp.where(row.measured, (roots.amplitude_nm - row.amplitude_nm) / row.error_nm, 0.0)
    slot = jnp.argmin(jnp.where(roots.steady, jnp.sum(misfit**2, axis=1), jnp.inf))
    return _Branch(
        coordinate=roots.coordinate[slot],
        exists=roots.steady[slot],
        orbits=jnp.sum(roots.steady, dtype=jnp.int32),
        near_fold=roots.steady[slot] & roots.near_double[slot],
    )


def _prediction(branch: _Branch, orbit: OrbitProblem) -> Prediction:
    return Prediction(
        amplitude_nm=jnp.where(branch.exists, amplitudes(branch.coordinate, orbit), 0.0),
        orbits=branch.orbits,
        near_fold=branch.near_fold,
        approach_speed_nm_per_us=speeds_at(branch.coordinate, orbit.law).approach,
    )


def _constraint(
    values: Float[Array, "sets p"], measurement: Measurement, problem: Problem
) -> tuple[Float[Array, " sets"], Float[Array, "sets p"]]:
    """Return the residual of the measured Q and its slope; 0 where Q is not a parameter."""
    if "quality_factor" not in problem.names:
        return jnp.zeros_like(values[:, 0]), jnp.zeros_like(values)
    index = problem.names.index("quality_factor")
    residual = (values[:, index] - measurement.quality_factor) / measurement.quality_factor_error
    return residual, jnp.zeros_like(values).at[:, index].set(1.0 / measurement.quality_factor_error)
