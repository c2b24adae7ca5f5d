"""What is fitted, what is held, and what predictions are compared with, of one table or of several.

`task_of` turns tables and options of a fit into a `Problem`, the parameters as vectors in the optimiser's coordinates,
and a `Measurement`, the rows as arrays with the cantilever and the Gaussian constraints.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import IntEnum
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float, Int

from afm_jax.apparatus.cantilever import Cantilever
from afm_jax.contact.parameters import CONTACT_PARAMETER, EFFECTS, PAPER, idle_without
from afm_jax.impact.law import BRIDGE_NM, CollisionDelay, ImpactLaw
from afm_jax.solve.lanes import filled
from fitting.parameters import (
    DELAY,
    LAW,
    NUISANCE_NAMES,
    USUAL_DRIFTS,
    USUAL_ERRORS,
    Parameter,
    is_nuisance,
    model_parameters,
    name_of_table,
    parameter_called,
)
from fitting.tables.csv_text import TableError, printable
from fitting.tables.several import SeveralTables
from fitting.tables.table import AmplitudeTable, check_quality_factor

AnyArray = Array | np.ndarray
"""JAX's within its programs, NumPy's outside."""
Numbers = Float[np.ndarray, "..."] | float
"""Arrays, and the NumPy scalars that come of taking one element of them."""


def coordinate_of(parameter: Parameter, value: Numbers) -> Numbers:
    """Return the optimiser's coordinate of a parameter's value."""
    if parameter.sign:
        return np.sqrt(np.maximum(parameter.sign * (value - parameter.reference), 0.0))
    if parameter.width:
        return (value - parameter.reference) / parameter.width
    return np.log(value)


def value_at(parameter: Parameter, coordinate: Numbers) -> Numbers:
    """Return a parameter's value at an optimiser's coordinate, kept in the allowed range."""
    return np.clip(_unbounded(parameter, coordinate), parameter.lowest, parameter.highest)


def slope_at(parameter: Parameter, coordinate: Numbers) -> Numbers:
    """Return d value/d coordinate; 0 where the value is held at the end of its range."""
    value = _unbounded(parameter, coordinate)
    inside = (value >= parameter.lowest) & (value <= parameter.highest)
    slope = 2.0 * parameter.sign * coordinate if parameter.sign else parameter.width or value
    return np.where(inside, slope, 0.0)


def _unbounded(parameter: Parameter, coordinate: Numbers) -> Numbers:
    if parameter.sign:
        return parameter.reference + parameter.sign * coordinate**2
    if parameter.width:
        return parameter.reference + parameter.width * coordinate
    return np.exp(coordinate)


@dataclass(frozen=True)
class Problem:
    """What is fitted: the model's parameters, then nuisances; which effects a contact has, and what is driven."""

    model: str
    names: tuple[str, ...]
    effects: tuple[str, ...] = EFFECTS
    drive: str = "sample"

    @property
    def tapping(self) -> bool:
        """Whether the cantilever is driven itself."""
        return self.drive != "sample"

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """The parameters in the order of every vector."""
        return tuple(parameter_called(name) for name in self.names)

    @property
    def lasting(self) -> bool:
        """Whether impacts take time: a delay, or the contact itself."""
        return self.model.endswith("+delay") or self.model == "contact"

    @property
    def own(self) -> tuple[str, ...]:
        """The names of the model's parameters, without nuisances."""
        return tuple(name for name in self.names if not is_nuisance(name))

    @property
    def ends(self) -> Float[np.ndarray, "2 p"]:
        """The lowest and the highest values that the parameters can have."""
        return np.array([(parameter.lowest, parameter.highest) for parameter in self.parameters]).T

    def _each(
        self, function: Callable[[Parameter, Numbers], Numbers], columns: Float[np.ndarray, "... p"]
    ) -> Float[np.ndarray, "... p"]:
        """Return what a function makes of each parameter's column."""
        pairs = zip(self.parameters, np.moveaxis(columns, -1, 0), strict=True)
        return np.stack([function(parameter, column) for parameter, column in pairs], axis=-1)

    def values(self, coordinates: Float[np.ndarray, "... p"]) -> Float[np.ndarray, "... p"]:
        """Return the parameters' values at optimiser coordinates."""
        return self._each(value_at, coordinates)

    def values_and_slopes(
        self, coordinates: Float[np.ndarray, "... p"]
    ) -> tuple[Float[np.ndarray, "... p"], Float[np.ndarray, "... p"]]:
        """Return the values and their derivatives by the coordinates."""
        return self.values(coordinates), self._each(slope_at, coordinates)

    def coordinates(self, values: Float[np.ndarray, "... p"]) -> Float[np.ndarray, "... p"]:
        """Return optimiser coordinates of parameter values."""
        return self._each(coordinate_of, values)

    def known(self, values: Float[Array, " p"]) -> dict[str, Float[Array, ""]]:
        """Return the parameters by name."""
        return dict(zip(self.names, values, strict=True))

    def law(self, values: Float[Array, " p"], fixed: Mapping[str, Any]) -> ImpactLaw:
        """Return the impact law, with its delay, some parameters fixed; what the model leaves out is lossless."""
        known = {**fixed, **self.known(values)}
        delay = None
        if self.lasting:
            parts: dict[str, Any] = {p.name.removeprefix("delay_"): known.get(p.name, p.reference) for p in DELAY}
            delay = CollisionDelay(**parts)
        return ImpactLaw(**{p.name: known.get(p.name, p.reference) for p in LAW}, delay=delay)

    def cantilever(self, values: Float[Array, " p"], measured: Cantilever) -> Cantilever:
        """Return the cantilever, with its fitted frequency and quality factor where these are nuisances."""
        known = self.known(values)
        return Cantilever(
            known.get("free_frequency_khz", measured.frequency_khz),
            known.get("quality_factor", measured.quality_factor),
            measured.mass_ng,
        )

    def nuisance(self, values: Float[Array, " p"], name: str) -> Float[Array, ""]:
        """Return a nuisance, or the value that stands for its absence where it is not a parameter."""
        return self.known(values).get(name, jnp.asarray(_NEUTRAL[name]))


