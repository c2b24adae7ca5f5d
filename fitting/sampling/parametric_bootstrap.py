"""The parametric bootstrap: how fitted values scatter when the fitted law is the truth of repeated experiments."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from fitting.result import FitResult
from fitting.sampling.batch_fit import draw_data, fit_data_sets
from fitting.sampling.refit import compact, objective_of

FEWEST = 40
"""With fewer samples the 2.5 % quantile is the smallest value or next to it."""


@dataclass(frozen=True, eq=False)
class Bootstrap:
    """Fitted values of synthetic data sets.

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
        plain = np.where(np.isfinite(self.correlations), self.correlations, np.inf).tolist()
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
            "correlations": [[None if entry == np.inf else entry for entry in row] for row in plain],
        }


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
    return Bootstrap(tuple(result.parameters), refit.values, kept, samples - len(kept), seed)


def require_valid(result: FitResult) -> None:
    """Refuse a fit that is not valid: synthetic data of a wrong law say nothing of the errors.

    Raises:
        ValueError: if so, with the fit's reason.
    """
    if not result.valid:
        raise ValueError(f"the fit of the model {result.model!r} is not valid ({result.reasons[0]}); mend it first")
