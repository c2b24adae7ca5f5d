"""What a folded trace shows of impacts and of its top: their number, the peak height, and whether it repeats.

An impact is where the velocity jumps between two free flights. The peak height is that of a polynomial through the
samples around the top, or of a parabola through few. A trace repeats if its response periods differ by the noise alone
and do not drift; one that does not may be a tip that rings down freely.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.optimize import least_squares

from fitting.traces.fold import Fold, shortened
from fitting.traces.trace import Trace

_WINDOWS = (0.03, 0.1)
"""Of the free period: length of the two stretches whose flights are compared; the short one where noise allows."""
_BINS = 10
"""Per stretch."""
_MOST_BINS = 6000
_LEAST_BINS = 3
_SURE = 6.0
"""Standard errors by which a jump must stand out of the noise."""
_LEAST_JUMP = 0.05
"""Of Omega times the peak height: a free frequency wrong by 5 %, or a filter, makes smaller ones."""
_HIDDEN = 0.2
"""Of Omega times the peak height: where the noise hides even such jumps the count is not to be trusted."""
_BESIDE = 2
"""Bins around an impact's two stretches that belong to it: a contact takes time."""


class ImpactCount(NamedTuple):
    """What was counted; `impacts` is None where the samples do not tell, and `reason` says why."""

    impacts: int | None
    reason: str | None


def count_impacts(
    folded: Fold, *, free_frequency_khz: float, quality_factor: float | None, peak_nm: float
) -> ImpactCount:
    """Count the impacts in a response period.

    A free flight satisfies z'' + (Omega/Q) z' + Omega^2 z = 0: it is fixed by height and velocity. To the left and the
    right of every instant such a flight is fitted to 3 % of a free period, in more noise to 10 %; an impact is where
    the velocity of the right one exceeds that of the left. Impacts closer than such a stretch count as one.

    Args:
        folded: of the right order.
        free_frequency_khz: Omega/2 pi.
        quality_factor: Q, or None: no damping.
        peak_nm: largest height above rest.
    """
    omega = 2e-3 * np.pi * free_frequency_khz
    why = f"{folded.resolution:.3g} distinct phases in a response period are too few to see where the velocity jumps"
    for share in _WINDOWS:
        window = share * 2.0 * np.pi / omega
        bins = int(min(np.ceil(folded.period_us / window * _BINS), folded.resolution, _MOST_BINS))
        across = int(window * bins / folded.period_us)
        if across < _LEAST_BINS or bins < 2 * across + 2:
            continue
        time, height, error = _binned(folded, bins)
        jump, spread = _jumps(time, height, error, across, (omega, quality_factor), folded.period_us)
        if _SURE * float(np.median(spread)) > (_LEAST_JUMP if share < _WINDOWS[-1] else _HIDDEN) * omega * peak_nm:
            why = "the noise hides jumps of the velocity; record more response periods"
            continue
        least = np.maximum(_SURE * spread, _LEAST_JUMP * omega * peak_nm)
        return ImpactCount(_tops(np.where(jump > least, jump, 0.0), across), None)
    return ImpactCount(None, why)


def _binned(folded: Fold, bins: int) -> tuple[Float[np.ndarray, " bins"], ...]:
    """Return mean time (in us, since phase 0), mean height and its error in equal bins of the response period."""
    turns = np.mod(folded.angle / (2.0 * np.pi), 1.0)
    index = np.minimum((turns * bins).astype(np.int64), bins - 1)
    count = np.bincount(index, minlength=bins)
    filled = np.maximum(count, 1)
    time = np.bincount(index, turns, bins) / filled * folded.period_us
    height = np.bincount(index, folded.height, bins) / filled
    empty = count == 0
    # a bin between two samples' phases: the waveform fills it
    centre = (np.arange(bins) + 0.5) / bins
    time = np.where(empty, centre * folded.period_us, time)
    height = np.where(empty, folded.waveform(2.0 * np.pi * centre), height)
    return time, height, folded.noise_nm / np.sqrt(filled)


def _jumps(
    time: Float[np.ndarray, " bins"],
    height: Float[np.ndarray, " bins"],
    error: Float[np.ndarray, " bins"],
    across: int,
    oscillator: tuple[float, float | None],
    period: float,
) -> tuple[Float[np.ndarray, " bins"], Float[np.ndarray, " bins"]]:
    """Return velocity right less left at the middle of each bin, leaving that bin out, and its standard error."""
    bins = len(time)
    middle = np.arange(bins)[:, None]
    sides = []
    for direction in (-1, 1):
        index = middle + direction * np.arange(1, across + 1)
        since = time[index % bins] + np.floor(index / bins) * period - time[:, None]
        sides.append(_velocity(since, height[index % bins], error[index % bins], oscillator))
    return sides[1][0] - sides[0][0], np.hypot(sides[1][1], sides[0][1])


