"""From parameters to predicted amplitudes: each row's steady single-impact orbit, on the branch that was measured.

The model of one row is the first page: what an impact does (`impact_of`), the orbit's scene (`orbit_problem`), which of
its steady orbits was measured (`branch_of`), and what the instrument shows of it (`shown`). A steady orbit is a root of
its closing condition; by the implicit function theorem it moves smoothly with the parameters.

Below, `linearise` and `predict` do that for all pairs of a set of parameters and a row, a fixed number at a time.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from afm_jax.apparatus.platform import Platform
from afm_jax.apparatus.surface import detected, height_of_free_deflection
from afm_jax.checks import is_traced
from afm_jax.contact.contact import Contact
from afm_jax.contact.law_of_contact import tabulated
from afm_jax.impact.closure import (
    COARSE,
    Coordinates,
    OrbitPlace,
    OrbitProblem,
    coordinates_of_roots,
    first_seen,
    follow_root,
    harmless_coordinate,
)
from afm_jax.impact.lasting_impact import TabulatedImpact, middle_of_contact
from afm_jax.impact.law import Law, Speeds
from afm_jax.impact.orbits import SteadyOrbits, amplitudes, is_steady, steady_orbits
from afm_jax.solve.lanes import compiled_quickly, filled, in_blocks
from fitting.models import Measurement, Problem, Rows


class Branch(NamedTuple):
    """The orbit that a row is taken to be on: where, whether there is one, and how many there are.

    ``slopes`` are those of `FollowedRoot`.
    """

    place: OrbitPlace
    exists: Bool[Array, ""]
    orbits: Int[Array, ""]
    near_fold: Bool[Array, ""]
    slopes: Float[Array, "5 2"] | None


AnyImpact = Law | TabulatedImpact


def impact_of(values: Float[Array, " p"], measurement: Measurement, problem: Problem) -> AnyImpact:
    """Return what an impact does at a set of values: the model's law, or the table of its contact."""
    if problem.model != "contact":
        return problem.law(values, measurement.fixed)
    chosen = {name: value for name, value in problem.known(values).items() if name in problem.own}
    contact = Contact.paper(effects=problem.effects, **(measurement.fixed | chosen))
    return tabulated(contact, measurement.cantilever.mass_ng)


def orbit_problem(
    values: Float[Array, " p"],
    impact: AnyImpact,
    row: Rows,
    measurement: Measurement,
    problem: Problem,
) -> OrbitProblem:
    """Return the orbit's scene of one row at a set of values, for the impact that these stand for."""
    cantilever = problem.cantilever(values, measurement.cantilever)
    amplitude = row.drive_amplitude_nm * problem.nuisance(values, "drive_calibration")
    if problem.tapping:
        # the free tip's amplitude as the detector shows it: seen from that tip the sample moves by it
        amplitude = amplitude / problem.nuisance(values, "tip_calibration")
        amplitude = amplitude * (1.0 + problem.nuisance(values, "free_amplitude_drift") * row.time)
    if problem.drive == "base":
        ratio = row.drive_frequency_khz / cantilever.frequency_khz
        amplitude = height_of_free_deflection(amplitude, ratio, cantilever.quality_factor)
    offset = row.offset_nm + problem.nuisance(values, "offset_origin_nm")
    return OrbitProblem(
        cantilever, Platform(amplitude, row.drive_frequency_khz, offset), impact, jnp.asarray(row.order)
    )


def shown(
    seen: Float[Array, " 3"], orbit: OrbitProblem, row: Rows, values: Float[Array, " p"], problem: Problem
) -> Float[Array, " k"]:
    """Return the readings of an orbit: peak and lock-in amplitude in nm and, where the table has it, the phase in deg.

    Calibration, zero and drift of the instrument are included. Of the phases that differ by 360/N the one next to the
    measured phase is returned. A further reading of a table would be one more entry here and in `Rows`.

    Args:
        seen: peak height in nm, lock-in amplitude in nm and phase in degrees of the orbit itself.
        orbit: the orbit's scene.
        row: the row.
        values: of all parameters, of which the nuisances count.
        problem: the model.
    """
    height, amplitude, phase = seen
    if problem.tapping:
        ratio = row.drive_frequency_khz / orbit.cantilever.frequency_khz
        amplitude, phase = detected(
            jnp.where(row.free, 0.0, amplitude),
            phase,
            orbit.platform.amplitude_nm,
            ratio,
            orbit.cantilever.quality_factor,
            base=problem.drive == "base",
        )
        height = jnp.zeros_like(height)
    read = jnp.stack([height, amplitude]) * problem.nuisance(values, "tip_calibration")
    if row.amplitude_nm.shape[0] < 3:
        return read
    period, known = 360.0 / row.order, row.amplitude_nm[2]
    zero = problem.nuisance(values, "phase_zero_deg")
    apart = phase + zero + problem.nuisance(values, "phase_drift_deg") * row.time - known
    return jnp.append(read, known + (apart + 0.5 * period) % period - 0.5 * period)


