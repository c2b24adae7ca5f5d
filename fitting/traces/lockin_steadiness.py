"""Whether a trace repeats: what its response periods do beyond the noise, and whether they drift."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from fitting.traces.lockin_fold import Fold
from fitting.traces.lockin_peak import Peak

_SURE = 5.0
"""Standard errors from which a drift is one."""

_RUNNING = 0.03
"""Change of the phase over the trace, in rad, that may come from a wrong drive frequency."""


class Steadiness(NamedTuple):
    """What the response periods do, in shares of the deflection's standard deviation or of the amplitude.

    Attributes:
        excess: rms by which the periods' slow Fourier lines differ beyond white noise.
        lockin_drift: change of the lock-in value over the trace, of the lock-in amplitude; 0 where not significant.
        peak_drift: change of the peak height over the trace, of the peak height; 0 where not significant.
        trend_share: how much of the lock-in's scatter a slow change explains.
        phase_step_deg: advance of the phase from one response period to the next, where the phase runs away steadily.
    """

    excess: float
    lockin_drift: float
    peak_drift: float
    trend_share: float
    phase_step_deg: float | None


def look_at_periods(folded: Fold, peak: Peak) -> Steadiness:
    """Compare the response periods with each other.

    Args:
        folded: of the best order.
        peak: its top.
    """
    deviations = folded.lockin_deviations
    amplitude = max(abs(folded.lockin), 1e-300)
    index = np.arange(folded.cycles, dtype=np.float64)
    drift, share = _trend(deviations / amplitude, index)
    peaks = np.bincount(folded.cycle, peak.weights * folded.left, folded.cycles) * folded.cycles
    top_drift, _ = _trend(peaks / max(abs(peak.height_nm), 1e-300) + 0j, index)
    return Steadiness(_excess(folded), drift, top_drift, share, _running_phase(folded))


def white_noise_nm(folded: Fold) -> float:
    """Return the noise of one sample from third differences, which a smooth motion hardly has; an upper bound."""
    differences = np.diff(folded.height, 3)
    # the median is blind to the few differences that an impact falls into
    return float(min(np.median(np.abs(differences)) / 0.6745 / np.sqrt(20.0), folded.noise_nm))


def _excess(folded: Fold) -> float:
    """Return the rms of what the periods' lines 1 to N + 1 do beyond white noise, of the standard deviation."""
    count = np.bincount(folded.cycle, minlength=folded.cycles)
    total, expected = 0.0, 0.0
    noise = white_noise_nm(folded)
    for k in range(1, folded.order + 2):
        lines = folded.per_cycle(folded.left * np.exp(-1j * k * folded.angle)) * 2.0 / count
        # what all periods share is the waveform's, not scatter
        total += 0.5 * float(np.mean(np.abs(lines - lines.mean()) ** 2))
        expected += 2.0 * noise**2 * float(np.mean(1.0 / count))
    # the scatter of J periods' lines is itself uncertain by 1/sqrt(J (N + 1))
    sure = 1.0 + 4.0 / np.sqrt(folded.cycles * (folded.order + 1))
    beyond = total - expected
    return float(np.sqrt(beyond) / max(folded.spread_nm, 1e-300)) if total > expected * sure else 0.0


def _trend(values: np.ndarray, index: Float[np.ndarray, " cycles"]) -> tuple[float, float]:
    """Return the change over the trace that a straight line gives, 0 unless significant, and a parabola's share."""
    if len(index) < 4:
        return 0.0, 0.0
    centred = index - index.mean()
    line = np.sum(values * centred) / np.sum(centred**2)
    left = values - values.mean() - line * centred
    error = np.sqrt(np.sum(np.abs(left) ** 2) / (len(index) - 2) / np.sum(centred**2))
    change = abs(line) * len(index)
    design = np.vander(centred / centred[-1], 3)
    bent = values - design @ np.linalg.pinv(design) @ values
    total = float(np.sum(np.abs(values - values.mean()) ** 2))
    share = 1.0 - float(np.sum(np.abs(bent) ** 2)) / total if total > 0.0 else 0.0
    return (float(change) if abs(line) > _SURE * error else 0.0), share


def _running_phase(folded: Fold) -> float | None:
    """Return the advance of the phase per response period where amplitude stays and phase runs: a wrong frequency."""
    count = np.bincount(folded.cycle, minlength=folded.cycles)
    mean = folded.per_cycle(folded.height + 0j) / count
    lines = folded.per_cycle((folded.height - mean.real[folded.cycle]) * np.exp(-1j * folded.angle)) * 2.0 / count
    size = np.abs(lines)
    phase = np.unwrap(np.angle(lines))
    if folded.cycles < 6 or np.std(size) > min(0.15, 0.3 * float(np.std(phase))) * np.mean(size):
        return None
    slope, start = np.polyfit(np.arange(folded.cycles), phase, 1)
    left = phase - start - slope * np.arange(folded.cycles)
    runs = abs(slope) * folded.cycles > _RUNNING and float(np.std(left)) < 0.3 * abs(slope) * folded.cycles / np.sqrt(
        12.0
    )
    return float(np.degrees(slope)) if runs else None
