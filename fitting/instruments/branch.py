"""What the amplitudes of one branch of a curve say: the free level, its noise and jumps, contact and slope."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

Rows = Float[np.ndarray, " rows"]
JUMP = 0.02
"""Change of the free amplitude, as a share of it, that is called a jump."""
_FEWEST = 5


class ContactSlope(NamedTuple):
    """The steepest settled part of a branch in contact, and its line.

    Attributes:
        value: change of the amplitude per nm of height.
        error: standard error of it by the scatter about the line.
        bend: standard error of it because the line may be bent too little to be seen: a tenth of the change of a
            parabola's slope along it, and of that change's error.
        offsets_nm: heights of its rows, the nearest to the sample last.
        level: mean amplitude of its rows.
    """

    value: float
    error: float
    bend: float
    offsets_nm: Rows
    level: float


class BranchLook(NamedTuple):
    """What one branch shows.

    Attributes:
        free: rows in front of the contact, in the branch's order.
        level: amplitude of the free tip.
        level_error: standard error of it.
        noise: scatter of single amplitudes there; NaN with too few rows.
        slope: change of the amplitude per nm of height in contact; None where too few rows are there.
        onset_nm: height at which the line through the rows in contact meets the free level; None without such rows.
        jump: levels before and after the largest jump of the free amplitude along the heights, None without one.
        change: of the amplitude over the farthest quarter of the rows, of the amplitude, if that is no free part.
    """

    free: Bool[np.ndarray, " rows"]
    level: float
    level_error: float
    noise: float
    slope: ContactSlope | None
    onset_nm: float | None
    jump: tuple[float, float] | None
    change: float | None = None


def look_at(offset_nm: Rows, amplitude: Rows, lag_deg: Rows) -> BranchLook:
    """Return the free level, its noise and jumps, contact and slope of one branch.

    Args:
        offset_nm: heights, growing towards the tip.
        amplitude: in any unit, positive.
        lag_deg: of the phase, with any zero, or zeros; it leaves that of the free tip before the amplitude does.
    """
    order = np.argsort(offset_nm, kind="stable")
    offset, values, lag = offset_nm[order], amplitude[order], lag_deg[order]
    high = values[values > 0.7 * values.max()]
    level = float(np.median(high))
    scatter = 1.48 * float(np.median(np.abs(high - level)))
    first, last = _contact(values, level, scatter)
    # of a curve that goes deep the slope is read between 0.1 and 0.9 of the free amplitude
    engaged = first + np.flatnonzero(values[first:last] > 0.1 * level)
    slope = steepest_part(offset[engaged], values[engaged], deep=bool(values.min() < 0.5 * level))
    # where the line through the steepest part meets the free level
    onset = None if slope is None else float(slope.offsets_nm.mean() + (level - slope.level) / slope.value)
    free = np.ones(len(values), dtype=bool)
    if first < last:
        # the farthest row even where all are in contact
        free = offset <= offset[first] - 0.1 * (offset[first] - offset[0])
    change = _change(offset, values)
    jump = _jump(values[free], lag[free]) if change is None else None
    if jump is None:
        free &= np.arange(len(values)) < _plateau_end(values[free], lag[free])
    rows = values[free]
    noise = _scatter(rows) if len(rows) >= _FEWEST else float("nan")
    error = float(np.std(rows) / np.sqrt(len(rows)))
    mask = free[np.argsort(order, kind="stable")]
    return BranchLook(mask, float(np.median(rows)), error, noise, slope, onset, jump, change)


def _plateau_end(values: Rows, lag: Rows) -> int:
    """Return how many rows, the farthest first, are of the free tip: until blocks of a 20th leave the farthest ones."""
    until = len(values)
    size = max(until // 20, _FEWEST)
    blocks = until // size
    if blocks < 4:
        return until
    first = max(blocks // 4, 1)
    # blocks of the free tip may differ by 0.005 of the amplitude, and by a degree
    for column, flat in ((values, 0.005 * abs(float(np.median(values)))), (lag, 1.0)):
        far = float(np.median(column[: first * size]))
        noise = 5.0 * _scatter(column[: first * size])
        middles = np.median(column[: blocks * size].reshape(blocks, size), axis=1)
        away = np.abs(middles - far) > max(flat, noise / np.sqrt(size))
        # one block that departs may be a spike
        leaves = np.flatnonzero(away[first:] & np.append(away[first + 1 :], True))
        until = min([until, *((first + leaves[:1]) * size).tolist()])
        # of the last block single rows may be in contact
        while until > len(values) // 2 and abs(column[until - 1] - far) > max(flat, noise):
            until -= 1
    return until


def _change(offset: Rows, values: Rows) -> float | None:
    """Return by how much the amplitude falls over the farthest quarter of the rows, of it; None where it is flat."""
    rows = max(len(values) // 4, min(len(values), _FEWEST))
    far, line = values[:rows], _line(offset[:rows], values[:rows])
    if rows < 4 or line is None:
        return None
    slope, error, scatter = line
    change = slope * float(np.ptp(offset[:rows]) / np.median(far))
    # a step is a jump of the free amplitude, not a fall
    of_step = min(float(np.var(far[:k]) * k + np.var(far[k:]) * (rows - k)) for k in range(1, rows))
    # over the farthest quarter a free part changes by 1 % at most
    falls = abs(change) > 0.01 and abs(slope) > 5.0 * error and scatter**2 * (rows - 2) < of_step
    return change if falls else None


def _scatter(values: Rows) -> float:
    """Return the standard deviation about a straight line: a drift is none, correlated noise counts."""
    line = _line(np.arange(len(values), dtype=float), values) if len(values) > 3 else None
    return 0.0 if line is None else line[2]


def _contact(values: Rows, level: float, scatter: float) -> tuple[int, int]:
    """Return from which row on, up to which, the amplitude is reduced: from the nearest outwards until it is back."""
    deep = values.min() < 0.5 * level
    highest = 0.9 * level if deep else level - max(5.0 * min(scatter, 0.02 * level), 0.01 * level)
    low = np.flatnonzero(values < highest)
    if not low.size:
        return 0, 0
    outside = np.flatnonzero(values[: low[-1]] >= highest)
    return (int(outside[-1]) + 1 if outside.size else 0), int(low[-1]) + 1


def steepest_part(offset: Rows, values: Rows, *, deep: bool = False) -> ContactSlope | None:
    """Return the steepest settled part of rows in contact, the nearest to the sample if there are several.

    A curve that first falls slowly (attraction) and then by 1 nm per nm (a hard sample) tells the scale of its
    amplitude by the second part only. Lines are laid through all windows of a nm or more; of those as steep as the
    steepest within their errors the one nearest to the sample is taken, longer where its slope is known to worse than
    3 % and the rows before it lie on the same line.

    Args:
        offset: heights, rising.
        values: amplitudes in any unit.
        deep: whether the amplitude falls below half of the free one: then the line through all rows is taken where it
            is about as steep, because that of a small part follows the bends of the curve.
    """
    rows = len(values)
    if rows < 4 or np.ptp(offset) == 0.0:
        return None
    # 1 nm at least
    length = max(1.0, 5.0 * float(np.median(np.diff(offset))))
    starts = np.searchsorted(offset, offset - length, side="left").tolist()
    # windows that the far end cuts off are left out
    ends = [(a, b) for b, a in enumerate(starts, start=1) if b - a > 3 and offset[b - 1] - offset[0] >= length]
    windows = [(a, b, line) for a, b in ends if (line := _line(offset[a:b], values[a:b]))]
    chosen = _line(offset, values)
    first, last, usual = 0, rows, 0.0
    if windows:
        slopes, errors, scatters = np.array([line for *_, line in windows]).T
        # settled is a window that scatters about its line by at most three times what most do, or 6 % of its fall: of a
        # jump a line leaves 17 %
        usual = float(np.median(scatters))
        settled = scatters <= np.maximum(3.0 * usual, 0.06 * length * np.abs(slopes)) + 1e-12
        steepest = int(np.argmin(np.where(settled, slopes, np.inf)))
        alike = settled & (np.abs(slopes - slopes[steepest]) <= 2.0 * np.hypot(errors, errors[steepest]) + 1e-12)
        start, end, _ = windows[int(np.flatnonzero(alike)[-1])]
        start = _straight_from(offset[:end], values[:end], start)
        line = _line(offset[start:end], values[start:end])
        # with a plateau the line through all rows has less than 0.8 of the slope of the steepest part
        if not (deep and line is not None and chosen is not None and chosen[0] < 0.8 * line[0]):
            first, last, chosen = start, end, line
    # a slope differs from 0 by four standard errors
    if chosen is None or not chosen[0] < -4.0 * chosen[1]:
        return None
    part = offset[first:last]
    # few rows may lie on a line by chance
    error = max(chosen[1], usual / float(np.linalg.norm(part - part.mean())))
    bend = 0.1 * float(np.hypot(*_change_of_slope(part, values[first:last])))
    return ContactSlope(chosen[0], error, bend, part, float(values[first:last].mean()))


def _straight_from(offset: Rows, values: Rows, first: int) -> int:
    """Return from which row on the slope is known to 3 %, as far as the rows up to the last lie on a line."""
    step = max(len(offset) - first, 4) // 4
    while first > 0:
        line = _line(offset[first:], values[first:])
        trial = max(first - step, 0)
        known = line is not None and line[1] < 0.03 * abs(line[0])
        change, error = _change_of_slope(offset[trial:], values[trial:])
        if known or len(offset) - trial < 6 or abs(change) > 2.0 * error + 1e-12 * abs(values[-1]):
            break
        first = trial
    return first


def _change_of_slope(offset: Float[np.ndarray, " some"], values: Float[np.ndarray, " some"]) -> tuple[float, float]:
    """Return how much a parabola's slope changes along rows, and the standard error; 0 of less than five heights."""
    if len(np.unique(offset)) < 5:
        return 0.0, 0.0
    width = float(np.ptp(offset))
    (bend, _, _), covariance = np.polyfit((offset - offset.mean()) / width, values, 2, cov=True)
    return 2.0 * float(bend) / width, 2.0 * float(np.sqrt(covariance[0, 0])) / width


