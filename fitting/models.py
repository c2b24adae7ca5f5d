"""What is fitted of one table or of several, and what is known beforehand: a `Task`, from a fit's options."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float, Int

from afm_jax.contact.parameters import CONTACT_PARAMETER, EFFECTS, PAPER, idle_without
from afm_jax.impact.law import BRIDGE_NM
from fitting.parameters import (
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
    phase = table.phase_and_error_deg[0] is not None
    known = {}
    for drift, start, neutral, measured in (
        ("phase_drift_deg", "phase_zero_deg", 0.0, phase),
        ("free_amplitude_drift", "drive_calibration", 1.0, table.tapping),
    ):
        if measured and drifts(table):
            known[drift] = given.get(drift, (0.0, USUAL_DRIFTS[drift]))
            value, error = table.calibration.get(start, (neutral, 0.0))
            known[start] = value, float(np.hypot(error, 0.5 * np.hypot(*known[drift])))
    return known


class Task(NamedTuple):
    """A fit to do: what is known beforehand (value and error by parameter), and what is fitted."""

    known: dict[str, tuple[float, float]]
    problem: Problem


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
    """Return what a fit has to do: one law, and nuisances that are common or each table's own.

    Arguments and errors are as of `fit`.
    """
    each = [_known_of(member, model, constraints) for member in table.tables]
    nuisances = [name for name in NUISANCE_NAMES if any(name in known for known in each)]
    common = _shared(table, each, share, nuisances) if isinstance(table, SeveralTables) else nuisances
    own = model_parameters(model, None if free is None else tuple(free), fixed)
    known = {name: each[0][name] for name in (*own, *common) if name in each[0]}
    for member, label, of_table in zip(table.tables, table.labels, each, strict=True):
        if model == "contact" and member.tapping:
            _check_above_resonance(member)
        # what is each table's own may differ by what a delay takes up in common
        checked = {name: pair for name, pair in of_table.items() if name in common or name != "offset_origin_nm"}
        check_constraints(checked, model, own, member.drive)
        separate = [name for name in nuisances if name in of_table and name not in common]
        known |= {name_of_table(name, label): of_table[name] for name in separate}
    if isinstance(table, SeveralTables):
        table.check_different()
    return Task(known, Problem(model, own + tuple(filter(is_nuisance, known)), tuple(effects), table.drive))


def _known_of(
    table: AmplitudeTable, model: str, constraints: dict[str, tuple[float, float]] | None
) -> dict[str, tuple[float, float]]:
    """Return everything that is known beforehand of a table's fit, the quality factor's assumed error included."""
    known = constraints_of(table, constraints)
    if table.quality_factor is not None and (model.endswith("+delay") or model == "contact"):
        usual = USUAL_ERRORS["quality_factor"] * table.quality_factor
        known = {"quality_factor": (table.quality_factor, usual)} | known
    return known


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
    names = (*own, *NUISANCE_NAMES)
    for name, (value, error) in known.items():
        if name not in names:
            raise ValueError(f"the constraint on {name!r} is on no parameter: choose from {', '.join(names)}")
        if not (np.isfinite(value) and 0.0 < error < np.inf):
            raise ValueError(
                f"the constraint on {name} must be a value and a positive error, but is {value} +- {error}"
            )
    if "offset_origin_nm" in known and model.endswith("+delay") and drive == "sample":
        raise ValueError(
            "offset_origin_nm and delay_offset_nm shift the same thing: with a delay leave the constraint on "
            "offset_origin_nm out (delay_offset_nm takes it up), or fit the model 'contact'"
        )


def _shared(
    tables: SeveralTables,
    each: Sequence[dict[str, tuple[float, float]]],
    share: Sequence[str],
    nuisances: Sequence[str],
) -> list[str]:
    """Return the nuisances that several tables share.

    Raises:
        ValueError: if there is no such nuisance, or tables do not say the same of it.
    """
    for name in share:
        if name not in (*NUISANCE_NAMES, "all"):
            raise ValueError(f"`share` must be chosen from {', '.join(NUISANCE_NAMES)} and all, but one is {name!r}")
        if name not in (*nuisances, "all"):
            raise ValueError(f"`share` names {name}, but no table gives it with an error; state it, or leave it out")
    shared = [name for name in nuisances if "all" in share or name in share]
    for name in shared:
        said = ["nothing of it" if name not in known else "{:g} +- {:g}".format(*known[name]) for known in each]
        for label, words in zip(tables.labels, said, strict=True):
            if words != said[0]:
                raise ValueError(
                    f"{name} is shared, but {tables.labels[0]} says {said[0]}, and {label} says {words}; say it once "
                    "(`constraints=...`), or do not share it"
                )
    return shared


def drifts(table: AmplitudeTable) -> bool:
    """Say whether a table's rows stand in order of time, more than one."""
    return table.rows_in_order_of_time and table.rows > 1


def readings_of(
    table: AmplitudeTable | SeveralTables,
) -> tuple[Float[np.ndarray, "rows 3"], Float[np.ndarray, "rows 3"]]:
    """Return peak and lock-in amplitude and the phase, and their errors. NaN: not measured."""
    values, errors = [], []
    for one in table.tables:
        phase, its_error = one.phase_and_error_deg
        blank = np.full(one.rows, np.nan)
        columns = one.peak_amplitude_nm, one.lockin_amplitude_nm, phase
        of_error = one.peak_amplitude_error_nm, one.lockin_amplitude_error_nm, its_error
        values.append(np.column_stack([blank if column is None else column for column in columns]))
        errors.append(np.column_stack([blank if column is None else column for column in of_error]))
    return np.concatenate(values), np.concatenate(errors)


class Reach(IntEnum):
    """Where a driven tip is: it meets the sample, stays clear of it, or is only drawn to it."""

    IMPACT = 0
    FREE = 1
    ATTRACTED = 2


def reach_of(table: AmplitudeTable, quality_factor: float | None) -> Int[np.ndarray, " rows"]:
    """Return the `Reach` of every row; where the sample is driven, all meet it.

    A tip is free whose amplitude leaves room for a bridge. Impacts push: the virial of the force, of the sign of
    Re(gamma W conj Z) with the height's lock-in value Z and W = Z + A0, is negative; where it is not, or the tip is out
    of reach without being free, the sample only draws it.
    """
    found = np.full(table.rows, Reach.IMPACT)
    if table.drive == "sample":
        return found
    reach = np.asarray(table.excitation_nm) + np.asarray(table.offset_nm)
    found[(np.real(tip_work(table, quality_factor)) > 0.0) | (reach < 0.0)] = Reach.ATTRACTED
    found[reach < -BRIDGE_NM] = Reach.FREE
    return found


def tip_work(table: AmplitudeTable, quality_factor: float | None) -> Complex[np.ndarray, " rows"]:
    """Return the first harmonic's force over k times height, gamma W conj Z with W = Z + A0, in nm^2.

    Its real part is twice the virial over k, its imaginary part minus the energy lost in a period over pi k. NaN where
    not both amplitude and lag were measured. Under "base" the height is that of the deflection that is read.
    """
    _, amplitude, lag = readings_of(table)[0].T
    ratio = np.asarray(table.drive_frequency_khz) / float(table.free_frequency_khz)
    gamma = (1.0 - ratio) * (1.0 + ratio) + 1j * ratio * (0.0 if quality_factor is None else 1.0 / quality_factor)
    free = np.asarray(table.excitation_nm)
    height = -amplitude * np.exp(-1j * (np.deg2rad(lag) - np.angle(gamma)))
    if table.drive == "base":
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
