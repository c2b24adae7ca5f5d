"""Intervals: linear ones, and by profile likelihood how far a parameter can go while the others follow."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

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
_TRIALS = 20
_CLOSE, _NEAREST = 5e-4, 1e-2
"""Relative error of an end's distance in chi2's root; distance in errors within which an orbit is lost at the end."""


@dataclass(frozen=True)
class Interval:
    """A 95 % interval; an end that is open is None, with the reason. ``kind``: profile, linear or limit."""

    low: float | None
    high: float | None
    reason: str | None = None
    kind: str | None = None


def linear_interval(parameter: Parameter, low: float, high: float) -> Interval:
    """Return the interval between two ends; one beyond the parameter's range is open."""
    return _with_open_ends(parameter, [low, high], [None, None], "linear")


class Unknown(NamedTuple):
    """What stands for a parameter in a fit: where it is, its standard error, and the ways between it and a value."""

    place: float
    error: float
    of_value: Callable[[float], float]
    value: Callable[[float], float]


def profile_interval(
    rise: Callable[[float], float], parameter: Parameter, unknown: Unknown, least: float = -np.inf
) -> Interval:
    """Return the interval over which the smallest chi2, the others following, rises by less than 3.84.

    Args:
        rise: of chi2 over its minimum, at an unknown; infinite where a row has lost its orbit.
        parameter: for its range.
        unknown: where chi2 is smallest.
        least: value that stands for the lower end of the range, where the value's logarithm is the unknown.
    """
    ends, reasons = [], []
    for last in (max(least, parameter.lowest), parameter.highest):
        far = unknown.of_value(last) - unknown.place
        side = float(np.sign(far))
        distance, reason = _end(rise, unknown, side, abs(far))
        ends.append(None if distance is None else unknown.value(unknown.place + side * distance))
        reasons.append(reason)
    return _with_open_ends(parameter, ends, reasons, "profile")


def _with_open_ends(parameter: Parameter, ends: list[float | None], reasons: list[str | None], kind: str) -> Interval:
    """Return the interval of two ends: open where they leave the parameter's range, with the reason."""
    said = []
    for i, (name, last, beyond) in enumerate((("lower", parameter.lowest, -1), ("upper", parameter.highest, 1))):
        end = ends[i]
        if end is not None and beyond * (end - last) > 0.0:
            ends[i], reasons[i] = None, END_OF_RANGE
        if reasons[i]:
            said.append(f"{name} end: {reasons[i]}{f', {last:g}' if reasons[i] == END_OF_RANGE else ''}")
    return Interval(ends[0], ends[1], "; ".join(said) or None, "limit" if None in ends else kind)


def _end(
    rise: Callable[[float], float],
    unknown: Unknown,
    side: float,
    most: float,
) -> tuple[float | None, str | None]:
    """Return how far one end is, or why there is none: where sqrt(rise), nearly linear in the distance, is 1.96."""
    error = unknown.error
    wanted = float(np.sqrt(CHI2_95))
    (low, below), (high, above) = (0.0, 0.0), (np.inf, np.inf)
    trial, farther = min(wanted * error, most), np.inf
    for _ in range(_TRIALS):
        root = float(np.sqrt(max(rise(unknown.place + side * trial), 0.0)))
        if abs(root - wanted) < _CLOSE * wanted:
            return trial, None
        if root < wanted:
            if trial >= most:
                return None, END_OF_RANGE
            if trial >= _FARTHEST * error:
                return None, NO_LIMIT
            # where a straight line leads; where chi2 hardly rises any more three times as far
            slope = (root - below) / (trial - low)
            farther = min(trial + (wanted - root) / slope if slope > 0.0 else np.inf, 3.0 * trial)
            low, below = trial, root
        else:
            high, above = trial, root
        if not np.isfinite(high):
            trial = min(farther, most, _FARTHEST * error)
            continue
        # an orbit that was seen must be there: where it is lost the interval ends
        if high - low < (1e-5 * high if np.isfinite(above) else _NEAREST * error):
            return low, None
        share = (wanted - below) / (above - below) if np.isfinite(above) else 0.5
        trial = low + float(np.clip(share, 0.05, 0.95)) * (high - low)
    return None, UNSETTLED
