"""Simulation-based calibration of a posterior at the data at hand: are true values anywhere in it equally often?

With p(theta | y) as the prior (T. Sailynoja, M. Schmitt, P.-C. Burkner, A. Vehtari, Posterior SBC, arXiv 2502.03279):
theta* is drawn from the posterior under test, a second table y' from theta*, with the same drives and errors; in
p(theta | y, y') the rank of theta* is uniform if the posterior is right. That second posterior is a Gaussian around
the fit of both tables (the errors that a fit states), and the same draws weighted to the exact density by
Pareto-smoothed importance sampling. Ranks among the weighted draws test the posterior under test, those among the plain
draws the Gaussian errors besides.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from fitting.fits.discrepancy import root_of
from fitting.fits.objective import Objective
from fitting.sampling.bootstrap import DataSets, Refit, fit_data_sets, shifts
from fitting.sampling.draws import densities, noise_of
from fitting.sampling.leave_one_out import pareto_smoothed
from fitting.sampling.posterior import log_prior

DRAWS = 64
"""Of every set's posterior."""
_FEWEST_EFFECTIVE = 5.0
"""Weighted draws that are worth fewer independent ones say nothing of a rank."""
_LEVELS = np.linspace(0.04, 0.96, 47)
"""Shares at which ranks are counted."""
_UNIFORM_SETS = 4000
LIKELIHOOD = "log_likelihood"
"""A quantity that depends on the data too: ranks of it are not uniform if data are ignored."""
IMPROBABLE = 0.01
"""Probability below which ranks are not taken to be uniform."""


@dataclass(frozen=True, eq=False)
class RankCalibration:
    """Ranks of true values in posteriors of simulated tables, as shares from 0 to 1.

    Attributes:
        quantities: the parameters, then the likelihood of the data.
        ranks: in the exact posteriors.
        gaussian_ranks: in the Gaussian ones that a fit states.
        p_values: probability of ranks farther from uniform, by quantity.
        gaussian_p_values: the same of the Gaussian ones.
        band: half-width, in standard deviations of a count, of the band that uniform ranks keep to in 95 % of cases.
        failed: sets that could not be fitted, or whose posterior is too far from Gaussian to be weighted; left out.
        seed: of the sets.
    """

    quantities: tuple[str, ...]
    ranks: Float[np.ndarray, "sets q"]
    gaussian_ranks: Float[np.ndarray, "sets q"]
    p_values: Float[np.ndarray, " q"]
    gaussian_p_values: Float[np.ndarray, " q"]
    band: float
    failed: int
    seed: int

    @property
    def p_value(self) -> float:
        """Probability of the least uniform quantity, times their number (Bonferroni)."""
        return _together(self.p_values)

    @property
    def gaussian_p_value(self) -> float:
        """The same of the Gaussian posteriors."""
        return _together(self.gaussian_p_values)


