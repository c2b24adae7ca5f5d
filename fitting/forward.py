"""From parameters to predicted amplitudes: each row's steady single-impact orbit, on the branch that was measured."""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from afm_jax.apparatus.platform import Platform
from afm_jax.contact.contact import Contact
from afm_jax.impact.lasting_closure import LastingProblem
from afm_jax.impact.lasting_impact import LawImpact, TabulatedImpact
from afm_jax.impact.lasting_orbits import lasting_amplitudes, near_fold, steady_lasting_orbits
from afm_jax.impact.lasting_search import follow_lasting_root
from afm_jax.impact.orbit_closure import OrbitProblem, speeds_at
from afm_jax.impact.orbit_state import amplitudes, steady_orbits
from fitting.contact_table import tabulated
from fitting.measurement import Measurement, Rows
from fitting.models import Problem

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


class _Branch(NamedTuple):
    """The orbit that a row is taken to be on: its coordinate, whether there is one, and how many there are."""

    coordinate: Float[Array, ""]
    exists: Bool[Array, ""]
    orbits: Int[Array, ""]
    near_fold: Bool[Array, ""]


def linearise(
    values: Float[np.ndarray, "sets p"],
    measurement: Measurement,
    problem: Problem,
    near: Float[np.ndarray, " rows"] | None = None,
) -> Linearised:
    """Return residuals, their Jacobian (forward mode through the implicit roots) and predictions for several sets.

    Pairs of a set and a row are taken `LANES` at a time: one compiled program serves tables of every size.

    Args:
        values: the parameters' values, at most `BATCH` sets.
        measurement: what they are compared with.
        problem: the model.
        near: coordinates of the rows' orbits at parameters close by: roots are followed from there instead of searched
            for, which takes a hundredth of the time and says nothing of admissible and stable. Impacts that last only.
    """
    values = np.asarray(values)
    sets, count = values.shape
    rows = measurement.rows.order.shape[0]
    filled = np.concatenate([values, np.repeat(values[-1:], BATCH - sets, axis=0)])
    columns = jax.tree.map(np.asarray, measurement.rows)
    blocks = []
    for begin in range(0, sets * rows, LANES):
        # the last block is filled up with the last pair
        lane = np.minimum(np.arange(begin, begin + LANES), sets * rows - 1)
        some = jax.tree.map(lambda column, row=lane % rows: column[row], columns)
        start = None if near is None else np.asarray(near)[lane % rows]
        block = linearise_pairs(filled, lane // rows, measurement._replace(rows=some), problem, start)
        blocks.append(jax.tree.map(np.asarray, block))
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


@partial(jax.jit, static_argnames=("problem",))
def linearise_pairs(
    values: Float[Array, "sets p"],
    index: Int[Array, " lanes"],
    measurement: Measurement,
    problem: Problem,
    near: Float[Array, " lanes"] | None,
) -> _Block:
    """Return the pairs of a row and the set of values that its index names."""
    impacts, slopes = jax.vmap(lambda v: _impact_and_slopes(v, measurement, problem))(values)

    # One vmap over all pairs, not two nested ones: tracing costs as much as a fit otherwise.
    def one(point: Float[Array, " p"], impact, slope, row: Rows, start):
        orbit = orbit_problem(point, impact, row, measurement, problem)
        branch = branch_of(orbit, row) if start is None else _followed(orbit, start)

        def predict(v, impact):
            return _prediction(branch, v, orbit_problem(v, impact, row, measurement, problem), problem)

        # The search stays outside the differentiation: a program that compiles in half the time.
        predicted = predict(point, impact)
        along = jax.vmap(lambda e, turn: jax.jvp(predict, (point, impact), (e, turn))[1].amplitude_nm, out_axes=-1)
        return along(jnp.eye(point.shape[0]), slope), predicted

    points, impacts, slopes = jax.tree.map(lambda leaf: leaf[index], (values, impacts, slopes))
    rows = measurement.rows
    slope, prediction = jax.vmap(one)(points, impacts, slopes, rows, near)
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


def impact_of(values: Float[Array, " p"], measurement: Measurement, problem: Problem) -> LawImpact | TabulatedImpact:
    """Return what an impact does at a set of values: the model's law, or the table of its contact."""
    if problem.model != "contact":
        return LawImpact(problem.law(values))
    chosen = {name: value for name, value in problem.known(values).items() if name in problem.own}
    contact = Contact.paper(effects=problem.effects, **(measurement.contact | chosen))
    return tabulated(contact, measurement.cantilever.mass_ng)


def _impact_and_slopes(values: Float[Array, " p"], measurement: Measurement, problem: Problem) -> tuple[Any, Any]:
    """Return the impact, and its derivatives by each parameter along a first axis."""

    def turned(e):
        return jax.jvp(lambda v: impact_of(v, measurement, problem), (values,), (e,))

    # The derivatives by a nuisance are zeros: not worth another program.
    return impact_of(values, measurement, problem), jax.vmap(lambda e: turned(e)[1])(jnp.eye(values.shape[0]))


def orbit_problem(
    values: Float[Array, " p"],
    impact: LawImpact | TabulatedImpact,
    row: Rows,
    measurement: Measurement,
    problem: Problem,
) -> OrbitProblem | LastingProblem:
    """Return the orbit's scene of one row at a set of values, for the impact that these stand for."""
    cantilever = problem.cantilever(values, measurement.cantilever)
    platform = Platform(
        row.drive_amplitude_nm * problem.nuisance(values, "drive_calibration", 1.0),
        row.drive_frequency_khz,
        row.offset_nm + problem.nuisance(values, "offset_origin_nm", 0.0),
    )
    if isinstance(impact, LawImpact) and not problem.lasting:
        return OrbitProblem(cantilever, platform, impact.law, row.order)
    return LastingProblem(cantilever, platform, impact, row.order)


def branch_of(orbit: OrbitProblem | LastingProblem, row: Rows) -> _Branch:
    """Choose among a row's steady orbits; no derivatives.

    There can be several: the one that explains the measured amplitudes best counts. A row without any is predicted as
    0, which misses the measurement by all of it: a fixed penalty.
    """
    roots = steady_lasting_orbits(orbit) if isinstance(orbit, LastingProblem) else steady_orbits(orbit)
    misfit = jnp.where(row.measured, (roots.amplitude_nm - row.amplitude_nm) / row.error_nm, 0.0)
    slot = jnp.argmin(jnp.where(roots.steady, jnp.sum(misfit**2, axis=1), jnp.inf))
    return _Branch(
        coordinate=roots.coordinate[slot],
        exists=roots.steady[slot],
        orbits=jnp.sum(roots.steady, dtype=jnp.int32),
        near_fold=roots.steady[slot] & roots.near_double[slot],
    )


def _followed(orbit: OrbitProblem | LastingProblem, start: Float[Array, ""]) -> _Branch:
    """Follow a row's orbit from its coordinate at other parameters; NaN: there was none."""
    if not isinstance(orbit, LastingProblem):
        raise TypeError("instantaneous impacts are searched for every time: that costs no more")
    there = jnp.isfinite(start)
    harmless = orbit.impact.lowest + 2.0 * jnp.maximum(orbit.platform.top_speed_nm_per_us, orbit.impact.reach)
    root = follow_lasting_root(jnp.where(there, start, harmless), orbit)
    exists = there & root.found
    return _Branch(
        coordinate=jnp.where(exists, root.coordinate, harmless),
        exists=exists,
        orbits=exists.astype(jnp.int32),
        near_fold=exists & near_fold(root.coordinate, orbit),
    )


def _prediction(
    branch: _Branch, values: Float[Array, " p"], orbit: OrbitProblem | LastingProblem, problem: Problem
) -> Prediction:
    if isinstance(orbit, LastingProblem):
        amplitude = lasting_amplitudes(branch.coordinate, orbit)[:2]
        speed = orbit.impact.speeds(branch.coordinate).approach
    else:
        amplitude = amplitudes(branch.coordinate, orbit)
        speed = speeds_at(branch.coordinate, orbit.law).approach
    return Prediction(
        amplitude_nm=jnp.where(
            branch.exists, amplitude * problem.nuisance(values, "tip_calibration", 1.0), jnp.zeros_like(amplitude)
        ),
        orbits=branch.orbits,
        near_fold=branch.near_fold,
        approach_speed_nm_per_us=lax.stop_gradient(speed),
        coordinate=branch.coordinate,
    )