_NEUTRAL = {name: 1.0 if name.endswith("_calibration") else 0.0 for name in NUISANCE_NAMES}
"""What stands for the absence of a nuisance."""

ROWS_PER_PROGRAM = 32
"""Rows are padded to multiples of this, so that programs by rows (gradients, a scout's fit) have few shapes."""


class Rows(NamedTuple):
    """A table as arrays of shape (rows,), and measured values and errors of shape (rows, k): peak, lock-in, phase.

    The phase is in degrees, and there (k = 3) only if the table has one: of the orbit, or the lag of a cantilever that
    is driven itself, whose free amplitude stands for the drive's. What was not measured, and every padded row, has
    ``measured`` False; its value and error are 1. ``no_orbit``: the drive was tried and no steady orbit seen; ``free``:
    the driven tip does not come near the sample. ``time``: from -1/2 to 1/2 where the rows stand in order of time, else
    0. ``table``: which of several tables a row is of; None: of the one.
    """

    order: Float[AnyArray, " rows"]
    drive_frequency_khz: Float[AnyArray, " rows"]
    drive_amplitude_nm: Float[AnyArray, " rows"]
    offset_nm: Float[AnyArray, " rows"]
    amplitude_nm: Float[AnyArray, "rows k"]
    error_nm: Float[AnyArray, "rows k"]
    measured: Bool[AnyArray, "rows k"]
    no_orbit: Bool[AnyArray, " rows"]
    free: Bool[AnyArray, " rows"]
    time: Float[AnyArray, " rows"]
    table: Int[np.ndarray, " rows"] | None = None


