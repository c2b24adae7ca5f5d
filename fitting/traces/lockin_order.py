"""The response order: after how many drive periods a trace repeats; fits to half of it predict the other half."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from fitting.traces.lockin_harmonics import GAP_SHARE, fit_harmonics, widest_gap
from fitting.traces.lockin_trace import Trace

HIGHEST_ORDER = 16
"""Longest response in drive periods that is looked for; a steady orbit of a higher order is hardly ever seen."""
_SAMPLES_PER_PERIOD = 48
"""Averages of neighbours keep at least so many samples per drive period; a finer trace tells no more of the order."""
_PER_PERIOD = 8
"""Most harmonics per drive period; what a kink leaves beyond them, 1 % of the motion, is the same for all orders."""
_MOST_SAMPLES = 40_000
_UNSEEN = 0.003
"""A repetition is good enough where what it misses is below this share of the deflection's standard deviation."""
_MARGIN = 0.02
"""Share of the misfit that more parameters may take away by chance."""


class OrderSearch(NamedTuple):
    """What the search found.

    Attributes:
        order: the smallest N that predicts the trace as well as any.
        misfit_nm: rms error of the prediction for N = 1, 2, ..., shape (orders,).
        spread_nm: standard deviation of the deflection.
    """

    order: int
    misfit_nm: Float[np.ndarray, " orders"]
    spread_nm: float


def find_order(trace: Trace) -> OrderSearch:
    """Find the smallest number N of drive periods after which a trace repeats.

    For every N up to half the trace the first half is fitted by harmonics of omega/N and predicts the second, and the
    other way round. A prediction, unlike a fit, gains nothing by following noise or chaos. (Even and odd periods would
    not do: sampled in step with two drive periods they see different phases.)

    Args:
        trace: at least two drive periods of it.
    """
    turns, height = _shortened(trace)
    spread = float(np.std(height))
    most = min(HIGHEST_ORDER, int(trace.drive_periods / 2.0 + 1e-9))
    band = _harmonics_per_period(turns, most)
    squares = np.array([_prediction_error(turns / order, height, band * order) for order in range(1, most + 1)])
    chance = max(_MARGIN, 8.0 / np.sqrt(len(height)))
    allowed = squares.min() * (1.0 + chance) + (_UNSEEN * spread) ** 2
    order = int(np.flatnonzero(squares <= allowed)[0]) + 1
    return OrderSearch(order, np.sqrt(squares), spread)


def _shortened(trace: Trace) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Return drive phases (in turns) and heights, averaged over neighbours and cut where there are too many."""
    per_period = trace.drive_period_us / trace.step_us
    join = max(1, int(per_period / _SAMPLES_PER_PERIOD))
    whole = trace.samples // join * join
    height = trace.height_nm[:whole].reshape(-1, join).mean(axis=1)
    turns = trace.time_us[:whole].reshape(-1, join).mean(axis=1) / trace.drive_period_us
    return turns[-_MOST_SAMPLES:], height[-_MOST_SAMPLES:]


def _prediction_error(turns: Float[np.ndarray, " n"], height: Float[np.ndarray, " n"], highest: int) -> float:
    """Return the mean square of what either half of a trace says wrongly of the other.

    Args:
        turns: response phase of the samples, in turns.
        height: of the samples.
        highest: harmonics that are fitted.
    """
    angle, half = 2.0 * np.pi * turns, len(height) // 2
    total = 0.0
    for known, asked in ((slice(half), slice(half, None)), (slice(half, None), slice(half))):
        function = fit_harmonics(angle[known], height[known], highest)
        total += float(np.sum((height[asked] - function(angle[asked])) ** 2))
    return total / len(height)


def _harmonics_per_period(turns: Float[np.ndarray, " n"], most: int) -> int:
    """Return how many harmonics per drive period both halves determine for every order: the same band for all."""
    half, least = len(turns) // 2, float(_PER_PERIOD)
    for order in range(1, most + 1):
        for part in (turns[:half], turns[half:]):
            least = min(least, GAP_SHARE / (order * widest_gap(2.0 * np.pi * part / order)))
    return max(1, int(least))
