"""Profile-likelihood intervals: how far a parameter can go while the others follow and chi2 rises by 3.84.

Gradient, curvature and distance to the true minimum are asked of a minimum, whatever the optimiser says.
"""

from dataclasses import dataclass
from functools import partial

import numpy as np
from jaxtyping import Bool, Float, Int

from afm_jax.least_squares import Box, Searches, covariance_of, descended
from afm_jax.units import TWO_SIDED_95
from fitting.fits.objective import PLAIN, Objective
from fitting.models import coordinate_of
from fitting.parameters import Parameter, is_of_one_table

CHI2_95 = 3.841458820694124
"""95 % quantile of chi2 with one degree of freedom."""
_OUTER_STEPS = 30
_INNER_STEPS = 25
_SETTLED = 1e-6
"""Estimated distance of chi2 to its minimum over the others at which these have arrived."""
END_OF_RANGE = "reaches the end of its range"
UNSETTLED = "the search did not settle"
UNEXPLAINED = "the model does not explain the data"
"""Why an end of an interval is open, why it is not known, and why there is no interval."""
_FARTHEST = 100.0
"""Distance in standard errors at which a search gives up: the data do not determine the parameter on that side."""
_LOST = 1e3
"""Rise of chi2 that says that a row has lost its orbit on the way there: shorter steps may keep it."""
_NEAREST = 0.01
"""Step in standard errors from which that is the end."""
_FIRST_TRIAL = float(np.sqrt(CHI2_95))
"""In standard errors: where the end lies if chi2 is a parabola."""


@dataclass(frozen=True)
class Interval:
    """A 95 % interval; an end that is open is None, with the reason."""

    low: float | None
    high: float | None
    reason: str | None = None

    def moved(self, value: float, to: float, growth: float) -> "Interval":
        """Return the interval of a value that has moved, its ends at so many times their distance from it."""
        low, high = (None if end is None else float(to + growth * (end - value)) for end in (self.low, self.high))
        return Interval(low, high, self.reason)


@dataclass
class _Side:
    """The search for one end of one interval."""

    index: int
    direction: float
    others: Float[np.ndarray, " p"]  # places (`Places`) at `inside`; the profiled one is not used
    along: Float[np.ndarray, " p"]  # how they go on from there, by distance
    inside: float = 0.0  # distance in errors that lies inside the interval
    outside: float = np.inf
    inside_root: float = 0.0  # root of the rise of chi2 there
    outside_root: float = np.inf
    trial: float = _FIRST_TRIAL
    end: float | None = None
    reason: str | None = None


def profile_intervals(
    objective: Objective,
    values: Float[np.ndarray, " p"],
    covariance: Float[np.ndarray, "p p"],
    chi2: float,
) -> list[Interval]:
    """Return the 95 % profile interval of every parameter; Wald's of nuisances of one of several tables.

    Args:
        objective: chi2 of a table and a model.
        values: the fitted values.
        covariance: theirs, for steps and first guesses; an infinite variance gives an open interval.
        chi2: at the fitted values.
    """
    errors = np.sqrt(np.diag(covariance))
    here = Places(objective).of_values(values)
    sides = [
        _Side(index, direction, here, _followers(objective, values, covariance, index, direction))
        for index in range(len(values))
        for direction in (-1.0, 1.0)
        if np.isfinite(errors[index]) and not is_of_one_table(objective.problem.names[index])
    ]
    for _ in range(_OUTER_STEPS):
        active = [side for side in sides if side.end is None and side.reason is None]
        if not active:
            break
        _advance(objective, active, values, errors, chi2)
    reach = TWO_SIDED_95 * errors
    ends = list(zip((values - reach).tolist(), (values + reach).tolist(), strict=True))
    # it has a Gaussian constraint, and there are as many as tables
    return [
        within_range(objective.problem.parameters[index], Interval(*ends[index]))
        if np.isfinite(errors[index]) and is_of_one_table(name)
        else _interval(sides, index)
        for index, name in enumerate(objective.problem.names)
    ]


