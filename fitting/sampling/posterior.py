"""The posterior of a fit: on a grid that fits itself to the density for one or two parameters, by NUTS for more.

On the grid nuisances have a Gaussian constraint each: they are integrated out by Laplace's method at every point.
"""

from collections.abc import Callable, Sequence
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float

from afm_jax.checks import checked
from afm_jax.units import TWO_SIDED_95
from fitting.fits.objective import Objective
from fitting.fits.result import FitResult
from fitting.models import Problem
from fitting.sampling.bootstrap import Refit, compact, objective_of, require_valid, standard_covariance
from fitting.sampling.posterior_result import Posterior, PosteriorGrid

FEWEST_SAMPLES = 100


@checked
def posterior(
    result: FitResult,
    *,
    method: Literal["auto", "grid", "nuts"] = "auto",
    log_uniform: Sequence[str] = (),
    samples: int = 1000,
    seed: int = 0,
) -> Posterior:
    """Return the posterior of the parameters, with priors flat in their values.

    Constraints of the fit (the quality factor's, calibrations) are Gaussian priors.

    Args:
        result: from `fitting.fit`; it must be valid.
        method: "grid" for models with one or two parameters of their own, nuisances integrated out by Laplace's method;
            "nuts" for any, with the optional package blackjax; "auto": the grid where it can.
        log_uniform: losses whose prior is flat in their logarithm instead.
        samples: for NUTS: draws of each of four chains.
        seed: for NUTS.

    Raises:
        ValueError: if the fit is not valid, an option is impossible, or the data do not determine every parameter.
        ImportError: if NUTS is asked for and blackjax is not installed.
    """
    require_valid(result)
    # the packages of the methods are loaded when they are needed
    from fitting.sampling.nuts import nuts_posterior, require_blackjax  # noqa: PLC0415

    refit = compact(objective_of(result))
    problem = refit.objective.problem
    if method not in {"auto", "grid", "nuts"}:
        raise ValueError(f"`method` must be 'auto', 'grid' or 'nuts', but is {method!r}")
    for name in log_uniform:
        if name not in problem.own or not any(p.name == name and not p.width for p in problem.parameters):
            raise ValueError(f"`log_uniform` must name losses of the model {result.model!r}, but one is {name!r}")
    if method == "grid" or (method == "auto" and len(problem.own) <= 2):
        return grid_posterior(refit, tuple(log_uniform))
    if samples < FEWEST_SAMPLES:
        raise ValueError(f"`samples` must be at least {FEWEST_SAMPLES}, but is {samples}")
    require_blackjax()
    return nuts_posterior(refit, tuple(log_uniform), samples, seed)


POINTS = 49
_COARSE = 17
_FIRST_REACH = 6.0
"""Half the width of the first box in standard errors."""
_NEGLIGIBLE = 16.0
"""A fall of the log density by more than this, a factor of 1e-7, ends the box."""
_ROUNDS = 8
_NUISANCE_STEPS = 4
_SETTLED = 1e-3
_FINE = 4001


class _Axis(NamedTuple):
    """One axis of the box: its ends, and where the parameter's range ends."""

    low: float
    high: float
    lowest: float
    highest: float

    def points(self, count: int) -> Float[np.ndarray, " count"]:
        return np.linspace(self.low, self.high, count)


def grid_posterior(refit: Refit, log_uniform: tuple[str, ...] = ()) -> Posterior:
    """Return the posterior of a model with one or two parameters of its own.

    Args:
        refit: the fit, from `fitting.sampling.bootstrap.objective_of`.
        log_uniform: parameters whose prior is flat in the logarithm of their loss, not in their value.

    Raises:
        ValueError: if there are more parameters, or a prior flat in a logarithm has no end where the density is.
    """
    own = refit.objective.problem.own
    if len(own) > 2:
        raise ValueError(f"a grid takes one or two parameters, but the model has {', '.join(own)}; use NUTS")
    density = _Density(refit, log_uniform)
    axes = _box(density)
    points = tuple(axis.points(POINTS) for axis in axes)
    log_density, nuisance_mean, nuisance_square = density(points)
    weight = np.exp(log_density - log_density.max())
    weight /= _integral(weight, points)
    _require_proper(weight, points, own, density)
    mean, deviation, interval = {}, {}, {}
    for k, name in enumerate(own):
        marginal = weight if len(own) == 1 else np.trapezoid(weight, points[1 - k], axis=1 - k)
        mean[name], deviation[name], interval[name] = _summary(points[k], marginal)
    for k, name in enumerate(refit.objective.problem.names[len(own) :]):
        middle = _integral(weight * nuisance_mean[..., k], points)
        variance = _integral(weight * nuisance_square[..., k], points) - middle**2
        mean[name], deviation[name] = middle, float(np.sqrt(variance))
        # Gaussian to the order that Laplace's method keeps
        interval[name] = middle - TWO_SIDED_95 * deviation[name], middle + TWO_SIDED_95 * deviation[name]
    return Posterior(
        method="grid",
        log_uniform=log_uniform,
        mean=mean,
        standard_deviation=deviation,
        interval95=interval,
        converged=True,
        reasons=[],
        grid=PosteriorGrid(own, points, weight),
    )