def branch_of(orbit: OrbitProblem, row: Rows, values: Float[Array, " p"], problem: Problem) -> Branch:
    """Search for a row's steady orbits and choose the measured one; no derivatives."""
    roots = steady_orbits(orbit)
    read = jax.vmap(lambda seen: shown(seen, orbit, row, values, problem))(roots.amplitude_nm)
    return chosen(roots._replace(amplitude_nm=read), row)


def chosen(roots: SteadyOrbits, row: Rows) -> Branch:
    """Choose among the steady orbits of a row, or of each row of a table.

    There can be several: the one that explains the measured readings best counts. A row without any is predicted as
    `nothing_shown`: a fixed penalty. A free tip has its steady motion.

    Args:
        roots: of shape (..., slots), with the readings as they are shown.
        row: the row, or the rows, as arrays of NumPy or JAX like the roots.
    """
    numpy: Any = np if isinstance(roots.steady, np.ndarray) else jnp
    measured, amplitude, error = (column[..., None, :] for column in (row.measured, row.amplitude_nm, row.error_nm))
    misfit = numpy.where(measured, (roots.amplitude_nm - amplitude) / error, 0.0)
    size = numpy.where(roots.steady, (misfit**2).sum(axis=-1), numpy.inf)
    slot = size.argmin(axis=-1, keepdims=True)

    def of_slot(leaf: Any) -> Any:
        place = slot.reshape(slot.shape + (1,) * (leaf.ndim - slot.ndim))
        return numpy.take_along_axis(leaf, place, axis=slot.ndim - 1).squeeze(slot.ndim - 1)

    steady = of_slot(roots.steady)
    return Branch(
        place=jax.tree.map(of_slot, roots.place),
        exists=steady | row.free,
        orbits=numpy.where(row.free, 1, roots.steady.sum(axis=-1, dtype=np.int32)),
        near_fold=steady & of_slot(roots.near_double) & ~row.free,
        slopes=None if roots.slopes is None else of_slot(roots.slopes),
    )


class Prediction(NamedTuple):
    """Predicted readings of shape (rows, k) as in `Rows`, `nothing_shown` without orbit; the rest has shape (rows,).

    ``orbits`` is the number of stable admissible orbits; where an orbit is followed it is not counted again. All else
    belongs to the chosen orbit: ``coordinate`` is that of its impact in the law (`Law.speeds`),
    ``approach_speed_nm_per_us`` is NaN of a free tip, ``pull_nm_per_us2`` and ``change_nm_per_us3`` are the
    acceleration at mid contact and its derivative by time.
    """

    amplitude_nm: Float[Array, "rows k"]
    orbits: Int[Array, " rows"]
    near_fold: Bool[Array, " rows"]
    approach_speed_nm_per_us: Float[Array, " rows"]
    coordinate: Float[Array, " rows"]
    pull_nm_per_us2: Float[Array, " rows"]
    change_nm_per_us3: Float[Array, " rows"]


def prediction_of(
    branch: Branch, values: Float[Array, " p"], orbit: OrbitProblem, row: Rows, problem: Problem
) -> Prediction:
    """Return what is predicted for a row at a set of values, on the orbit that it is taken to be on."""
    read = shown(amplitudes(branch.place, orbit, branch.slopes), orbit, row, values, problem)
    speeds = lax.stop_gradient(orbit.impact.speeds(branch.place.coordinate))
    still = lax.stop_gradient(orbit)
    middle = middle_of_contact(
        still.cantilever,
        still.platform,
        branch.place.phase / still.platform.angular_frequency + 0.5 * speeds.delay,
    )
    return Prediction(
        amplitude_nm=jnp.where(branch.exists, read, nothing_shown(row)),
        orbits=branch.orbits,
        near_fold=branch.near_fold,
        approach_speed_nm_per_us=jnp.where(row.free, jnp.nan, speeds.approach),
        coordinate=branch.place.coordinate,
        pull_nm_per_us2=middle.acceleration,
        change_nm_per_us3=middle.change,
    )


