"""From parameters to predicted amplitudes: each row's steady single-impact orbit, on the branch that was measured."""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from afm_jax.impact.lasting_impact import LawImpact, TabulatedImpact
from afm_jax.impact.orbit_closure import OrbitProblem
from afm_jax.impact.orbits import amplitudes
from fitting.measurement import Measurement, Rows
from fitting.models import Problem
from fitting.row_orbits import Branch, branch_near, branch_of, followed, impact_of, orbit_problem

BATCH = 8
"""Sets of parameters that `linearise` takes at once."""
LANES = 256
"""Pairs of a set and a row that one program takes."""
CENSORED = 3.0
"""Residual of a row where no orbit was seen and the model has a steady one: e^(-9/2), a probability of 1 %."""


class Prediction(NamedTuple):
    """Predicted amplitudes of shape (rows, 2), 0 where there is no orbit; the rest has shape (rows,).

    ``orbits`` counts the stable admissible orbits (where roots are followed: whether there is one); ``coordinate``,
    ``near_fold`` and ``approach_speed_nm_per_us`` are those of the chosen one.
    """

    amplitude_nm: Float[Array, "rows 2"]
    orbits: Int[Array, " rows"]
    near_fold: Bool[Array, " rows"]
    approach_speed_nm_per_us: Float[Array, " rows"]
    coordinate: Float[Array, " rows"]


class Linearised(NamedTuple):
    """Residuals (sets, n), their Jacobian by the parameters' values (sets, n, p), and predictions (sets, ...).

    First (predicted - measured)/error of all amplitudes, row by row, 0 where nothing was measured; then a residual for
    every row where no orbit was seen, 0 if the model has none; then the constraint on each parameter, 0 where there is
    none. The sum of their squares is chi2.
    """

    residual: Float[np.ndarray, "sets n"]
    jacobian: Float[np.ndarray, "sets n p"]
    prediction: Prediction


def linearise(
    values: Float[np.ndarray, "sets p"],
    measurement: Measurement,
    problem: Problem,
    near: Float[np.ndarray, " rows"] | Float[np.ndarray, "sets rows"] | None = None,
) -> Linearised:
    """Return residuals, their Jacobian (forward mode through the implicit roots) and predictions for several sets.

    Three programs share the work, so that each is compiled once and run only where it is needed: what an impact does at
    every set, where the orbits are, and the amplitudes with their slopes there. Pairs of a set and a row are taken
    `LANES` at a time: the same programs serve tables of every size.

    Args:
        values: the parameters' values, at most `BATCH` sets.
        measurement: what they are compared with.
        problem: the model.
        near: coordinates of the orbits at parameters close by, NaN where there is none, for each row or for each set
            and row: orbits are followed from there instead of searched for, which takes a tenth of the time and says
            nothing of admissible and stable. Impacts that last only.
    """
    values = np.asarray(values)
    sets, count = values.shape
    rows = measurement.rows.order.shape[0]
    filled = np.concatenate([values, np.repeat(values[-1:], BATCH - sets, axis=0)])
    impacts = impacts_of(filled, measurement, problem)
    columns = jax.tree.map(np.asarray, measurement.rows)
    known = None if near is None else np.broadcast_to(np.asarray(near), (sets, rows)).ravel()
    blocks = []
    for begin in range(0, sets * rows, LANES):
        # the last block is filled up with the last pair
        lane = np.minimum(np.arange(begin, begin + LANES), sets * rows - 1)
        some = measurement._replace(rows=jax.tree.map(lambda column, row=lane % rows: column[row], columns))
        index = lane // rows
        branch = branch_near(known[lane]) if known is not None else located(filled, impacts, index, some, problem)
        blocks.append(jax.tree.map(np.asarray, linearise_pairs(filled, impacts, index, some, problem, branch)))
    whole: _Block = jax.tree.map(
        lambda *parts: np.concatenate(parts)[: sets * rows].reshape(sets, rows, *parts[0].shape[1:]), *blocks
    )
    misfit, unseen = np.asarray(whole.misfit).reshape(sets, -1), np.asarray(whole.unseen)
    strength = 1.0 / np.asarray(measurement.constraint_error)
    constraint = (values - np.asarray(measurement.constraint_value)) * strength
    pulls = np.broadcast_to(np.diag(strength), (sets, count, count))
    flat = np.asarray(whole.slope).reshape(sets, 2 * rows, count)
    return Linearised(
        residual=np.concatenate([misfit, unseen, constraint], axis=1),
        jacobian=np.concatenate([flat, np.zeros((sets, rows, count)), pulls], axis=1),
        prediction=whole.prediction,
    )


