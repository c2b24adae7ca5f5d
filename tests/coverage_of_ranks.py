"""Simulation-based calibration of whole posteriors, with many simulated tables of the bundled ones.

    python -m tests.coverage_of_ranks [--sets 1000]

Are true values anywhere in the posterior equally often? With p(theta | y) as the prior (T. Sailynoja, M. Schmitt, P.-C.
Burkner, A. Vehtari, Posterior SBC, arXiv 2502.03279): theta* is drawn from the posterior under test, a second table y'
from theta*, with the drives and errors of the first; in p(theta | y, y') the rank of theta* is uniform if the posterior
is right. That second posterior is a Gaussian around the fit of both tables (the errors that a fit states), and its
draws weighted to the exact density by importance sampling.

A line for each table and model; then the same posterior a fifth too narrow and half a standard deviation off, which
must be noticed. `make ranks` runs it; the exit status is 1 if a posterior is not uniform, or a wrong one is taken for
right.
"""

import argparse
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import Float

import fitting.examples
from fitting import FitResult, fit, posterior, read_table
from fitting.infer.explain import Explained
from fitting.infer.fit import explained_of
from fitting.infer.instantaneous import Chi2
from fitting.infer.law import root_of
from fitting.infer.search import Followed, descend
from fitting.infer.summary import convergence_of
from fitting.infer.unknowns import _FACTORS
from fitting.sampling.posterior import sampled_by_gaussian

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
            p_value, failed = calibrate_ranks(explained, draws, sets)
            right = (p_value >= PROBABILITY) == (said == "as sampled")
            missed += not right
            line = f"{name}, {model}, {said}: probability {p_value:.2g}, {failed} of {sets} failed"
            sys.stdout.write(f"{line}{'' if right else '  MISSED'}\n")
            sys.stdout.flush()
    return 1 if missed else 0


def draws_of(explained: Explained, result: FitResult) -> Float[np.ndarray, "draws k"]:
    """Return draws of all unknowns, those that a posterior's samples are made of."""
    samples = posterior(result).chains.samples
    if not sampled_by_gaussian(result.model):
        return unknowns_of(explained, samples.reshape(-1, samples.shape[2]))
    root = root_of(explained.covariance)
    return explained.end.theta + np.random.default_rng(0).normal(size=(4000, root.shape[1])) @ root.T


def calibrate_ranks(explained: Explained, draws: Float[np.ndarray, "draws k"], sets: int) -> tuple[float, int]:
    """Return how probable the ranks of true values are in posteriors of simulated tables, and how many tables failed.

    Ranks are those of each unknown and of the likelihood of the data, which depends on them too: its ranks are not
    uniform if a posterior ignores the data. The probability is that of ranks farther from uniform, of the least uniform
    quantity, times their number (Bonferroni). A set fails that could not be fitted, or whose posterior is too far from
    Gaussian to be weighted.

    Args:
        explained: the fit.
        draws: of its posterior, which is under test.
        sets: how many tables are simulated.

    Raises:
        ValueError: if hardly any could be fitted.
    """
    random = np.random.default_rng(0)
    true = draws[random.choice(len(draws), sets, replace=sets > len(draws))]
    second = readings_of(explained, true) + noise_of(explained, sets, random)
    exact, (mean, _) = [], explained.model.prior
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
            exact.append(_ranks(drawn, weight, np.append(theta, chi2_of(found, theta[None])), random))
    if len(exact) < max(10, sets // 2):
        raise ValueError(f"only {len(exact)} of {sets} simulated tables could be fitted and their posteriors weighted")
    uniform = _deviation(np.random.default_rng(0).random((4000, len(exact))).T)
    farther = np.mean(uniform >= _deviation(np.array(exact))[:, None], axis=1)
    return float(min(farther.size * farther.min(), 1.0)), sets - len(exact)


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


def noise_of(explained: Explained, sets: int, random: np.random.Generator) -> Float[np.ndarray, "sets rows 3"]:
    """Return noise of readings with the rows' covariances, 0 where nothing counts."""
    # zero rows and columns are those of what does not count
    root = np.linalg.pinv(explained.weights.whitening)
    return np.einsum("nij,snj->sni", root, random.normal(size=(sets, *explained.weights.used.shape)))


def with_data(
    explained: Explained, read: Float[np.ndarray, "rows 3"], mean: Float[np.ndarray, " k"], *, sharper: float = 1.0
) -> Explained:
    """Return a fit, not at its minimum, whose table has other readings, with errors over a number."""
    model = replace(explained.model, data=replace(explained.model.data, read=read))
    # it is computed when it is asked for first, and kept
    vars(model)["prior"] = mean, explained.model.prior[1]
    weights = explained.weights._replace(whitening=sharper * explained.weights.whitening)
    return replace(explained, model=model, weights=weights)


def refitted(explained: Explained) -> Explained:
    """Return the minimum for a table's readings, from the fit of another one, by the same weights."""
    law: Any = explained.model.law
    if law.lasting:
        end = descend(explained.model, explained.end.theta, explained.end.orbits, explained.weights)
        return replace(explained, end=end)
    chi2 = Chi2(explained.model, explained.weights)
    return chi2.explained(chi2.descended(explained.end.theta))


def chi2_of(explained: Explained, theta: Float[np.ndarray, "draws k"]) -> Float[np.ndarray, " draws"]:
    """Return chi2 at unknowns; infinite where a row has lost its orbit."""
    law: Any = explained.model.law
    if law.lasting:
        rows = Followed(explained.model, explained.end.theta, explained.end.orbits, explained.weights, np.inf)
        return np.array([rows.sum(one).value for one in theta])
    chi2 = Chi2(explained.model, explained.weights)
    return np.array([np.sum(chi2.at(one)[1] ** 2) for one in theta])


def readings_of(explained: Explained, theta: Float[np.ndarray, "draws k"]) -> Float[np.ndarray, "draws rows 3"]:
    """Return what unknowns predict without noise; NaN of a row without an orbit where impacts last."""
    model = explained.model
    law: Any = model.law
    if law.lasting:
        found = [model.follow(one, explained.end.orbits.x) for one in theta]
        return np.array([np.where(one.closes[:, None], one.readings, np.nan) for one in found])
    chi2 = Chi2(model, explained.weights)
    return np.array([chi2.at(one)[0].orbits.readings for one in theta])


def unknowns_of(explained: Explained, values: Float[np.ndarray, "draws p"]) -> Float[np.ndarray, "draws p"]:
    """Return the unknowns of an instantaneous law and of the instrument for values of the printed parameters."""
    law: Any = explained.model.law
    own = [law.unknown_of(name, column) for name, column in zip(law.names, values.T, strict=False)]
    for quantity, column in zip(explained.model.instrument, values.T[len(own) :], strict=True):
        off = np.log(column / quantity.value) * quantity.value if quantity.kind in _FACTORS else column - quantity.value
        own.append(off / quantity.error)
    return np.stack(own, axis=1)


if __name__ == "__main__":
    sys.exit(main())
