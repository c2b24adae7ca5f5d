"""What a minimum amounts to: errors, intervals, checks, and a verdict on whether to believe it."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from scipy.special import chdtrc

from afm_jax.version import version_of
from fitting.checks import Convergence, at_bound, check_minimum, covariance
from fitting.intervals import Interval, profile_intervals
from fitting.law_band import law_with_band
from fitting.minimum import Minimum
from fitting.optimise import Objective
from fitting.result import FitResult, FittedParameter, FittedRows
from fitting.strained import Strain, untabulated
from fitting.table import AmplitudeTable
from fitting.verdict import Evidence, judge_fit, misfits

_PACKAGES = ("afm-jax", "jax", "optax", "numpy")


@dataclass(frozen=True)
class Found:
    """A minimum before it is summarised: the objective with the errors as stated and as used, and the settings."""

    stated: Objective
    objective: Objective
    minimum: Minimum
    strain: Strain
    settings: dict[str, Any]


def summarise(table: AmplitudeTable, found: Found) -> FitResult:
    """Return errors, intervals, checks and verdict of a minimum."""
    return _Summary(found.objective, table, found.minimum, found.strain, found.settings).result()


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
        unknown = np.full_like(errors, np.inf)
        rows = self._rows()
        used_speeds = np.where(rows.used, rows.approach_speed_nm_per_us, np.nan)
        missed = untabulated(self.objective, self.values, used_speeds)
        evidence = Evidence(
            table=self.table,
            parameters=self._parameters(unknown, "the model does not explain the data", moved),
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
            untabulated=tuple(np.flatnonzero(missed).tolist()),
        )
        # Errors that assume the model would be confident numbers about a law that is not there.
        explained = not misfits(evidence)
        shown_covariance = self.covariance if explained else np.full_like(self.covariance, np.inf)
        if explained:
            evidence = replace(evidence, parameters=self._explained_parameters(errors, moved))
        reasons, warnings = judge_fit(evidence)
        return FitResult(
            model=self.problem.model,
            parameters=evidence.parameters,
            correlations=_correlations(shown_covariance),
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
                shown_covariance,
                used_speeds,
            ),
            rows=rows,
            residual_autocorrelation=evidence.autocorrelation,
            convergence=self.convergence,
            table=self.table,
            settings=self.settings,
            versions={name: version_of(name) for name in _PACKAGES},
        )

    def _explained_parameters(
        self, errors: Float[np.ndarray, " p"], moved: Bool[np.ndarray, " p"]
    ) -> dict[str, FittedParameter]:
        """Return the parameters with their errors and, where all are determined, their intervals."""
        if not np.all(np.isfinite(errors)):
            # With one parameter adrift there is no minimum to follow for the others.
            return self._parameters(errors, "the data do not determine the parameters", moved)
        intervals = profile_intervals(self.objective, self.values, self.covariance, self.chi2)
        return self._parameters(errors, intervals, moved)

    def _parameters(
        self, errors: Float[np.ndarray, " p"], intervals: list[Interval] | str, moved: Bool[np.ndarray, " p"]
    ) -> dict[str, FittedParameter]:
        """Return the parameters with errors and intervals; for these a text says why there are none."""
        if isinstance(intervals, str):
            intervals = [Interval(None, None, intervals)] * len(errors)
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

    def _other_minimum(self, errors: Float[np.ndarray, " p"]) -> tuple[dict[str, float], float] | None:
        """Return values and chi2 of another minimum that the data hardly tell from the best one, if there is one."""
        values, chi2 = self.minimum.ends, self.minimum.chi2
        known = np.where(np.isfinite(errors) & (errors > 0.0), errors, np.inf)
        apart = np.max(np.abs(values - self.values) / known, axis=1) > 5.0
        if not apart.any():
            return None
        index = int(np.argmin(np.where(apart, chi2, np.inf)))
        found = float(chi2[index])
        if self.problem.lasting:
            # it was found with the errors as stated and outliers counting less
            found = float(np.sum(self.searching.residual(values[index : index + 1]) ** 2))
        if not found < self.chi2 + 4.0:
            return None
        return dict(zip(self.problem.names, values[index].tolist(), strict=True)), found


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
