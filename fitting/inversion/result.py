"""What a direct inversion found, point by point and as laws, and everything that went into it.

Beside it stands the paper's own reading of amplitudes on resonance: the velocities from the amplitudes alone, the phase
assumed. On a subharmonic resonance, omega = 2 N Omega, the paper takes the impact to occur where the sample is fastest
(drive phase 3 pi/2) and the flight to be an undamped half oscillation: V' = Omega a, V = -Omega a, so that

    u_in = Omega a + beta omega,    u_out = Omega a - beta omega.

Air damping, the collision delay and the offset are left out; with them the phase is another.
"""

from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from afm_jax.impact.law import ImpactLaw, Law, TabulatedLaw
from afm_jax.results import Result, public_result
from afm_jax.strict_json import plain
from afm_jax.units import RAD_PER_US_PER_KHZ
from fitting.fits.result import FittedLaw
from fitting.tables.table import AmplitudeTable

ASSUMPTION = (
    "on resonance, omega = 2 N Omega, the tip hits where the sample is fastest (phase 3 pi/2), in instantaneous "
    "impacts between undamped half oscillations: V' = Omega a"
)
TOLERANCE = 5e-4
"""Relative distance of the drive frequency from 2 N times the free one up to which a row counts as on resonance."""
Rebound = Callable[[Float[np.ndarray, " n"]], Float[np.ndarray, " n"]]
_FEWEST_POINTS = 4
"""Speeds that a law needs at least."""
_HALF_SINE = 4.0 / (3.0 * np.pi)
"""Lock-in amplitude of half sines at their own frequency, over their height."""


@dataclass(frozen=True, kw_only=True)
class ResonanceReading:
    """The paper's reading of the rows on resonance; arrays of one entry per such row.

    Attributes:
        assumption: what it takes for granted.
        row: numbers of the rows in the table, from 0.
        approach_speed_nm_per_us: u_in.
        rebound_speed_nm_per_us: u_out.
        speed_error_nm_per_us: standard error of both: they share that of the amplitude.
        reference: what the bias is against: "truth", "phase" (the same rows inverted), "law" (regressed), or "none".
        reference_rebound_nm_per_us: u_out of the reference at the approach speed read, NaN where it has none.
        bias: rebound speed over that of the reference, less 1.
    """

    assumption: str
    row: Int[np.ndarray, " n"]
    approach_speed_nm_per_us: Float[np.ndarray, " n"]
    rebound_speed_nm_per_us: Float[np.ndarray, " n"]
    speed_error_nm_per_us: Float[np.ndarray, " n"]
    reference: str
    reference_rebound_nm_per_us: Float[np.ndarray, " n"]
    bias: Float[np.ndarray, " n"]


def on_resonance(table: AmplitudeTable) -> Bool[np.ndarray, " rows"]:
    """Return which rows of a table are driven at 2 N times the free frequency."""
    return np.abs(table.drive_frequency_khz / (2.0 * table.order * table.free_frequency_khz) - 1.0) <= TOLERANCE


def read_on_resonance(
    table: AmplitudeTable,
    *,
    law: Rebound | None,
    reference: str,
) -> ResonanceReading:
    """Return the paper's reading of the rows on resonance, beside a law that is known otherwise.

    The amplitude is the peak height, or what half sines of the lock-in amplitude reach.

    Args:
        table: the table.
        law: rebound speed for approach speeds in nm/us to compare with, NaN where it says nothing; None: there is none.
        reference: what that law is called.
    """
    blank = np.full(table.rows, np.nan)
    peak, peak_error = table.peak_amplitude_nm, table.peak_amplitude_error_nm
    peak, peak_error = (blank if part is None else part for part in (peak, peak_error))
    lockin, lockin_error = table.lockin_amplitude_nm, table.lockin_amplitude_error_nm
    lockin, lockin_error = (blank if part is None else part / _HALF_SINE for part in (lockin, lockin_error))
    height, error = np.where(np.isfinite(peak), (peak, peak_error), (lockin, lockin_error))
    row = np.flatnonzero(on_resonance(table))
    speed = RAD_PER_US_PER_KHZ * table.free_frequency_khz * height[row]
    top = RAD_PER_US_PER_KHZ * table.drive_frequency_khz[row] * table.excitation_nm[row]
    approach, rebound = speed + top, speed - top
    expected = np.full(len(row), np.nan) if law is None else law(approach)
    return ResonanceReading(
        assumption=ASSUMPTION,
        row=row,
        approach_speed_nm_per_us=approach,
        rebound_speed_nm_per_us=rebound,
        speed_error_nm_per_us=RAD_PER_US_PER_KHZ * table.free_frequency_khz * error[row],
        reference=reference if law is not None else "none",
        reference_rebound_nm_per_us=expected,
        bias=rebound / expected - 1.0,
    )


_APART = 3.0
"""Standard errors that rows may be from a law in the median (0.67 expected) before it counts as another's."""
FORMAT_VERSION = 2
"""Version of the JSON layout; raised when a key changes its meaning or goes."""