def nothing_shown(row: Rows) -> Float[Array, " k"]:
    """Return what a row without an orbit is predicted as: no amplitude, and the phase that is farthest off."""
    return jnp.append(jnp.zeros(2), row.amplitude_nm[2:] + 180.0 / row.order)


BATCH = 8
"""Sets of parameters that `linearise` takes at once."""
SEARCHED, SOLVED = 128, 1024
"""Pairs of a set and a row that one program takes: of impacts that last, and of instantaneous ones, of which a pair
takes a hundredth of the time."""
CENSORED = 3.0
"""Residual of a row where no orbit was seen and the model has a steady one: e^(-9/2), a probability of 1 %."""


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
    every set, where the orbits are, and the amplitudes with their slopes there. Pairs of a set and a row are taken a
    fixed number at a time: the same programs serve tables of every size.

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
    batch, impacts = batch_of(values, measurement, problem)
    whole = _of_pairs(_Pairs(batch, sets, impacts, measurement, problem, near), linearised)
    misfit, unseen = np.asarray(whole.misfit).reshape(sets, -1), np.asarray(whole.unseen)
    strength = 1.0 / np.asarray(measurement.constraint_error)
    constraint = (values - np.asarray(measurement.constraint_value)) * strength
    pulls = np.broadcast_to(np.diag(strength), (sets, count, count))
    slope = np.asarray(whole.slope)
    if measurement.joint is not None and measurement.rows.table is not None:
        slope = measurement.joint.spread(slope, measurement.rows.table, count)
    flat = slope.reshape(sets, -1, count)
    return Linearised(
        residual=np.concatenate([misfit, unseen, constraint], axis=1),
        jacobian=np.concatenate([flat, np.zeros((sets, rows, count)), pulls], axis=1),
        prediction=whole.prediction,
    )


class Predicted(NamedTuple):
    """Readings that several sets of a law and of values predict, and how far the measured ones are from these.

    Attributes:
        misfit: (predicted - measured)/error, 0 where nothing was measured, shape (sets, rows, k).
        prediction: what is predicted, with leading axis (sets,).
    """

    misfit: Float[np.ndarray, "sets rows k"]
    prediction: Prediction


def predict(
    values: Float[np.ndarray, "sets p"],
    laws: AnyImpact,
    measurement: Measurement,
    problem: Problem,
    near: Float[np.ndarray, "sets rows"],
) -> Predicted:
    """Return the readings that laws predict with an instrument: the forward model itself, nothing linearised.

    Args:
        values: of all parameters, of which only the nuisances (the instrument) count.
        laws: what an impact does, one law a set, along a first axis.
        measurement: the rows, and what they are compared with.
        problem: the model that has these parameters.
        near: coordinates of the orbits at laws close by, from which they are followed; NaN where there is none.
    """
    # one program for every model: parameters of laws do not matter here
    own, joint = len(problem.own), measurement.joint
    instrument = replace(problem, model="law+delay", names=problem.names[own:], effects=())
    known = measurement._replace(constraint_value=np.zeros(0), constraint_error=np.zeros(0), fixed={})
    points = values[:, own:]
    if joint is not None:
        alone = replace(
            joint.problem, model="law+delay", names=joint.problem.names[len(joint.problem.own) :], effects=()
        )
        points = joint.values(values)[..., len(joint.problem.own) :]
        known = known._replace(joint=replace(joint, problem=alone))
    pairs = _Pairs(points, len(values), _Impacts(laws, None), known, instrument, near)
    block = _of_pairs(pairs, predict_pairs)
    return Predicted(np.asarray(block.misfit), block.prediction)


class ImpactSlopes(NamedTuple):
    """Derivatives of the rows' residuals by what their impacts do, shape (rows, k): peak, lock-in, phase.

    ``by_square``: by the squared rebound speed, in us^2/nm^2; in a formula the delay follows the speed. ``by_delay``:
    by the delay, in 1/us; 0 where impacts are instantaneous. Both are 0 where nothing was measured.
    """

    by_square: Float[np.ndarray, "rows k"]
    by_delay: Float[np.ndarray, "rows k"]


