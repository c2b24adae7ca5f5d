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
from fitting import FitResult, fit, posterior, read_table
from fitting.infer.explain import Explained
from fitting.infer.fit import explained_of
from fitting.infer.law import root_of
from fitting.infer.summary import convergence_of
from fitting.sampling.posterior import sampled_by_gaussian
from tests.batched_refit import chi2_of, noise_of, readings_of, refitted, unknowns_of, with_data

TABLES = (
    ("amplitudes_law.csv", "law", 1),
    ("amplitudes_contact.csv", "viscous+delay", 5),
)
"""Tables and models; what the number of simulated tables is divided by, for a fit of impacts that last takes longer."""
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

    Of each quantity: the unknowns, then the likelihood of the data, which depends on them too: its ranks are not
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
    parser.add_argument("--sets", type=int, default=1000, help="simulated tables, a fifth where impacts last")
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)  # noqa: FBT003
    missed = 0
    for name, model, fewer in TABLES:
        result, sets = fit(read_table(Path(fitting.examples.__path__[0]) / name), model), options.sets // fewer
        explained = explained_of(result)
        drawn = draws_of(explained, result)
        middle, error = drawn.mean(axis=0), drawn.std(axis=0)
        narrow, shifted = middle + 0.8 * (drawn - middle), drawn + 0.5 * error
        for said, draws in (("as sampled", drawn), ("a fifth too narrow", narrow), ("half an error off", shifted)):
            ranks = calibrate_ranks(explained, draws, sets=sets)
            right = (ranks.p_value >= PROBABILITY) == (said == "as sampled")
            missed += not right
            sys.stdout.write(
                f"{name}, {model}, {said}: probability {ranks.p_value:.2g}, Gaussian {ranks.gaussian_p_value:.2g}, "
                f"{ranks.failed} of {sets} failed{'' if right else '  MISSED'}\n"
            )
            sys.stdout.flush()
    return 1 if missed else 0


def draws_of(explained: Explained, result: FitResult) -> Float[np.ndarray, "draws k"]:
    """Return draws of all unknowns, those that a posterior's samples are made of."""
    samples = posterior(result).chains.samples
    if not sampled_by_gaussian(result.model):
        return unknowns_of(explained, samples.reshape(-1, samples.shape[2]))
    root = root_of(explained.covariance)
    return explained.end.theta + np.random.default_rng(0).normal(size=(4000, root.shape[1])) @ root.T


def calibrate_ranks(
    explained: Explained,
    draws: Float[np.ndarray, "draws k"],
    *,
    sets: int = 100,
    seed: int = 0,
) -> RankCalibration:
    """Return the ranks of true values in posteriors of simulated tables.

    Args:
        explained: the fit.
        draws: of its posterior, which is under test.
        sets: how many tables are simulated.
        seed: of the tables.

    Raises:
        ValueError: if hardly any could be fitted.
    """
    random = np.random.default_rng(seed)
    true = draws[random.choice(len(draws), sets, replace=sets > len(draws))]
    second = readings_of(explained, true) + noise_of(explained, sets, random)
    exact, gaussian, (mean, _) = [], [], explained.model.prior
    for theta, read in zip(true, second, strict=True):
        # two Gaussian readings are one at their mean
        both = with_data(explained, 0.5 * (explained.model.data.read + read), mean, sharper=np.sqrt(2.0))
        if not np.isfinite(read[both.weights.used]).all():
            continue
        found = refitted(both)
        if not (convergence_of(found, "", 0).converged and np.isfinite(found.covariance).all()):
            continue
        drawn, weight = _posterior(found, random)
        if weight is not None and 1.0 / np.sum(weight**2) >= _FEWEST_EFFECTIVE:
            here = np.append(theta, chi2_of(found, theta[None]))
            exact.append(_ranks(drawn, weight, here, random))
            gaussian.append(_ranks(drawn, np.full(DRAWS, 1.0 / DRAWS), here, random))
    if len(exact) < max(10, sets // 2):
        raise ValueError(f"only {len(exact)} of {sets} simulated tables could be fitted and their posteriors weighted")
    uniform = _deviation(np.random.default_rng(0).random((_UNIFORM_SETS, len(exact))).T)
    p_values = []
    for ranks in (exact, gaussian):
        farther = np.mean(uniform >= _deviation(np.array(ranks))[:, None], axis=1)
        p_values.append(float(min(farther.size * farther.min(), 1.0)))
    return RankCalibration(*p_values, failed=sets - len(exact))


def _posterior(
    found: Explained, random: np.random.Generator
) -> tuple[Float[np.ndarray, "draws q"], Float[np.ndarray, " draws"] | None]:
    """Return Gaussian draws around a fit with their chi2, and weights that make them the exact posterior's."""
    root, law = root_of(found.covariance), found.model.law
    z = random.normal(size=(DRAWS, root.shape[1]))
    drawn = found.end.theta + z @ root.T
    # losses of an instantaneous law are not negative
    lost = np.any(drawn[:, : 0 if law.lasting else len(law.own)] < 0.0, axis=1)
    chi2 = chi2_of(found, np.where(lost[:, None], found.end.theta, drawn))
    raw = np.where(lost | ~np.isfinite(chi2), -np.inf, -0.5 * chi2 + 0.5 * np.sum(z**2, axis=1))
    with_chi2 = np.append(drawn, chi2[:, None], axis=1)
    if not np.isfinite(raw).any():
        return with_chi2, None
    return with_chi2, np.exp(raw - np.logaddexp.reduce(raw))


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
