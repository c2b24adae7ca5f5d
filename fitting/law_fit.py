"""The fit: screen, polish, check, and say what was found and whether to believe it."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from scipy.special import chdtrc

from afm_jax.contact.contact import EFFECTS
from afm_jax.parameters import require_float64
from afm_jax.version import version_of
from fitting.checks import Convergence, at_bound, check_minimum, covariance
from fitting.contact_values import check_contact_values
from fitting.intervals import Interval, profile_intervals
from fitting.law_band import law_with_band
from fitting.measurement import constraints_of, measurement_of
from fitting.minimum import Minimum, minimise, rescale_errors, settle
from fitting.models import NUISANCE_NAMES, Problem, model_parameters
from fitting.optimise import BATCH, ROBUST, SOFT, Objective
from fitting.result import FitResult, FittedParameter, FittedRows
from fitting.strained import Strain, relaxed, strain_of
from fitting.table import AmplitudeTable
from fitting.verdict import IMPROBABLE, Evidence, judge_fit

_PACKAGES = ("afm-jax", "jax", "optax", "numpy")
_STRAIN_ROUNDS = 3


def fit(  # noqa: PLR0913
    table: AmplitudeTable,
    model: str = "law",
    *,
    scale_errors: bool = False,
    free: Sequence[str] | None = None,
    fixed: dict[str, float] | None = None,
    constraints: dict[str, tuple[float, float]] | None = None,
    effects: Sequence[str] = EFFECTS,
    robust: bool = False,
) -> FitResult:
    """Fit an impact law to measured amplitudes of single-impact orbits.

    Args:
        table: from `read_table`; what it gives with an error (Q, calibrations) is a nuisance with that constraint.
        model: "restitution" (r), "law" (r, epsilon; eq. 6) or "viscous" (epsilon, viscous_loss), each instantaneous or
            with "+delay", the collision delay; or "contact", physical parameters through the resolved contact.
        scale_errors: take the amplitudes' errors as relative only and scale them until chi2 equals its degrees of
            freedom (the error of Q stays); goodness of fit can then not be judged, and the result says so.
        free: for "contact": the parameters that are fitted, by keyword of `Contact.paper`; None: relative humidity,
            adhesion energy, viscosity and modulus.
        fixed: for "contact": values of parameters that are not the paper's.
        constraints: value and standard error of what else is known, by parameter: a nuisance (`quality_factor`,
            `tip_calibration`, `drive_calibration`, `offset_origin_nm`), which then is fitted along, or one of the
            model's parameters.
        effects: for "contact": the effects there are.
        robust: let outliers count linearly from two errors on.

    Returns:
        Values, errors, intervals, goodness of fit and a verdict; see `FitResult`.

    Raises:
        ValueError: if there is no such model or parameter, a constraint is impossible or degenerate with the model, or
            there are fewer measured amplitudes than parameters.
        RuntimeError: if JAX is not set to 64-bit floats.
    """
    options: dict[str, Any] = {"free": free, "fixed": fixed, "constraints": constraints, "effects": effects}
    found = find_fit(table, model, scale_errors=scale_errors, robust=robust, **options)
    return summarise(table, found)


@dataclass(frozen=True)
class Found:
    """A minimum before it is summarised: the objective with the errors as stated and as used, and the settings."""

    stated: Objective
    objective: Objective
    minimum: Minimum
    strain: Strain
    settings: dict[str, Any]


def find_fit(  # noqa: PLR0913
    table: AmplitudeTable,
    model: str,
    *,
    scale_errors: bool = False,
    free: Sequence[str] | None = None,
    fixed: dict[str, float] | None = None,
    constraints: dict[str, tuple[float, float]] | None = None,
    effects: Sequence[str] = EFFECTS,
    robust: bool = False,
) -> Found:
    """Return the minimum of a fit; arguments and errors as of `fit`."""
    require_float64()
    known = constraints_of(table, constraints)
    problem = problem_of(table, model, free=free, constraints=known, effects=effects)
    check_contact_values(model, fixed)
    measurement = measurement_of(table, problem, known, fixed)
    amplitudes = int(np.asarray(measurement.rows.measured).sum())
    if amplitudes < len(problem.own):
        raise ValueError(
            f"{table.source}: {amplitudes} measured amplitude(s) cannot determine the {len(problem.own)} "
            f"parameters of the model {model!r}; measure at other drives, orders or offsets too"
        )
    stated = Objective(measurement, problem, robust=robust)
    objective, minimum, strain = unstrained_minimum(stated)
    scale = None
    if scale_errors:
        objective, minimum, scale = rescale_errors(objective, minimum, len(problem.own))
    settings = {
        "model": model,
        "error_scale": scale,
        "starts": BATCH,
        "soft": SOFT,
        "robust": ROBUST if robust else None,
        "constraints": known,
        "free": list(problem.own),
        "fixed": fixed or {},
        "effects": list(effects) if model == "contact" else None,
    }
    return Found(stated, objective, minimum, strain, settings)


def summarise(table: AmplitudeTable, found: Found) -> FitResult:
    """Return errors, intervals, checks and verdict of a minimum."""
    return _Summary(found.objective, table, found.minimum, found.strain, found.settings).result()


def problem_of(
    table: AmplitudeTable,
    model: str,
    *,
    free: Sequence[str] | None = None,
    constraints: dict[str, tuple[float, float]] | None = None,
    effects: Sequence[str] = EFFECTS,
) -> Problem:
    """Return what is fitted for a table: the model's parameters, and the nuisances that are constrained.

    Raises:
        ValueError: if there is no such model or parameter, or a constraint is impossible.
    """
    own = model_parameters(model, None if free is None else tuple(free))
    known = constraints_of(table, constraints)
    for name, (value, error) in known.items():
        if name not in (*own, *NUISANCE_NAMES):
            raise ValueError(
                f"the constraint on {name!r} is on no parameter: choose from {', '.join((*own, *NUISANCE_NAMES))}"
            )
        if not (np.isfinite(value) and 0.0 < error < np.inf):
            raise ValueError(
                f"the constraint on {name} must be a value and a positive error, but is {value} +- {error}"
            )
    if "offset_origin_nm" in known and model.endswith("+delay"):
        raise ValueError(
            "offset_origin_nm and delay_offset_nm shift the same thing: with a delay leave the constraint on "
            "offset_origin_nm out (delay_offset_nm takes it up), or fit the model 'contact'"
        )
    nuisances = tuple(name for name in NUISANCE_NAMES if name in known)
    return Problem(model, own + nuisances, tuple(effects))


def unstrained_minimum(stated: Objective) -> tuple[Objective, Minimum, Strain]:
    """Return the minimum with the model's own error in the weights and strained rows set aside, until both settle."""
    minimum = minimise(stated)
    strain = strain_of(stated, stated.problem.values(minimum.coordinates))
    if not stated.problem.lasting:
        return stated, minimum, strain
    objective = relaxed(stated, strain)
    for _ in range(_STRAIN_ROUNDS):
        minimum = settle(objective, minimum)
        again = strain_of(stated, stated.problem.values(minimum.coordinates))
        same = np.array_equal(again.set_aside, strain.set_aside)
        close = np.allclose(again.model_error, strain.model_error, rtol=0.02)
        if same and close:
            break
        objective, strain = relaxed(stated, again), again
    return objective, settle(objective, minimum), strain