def _velocity(
    since: Float[np.ndarray, "bins n"],
    height: Float[np.ndarray, "bins n"],
    error: Float[np.ndarray, "bins n"],
    oscillator: tuple[float, float | None],
) -> tuple[Float[np.ndarray, " bins"], Float[np.ndarray, " bins"]]:
    """Return the velocity at time 0 of the free flight through some heights, and its standard error, row by row.

    The flight is z = z0 c + v0 s with c and s known; least squares gives v0 from the 2 x 2 normal equations.
    """
    omega, quality = oscillator
    decay = 0.0 if quality is None else 0.5 * omega / quality
    damped = np.sqrt(omega**2 - decay**2)
    fade = np.exp(-decay * since)
    s = fade * np.sin(damped * since) / damped
    c = fade * np.cos(damped * since) + decay * s
    cc, cs, ss = (np.sum(one * other, axis=1) for one, other in ((c, c), (c, s), (s, s)))
    determinant = cc * ss - cs**2
    velocity = (cc * np.sum(s * height, axis=1) - cs * np.sum(c * height, axis=1)) / determinant
    return velocity, np.mean(error, axis=1) * np.sqrt(cc / determinant)


def _tops(jump: Float[np.ndarray, " bins"], across: int) -> int:
    """Return how many jumps, from the largest on, lie more than a stretch apart on the circle."""
    left, count = jump.copy(), 0
    while left.max() > 0.0:
        place = int(np.argmax(left))
        count += 1
        left[np.arange(place - across - _BESIDE, place + across + _BESIDE + 1) % len(left)] = 0.0
    return count


_GRID = 2048
_TOP = 0.6
"""Share of the peak above which a flight is fitted: a cosine's first 53 degrees."""
_MISSES = {4: 3e-5, 6: 3e-7}
"""What polynomials miss of the top of that cosine, by their degree."""
_REACH = 0.35
"""Of the response period: longest stretch to each side of the top."""
_ENOUGH = {4: 10, 6: 14}
"""Distinct phases for polynomials by their degree; with fewer a parabola through the nearest three."""


class Peak(NamedTuple):
    """The top of the waveform.

    Attributes:
        height_nm: above the rest position.
        error_nm: from the noise.
        sampling_error_nm: by how much the polynomial may miss the top of a cosine.
        at: response phase of the top, in turns.
        weights: of the samples, whose sum with the heights is the height, shape (samples,).
        frequency_khz: of the free flight, from the bending at the top: z'' = -Omega^2 z; None where it is not positive.
    """

    height_nm: float
    error_nm: float
    sampling_error_nm: float
    at: float
    weights: Float[np.ndarray, " samples"]
    frequency_khz: float | None


def find_peak(folded: Fold) -> Peak:
    """Return the largest height of the waveform above the rest position.

    All response periods' samples near the top are fitted together: the result is the mean of the periods' maxima,
    without the bias of the maximum of noisy samples.

    Args:
        folded: of the right order.
    """
    turns = np.arange(_GRID) / _GRID
    shape = folded.waveform(2.0 * np.pi * turns)
    top = int(np.argmax(shape))
    before, after = (_reach(np.roll(shape, -top), direction) for direction in (-1, 1))
    offset = np.mod(folded.angle / (2.0 * np.pi) - turns[top] + 0.5, 1.0) - 0.5
    inside = (offset >= -before) & (offset <= after)
    phases = _distinct(offset[inside], folded.resolution)
    peaks = [_vertex(folded, turns[top], offset, inside, degree) for degree in _MISSES if phases >= _ENOUGH[degree]]
    if peaks:
        # a higher degree misses less and follows the noise more
        return min(peaks, key=lambda peak: float(np.hypot(peak.error_nm, peak.sampling_error_nm)))
    # of phases 1/resolution apart three lie within 1.5 of these steps, wherever the top is
    return _vertex(folded, turns[top], offset, np.abs(offset) <= 1.500001 / folded.resolution, 2)


def _reach(shape: Float[np.ndarray, " grid"], direction: int) -> float:
    """Return how far the waveform stays above its share of the top, in turns; the top is the first element."""
    ordered = shape if direction > 0 else np.roll(shape[::-1], 1)
    low = np.flatnonzero(ordered < _TOP * ordered[0])
    return min(_REACH, (int(low[0]) if len(low) else _GRID) / _GRID)


def _distinct(offset: Float[np.ndarray, " n"], resolution: float) -> int:
    return len(np.unique(np.round(offset * max(resolution, 1.0) * 2.0)))


