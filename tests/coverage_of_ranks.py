"""Simulation-based calibration of whole posteriors, with many simulated tables of the bundled ones.

    python -m tests.coverage_of_ranks [--sets 1000]

Are true values anywhere in the posterior equally often? With p(theta | y) as the prior (T. Sailynoja, M. Schmitt, P.-C.
Burkner, A. Vehtari, Posterior SBC, arXiv 2502.03279): theta* is drawn from the posterior under test, a second table y'
from theta*, with the drives and errors of the first; in p(theta | y, y') the rank of theta* is uniform if the posterior
is right. That second posterior is a Gaussian around the fit of both tables (the errors that a fit states), and its
draws weighted to the exact density by importance sampling. Ranks among the weighted draws test the posterior under
test, those among the plain draws the Gaussian errors besides.

A line for each table and model; then the same posterior a fifth too narrow and half a standard deviation off, which
must be noticed. `make ranks` runs it; the exit status is 1 if a posterior is not uniform, or a wrong one is taken for
right.
"""

import argparse
import sys
from dataclasses import dataclass
from pathlib import Path

import jax
import numpy as np
from jaxtyping import Float

import fitting.examples
from fitting import fit, posterior, read_table
from fitting.fits.law_after import root_of
from fitting.fits.objective import Objective
from fitting.sampling.refit import Refit
from tests.batched_refit import DataSets, densities, fit_data_sets, noise_of, posterior_draws, refit_of_rows, shifts

TABLES = (
    ("amplitudes_law.csv", "law"),
    ("amplitudes_contact.csv", "viscous+delay"),
)
PROBABILITY = 1e-3
DRAWS = 64
"""Of every set's posterior."""
_FEWEST_EFFECTIVE = 5.0
"""Weighted draws that are worth fewer independent ones say nothing of a rank."""
_LEVELS = np.linspace(0.04, 0.96, 47)
"""Shares at which ranks are counted."""
_UNIFORM_SETS = 4000


@dataclass(frozen=True, eq=False)
class RankCalibration:
    """Ranks of true values in posteriors of simulated tables, as shares from 0 to 1.

    Of each quantity: the parameters, then the likelihood of the data, which depends on them too: its ranks are not
    uniform if a posterior ignores the data.

    Attributes:
        p_value: probability of ranks in the exact posteriors that are farther from uniform, of the least uniform
            quantity, times their number (Bonferroni).
        gaussian_p_value: likewise of ranks in the Gaussian posteriors that a fit states.
        failed: sets that could not be fitted, or whose posterior is too far from Gaussian to be weighted; left out.
    """

    p_value: float
    gaussian_p_value: float
    failed: int


def main() -> int:
    """Simulate, print and judge."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0] if __doc__ else None)
    parser.add_argument("--sets", type=int, default=1000, help="simulated tables of each")
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)  # noqa: FBT003
    missed = 0
    for name, model in TABLES:
        result = fit(read_table(Path(fitting.examples.__path__[0]) / name), model)
        drawn = posterior_draws(result, posterior(result)).values
        drawn = drawn.reshape(-1, drawn.shape[2])
        middle, error = drawn.mean(axis=0), drawn.std(axis=0)
        narrow, shifted = middle + 0.8 * (drawn - middle), drawn + 0.5 * error
        for said, draws in (("as sampled", drawn), ("a fifth too narrow", narrow), ("half an error off", shifted)):
            ranks = calibrate_ranks(refit_of_rows(result)[0], draws, sets=options.sets)
            right = (ranks.p_value >= PROBABILITY) == (said == "as sampled")
            missed += not right
            sys.stdout.write(
                f"{name}, {model}, {said}: probability {ranks.p_value:.2g}, Gaussian {ranks.gaussian_p_value:.2g}, "
                f"{ranks.failed} of {options.sets} failed{'' if right else '  MISSED'}\n"
            )
            sys.stdout.flush()
    return 1 if missed else 0


def calibrate_ranks(
    refit: Refit,
    draws: Float[np.ndarray, "draws p"],
    *,
    sets: int = 100,
    seed: int = 0,
) -> RankCalibration:
    """Return the ranks of true values in posteriors of simulated tables.

    Args:
        refit: the fit, its rows alone.
        draws: of its posterior, which is under test.
        sets: how many tables are simulated.
        seed: of the tables.

    Raises:
        ValueError: if hardly any could be fitted.
    """
    random = np.random.default_rng(seed)
    true = draws[random.choice(len(draws), sets, replace=sets > len(draws))]
    predicted = densities(refit.objective, true).predicted
    both, data = _both_tables(refit, predicted + noise_of(refit.objective, sets, random))
    fits, shift = fit_data_sets(both, data), shifts(both.objective, data)
    here = np.append(true, densities(both.objective, true, shift).log_density[:, None], axis=1)
    exact, gaussian = [], []
    for k in np.flatnonzero(fits.converged & np.isfinite(fits.covariance).all(axis=(1, 2))):
        drawn, weight = _posterior(both.objective, fits.values[k], fits.covariance[k], shift[k], random)
        if weight is not None and 1.0 / np.sum(weight**2) >= _FEWEST_EFFECTIVE:
            exact.append(_ranks(drawn, weight, here[k], random))
            gaussian.append(_ranks(drawn, np.full(DRAWS, 1.0 / DRAWS), here[k], random))
    if len(exact) < max(10, sets // 2):
        raise ValueError(f"only {len(exact)} of {sets} simulated tables could be fitted and their posteriors weighted")
    uniform = _deviation(np.random.default_rng(0).random((_UNIFORM_SETS, len(exact))).T)
    p_values = []
    for ranks in (exact, gaussian):
        farther = np.mean(uniform >= _deviation(np.array(ranks))[:, None], axis=1)
        p_values.append(float(min(farther.size * farther.min(), 1.0)))
    return RankCalibration(*p_values, failed=sets - len(exact))


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
    random: np.random.Generator,
) -> tuple[Float[np.ndarray, "draws q"], Float[np.ndarray, " draws"] | None]:
    """Return Gaussian draws around a fit with their likelihoods, and weights that make them the exact posterior's."""
    z = random.normal(size=(DRAWS, values.size))
    drawn = values + z @ root_of(covariance).T
    lowest, highest = np.array([(p.lowest, p.highest) for p in objective.problem.parameters]).T
    inside = np.all((drawn >= lowest) & (drawn <= highest), axis=1)
    within = np.clip(drawn, lowest, highest)
    likelihood = densities(objective, within, shift).log_density
    with_likelihood = np.append(drawn, likelihood[:, None], axis=1)
    raw = likelihood + 0.5 * np.sum(z**2, axis=1)
    raw = np.where(inside & np.isfinite(raw), raw, -np.inf)
    if not np.isfinite(raw).any():
        return with_likelihood, None
    return with_likelihood, np.exp(raw - np.logaddexp.reduce(raw))


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


if __name__ == "__main__":
    sys.exit(main())
