"""Bins of height: curves whose heights repeat or are not in order, as rows that a table can hold.

A bin's row is the mean of the readings in it. Its error is their scatter about a straight line over the height, pooled
with that of the neighbouring bins, over the root of their number: in contact readings scatter more than those of the
free tip, because the height does. Where the farther free bins scatter about a straight line in time by more than their
errors (noise that is not independent from row to row), all errors are multiplied by that.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

_ROWS = 5
"""Rows in a bin of the usual width, at least; as many are needed for a scatter of their own."""
_MOST = 200
"""Bins of the usual width in a branch."""
_FEWEST = 100
"""Rows of a branch from which it gets bins of a width; of fewer only rows of equal height are merged."""
_NEIGHBOURS = 4
_ONE_RAMP = 0.1
"""Share of a branch's rows that the rows of a bin may be spread over, for the bins to be in the order of time."""


class Binned(NamedTuple):
    """Rows of a table, in the order of time where that is known; arrays of shape (bins,).

    Attributes:
        offset_nm: mean height of a bin's readings.
        readings: mean of every quantity, by name.
        errors: standard error of each mean, by name.
        rows: number of readings.
        branch: "approach" or "retract".
        in_order_of_time: whether the bins stand as they were passed.
    """

    offset_nm: Float[np.ndarray, " bins"]
    readings: dict[str, Float[np.ndarray, " bins"]]
    errors: dict[str, Float[np.ndarray, " bins"]]
    rows: Int[np.ndarray, " bins"]
    branch: np.ndarray
    in_order_of_time: bool


def faults_of_order(offset_nm: Float[np.ndarray, " rows"], branch: np.ndarray) -> tuple[int, int]:
    """Return how many rows repeat a height of their branch, and how many step back against its direction."""
    repeated = back = 0
    for name in dict.fromkeys(branch.tolist()):
        heights = offset_nm[branch == name]
        steps = np.diff(heights) * np.sign(heights[-1] - heights[0])
        repeated += len(heights) - len(np.unique(heights))
        back += int(np.sum(steps < 0.0))
    return repeated, back


def usual_width(offset_nm: Float[np.ndarray, " rows"], branch: np.ndarray) -> float | None:
    """Return the width in nm of bins for a curve whose heights repeat or are not in order, None for others.

    The width is that of five rows, or of a 200th of them; 0 (only rows of equal height are merged) for few rows.
    """
    if not any(faults_of_order(offset_nm, branch)):
        return None
    widths = []
    for name in dict.fromkeys(branch.tolist()):
        heights = offset_nm[branch == name]
        if len(heights) >= _FEWEST:
            widths.append(float(np.ptp(heights)) * max(_ROWS / len(heights), 1.0 / _MOST))
    return max(widths, default=0.0)