def _vertex(folded: Fold, top: float, offset: Float[np.ndarray, " samples"], inside: np.ndarray, degree: int) -> Peak:
    """Return the maximum of the polynomial fitted to the samples inside."""
    scale = float(np.max(np.abs(offset[inside])))
    x = offset[inside] / scale
    design = np.vander(x, degree + 1, increasing=True)
    inverse = np.linalg.pinv(design)
    values = inverse @ folded.height[inside]
    grid = np.linspace(-1.0, 1.0, 4001)
    at = float(grid[np.argmax(np.polynomial.polynomial.polyval(grid, values))])
    slope, bend = (np.polynomial.polynomial.polyval(at, np.polynomial.polynomial.polyder(values, m)) for m in (1, 2))
    if bend < 0.0:
        at = float(np.clip(at - slope / bend, -1.0, 1.0))
    height = float(np.polynomial.polynomial.polyval(at, values))
    # the height does not depend on where the top lies, to first order
    weights = np.zeros(len(offset))
    weights[inside] = at ** np.arange(degree + 1) @ inverse
    bend_us = float(bend) / (scale * folded.period_us) ** 2
    frequency = 1e3 * np.sqrt(-bend_us / height) / (2.0 * np.pi) if bend_us < 0.0 < height else None
    spacing = folded.period_us / folded.resolution
    # at its top cos between three points h apart is off by at most h^4/45, between four by less than h^4/20
    off = _MISSES[degree] * abs(height) if degree > 2 else bend_us**2 / max(abs(height), 1e-300) * spacing**4 / 20.0
    place = float(np.mod(top + at * scale, 1.0))
    return Peak(height, folded.error_of(weights), float(off), place, weights, frequency)


_SURE_CHANGE = 5.0
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
    return float(np.sqrt(beyond) / folded.spread_nm) if total > expected * sure and not folded.is_constant else 0.0


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
    return (float(change) if abs(line) > _SURE_CHANGE * error else 0.0), share


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


_UNEXPLAINED = 0.05
"""Share of the standard deviation that a free vibration may leave beyond white noise."""
_OTHER = 0.1
"""Share by which a free vibration may differ from the given free frequency."""
_QUALITIES = (2.0, 5.0, 15.0, 50.0, 200.0, 1e3, 1e5)
"""Where the search for a decay begins."""
_STEADY = 1e5
"""Quality factor from which on no decay is seen."""


class Ringing(NamedTuple):
    """A free vibration, a exp(-Omega t/2Q) cos(Omega' t + phi), beside what the drive moves without an impact."""

    frequency_khz: float
    quality_factor: float
    """Infinite where no decay is seen."""


def find_ringing(trace: Trace) -> Ringing | None:
    """Return the free vibration that a trace is, beside a sine of the drive's frequency; None if it is something else.

    Amplitudes and phases follow by linear least squares from frequency and decay, which are searched from the spectrum.

    Args:
        trace: any samples.
    """
    turns, height = shortened(trace)
    time = turns * trace.drive_period_us
    since, span = time - time[0], float(time[-1] - time[0])
    driven = np.stack([np.ones_like(turns), np.cos(2.0 * np.pi * turns), np.sin(2.0 * np.pi * turns)], axis=1)

    def left(shape: Float[np.ndarray, " 2"]) -> Float[np.ndarray, " n"]:
        omega, decay = shape
        fade = np.exp(-abs(decay) * since)
        design = np.column_stack([driven, fade * np.cos(omega * since), fade * np.sin(omega * since)])
        return height - design @ np.linalg.lstsq(design, height, rcond=None)[0]

    rest = height - driven @ np.linalg.lstsq(driven, height, rcond=None)[0]
    spectrum = np.abs(np.fft.rfft(rest, 4 * len(rest)))
    omega = 2.0 * np.pi * max(int(np.argmax(spectrum)), 1) / (4 * len(rest) * float(since[1]))
    starts = [np.array([omega, 0.5 * omega / quality]) for quality in _QUALITIES]
    start = min(starts, key=lambda shape: float(np.sum(left(shape) ** 2)))
    best = least_squares(left, start, x_scale=np.array([1.0 / span, 1.0 / span]), max_nfev=40)
    omega, decay = float(best.x[0]), abs(float(best.x[1]))
    third = np.median(np.abs(np.diff(height, 3))) / 0.6745 / np.sqrt(20.0)
    missed = 2.0 * best.cost / len(height) - float(third) ** 2
    if missed > (_UNEXPLAINED * float(np.std(height))) ** 2:
        return None
    given = trace.settings.free_frequency_khz
    frequency = 1e3 * np.hypot(omega, decay) / (2.0 * np.pi)
    if given is not None and abs(frequency / given - 1.0) > _OTHER:
        return None
    quality = 0.5 * np.hypot(omega, decay) / max(decay, 1e-300)
    return Ringing(float(frequency), float(quality) if quality < _STEADY else float("inf"))
