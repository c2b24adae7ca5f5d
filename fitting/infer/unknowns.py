"""Everything that is unknown in a fit as one vector with priors, and what the rows read as a function of it.

The vector holds the unknowns of the law (`fitting.predict.law`), one factor of N(0, 1) for each leading remainder of
the corrections of impacts that last, and the instrument's quantities, each in standard errors of what is known of it. A
new nuisance is an entry of `_MOVES`, and a term of `Model.local`.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from afm_jax.contact.parameters import PAPER
from fitting.models import Reach, Task, drifts, reach_of, readings_of
from fitting.parameters import CONTACT_NAMES, PARAMETERS, is_nuisance, name_of_table
from fitting.predict.law import LawModel
from fitting.predict.orbit import COUNT, READINGS, Local, Orbits, Row, followed, starts_of
from fitting.tables.several import SeveralTables
from fitting.tables.table import AmplitudeTable

UNDAMPED = 1e15
"""Quality factor of no air damping: by an infinite one there is no derivative."""
REMAINDERS = 7
"""Leading terms that the corrections of impacts that last leave out."""


def weak_prior(name: str, mass_ng: float) -> tuple[float, float]:
    """Return what is known of any tip of an unknown of a law: so wide that it decides only where readings say nothing.

    Args:
        name: of the parameter.
        mass_ng: of the tip.
    """
    wide = {
        "epsilon": (np.log(100.0 / mass_ng), 10.0),
        "delay_hertz": (np.log(0.2 * mass_ng**0.4), 5.0),
        "delay_lead_nm": (5.0, 30.0),
        "delay_offset_nm": (0.0, 10.0),
    }
    if name in CONTACT_NAMES:
        parameter = PARAMETERS[name]
        return (0.0, 10.0) if parameter.width else (float(np.log(max(PAPER[name], 1e-3))), 5.0)
    return wide.get(name, (0.0, np.inf))


@dataclass(frozen=True, eq=False)
class Data:
    """The rows of one table or of several, one after the other.

    Attributes:
        row: what was set.
        read: peak and lock-in amplitude in nm, phase in degrees; NaN where nothing was measured; shape (rows, 3).
        error: their standard errors.
        no_orbit: the drive was tried and no steady orbit seen.
        time: from -1/2 to 1/2 where a table's rows stand in order of time, else 0.
        number: of the row's table.
        drives: what is driven in each table.
        free_frequency_khz, quality_factor: as each row's table gives them; `UNDAMPED`: no air damping.
        mass_ng: of the tip.
    """

    row: Row
    read: Float[np.ndarray, "rows 3"]
    error: Float[np.ndarray, "rows 3"]
    no_orbit: Bool[np.ndarray, " rows"]
    time: Float[np.ndarray, " rows"]
    number: Int[np.ndarray, " rows"]
    drives: tuple[str, ...]
    free_frequency_khz: Float[np.ndarray, " rows"]
    quality_factor: Float[np.ndarray, " rows"]
    mass_ng: float

    @property
    def measured(self) -> Bool[np.ndarray, "rows 3"]:
        """What was measured."""
        return np.isfinite(self.read)

    @cached_property
    def tapping(self) -> Bool[np.ndarray, " rows"]:
        """Rows whose cantilever is driven itself."""
        return np.array([drive != "sample" for drive in self.drives])[self.number]

    @cached_property
    def groups(self) -> list[tuple[str, np.ndarray]]:
        """What is driven, and the rows of it: one program each."""
        drive = np.array(self.drives)[self.number]
        return [(name, np.flatnonzero(drive == name)) for name in dict.fromkeys(self.drives)]

    def scaled(self, factor: float) -> "Data":
        """Return the rows with errors times a factor."""
        return replace(self, error=self.error * factor)


def data_of(table: AmplitudeTable | SeveralTables, task: Task) -> Data:
    """Return the rows that a fit has to explain; a Q that the table leaves open is what is known of it besides."""
    tables, columns, heads = table.tables, [], []
    for member, label in zip(tables, table.labels, strict=True):
        quality = member.quality_factor
        if quality is not None and np.isnan(quality):
            known = task.known.get(name_of_table("quality_factor", label)) or task.known["quality_factor"]
            quality = known[0]
        heads.append((member.free_frequency_khz, UNDAMPED if quality is None else float(quality)))
        columns.append(_columns_of(member, quality))
    number = np.repeat(np.arange(len(tables)), [member.rows for member in tables])
    whole = {name: np.concatenate([part[name] for part in columns]) for name in columns[0]}
    read = whole["read"]
    return Data(
        row=Row(*(whole[name] for name in Row._fields[:4]), phase_deg=np.nan_to_num(read[:, 2]), free=whole["free"]),
        read=read,
        error=whole["error"],
        no_orbit=whole["no_orbit"],
        time=whole["time"],
        number=number,
        drives=tuple(member.drive for member in tables),
        free_frequency_khz=np.array([float(frequency) for frequency, _ in heads])[number],
        quality_factor=np.array([quality for _, quality in heads])[number],
        mass_ng=1.0 if table.mass_ng is None else float(table.mass_ng),
    )


def _columns_of(table: AmplitudeTable, quality_factor: float | None) -> dict[str, np.ndarray]:
    """Return the rows of one table; of a driven tip those that are only drawn to the sample count as not measured."""
    values, errors = readings_of(table)
    measured, free = np.isfinite(values), np.zeros(table.rows, bool)
    if table.tapping:
        reach = reach_of(table, quality_factor)
        measured, free = measured & (reach != Reach.ATTRACTED)[:, None], reach == Reach.FREE
    missing = ((0, 0), (0, READINGS - values.shape[1]))
    read, error = (
        np.pad(np.where(measured, part, np.nan), missing, constant_values=np.nan) for part in (values, errors)
    )
    return {
        "order": np.asarray(table.order, float),
        "drive_frequency_khz": np.asarray(table.drive_frequency_khz, float),
        "drive_amplitude_nm": np.asarray(table.excitation_nm, float),
        "offset_nm": np.asarray(table.offset_nm, float),
        "read": read,
        "error": error,
        "no_orbit": np.zeros(table.rows, bool) if table.no_orbit is None else np.nan_to_num(table.no_orbit) > 0.0,
        "time": np.linspace(-0.5, 0.5, table.rows) if drifts(table) else np.zeros(table.rows),
        "free": free,
    }


class Quantity(NamedTuple):
    """A quantity of the instrument that is unknown: its name, value and error as known, and the rows that it is of."""

    name: str
    value: float
    error: float
    rows: Bool[np.ndarray, " rows"]

    @property
    def kind(self) -> str:
        """The name without that of a table."""
        return self.name.partition(" of ")[0]

    def at(self, unknown: Any, numpy: Any = np) -> Any:
        """Return the value at an unknown, of NumPy or JAX: frequency and Q move by factors, all else by differences."""
        if self.kind in _FACTORS:
            return self.value * numpy.exp(self.error / self.value * unknown)
        return self.value + self.error * unknown

    def unknown(self, value: float) -> float:
        """Return the unknown for a value."""
        if self.kind in _FACTORS:
            return float(np.log(value / self.value)) * self.value / self.error
        return (value - self.value) / self.error

    def slope(self, unknown: float) -> float:
        """Return d value/d unknown."""
        return self.error * self.at(unknown) / self.value if self.kind in _FACTORS else self.error


_FACTORS = ("free_frequency_khz", "quality_factor")
_MOVES = {
    "free_frequency_khz": "free_frequency_khz",
    "quality_factor": "quality_factor",
    "drive_calibration": "drive_calibration",
    "free_amplitude_drift": "drive_calibration",
    "offset_origin_nm": "offset_origin_nm",
    "tip_calibration": "tip_calibration",
    "phase_zero_deg": "phase_zero_deg",
    "phase_drift_deg": "phase_zero_deg",
}
"""Which `Local` a quantity moves."""
NEUTRAL = {"drive_calibration": 1.0, "tip_calibration": 1.0}
"""What stands for the absence of a quantity, if that is not 0 or what the table gives."""


@dataclass(frozen=True, eq=False)
class Model:
    """What is fitted: a law, with or without remainders of its corrections, and an instrument.

    Attributes:
        data: the rows.
        law: as a function of its unknowns.
        instrument: unknown quantities.
        known: value and standard error of what is known of the law's parameters, by their names.
        remainders: change of w^2 and of the delay of every row by each remainder, shape (2, rows, 7); None: without.
    """

    data: Data
    law: LawModel
    instrument: tuple[Quantity, ...] = ()
    known: Mapping[str, tuple[float, float]] | None = None
    remainders: Float[np.ndarray, "2 rows 7"] | None = None

    @cached_property
    def names(self) -> tuple[str, ...]:
        """The unknowns, in the order of every vector."""
        rest = () if self.remainders is None else tuple(f"remainder_{i}" for i in range(REMAINDERS))
        return (*self.law.names, *rest, *(quantity.name for quantity in self.instrument))

    @cached_property
    def prior(self) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, " k"]]:
        """Mean of every unknown, and one over the standard deviation: 0 where nothing is known."""
        mean, strength = np.zeros(len(self.names)), np.ones(len(self.names))
        own = self.law.own
        for i, name in enumerate(self.law.names):
            if name in own:
                mean[i], strength[i] = self._known_of(name)
        return mean, strength

    @property
    def lowest(self) -> Float[np.ndarray, " k"]:
        """Lowest value of every unknown: no impact on a sample at rest gives energy."""
        return np.array([0.0 if name == "viscous_loss" else -np.inf for name in self.names])

    def _known_of(self, name: str) -> tuple[float, float]:
        """Return what is known of a parameter's unknown: the mean, and one over the standard deviation."""
        law = self.law
        if name not in (self.known or {}):
            value, error = weak_prior(name, self.data.mass_ng) if law.lasting else (0.0, np.inf)
            return value, 1.0 / error
        value, error = (self.known or {})[name]
        # to first order
        low, here, high = (float(law.unknown_of(name, value + side * error)) for side in (-1e-3, 0.0, 1e-3))
        return here, 2e-3 / max(abs(high - low), 1e-300)

    def of_law(self, theta: Float[np.ndarray, " k"]) -> Float[np.ndarray, " l"]:
        """Return the unknowns of the law."""
        return theta[: len(self.law.names)]

    def _instrument_at(self, theta: Any, numpy: Any = np) -> dict[str, Any]:
        """Return every quantity of the instrument for each row, by its kind."""
        data, first = self.data, len(self.names) - len(self.instrument)
        known = {name: numpy.full(data.time.shape, NEUTRAL.get(name, 0.0)) for name in _MOVES}
        known |= {name: numpy.asarray(getattr(data, name)) for name in _FACTORS}
        for i, quantity in enumerate(self.instrument):
            value = quantity.at(theta[first + i], numpy)
            known[quantity.kind] = numpy.where(quantity.rows, value, known[quantity.kind])
        return known

    def instrument_columns(self, theta: Any, numpy: Any = np) -> list[Any]:
        """Return what the instrument is for every row: the last columns of `Local`, of NumPy or JAX."""
        known = self._instrument_at(theta, numpy)
        known["drive_calibration"] = known["drive_calibration"] * (1.0 + known["free_amplitude_drift"] * self.data.time)
        known["phase_zero_deg"] = known["phase_zero_deg"] + known["phase_drift_deg"] * self.data.time
        return [known[name] for name in Local._fields[6:]]

    def local(self, theta: Float[np.ndarray, " k"]) -> Float[np.ndarray, "rows local"]:
        """Return what law and instrument are for every row, columns as `Local`."""
        found = np.zeros((self.data.time.size, COUNT))
        found[:, 2:6] = self.law.coefficients(self.of_law(theta))[0]
        found[:, 6:] = np.stack(self.instrument_columns(theta), axis=1)
        if self.remainders is not None:
            first = len(self.law.names)
            found[:, :2] += (self.remainders @ theta[first : first + REMAINDERS]).T
        return found

    def slopes(self, theta: Float[np.ndarray, " k"], orbits: Orbits) -> Float[np.ndarray, "rows 3 k"]:
        """Return the derivatives of the readings by the unknowns: local slopes times what law and instrument change."""
        known = len(self.law.names)
        along = np.zeros((len(orbits.x), READINGS, len(self.names)))
        speeds = np.where(np.isfinite(orbits.approach) & (orbits.approach > 0.0), orbits.approach, 100.0)
        law, by_local = self.law.at(self.of_law(theta), speeds), orbits.slopes
        along[:, :, :known] = (
            by_local[:, :, 0, None] * law.square_slope[:, None] + by_local[:, :, 1, None] * law.time_slope[:, None]
        )
        along[:, :, :known] += by_local[:, :, 2:6] @ self.law.coefficients(self.of_law(theta))[1]
        if self.remainders is not None:
            of_law = by_local[:, :, 0, None] * self.remainders[0, :, None]
            along[:, :, known : known + REMAINDERS] = of_law + by_local[:, :, 1, None] * self.remainders[1, :, None]
        along[:, :, len(self.names) - len(self.instrument) :] = self.slopes_by_instrument(theta, by_local)
        return along

    def slopes_by_instrument(
        self, theta: Float[np.ndarray, " k"], by_local: Float[np.ndarray, "rows 3 local"]
    ) -> Float[np.ndarray, "rows 3 quantities"]:
        """Return the derivatives of the readings by the instrument's unknowns."""
        at, first = self._instrument_at(theta), len(self.names) - len(self.instrument)
        along = np.zeros((len(by_local), READINGS, len(self.instrument)))
        of_time = {
            "drive_calibration": 1.0 + at["free_amplitude_drift"] * self.data.time,
            "free_amplitude_drift": at["drive_calibration"] * self.data.time,
            "phase_drift_deg": self.data.time,
        }
        for i, quantity in enumerate(self.instrument):
            size = quantity.slope(float(theta[first + i])) * of_time.get(quantity.kind, np.ones_like(self.data.time))
            moved = by_local[:, :, Local._fields.index(_MOVES[quantity.kind])]
            along[:, :, i] = np.where(quantity.rows[:, None], moved * size[:, None], 0.0)
        return along

    def follow(
        self, theta: Float[np.ndarray, " k"], x: Float[np.ndarray, "rows 3"], *, most: int = 14, judge: bool = False
    ) -> Orbits:
        """Return the orbits of all rows from where they were, NaN where there was none."""
        local, table = self.local(theta), self.law.table(self.of_law(theta))
        whole = no_orbits(self.data.time.size)
        for drive, some in self.data.groups:
            found = followed(x[some], local[some], self.data.row.take(some), table, drive, most=most, judge=judge)
            for column, part in zip(whole, found, strict=True):
                column[some] = part
        return whole

    def candidates(
        self, theta: Float[np.ndarray, " k"], rows: np.ndarray, *, most: int = 14, judge: bool = True
    ) -> tuple[np.ndarray, Orbits]:
        """Return all orbits of some rows at unknowns, searched for, and the row of each."""
        local, table, parts = self.local(theta), self.law.table(self.of_law(theta)), []
        for drive, some in self.data.groups:
            mine = np.intersect1d(some, rows)
            if not mine.size:
                continue
            which, x = starts_of(local[mine], self.data.row.take(mine), table, drive)
            if which.size:
                at = mine[which]
                parts.append((at, followed(x, local[at], self.data.row.take(at), table, drive, most=most, judge=judge)))
        if not parts:
            return np.zeros(0, int), no_orbits(0)
        return np.concatenate([at for at, _ in parts]), Orbits(
            *map(np.concatenate, zip(*(o for _, o in parts), strict=True))
        )


def no_orbits(count: int) -> Orbits:
    """Return room for the orbits of so many rows."""
    shapes = {"x": (3,), "readings": (READINGS,), "slopes": (READINGS, COUNT)}
    kinds: dict[str, type] = dict.fromkeys(("closes", "steady", "growing"), bool)
    return Orbits(*(np.zeros((count, *shapes.get(name, ())), kinds.get(name, float)) for name in Orbits._fields))


def quantities_of(data: Data, task: Task, labels: tuple[str, ...]) -> tuple[Quantity, ...]:
    """Return what is unknown of the instrument, from what a task knows of it beforehand."""
    found = []
    for name in filter(is_nuisance, task.problem.names):
        value, error = task.known[name]
        _, _, label = name.partition(" of ")
        mine = data.number == labels.index(label) if label else np.ones(data.number.size, bool)
        found.append(Quantity(name, value, error, mine))
    return tuple(found)