@dataclass(frozen=True, eq=False)
class Joint:
    """How the parameters of several tables that are fitted together are those of each.

    Attributes:
        problem: of every one of them: the model's parameters, and the nuisances that any has.
        cantilevers: as each table gives it; all of one mass.
        drives: what is driven in each.
        place: of each table's parameters among all that are fitted, shape (tables, p); -1 where one is held.
        held: the values of these.
    """

    problem: Problem
    cantilevers: tuple[Cantilever, ...]
    drives: tuple[str, ...]
    place: Int[np.ndarray, "tables p"]
    held: Float[np.ndarray, "tables p"]

    def values(self, everything: Float[np.ndarray, "sets q"]) -> Float[np.ndarray, "sets tables p"]:
        """Return the values of each table's parameters."""
        return np.where(self.place >= 0, everything[:, self.place], self.held)

    def spread(
        self, slope: Float[np.ndarray, "sets rows k p"], table: Int[np.ndarray, " rows"], count: int
    ) -> Float[np.ndarray, "sets rows k q"]:
        """Return derivatives by all parameters that are fitted, from those by each row's own."""
        # what is held is put into a last column, which is cut
        whole = np.zeros((*slope.shape[:-1], count + 1))
        np.put_along_axis(whole, np.broadcast_to(self.place[table][:, None, :], slope.shape), slope, axis=-1)
        return whole[..., :count]


class Measurement(NamedTuple):
    """Everything a prediction is compared with.

    Attributes:
        rows: the table, padded.
        cantilever: as the table gives it.
        constraint_value: what is known of each parameter beforehand, shape (p,).
        constraint_error: its standard error, infinite where nothing is known.
        fixed: values of the model's parameters that are not fitted, by name; of a contact those not the paper's.
        joint: where the rows are of several tables: which parameters are whose; no compiled program takes it.
    """

    rows: Rows
    cantilever: Cantilever
    constraint_value: Float[AnyArray, " p"]
    constraint_error: Float[AnyArray, " p"]
    fixed: dict[str, Float[AnyArray, ""]]
    joint: Joint | None = None

    def of_drive(self, drive: str) -> "Measurement":
        """Return the rows of several tables of which this is driven as those of one; its parameters are `joint`'s."""
        assert self.joint is not None and self.rows.table is not None  # noqa: S101, PT018
        chosen = np.array(self.joint.drives)[self.rows.table] == drive
        rows = jax.tree.map(lambda column: np.asarray(column)[chosen], self.rows._replace(table=None))
        count = len(self.joint.problem.names)
        return Measurement(rows, self.cantilever, np.ones(count), np.full(count, np.inf), self.fixed)


def constraints_of(
    table: AmplitudeTable, constraints: dict[str, tuple[float, float]] | None
) -> dict[str, tuple[float, float]]:
    """Return everything that is known beforehand: what the table says, and what the caller adds or says instead.

    Raises:
        TableError: if nothing says the quality factor.
    """
    known = dict(table.calibration)
    if "quality_factor" not in (constraints or {}):
        check_quality_factor(table)
    if table.quality_factor is not None and table.quality_factor_error is not None:
        known["quality_factor"] = table.quality_factor, table.quality_factor_error
    if table.free_frequency_error_khz is not None:
        known["free_frequency_khz"] = table.free_frequency_khz, table.free_frequency_error_khz
    given = dict(constraints or {})
    return known | _known_of_drifts(table, given) | given


def _known_of_drifts(table: AmplitudeTable, given: Mapping[str, tuple[float, float]]) -> dict[str, tuple[float, float]]:
    """Return what is known of slow drifts along the rows of a table, and of what they start from.

    What the table says of the zero of phase, and of the free amplitude, held when it was set, before the first row or
    after the last: half a drift away from the middle.

    Args:
        table: whose rows may stand in order of time.
        given: what the caller says.
    """
    if not drifts(table):
        return {}
    assumed = []
    if table.phase_and_error_deg[0] is not None:
        assumed.append(("phase_drift_deg", "phase_zero_deg", 0.0))
    if table.tapping:
        assumed.append(("free_amplitude_drift", "drive_calibration", 1.0))
    known = {}
    for drift, start, neutral in assumed:
        known[drift] = given.get(drift, (0.0, USUAL_DRIFTS[drift]))
        value, error = table.calibration.get(start, (neutral, 0.0))
        known[start] = value, float(np.hypot(error, 0.5 * np.hypot(*known[drift])))
    return known