def impact_slopes(
    values: Float[np.ndarray, " p"],
    measurement: Measurement,
    problem: Problem,
    near: Float[np.ndarray, " rows"] | None = None,
) -> ImpactSlopes:
    """Return how the residuals change with each row's impact, by the program of `linearise`; arguments as there.

    The derivatives are those along a direction in which the impact itself is changed, put where those by the first
    parameter would be.
    """
    batch, impacts = batch_of(np.asarray(values)[None], measurement, problem)
    still = jax.tree.map(lambda leaf: np.zeros(leaf.shape), impacts.slopes)

    def along(where: Callable[[Any], Any], turn: float, *constant: Any) -> tuple[np.ndarray, np.ndarray]:
        leaf = np.array(where(still))
        leaf[(slice(None), 0, *constant)] = turn
        turned = impacts._replace(slopes=eqx.tree_at(where, still, leaf))
        block = _of_pairs(_Pairs(batch, 1, turned, measurement, problem, near), linearised)
        return np.asarray(block.slope)[0, :, :, 0], np.asarray(block.prediction.approach_speed_nm_per_us)[0]

    # -1: a larger loss, or epsilon, is a smaller squared speed; of a series the constant term is changed
    if isinstance(impacts.impact, TabulatedImpact):
        return ImpactSlopes(along(lambda i: i.loss, -1.0, 0)[0], along(lambda i: i.time, 1.0, 0)[0])
    by_square, _ = along(lambda i: i.epsilon, -1.0)
    if not impacts.impact.delayed:
        return ImpactSlopes(by_square, np.zeros_like(by_square))
    by_offset, speed = along(lambda i: i.delay.offset_nm, -1.0)
    # the offset d shortens the delay by d/u; a free tip has no speed
    return ImpactSlopes(by_square, np.nan_to_num(speed)[:, None] * by_offset)


def programs_of_search(
    values: Float[np.ndarray, " p"], measurement: Measurement, problem: Problem
) -> list[Callable[[], object]]:
    """Return what compiles the programs of `linearise`, or reads them from the cache, one each.

    Args:
        values: some values of the parameters.
        measurement: what will be compared with.
        problem: the model.
    """
    sets = np.asarray(values)[None]
    batch, calls = _calls_for_impacts(sets, measurement, problem)
    # of the impacts only the shapes are needed here: any numbers do
    impacts = jax.tree.map(lambda leaf: np.ones((BATCH, *leaf.shape[1:]), leaf.dtype), impacts_of.shapes(*calls[0]))
    here, own = measurement, problem
    if measurement.joint is not None:
        # one of what is driven: the program of another is compiled when it comes to it
        drive = measurement.joint.drives[0]
        batch, own = batch[:, 0], replace(measurement.joint.problem, drive=drive)
        here = measurement.of_drive(drive)
    index = np.zeros(_lanes(own), dtype=int)
    rows = jax.tree.map(lambda column: np.asarray(column)[index], here.rows)
    lanes = Lanes(batch[index], impacts, index, here._replace(rows=rows))
    # NumPy's arrays, as a search gives them
    nothing: Any = np.full(index.shape, np.nan)
    none: Any = np.zeros(index.shape, bool)
    slopes: Any = np.zeros((*index.shape, 5, 2)) if own.lasting else None
    nowhere = Branch(OrbitPlace(nothing, nothing), none, none.astype(np.int32), none, slopes)
    # those that take longest to compile, next to their trace, first
    return [
        lambda: batch_of(sets, measurement, problem),
        lambda: follow_pairs(lanes, own, nothing),
        lambda: linearise_pairs(lanes, own, nowhere),
        lambda: search_pairs(lanes, own),
        lambda: judge_pairs(lanes, own, nowhere),
    ]


class _Block(NamedTuple):
    """Misfits and their slopes, residuals of rows without orbit, and predictions, for each pair of a set and a row."""

    misfit: Float[Array, "lanes k"]
    slope: Float[Array, "lanes k p"]
    unseen: Float[Array, " lanes"]
    prediction: Prediction


class _Impacts(NamedTuple):
    """What an impact does at each set of values, and its derivatives by each parameter along a second axis."""

    impact: AnyImpact
    slopes: Any

    def first(self) -> "_Impacts":
        """Return those of the first set, without their leading axis."""
        return jax.tree.map(lambda leaf: np.asarray(leaf)[0], self)


