"""What the amplitudes of one branch of a curve say: the free level, its noise and jumps, contact and slope."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

JUMP = 0.02
"""Change of the free amplitude, as a share of it, that is called a jump."""
_FEWEST = 5
_DEEP, _SHALLOW = 0.1, 0.9
"""Shares of the free amplitude between which the slope of a curve that goes deep is read."""


@dataclass(frozen=True, eq=False)
class BranchLook:
    """What one branch shows.

    Attributes:
        free: rows in front of the contact, in the branch's order.
        level: amplitude of the free tip.
        level_error: standard error of it.
        noise: scatter of single amplitudes there; NaN with too few rows.
        slope: change of the amplitude per nm of height in contact, with its error; None where too few rows are there.
        onset_nm: height at which the line through the rows in contact meets the free level; None without such rows.
        jump: levels before and after the largest jump of the free amplitude along the heights, None without one.
    """

    free: Bool[np.ndarray, " rows"]
    level: float
    level_error: float
    noise: float
    slope: tuple[float, float] | None
    onset_nm: float | None
    jump: tuple[float, float] | None


def look_at(offset_nm: Float[np.ndarray, " rows"], amplitude: Float[np.ndarray, " rows"]) -> BranchLook:
    """Look at one branch.

    Args:
        offset_nm: heights, growing towards the tip.
        amplitude: in any unit, positive.
    """
    order = np.argsort(offset_nm, kind="stable")
    offset, values = offset_nm[order], amplitude[order]
    high = values[values > 0.7 * values.max()]
    level = float(np.median(high))
    scatter = 1.48 * float(np.median(np.abs(high - level)))
    first, last = _contact(values, level, scatter)
    touching = slice(first, last)
    engaged = values[touching] > _DEEP * level
    slope, onset = _line(offset[touching][engaged], values[touching][engaged], level)
    edge = offset[first] if first < last else np.inf
    free = offset < edge - (0.1 * (edge - offset[0]) if np.isfinite(edge) else 0.0)
    if free.sum() < _FEWEST:
        free = np.arange(len(values)) < max(first, 1)
    rows = values[free]
    mask = np.zeros(len(values), dtype=bool)
    mask[order] = free
    noise = _scatter(rows) if len(rows) >= _FEWEST else float("nan")
    error = float(np.std(rows) / np.sqrt(len(rows)))
    return BranchLook(mask, float(np.median(rows)), error, noise, slope, onset, _jump(rows))


def _scatter(values: Float[np.ndarray, " rows"]) -> float:
    """Return the standard deviation about a straight line: a drift is none, correlated noise counts."""
    if len(values) < 4:
        return 0.0
    place = np.linspace(-1.0, 1.0, len(values))
    misfit = values - np.polyval(np.polyfit(place, values, 1), place)
    return float(np.sqrt(np.sum(misfit**2) / (len(values) - 2)))


def _contact(values: Float[np.ndarray, " rows"], level: float, scatter: float) -> tuple[int, int]:
    """Return from which row on, up to which, the amplitude is reduced: from the nearest outwards until it is back."""
    deep = values.min() < 0.5 * level
    highest = _SHALLOW * level if deep else level - max(5.0 * min(scatter, 0.02 * level), 0.01 * level)
    low = np.flatnonzero(values < highest)
    if not low.size:
        return 0, 0
    outside = np.flatnonzero(values[: low[-1]] >= highest)
    return (int(outside[-1]) + 1 if outside.size else 0), int(low[-1]) + 1


def _line(
    offset: Float[np.ndarray, " some"], values: Float[np.ndarray, " some"], level: float
) -> tuple[tuple[float, float] | None, float | None]:
    """Return slope with error, and where the line meets the free level."""
    if len(values) < 4 or np.ptp(offset) == 0.0:
        return None, None
    middle = offset.mean()
    (slope, height), covariance = np.polyfit(offset - middle, values, 1, cov=True)
    if not slope < 0.0:
        return None, None
    return (float(slope), float(np.sqrt(covariance[0, 0]))), float(middle + (level - height) / slope)


def _jump(values: Float[np.ndarray, " rows"]) -> tuple[float, float] | None:
    """Return the levels on both sides of the split of the rows whose means differ most, if that is a jump."""
    rows = len(values)
    if rows < 2 * _FEWEST:
        return None
    sums = np.cumsum(values)
    counts = np.arange(_FEWEST, rows - _FEWEST + 1)
    before, after = sums[counts - 1] / counts, (sums[-1] - sums[counts - 1]) / (rows - counts)
    most = int(np.argmax(np.abs(after - before)))
    single = float(np.median(np.abs(np.diff(values)))) / 0.954
    error = single * np.sqrt(1.0 / counts[most] + 1.0 / (rows - counts[most]))
    low, high = float(before[most]), float(after[most])
    # a drift spreads over the rows, a jump happens between two of them
    near = values[max(counts[most] - 10, 0) : counts[most]].mean(), values[counts[most] : counts[most] + 10].mean()
    sudden = abs(near[1] - near[0]) > 0.5 * abs(high - low)
    return (low, high) if abs(high - low) > max(JUMP * abs(low), 6.0 * error) and sudden else None