@dataclass(frozen=True, kw_only=True)
class InvertedRows:
    """The impacts of all rows of a table, as those of a free tip on a sample at rest; NaN where a row has none.

    Attributes:
        impact: approach speed, rebound speed (nm/us) and collision delay (us), shape (rows, 3).
        covariance: of the three, from the errors of the row's own numbers, shape (rows, 3, 3).
        shared: by how much the three move with one standard error of what all rows share, shape (rows, 3, shared).
        shared_names: what the rows share: "quality_factor", "free_frequency_khz".
        chi2: of a row's three measured numbers (one degree of freedom); NaN where there are only two.
        regressed: whether the row enters the laws.
        note: why a row was not inverted or not regressed; empty where there is nothing to say.
    """

    impact: Float[np.ndarray, "rows 3"]
    covariance: Float[np.ndarray, "rows 3 3"]
    shared: Float[np.ndarray, "rows 3 shared"]
    shared_names: tuple[str, ...]
    chi2: Float[np.ndarray, " rows"]
    regressed: Bool[np.ndarray, " rows"]
    note: tuple[str, ...]

    @property
    def inverted(self) -> Bool[np.ndarray, " rows"]:
        """Which rows were inverted."""
        return np.asarray(np.isfinite(self.impact).all(axis=1))

    @property
    def errors(self) -> Float[np.ndarray, "rows 3"]:
        """Standard errors from the row's own numbers."""
        return np.sqrt(np.diagonal(self.covariance, axis1=1, axis2=2))

    @property
    def systematic_errors(self) -> Float[np.ndarray, "rows 3"]:
        """Standard errors from what all rows share."""
        return np.sqrt(np.sum(self.shared**2, axis=2))


@dataclass(frozen=True)
class Coefficient:
    """A coefficient of a regressed law; its standard error holds the systematic one (of Q and frequency)."""

    value: float
    unit: str
    standard_error: float | None
    systematic_error: float | None


@dataclass(frozen=True)
class RegressedLaw:
    """A law regressed on the rows.

    Attributes:
        model: "viscous" (u_out^2 = u_in^2 - epsilon - viscous_loss u_in), "restitution" (u_out^2 = r^2 u_in^2 -
            epsilon, eq. 6) or "delay" (tau = hertz u_in^(-1/5) - lead_nm (1/u_out - 1/u_in) - offset_nm/u_in).
        parameters: by name.
        chi2: sum of squared normalised residuals.
        degrees_of_freedom: rows less coefficients.
        p_value: probability of a larger chi2 if the law is right.
        pulls: by how many standard errors Q and frequency are moved, by name.
        curve: the law at the result's speeds: rebound speed in nm/us (NaN where captured), or the delay in us.
        curve_changes: changes of the curve by one standard deviation of each of several independent unknowns.
    """

    model: str
    parameters: dict[str, Coefficient]
    chi2: float
    degrees_of_freedom: int
    p_value: float
    pulls: dict[str, float]
    curve: Float[np.ndarray, " points"]
    curve_changes: Float[np.ndarray, "points unknowns"]

    @property
    def curve_error(self) -> Float[np.ndarray, " points"]:
        """Standard error of the curve."""
        return np.linalg.norm(self.curve_changes, axis=1)

    def to_dict(self) -> dict[str, Any]:
        """Return the law as plain numbers."""
        told = asdict(self)
        del told["curve_changes"]
        return told | {"curve_error": self.curve_error}


class LawDistance(NamedTuple):
    """How far inverted rows are from a law that is known otherwise.

    Attributes:
        rows_compared: inverted rows within the speeds that the law is known for.
        median_distance_in_errors: median distance of their rebound speeds from the law's, in standard errors; None
            without such rows.
        extrapolated: a sentence on rows outside these speeds; None: there are none.
    """

    rows_compared: int
    median_distance_in_errors: float | None
    extrapolated: str | None

    @property
    def agrees(self) -> bool:
        """Whether rows and law are apart by no more than noise explains."""
        return self.median_distance_in_errors is None or self.median_distance_in_errors <= _APART


def described(law: Law) -> str:
    """Return what a law comes from and over which speeds it is known, in words."""
    if not isinstance(law, TabulatedLaw):
        return "a law"
    what = f"a law ({law.origin.text})" if law.origin.text else "a law"
    return f"{what}, known from {float(law.slowest_nm_per_us):.4g} to {float(law.fastest_nm_per_us):.4g} nm/us"


