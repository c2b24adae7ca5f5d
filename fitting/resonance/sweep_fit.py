"""One fit of a sweep in front of one background: start, polish, errors, check of the minimum."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from fitting.checks import Convergence, check_minimum
from fitting.fisher import whole_covariance_of
from fitting.optimise import PLAIN, lowest, polish
from fitting.resonance.calibration_errors import SMALLEST, first_errors, with_estimated_errors
from fitting.resonance.calibration_result import PointErrors
from fitting.resonance.resonance_model import LINEAR_NAMES, TERMS, SweepObjective, SweepProblem, points_of
from fitting.resonance.resonance_start import starts
from fitting.resonance.resonance_sweep import ResonanceSweep

_SETTLED = 1e-10
"""Estimated distance of chi2 to its minimum at which the polish stops."""
_HZ_PER_KHZ = 1e3
_ROUNDS = 3
"""How often errors are estimated and the fit repeated; in the third round little changes."""


@dataclass(frozen=True)
class SweepFit:
    """A minimum of chi2 and what belongs to it; `data` counts the numbers measured, two a point with phase."""

    objective: SweepObjective
    coordinates: Float[np.ndarray, " p"]
    values: Float[np.ndarray, " p"]
    residual: Float[np.ndarray, " n"]
    covariance: Float[np.ndarray, "p p"]
    convergence: Convergence
    errors: PointErrors
    reverse: bool
    data: int

    @property
    def chi2(self) -> float:
        """Sum of squared residuals."""
        return float(np.sum(self.residual**2))

    @property
    def freedom(self) -> int:
        """Numbers measured less parameters."""
        return self.data - len(self.values)

    @property
    def points(self) -> int:
        """Number of points."""
        return self.data // (2 if self.objective.kind == "phase" else 1)


def kind_of(sweep: ResonanceSweep) -> str:
    """Return "phase" or "amplitude": what of a sweep is fitted."""
    return "amplitude" if sweep.phase_deg is None else "phase"


def fit_sweep(sweep: ResonanceSweep, background: str, noise: float | None, *, scale_errors: bool) -> SweepFit:
    """Fit a sweep in front of a background.

    Args:
        sweep: the sweep.
        background: a key of `TERMS` for the sweep's kind.
        noise: error of every point as a share of the largest amplitude, or None.
        scale_errors: scale given errors such that chi2/dof = 1.
    """
    kind = kind_of(sweep)
    terms = TERMS[kind][background]
    grids = []
    for reverse in (False, True) if kind == "phase" else (False,):
        points = points_of(sweep, reverse=reverse)
        grids.append((*starts(points, sweep.points, kind, terms), reverse))
    values, square, reverse = min(grids, key=lambda grid: grid[1])
    data = sweep.points * (2 if kind == "phase" else 1)
    along, across = first_errors(sweep, noise, np.sqrt(square / max(data - terms - 2, 1)))
    best = values[0]
    names = ("frequency_khz", "quality_factor", *LINEAR_NAMES[kind][:terms])
    problem = SweepProblem(background, names, reference_khz=float(best[0]), width_khz=float(best[0] / best[1] / 2.0))
    objective = SweepObjective(points_of(sweep, reverse=reverse), kind, problem).with_errors(along, across)
    coordinates = _polished(objective, problem.coordinates(values))
    if sweep.amplitude_error is None and noise is None:
        objective, coordinates, errors = _estimated(objective, coordinates, sweep, data)
    else:
        factor = _misfit(objective, coordinates, data) if scale_errors else 1.0
        # A fit without any misfit keeps its errors.
        factor = factor if factor > 0.0 else 1.0
        objective = objective.with_errors(along * factor, across * factor)
        origin = "noise" if sweep.amplitude_error is None else "file"
        typical = float(np.median(along) * factor * sweep.amplitude.max())
        errors = PointErrors(origin, factor if scale_errors else None, typical, None)
    return _finished(objective, coordinates, errors, reverse=reverse, data=data)


def _estimated(
    objective: SweepObjective, coordinates: Float[np.ndarray, " p"], sweep: ResonanceSweep, data: int
) -> tuple[SweepObjective, Float[np.ndarray, " p"], PointErrors]:
    """Estimate the errors from the misfit and fit again, a few times over."""
    level = jitter = 0.0
    for _ in range(_ROUNDS):
        values = objective.problem.values(coordinates)
        objective, level, jitter = with_estimated_errors(objective, values, sweep.points)
        coordinates = _polished(objective, coordinates[None])
    # The two sums of squares are met, their weighted sum only nearly; a sweep without noise keeps its least errors.
    factor = _misfit(objective, coordinates, data) if level > SMALLEST else 1.0
    along, across = factor / np.asarray(objective.points.weight)[: sweep.points].T
    jitter_hz = _HZ_PER_KHZ * jitter * factor if objective.kind == "phase" else None
    errors = PointErrors("estimated", None, float(level * factor * sweep.amplitude.max()), jitter_hz)
    return objective.with_errors(along, across), coordinates, errors


def refit(fit: SweepFit, sweep: ResonanceSweep, background: str) -> SweepFit:
    """Fit the same sweep with the same errors in front of another background."""
    kind = fit.objective.kind
    terms = TERMS[kind][background]
    values, _ = starts(fit.objective.points, sweep.points, kind, terms)
    # Beside the grid's points: the fit that is there already, its linear parameters cut or filled up with zeros.
    known = np.zeros(terms + 2)
    kept = min(len(known), len(fit.values))
    known[:kept] = fit.values[:kept]
    values[-1] = known
    problem = fit.objective.problem
    names = ("frequency_khz", "quality_factor", *LINEAR_NAMES[kind][:terms])
    own = SweepProblem(background, names, reference_khz=problem.reference_khz, width_khz=problem.width_khz)
    objective = SweepObjective(fit.objective.points, kind, own)
    coordinates = _polished(objective, own.coordinates(values))
    return _finished(objective, coordinates, fit.errors, reverse=fit.reverse, data=fit.data)


def _polished(objective: SweepObjective, starting: Float[np.ndarray, "starts p"]) -> Float[np.ndarray, " p"]:
    result = polish(objective, starting, PLAIN, settled=_SETTLED)
    return result.coordinates[lowest(result.objective)]


def _misfit(objective: SweepObjective, coordinates: Float[np.ndarray, " p"], data: int) -> float:
    """Return the root of chi2/dof."""
    residual, _ = objective.linearise(coordinates[None])
    return float(np.sqrt(np.sum(residual**2) / (data - len(coordinates))))


def _finished(objective: SweepObjective, coordinates, errors: PointErrors, *, reverse: bool, data: int) -> SweepFit:
    residual, jacobian = objective.linearise(coordinates[None])
    values, slopes = objective.problem.values_and_slopes(coordinates)
    convergence = check_minimum(objective, coordinates, np.ones(len(values), dtype=bool))
    covariance = whole_covariance_of(jacobian[0].T @ jacobian[0])
    if np.all(np.isfinite(covariance)):
        covariance = covariance * np.outer(slopes, slopes)
    return SweepFit(objective, coordinates, values, residual[0], covariance, convergence, errors, reverse, data)
