"""Direct inversion: amplitude and phase of each row give the speeds of its impact and the collision delay, no law."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from afm_jax.checks import checked, in_float64
from afm_jax.columns import CsvColumns, csv_columns, rows_of
from afm_jax.report import Cell, Section, sections, table_of
from afm_jax.results import JudgedResult, public_result
from afm_jax.saved import as_json
from afm_jax.solve.least_squares import IMPROBABLE, chi2_tail
from afm_jax.words import with_error
from fitting.infer.unknowns import NEUTRAL, UNDAMPED
from fitting.inversion.flight import invert_rows
from fitting.models import constraints_of, readings_of
from fitting.predict.orbit import Local, Row
from fitting.tables.csv_text import TableError
from fitting.tables.table import AmplitudeTable, TableLike, as_table

Rows = Float[np.ndarray, " rows"]
Impacts = Float[np.ndarray, "rows 3"]
Covariances = Float[np.ndarray, "rows 3 3"]
Shared = Float[np.ndarray, "rows 3 k"]
_SLOW = 2.5
"""Rows below this multiple of sqrt(epsilon) are left out of the lines: their contact is no short event any more."""
POWERS = {"viscous": 1, "restitution": 2}
"""By the law the power n of u_in in u_in^2 - u_out^2 = epsilon + slope u_in^n; slopes are viscous_loss and 1 - r^2."""


_INSTRUMENT = Local._fields[6:]
"""Quantities of the instrument that all rows share."""


@dataclass(frozen=True)
class Line:
    """The loss u_in^2 - u_out^2 as a straight line over 1 and u_in^n.

    Attributes:
        epsilon: in nm^2/us^2.
        epsilon_error: its standard error.
        slope: viscous_loss in nm/us, or 1 - r^2.
        slope_error: its standard error.
        chi2: of the rows.
        degrees_of_freedom: rows less two.
        p_value: probability of a larger chi2.
    """

    epsilon: float
    epsilon_error: float
    slope: float
    slope_error: float
    chi2: float
    degrees_of_freedom: int
    p_value: float


@public_result(picture="fitting.inversion.picture:inversion_figure")
@dataclass(frozen=True, eq=False, kw_only=True)
class Inversion(JudgedResult):
    """What `invert` finds; rows that give nothing are NaN and have a note.

    Attributes:
        approach_speed_nm_per_us: relative to the platform, shape (rows,).
        rebound_speed_nm_per_us: likewise; both are those of a free tip on a sample at rest.
        collision_delay_us: how much longer than an instantaneous impact.
        covariance: of these three, from the errors of each row's numbers.
        shared: change of the three by one standard error of each quantity that all rows share.
        shared_names: these quantities: quality_factor, free_frequency_khz, ...
        note: why a row gave nothing or is left out of the lines; else empty.
        in_lines: which rows the lines go through.
        lines: by "viscous" and "restitution"; empty where the rows determine none.
        table: what was inverted.
        reasons: why not.
        warnings: what a reader should know besides.
    """

    approach_speed_nm_per_us: Rows
    rebound_speed_nm_per_us: Rows
    collision_delay_us: Rows
    covariance: Covariances
    shared: Float[np.ndarray, "rows 3 shared"]
    shared_names: tuple[str, ...]
    note: tuple[str, ...]
    in_lines: Bool[np.ndarray, " rows"]
    lines: dict[str, Line]
    table: AmplitudeTable
    reasons: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()

    @property
    def errors(self) -> Impacts:
        """Standard errors of approach speed, rebound speed and delay, what rows share included."""
        return np.sqrt(np.diagonal(self.covariance, axis1=1, axis2=2) + np.sum(self.shared**2, axis=2))

    @property
    def preferred(self) -> str | None:
        """The law of the line with the smaller chi2; None without lines."""
        return min(self.lines, key=lambda name: self.lines[name].chi2, default=None)


@as_json.register
def _(result: Inversion) -> dict[str, Any]:
    names = ("valid", "reasons", "warnings", "preferred", "shared_names")
    own = {"format": "afm-jax invert", "format_version": 2} | {name: getattr(result, name) for name in names}
    rows = rows_of(csv_columns(result)["invert.csv"])
    return own | {"rows": rows, "lines": {name: vars(line) for name, line in result.lines.items()}}


@csv_columns.register
def _(result: Inversion) -> CsvColumns:
    drive = ("order", "drive_frequency_khz", "drive_amplitude_nm", "offset_nm")
    columns: dict[str, Any] = {name: getattr(result.table, name) for name in drive}
    found = {"approach_speed": "nm_per_us", "rebound_speed": "nm_per_us", "collision_delay": "us"}
    for (name, unit), error in zip(found.items(), result.errors.T, strict=True):
        columns |= {f"{name}_{unit}": getattr(result, f"{name}_{unit}"), f"{name}_error_{unit}": error}
    return {"invert.csv": columns | {"in_lines": result.in_lines, "note": list(result.note)}}


@sections.register
def _(result: Inversion) -> list[Section]:
    cells: dict[str, Cell] = {
        **{name: name.replace(" ", "_") for name in ("order", "drive frequency khz", "drive amplitude nm")},
        "approach\nnm/us": "approach_speed_nm_per_us:.4f",
        "rebound\nnm/us": "rebound_speed_nm_per_us:.4f",
        "delay\nus": "collision_delay_us:.4f",
        "note": "note",
    }
    lines = [
        f"u_in^2 - u_out^2 = epsilon + {name} u_in{'^2' * (law != 'viscous')}: epsilon "
        f"{with_error(line.epsilon, line.epsilon_error)}, {name} {with_error(line.slope, line.slope_error)}, "
        f"chi2/dof {line.chi2:.1f}/{line.degrees_of_freedom}"
        for (law, line), name in zip(result.lines.items(), ("viscous_loss", "(1 - r^2)"), strict=False)
    ]
    return [
        Section(f"{result.table.source}, {result.table.rows} rows", []),
        Section("Impacts", [table_of(cells, rows_of(csv_columns(result)["invert.csv"])), *lines]),
    ]


@checked
@in_float64
def invert(
    table: TableLike,
    *,
    noise: float | None = None,
    quality_factor: tuple[float, float | None] | float | str | None = None,
) -> Inversion:
    """Return approach speed, rebound speed and collision delay of every row with a phase, and lines through the losses.

    A row's amplitude and phase fix the flight between two impacts; no impact law is assumed. What the platform's
    motion and the air do during the contact is taken back by parameter-free corrections (`inversion.flight`), so that
    the speeds are those of a free tip on a sample at rest. The losses u_in^2 - u_out^2 are then set on a straight line
    over (1, u_in), a viscous loss, and over (1, u_in^2), a restitution.

    Args:
        table: from `read_table`, or its file, with phases; its free frequency is exactly known if it has no error.
        noise: of a file's amplitudes without an error, relative.
        quality_factor: in place of the table's: a number, a pair with its error, '40 +- 2', or 'none': no air damping.

    Returns:
        Rows with errors, lines and a verdict; see `Inversion`.

    Raises:
        TableError: if the table has no phase, or does not say its quality factor.
    """
    table = as_table(table, noise=noise, quality_factor=quality_factor)
    if table.tapping:
        raise TableError(
            f"{table.source}: the {'cantilever' if table.drive == 'base' else 'tip'} is driven here, not the sample; "
            "`afm-jax tapping` reads energy and impact speeds off such rows without a law, `afm-jax fit` fits a law"
        )
    value, error = readings_of(table)
    measured = np.isfinite(value) & np.isfinite(error)
    chosen = measured[:, 2] & measured[:, :2].any(axis=1)
    if not chosen.any():
        raise TableError(
            f"{table.source}: no row has a phase with an amplitude; add the columns phase_deg and phase_error_deg, or "
            "use `afm-jax fit`"
        )
    value, error = np.where(measured, value, 1.0), np.where(measured, error, np.inf)
    stated = {name: pair for name, pair in constraints_of(table, None).items() if name in _INSTRUMENT}
    known = NEUTRAL | {name: value for name, (value, _) in stated.items()}
    known |= {"quality_factor": table.quality_factor or UNDAMPED, "free_frequency_khz": table.free_frequency_khz}
    drive = (table.order, table.drive_frequency_khz, table.excitation_nm, table.offset_nm)
    never = np.zeros(table.rows, bool)
    row = Row(*(np.asarray(column, float) for column in drive), phase_deg=value[:, 2], free=never)
    instrument = np.tile([known.get(name, 0.0) for name in _INSTRUMENT], (table.rows, 1))
    impact, own, shared, chi2 = invert_rows(row, instrument, value, error)
    for found in (impact, own, shared):
        found[~chosen] = np.nan
    there = np.all(np.isfinite(impact), axis=1)
    covariance = own @ np.swapaxes(own, 1, 2)
    shared = shared[:, :, [_INSTRUMENT.index(name) for name in stated]] * [error for _, error in stated.values()]
    lines, in_lines = _lines(impact, covariance, shared, there)
    # the first that holds
    notes = {
        "no phase with an amplitude: nothing to invert": ~chosen,
        "no flight between two impacts has this amplitude and phase": ~there,
        "amplitudes and phase contradict each other by more than four standard errors": chi2 > 16.0,
        f"slower than {_SLOW} sqrt(epsilon): left out of the lines": ~in_lines,
    }
    u, w, delay = impact.T
    unsure = table.quality_factor is not None and table.quality_factor_error is None
    reason = _why_not_valid(u, lines, int(in_lines.sum()))
    return Inversion(
        approach_speed_nm_per_us=u,
        rebound_speed_nm_per_us=w,
        collision_delay_us=delay,
        covariance=covariance,
        shared=shared,
        shared_names=tuple(stated),
        note=tuple(np.select([*notes.values()], [*notes], "").tolist()),
        in_lines=in_lines,
        lines=lines,
        table=table,
        reasons=() if reason is None else (reason,),
        warnings=("Q comes without an error: its uncertainty is not in the errors here",) if unsure else (),
    )


def _why_not_valid(speed: Rows, lines: dict[str, Line], rows: int) -> str | None:
    """Return why approach speeds, and the lines through so many rows, are no measurement; None where they are."""
    if not np.isfinite(speed).any():
        return "no row could be inverted: check the phases' sign and zero (t = 0 when the platform is highest)"
    if not lines:
        return f"{rows} rows do not determine a line of two coefficients: measure at more drives"
    if max(one.p_value for one in lines.values()) < IMPROBABLE:
        return "neither line explains the rows: check the errors, Q, and the calibration of tip and drive"
    if all(abs(one.epsilon) < 2 * one.epsilon_error and abs(one.slope) < 2 * one.slope_error for one in lines.values()):
        return "the rows determine no coefficient of either line to two standard errors: measure more finely"
    return None


def _lines(
    impact: Impacts, covariance: Covariances, shared: Shared, there: Bool[np.ndarray, " rows"]
) -> tuple[dict[str, Line], Bool[np.ndarray, " rows"]]:
    """Return the lines through the losses, and which of the rows that are there they go through: not too slow ones."""
    fast, lines = there, {}
    for _ in range(2):
        if fast.sum() < 3 or np.ptp(impact[fast, 0]) < 1e-6 * impact[fast, 0].max():
            return {}, fast
        lines = {law: line(impact[fast], covariance[fast], shared[fast], power) for law, power in POWERS.items()}
        epsilon = min(lines.values(), key=lambda one: one.chi2).epsilon
        fast = there & (impact[:, 0] > _SLOW * max(epsilon, 0.0) ** 0.5)
    return lines, fast


def line(impact: Impacts, covariance: Covariances, shared: Shared, power: int) -> Line:
    """Return the line u_in^2 - u_out^2 = epsilon + slope u_in^n of correlated rows.

    The residual of a row varies by (2 u_in - n slope u_in^(n - 1), -2 u_out) times the errors of its speeds, which its
    covariance and what all rows share give together (total least squares to first order).

    Args:
        impact: approach speeds, rebound speeds and delays.
        covariance: of each row's.
        shared: their changes by one standard error of each quantity that all rows share.
        power: n.
    """
    u, w, _ = impact.T
    design, wanted = np.stack([np.ones_like(u), u**power], axis=1), u**2 - w**2
    whiten = inverse = np.zeros((2, 2))
    found = np.zeros(2)
    for _ in range(7):
        slopes = np.stack([2.0 * u - power * found[1] * u ** (power - 1), -2.0 * w], axis=1)
        common = np.einsum("ni,nik->nk", slopes, shared[:, :2])
        own = np.einsum("ni,nij,nj->n", slopes, covariance[:, :2, :2], slopes)
        # by the root of the covariance of all residuals
        whiten = np.linalg.inv(np.linalg.cholesky(np.diag(own) + common @ common.T))
        inverse = np.linalg.pinv(whiten @ design)
        found = inverse @ whiten @ wanted
    chi2, freedom = float(np.sum((whiten @ (design @ found - wanted)) ** 2)), len(u) - 2
    (epsilon, slope), (epsilon_error, slope_error) = found.tolist(), np.linalg.norm(inverse, axis=1).tolist()
    return Line(epsilon, epsilon_error, slope, slope_error, chi2, freedom, chi2_tail(chi2, freedom))
