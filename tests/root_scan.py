"""All roots of a function of one number: scan in float64, refine in mpmath."""

from collections.abc import Callable

import numpy as np

from tests.brute_force import Floats
from tests.reference_flight import Number, mp


def refined(exact: Callable[[Number], Number], low: float, high: float) -> Number | None:
    """Return the root between two float64 numbers, or None where the change of sign was rounding.

    The edge of the valid range is known to float64 only: where an end fails, both are drawn in by a billionth.
    """
    for part in (0, mp.mpf(10) ** -9):
        inset = part * (mp.mpf(high) - low)
        ends = (low + inset, high - inset)
        values = [exact(end) for end in ends]
        if not any(mp.im(value) for value in values) and values[0] * values[1] < 0:
            return mp.findroot(exact, ends, solver="ridder")
    return None


def sign_changes(function: Callable[[Floats], Floats], grid: Floats) -> list[tuple[float, float]]:
    """Return intervals with a root: the grid is first completed so that pairs of close roots and edges show.

    Added are the last valid points beside invalid ones (NaN) and, twice, the vertices of parabolas through three points
    that do not change sign.
    """
    values = function(grid)
    edge = np.flatnonzero(np.isnan(values[:-1]) != np.isnan(values[1:]))
    good = np.where(np.isnan(values[edge]), grid[edge + 1], grid[edge])
    bad = np.where(np.isnan(values[edge]), grid[edge], grid[edge + 1])
    for _ in range(80):
        middle = 0.5 * (good + bad)
        valid = ~np.isnan(function(middle))
        good, bad = np.where(valid, middle, good), np.where(valid, bad, middle)
    grid = np.union1d(grid, good)
    for _ in range(4):
        values = function(grid)
        left, here, right = values[:-2], values[1:-1], values[2:]
        turns = (here * left > 0) & (here * right > 0) & (np.abs(here) <= np.minimum(np.abs(left), np.abs(right)))
        at = np.flatnonzero(turns) + 1
        x0, x1, x2 = grid[at - 1], grid[at], grid[at + 1]
        lean0, lean1 = (values[at] - values[at - 1]) / (x1 - x0), (values[at + 1] - values[at]) / (x2 - x1)
        bend = (lean1 - lean0) / (x2 - x0)
        straight = bend == 0
        vertex = 0.5 * (x0 + x1) - 0.5 * lean0 / np.where(straight, 1, bend)
        grid = np.union1d(grid, vertex[~straight & (vertex > x0) & (vertex < x2)])
    values = function(grid)
    change = np.flatnonzero(values[:-1] * values[1:] < 0)
    return [(float(grid[i]), float(grid[i + 1])) for i in change]
