"""Whether to trust a calibration, in words: what makes it invalid, and what a reader should know besides.

Patterns in the residuals of the sweep that chance does not bring about belong to it.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from afm_jax.least_squares import IMPROBABLE
from afm_jax.outcomes import Rule, Rules, judge
from afm_jax.words import counted
from fitting.calibration.model import SweepFit
from fitting.calibration.result import Alternative, CalibratedValue
from fitting.calibration.sweep import ResonanceSweep

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

    @property
    def per_freedom(self) -> float:
        """Chi2 over the degrees of freedom."""
        return self.fit.chi2 / self.fit.freedom

    @property
    def half_width_khz(self) -> float:
        """Half-width of the resonance, f0/2Q."""
        return self.frequency.value / self.quality_factor.value / 2.0

    @property
    def below(self) -> float:
        """How many half-widths the scan reaches below the resonance."""
        return float((self.frequency.value - self.sweep.frequency_khz[0]) / self.half_width_khz)

    @property
    def above(self) -> float:
        """How many half-widths the scan reaches above the resonance."""
        return float((self.sweep.frequency_khz[-1] - self.frequency.value) / self.half_width_khz)

    @property
    def reach(self) -> float:
        """Half-widths to the nearer end of the scan; negative where the resonance lies outside."""
        return min(self.below, self.above)

    @property
    def side(self) -> str:
        """Which end of the scan is the nearer one."""
        return "lower" if self.below < self.above else "upper"

    @property
    def inside(self) -> int:
        """Points within the half-width."""
        return int(np.sum(np.abs(self.sweep.frequency_khz - self.frequency.value) < self.half_width_khz))

    @property
    def wider(self) -> list[float]:
        """By how much the residuals' correlation widens the errors of frequency and quality factor."""
        return inflation_of(self.fit).tolist()

    @property
    def better(self) -> list[tuple[Alternative, float]]:
        """The background that describes the scan clearly better, if there is one, and by how much its AIC is lower."""
        best = _better(self.fit, self.alternatives)
        return [] if best is None else [(best, self.fit.aic - best.aic)]


def judge_calibration(evidence: SweepEvidence) -> tuple[list[str], list[str]]:
    """Return what makes a calibration invalid, and its warnings; each a sentence."""
    # what is not identified is said where nothing else explains it
    return judge(REASONS, evidence) or judge([_UNIDENTIFIED], evidence)[:1], judge(WARNINGS, evidence)


def preferred(fit: SweepFit, background: str, alternatives: list[Alternative]) -> str:
    """Return the background that describes a sweep clearly better than the one it was fitted with, or that one."""
    best = _better(fit, alternatives)
    return background if best is None else best.background


def _better(fit: SweepFit, alternatives: list[Alternative]) -> Alternative | None:
    best = min(alternatives, key=lambda other: other.aic, default=None)
    return best if best is not None and best.aic < fit.aic - _CLEARLY else None


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


_LONGEST = 12
"""Longest repetition looked for, in points."""
_NO_MISFIT = 1e-6
"""Chi2 per point below which the residuals are rounding errors, not data."""


def autocorrelation(fit: SweepFit, lag: int) -> float:
    """Return the correlation of residuals that lie `lag` points apart, of both components together.

    It is a size, of a scan's evenly spaced points. `fitting.fits.verdict.correlation_excess` is a test of neighbouring
    rows of a table, whose readings may go together.
    """
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


def _unidentified(evidence: SweepEvidence) -> list[str]:
    found = {"frequency_khz": evidence.frequency, "quality_factor": evidence.quality_factor}
    return [
        f"{name} is not identified: {v.interval_reason}" for name, v in found.items() if v.interval95 == (None, None)
    ]


_UNIDENTIFIED = Rule(_unidentified, "{case}.")

