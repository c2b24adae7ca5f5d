"""Intervals: linear ones, and by profile likelihood how far an unknown can go while the others follow."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from fitting.parameters import Parameter

CHI2_95 = 3.841458820694124
"""95 % quantile of chi2 with one degree of freedom."""
END_OF_RANGE = "reaches the end of its range"
UNSETTLED = "the search did not settle"
UNEXPLAINED = "the model does not explain the data"
UNDETERMINED = "the data do not determine this parameter"
NO_LIMIT = "the data set no limit on this side"
"""Why an end of an interval is open, why it is not known, and why there is no interval."""
_FARTHEST = 100.0
"""Distance in standard errors at which a search gives up: the data do not determine the parameter on that side."""
_TRIALS = 16


@dataclass(frozen=True)
class Interval:
    """A 95 % interval; an end that is open is None, with the reason. ``kind``: profile, linear or limit."""

    low: float | None
    high: float | None
    reason: str | None = None
    kind: str | None = None


def within_range(parameter: Parameter, interval: Interval) -> Interval:
    """Return an interval whose ends beyond the parameter's range are open: a limit."""
    ends, reasons = [interval.low, interval.high], [interval.reason] if interval.reason else []
    for i, (name, last, beyond) in enumerate((("lower", parameter.lowest, -1), ("upper", parameter.highest, 1))):
        end = ends[i]
        if end is not None and beyond * (end - last) > 0.0:
            ends[i] = None
            reasons.append(f"{name} end: {END_OF_RANGE}, {last:g}")
    kind = "limit" if None in ends and ends != [None, None] else interval.kind
    return Interval(ends[0], ends[1], "; ".join(reasons) or None, kind)


def profile_interval(
    rise: Callable[[float], float], value: float, error: float, lowest: float, highest: float
) -> Interval:
    """Return the interval over which the smallest chi2, the others following, rises by less than 3.84.

    Args:
        rise: of chi2 over its minimum, at a value; infinite where a row has lost its orbit.
        value: where chi2 is smallest.
        error: linear standard error.
        lowest: where the value may lie.
        highest: likewise.
    """
    ends, reasons = [], []
    for name, direction, last in (("lower", -1.0, lowest), ("upper", 1.0, highest)):
        end, reason = _end(rise, value, error, direction, last)
        ends.append(end)
        if reason:
            reasons.append(f"{name} end: {reason}")
    return Interval(ends[0], ends[1], "; ".join(reasons) or None, "limit" if None in ends else "profile")


def _end(
    rise: Callable[[float], float], value: float, error: float, direction: float, last: float
) -> tuple[float | None, str | None]:
    """Return one end, or why there is none: the root of sqrt(rise) = 1.96, which is nearly linear in the distance."""
    wanted, inside, outside = float(np.sqrt(CHI2_95)), (0.0, 0.0), None
    most = abs(last - value)
    trial = min(wanted * error, most)
    for _ in range(_TRIALS):
        root = float(np.sqrt(max(rise(value + direction * trial), 0.0)))
        if abs(root - wanted) < 5e-4 * wanted:
            return value + direction * trial, None
        if root < wanted:
            if trial >= most:
                return None, f"{END_OF_RANGE}, {last:g}"
            if trial >= _FARTHEST * error:
                return None, NO_LIMIT
            inside = trial, root
        else:
            outside = trial, root
        if outside is None:
            trial = min(trial * max(wanted / max(root, 0.65), 1.5), most, _FARTHEST * error)
            continue
        (low, below), (high, above) = inside, outside
        share = (wanted - below) / (above - below) if np.isfinite(above) else 0.5
        trial = low + float(np.clip(share, 0.02, 0.98)) * (high - low)
        if high - low < 1e-5 * high:
            return value + direction * trial, None
    return (value + direction * trial, None) if outside and outside[0] - inside[0] < 0.01 * error else (None, UNSETTLED)
