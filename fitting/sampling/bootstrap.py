"""The parametric bootstrap: how fitted values scatter when the fitted law is the truth of repeated experiments.

Many synthetic data sets of one table are fitted at once, from the objective of the finished fit, rebuilt from its
result. A data set enters the residuals only as a shift: (predicted - measured_k)/error = (predicted - measured)/error +
(measured - measured_k)/error. One compiled program therefore serves all of them, and since every fit starts at the same
values, the first linearisation serves all of them too.
"""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from afm_jax.checks import checked, require_float64
from afm_jax.contact.parameters import EFFECTS
from afm_jax.least_squares import Box, Searches, descended, distance, whole_covariance_of
from afm_jax.results import Result, public_result
from afm_jax.strict_json import plain as in_json
from fitting.fits.intervals import at_bound, covariance
from fitting.fits.objective import Objective, softened
from fitting.fits.result import FitResult
from fitting.models import ROWS_PER_PROGRAM, Problem, measurement_of
from fitting.tables.several import SeveralTables


class Refit(NamedTuple):
    """An objective with the orbits followed from a fit's values, and those values in the problem's order."""

    objective: Objective
    values: Float[np.ndarray, " p"]


def objective_of(result: FitResult) -> Refit:
    """Return the objective that a fit ended with: its rows, errors, constraints, effects and loss.

    Excluded rows stay excluded, and errors contain the model's error and the scale that the fit gave them.

    Args:
        result: from `fitting.fit`.

    Raises:
        ValueError: if the fit is of several tables.
        RuntimeError: if JAX is not set to 64-bit floats.
    """
    require_float64()
    if isinstance(result.table, SeveralTables):
        raise ValueError(  # noqa: TRY004 (a fit of several tables is no wrong type)
            "bootstrap and posterior are about one table; the intervals of a joint fit are its own"
        )
    settings = result.settings
    effects = EFFECTS if settings["effects"] is None else tuple(settings["effects"])
    names = tuple(result.parameters)
    problem = Problem(result.model, names, effects, result.table.drive)
    measurement = measurement_of(result.table, problem, settings["constraints"], settings["fixed"])
    values = np.array([result.parameters[name].value for name in names])
    stated = Objective(measurement, problem, robust=settings["robust"] is not None)
    size = np.asarray(measurement.rows.order).shape[0]
    error = np.full(np.asarray(measurement.rows.error_nm).shape, np.nan)
    error[: result.table.rows, :2] = result.rows.error_nm
    if result.rows.phase_error_deg is not None:
        error[: result.table.rows, 2] = result.rows.phase_error_deg
    used = np.isfinite(error)
    objective = stated.with_rows(error_nm=np.where(used, error, 1.0), measured=used)
    if result.model != "contact":
        return Refit(objective.following(values), values)
    # a contact's orbits are named by their approach speed, which the fit has noted: no need to search for them
    near = np.full(size, np.nan)
    near[: result.table.rows] = result.rows.approach_speed_nm_per_us
    return Refit(Objective(objective.measurement, problem, near=near, robust=objective.robust), values)