class _Density:
    """The log density on a grid, with mean and mean square of the nuisances there."""

    def __init__(self, refit: Refit, log_uniform: tuple[str, ...]):
        self.objective, self.values = refit
        self.covariance = standard_covariance(refit)
        self.own = len(self.objective.problem.own)
        self.log_uniform = log_uniform
        block = self.covariance[: self.own, : self.own]
        # where the nuisances go, to first order, when the own parameters move
        self.follow = self.covariance[self.own :, : self.own] @ np.linalg.inv(block)

    @property
    def objective_parameters(self):
        return self.objective.problem.parameters[: self.own]

    def __call__(self, points: tuple[Float[np.ndarray, "..."], ...]):
        """Return the log density, and mean and mean square of the nuisances, each of the grid's shape."""
        shape = tuple(len(axis) for axis in points)
        mesh = np.stack([axis.ravel() for axis in np.meshgrid(*points, indexing="ij")], axis=1)
        nuisance = self.values[self.own :] + (mesh - self.values[: self.own]) @ self.follow.T
        chi2, nuisance, variance, volume = _integrate_nuisances(
            self.objective, np.concatenate([mesh, nuisance], axis=1), self.own
        )
        log_density = -0.5 * chi2 + volume + log_prior(self.objective.problem, mesh, self.log_uniform)
        square = nuisance**2 + np.einsum("spp->sp", variance)
        return log_density.reshape(shape), nuisance.reshape(*shape, -1), square.reshape(*shape, -1)


def log_prior(
    problem: Problem, values: Float[np.ndarray, "points k"], log_uniform: Sequence[str]
) -> Float[np.ndarray, " points"]:
    """Return the logarithm of the prior of a problem's first parameters, but for constraints and a constant."""
    total = np.zeros(len(values))
    for parameter, column in zip(problem.parameters, values.T, strict=False):
        if parameter.name in log_uniform:
            total -= np.log(np.maximum(np.abs(column - parameter.reference), 1e-300))
    return total


class _Nuisances(NamedTuple):
    """A parabola of chi2 in the nuisances at every point: its value and curvature, the step to its minimum."""

    chi2: Float[np.ndarray, " points"]
    curvature: Float[np.ndarray, "points q q"]
    step: Float[np.ndarray, "points q"]
    fall: Float[np.ndarray, " points"]


def _nuisances(objective: Objective, values: Float[np.ndarray, "points p"], own: int) -> _Nuisances:
    found = objective.at_values(values)
    residual, jacobian = np.asarray(found.residual), np.asarray(found.jacobian)[:, :, own:]
    curvature = np.einsum("snp,snq->spq", jacobian, jacobian)
    gradient = np.einsum("snp,sn->sp", jacobian, residual)
    step = -np.linalg.solve(curvature, gradient[:, :, None])[:, :, 0]
    return _Nuisances(np.sum(residual**2, axis=1), curvature, step, -np.einsum("sp,sp->s", gradient, step))


def _integrate_nuisances(objective: Objective, values: Float[np.ndarray, "points p"], own: int):
    """Return chi2 at its minimum over the nuisances, where that is, their covariance, and the log volume around it."""
    values = values.copy()
    found = _nuisances(objective, values, own)
    for _ in range(_NUISANCE_STEPS):
        # far from the fit nothing hangs on it
        moving = (found.fall > _SETTLED) & (found.chi2 - found.fall < found.chi2.min() + 4.0 * _NEGLIGIBLE)
        if not moving.any():
            break
        values[:, own:] += np.where(moving[:, None], found.step, 0.0)
        found = _nuisances(objective, values, own)
    volume = -0.5 * np.linalg.slogdet(found.curvature)[1]
    return found.chi2 - found.fall, values[:, own:] + found.step, np.linalg.inv(found.curvature), volume


def _box(density: _Density) -> list[_Axis]:
    """Return a box that ends where the density is negligible, or where a parameter's range does."""
    errors = np.sqrt(np.diag(density.covariance))[: density.own]
    axes = [
        _Axis(
            max(value - _FIRST_REACH * error, parameter.lowest),
            min(value + _FIRST_REACH * error, parameter.highest),
            parameter.lowest,
            parameter.highest,
        )
        for value, error, parameter in zip(density.values, errors, density.objective_parameters, strict=False)
    ]
    for _ in range(_ROUNDS):
        points = tuple(axis.points(_COARSE) for axis in axes)
        log_density, _, _ = density(points)
        again = [_fitted(axis, log_density, k) for k, axis in enumerate(axes)]
        settled = all(new == old for new, old in zip(again, axes, strict=True))
        axes = again
        if settled:
            break
    return axes