def binned(
    offset_nm: Float[np.ndarray, " rows"],
    readings: dict[str, Float[np.ndarray, " rows"]],
    branch: np.ndarray,
    free: Bool[np.ndarray, " rows"],
    width_nm: float,
    stated: dict[str, float],
) -> Binned:
    """Return the means of the readings of each bin of height, with their errors.

    Args:
        offset_nm: heights.
        readings: what was read there, by name.
        branch: "approach" or "retract" of each row.
        free: rows of the free tip.
        width_nm: of a bin; 0: rows of equal height are merged.
        stated: standard error of a single reading, by name, where that is given instead of the scatter; with `width_nm`
            0 it is needed.
    """
    parts: list[tuple[np.ndarray, ...]] = []
    scatter: dict[str, list[np.ndarray]] = {name: [] for name in readings}
    means: dict[str, list[np.ndarray]] = {name: [] for name in readings}
    in_order = True
    for name in dict.fromkeys(branch.tolist()):
        rows = np.flatnonzero(branch == name)
        rows = rows[np.argsort(offset_nm[rows], kind="stable")]
        height = offset_nm[rows]
        if width_nm > 0.0:
            _, place = np.unique(np.floor((height - height[0]) / width_nm), return_inverse=True)
        else:
            _, place = np.unique(height, return_inverse=True)
        counts = np.bincount(place)

        def mean(values: Float[np.ndarray, " some"], place=place, counts=counts) -> Float[np.ndarray, " bins"]:
            return np.bincount(place, values) / counts

        time = mean(rows.astype(float))
        spread = np.sqrt(np.maximum(mean((rows - time[place]) ** 2.0), 0.0))
        in_order &= bool(np.median(spread) <= _ONE_RAMP * len(rows) + 1.0)
        at = mean(height)
        whole = np.bincount(place, free[rows]) == counts
        # the nearer half of the free rows may feel the sample already
        whole &= np.cumsum(whole) <= 0.5 * whole.sum()
        order = np.arange(len(at)) if name == "approach" else np.arange(len(at))[::-1]
        for key, values in readings.items():
            bins = mean(values[rows])
            single = np.full(len(at), stated[key]) if key in stated else _scatter(height, values[rows], place, len(at))
            error = single / np.sqrt(counts)
            if key not in stated:
                error = error * _excess(bins[whole], error[whole], time[whole])
            means[key].append(bins[order])
            scatter[key].append(error[order])
        parts.append((at[order], counts[order], np.full(len(at), name, dtype=object)))
    offset, counts, names = (np.concatenate(columns) for columns in zip(*parts, strict=True))
    return Binned(
        offset,
        {key: np.concatenate(columns) for key, columns in means.items()},
        {key: np.concatenate(columns) for key, columns in scatter.items()},
        counts,
        names.astype(str),
        in_order,
    )


def _scatter(
    height: Float[np.ndarray, " rows"], values: Float[np.ndarray, " rows"], place: Int[np.ndarray, " rows"], bins: int
) -> Float[np.ndarray, " bins"]:
    """Return the scatter of single readings about a line over the height, in each bin and its neighbours."""
    # bins of few rows are taken together
    counts = np.bincount(place)
    group = np.zeros(bins, dtype=int)
    number, held = 0, 0
    for k, count in enumerate(counts.tolist()):
        if held >= _ROWS:
            number, held = number + 1, 0
        group[k] = number
        held += count
    if held < _ROWS and number:
        group[group == number] = number - 1
    of_row = group[place]
    rows = np.bincount(of_row).astype(float)

    def mean(numbers: Float[np.ndarray, " rows"]) -> Float[np.ndarray, " rows"]:
        return (np.bincount(of_row, numbers) / rows)[of_row]

    x, y = height - mean(height), values - mean(values)
    # a column of one height, or of one number, has no slope
    width = mean(x * x)
    slope = np.where(width > 0.0, mean(x * y) / np.where(width > 0.0, width, 1.0), 0.0)
    squares = np.bincount(of_row, (y - slope * x) ** 2)
    free = np.maximum(rows - 2.0, 0.0)
    window = np.ones(2 * _NEIGHBOURS + 1)
    pooled, freedom = (np.convolve(column, window)[_NEIGHBOURS:-_NEIGHBOURS] for column in (squares, free))
    return np.sqrt(pooled / np.maximum(freedom, 1.0))[group]


def _excess(
    values: Float[np.ndarray, " bins"], errors: Float[np.ndarray, " bins"], time: Float[np.ndarray, " bins"]
) -> float:
    """Return by how much free bins scatter more about a straight line in time than their errors say, 1 at least."""
    known = errors > 0.0
    if known.sum() < _ROWS:
        return 1.0
    values, weights = values[known], 1.0 / errors[known]
    place = (time[known] - time[known].mean()) / max(float(np.ptp(time)), 1.0)
    misfit = (values - np.polyval(np.polyfit(place, values, 1, w=weights), place)) * weights
    return max(1.0, float(np.sqrt(np.sum(misfit**2) / (known.sum() - 2))))
