"""Whether to trust a calibration, in words: what makes it invalid, and what a reader should know besides.

Patterns in the residuals of the sweep that chance does not bring about belong to it.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from afm_jax.words import counted
from fitting.calibration.model import SweepFit
from fitting.calibration.result import Alternative, CalibratedValue
from fitting.calibration.sweep import ResonanceSweep

IMPROBABLE = 1e-3
"""Probability of the chi2 below which the model does not explain the sweep."""
_PEAK = 30.0
"""Fall of chi2 per unit of chi2/dof that four more parameters practically never bring about by chance."""
_CLEARLY = 10.0
"""Difference of Akaike's criterion from which on a background is better."""
_WIDER = 1.1
_SYSTEMATIC = 0.5
"""Correlation of neighbouring residuals beyond which the standard errors mean nothing."""


_FAST_KHZ = 2e4
"""The fastest cantilevers resonate at a few MHz."""


@dataclass(frozen=True)
class SweepEvidence:
    """All that the verdict looks at."""

    sweep: ResonanceSweep
    fit: SweepFit
    frequency: CalibratedValue
    quality_factor: CalibratedValue
    p_value: float
    autocorrelation: float
    repeat: tuple[int, float] | None
    runs_excess: float
    chi2_without: float
    alternatives: list[Alternative]


def judge_calibration(evidence: SweepEvidence) -> tuple[list[str], list[str]]:
    """Return what makes a calibration invalid, and its warnings; each a sentence."""
    return _reasons(evidence), _warnings(evidence)


def half_widths(evidence: SweepEvidence) -> tuple[float, float]:
    """Return how many half-widths f0/2Q the sweep reaches below and above the resonance."""
    frequency, half = evidence.frequency.value, evidence.frequency.value / evidence.quality_factor.value / 2.0
    measured = evidence.sweep.frequency_khz
    return float((frequency - measured[0]) / half), float((measured[-1] - frequency) / half)


def _reasons(evidence: SweepEvidence) -> list[str]:
    fit, reasons = evidence.fit, []
    per_freedom = fit.chi2 / fit.freedom
    if evidence.chi2_without - fit.chi2 < _PEAK * max(per_freedom, 1e-300):
        reasons.append("No resonance stands out of the sweep: a parabola explains it about as well.")
    if fit.convergence.reason is not None:
        reasons.append(f"Not converged: {fit.convergence.reason}.")
    elif not np.all(np.isfinite(fit.covariance)):
        reasons.append(
            "Not identified: the sweep does not determine frequency, quality factor and background together."
        )
    elif not fit.convergence.converged:
        distance = fit.convergence.estimated_distance
        reasons.append(f"Not converged: chi2 lies an estimated {distance:.2g} above its minimum.")
    reasons += _range_reasons(evidence)
    if evidence.p_value < IMPROBABLE:
        reasons.append(
            f"The model does not explain the sweep: chi2/dof = {per_freedom:.3g} (probability {evidence.p_value:.1g}). "
            "The background may be another one, the frequency may have drifted, the resonance may be nonlinear, or the "
            "errors are too small."
        )
    if evidence.autocorrelation > _SYSTEMATIC:
        reasons.append(
            f"Neighbouring residuals are strongly correlated ({evidence.autocorrelation:+.2f}): the model misses "
            "something (another background, drift, a second resonance, too fast a sweep), and the errors mean nothing."
        )
    for name, value in (("frequency_khz", evidence.frequency), ("quality_factor", evidence.quality_factor)):
        if value.interval95 == (None, None) and not reasons:
            reasons.append(f"{name} is not identified: {value.interval_reason}.")
    return reasons


def _range_reasons(evidence: SweepEvidence) -> list[str]:
    """Say where the sweep does not hold the resonance: outside, at the edge, or between two points."""
    below, above = half_widths(evidence)
    frequency = evidence.frequency.value
    if below < 0.0 or above < 0.0:
        return [f"The resonance ({frequency:.6g} kHz) lies outside the sweep: sweep around it."]
    if min(below, above) < 1.0:
        side = "lower" if below < above else "upper"
        message = (
            f"The resonance ({frequency:.6g} kHz) lies at the {side} edge of the sweep, {min(below, above):.2g} "
            "half-widths from it: sweep at least one half-width (f0/2Q) to both sides."
        )
        return [message]
    half = frequency / evidence.quality_factor.value / 2.0
    inside = int(np.sum(np.abs(evidence.sweep.frequency_khz - frequency) < half))
    if inside < 3:
        return [f"Only {counted(inside, 'point')} within the half-width of the resonance: sweep in finer steps."]
    return []


