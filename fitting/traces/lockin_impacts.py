"""Counting impacts in a folded trace: where the velocity jumps between two free flights."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from fitting.traces.lockin_fold import Fold

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
    phases: tuple[float, ...]
    """Response phase of each, in turns."""
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
        places = _tops(np.where(jump > least, jump, 0.0), across)
        return ImpactCount(len(places), tuple(float(place / bins) for place in places), None)
    return ImpactCount(None, (), why)


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


def _tops(jump: Float[np.ndarray, " bins"], across: int) -> list[int]:
    """Return the largest jumps that lie more than a stretch apart on the circle, in order."""
    left, places = jump.copy(), []
    while left.max() > 0.0:
        place = int(np.argmax(left))
        places.append(place)
        left[np.arange(place - across - _BESIDE, place + across + _BESIDE + 1) % len(left)] = 0.0
    return sorted(places)