def _advance(objective: Objective, sides: list[_Side], values, errors, chi2: float) -> None:
    """Take one trial distance on every side and narrow its bracket."""
    rise = CHI2_95
    targets = np.array([_target(side, objective, values, errors) for side in sides])
    found, others = _minimise_others(objective, sides, targets)
    for side, target, value, coordinates in zip(sides, targets, found, others, strict=True):
        parameter = objective.problem.parameters[side.index]
        end = parameter.lowest if side.direction < 0 else parameter.highest
        distance = abs(target - values[side.index]) / errors[side.index]
        above = value - chi2
        if not np.isfinite(above):
            side.reason = f"{UNSETTLED}: chi2 is not finite on this side"
            continue
        if above > _LOST:
            # an orbit that was seen must be there: where it is lost the interval ends
            side.trial = side.inside + 0.5 * (distance - side.inside)
            side.end = float(target) if distance - side.inside < _NEAREST else None
            continue
        root = float(np.sqrt(max(above, 0.0)))
        if above < rise:
            if distance > side.inside:
                side.along = (coordinates - side.others) / (distance - side.inside)
                side.inside_root = root
            side.inside, side.others = max(side.inside, distance), coordinates
            if target == end:
                side.reason = f"{END_OF_RANGE}, {end:g}"
            elif distance >= _FARTHEST:
                side.reason = "the data set no limit on this side"
        else:
            side.outside_root = root if distance <= side.outside else side.outside_root
            side.outside = min(side.outside, distance)
        if side.outside - side.inside < 1e-5 * max(side.outside, 1e-300) or abs(above - rise) < 1e-3 * rise:
            side.end = float(target)
        # sqrt(chi2 - minimum) is close to a straight line, which has a kink where another parameter meets its bound
        guess = distance * np.sqrt(rise / above) if above > 1e-6 * rise else 2.0 * distance
        if np.isfinite(side.outside):
            share = (np.sqrt(rise) - side.inside_root) / (side.outside_root - side.inside_root)
            guess = side.inside + share * (side.outside - side.inside)
        safe = side.inside + 0.5 * (side.outside - side.inside) if np.isfinite(side.outside) else 3.0 * distance
        margin = 1e-3 * (side.outside - side.inside) if np.isfinite(side.outside) else 0.0
        inside = side.inside + margin < guess < side.outside - margin
        side.trial = min(guess if inside else safe, _FARTHEST)


def _followers(objective: Objective, values, covariance, index: int, direction: float) -> Float[np.ndarray, " p"]:
    """Return how the places of the others change, to first order, when one moves by a standard error."""
    variance = covariance[index, index]
    shift = direction * _FIRST_TRIAL * covariance[:, index] / np.sqrt(variance) if variance > 0.0 else 0.0
    guess = np.clip(values + shift, *objective.problem.ends)
    places = Places(objective)
    moved = places.of_values(np.where(np.isfinite(guess), guess, values))
    return (moved - places.of_values(values)) / _FIRST_TRIAL


def _target(side: _Side, objective: Objective, values, errors) -> float:
    parameter = objective.problem.parameters[side.index]
    target = values[side.index] + side.direction * side.trial * errors[side.index]
    return float(np.clip(target, parameter.lowest, parameter.highest))


class Places:
    """Where the minimisation over the other parameters moves: a loss by its value, the others by their coordinates.

    The coordinate of a loss is a root, in which a loss of 0 never grows again: there its derivative vanishes. By value
    it lies between bounds, at which it is held as long as chi2 falls outward.
    """

    def __init__(self, objective: Objective):
        """Keep the objective, and the places that bound it."""
        self.objective = objective
        self.by_value = np.array([parameter.sign != 0 for parameter in objective.problem.parameters])
        self.lowest, self.highest = self.of_values(objective.problem.ends)

    def of_values(self, values: Float[np.ndarray, "... p"]) -> Float[np.ndarray, "... p"]:
        """Return the places of values."""
        return np.where(self.by_value, values, self.objective.problem.coordinates(values))

    def coordinates(self, places: Float[np.ndarray, "... p"]) -> Float[np.ndarray, "... p"]:
        """Return the optimiser's coordinates of places."""
        columns = zip(self.objective.problem.parameters, np.moveaxis(places, -1, 0), strict=True)
        return np.stack([coordinate_of(p, place) if p.sign else place for p, place in columns], axis=-1)

    def look(self, places: Float[np.ndarray, "sets p"], some: Int[np.ndarray, " sets"]) -> Searches:  # noqa: ARG002
        """Return chi2, the residuals and their Jacobian by the places."""
        known, slopes = self.objective.problem.values_and_slopes(self.coordinates(places))
        result = self.objective.at_values(np.where(self.by_value, places, known))
        residual, jacobian = np.asarray(result.residual), np.asarray(result.jacobian)
        jacobian = jacobian * np.where(self.by_value, 1.0, slopes)[:, None, :]
        return Searches(places, residual, jacobian, np.sum(residual**2, axis=1))


def _minimise_others(objective: Objective, sides: list[_Side], targets):
    """Minimise chi2 over the parameters that are not profiled, on all sides at once."""
    places = Places(objective)
    ahead = np.array([side.trial - side.inside for side in sides])
    z = np.array([side.others for side in sides]) + ahead[:, None] * np.array([side.along for side in sides])
    z = np.clip(z, places.lowest, places.highest)
    index = np.array([side.index for side in sides])
    lanes = np.arange(len(sides))
    fixed = np.zeros_like(z, dtype=bool)
    fixed[lanes, index] = True
    parameters = objective.problem.parameters
    z[lanes, index] = [
        t if parameters[k].sign else coordinate_of(parameters[k], np.asarray(t))
        for k, t in zip(index, targets, strict=True)
    ]
    box = Box(places.lowest, places.highest, fixed)
    end = descended(places.look, places.look(z, lanes), box, settled=_SETTLED, most=_INNER_STEPS)
    return end.chi2, end.place


