"""What a fit gives: parameters, the law with its band, the energy lost in impacts, rows, and all inputs.

Energies and delta with their intervals (`Loss`), beside the parameters, are the quantities that people ask for.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from afm_jax.checks import in_float64
from afm_jax.impact.law import CollisionDelay, Origin, TabulatedLaw
from afm_jax.results import Result, public_result
from afm_jax.saved import FIT_FORMAT, FIT_FORMAT_VERSION, as_json
from afm_jax.scenefile.law_files import save_law_csv
from afm_jax.strict_json import plain
from afm_jax.units import EV_PER_AJ, TWO_SIDED_95
from fitting.infer.law import LAW_POINTS, AtSpeeds, points_of_law, rebound_by_formula
from fitting.tables.several import SeveralTables, repeats_of
from fitting.tables.table import AmplitudeTable

ENOUGH = 1e-2
"""Estimated distance of chi2 to its minimum below which a fit counts as converged (one standard error is 1)."""


@dataclass(frozen=True)
class Convergence:
    """The state of a minimum.

    Attributes:
        converged: chi2 is at a minimum, and orbits and weights have settled.
        optimiser: what the search was done with.
        iterations: of it.
        gradient: largest slope of chi2 by an unknown, per standard error.
        estimated_distance: by how much chi2 lies above its minimum, g H^-1 g.
        reason: why chi2 is not at a minimum, None if it is.
    """

    converged: bool
    optimiser: str
    iterations: int
    gradient: float
    estimated_distance: float
    reason: str | None = None


@dataclass(frozen=True)
class FittedParameter:
    """One parameter of a fit.

    Attributes:
        value: in the unit beside it.
        unit: the unit, empty for a number.
        standard_error: Wald's, from the Fisher information, and where impacts last with what the model leaves out; None
            where the data do not determine it or at a bound.
        interval95: by profile likelihood, or where impacts last linear, what the model leaves out in it; an end is None
            where it is open.
        interval_reason: why an end is open; None if none is.
        interval_kind: "profile", "linear", or where an end is open "limit"; None without an interval.
        undetermined: the data do not determine it, not even to first order.
        at_bound: the loss vanishes within the resolution of the data.
        constraint: (value, standard error) that the table gives for it, or None.
    """

    value: float
    unit: str
    standard_error: float | None
    interval95: tuple[float | None, float | None]
    interval_reason: str | None
    interval_kind: str | None
    undetermined: bool
    at_bound: bool
    constraint: tuple[float, float] | None

    def containing(self, other: "FittedParameter") -> "FittedParameter":
        """Return the parameter with error and interval so large that they hold those of another minimum too."""
        (low, high), (lower, higher) = self.interval95, other.interval95
        ends = (
            None if low is None or lower is None else min(low, lower),
            None if high is None or higher is None else max(high, higher),
        )
        error = self.standard_error
        if error is not None and other.standard_error is not None:
            error = max(error, abs(other.value - self.value) / TWO_SIDED_95 + other.standard_error)
        reasons = dict.fromkeys(reason for reason in (self.interval_reason, other.interval_reason) if reason)
        return replace(self, standard_error=error, interval95=ends, interval_reason="; ".join(reasons) or None)


@dataclass(frozen=True)
class FittedRows:
    """The rows of the table beside their prediction; NaN where nothing was measured or predicted.

    Amplitudes have shape (rows, 2): peak, lock-in; residuals that of the phase besides, if the table has one.
    ``error_nm`` and ``phase_error_deg`` are the measured error with that of the model (``model_error``, relative) added
    in quadrature; rows ``set_aside`` are not used, ``reasons`` says why (empty for the others). Phases are those of the
    table, the predicted ones next to the measured.
    """

    predicted_nm: Float[np.ndarray, "rows 2"]
    measured_nm: Float[np.ndarray, "rows 2"]
    residual: Float[np.ndarray, "rows k"]
    error_nm: Float[np.ndarray, "rows 2"]
    model_error: Float[np.ndarray, " rows"]
    used: Bool[np.ndarray, " rows"]
    set_aside: Bool[np.ndarray, " rows"]
    approach_speed_nm_per_us: Float[np.ndarray, " rows"]
    orbits: Int[np.ndarray, " rows"]
    near_fold: Bool[np.ndarray, " rows"]
    reasons: tuple[str, ...] = ()
    predicted_phase_deg: Float[np.ndarray, " rows"] | None = None
    measured_phase_deg: Float[np.ndarray, " rows"] | None = None
    phase_error_deg: Float[np.ndarray, " rows"] | None = None

    @property
    def reached_nm_per_us(self) -> Float[np.ndarray, " reached"]:
        """Approach speeds of the rows that are used, as far as they are known."""
        speeds = self.approach_speed_nm_per_us[self.used]
        return speeds[np.isfinite(speeds)]


@dataclass(frozen=True)
class FittedTable:
    """One of several tables that were fitted together.

    Attributes:
        name: what it is called.
        rows: how many it has.
        used: how many of them count.
        chi2: of its readings, of what is known of its own nuisances.
        readings: how many there are.
        pull: how far its law is from that of the others, as standard deviations of a single Gaussian number; NaN where
            they do not determine it.
        p_value: probability of a larger pull if all have the same law.
        nuisances: its own, as `FitResult.parameters`.
    """

    name: str
    rows: int
    used: int
    chi2: float
    readings: int
    pull: float
    p_value: float
    nuisances: dict[str, FittedParameter]


@dataclass(frozen=True)
class WithInterval:
    """A value and the ends of its 95 % interval, None where no error is known."""

    value: float
    interval95: tuple[float | None, float | None]


@dataclass(frozen=True)
class EnergyLost:
    """Energy lost in an impact at an approach speed in nm/us, with its 95 % band; None: its mass is not known."""

    approach_speed_nm_per_us: float
    energy_aj: WithInterval | None
    energy_ev: WithInterval | None


@dataclass(frozen=True)
class Loss:
    """Energy lost in impacts: at three measured speeds, and by the printed parameters.

    Attributes:
        energies: at three speeds, of the law.
        energies_reason: why they are not known; None where they are.
        delta_aj: energy lost to adhesion, m epsilon/2.
        delta_ev: in electron volts.
        formula_off: largest distance of the formula with the printed parameters from the law, over the measured speeds,
            relative to the rebound speed; None of a model without a formula.
        formula_off_at_nm_per_us: approach speed where it is that far.
        capture_speed_nm_per_us: of the law, extrapolated.
    """

    energies: tuple[EnergyLost, ...]
    energies_reason: str | None
    delta_aj: WithInterval | None
    delta_ev: WithInterval | None
    formula_off: float | None
    formula_off_at_nm_per_us: float | None
    capture_speed_nm_per_us: WithInterval


class FittedLaw(TabulatedLaw):
    """The impact law that a fit found, with its discrepancy: a law for scenes, and its points with a 95 % band.

    The points go from 0.8 times the slowest to 1.2 times the fastest speed that the rows reached; beyond them the law
    is `extrapolated`. `sample` draws laws that are as uncertain. NaN: nothing is known of the band.

    Attributes:
        approach_speed_nm_per_us: u_in at the points.
        rebound_speed_nm_per_us: u_out; 0 where the tip is captured.
        rebound_low_nm_per_us: lower end of its pointwise 95 % band.
        rebound_high_nm_per_us: upper end.
        collision_delay_us: the delay; 0 if impacts are instantaneous.
        delay_low_us: lower end of its band.
        delay_high_us: upper end.
    """

    approach_speed_nm_per_us: Float[np.ndarray, " points"] = eqx.field(kw_only=True)
    rebound_speed_nm_per_us: Float[np.ndarray, " points"] = eqx.field(kw_only=True)
    rebound_low_nm_per_us: Float[np.ndarray, " points"] = eqx.field(kw_only=True)
    rebound_high_nm_per_us: Float[np.ndarray, " points"] = eqx.field(kw_only=True)
    collision_delay_us: Float[np.ndarray, " points"] = eqx.field(kw_only=True)
    delay_low_us: Float[np.ndarray, " points"] = eqx.field(kw_only=True)
    delay_high_us: Float[np.ndarray, " points"] = eqx.field(kw_only=True)

    def __init__(
        self,
        law: AtSpeeds,
        approach_speeds: Float[np.ndarray, " rows"],
        *,
        delay: CollisionDelay | None,
        mass_ng: float | None,
        origin: str,
    ):
        """Make the table of a law, with its linearised 95 % band.

        Args:
            law: with its errors, NaN where nothing is known of them.
            approach_speeds: of the rows' orbits in nm/us, NaN where a row has none.
            delay: what the law's own is written beside; None: impacts are instantaneous.
            mass_ng: of the tip; None: not known.
            origin: what the law comes from, in words.
        """
        speeds, points = points_of_law(law, approach_speeds)
        leaves = points.law[0] > 0.0
        u, w = speeds[leaves], np.minimum(points.law[0], speeds)[leaves]
        captured = speeds[~leaves][-1] if not leaves.all() else 0.0
        late = None if delay is None else points.law[1, leaves]
        known: dict[str, Any] = {
            "capture_speed_nm_per_us": np.clip(points.capture, captured, (1.0 - 1e-9) * u[0]),
            "delay": delay,
            # with a knot a point, orbits of a scene with the law are the fit's predictions to 1e-6; with 24 to 4e-4
            "most_knots": LAW_POINTS,
        }
        if np.isfinite(points.factor).all():
            (by_rebound, by_delay), of_capture = fewest_unknowns(points.factor[:, leaves], points.capture_factor)
            known |= {"rebound_changes": by_rebound.T, "delay_changes": None if delay is None else by_delay.T}
            table = TabulatedLaw.with_errors(u, w, late, capture_changes=of_capture, **known)
        else:
            table = TabulatedLaw(u, w, late, **known)
        for part in dataclasses.fields(TabulatedLaw):
            setattr(self, part.name, getattr(table, part.name))
        self.mass_ng, self.origin = None if mass_ng is None else jnp.asarray(mass_ng), Origin(origin)
        width = TWO_SIDED_95 * np.linalg.norm(points.factor, axis=2)
        self.approach_speed_nm_per_us = speeds
        self.rebound_speed_nm_per_us, self.collision_delay_us = map(np.asarray, _points(table, speeds))
        self.rebound_low_nm_per_us = np.maximum(self.rebound_speed_nm_per_us - width[0], 0.0)
        self.rebound_high_nm_per_us = self.rebound_speed_nm_per_us + width[0]
        self.delay_low_us = self.collision_delay_us - width[1]
        self.delay_high_us = self.collision_delay_us + width[1]


@as_json.register
def _(law: FittedLaw) -> dict[str, Any]:
    # its points with units in their names, and all that makes it again
    return as_json.dispatch(TabulatedLaw)(law) | {name: plain(getattr(law, name)) for name in FittedLaw.__annotations__}


@public_result(picture="fitting.report.plots:rows_figure", home="fitting.report.report")
@dataclass(frozen=True)
class FitResult(Result):
    """The outcome of `fit`; attributes are named like the keys of its JSON.

    Attributes:
        model: the model's name.
        parameters: by name, the law's first: where impacts last those of the model's formula that is closest to `law`
            over the speeds of the rows that were used, with errors that contain what the formula leaves out.
        correlations: matrix in the parameters' order; NaN where a variance is unknown.
        chi2: sum of squared normalised residuals, constraints included, and where impacts last what the model leaves
            out; of a robust fit without outliers.
        degrees_of_freedom: measured amplitudes plus constraints minus parameters.
        p_value: probability of a larger chi2 if the model is right.
        aic: chi2 + 2 k; where impacts last no means to choose a model, for chi2 makes up for what a formula lacks.
        valid: converged, explained and determined; `reasons` say why not.
        reasons: what makes the result invalid.
        warnings: what a reader should know besides.
        law: the fitted impact law with its band.
        loss: of an impact: energies, delta, how far formula and law differ, the capture speed; None if no speed
            was reached.
        rows: measured and predicted amplitudes.
        convergence: what the checks of the minimum found.
        table: the table that was fitted, or all of several.
        tables: of several: each one's rows, chi2, pull on the law, and what it has to itself; `parameters` are then
            those that all have in common.
        settings: every option of the fit.
        versions: of the packages that computed it.
    """

    _doubt: ClassVar[str] = ": the numbers below are not a measurement of the law."
    model: str
    parameters: dict[str, FittedParameter]
    correlations: Float[np.ndarray, "p p"]
    chi2: float
    degrees_of_freedom: int
    p_value: float
    aic: float
    valid: bool
    reasons: list[str]
    warnings: list[str]
    law: FittedLaw
    rows: FittedRows
    convergence: Convergence
    table: AmplitudeTable | SeveralTables
    settings: dict[str, Any] = field(default_factory=dict)
    versions: dict[str, str] = field(default_factory=dict)
    loss: Loss | None = None
    tables: tuple[FittedTable, ...] = ()

    def report(self, folder: str | Path, name: str = "", more: Sequence[Any] = ()) -> list[Path]:
        """Write this fit into a folder as every result, and its law as law.csv; return the paths."""
        paths, law = super().report(folder, name, more), Path(folder) / "law.csv"
        save_law_csv(self.law, law)
        return [*paths, law]


@as_json.register
@in_float64
def _(fit: FitResult) -> dict[str, Any]:
    left_out = {"table"} if fit.tables else {"table", "tables"}
    names = [field.name for field in dataclasses.fields(fit) if field.name not in left_out]
    return plain(
        {"format": FIT_FORMAT, "format_version": FIT_FORMAT_VERSION}
        | {name: getattr(fit, name) for name in names}
        | {
            "correlations": {"names": list(fit.parameters), "matrix": fit.correlations},
            "law": as_json(fit.law),
            "input": fit.table,
            "repeats": repeats_of(fit.table),
        }
    )


@jax.jit
def _points(law: TabulatedLaw, speeds: Float[Array, " points"]) -> tuple[Array, Array]:
    return law.rebound_speed(speeds), law.collision_delay(speeds)


def fewest_unknowns(
    of_law: Float[np.ndarray, "2 points m"], of_capture: Float[np.ndarray, " m"]
) -> tuple[Float[np.ndarray, "2 points k"], Float[np.ndarray, " k"]]:
    """Return changes with fewer independent unknowns that have the same covariance, to 3 parts in 1000 of every error.

    What is not known of the capture speed (NaN) is left out.
    """
    flat = np.append(of_law.reshape(-1, of_law.shape[2]), np.nan_to_num(of_capture)[None], axis=0)
    size = np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), 1e-300)
    left, strength, _ = np.linalg.svd(flat / size, full_matrices=False)
    parts = left * strength
    missing = np.sqrt(np.maximum(np.cumsum((parts**2)[:, ::-1], axis=1)[:, ::-1], 0.0)).max(axis=0)
    kept = (size * parts)[:, : max(int(np.sum(missing > _LEAST_PART)), 1)]
    return kept[:-1].reshape(*of_law.shape[:2], -1), kept[-1]


_LEAST_PART = 3e-3
"""Share of an error below which unknowns are left out."""


def interval_of(value: float, error: float, lowest: float = -np.inf) -> WithInterval:
    """Return a value with its 95 % interval, cut off below where nothing can be."""
    if not np.isfinite(error):
        return WithInterval(value, (None, None))
    reach = TWO_SIDED_95 * error
    return WithInterval(value, (float(max(value - reach, lowest)), float(value + reach)))


def scaled(known: WithInterval | None, factor: float) -> WithInterval | None:
    """Return a value and its interval in another unit; None if it is not known."""
    if known is None:
        return None
    low, high = (None if end is None else end * factor for end in known.interval95)
    return WithInterval(known.value * factor, (low, high))


NO_MASS = "the table gives neither mass_ng nor spring_constant_n_per_m"


def loss_of(
    law: AtSpeeds,
    measured: tuple[float, float],
    mass_ng: float | None,
    parameters: Mapping[str, FittedParameter],
    formula: Mapping[str, float] | None,
) -> Loss:
    """Return the energy lost in impacts: at measured speeds, and by the printed parameters.

    Args:
        law: with its errors.
        measured: slowest and fastest approach in nm/us.
        mass_ng: of the tip; None: not known.
        parameters: of the fit.
        formula: values of the model's formula, those that are held included; None: it has none.
    """
    # two digits, and within what was measured
    three = np.clip([float(f"{speed:.2g}") for speed in np.geomspace(*measured, 3)], *measured)
    points = law(np.resize(three, LAW_POINTS))
    errors, taken, delta = np.linalg.norm(points.factor[0], axis=1), [None] * 3, None
    if mass_ng is not None:
        # a sample at rest gives no energy
        taken = [
            interval_of(0.5 * mass_ng * (u**2 - w**2), mass_ng * w * error, lowest=0.0)
            for u, w, error in zip(three.tolist(), points.law[0].tolist(), errors.tolist(), strict=False)
        ]
        epsilon = parameters.get("epsilon")
        delta = epsilon and scaled(WithInterval(epsilon.value, epsilon.interval95), 0.5 * mass_ng)
    energies = [EnergyLost(u, one, scaled(one, EV_PER_AJ)) for u, one in zip(three.tolist(), taken, strict=True)]
    off = off_at = None
    if formula is not None:
        speeds = np.geomspace(*measured, LAW_POINTS)
        rebound, by_formula = law(speeds).law[0], rebound_by_formula(formula, speeds)
        apart = np.where(rebound > 0.0, np.abs(by_formula / np.where(rebound > 0.0, rebound, 1.0) - 1.0), 0.0)
        off, off_at = float(apart.max()), float(speeds[np.argmax(apart)])
    return Loss(
        energies=tuple(dict.fromkeys(energies)),
        energies_reason=NO_MASS if mass_ng is None else None,
        delta_aj=delta,
        delta_ev=scaled(delta, EV_PER_AJ),
        formula_off=off,
        formula_off_at_nm_per_us=off_at,
        capture_speed_nm_per_us=interval_of(points.capture, float(np.linalg.norm(points.capture_factor)), lowest=0.0),
    )
