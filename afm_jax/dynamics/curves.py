"""Curves of closed loops in one or two parameters, followed by pseudo-arclength round folds.

Takes a family and ranges of parameters in their units; gives points: unknowns of the family and parameters.

A point of a curve is the unknowns of a loop (`LoopFamily`) followed by the parameters as fractions of their ranges. A
step along the tangent is a guess, and Newton's method closes the loop again in the plane across the tangent. Where a
test function of the family changes its sign between two points the root is located by a bracketed search.

On curves in two parameters the test function is solved for together with the closing conditions.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from afm_jax.dynamics.impact_loop import CAPTURE, FOLD, LoopFamily, rolled_states
from afm_jax.solve.arclength import point_in_plane

_LONGEST_STEP = 0.05
"""Steps along a curve: phases in rad, speeds of the fastest impact, parameters of their ranges."""
_STRAIGHT = 0.98
"""Smallest cosine between the tangents of neighbouring points."""
AT_A_ROOT = 1e-7
"""Largest test function at a root; a jump or a pole is none."""
_SAME = 1e-5


class CurvePoint(NamedTuple):
    """A point of a curve of closed loops, NumPy arrays."""

    point: Any
    tangent: Any
    """Unit vector along the curve."""
    tests: Any
    """The test functions, in the order of `KINDS`."""
    delay: Any
    """Longest delay of an impact, in drive periods."""


def solved_point(guess: np.ndarray, normal: np.ndarray, family: LoopFamily) -> CurvePoint | None:
    """Return the point of a curve in the plane through a guess across a normal; None where no loop closes there."""
    # steps in phases in rad, speeds of the fastest impact, parameters of their ranges
    point = point_in_plane(family.linearised, guess, normal)
    return None if point is None else CurvePoint(point.x, point.tangent, *family.tests(point))


class CurveLeg(NamedTuple):
    """One step of a curve from a point to the next one."""

    begin: CurvePoint
    end: CurvePoint
    guesses: tuple[np.ndarray, np.ndarray]
    """From which the points at either end were solved for."""
    normal: np.ndarray
    """Of the plane in which they were."""

    def at(self, fraction: float, family: LoopFamily) -> CurvePoint | None:
        """Return the curve's point in the plane at a fraction of the step."""
        first, last = self.guesses
        point = solved_point(first + fraction * (last - first), self.normal, family)
        return point if point is None or point.tangent @ self.begin.tangent > 0.0 else _reversed(point)


class FollowedCurve(NamedTuple):
    """A curve as it was followed from one of its points both ways: its steps from one end to the other."""

    legs: list[CurveLeg]
    ends: tuple[str, str]

    @property
    def steps(self) -> list[CurvePoint]:
        """The points from one end to the other."""
        return [self.legs[0].begin, *(leg.end for leg in self.legs)]

    @property
    def points(self) -> Float[np.ndarray, "points n"]:
        """The coordinates of the points from one end to the other."""
        return np.stack([step.point for step in self.steps])


def followed_both_ways(start: np.ndarray, family: LoopFamily) -> FollowedCurve | None:
    """Return the curve through a point, followed both ways; None where the point is none of a curve."""
    normals = np.eye(len(start))[-1], np.full(len(start), 1.0 / np.sqrt(len(start)))
    solved = (solved_point(start, normal, family) for normal in normals)
    # farther away it is another orbit than the one that was found
    first = next((point for point in solved if point is not None and np.abs(point.point - start).max() < 0.1), None)
    if first is None:
        return None
    ahead, why_ahead = _follow(first, family)
    behind, why_behind = ([], "closed") if why_ahead == "closed" else _follow(_reversed(first), family)
    back = [
        CurveLeg(_reversed(leg.end), _reversed(leg.begin), (leg.guesses[1], leg.guesses[0]), leg.normal)
        for leg in reversed(behind)
    ]
    return FollowedCurve([*back, *ahead], (why_behind, why_ahead)) if ahead or behind else None


def _follow(begin: CurvePoint, family: LoopFamily) -> tuple[list[CurveLeg], str]:
    """Return the legs of a curve from a point along its tangent, and why they end."""
    here, legs, length = begin, [], 0.2 * _LONGEST_STEP
    unlike_shorter = _unlike_a_shorter_loop(begin, family)
    while len(legs) < 3000:
        guess = here.point + length * here.tangent
        ahead = solved_point(guess, here.tangent, family)
        if ahead is None or not (
            # beyond, a point may belong to another curve
            np.linalg.norm(ahead.point - guess) < 0.3 * length and here.tangent @ ahead.tangent > _STRAIGHT
        ):
            length *= 0.5
            # the shortest step
            if length < 1e-7:
                return legs, "lost"
            continue
        fractions = ahead.point[-len(family.paths) :]
        if np.any(fractions < 0.0) or np.any(fractions > 1.0):
            last = _at_the_border(here, ahead, family)
            return (legs if last is None else [*legs, last]), "range"
        legs.append(CurveLeg(here, ahead, (here.point, guess), here.tangent))
        over = _why_over(ahead, unlike_shorter, family)
        if over is not None:
            return (legs if over == "capture" else legs[:-1]), over
        if len(legs) > 10 and _closes(ahead, begin, length, family):
            return legs, "closed"
        # a straight curve has longer steps
        if here.tangent @ ahead.tangent > 0.998:
            length = min(1.5 * length, _LONGEST_STEP)
        here = ahead
    return legs, "too long"


