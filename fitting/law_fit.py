"""The fit: screen, polish, check, and say what was found and whether to believe it."""

from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from scipy.special import chdtrc

from afm_jax.parameters import require_float64
from afm_jax.version import version_of
from fitting.checks import Convergence, at_bound, check_minimum, covariance
from fitting.forward import Measurement, measurement_of
from fitting.intervals import Interval, profile_intervals
from fitting.law_band import law_with_band
from fitting.minimum import Minimum, minimise, rescale_errors
from fitting.models import Problem, law_parameters
from fitting.optimise import BATCH, SOFT, Objective
from fitting.result import FitResult, FittedParameter, FittedRows
from fitting.table import AmplitudeTable
from fitting.verdict import IMPROBABLE, Evidence, judge_fit

_PACKAGES = ("afm-jax", "jax", "optax", "numpy")


def fit(table: AmplitudeTable, model: str = "law", *, scale_errors: bool = False) -> FitResult:
    """Fit an impact law to measured amplitudes of single-impact orbits.

    Args:
        table: from `read_table`; Q is a nuisance with a Gaussian constraint if the table gives it with an error.
        model: "restitution" (r), "law" (r, epsilon; eq. 6) or "viscous" (epsilon, viscous_loss).
        scale_errors: take the amplitudes' errors as relative only and scale them until chi2 equals its degrees of
            freedom (the error of Q stays); goodness of fit can then not be judged, and the result says so.

    Returns:
        Values, errors, intervals, goodness of fit and a verdict; see `FitResult`.

    Raises:
        ValueError: if there is no such model, or fewer measured amplitudes than parameters.
        RuntimeError: if JAX is not set to 64-bit floats.
    """
    require_float64()
    problem = problem_of(table, model)
    measurement = measurement_of(table)
    amplitudes = int(np.asarray(measurement.rows.measured).sum())
    if amplitudes < len(law_parameters(model)):
        raise ValueError(
            f"{table.source}: {amplitudes} measured amplitude(s) cannot determine the {len(law_parameters(model))} "
            f"parameters of the model {model!r}; measure at other drives, orders or offsets too"
        )
    objective = Objective(measurement, problem)
    minimum, scale = minimise(objective), None
    if scale_errors:
        objective, minimum, scale = rescale_errors(objective, minimum, len(law_parameters(model)))
    return _Summary(objective, table, minimum, scale).result()


def problem_of(table: AmplitudeTable, model: str) -> Problem:
    """Return what is fitted for a table: the model's parameters, and Q where it comes with an uncertainty.

    Raises:
        ValueError: if there is no such model.
    """
    nuisance = () if table.quality_factor_error is None else ("quality_factor",)
    return Problem(model, law_parameters(model) + nuisance)


class _Summary:
    """Turns a minimum into a `FitResult`: errors, intervals, checks, verdict."""

    def __init__(self, objective: Objective, table: AmplitudeTable, minimum: Minimum, error_scale: float | None):
        self.objective, self.table, self.minimum, self.error_scale = objective, table, minimum, error_scale
        self.problem = objective.problem
        self.values = self.problem.values(minimum.coordinates)
        self.free = ~at_bound(objective, self.values)
        self.convergence: Convergence = check_minimum(objective, minimum.coordinates, self.free)
        linear = objective.at_values(self.values[None])
        self.residual = np.asarray(linear.residual)[0]
        self.prediction = linear.prediction
        self.chi2 = float(np.sum(self.residual**2))
        constraints = int("quality_factor" in self.problem.names)
        self.data = int(np.asarray(objective.measurement.rows.measured).sum()) + constraints
        self.freedom = self.data - len(self.values)
        self.covariance = covariance(objective, self.values, self.free)

    def result(self) -> FitResult:
        judged = self.freedom > 0 and self.error_scale is None
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
            error_scale=self.error_scale,
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
                self.problem, self.values, self._shown_covariance(p_value), rows.approach_speed_nm_per_us
            ),
            rows=rows,
            residual_autocorrelation=evidence.autocorrelation,
            convergence=self.convergence,
            table=self.table,
            settings={"model": self.problem.model, "error_scale": self.error_scale, "starts": BATCH, "soft": SOFT},
            versions={name: version_of(name) for name in _PACKAGES},
        )

    def _shown_covariance(self, p_value: float) -> Float[np.ndarray, "p p"]:
        """Return the covariance, infinite where the model does not explain the data."""
        return np.full_like(self.covariance, np.inf) if p_value < IMPROBABLE else self.covariance

    def _parameters(
        self, errors: Float[np.ndarray, " p"], intervals: list[Interval], moved: Bool[np.ndarray, " p"]
    ) -> dict[str, FittedParameter]:
        constraint: tuple[float, float] | None = None
        if self.table.quality_factor is not None and self.table.quality_factor_error is not None:
            constraint = self.table.quality_factor, self.table.quality_factor_error
        return {
            parameter.name: FittedParameter(
                value=float(self.values[i]),
                unit=parameter.unit,
                standard_error=float(errors[i]) if self.free[i] and np.isfinite(errors[i]) else None,
                interval95=(intervals[i].low, intervals[i].high),
                interval_reason=intervals[i].reason,
                undetermined=not np.isfinite(self.covariance[i, i]),
                at_bound=not bool(self.free[i]),
                did_not_move=not bool(moved[i]) and parameter.name != "quality_factor",
                constraint=constraint if parameter.name == "quality_factor" else None,
            )
            for i, parameter in enumerate(self.problem.parameters)
        }

    def _rows(self) -> FittedRows:
        count = self.table.rows
        measured = np.asarray(self.objective.measurement.rows.measured)[:count]
        prediction: Any = self.prediction
        exists = prediction.orbits[0][:count] > 0
        predicted = np.where(exists[:, None], prediction.amplitude_nm[0][:count], np.nan)
        amplitude = np.asarray(self.objective.measurement.rows.amplitude_nm)[:count]
        residual = self.residual[:-1].reshape(-1, 2)[:count]
        return FittedRows(
            predicted_nm=predicted,
            measured_nm=np.where(measured, amplitude, np.nan),
            residual=np.where(measured, residual, np.nan),
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


def _autocorrelation(residual: Float[np.ndarray, "rows 2"]) -> float:
    """Return the lag-1 correlation of residuals of neighbouring rows, both amplitudes together; NaN for few rows."""
    before, after = residual[:-1], residual[1:]
    both = np.isfinite(before) & np.isfinite(after)
    total = np.nansum(residual**2)
    if both.sum() < 8 or total == 0.0:
        return float("nan")
    return float(np.sum(before[both] * after[both]) / both.sum() / (total / np.isfinite(residual).sum()))


__all__ = ["FitResult", "Measurement", "fit", "problem_of"]
