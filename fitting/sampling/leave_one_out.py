"""How well a posterior predicts each row without having seen it: leave-one-out by Pareto-smoothed importance sampling.

A. Vehtari, D. Simpson, A. Gelman, Y. Yao, J. Gabry, Pareto smoothed importance sampling, J. Mach. Learn. Res. 25 (72)
(2024); the tail is fitted as in J. Zhang, M. A. Stephens, Technometrics 51, 316 (2009).
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

_LEAST_TAIL = 5
_PRIOR_DRAWS, _PRIOR_SHAPE = 10, 0.5
"""A weak prior on the tail's shape: as many draws' worth of it."""


@dataclass(frozen=True)
class LeaveOneOut:
    """What rows are predicted by the others.

    Attributes:
        elpd: sum of the rows' logarithms of predictive density.
        elpd_error: its standard error, from the scatter among the rows.
        p_loo: by how much that is below the density of rows that were seen: the effective number of parameters.
        elpd_by_row: the logarithms.
        pareto_k: shape of the weights' tail by row: beyond the highest allowed the row's number is not reliable.
        highest_k: what is allowed of so many draws.
    """

    elpd: float
    elpd_error: float
    p_loo: float
    elpd_by_row: Float[np.ndarray, " rows"]
    pareto_k: Float[np.ndarray, " rows"]
    highest_k: float


def leave_one_out(log_likelihood: Float[np.ndarray, "draws rows"], efficiency: float = 1.0) -> LeaveOneOut:
    """Return how well each row is predicted by the others.

    Args:
        log_likelihood: of each row at draws of the posterior of all of them.
        efficiency: independent draws per draw.
    """
    draws, count = log_likelihood.shape
    smoothed = [pareto_smoothed(-column, efficiency) for column in log_likelihood.T]
    weight = np.stack([each for each, _ in smoothed], axis=1)
    elpd = np.asarray(np.logaddexp.reduce(weight + log_likelihood, axis=0))
    seen = np.asarray(np.logaddexp.reduce(log_likelihood, axis=0)) - np.log(draws)
    return LeaveOneOut(
        elpd=float(elpd.sum()),
        elpd_error=float(np.sqrt(count * elpd.var())),
        p_loo=float((seen - elpd).sum()),
        elpd_by_row=elpd,
        pareto_k=np.array([k for _, k in smoothed]),
        highest_k=float(min(1.0 - 1.0 / np.log10(draws), 0.7)),
    )


def pareto_smoothed(
    log_weight: Float[np.ndarray, " draws"], efficiency: float = 1.0
) -> tuple[Float[np.ndarray, " draws"], float]:
    """Return logarithms of importance weights, normalised, their largest smoothed; and the shape k of their tail.

    Args:
        log_weight: logarithms of raw weights; -inf: none.
        efficiency: independent draws per draw.
    """
    draws = log_weight.size
    log_weight = log_weight - log_weight.max()
    if not log_weight.any():
        # equal weights have no tail
        return log_weight - np.log(draws), -np.inf
    order = np.argsort(log_weight)
    tail = order[draws - int(np.ceil(min(0.2 * draws, 3.0 * np.sqrt(draws / efficiency)))) :]
    # where everything before the tail is of no weight, the smallest number stands for it
    cut = max(log_weight[order[draws - tail.size - 1]], np.log(np.finfo(float).tiny))
    tail = tail[log_weight[tail] > cut]
    shape = np.inf
    if tail.size >= _LEAST_TAIL:
        excess = np.exp(log_weight[tail]) - np.exp(cut)
        shape, size = _fitted_tail(excess)
        if np.isfinite(shape):
            log_weight[tail] = np.minimum(np.log(_quantiles(tail.size, shape, size) + np.exp(cut)), 0.0)
    return log_weight - np.logaddexp.reduce(log_weight), float(shape)


def _fitted_tail(excess: Float[np.ndarray, " n"]) -> tuple[float, float]:
    """Return shape and size of the generalised Pareto distribution of a tail in ascending order."""
    count = excess.size
    trials = 30 + int(np.sqrt(count))
    b = (1.0 - np.sqrt(trials / (np.arange(1, trials + 1) - 0.5))) / (3.0 * excess[int(count / 4 + 0.5) - 1])
    b += 1.0 / excess[-1]
    shape = np.mean(np.log1p(-b[:, None] * excess), axis=1)
    likelihood = count * (np.log(-b / shape) - shape - 1.0)
    weight = np.exp(likelihood - np.logaddexp.reduce(likelihood))
    middle = float(np.sum(b * weight) / np.sum(weight))
    found = float(np.mean(np.log1p(-middle * excess)))
    shrunk = (count * found + _PRIOR_DRAWS * _PRIOR_SHAPE) / (count + _PRIOR_DRAWS)
    return shrunk, -found / middle


def _quantiles(count: int, shape: float, size: float) -> Float[np.ndarray, " n"]:
    """Return evenly spaced quantiles of a generalised Pareto distribution."""
    share = (np.arange(count) + 0.5) / count
    if abs(shape) < 1e-12:
        return -size * np.log1p(-share)
    return size * np.expm1(-shape * np.log1p(-share)) / shape