def compact(refit: Refit) -> Refit:
    """Return a refit without the rows that say nothing, padded anew: many fits of it take less time.

    Args:
        refit: from `objective_of`.
    """
    objective = refit.objective
    rows = objective.measurement.rows
    telling = telling_rows(objective)
    size = max(-(-telling.size // ROWS_PER_PROGRAM), 1) * ROWS_PER_PROGRAM
    if size == np.asarray(rows.order).shape[0]:
        return refit
    # the rest of the new size is filled with rows that say nothing either
    silent = np.setdiff1d(np.arange(np.asarray(rows.order).shape[0]), telling)
    chosen = np.concatenate([telling, silent[: size - telling.size]])
    return Refit(objective.of_rows(chosen), refit.values)


def telling_rows(objective: Objective) -> Int[np.ndarray, " telling"]:
    """Return the places of the rows that say something."""
    rows = objective.measurement.rows
    return np.flatnonzero(np.asarray(rows.measured).any(axis=1) | np.asarray(rows.no_orbit))


def standard_covariance(refit: Refit) -> Float[np.ndarray, "p p"]:
    """Return the Fisher covariance at a fit's values.

    Args:
        refit: from `objective_of`.

    Raises:
        ValueError: if the data do not determine every parameter.
    """
    matrix = covariance(refit.objective, refit.values, ~at_bound(refit.objective, refit.values))
    adrift = [
        name
        for name, own in zip(refit.objective.problem.names, np.diag(matrix), strict=True)
        if not (np.isfinite(own) and own > 0.0)
    ]
    if adrift:
        raise ValueError(
            f"the data do not determine {', '.join(adrift)}: there is no size of steps to start from; fit a model with "
            "fewer parameters, or constrain these"
        )
    return matrix


_STEPS = 40
_SETTLED = 1e-6
"""Estimated distance of chi2 to its minimum at which a data set is done: values within a thousandth of an error."""


class DataSets(NamedTuple):
    """Readings of shape (sets, rows, k), and the measured values of the constrained parameters, shape (sets, p)."""

    amplitude_nm: Float[np.ndarray, "sets rows k"]
    constraint_value: Float[np.ndarray, "sets p"]


class BatchFit(NamedTuple):
    """The fits of several data sets.

    Attributes:
        values: of the parameters.
        chi2: there; with a robust loss the soft sum.
        covariance: Fisher's, infinite where a direction is not determined.
        converged: the estimated distance to the minimum is small.
    """

    values: Float[np.ndarray, "sets p"]
    chi2: Float[np.ndarray, " sets"]
    covariance: Float[np.ndarray, "sets p p"]
    converged: Bool[np.ndarray, " sets"]


def draw_data(refit: Refit, sets: int, random: np.random.Generator) -> DataSets:
    """Return data sets as they would have been measured if the fitted values were the truth.

    Amplitudes scatter about the fitted ones by the rows' errors, and constraints, which are measurements as well, about
    the fitted parameters by theirs.

    Args:
        refit: the fit, from `fitting.sampling.bootstrap.objective_of`.
        sets: how many.
        random: the generator that is drawn from.
    """
    objective, values = refit
    rows, constraint = objective.measurement.rows, objective.measurement.constraint_error
    predicted = np.asarray(objective.at_values(values[None]).prediction.amplitude_nm)[0]
    errors = np.where(np.asarray(rows.measured), np.asarray(rows.error_nm), 0.0)
    known = np.where(np.isfinite(np.asarray(constraint)), np.asarray(constraint), 0.0)
    return DataSets(
        amplitude_nm=predicted + errors * random.normal(size=(sets, *errors.shape)),
        constraint_value=values + known * random.normal(size=(sets, known.size)),
    )


def fit_data_sets(refit: Refit, data: DataSets) -> BatchFit:
    """Fit every data set by damped Gauss-Newton steps (Levenberg, Marquardt) from the fit's values.

    Args:
        refit: the fit that the data sets resemble; its orbits are followed.
        data: from `draw_data`.

    Returns:
        The fits. A parameter at an end of its range is held there while chi2 falls towards the outside.
    """
    objective, sets = refit.objective, len(data.amplitude_nm)
    shift = shifts(objective, data)
    start = np.broadcast_to(refit.values, (1, refit.values.size))
    one = plain(objective).at_values(start)
    residual = np.asarray(one.residual) + shift
    jacobian = np.repeat(np.asarray(one.jacobian), sets, axis=0)
    start = _searches(objective, np.repeat(start, sets, axis=0), residual, jacobian)

    def look(values: Float[np.ndarray, "some p"], some: Int[np.ndarray, " some"]) -> Searches:
        found = plain(objective).at_values(values)
        return _searches(objective, values, np.asarray(found.residual) + shift[some], np.asarray(found.jacobian))

    lowest, highest = objective.problem.ends
    box = Box(lowest, highest, np.zeros((sets, refit.values.size), dtype=bool))
    end = descended(look, start, box, settled=_SETTLED, most=_STEPS)
    normal = np.einsum("snp,snq->spq", end.jacobian, end.jacobian)
    return BatchFit(end.place, end.chi2, whole_covariance_of(normal), distance(end, box) <= _SETTLED)


def shifts(objective: Objective, data: DataSets) -> Float[np.ndarray, "sets n"]:
    """Return what each data set adds to the residuals of the table itself."""
    rows, known = objective.measurement.rows, objective.measurement
    weight = np.where(np.asarray(rows.measured), 1.0 / np.asarray(rows.error_nm), 0.0)
    amplitudes = weight * (np.asarray(rows.amplitude_nm) - data.amplitude_nm)
    constraints = (np.asarray(known.constraint_value) - data.constraint_value) / np.asarray(known.constraint_error)
    sets, count = amplitudes.shape[:2]
    return np.concatenate([amplitudes.reshape(sets, -1), np.zeros((sets, count)), constraints], axis=1)


def plain(objective: Objective) -> Objective:
    """Return the objective without its soft loss, which is applied after the shift."""
    return Objective(objective.measurement, objective.problem, near=objective.near)


def _searches(objective: Objective, values, residual, jacobian) -> Searches:
    """Return the searches with the loss applied: residuals whose squares add up to it."""
    if objective.robust:
        residual, slope = softened(residual)
        jacobian = jacobian * slope[:, :, None]
    return Searches(values, residual, jacobian, np.sum(residual**2, axis=1))


FEWEST = 40
"""With fewer samples the 2.5 % quantile is the smallest value or next to it."""


@public_result(picture="fitting.report.pair_plots:bootstrap_figure")
@dataclass(frozen=True, eq=False)
class Bootstrap(Result):
    """Parameters fitted to synthetic data sets of the law that a fit has found; what `bootstrap` returns.

    Attributes:
        names: of the parameters.
        fitted: the fit's own values, which are the truth of the synthetic data, shape (p,).
        samples: values of the data sets whose fit converged, shape (samples, p).
        failures: data sets whose fit did not converge; they are left out.
        seed: of the synthetic data.
    """

    names: tuple[str, ...]
    fitted: Float[np.ndarray, " p"]
    samples: Float[np.ndarray, "samples p"]
    failures: int
    seed: int

    @property
    def standard_error(self) -> dict[str, float]:
        """Standard deviation of the values."""
        return dict(zip(self.names, self.samples.std(axis=0, ddof=1).tolist(), strict=True))

    @property
    def bias(self) -> dict[str, float]:
        """Mean of the values minus the truth of the data."""
        return dict(zip(self.names, (self.samples.mean(axis=0) - self.fitted).tolist(), strict=True))

    @property
    def interval95(self) -> dict[str, tuple[float, float]]:
        """Percentile intervals: from the 2.5 % to the 97.5 % quantile of the values."""
        low, high = np.quantile(self.samples, [0.025, 0.975], axis=0)
        return {name: (float(a), float(b)) for name, a, b in zip(self.names, low, high, strict=True)}

    @property
    def basic_interval95(self) -> dict[str, tuple[float, float]]:
        """Basic intervals: the percentile ones mirrored at the fitted value, which corrects a bias."""
        return {
            name: (2.0 * float(value) - high, 2.0 * float(value) - low)
            for (name, (low, high)), value in zip(self.interval95.items(), self.fitted, strict=True)
        }

    @property
    def correlations(self) -> Float[np.ndarray, "p p"]:
        """Correlation matrix of the values in the order of the names; NaN for a parameter that never moves."""
        centred = self.samples - self.samples.mean(axis=0)
        covariance = centred.T @ centred
        size = np.sqrt(np.diag(covariance))
        safe = np.where(size > 0.0, size, np.nan)
        return covariance / np.outer(safe, safe)

    def to_dict(self) -> dict[str, Any]:
        """Return everything but the single samples as plain lists, numbers and strings."""
        return {
            "samples": len(self.samples),
            "failures": self.failures,
            "seed": self.seed,
            "parameters": {
                name: {
                    "standard_error": self.standard_error[name],
                    "bias": self.bias[name],
                    "interval95": list(self.interval95[name]),
                    "basic_interval95": list(self.basic_interval95[name]),
                }
                for name in self.names
            },
            "correlations": in_json(self.correlations),
        }


@checked
def bootstrap(result: FitResult, samples: int = 400, *, seed: int = 0) -> Bootstrap:
    """Fit synthetic data sets that the fitted law would give, with the errors of the rows.

    Args:
        result: from `fitting.fit`; it must be valid.
        samples: how many data sets.
        seed: of their noise.

    Returns:
        The values, and intervals that do not rest on a linear model.

    Raises:
        ValueError: if the fit is not valid, or `samples` is too small.
    """
    if samples < FEWEST:
        raise ValueError(f"`samples` must be at least {FEWEST} for a 95 % interval, but is {samples}")
    require_valid(result)
    refit = compact(objective_of(result))
    fits = fit_data_sets(refit, draw_data(refit, samples, np.random.default_rng(seed)))
    kept = fits.values[fits.converged]
    if len(kept) < FEWEST:
        raise ValueError(
            f"only {len(kept)} of {samples} synthetic data sets could be fitted: the data hardly determine the "
            "parameters; fit a model with fewer of them, or constrain some"
        )
    return Bootstrap(refit.objective.problem.names, refit.values, kept, samples - len(kept), seed)


def require_valid(result: FitResult) -> None:
    """Refuse a fit that is not valid: synthetic data of a wrong law say nothing of the errors.

    Raises:
        ValueError: if so, with the fit's reason.
    """
    if not result.valid:
        raise ValueError(f"the fit of the model {result.model!r} is not valid ({result.reasons[0]}); mend it first")