def _line(offset: Float[np.ndarray, " some"], values: Float[np.ndarray, " some"]) -> tuple[float, float, float] | None:
    """Return slope, its error and the scatter about the line; None where all heights are one."""
    place = offset - offset.mean()
    width = float(np.sum(place**2))
    if width == 0.0 or len(values) < 3:
        return None
    slope = float(np.sum(place * values)) / width
    scatter = float(np.sqrt(np.sum((values - values.mean() - slope * place) ** 2) / (len(values) - 2)))
    return slope, scatter / float(np.sqrt(width)), scatter


def _jump(values: Rows, lag: Rows) -> tuple[float, float] | None:
    """Return the levels on both sides of the split of the rows whose means differ most, if that is a jump.

    A tip that comes into contact goes on losing amplitude, and its lag changes, too.
    """
    rows = len(values)
    if rows < 2 * _FEWEST:
        return None
    counts = np.arange(_FEWEST, rows - _FEWEST + 1)
    sums = np.cumsum(values)[counts - 1]
    before, after = sums / counts, (values.sum() - sums) / (rows - counts)
    most = int(np.argmax(np.abs(after - before)))
    low, high, split = float(before[most]), float(after[most]), int(counts[most])
    single = float(np.median(np.abs(np.diff(values)))) / 0.954
    error = single * np.sqrt(1.0 / split + 1.0 / (rows - split))
    falls = (rows - split) * abs(float(np.polyfit(np.arange(rows - split), values[split:], 1)[0]))
    # a change of the amplitude with one of the lag by 3 degrees is that of first contact
    turn = float(np.percentile(np.abs(lag[split:] - np.median(lag[:split])), 75.0))
    # a drift spreads over the rows, a jump happens between two of them
    sudden = abs(values[split : split + 10].mean() - values[max(split - 10, 0) : split].mean())
    if falls > 0.5 * abs(high - low) or turn > 3.0 or sudden <= 0.5 * abs(high - low):
        return None
    return (low, high) if abs(high - low) > max(JUMP * abs(low), 6.0 * error) else None