def _warnings(evidence: SweepEvidence) -> list[str]:
    sweep, fit, warnings = evidence.sweep, evidence.fit, []
    if evidence.frequency.value > _FAST_KHZ:
        warnings.append(
            f"A resonance of {evidence.frequency.value:.6g} kHz is beyond any cantilever's: if the frequencies "
            "are in Hz, name their column frequency_hz."
        )
    if sweep.reordered:
        warnings.append("The frequencies did not rise from point to point: the points were sorted.")
    if fit.reverse:
        warnings.append("The phase rises through the resonance: it was taken with the opposite sign.")
    below, above = half_widths(evidence)
    if 1.0 <= min(below, above) < 2.0:
        warnings.append(
            f"The sweep reaches {below:.1f} half-widths below and {above:.1f} above the resonance: frequency, quality "
            "factor and background are hard to tell apart."
        )
    if fit.errors.origin == "estimated" or fit.errors.scale is not None:
        how = "estimated from the misfit" if fit.errors.scale is None else f"scaled by {fit.errors.scale:.3g}"
        warnings.append(f"The points' errors were {how} so that chi2/dof = 1: the goodness of fit cannot be judged.")
    elif evidence.p_value > 1.0 - 1e-6:
        warnings.append("The errors look too large: chi2 is improbably small.")
    return warnings + _residual_warnings(evidence) + _background_warnings(evidence)


def _residual_warnings(evidence: SweepEvidence) -> list[str]:
    correlation, warnings = evidence.autocorrelation, []
    if 3.0 / np.sqrt(evidence.fit.data) < correlation <= _SYSTEMATIC:
        warnings.append(
            f"Neighbouring residuals are correlated ({correlation:+.2f}): something systematic is left, or a filter "
            "joins neighbouring points."
        )
    wider = inflation_of(evidence.fit).tolist()
    if max(wider) > _WIDER:
        warnings.append(
            f"The residuals' correlation widens the errors of frequency_khz {wider[0]:.2g} and of quality_factor "
            f"{wider[1]:.2g} times; that is in what is stated."
        )
    if evidence.repeat is not None:
        lag, strength = evidence.repeat
        warnings.append(
            f"The residuals repeat every {lag} points (correlation {strength:+.2f}): something periodic, such as a "
            "drive whose frequency is rounded to steps of its own, not noise."
        )
    elif abs(evidence.runs_excess) > 4.0:
        what = "fewer" if evidence.runs_excess < 0 else "more"
        warnings.append(
            f"The amplitude's residuals change their sign {what} often than chance allows "
            f"({abs(evidence.runs_excess):.1f} standard deviations)."
        )
    return warnings


def preferred(fit: SweepFit, background: str, alternatives: list[Alternative]) -> str:
    """Return the background that describes a sweep clearly better than the one it was fitted with, or that one."""
    best = _better(fit, alternatives)
    return background if best is None else best.background


def _better(fit: SweepFit, alternatives: list[Alternative]) -> Alternative | None:
    best = min(alternatives, key=lambda other: other.aic, default=None)
    return best if best is not None and best.aic < fit.chi2 + 2.0 * len(fit.values) - _CLEARLY else None


def inflation_of(fit: SweepFit) -> Float[np.ndarray, "2"]:
    """Return by how much the residuals' correlation widens the errors of frequency and quality factor, 1 at least.

    The covariance of the scores J^T r over the sweep, neighbours included with Bartlett's weights up to the root of the
    number of points (Newey and West), takes the place of the one of independent residuals.

    Args:
        fit: at its minimum.
    """
    residual, jacobian = fit.objective.linearise(fit.coordinates[None])
    blocks, used = 2 if fit.objective.kind == "phase" else 1, fit.points
    each = np.einsum("n,np->np", residual[0], jacobian[0]).reshape(blocks, -1, jacobian.shape[2])
    score = each[:, :used].sum(axis=0)
    plain = each[:, :used].reshape(-1, each.shape[2])
    independent = plain.T @ plain
    long_run = score.T @ score
    reach = int(np.sqrt(used))
    for lag in range(1, reach + 1):
        together = score[lag:].T @ score[:-lag]
        long_run = long_run + (1.0 - lag / (reach + 1.0)) * (together + together.T)
    information = jacobian[0].T @ jacobian[0]
    scale = 1.0 / np.sqrt(np.maximum(np.diag(information), 1e-300))
    inverse = scale[:, None] * np.linalg.pinv(scale[:, None] * information * scale) * scale
    wide, narrow = (np.diag(inverse @ middle @ inverse)[:2] for middle in (long_run, independent))
    known = (narrow > 0.0) & (wide > narrow)
    return np.where(known, np.sqrt(np.where(known, wide, 1.0) / np.where(known, narrow, 1.0)), 1.0)


def _background_warnings(evidence: SweepEvidence) -> list[str]:
    """Name the background that describes the sweep better than the one chosen, and what it would make of Q."""
    own = evidence.fit.chi2 + 2.0 * len(evidence.fit.values)
    best = _better(evidence.fit, evidence.alternatives)
    if best is None:
        return []
    message = (
        f"The background '{best.background}' describes the sweep better (AIC lower by {own - best.aic:.0f}) and gives "
        f"{best.frequency_khz:.7g} kHz and Q = {best.quality_factor:.5g}: choose it with "
        f"--background {best.background}."
    )
    return [message]


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