class _Block(NamedTuple):
    """Misfits and their slopes, residuals of rows without orbit, and predictions, for each pair of a set and a row."""

    misfit: Float[Array, "lanes 2"]
    slope: Float[Array, "lanes 2 p"]
    unseen: Float[Array, " lanes"]
    prediction: Prediction


class _Impacts(NamedTuple):
    """What an impact does at each set of values, and its derivatives by each parameter along a second axis."""

    impact: LawImpact | TabulatedImpact
    slopes: LawImpact | TabulatedImpact


@partial(jax.jit, static_argnames="problem")
def impacts_of(values: Float[Array, "sets p"], measurement: Measurement, problem: Problem) -> _Impacts:
    """Return the law, or the table of the contact, of several sets of values."""
    return _Impacts(*jax.vmap(lambda v: _impact_and_slopes(v, measurement, problem))(values))


@partial(jax.jit, static_argnames="problem")
def located(
    values: Float[Array, "sets p"],
    impacts: _Impacts,
    index: Int[Array, " lanes"],
    measurement: Measurement,
    problem: Problem,
) -> Branch:
    """Return the orbit that each pair of a row and the set that its index names is on."""

    def one(point: Float[Array, " p"], impact, row: Rows) -> Branch:
        return branch_of(orbit_problem(point, impact, row, measurement, problem), row)

    points, impact = jax.tree.map(lambda leaf: leaf[index], (values, impacts.impact))
    return jax.vmap(one)(points, impact, measurement.rows)


@partial(jax.jit, static_argnames="problem")
def linearise_pairs(
    values: Float[Array, "sets p"],
    impacts: _Impacts,
    index: Int[Array, " lanes"],
    measurement: Measurement,
    problem: Problem,
    branch: Branch,
) -> _Block:
    """Return misfits and slopes of pairs of a row and the set of values that its index names, on given orbits."""

    # One vmap over all pairs, not two nested ones: tracing costs as much as a fit otherwise.
    def one(point: Float[Array, " p"], impact, slope, row: Rows, known: Branch):
        orbit = orbit_problem(point, impact, row, measurement, problem)
        branch = followed(orbit, known) if orbit.impact.lasts else known

        def predict(v, impact):
            return _prediction(branch, v, orbit_problem(v, impact, row, measurement, problem), problem)

        def along(e, turn):
            predicted, change = jax.jvp(predict, (point, impact), (e, turn))
            return change.amplitude_nm, predicted

        return jax.vmap(along, out_axes=(-1, None))(jnp.eye(point.shape[0]), slope)

    points, impact, slopes = jax.tree.map(lambda leaf: leaf[index], (values, *impacts))
    rows = measurement.rows
    slope, prediction = jax.vmap(one)(points, impact, slopes, rows, branch)
    # far from any law (a start of the search) a root can be no motion at all: no orbit there
    sound = jnp.isfinite(prediction.amplitude_nm).all(axis=1) & jnp.isfinite(slope).all(axis=(1, 2))
    slope = jnp.where(sound[:, None, None], slope, 0.0)
    prediction = prediction._replace(
        amplitude_nm=jnp.where(sound[:, None], prediction.amplitude_nm, 0.0),
        orbits=jnp.where(sound, prediction.orbits, 0),
    )
    weight = jnp.where(rows.measured, 1.0 / rows.error_nm, 0.0)
    return _Block(
        misfit=weight * (prediction.amplitude_nm - rows.amplitude_nm),
        slope=weight[:, :, None] * slope,
        unseen=jnp.where(rows.no_orbit & (prediction.orbits > 0), CENSORED, 0.0),
        prediction=prediction,
    )


def _impact_and_slopes(values: Float[Array, " p"], measurement: Measurement, problem: Problem) -> tuple[Any, Any]:
    """Return the impact, and its derivatives by each parameter along a first axis."""

    def turned(e):
        return jax.jvp(lambda v: impact_of(v, measurement, problem), (values,), (e,))

    # The derivatives by a nuisance are zeros: not worth another program.
    return impact_of(values, measurement, problem), jax.vmap(lambda e: turned(e)[1])(jnp.eye(values.shape[0]))


def _prediction(branch: Branch, values: Float[Array, " p"], orbit: OrbitProblem, problem: Problem) -> Prediction:
    amplitude = amplitudes(branch.place, orbit)[:2]
    speed = orbit.impact.speeds(branch.place.coordinate).approach
    return Prediction(
        amplitude_nm=jnp.where(
            branch.exists, amplitude * problem.nuisance(values, "tip_calibration", 1.0), jnp.zeros_like(amplitude)
        ),
        orbits=branch.orbits,
        near_fold=branch.near_fold,
        approach_speed_nm_per_us=lax.stop_gradient(speed),
        coordinate=branch.place.coordinate,
    )