class _Summary:
    """Turns a minimum into a `FitResult`: errors, intervals, checks, verdict."""

    def __init__(
        self, objective: Objective, table: AmplitudeTable, minimum: Minimum, strain: Strain, settings: dict[str, Any]
    ):
        self.searching, self.table, self.minimum, self.strain = objective, table, minimum, strain
        self.settings, self.problem = settings, objective.problem
        self.values = self.problem.values(minimum.coordinates)
        # orbits are followed from here on: only their places change a little
        self.objective = objective.following(self.values)
        self.free = ~at_bound(self.objective, self.values)
        self.convergence: Convergence = check_minimum(self.objective, minimum.coordinates, self.free)
        linear = self.searching.at_values(self.values[None])
        self.residual = np.asarray(linear.residual)[0]
        self.amplitude_residual = self.searching.misfit(linear)
        self.prediction = linear.prediction
        self.chi2 = float(np.sum(self.residual**2))
        self.constraints = settings["constraints"]
        used = int(np.asarray(objective.measurement.rows.measured).sum())
        self.data = used + int(np.asarray(objective.measurement.rows.no_orbit).sum()) + len(self.constraints)
        self.freedom = self.data - len(self.values)
        self.covariance = covariance(self.objective, self.values, self.free)

    def result(self) -> FitResult:
        judged = self.freedom > 0 and self.settings["error_scale"] is None and not self.searching.robust
        p_value = float(chdtrc(self.freedom, self.chi2)) if judged else float("nan")
        errors = np.sqrt(np.diag(self.covariance))
        moved = ~self.free | ~np.isfinite(errors) | (np.abs(self.values - self.minimum.start) > 1e-3 * errors)
        if p_value < IMPROBABLE:
            # Errors that assume the model would be confident numbers about a law that is not there.
            intervals = [Interval(None, None, "the model does not explain the data")] * len(errors)
            parameters = self._parameters(np.full_like(errors, np.inf), intervals, moved)
        elif not np.all(np.isfinite(errors)):
            # With one parameter adrift there is no minimum to follow for the others.
            intervals = [Interval(None, None, "the data do not determine the parameters")] * len(errors)
            parameters = self._parameters(errors, intervals, moved)
        else:
            intervals = profile_intervals(self.objective, self.values, self.covariance, self.chi2)
            parameters = self._parameters(errors, intervals, moved)
        rows = self._rows()
        evidence = Evidence(
            table=self.table,
            parameters=parameters,
            convergence=self.convergence,
            rows=rows,
            chi2=self.chi2,
            freedom=self.freedom,
            p_value=p_value,
            autocorrelation=_autocorrelation(rows.residual),
            other_minimum=self._other_minimum(errors),
            error_scale=self.settings["error_scale"],
            lasting=self.problem.lasting,
            robust=self.searching.robust,
            correlations=_correlations(self.covariance),
        )
        reasons, warnings = judge_fit(evidence)
        return FitResult(
            model=self.problem.model,
            parameters=parameters,
            correlations=_correlations(self._shown_covariance(p_value)),
            chi2=self.chi2,
            degrees_of_freedom=self.freedom,
            p_value=evidence.p_value,
            aic=self.chi2 + 2.0 * len(self.values),
            bic=self.chi2 + len(self.values) * float(np.log(self.data)),
            valid=not reasons,
            reasons=reasons,
            warnings=warnings,
            law=law_with_band(
                self.problem,
                self.objective.measurement,
                self.values,
                self._shown_covariance(p_value),
                np.where(rows.used, rows.approach_speed_nm_per_us, np.nan),
            ),
            rows=rows,
            residual_autocorrelation=evidence.autocorrelation,
            convergence=self.convergence,
            table=self.table,
            settings=self.settings,
            versions={name: version_of(name) for name in _PACKAGES},
        )

    def _shown_covariance(self, p_value: float) -> Float[np.ndarray, "p p"]:
        """Return the covariance, infinite where the model does not explain the data."""
        return np.full_like(self.covariance, np.inf) if p_value < IMPROBABLE else self.covariance

    def _parameters(
        self, errors: Float[np.ndarray, " p"], intervals: list[Interval], moved: Bool[np.ndarray, " p"]
    ) -> dict[str, FittedParameter]:
        return {
            parameter.name: FittedParameter(
                value=float(self.values[i]),
                unit=parameter.unit,
                standard_error=float(errors[i]) if self.free[i] and np.isfinite(errors[i]) else None,
                interval95=(intervals[i].low, intervals[i].high),
                interval_reason=intervals[i].reason,
                undetermined=not np.isfinite(self.covariance[i, i]),
                at_bound=not bool(self.free[i]),
                did_not_move=not bool(moved[i]) and parameter.name not in self.constraints,
                constraint=self.constraints.get(parameter.name),
            )
            for i, parameter in enumerate(self.problem.parameters)
        }

    def _rows(self) -> FittedRows:
        count = self.table.rows
        rows = self.searching.measurement.rows
        used = np.asarray(rows.measured)[:count]
        prediction: Any = self.prediction
        exists = prediction.orbits[0][:count] > 0
        predicted = np.where(exists[:, None], prediction.amplitude_nm[0][:count], np.nan)
        amplitude, error = np.asarray(rows.amplitude_nm)[:count], np.asarray(rows.error_nm)[:count]
        measured = used | (self.strain.set_aside[:count, None] & np.isfinite(_amplitudes(self.table)))
        return FittedRows(
            predicted_nm=predicted,
            measured_nm=np.where(measured, amplitude, np.nan),
            residual=np.where(used, self.amplitude_residual[:count], np.nan),
            error_nm=np.where(used, error, np.nan),
            model_error=self.strain.model_error[:count],
            used=np.any(used, axis=1, keepdims=False).astype(bool),
            set_aside=self.strain.set_aside[:count],
            approach_speed_nm_per_us=np.where(exists, prediction.approach_speed_nm_per_us[0][:count], np.nan),
            orbits=prediction.orbits[0][:count],
            near_fold=prediction.near_fold[0][:count],
        )

    def _other_minimum(self, errors: Float[np.ndarray, " p"]) -> dict[str, float] | None:
        """Return the values of another minimum that the data hardly tell from the best one, if there is one."""
        values, chi2 = self.minimum.ends, self.minimum.chi2
        known = np.where(np.isfinite(errors) & (errors > 0.0), errors, np.inf)
        apart = np.max(np.abs(values - self.values) / known, axis=1) > 5.0
        rival = apart & (chi2 < self.chi2 + 4.0)
        if not rival.any():
            return None
        index = int(np.argmin(np.where(rival, chi2, np.inf)))
        return dict(zip(self.problem.names, values[index].tolist(), strict=True))