class Task(NamedTuple):
    """A fit to do: what is known beforehand (value and error by parameter), what is fitted, and to what."""

    known: dict[str, tuple[float, float]]
    problem: Problem
    measurement: Measurement


def task_of(
    table: AmplitudeTable | SeveralTables,
    model: str,
    *,
    share: Sequence[str] = (),
    free: Sequence[str] | None = None,
    fixed: dict[str, float] | None = None,
    constraints: dict[str, tuple[float, float]] | None = None,
    effects: Sequence[str] = EFFECTS,
) -> Task:
    """Return what a fit has to do; arguments and errors as of `fit`."""
    options = {"free": free, "fixed": fixed, "effects": effects}
    if isinstance(table, SeveralTables):
        return _joint_task(table, model, share, constraints, **options)
    known = _known_of(table, model, constraints)
    problem = problem_of(table, model, constraints=known, **options)
    return Task(known, problem, measurement_of(table, problem, known, fixed))


def _known_of(
    table: AmplitudeTable, model: str, constraints: dict[str, tuple[float, float]] | None
) -> dict[str, tuple[float, float]]:
    """Return everything that is known beforehand of a table's fit, the quality factor's assumed error included."""
    known = constraints_of(table, constraints)
    if table.quality_factor is not None and (model.endswith("+delay") or model == "contact"):
        usual = USUAL_ERRORS["quality_factor"] * table.quality_factor
        known = {"quality_factor": (table.quality_factor, usual)} | known
    return known


def problem_of(
    table: AmplitudeTable,
    model: str,
    *,
    free: Sequence[str] | None = None,
    fixed: dict[str, float] | None = None,
    constraints: dict[str, tuple[float, float]] | None = None,
    effects: Sequence[str] = EFFECTS,
) -> Problem:
    """Return what is fitted for a table: the model's parameters, and the nuisances that are constrained.

    Raises:
        ValueError: if there is no such model or parameter, or a constraint is impossible.
        TableError: if a contact is to be fitted to a tip that is driven near resonance.
    """
    if model == "contact" and table.tapping:
        _check_above_resonance(table)
    own = model_parameters(model, None if free is None else tuple(free), fixed)
    known = constraints_of(table, constraints)
    check_constraints(known, model, own, table.drive)
    nuisances = tuple(name for name in NUISANCE_NAMES if name in known)
    return Problem(model, own + nuisances, tuple(effects), table.drive)


_LEAST_RATIO = 1.01
"""Drive over free frequency from which taps may be fast and brief enough for a free tip's collisions."""


def _check_above_resonance(table: AmplitudeTable) -> None:
    """Check that a driven tip meets the sample as a free one would, but for corrections.

    Raises:
        TableError: if a row is driven on resonance or below it, where lever and drive turn the tip round.
    """
    ratio = table.drive_frequency_khz / table.free_frequency_khz
    row = int(np.argmin(ratio))
    if ratio[row] < _LEAST_RATIO:
        raise TableError(
            f"{printable(table.source)}, line {table.lines[row]}: driven at {ratio[row]:.3f} of the free frequency, "
            "where lever and drive turn the tip round: no contact can be fitted to that. Such a curve gives the energy "
            "of a tap: `afm-jax tapping CURVE`; for the contact drive 3 to 10 % above resonance"
        )