REASONS: Rules[SweepEvidence] = [
    Rule(
        lambda e: e.chi2_without - e.fit.chi2 < _PEAK * max(e.per_freedom, 1e-300),
        "No resonance stands out of the sweep: a parabola explains it about as well.",
    ),
    (
        Rule(lambda e: e.fit.convergence.reason is not None, "Not converged: {e.fit.convergence.reason}."),
        Rule(
            lambda e: not np.all(np.isfinite(e.fit.covariance)),
            "Not identified: the sweep does not determine frequency, quality factor and background together.",
        ),
        Rule(
            lambda e: not e.fit.convergence.converged,
            "Not converged: chi2 lies an estimated {e.fit.convergence.estimated_distance:.2g} above its minimum.",
        ),
    ),
    (
        Rule(
            lambda e: e.reach < 0.0,
            "The resonance ({e.frequency.value:.6g} kHz) lies outside the sweep: sweep around it.",
        ),
        Rule(
            lambda e: e.reach < 1.0,
            "The resonance ({e.frequency.value:.6g} kHz) lies at the {e.side} edge of the sweep, {e.reach:.2g} "
            "half-widths from it: sweep at least one half-width (f0/2Q) to both sides.",
        ),
        Rule(
            lambda e: e.inside < 3,
            lambda e, _: (
                f"Only {counted(e.inside, 'point')} within the half-width of the resonance: sweep in finer steps."
            ),
        ),
    ),
    Rule(
        lambda e: e.p_value < IMPROBABLE,
        "The model does not explain the sweep: chi2/dof = {e.per_freedom:.3g} (probability {e.p_value:.1g}). The "
        "background may be another one, the frequency may have drifted, the resonance may be nonlinear, or the errors "
        "are too small.",
    ),
    Rule(
        lambda e: e.autocorrelation > _SYSTEMATIC,
        "Neighbouring residuals are strongly correlated ({e.autocorrelation:+.2f}): the model misses something "
        "(another background, drift, a second resonance, too fast a sweep), and the errors mean nothing.",
    ),
]
"""What makes a calibration invalid."""

WARNINGS: Rules[SweepEvidence] = [
    Rule(
        lambda e: e.frequency.value > _FAST_KHZ,
        "A resonance of {e.frequency.value:.6g} kHz is beyond any cantilever's: if the frequencies are in Hz, name "
        "their column frequency_hz.",
    ),
    Rule(
        lambda e: e.sweep.reordered,
        "The frequencies did not rise from point to point: the points were sorted.",
    ),
    Rule(lambda e: e.fit.reverse, "The phase rises through the resonance: it was taken with the opposite sign."),
    Rule(
        lambda e: 1.0 <= e.reach < 2.0,
        "The sweep reaches {e.below:.1f} half-widths below and {e.above:.1f} above the resonance: frequency, quality "
        "factor and background are hard to tell apart.",
    ),
    (
        Rule(
            lambda e: e.fit.errors.scale is not None,
            "The points' errors were scaled by {e.fit.errors.scale:.3g} so that chi2/dof = 1: the goodness of fit "
            "cannot be judged.",
        ),
        Rule(
            lambda e: e.fit.errors.origin == "estimated",
            "The points' errors were estimated from the misfit so that chi2/dof = 1: the goodness of fit cannot be "
            "judged.",
        ),
        Rule(lambda e: e.p_value > 1.0 - 1e-6, "The errors look too large: chi2 is improbably small."),
    ),
    Rule(
        lambda e: 3.0 / np.sqrt(e.fit.data) < e.autocorrelation <= _SYSTEMATIC,
        "Neighbouring residuals are correlated ({e.autocorrelation:+.2f}): something systematic is left, or a filter "
        "joins neighbouring points.",
    ),
    Rule(
        lambda e: max(e.wider) > _WIDER,
        "The residuals' correlation widens the errors of frequency_khz {e.wider[0]:.2g} and of quality_factor "
        "{e.wider[1]:.2g} times; that is in what is stated.",
    ),
    (
        Rule(
            lambda e: e.repeat is not None,
            "The residuals repeat every {e.repeat[0]} points (correlation {e.repeat[1]:+.2f}): something periodic, "
            "such as a drive whose frequency is rounded to steps of its own, not noise.",
        ),
        Rule(
            lambda e: abs(e.runs_excess) > 4.0,
            lambda e, _: (
                f"The amplitude's residuals change their sign {'fewer' if e.runs_excess < 0 else 'more'} often than "
                f"chance allows ({abs(e.runs_excess):.1f} standard deviations)."
            ),
        ),
    ),
    Rule(
        lambda e: e.better,
        "The background '{case[0].background}' describes the sweep better (AIC lower by {case[1]:.0f}) and gives "
        "{case[0].frequency_khz:.7g} kHz and Q = {case[0].quality_factor:.5g}: choose it with "
        '`background="{case[0].background}"`.',
    ),
]
"""What a reader should know besides."""
