"""Draws of a posterior with what each of them predicts: readings, replicated ones, and how likely the measured are."""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from fitting.fits.objective import PLAIN, ROBUST, Objective, soft_square
from fitting.fits.result import FitResult
from fitting.forward import Linearised
from fitting.sampling.bootstrap import Refit, objective_of, plain, telling_rows
from fitting.sampling.posterior import grid_draws, log_prior
from fitting.sampling.posterior_result import Posterior

CHAINS, DRAWS = 4, 250
"""Draws that are looked at, of a posterior on a grid; of chains as many, evenly spaced."""


@dataclass(frozen=True, eq=False)
class PosteriorDraws:
    """Draws of a posterior and what they predict for the rows that say something.

    Attributes:
        names: of the parameters, nuisances included.
        rows: places of these rows in the table.
        measured: what was read there: peak, lock-in amplitude and, if the table has one, the phase; NaN: not used.
        error: of the readings, with the model's.
        values: of the parameters.
        statistics: what is known of the sampler's steps, by ArviZ's names, each of shape (chains, draws); `lp` is the
            logarithm of the posterior's density but for a constant.
        predicted: readings without noise.
        replicated: readings with noise, as another experiment would give them.
        log_likelihood: of each row's readings together.
        efficiency: independent draws per draw, 1 at most.
    """

    names: tuple[str, ...]
    rows: Int[np.ndarray, " rows"]
    measured: Float[np.ndarray, "rows k"]
    error: Float[np.ndarray, "rows k"]
    values: Float[np.ndarray, "chains draws p"]
    statistics: dict[str, np.ndarray]
    predicted: Float[np.ndarray, "chains draws rows k"]
    replicated: Float[np.ndarray, "chains draws rows k"]
    log_likelihood: Float[np.ndarray, "chains draws rows"]
    efficiency: float


class Densities(NamedTuple):
    """What sets of values predict, and how likely: logarithms of the rows' likelihoods and the posterior's density."""

    predicted: Float[np.ndarray, "sets rows k"]
    log_likelihood: Float[np.ndarray, "sets rows"]
    log_density: Float[np.ndarray, " sets"]


def refit_of_rows(result: FitResult) -> tuple[Refit, Int[np.ndarray, " rows"]]:
    """Return the fit's objective with the rows that say something alone, and their places in the table."""
    refit = objective_of(result)
    told = telling_rows(refit.objective)
    return Refit(refit.objective.of_rows(told), refit.values), told


def posterior_draws(result: FitResult, found: Posterior, *, seed: int = 0) -> PosteriorDraws:
    """Return draws of a fit's posterior, and what they predict.

    Args:
        result: from `fitting.fit`.
        found: its posterior, from `fitting.posterior`.
        seed: of the draws, where the posterior has none of its own, and of the replicated noise.
    """
    refit, told = refit_of_rows(result)
    random = np.random.default_rng(seed)
    values, statistics, efficiency = _draws_of(refit, found, random)
    shape = values.shape[:2]
    dense = densities(refit.objective, values.reshape(-1, values.shape[2]), found.log_uniform)
    rows = refit.objective.measurement.rows
    used = np.asarray(rows.measured)
    replicated = dense.predicted + noise_of(refit.objective, len(dense.predicted), random)

    def in_chains(column):
        return column.reshape(*shape, *column.shape[1:])

    return PosteriorDraws(
        names=refit.objective.problem.names,
        rows=told,
        measured=np.where(used, np.asarray(rows.amplitude_nm), np.nan),
        error=np.where(used, np.asarray(rows.error_nm), np.nan),
        values=values,
        statistics=statistics | {"lp": in_chains(dense.log_density)},
        predicted=in_chains(dense.predicted),
        replicated=in_chains(replicated),
        log_likelihood=in_chains(dense.log_likelihood),
        efficiency=efficiency,
    )


def _draws_of(refit: Refit, found: Posterior, random: np.random.Generator):
    """Return draws (chains, draws, p), their statistics, and how many of them are worth an independent one."""
    if found.chains is None:
        if found.grid is None:
            raise ValueError("this posterior has neither a grid nor chains to draw from")
        drawn = grid_draws(refit, found.grid, found.log_uniform, CHAINS * DRAWS, random)
        return drawn.reshape(CHAINS, DRAWS, -1), {}, 1.0
    chains, draws, _ = found.chains.samples.shape
    step = max(draws // DRAWS, 1)
    worth = float(np.mean(found.chains.effective_samples)) / (chains * draws)
    statistics = {name: each[:, ::step] for name, each in found.chains.statistics.items()}
    return found.chains.samples[:, ::step], statistics, min(step * worth, 1.0)


def densities(
    objective: Objective,
    values: Float[np.ndarray, "sets p"],
    log_uniform: tuple[str, ...] = (),
    shift: Float[np.ndarray, "... n"] | float = 0.0,
) -> Densities:
    """Return what sets of values predict and how likely that makes the readings.

    With a robust loss errors have the distribution that this loss stands for, the symmetric hyperbolic one.

    Args:
        objective: of the rows.
        values: of the parameters, within their ranges.
        log_uniform: as the posterior's.
        shift: what other readings add to the residuals, the same of all sets or of each.
    """
    from scipy.special import kve  # noqa: PLC0415 (most fits need no SciPy)

    found: Linearised = plain(objective).at_values(values)
    rows, predicted = objective.measurement.rows, np.asarray(found.prediction.amplitude_nm)
    residual = np.asarray(found.residual) + shift
    softness = ROBUST if objective.robust else PLAIN
    half = 0.5 * soft_square(residual, softness)
    readings, unseen = predicted[0].size, predicted.shape[1]
    weight = 2.0 * ROBUST * kve(1, ROBUST**2) if objective.robust else np.sqrt(2.0 * np.pi)
    known = np.where(np.asarray(rows.measured), np.log(weight * np.asarray(rows.error_nm)), 0.0)
    each = -half[:, :readings].reshape(predicted.shape) - known
    return Densities(
        predicted=predicted,
        log_likelihood=each.sum(axis=2) - half[:, readings : readings + unseen],
        log_density=-half.sum(axis=1) + log_prior(objective.problem, values, log_uniform),
    )


def noise_of(objective: Objective, sets: int, random: np.random.Generator) -> Float[np.ndarray, "sets rows k"]:
    """Return noise of readings, 0 where nothing was read."""
    rows = objective.measurement.rows
    used: Bool[np.ndarray, "rows k"] = np.asarray(rows.measured)
    shape: Any = (sets, *used.shape)
    standard = random.normal(size=shape)
    if objective.robust:
        from scipy.stats import genhyperbolic  # noqa: PLC0415 (most fits need no SciPy)

        # e^(-s^2 sqrt(1 + x^2/s^2)), with s the softness
        standard = genhyperbolic(1.0, ROBUST**2, 0.0, scale=ROBUST).rvs(size=shape, random_state=random)
    return np.where(used, np.asarray(rows.error_nm), 0.0) * standard
