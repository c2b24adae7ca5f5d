"""A posterior as a netCDF file in ArviZ's layout: a group each for draws, predictions, likelihoods and readings.

ArviZ computes leave-one-out, Pareto k by row and predictive checks of it.
"""

import importlib
import importlib.util
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from afm_jax.checks import checked
from afm_jax.version import __version__
from afm_jax.whole_files import write_whole
from fitting.fits.objective import PLAIN, ROBUST, Objective, soft_square
from fitting.fits.result import FitResult
from fitting.models import Problem
from fitting.sampling.bootstrap import Refit, objective_of, plain, telling_rows
from fitting.sampling.posterior_result import Posterior

DRAWS = 250
"""Draws of each chain that are written, evenly spaced."""
READINGS = ("peak_amplitude_nm", "lockin_amplitude_nm", "phase_deg")


def require_netcdf() -> Any:
    """Return xarray, which writes such files.

    Raises:
        ModuleNotFoundError: if it or h5netcdf is not installed.
    """
    for package in ("xarray", "h5netcdf"):
        if importlib.util.find_spec(package) is None:
            raise ModuleNotFoundError(
                f"a file for ArviZ needs the package {package}: pip install 'afm-jax[arviz]'", name=package
            )
    return importlib.import_module("xarray")


@checked
def write_inference_data(result: FitResult, found: Posterior, path: str | Path, *, seed: int = 0) -> None:
    """Write a posterior for ArviZ: `arviz.from_netcdf(path)` reads it.

    The groups are posterior, sample_stats, log_likelihood (of each row's readings together), posterior_predictive and
    observed_data; rows are named by their lines in the table's file.

    Args:
        result: from `fitting.fit`.
        found: its posterior, from `fitting.posterior`.
        path: of the file.
        seed: of the replicated noise.

    Raises:
        ModuleNotFoundError: if xarray or h5netcdf is not installed (extra `arviz`).
        OSError: if the file cannot be written.
    """
    xarray = require_netcdf()
    draws = posterior_draws(result, found, seed=seed)
    lines, draw = result.table.lines[draws.rows], ("chain", "draw")
    steps = {name: np.arange(size) for name, size in zip(draw, draws.values.shape, strict=False)}
    predictive, observed, places = {}, {}, {}
    for kind, name in enumerate(READINGS[: draws.measured.shape[1]]):
        read = np.isfinite(draws.measured[:, kind])
        if read.any():
            place = f"{name}_line"
            places[place] = lines[read]
            predictive[name] = (*draw, place), draws.replicated[:, :, read, kind]
            observed[name] = place, draws.measured[read, kind]
    chains = {name: (draw, column) for name, column in draws.statistics.items()}
    groups = {
        "posterior": ({name: (draw, draws.values[..., i]) for i, name in enumerate(draws.names)}, steps),
        "sample_stats": (chains, steps),
        "log_likelihood": ({"readings": ((*draw, "line"), draws.log_likelihood)}, steps | {"line": lines}),
        "posterior_predictive": (predictive, steps | places),
        "observed_data": (observed, places),
    }
    about = {
        "inference_library": "afm-jax",
        "inference_library_version": __version__,
        "model": result.model,
        "table": result.table.source,
    }
    with tempfile.TemporaryDirectory() as folder:
        whole = Path(folder) / "whole.nc"
        for group, (variables, coordinates) in groups.items():
            data = xarray.Dataset(variables, coords=coordinates, attrs=about)
            data.to_netcdf(whole, group=group, mode="a" if whole.exists() else "w", engine="h5netcdf")
        write_whole(path, whole.read_bytes(), named_by_user=True)


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


def posterior_draws(result: FitResult, found: Posterior, *, seed: int = 0) -> PosteriorDraws:
    """Return draws of a fit's posterior, `DRAWS` of each chain at most, and what they predict.

    Args:
        result: from `fitting.fit`.
        found: its posterior, from `fitting.posterior`.
        seed: of the replicated noise.
    """
    refit, rows = refit_of_rows(result)
    step = max(found.chains.samples.shape[1] // DRAWS, 1)
    values = found.chains.samples[:, ::step]
    statistics = {name: column[:, ::step] for name, column in found.chains.statistics.items()}
    dense = densities(refit.objective, values.reshape(-1, values.shape[2]), found.log_uniform)
    noise = noise_of(refit.objective, len(dense.predicted), np.random.default_rng(seed))
    used = np.asarray(refit.objective.measurement.rows.measured)

    def in_chains(column):
        return column.reshape(*values.shape[:2], *column.shape[1:])

    return PosteriorDraws(
        names=refit.objective.problem.names,
        rows=rows,
        measured=np.where(used, np.asarray(refit.objective.measurement.rows.amplitude_nm), np.nan),
        error=np.where(used, np.asarray(refit.objective.measurement.rows.error_nm), np.nan),
        values=values,
        statistics=statistics | {"lp": in_chains(dense.log_density)},
        predicted=in_chains(dense.predicted),
        replicated=in_chains(dense.predicted + noise),
        log_likelihood=in_chains(dense.log_likelihood),
    )


def refit_of_rows(result: FitResult) -> tuple[Refit, Int[np.ndarray, " rows"]]:
    """Return the fit's objective with the rows that say something alone, and their places in the table."""
    refit = objective_of(result)
    rows = telling_rows(refit.objective)
    return Refit(refit.objective.of_rows(rows), refit.values), rows


class Densities(NamedTuple):
    """What sets of values predict, and how likely: logarithms of the rows' likelihoods and the posterior's density."""

    predicted: Float[np.ndarray, "sets rows k"]
    log_likelihood: Float[np.ndarray, "sets rows"]
    log_density: Float[np.ndarray, " sets"]


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
        shift: what other readings add to the residuals, of all sets or of each.
    """
    from scipy.special import kve  # noqa: PLC0415 (most fits need no SciPy)

    prediction = plain(objective).at_values(values)
    rows, predicted = objective.measurement.rows, np.asarray(prediction.prediction.amplitude_nm)
    residual = np.asarray(prediction.residual) + shift
    half = 0.5 * soft_square(residual, ROBUST if objective.robust else PLAIN)
    readings, unseen = predicted[0].size, predicted.shape[1]
    weight = 2.0 * ROBUST * kve(1, ROBUST**2) if objective.robust else np.sqrt(2.0 * np.pi)
    norm = np.where(np.asarray(rows.measured), np.log(weight * np.asarray(rows.error_nm)), 0.0)
    each = -half[:, :readings].reshape(predicted.shape) - norm
    return Densities(
        predicted=predicted,
        log_likelihood=each.sum(axis=2) - half[:, readings : readings + unseen],
        log_density=-half.sum(axis=1) + log_prior(objective.problem, values, log_uniform),
    )


def log_prior(
    problem: Problem, values: Float[np.ndarray, "sets p"], log_uniform: tuple[str, ...]
) -> Float[np.ndarray, " sets"]:
    """Return the logarithm of the prior at sets of values, but for constraints and a constant."""
    total = np.zeros(len(values))
    for parameter, column in zip(problem.parameters, values.T, strict=True):
        if parameter.name in log_uniform:
            total -= np.log(np.maximum(np.abs(column - parameter.reference), 1e-300))
    return total


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