def _fitted(axis: _Axis, log_density: Float[np.ndarray, "..."], k: int) -> _Axis:
    """Return an axis widened where the density is cut off, narrowed where most of it holds nothing."""
    others = tuple(j for j in range(log_density.ndim) if j != k)
    height = log_density.max(axis=others) - log_density.max()
    points, width = axis.points(len(height)), axis.high - axis.low
    above = np.flatnonzero(height > -_NEGLIGIBLE)
    first, last = int(above[0]), int(above[-1])
    low, high = axis.low, axis.high
    if first == 0:
        low = max(axis.low - 0.5 * width, axis.lowest)
    elif first > 3:
        low = float(points[first - 2])
    if last == len(points) - 1:
        high = min(axis.high + 0.5 * width, axis.highest)
    elif last < len(points) - 4:
        high = float(points[last + 2])
    return axis._replace(low=low, high=high)


def _require_proper(weight, points, own: tuple[str, ...], density: _Density) -> None:
    """Refuse a prior flat in a logarithm where the loss may be zero: its integral does not exist.

    Raises:
        ValueError: if so.
    """
    for k, parameter in enumerate(density.objective_parameters):
        edge = 0 if parameter.sign >= 0 else -1
        there = np.take(weight, edge, axis=k).max()
        reached = parameter.bound is not None and points[k][edge] == parameter.bound
        if parameter.name in density.log_uniform and reached and there > np.exp(-_NEGLIGIBLE) * weight.max():
            raise ValueError(
                f"log_uniform: {own[k]} may be at its bound, {parameter.bound:g}, where such a prior has no end; leave "
                "it flat in the value"
            )


def _summary(points: Float[np.ndarray, " n"], marginal: Float[np.ndarray, " n"]):
    """Return mean, standard deviation and equal-tailed 95 % interval of a tabulated density."""
    from scipy.interpolate import PchipInterpolator  # noqa: PLC0415 (most fits need no SciPy)

    mean = float(np.trapezoid(points * marginal, points))
    deviation = float(np.sqrt(np.trapezoid((points - mean) ** 2 * marginal, points)))
    fine = np.linspace(points[0], points[-1], _FINE)
    rising: Callable[[np.ndarray], np.ndarray] = PchipInterpolator(points, marginal).antiderivative()
    cumulated = rising(fine)
    low, high = np.interp([0.025, 0.975], cumulated / cumulated[-1], fine)
    return mean, deviation, (float(low), float(high))


def _integral(weight: Float[np.ndarray, "..."], points: tuple[Float[np.ndarray, "..."], ...]) -> float:
    for axis in reversed(points):
        weight = np.trapezoid(weight, axis, axis=-1)
    return float(weight)


def grid_draws(
    refit: Refit, grid: PosteriorGrid, log_uniform: tuple[str, ...], count: int, random: np.random.Generator
) -> Float[np.ndarray, "count p"]:
    """Return draws of a posterior on a grid, nuisances included.

    Between the points the density is linear, a sum of triangles around them: a draw is a point and a triangle's. The
    nuisances are Gaussian for given parameters (Laplace).

    Args:
        refit: the fit, from `fitting.sampling.bootstrap.objective_of`.
        grid: its posterior.
        log_uniform: as the posterior's.
        count: of the draws.
        random: the generator that is drawn from.
    """
    weight = grid.density.copy()
    for k in range(weight.ndim):
        # a triangle at an end is a half
        np.moveaxis(weight, k, 0)[[0, -1]] *= 0.5
    chosen = np.unravel_index(random.choice(weight.size, count, p=weight.ravel() / weight.sum()), weight.shape)
    columns = []
    for axis, index in zip(grid.axes, chosen, strict=True):
        drawn = axis[index] + (axis[1] - axis[0]) * random.triangular(-1.0, 0.0, 1.0, count)
        # folded at an end: the half that is there
        columns.append(axis[-1] - np.abs(axis[-1] - (axis[0] + np.abs(drawn - axis[0]))))
    own, density = np.stack(columns, axis=1), _Density(refit, log_uniform)
    nuisance = refit.values[density.own :] + (own - refit.values[: density.own]) @ density.follow.T
    _, mean, variance, _ = _integrate_nuisances(refit.objective, np.concatenate([own, nuisance], axis=1), density.own)
    scatter = np.einsum("spq,sq->sp", np.linalg.cholesky(variance), random.normal(size=mean.shape))
    return np.concatenate([own, mean + scatter], axis=1)