def _correlations(covariance_matrix: Float[np.ndarray, "p p"]) -> Float[np.ndarray, "p p"]:
    error = np.sqrt(np.diag(covariance_matrix))
    known = np.isfinite(error) & (error > 0.0)
    safe = np.where(known, error, 1.0)
    matrix = np.where(np.isfinite(covariance_matrix), covariance_matrix, 0.0) / np.outer(safe, safe)
    return np.where(np.outer(known, known), matrix, np.nan)


def _amplitudes(table: AmplitudeTable) -> Float[np.ndarray, "rows 2"]:
    """Return peak and lock-in amplitude of the table, NaN where not measured."""
    blank = np.full(table.rows, np.nan)
    columns = table.peak_amplitude_nm, table.lockin_amplitude_nm
    return np.stack([blank if column is None else column for column in columns], axis=1)


def _autocorrelation(residual: Float[np.ndarray, "rows 2"]) -> float:
    """Return the lag-1 correlation of residuals of neighbouring rows, both amplitudes together; NaN for few rows."""
    before, after = residual[:-1], residual[1:]
    both = np.isfinite(before) & np.isfinite(after)
    total = np.nansum(residual**2)
    if both.sum() < 8 or total == 0.0:
        return float("nan")
    return float(np.sum(before[both] * after[both]) / both.sum() / (total / np.isfinite(residual).sum()))


__all__ = ["FitResult", "find_fit", "fit", "problem_of", "summarise"]