def _why_over(
    point: CurvePoint, unlike_shorter: Callable[[CurvePoint], float] | None, family: LoopFamily
) -> str | None:
    """Return why a curve ends before a point; None where it goes on."""
    if family.test != CAPTURE and point.tests[CAPTURE] < 0.0:
        return "capture"
    # of a drive period: beyond, a law's delay has lost its meaning close to capture
    if point.delay > 0.5:
        return "delay"
    # so near to a loop that repeats a shorter one it counts as that
    return "shorter" if unlike_shorter is not None and unlike_shorter(point) < 1e-3 else None


def _unlike_a_shorter_loop(first: CurvePoint, family: LoopFamily) -> Callable[[CurvePoint], float] | None:
    """Return the function that tells how far a loop is from repeating itself after fewer impacts, with a sign.

    None where a loop of so many impacts and periods cannot. A curve that comes to a loop of fewer impacts goes through
    it, back along its own loops begun with another impact: the sign changes there.
    """
    parameters = len(family.paths)
    count = (len(first.point) - parameters) // 2
    shifts = [shift for shift in range(1, count) if count % shift == 0 and int(family.order) % (count // shift) == 0]
    if not shifts:
        return None

    def differences(point: CurvePoint) -> np.ndarray:
        rolled = rolled_states(point.point[:-parameters])
        return (rolled[shifts] - rolled[0]).reshape(len(shifts), -1)

    towards = differences(first)
    towards = towards / np.linalg.norm(towards, axis=1, keepdims=True)
    return lambda point: float(np.min(np.sum(differences(point) * towards, axis=1)))


def _reversed(point: CurvePoint) -> CurvePoint:
    return point._replace(tangent=-point.tangent)


def _closes(here: CurvePoint, first: CurvePoint, length: float, family: LoopFamily) -> bool:
    """Say whether a curve has come back to its beginning; whole turns of the phases count as none."""
    count = (len(first.point) - len(family.paths)) // 2
    apart = here.point - first.point
    apart[:count] = (apart[:count] + np.pi) % (2.0 * np.pi) - np.pi
    return bool(np.linalg.norm(apart) < length and here.tangent @ first.tangent > _STRAIGHT)


def _at_the_border(here: CurvePoint, beyond: CurvePoint, family: LoopFamily) -> CurveLeg | None:
    """Return the leg to where a curve leaves the range of a parameter; None where no loop closes there."""
    parameters = len(family.paths)
    inside, outside = here.point[-parameters:], beyond.point[-parameters:]
    border = np.clip(outside, 0.0, 1.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        fractions = np.where(outside == border, np.inf, (border - inside) / (outside - inside))
    which, fraction = int(np.argmin(fractions)), float(np.min(fractions))
    guess = here.point + fraction * (beyond.point - here.point)
    place = len(guess) - parameters + which
    guess[place] = border[which]
    normal = np.eye(len(guess))[place]
    end = solved_point(guess, normal, family)
    if end is None or np.linalg.norm(end.point - guess) > _LONGEST_STEP:
        return None
    return CurveLeg(here, end if end.tangent @ here.tangent >= 0.0 else _reversed(end), (here.point, guess), normal)


def lies_on(point: np.ndarray, curve: FollowedCurve, family: LoopFamily) -> bool:
    """Say whether a curve goes through a point, up to whole drive periods and the choice of the first impact."""
    points, parameters = curve.points, len(family.paths)
    between = np.flatnonzero((points[:-1, -1] - point[-1]) * (points[1:, -1] - point[-1]) <= 0.0)
    for index in between:
        low, high = points[index], points[index + 1]
        rise = high[-1] - low[-1]
        guess = low + ((point[-1] - low[-1]) / rise if rise else 0.0) * (high - low)
        guess[-1] = point[-1]
        found = solved_point(guess, np.eye(len(guess))[-1], family)
        if found is None or np.abs(found.point - point)[-parameters:].max() > _SAME:
            continue
        rolled, state = rolled_states(found.point[:-parameters]), rolled_states(point[:-parameters])[0]
        if np.abs(rolled - state).max(axis=(1, 2), initial=0.0).min() < _SAME:
            return True
    return False


def root_on(leg: CurveLeg, test: int, family: LoopFamily) -> tuple[float, CurvePoint] | None:
    """Return where on a leg a test function is 0, as a fraction of the leg, and the point there; None: nowhere.

    Args:
        leg: of a curve in one parameter.
        test: number of the function, which counts as 1 where it has no value.
        family: of the curve's loops.
    """

    def tested(point: CurvePoint) -> float:
        value = float(point.tangent[-1] if test == FOLD else point.tests[test])
        return value if np.isfinite(value) else 1.0

    def tested_at(fraction: float) -> float:
        point = leg.at(fraction, family)
        return np.nan if point is None else tested(point)

    if not tested(leg.begin) * tested(leg.end) < 0.0:
        return None
    try:
        from scipy.optimize import brentq  # noqa: PLC0415  # half a second, seldom needed

        fraction = float(np.asarray(brentq(tested_at, 0.0, 1.0, xtol=1e-15)))
    except ValueError:
        # the guesses on the way led elsewhere
        return None
    point = leg.at(fraction, family)
    # a jump or a pole is no root
    return None if point is None or not abs(tested(point)) < AT_A_ROOT else (fraction, point)