def check_constraints(
    known: Mapping[str, tuple[float, float]], model: str, own: tuple[str, ...], drive: str = "sample"
) -> None:
    """Check what is known beforehand of a model's parameters and of the instrument.

    Args:
        known: value and standard error by parameter.
        model: its name.
        own: its parameters.
        drive: what is driven.

    Raises:
        ValueError: if a constraint is on no parameter, impossible, or says what a delay says already.
    """
    for name, (value, error) in known.items():
        if name not in (*own, *NUISANCE_NAMES):
            raise ValueError(
                f"the constraint on {name!r} is on no parameter: choose from {', '.join((*own, *NUISANCE_NAMES))}"
            )
        if not (np.isfinite(value) and 0.0 < error < np.inf):
            raise ValueError(
                f"the constraint on {name} must be a value and a positive error, but is {value} +- {error}"
            )
    if "offset_origin_nm" in known and model.endswith("+delay") and drive == "sample":
        raise ValueError(
            "offset_origin_nm and delay_offset_nm shift the same thing: with a delay leave the constraint on "
            "offset_origin_nm out (delay_offset_nm takes it up), or fit the model 'contact'"
        )


def _joint_task(
    tables: SeveralTables,
    model: str,
    share: Sequence[str],
    constraints: dict[str, tuple[float, float]] | None,
    **options: Any,
) -> Task:
    """Return what a fit of several tables has to do: one law, and nuisances that are shared or each table's own.

    Raises:
        ValueError: if there is no such nuisance to share, or the tables contradict each other on it.
    """
    each = [_known_of(table, model, constraints) for table in tables.tables]
    there = [name for name in NUISANCE_NAMES if any(name in known for known in each)]
    shared = _shared(share, there)
    _check_shared(tables, each, shared)
    several = {name: pair for name, pair in each[0].items() if name in shared}
    # what is each table's own may differ by what a delay takes up in common
    own = problem_of(tables.tables[0], model, constraints=several, **options).own
    for table, known in zip(tables.tables, each, strict=True):
        checked = {name: pair for name, pair in known.items() if name != "offset_origin_nm"}
        problem_of(replace(table, calibration={}), model, constraints=checked, **options)
    tables.check_different()
    differing = {name for name in _HEADS if len({getattr(table, name) for table in tables.tables}) > 1}
    local = (*own, *(name for name in NUISANCE_NAMES if name in (*there, *differing)))
    known = {name: pair for name, pair in each[0].items() if name in (*own, *shared)}
    names, place, held = _places(tables, each, local, [*own, *shared])
    for label, told in zip(tables.labels, each, strict=True):
        by_name = {name_of_table(name, label): pair for name, pair in told.items()}
        known |= {name: by_name[name] for name in names if name in by_name}
    drives = tuple(table.drive for table in tables.tables)
    problem = Problem(model, tuple(names), tuple(options["effects"]), tables.drive)
    alone = replace(problem, names=local, drive=drives[0])
    parts = [measurement_of(table, alone, known, options["fixed"]) for table in tables.tables]
    joint = Joint(alone, tuple(part.cantilever for part in parts), drives, place, held)
    return Task(known, problem, joint_measurement(tables, parts, problem, joint, known))


_HEADS = ("free_frequency_khz", "quality_factor")
"""Nuisances that are held at what each table says where nothing says their errors."""


def _places(
    tables: SeveralTables,
    each: Sequence[Mapping[str, tuple[float, float]]],
    local: Sequence[str],
    common: Sequence[str],
) -> tuple[list[str], Int[np.ndarray, "tables p"], Float[np.ndarray, "tables p"]]:
    """Return the names of all that is fitted, and where each table's parameters are among them or held; see `Joint`.

    Args:
        tables: the tables.
        each: what is known beforehand of each.
        local: names of the parameters of one table.
        common: names of those that all have in common.
    """
    names, size = [*common], (len(tables.labels), len(local))
    place, held = np.full(size, -1), np.zeros(size)
    for t, (table, label) in enumerate(zip(tables.tables, tables.labels, strict=True)):
        for i, name in enumerate(local):
            if name in common:
                place[t, i] = names.index(name)
            elif name in each[t]:
                place[t, i] = len(names)
                names.append(name_of_table(name, label))
            else:
                held[t, i] = getattr(table, name) if name in _HEADS else _NEUTRAL[name]
    return names, place, held