def batch_of(
    values: Float[np.ndarray, "sets p"], measurement: Measurement, problem: Problem
) -> tuple[Float[np.ndarray, "batch ..."], _Impacts]:
    """Return sets of values, filled up to `BATCH`, and their impacts; of several tables the values of each."""
    batch, calls = _calls_for_impacts(values, measurement, problem)
    impacts = [jax.tree.map(np.asarray, impacts_of(*call)) for call in calls]
    return batch, jax.tree.map(lambda *leaves: filled(np.concatenate(leaves), BATCH), *impacts)


def _calls_for_impacts(
    values: Float[np.ndarray, "sets p"], measurement: Measurement, problem: Problem
) -> tuple[Float[np.ndarray, "batch ..."], list[tuple[Any, ...]]]:
    """Return the sets of values as of `batch_of`, and the arguments of `impacts_of` for their impacts."""
    batch = filled(values, BATCH)
    points = batch
    if measurement.joint is not None:
        # an impact knows no nuisances
        problem, batch = measurement.joint.problem, measurement.joint.values(batch)
        measurement, points = measurement.of_drive(problem.drive), batch[:, 0]
    # an impact knows no rows: one program for tables of every size
    rowless = measurement._replace(rows=jax.tree.map(lambda column: np.asarray(column)[:0], measurement.rows))
    return batch, [(points, rowless, problem)]


def impact_at(values: Float[np.ndarray, " p"], measurement: Measurement, problem: Problem) -> _Impacts:
    """Return the law, or the table of the contact, at one set of values, with its slopes, by the shared program."""
    impact, slopes = batch_of(np.asarray(values)[None], measurement, problem)[1].first()
    if measurement.joint is None:
        return _Impacts(impact, slopes)
    # the parameters of the law come first in every table, and nuisances change no impact
    own, others = len(problem.own), len(problem.names) - len(problem.own)
    return _Impacts(impact, jax.tree.map(lambda s: np.pad(s[:own], [(0, others), *[(0, 0)] * (s.ndim - 1)]), slopes))


@compiled_quickly(static_argnames="problem")
def impacts_of(values: Float[Array, "sets p"], measurement: Measurement, problem: Problem) -> _Impacts:
    """Return the law, or the table of the contact, of several sets of values."""
    return _Impacts(*jax.vmap(lambda v: _impact_and_slopes(v, measurement, problem))(values))


def _lanes(problem: Problem) -> int:
    return SEARCHED if problem.lasting else SOLVED


class _Pairs(NamedTuple):
    """All pairs of a set of values and a row, on which a program is to run.

    Attributes:
        points: values of every set, or of every set and table; more sets than are asked for fill it up.
        sets: how many sets there are.
        impacts: of every set.
        measurement: the rows.
        problem: the model.
        near: coordinates of the orbits close by for each row, or each set and row; None: they are searched for.
    """

    points: Float[np.ndarray, "batch ..."]
    sets: int
    impacts: _Impacts
    measurement: Measurement
    problem: Problem
    near: Float[np.ndarray, "..."] | None


def _of_pairs(pairs: _Pairs, program: Callable[..., _Block]) -> _Block:
    """Return what a program finds for every pair of a set and a row, as arrays of shape (sets, rows, ...).

    Several tables are taken drive by drive; slopes are by the parameters of a row's own table.

    Args:
        pairs: on which it is to run.
        program: `linearised` or `predict_pairs`.
    """
    joint, table = pairs.measurement.joint, pairs.measurement.rows.table
    if joint is None or table is None:
        return _of_pairs_of_one_drive(pairs._replace(points=pairs.points[:, None]), program)
    drives = np.array(joint.drives)[table]
    places, blocks = [], []
    for drive in dict.fromkeys(drives.tolist()):
        mine = np.flatnonzero(drives == drive)
        of_drive = pairs._replace(
            points=pairs.points[:, table[mine]],
            measurement=pairs.measurement.of_drive(drive),
            problem=replace(joint.problem, drive=drive),
            near=None if pairs.near is None else pairs.near[..., mine],
        )
        places.append(mine)
        blocks.append(_of_pairs_of_one_drive(of_drive, program))
    order = np.argsort(np.concatenate(places))
    return jax.tree.map(lambda *parts: np.concatenate(parts, axis=1)[:, order], *blocks)


