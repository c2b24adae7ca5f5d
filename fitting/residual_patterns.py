"""Patterns in the residuals of a sweep that chance does not bring about."""

import numpy as np
from jaxtyping import Float

from fitting.resonance.sweep_fit import SweepFit

_LONGEST = 12
"""Longest repetition looked for, in points."""
_NO_MISFIT = 1e-6
"""Chi2 per point below which the residuals are rounding errors, not data."""


def autocorrelation(fit: SweepFit, lag: int) -> float:
    """Return the correlation of residuals that lie `lag` points apart, of both components together."""
    blocks = fit.residual.reshape(2 if fit.objective.kind == "phase" else 1, -1)[:, : fit.points]
    total = float(np.sum(blocks**2))
    if total < _NO_MISFIT * fit.data or fit.points <= lag:
        return 0.0
    return float(np.sum(blocks[:, lag:] * blocks[:, :-lag]) / total)


def repeat_of(fit: SweepFit) -> tuple[int, float] | None:
    """Return after how many points (at least 2) the residuals repeat, and their correlation; None if they do not."""
    lags = range(2, min(_LONGEST, fit.points // 4) + 1)
    found = {lag: autocorrelation(fit, lag) for lag in lags}
    if not found:
        return None
    lag = max(found, key=lambda one: found[one])
    # Of a slow wave neighbours are correlated most: that is no repetition.
    if found[lag] < max(0.3, 5.0 / np.sqrt(fit.data)) or autocorrelation(fit, 1) > 0.8 * found[lag]:
        return None
    return lag, found[lag]


def runs_excess(fit: SweepFit, residual: Float[np.ndarray, " n"]) -> float:
    """Return the number of runs of equal sign less its expectation, in standard deviations (Wald and Wolfowitz)."""
    if fit.chi2 < _NO_MISFIT * fit.data:
        return 0.0
    signs = residual[residual != 0.0] > 0.0
    total, positive = len(signs), int(signs.sum())
    pairs = 2.0 * positive * (total - positive)
    if total < 8 or pairs <= total:
        return 0.0
    runs = 1 + int(np.sum(signs[1:] != signs[:-1]))
    expected = pairs / total + 1.0
    variance = pairs * (pairs - total) / (total**2 * (total - 1.0))
    return float((runs - expected) / np.sqrt(variance))