def _shared(share: Sequence[str], there: Sequence[str]) -> list[str]:
    """Return the nuisances that several tables share.

    Raises:
        ValueError: if there is no such nuisance.
    """
    for name in share:
        if name not in (*NUISANCE_NAMES, "all"):
            raise ValueError(f"`share` must be chosen from {', '.join(NUISANCE_NAMES)} and all, but one is {name!r}")
        if name not in (*there, "all"):
            raise ValueError(f"`share` names {name}, but no table gives it with an error; state it, or leave it out")
    return [name for name in there if "all" in share or name in share]


def _check_shared(tables: SeveralTables, each: Sequence[dict[str, tuple[float, float]]], shared: Sequence[str]) -> None:
    """Check that tables say the same of what they share.

    Raises:
        ValueError: if they do not.
    """
    for name in shared:
        for known, label in zip(each, tables.labels, strict=True):
            if known.get(name) != each[0].get(name):
                said = [
                    f"{where} {'says nothing of it' if pair is None else 'says {:g} +- {:g}'.format(*pair)}"
                    for where, pair in ((tables.labels[0], each[0].get(name)), (label, known.get(name)))
                ]
                raise ValueError(
                    f"{name} is shared, but {', and '.join(said)}; say it once (`constraints=...`), or do not share it"
                )


def measurement_of(
    table: AmplitudeTable,
    problem: Problem,
    constraints: dict[str, tuple[float, float]] | None = None,
    fixed: dict[str, float] | None = None,
) -> Measurement:
    """Return a table as padded arrays (float64).

    Args:
        table: the amplitudes.
        problem: the model; its parameters' order is that of the constraints.
        constraints: value and standard error of what is known beforehand, by parameter; else the table says.
        fixed: values of the model's parameters that are not fitted.
    """
    known = constraints_of(table, constraints)
    value, error = _constraint_columns(problem, known)
    held: dict[str, Any] = {name: np.asarray(float(value)) for name, value in (fixed or {}).items()}
    quality_factor = table.quality_factor
    if quality_factor is not None and np.isnan(quality_factor):
        quality_factor = known["quality_factor"][0]
    cantilever = Cantilever(table.free_frequency_khz, quality_factor, table.mass_ng)
    rows = rows_of(table)
    if table.tapping:
        reach = reach_of(rows, cantilever, table.drive)
        hit = np.asarray(rows.measured) & (reach != Reach.ATTRACTED)[:, None]
        rows = rows._replace(measured=hit, free=reach == Reach.FREE)
    return Measurement(
        rows=rows,
        cantilever=cantilever,
        constraint_value=value,
        constraint_error=error,
        fixed=held,
    )


def _constraint_columns(
    problem: Problem, known: Mapping[str, tuple[float, float]]
) -> tuple[Float[np.ndarray, " p"], Float[np.ndarray, " p"]]:
    """Return what is known of each parameter and its standard error, infinite where nothing is."""
    pairs = [
        known.get(name, (parameter.reference, np.inf))
        for name, parameter in zip(problem.names, problem.parameters, strict=True)
    ]
    return np.array([float(value) for value, _ in pairs]), np.array([float(error) for _, error in pairs])


def joint_measurement(
    tables: SeveralTables,
    parts: Sequence[Measurement],
    problem: Problem,
    joint: Joint,
    known: Mapping[str, tuple[float, float]],
) -> Measurement:
    """Return several tables as one measurement.

    Args:
        tables: the tables.
        parts: each as a measurement of its own.
        problem: everything that is fitted.
        joint: which of that is whose.
        known: value and standard error of what is known beforehand, by the names of the problem.
    """
    kinds = max(part.rows.measured.shape[1] for part in parts)

    def whole(name: str) -> np.ndarray:
        columns = [np.asarray(getattr(p.rows, name))[: t.rows] for p, t in zip(parts, tables.tables, strict=True)]
        if columns[0].ndim > 1:
            filler = name != "measured"
            columns = [np.pad(c, ((0, 0), (0, kinds - c.shape[1])), constant_values=filler) for c in columns]
        return np.concatenate(columns)

    rows = Rows(**{name: whole(name) for name in Rows._fields if name != "table"}, table=tables.number)
    spare = -tables.rows % ROWS_PER_PROGRAM
    rows = jax.tree.map(lambda column: filled(column, tables.rows + spare), rows)
    for unread in (rows.measured, rows.no_orbit):
        unread[tables.rows :] = False
    value, error = _constraint_columns(problem, known)
    return parts[0]._replace(rows=rows, constraint_value=value, constraint_error=error, joint=joint)