def _of_pairs_of_one_drive(pairs: _Pairs, program: Callable[..., _Block]) -> _Block:
    """Return what `_of_pairs` does of rows under one drive; points are those of every row, or one for all."""
    sets, impacts, problem = pairs.sets, pairs.impacts, pairs.problem
    columns = jax.tree.map(np.asarray, pairs.measurement.rows)
    filling, whole = _filling(columns), columns.order.shape[0]
    rows = whole - filling
    number, row = (index.ravel() for index in np.indices((sets, rows)))
    near = None if pairs.near is None else np.broadcast_to(pairs.near, (sets, whole))[:, :rows].ravel()
    point = pairs.points[number, row if pairs.points.shape[1] > 1 else 0]

    def work(lanes: Any) -> _Block:
        point, number, of_row, near = lanes
        return program(Lanes(point, impacts, number, pairs.measurement._replace(rows=of_row)), problem, near)

    lanes = point, number, jax.tree.map(lambda column: column[row], columns), near

    def of_table(column: np.ndarray) -> np.ndarray:
        column = column.reshape(sets, rows, *column.shape[1:])
        return np.concatenate([column, np.repeat(column[:, -1:], filling, axis=1)], axis=1)

    width = _lanes(problem)
    known = (program, problem, jax.tree.structure((impacts, pairs.measurement))) if len(number) > width else None
    block = jax.tree.map(of_table, in_blocks(work, lanes, block=width, widths=(), program=known))
    # rows that only fill a table up say nothing
    for unread in (block.misfit, block.slope, block.unseen):
        unread[:, rows:] = 0.0
    return block


def _filling(rows: Rows) -> int:
    """Return how many rows at the end only fill a table up: on the drive of the row before, without a reading."""
    drives = np.stack([rows.order, rows.drive_frequency_khz, rows.drive_amplitude_nm, rows.offset_nm, rows.free])
    filling = ~(np.any(rows.measured, axis=1) | rows.no_orbit)
    filling[0] = False
    filling[1:] &= (drives[:, 1:] == drives[:, :-1]).all(axis=0)
    return int(np.argmin(filling[::-1]))


class Lanes(NamedTuple):
    """Pairs of a row and a set of values side by side: what a program takes; arrays of NumPy or JAX.

    Attributes:
        points: values of each row, shape (lanes, p).
        impacts: of every set.
        index: number of each lane's set.
        measurement: the rows, one a lane.
    """

    points: Any
    impacts: _Impacts
    index: Any
    measurement: Measurement

    def each(self, function: Callable[..., Any], *more: Any) -> Any:
        """Return what a function gives of every lane's values, impact and row, and of more arrays with its axis."""
        impact = _at(self.impacts.impact, self.index)
        return jax.vmap(function)(self.points, impact, self.measurement.rows, *more)


def located(lanes: Lanes, problem: Problem) -> Branch:
    """Return the orbit that each pair of a row, with its values, and the set that its index names is on.

    Outside of programs three of them share the work, `search_pairs`, `follow_pairs` and `judge_pairs`, the last two on
    what the first has found: they are compiled side by side.
    """
    if is_traced(lanes.points):
        return _located_in_a_program(lanes, problem)
    lanes = lanes._replace(points=np.asarray(lanes.points), index=np.asarray(lanes.index))
    rows = jax.tree.map(np.asarray, lanes.measurement.rows)
    near = jax.tree.map(np.asarray, search_pairs(lanes, problem))
    wanted = near.found & ~rows.free[:, None]
    # one that is nowhere if there are none
    lane, slot = np.nonzero(wanted) if wanted.any() else np.zeros((2, 1), int)

    def work(part: Any) -> Any:
        points, index, rows, coordinate = part
        some = Lanes(points, lanes.impacts, index, lanes.measurement._replace(rows=rows))
        root = follow_pairs(some, problem, coordinate)
        return root, judge_pairs(some, problem, root)

    def in_slots(values: np.ndarray) -> np.ndarray:
        whole = np.zeros((*wanted.shape, *values.shape[1:]), values.dtype)
        whole[lane, slot] = values
        return whole

    coordinate = np.where(wanted, near.coordinate, np.nan)[lane, slot]
    pairs = lanes.points[lane], lanes.index[lane], _at(rows, lane), coordinate
    known = located, problem, jax.tree.structure((lanes.impacts, lanes.measurement))
    found = jax.tree.map(in_slots, in_blocks(work, pairs, block=len(rows.order), widths=(), program=known))
    return _chosen_of(near.coordinate, wanted, found, rows)


