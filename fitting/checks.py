"""What is asked of a minimum, whatever the optimiser says: gradient, curvature, distance to the true minimum."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from fitting.fisher import covariance_of
from fitting.optimise import PLAIN, Objective

_STEP = 0.02
"""Step of the numerical Hessian in standard errors: its error is of the order of the step squared."""
_ENOUGH = 1e-4
"""Estimated distance of chi2 to its minimum below which a fit counts as converged (one standard error is 1)."""


@dataclass(frozen=True)
class Convergence:
    """The state of a minimum.

    Attributes:
        converged: gradient, curvature and distance are those of a minimum.
        gradient: largest slope of chi2 by a free parameter, per standard error.
        hessian_eigenvalues: of chi2/2 in units of standard errors: about 1 each at a well-behaved minimum.
        estimated_distance: by how much chi2 lies above its minimum, g H^-1 g.
        outward: at a bound, chi2 falls towards the outside (or there is no such parameter).
        reason: why there is nothing to check, None if there is.
    """

    converged: bool
    gradient: float
    hessian_eigenvalues: list[float]
    estimated_distance: float
    outward: bool
    reason: str | None = None


def covariance(
    objective: Objective, values: Float[np.ndarray, " p"], free: Bool[np.ndarray, " p"]
) -> Float[np.ndarray, "p p"]:
    """Return the Fisher covariance of the parameters' values; infinite where a direction is not determined.

    A parameter at its bound is held there; its own variance is the one it would have if it were free.
    """
    jacobian = np.asarray(objective.at_values(values[None]).jacobian)[0]
    full = covariance_of(jacobian.T @ jacobian)
    if free.all():
        return full
    result = np.zeros_like(full)
    result[np.ix_(free, free)] = covariance_of(jacobian[:, free].T @ jacobian[:, free])
    held = np.flatnonzero(~free)
    result[held, held] = full[held, held]
    return result


def check_minimum(
    objective: Objective, coordinates: Float[np.ndarray, " p"], free: Bool[np.ndarray, " p"]
) -> Convergence:
    """Look at chi2 around a point: gradient by forward mode, Hessian by differences of gradients.

    Args:
        objective: chi2 of a table and a model.
        coordinates: where the optimiser stopped.
        free: which parameters are not at their bound.
    """
    count = int(free.sum())
    outward = _pushes_outward(objective, coordinates, free)
    if count == 0:
        return Convergence(outward, 0.0, [], 0.0, outward)
    _, jacobian = objective.linearise(coordinates[None])
    fisher = jacobian[0][:, free].T @ jacobian[0][:, free]
    if not np.all(np.isfinite(fisher)):
        return _adrift([], outward=outward, reason="the slopes of the residuals are not finite where the search ended")
    curvature, axes = np.linalg.eigh(fisher)
    if curvature[0] <= 1e-14 * curvature[-1]:
        return _adrift(curvature.tolist(), outward=outward)
    scale = axes / np.sqrt(curvature)
    steps = np.zeros((2 * count + 1, len(coordinates)))
    steps[1 : count + 1, free], steps[count + 1 :, free] = _STEP * scale.T, -_STEP * scale.T
    _, gradient = objective.value_and_gradient(coordinates + steps, PLAIN)
    slope = gradient[:, free] @ scale / 2.0
    hessian = (slope[1 : count + 1] - slope[count + 1 :]) / (2.0 * _STEP)
    if not np.all(np.isfinite(hessian)) or not np.all(np.isfinite(slope[0])):
        return _adrift([], outward=outward, reason="chi2 has no finite curvature where the search ended")
    hessian = 0.5 * (hessian + hessian.T)
    eigenvalues = np.linalg.eigvalsh(hessian)
    distance = float(slope[0] @ np.linalg.solve(hessian, slope[0])) if eigenvalues[0] > 0 else float("inf")
    converged = bool(eigenvalues[0] > 0 and distance < _ENOUGH and outward)
    return Convergence(converged, float(np.abs(2.0 * slope[0]).max()), eigenvalues.tolist(), distance, outward)


def _adrift(eigenvalues: list[float], *, outward: bool, reason: str | None = None) -> Convergence:
    """Return the state of a point that is no minimum, at an unknown distance from one."""
    return Convergence(
        converged=False,
        gradient=float("inf"),
        hessian_eigenvalues=eigenvalues,
        estimated_distance=float("inf"),
        outward=outward,
        reason=reason,
    )


def at_bound(objective: Objective, values: Float[np.ndarray, " p"]) -> Bool[np.ndarray, " p"]:
    """Say which losses vanish within a hundredth of what the data could resolve."""
    jacobian = np.asarray(objective.at_values(values[None]).jacobian)[0]
    resolution = np.sqrt(np.diag(covariance_of(jacobian.T @ jacobian)))
    ends = [np.inf if p.bound is None else p.bound for p in objective.problem.parameters]
    return np.abs(values - np.array(ends)) < 0.01 * np.where(np.isfinite(resolution), resolution, 0.0)


def _pushes_outward(objective: Objective, coordinates, free) -> bool:
    """Say whether chi2 would fall beyond every bound that a parameter sits on (the Karush-Kuhn-Tucker condition)."""
    if free.all():
        return True
    result = objective.at_values(objective.problem.values(coordinates)[None])
    slope = np.asarray(result.jacobian)[0].T @ np.asarray(result.residual)[0]
    inward = np.array([p.sign for p in objective.problem.parameters])
    return bool(np.all((slope * inward)[~free] >= 0.0))