def rows_of(table: AmplitudeTable) -> Rows:
    """Return the rows of a table, padded to a multiple of `ROWS_PER_PROGRAM`."""
    size = -(-table.rows // ROWS_PER_PROGRAM) * ROWS_PER_PROGRAM

    def padded(column, filler=None):
        column = np.asarray(column, float)
        filler = column[-1] if filler is None else filler
        return np.concatenate([column, np.full(size - column.shape[0], filler)])

    def side_by_side(columns):
        return np.stack([padded(column, np.nan) for column in columns.T], axis=1)

    # NumPy throughout: every JAX operation outside a compiled program would be compiled by itself.
    values, errors = readings_of(table)
    amplitude, error = side_by_side(values), side_by_side(errors)
    measured = np.isfinite(amplitude)
    unseen = np.zeros(table.rows) if table.no_orbit is None else np.nan_to_num(table.no_orbit)
    return Rows(
        order=padded(table.order),
        drive_frequency_khz=padded(table.drive_frequency_khz),
        drive_amplitude_nm=padded(table.excitation_nm),
        offset_nm=padded(table.offset_nm),
        amplitude_nm=np.where(measured, amplitude, 1.0),
        error_nm=np.where(measured, error, 1.0),
        measured=measured,
        no_orbit=padded(unseen, 0.0) > 0.0,
        free=np.zeros(size, dtype=bool),
        time=padded(np.linspace(-0.5, 0.5, table.rows) if drifts(table) else np.zeros(table.rows)),
    )


def drifts(table: AmplitudeTable) -> bool:
    """Say whether a table's rows stand in order of time, more than one."""
    return table.rows_in_order_of_time and table.rows > 1


def readings_of(
    table: AmplitudeTable | SeveralTables,
) -> tuple[Float[np.ndarray, "rows k"], Float[np.ndarray, "rows k"]]:
    """Return peak and lock-in amplitude and the phase, if the table has one; and their errors. NaN: not measured."""
    if isinstance(table, SeveralTables):
        parts = list(zip(*map(readings_of, table.tables), strict=True))
        kinds = max(part.shape[1] for part in parts[0])
        values, errors = (
            [np.pad(p, ((0, 0), (0, kinds - p.shape[1])), constant_values=np.nan) for p in part] for part in parts
        )
        return np.concatenate(values), np.concatenate(errors)
    peak, lockin = table.peak_amplitude_nm, table.lockin_amplitude_nm
    columns = [(peak, table.peak_amplitude_error_nm), (lockin, table.lockin_amplitude_error_nm)]
    phase, error = table.phase_and_error_deg
    if phase is not None:
        columns.append((phase, error))
    blank = np.full(table.rows, np.nan)
    values, errors = ([blank if one is None else one for one in part] for part in zip(*columns, strict=True))
    return np.stack(values, axis=1), np.stack(errors, axis=1)


class Reach(IntEnum):
    """Where a driven tip is: it meets the sample, stays clear of it, or is only drawn to it."""

    IMPACT = 0
    FREE = 1
    ATTRACTED = 2


def reach_of(rows: Rows, cantilever: Cantilever, drive: str) -> Int[np.ndarray, " rows"]:
    """Return the `Reach` of every row; where the sample is driven, all meet it.

    A tip is free whose amplitude leaves room for a bridge. Impacts push: the virial of the force, of the sign of
    Re(gamma W conj Z) with the height's lock-in value Z and W = Z + A0, is negative; where it is not, or the tip is out
    of reach without being free, the sample only draws it.
    """
    found = np.full(len(np.asarray(rows.order)), Reach.IMPACT)
    if drive == "sample":
        return found
    reach = np.asarray(rows.drive_amplitude_nm) + np.asarray(rows.offset_nm)
    found[(np.real(tip_work(rows, cantilever, drive)) > 0.0) | (reach < 0.0)] = Reach.ATTRACTED
    found[reach < -BRIDGE_NM] = Reach.FREE
    return found


def tip_work(rows: Rows, cantilever: Cantilever, drive: str) -> Complex[np.ndarray, " rows"]:
    """Return the first harmonic's force over k times height, gamma W conj Z with W = Z + A0, in nm^2.

    Its real part is twice the virial over k, its imaginary part minus the energy lost in a period over pi k. NaN where
    not both amplitude and lag were measured. Under "base" the height is that of the deflection that is read.
    """
    known = np.array(rows.measured)
    if known.shape[1] < 3:
        return np.full(len(known), np.nan, dtype=complex)
    read = np.where(np.all(known[:, 1:], axis=1, keepdims=True), np.asarray(rows.amplitude_nm)[:, 1:], np.nan)
    ratio = np.asarray(rows.drive_frequency_khz) / float(cantilever.frequency_khz)
    loss = 0.0 if cantilever.quality_factor is None else 1.0 / float(cantilever.quality_factor)
    gamma = (1.0 - ratio) * (1.0 + ratio) + 1j * ratio * loss
    free = np.asarray(rows.drive_amplitude_nm)
    height = -read[:, 0] * np.exp(-1j * (np.deg2rad(read[:, 1]) - np.angle(gamma)))
    if drive == "base":
        height = height * np.exp(-1j * np.angle(1.0 - gamma))
        free = free / np.abs(1.0 - gamma)
        height = height - gamma * free
    return gamma * (height + free) * np.conj(height)


class Held(NamedTuple):
    """A parameter that is held.

    Attributes:
        name: of the parameter.
        value: at which it is held.
        error: its standard error.
        assumed: nobody has said the error.
    """

    name: str
    value: float
    error: float
    assumed: bool


def split_held(
    own: tuple[str, ...], fixed: Mapping[str, float] | None, constraints: Mapping[str, tuple[float, float]] | None
) -> tuple[dict[str, float], dict[str, tuple[float, float]], dict[str, float]]:
    """Return what a fit of the contact holds, what is known of what it fits, and what is known of what it holds.

    Args:
        own: the parameters that are fitted.
        fixed: values at which others are held.
        constraints: value and standard error of what is known of any.

    Returns:
        The values, those of the constraints among them; the other constraints; the standard errors that are said.

    Raises:
        ValueError: if a parameter is held at two values, or a constraint on one is impossible.
    """
    values, others, errors = dict(fixed or {}), {}, {}
    for name, (value, error) in (constraints or {}).items():
        if name not in CONTACT_PARAMETER or name in own:
            others[name] = (value, error)
            continue
        check_constraints({name: (value, error)}, "contact", (name,))
        if values.get(name, value) != value:
            raise ValueError(
                f"{name} is held at {values[name]:g} (`fixed=...`) and known as {value:g}: say one of the two"
            )
        values[name], errors[name] = value, error
    return values, others, errors


def held_of(
    own: tuple[str, ...], effects: tuple[str, ...], fixed: Mapping[str, float], errors: Mapping[str, float]
) -> tuple[Held, ...]:
    """Return all parameters of a contact that are not fitted and mean something with its effects."""
    values = PAPER | dict(fixed)
    return tuple(
        Held(name, float(values[name]), errors.get(name, known.error_at(values[name])), name not in errors)
        for name, known in CONTACT_PARAMETER.items()
        if name not in own and not idle_without(name, effects)
    )