def _located_in_a_program(lanes: Lanes, problem: Problem) -> Branch:
    """Return what `located` does, where it is not known how many orbits there are."""
    points, impacts, index, measurement = lanes
    rows = measurement.rows
    near = search_pairs(lanes, problem)
    wanted = near.found & ~rows.free[:, None]
    # one axis of all slots: every axis more is traced for itself
    lane = np.repeat(np.arange(wanted.shape[0]), wanted.shape[1])
    slots = Lanes(points[lane], impacts, index[lane], measurement._replace(rows=_at(rows, lane)))
    root = follow_pairs(slots, problem, jnp.where(wanted, near.coordinate, jnp.nan).ravel())
    found = root, judge_pairs(slots, problem, root)
    in_slots = jax.tree.map(lambda leaf: leaf.reshape(*wanted.shape, *leaf.shape[1:]), found)
    return _chosen_of(near.coordinate, wanted, in_slots, rows)


def _chosen_of(coordinate: Any, wanted: Any, found: tuple[Branch, "_Steadiness"], rows: Rows) -> Branch:
    """Return the chosen orbit of each row, given what was found in slots of coordinates; arrays of NumPy or JAX."""
    root, judged = found
    there = root.exists & wanted
    numpy: Any = np if isinstance(there, np.ndarray) else jnp
    place = OrbitPlace(numpy.where(there, root.place.coordinate, coordinate), root.place.phase)
    steady = judged.steady & first_seen(place.coordinate, there)
    return chosen(SteadyOrbits(place, steady, root.near_fold, judged.shown, root.slopes), rows)


def _at(columns: Any, index: Any) -> Any:
    """Return a tree of arrays with a row for each number of an index: impacts of sets, rows of lanes."""
    return jax.tree.map(lambda leaf: leaf[index], columns)


@compiled_quickly(static_argnames="problem")
def search_pairs(lanes: Lanes, problem: Problem) -> Coordinates:
    """Return where the orbits of each pair may be, of shape (lanes, slots)."""

    def one(point: Float[Array, " p"], impact, row: Rows) -> Coordinates:
        orbit = orbit_problem(point, impact, row, lanes.measurement, problem)
        return coordinates_of_roots(orbit, COARSE)

    return lanes.each(one)


@compiled_quickly(static_argnames="problem")
def follow_pairs(lanes: Lanes, problem: Problem, near: Float[Array, " lanes"]) -> Branch:
    """Return the orbit of each pair that is close to a coordinate, NaN: none; admissible and stable are not asked."""

    def one(point: Float[Array, " p"], impact, row: Rows, near: Float[Array, ""]) -> Branch:
        orbit = orbit_problem(point, impact, row, lanes.measurement, problem)
        harmless = harmless_coordinate(orbit)
        wanted = jnp.isfinite(near) & ~row.free
        root = follow_root(jnp.where(wanted, near, harmless), orbit, wanted)
        there = wanted & root.closes
        return Branch(
            place=OrbitPlace(jnp.where(there, root.place.coordinate, harmless), root.place.phase),
            exists=there | row.free,
            orbits=(there | row.free).astype(jnp.int32),
            near_fold=there & root.near_fold,
            slopes=root.slopes,
        )

    return lanes.each(one, near)


class _Steadiness(NamedTuple):
    """Whether an orbit is steady, and its readings as they are shown."""

    steady: Bool[Array, " lanes"]
    shown: Float[Array, "lanes k"]


@compiled_quickly(static_argnames="problem")
def judge_pairs(lanes: Lanes, problem: Problem, branch: Branch) -> _Steadiness:
    """Say which orbits of pairs are steady, and what is shown of them."""

    def one(point: Float[Array, " p"], impact, row: Rows, known: Branch) -> _Steadiness:
        orbit = lax.stop_gradient(orbit_problem(point, impact, row, lanes.measurement, problem))
        steady, seen = is_steady(known.place, known.exists, known.slopes, orbit)
        return _Steadiness(steady, shown(seen, orbit, row, point, problem))

    return lanes.each(one, branch)