def within_range(parameter: Parameter, interval: Interval) -> Interval:
    """Return an interval whose ends beyond the parameter's range are open."""
    ends, reasons = [interval.low, interval.high], [interval.reason] if interval.reason else []
    for i, (name, last, beyond) in enumerate((("lower", parameter.lowest, -1), ("upper", parameter.highest, 1))):
        end = ends[i]
        if end is not None and beyond * (end - last) > 0.0:
            ends[i] = None
            reasons.append(f"{name} end: {END_OF_RANGE}, {last:g}")
    return Interval(ends[0], ends[1], "; ".join(reasons) or None)


def _interval(sides: list[_Side], index: int) -> Interval:
    mine = [side for side in sides if side.index == index]
    if not mine:
        return Interval(None, None, "the data do not determine this parameter")
    low, high = mine
    reasons = [
        f"{name} end: {side.reason or UNSETTLED}"
        for name, side in (("lower", low), ("upper", high))
        if side.end is None
    ]
    return Interval(low.end, high.end, "; ".join(reasons) or None)


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
    fisher = _fisher(objective, values)
    full = covariance_of(fisher)
    if free.all():
        return full
    result = np.zeros_like(full)
    result[np.ix_(free, free)] = covariance_of(fisher[np.ix_(free, free)])
    held = np.flatnonzero(~free)
    result[held, held] = full[held, held]
    return result


def _fisher(objective: Objective, values: Float[np.ndarray, " p"]) -> Float[np.ndarray, "p p"]:
    """Return the Fisher matrix of the parameters' values."""
    jacobian = np.asarray(objective.at_values(values[None]).jacobian)[0]
    return jacobian.T @ jacobian


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
    # a point that is no minimum, at an unknown distance from one
    adrift = partial(Convergence, converged=False, gradient=np.inf, estimated_distance=np.inf, outward=outward)
    _, jacobian = objective.linearise(coordinates[None])
    fisher = jacobian[0][:, free].T @ jacobian[0][:, free]
    if not np.all(np.isfinite(fisher)):
        reason = "the slopes of the residuals are not finite where the search ended"
        return adrift(hessian_eigenvalues=[], reason=reason)
    curvature, axes = np.linalg.eigh(fisher)
    if curvature[0] <= 1e-14 * curvature[-1]:
        return adrift(hessian_eigenvalues=curvature.tolist())
    scale = axes / np.sqrt(curvature)
    steps = np.zeros((2 * count + 1, len(coordinates)))
    steps[1 : count + 1, free], steps[count + 1 :, free] = _STEP * scale.T, -_STEP * scale.T
    _, gradient = objective.value_and_gradient(coordinates + steps, PLAIN)
    slope = gradient[:, free] @ scale / 2.0
    hessian = (slope[1 : count + 1] - slope[count + 1 :]) / (2.0 * _STEP)
    if not np.all(np.isfinite(hessian)) or not np.all(np.isfinite(slope[0])):
        return adrift(hessian_eigenvalues=[], reason="chi2 has no finite curvature where the search ended")
    hessian = 0.5 * (hessian + hessian.T)
    eigenvalues = np.linalg.eigvalsh(hessian)
    distance = float(slope[0] @ np.linalg.solve(hessian, slope[0])) if eigenvalues[0] > 0 else float("inf")
    converged = bool(eigenvalues[0] > 0 and distance < _ENOUGH and outward)
    return Convergence(converged, float(np.abs(2.0 * slope[0]).max()), eigenvalues.tolist(), distance, outward)


def at_bound(objective: Objective, values: Float[np.ndarray, " p"]) -> Bool[np.ndarray, " p"]:
    """Say which losses vanish within a hundredth of what the data could resolve, and what is at an end of its range."""
    resolution = np.sqrt(np.diag(covariance_of(_fisher(objective, values))))
    resolution = np.where(np.isfinite(resolution), resolution, 0.0)
    losses = np.array([np.inf if p.bound is None else p.bound for p in objective.problem.parameters])
    ends = objective.problem.ends
    # so near that the steps of the Hessian would leave it
    at_end = np.any(np.abs(values - ends) <= _STEP * resolution, axis=0) & np.isinf(losses)
    return (np.abs(values - losses) < 0.01 * resolution) | at_end


def _pushes_outward(objective: Objective, coordinates, free) -> bool:
    """Say whether chi2 would fall beyond every bound that a parameter sits on (the Karush-Kuhn-Tucker condition).

    A parameter that by leaving its bound would take less off chi2 than counts is no reason to go on.
    """
    if free.all():
        return True
    result = objective.at_values(objective.problem.values(coordinates)[None])
    jacobian = np.asarray(result.jacobian)[0]
    slope = jacobian.T @ np.asarray(result.residual)[0]
    little = slope**2 < _ENOUGH * np.sum(jacobian**2, axis=0)
    values = objective.problem.values(coordinates)
    lowest, highest = objective.problem.ends
    inward = np.where(values - lowest < highest - values, 1.0, -1.0)
    return bool(np.all(((slope * inward >= 0.0) | little)[~free]))