@public_result(picture="fitting.inversion.report:inversion_figure", rows="records")
@dataclass(frozen=True, kw_only=True)
class Inversion(Result):
    """Speeds and delay of the impact of each row, and the laws regressed on them: what `invert` returns.

    Attributes:
        table: what was inverted.
        rows: speeds, delay and errors of each row.
        approach_speed_nm_per_us: speeds at which the laws' curves are given, shape (points,).
        laws: the regressions of the loss, by model; empty where rows do not determine one.
        delay: the delay law, or None.
        preferred: the model that chi2 prefers, or None where it does not tell.
        verdict: which law the rows prefer, in words.
        resonance: the paper's own reading of the rows on resonance.
        beside: a law that is known otherwise, if one was given.
        distance: how far the rows are from `beside`; None without that.
        valid: whether rows determine what is asked; `reasons` say why not.
        reasons: what makes the result invalid.
        warnings: what a reader should know besides.
        versions: of the packages that computed it.
    """

    table: AmplitudeTable
    rows: InvertedRows
    approach_speed_nm_per_us: Float[np.ndarray, " points"]
    laws: dict[str, RegressedLaw]
    delay: RegressedLaw | None
    preferred: str | None
    verdict: str
    resonance: ResonanceReading
    beside: ImpactLaw | TabulatedLaw | None
    distance: LawDistance | None
    valid: bool
    reasons: list[str]
    warnings: list[str]
    versions: dict[str, str]

    def records(self) -> list[dict[str, Any]]:
        """Return a mapping per row of the table; what is not known is None."""
        table, rows = self.table, self.rows
        lines = table.lines if len(table.lines) else np.arange(1, table.rows + 1)
        errors, systematic = rows.errors, rows.systematic_errors
        with np.errstate(invalid="ignore", divide="ignore"):
            correlation = rows.covariance[:, 0, 1] / errors[:, 0] / errors[:, 1]
        columns: dict[str, Any] = {
            "line": lines,
            "order": table.order,
            "drive_frequency_khz": table.drive_frequency_khz,
            "drive_amplitude_nm": table.excitation_nm,
            "offset_nm": table.offset_nm,
        }
        for k, (name, unit) in enumerate(
            (("approach_speed", "nm_per_us"), ("rebound_speed", "nm_per_us"), ("collision_delay", "us"))
        ):
            columns[f"{name}_{unit}"] = rows.impact[:, k]
            columns[f"{name}_error_{unit}"] = errors[:, k]
            columns[f"{name}_systematic_{unit}"] = systematic[:, k]
        columns |= {"speed_correlation": correlation, "chi2": rows.chi2, "regressed": rows.regressed, "note": rows.note}
        flat = {name: plain(column) for name, column in columns.items()}
        return [{name: column[i] for name, column in flat.items()} for i in range(table.rows)]

    @cached_property
    def law(self) -> FittedLaw | None:
        """The law that chi2 prefers, viscous where it does not tell, with the delay: what a scene takes.

        None where none is regressed, or where it leaves faster than it comes.
        """
        found = self.laws.get(self.preferred or "viscous")
        if found is None:
            return None
        u, rebound = self.approach_speed_nm_per_us, np.nan_to_num(found.curve)
        if np.any(rebound > u) or np.count_nonzero(rebound) < _FEWEST_POINTS:
            return None
        delay = np.zeros_like(u) if self.delay is None else self.delay.curve
        of_rebound = np.nan_to_num(found.curve_changes)
        of_delay = np.zeros((u.size, 0)) if self.delay is None else self.delay.curve_changes
        known = {name: one.value for name, one in found.parameters.items()}
        formula = ImpactLaw(
            known.get("r", 1.0), max(known.get("epsilon", 0.0), 0.0), max(known.get("viscous_loss", 0.0), 0.0)
        )
        loose, late = of_rebound.shape[1], of_delay.shape[1]
        changes = np.pad(of_rebound, ((0, 0), (0, late))), np.pad(of_delay, ((0, 0), (loose, 0)))
        return FittedLaw(
            u,
            rebound,
            delay,
            capture_speed_nm_per_us=float(formula.capture_speed_nm_per_us),
            delay=None,
            lasting=self.delay is not None,
            errors=(np.stack(changes, axis=1), np.full(loose + late, np.nan)),
            mass_ng=self.table.mass_ng,
            origin=f"{found.model} law regressed on {self.table.source}",
        )

    def to_dict(self) -> dict[str, Any]:
        """Return everything as plain lists, numbers and strings; what is not known is None."""
        law = {name: found.to_dict() for name, found in self.laws.items()}
        curve = self.laws.get(self.preferred or "viscous")
        law |= {
            "preferred": self.preferred,
            "verdict": self.verdict,
            "approach_speed_nm_per_us": self.approach_speed_nm_per_us,
            "rebound_speed_nm_per_us": None if curve is None else curve.curve,
        }
        found = {
            "format": "afm-jax invert",
            "format_version": FORMAT_VERSION,
            "valid": self.valid,
            "reasons": self.reasons,
            "warnings": self.warnings,
            "rows": self.records(),
            "law": law,
            "delay": None if self.delay is None else self.delay.to_dict(),
            "resonance": asdict(self.resonance),
            "fitted_law": None
            if self.beside is None or self.distance is None
            else {"law": described(self.beside), **self.distance._asdict(), "agrees": self.distance.agrees},
            "input": {name: value for name, value in vars(self.table).items() if value is not None},
            "versions": self.versions,
        }
        return plain(found)