@compiled_quickly(static_argnames="problem")
def linearise_pairs(lanes: Lanes, problem: Problem, branch: Branch) -> _Block:
    """Return misfits and slopes of pairs of a row, with its values, and the set that its index names, on its orbit."""

    # One vmap over all pairs, not two nested ones: tracing costs as much as a fit otherwise.
    def one(point: Float[Array, " p"], impact, row: Rows, slope, known: Branch):
        def predict(v, impact):
            return prediction_of(known, v, orbit_problem(v, impact, row, lanes.measurement, problem), row, problem)

        def along(e, turn):
            predicted, change = jax.jvp(predict, (point, impact), (e, turn))
            return change.amplitude_nm, predicted

        return jax.vmap(along, out_axes=(-1, None))(jnp.eye(point.shape[0]), slope)

    slope, prediction = lanes.each(one, _at(lanes.impacts.slopes, lanes.index), branch)
    return _block(prediction, slope, lanes.measurement.rows)


def _block(prediction: Prediction, slope: Float[Array, "lanes k p"], rows: Rows) -> _Block:
    """Return misfits and slopes in the rows' errors."""
    # far from any law (a start of the search) a root can be no motion at all: no orbit there
    sound = jnp.isfinite(prediction.amplitude_nm).all(axis=1) & jnp.isfinite(slope).all(axis=(1, 2))
    slope = jnp.where(sound[:, None, None], slope, 0.0)
    prediction = prediction._replace(
        amplitude_nm=jnp.where(sound[:, None], prediction.amplitude_nm, jax.vmap(nothing_shown)(rows)),
        orbits=jnp.where(sound, prediction.orbits, 0),
    )
    weight = jnp.where(rows.measured, 1.0 / rows.error_nm, 0.0)
    return _Block(
        misfit=weight * (prediction.amplitude_nm - rows.amplitude_nm),
        slope=weight[:, :, None] * slope,
        unseen=jnp.where(rows.no_orbit & (prediction.orbits > 0), CENSORED, 0.0),
        prediction=prediction,
    )


def linearised(lanes: Lanes, problem: Problem, near: Float[Array, " lanes"] | None) -> _Block:
    """Return `linearise_pairs` on the orbits near coordinates, or, None, on those that a search finds."""
    branch = located(lanes, problem) if near is None else follow_pairs(lanes, problem, near)
    return linearise_pairs(lanes, problem, branch)


@compiled_quickly(static_argnames="problem", level=0)
def predict_pairs(lanes: Lanes, problem: Problem, near: Float[Array, " lanes"]) -> _Block:
    """Return misfits of pairs of a row, with its values, and the law that its index names, near orbits; no slopes."""

    def one(point: Float[Array, " p"], impact, row: Rows, known: Branch) -> Prediction:
        orbit = orbit_problem(point, impact, row, lanes.measurement, problem)
        return prediction_of(known, point, orbit, row, problem)

    rows = lanes.measurement.rows
    prediction = lanes.each(one, follow_pairs(lanes, problem, near))
    return _block(prediction, jnp.zeros((*rows.amplitude_nm.shape, 0)), rows)


def _impact_and_slopes(values: Float[Array, " p"], measurement: Measurement, problem: Problem) -> tuple[Any, Any]:
    """Return the impact, and its derivatives by each parameter along a first axis."""

    def turned(e):
        return jax.jvp(lambda v: impact_of(v, measurement, problem), (values,), (e,))

    impact, own = jax.vmap(turned, out_axes=(None, 0))(jnp.eye(len(problem.own), values.shape[0]))
    # those by a nuisance, of which the others come after the model's own, are zeros
    nothing = values.shape[0] - len(problem.own)
    return impact, jax.tree.map(lambda leaf: jnp.pad(leaf, [(0, nothing), *[(0, 0)] * (leaf.ndim - 1)]), own)


class Free(NamedTuple):
    """What an impact does to a free tip: at coordinates of shape (n,), and at capture; us and nm/us."""

    speeds: Speeds
    hertz_time: Float[Array, " n"]
    lowest: Float[Array, ""]
    capture_speed: Float[Array, ""]
    """Approach speed in nm/us just above capture."""
    length: Float[Array, ""]
    """Gap in nm at which the bridge breaks: the length over which a leaving tip loses its energy."""


@compiled_quickly(level=0)
def free_impacts(impact: AnyImpact, coordinate: Float[Array, " n"]) -> Free:
    """Return what an impact does to free tips."""
    speeds = jax.vmap(impact.speeds)(coordinate)
    just_above = impact.speeds(impact.lowest * (1.0 + 1e-9)).approach
    hertz = impact.hertz_contact
    return Free(speeds, hertz.time(speeds.approach), impact.lowest, just_above, hertz.length_nm)