def calibrate_ranks(
    refit: Refit,
    believed: Float[np.ndarray, "draws p"],
    *,
    sets: int = 100,
    seed: int = 0,
    log_uniform: tuple[str, ...] = (),
    report: Callable[[int, int], None] | None = None,
) -> RankCalibration:
    """Return the ranks of true values in posteriors of simulated tables.

    Args:
        refit: the fit, its rows alone.
        believed: draws of its posterior, which is under test.
        sets: how many tables are simulated.
        seed: of the tables.
        log_uniform: as the posterior's.
        report: told how many tables are done, and of how many.

    Raises:
        ValueError: if hardly any could be fitted.
    """
    random = np.random.default_rng(seed)
    true = believed[random.choice(len(believed), sets, replace=sets > len(believed))]
    predicted = densities(refit.objective, true).predicted
    both, data = _both_tables(refit, predicted + noise_of(refit.objective, sets, random))
    fits, shift = fit_data_sets(both, data), shifts(both.objective, data)
    here = np.append(true, densities(both.objective, true, (), shift).log_density[:, None], axis=1)
    exact, gaussian = [], []
    for k in np.flatnonzero(fits.converged & np.isfinite(fits.covariance).all(axis=(1, 2))):
        drawn, weight = _posterior(both.objective, fits.values[k], fits.covariance[k], shift[k], log_uniform, random)
        if weight is not None and 1.0 / np.sum(weight**2) >= _FEWEST_EFFECTIVE:
            exact.append(_ranks(drawn, weight, here[k], random))
            gaussian.append(_ranks(drawn, np.full(DRAWS, 1.0 / DRAWS), here[k], random))
        if report is not None and (k + 1) % 10 == 0:
            report(int(k) + 1, sets)
    if len(exact) < max(10, sets // 2):
        raise ValueError(f"only {len(exact)} of {sets} simulated tables could be fitted and their posteriors weighted")
    uniform = _deviation(np.random.default_rng(0).random((_UNIFORM_SETS, len(exact))).T)
    found = [np.array(ranks) for ranks in (exact, gaussian)]
    p_values = [np.mean(uniform >= _deviation(ranks)[:, None], axis=1) for ranks in found]
    return RankCalibration(
        quantities=(*refit.objective.problem.names, LIKELIHOOD),
        ranks=found[0],
        gaussian_ranks=found[1],
        p_values=p_values[0],
        gaussian_p_values=p_values[1],
        band=float(np.quantile(uniform, 0.95)),
        failed=sets - len(exact),
        seed=seed,
    )


def _both_tables(refit: Refit, second: Float[np.ndarray, "sets rows k"]) -> tuple[Refit, DataSets]:
    """Return a refit of the table with a second one beside it, and the data sets of these; constraints count once."""
    objective = refit.objective
    rows = objective.measurement.rows
    first = np.broadcast_to(np.asarray(rows.amplitude_nm), second.shape)
    constraint = np.broadcast_to(np.asarray(objective.measurement.constraint_value), (len(second), refit.values.size))
    if not objective.robust:
        # two Gaussian readings are one at their mean
        both = objective.with_rows(error_nm=np.asarray(rows.error_nm) / np.sqrt(2.0))
        return Refit(both, refit.values), DataSets(0.5 * (first + second), constraint)
    count = first.shape[1]
    both = objective.of_rows(np.tile(np.arange(count), 2))
    both = both.with_rows(no_orbit=np.asarray(both.measurement.rows.no_orbit) & (np.arange(2 * count) < count))
    return Refit(both, refit.values), DataSets(np.concatenate([first, second], axis=1), constraint)


def _posterior(
    objective: Objective,
    values: Float[np.ndarray, " p"],
    covariance: Float[np.ndarray, "p p"],
    shift: Float[np.ndarray, " n"],
    log_uniform: tuple[str, ...],
    random: np.random.Generator,
) -> tuple[Float[np.ndarray, "draws q"], Float[np.ndarray, " draws"] | None]:
    """Return Gaussian draws around a fit with their likelihoods, and weights that make them the exact posterior's."""
    z = random.normal(size=(DRAWS, values.size))
    drawn = values + z @ root_of(covariance).T
    lowest, highest = np.array([(p.lowest, p.highest) for p in objective.problem.parameters]).T
    inside = np.all((drawn >= lowest) & (drawn <= highest), axis=1)
    within = np.clip(drawn, lowest, highest)
    likelihood = densities(objective, within, (), shift).log_density
    with_likelihood = np.append(drawn, likelihood[:, None], axis=1)
    raw = likelihood + log_prior(objective.problem, within, log_uniform) + 0.5 * np.sum(z**2, axis=1)
    raw = np.where(inside & np.isfinite(raw), raw, -np.inf)
    if not np.isfinite(raw).any():
        return with_likelihood, None
    return with_likelihood, np.exp(pareto_smoothed(raw)[0])


def _ranks(drawn, weight, here, random: np.random.Generator) -> Float[np.ndarray, " q"]:
    """Return where values stand among weighted draws, ties with the ends broken at random: uniform from 0 to 1."""
    worth = 1.0 / np.sum(weight**2)
    below = weight @ (drawn < here)
    return (worth * below + random.random(here.size)) / (worth + 1.0)


def _deviation(ranks: Float[np.ndarray, "sets q"]) -> Float[np.ndarray, " q"]:
    """Return the largest deviation of the share of ranks below each level from it, in standard deviations."""
    below = np.stack([np.mean(ranks <= level, axis=0) for level in _LEVELS])
    spread = np.sqrt(_LEVELS * (1.0 - _LEVELS) / len(ranks))
    return np.max(np.abs(below - _LEVELS[:, None]) / spread[:, None], axis=0)


def _together(p_values: Float[np.ndarray, " q"]) -> float:
    return float(min(p_values.size * p_values.min(), 1.0))
