"""Curves of closed loops, followed by pseudo-arclength round folds, and the roots of test functions on them.

From a point of a curve a step along the tangent is a guess, and Newton's method closes the loop again in the plane
across the tangent.
"""

import math
from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.optimize import brentq

from afm_jax.dynamics.closed_loops import CAPTURE, FOLD, CurvePoint, Equations, Frame, solved_point

FIRST_STEP = 0.01
LONGEST_STEP = 0.05
"""Steps along a curve: phases in rad, speeds of the fastest impact, parameters of their ranges."""
_SHORTEST_STEP = 1e-7
_MOST_POINTS = 3000
_STRAIGHT = 0.98
"""Smallest cosine between the tangents of neighbouring points."""
_LONGER = 0.998
"""Cosine from which on the next step is longer."""
_OFF = 0.3
"""Farthest that a point may lie from its guess, of the step: beyond, it may belong to another curve."""
_NEAR = 0.1
"""Farthest that the first point of a curve may lie from where an orbit was found."""
AT_A_ROOT = 1e-7
"""Largest test function at a root; a jump or a pole is none."""
_LONGEST_DELAY = 0.5
"""Of a drive period: beyond, a law's delay has lost its meaning close to capture."""
_UNLIKE = 1e-3
"""Distance at which a loop counts as one that repeats a shorter one."""
_SAME = 1e-5


class CurveLeg(NamedTuple):
    """One step of a curve: from a point to another; the guess for the second, and across what it was found."""

    begin: CurvePoint
    end: CurvePoint
    guess: np.ndarray
    row: np.ndarray

    def at(self, share: float, frame: Frame, equations: Equations) -> CurvePoint | None:
        """Return the curve's point in the plane at a share of the way."""
        guess = self.begin.point + share * (self.guess - self.begin.point)
        step = solved_point(frame, guess, self.row, equations)
        return step if step is None or step.tangent @ self.begin.tangent > 0.0 else _turned(step)


class FollowedCurve(NamedTuple):
    """A curve as it was followed from a point on it: backwards, and ahead."""

    first: CurvePoint
    behind: list[CurveLeg]
    ahead: list[CurveLeg]
    ends: tuple[str, str]

    @property
    def steps(self) -> list[CurvePoint]:
        """The points from one end to the other."""
        return [*(leg.end for leg in reversed(self.behind)), self.first, *(leg.end for leg in self.ahead)]

    @property
    def points(self) -> Float[np.ndarray, "points n"]:
        """The same as an array."""
        return np.stack([step.point for step in self.steps])

    def places(self) -> Iterator[tuple[CurveLeg, Callable[[float], float]]]:
        """Give the legs, each with the function from a share of it to a place between the points."""
        count = len(self.behind)
        for index, leg in enumerate(self.behind):
            yield leg, lambda share, index=index: count - index - share
        for index, leg in enumerate(self.ahead):
            yield leg, lambda share, index=index: count + index + share


def followed_both_ways(start: np.ndarray, frame: Frame, equations: Equations) -> FollowedCurve | None:
    """Return the curve through a point, followed both ways; None where the point is none of a curve."""
    rows = np.eye(len(start))[-1], np.full(len(start), 1.0 / np.sqrt(len(start)))
    solved = (solved_point(frame, start, row, equations) for row in rows)
    first = next((step for step in solved if step is not None and np.abs(step.point - start).max() < _NEAR), None)
    if first is None:
        return None
    ahead, why_ahead = _follow(first, first.tangent, frame, equations)
    if why_ahead == "closed":
        return FollowedCurve(first, [], ahead, ("closed", "closed"))
    behind, why_behind = _follow(first, -first.tangent, frame, equations)
    return FollowedCurve(first, behind, ahead, (why_behind, why_ahead)) if ahead or behind else None


def _follow(first: CurvePoint, tangent: np.ndarray, frame: Frame, equations: Equations) -> tuple[list[CurveLeg], str]:
    """Return the legs of a curve from a point in a direction, and why they end."""
    parameters = len(equations.paths)
    here, legs, length = first._replace(tangent=tangent), [], FIRST_STEP
    shorter = _likeness(first, frame, parameters)
    while len(legs) < _MOST_POINTS:
        guess = here.point + length * here.tangent
        found = solved_point(frame, guess, here.tangent, equations)
        if found is None or not _is_next(found, guess, length, here):
            length *= 0.5
            if length < _SHORTEST_STEP:
                return legs, "lost"
            continue
        shares = found.point[-parameters:]
        if np.any(shares < 0.0) or np.any(shares > 1.0):
            last = _at_the_border(here, found, frame, equations, parameters)
            return (legs if last is None else [*legs, last]), "range"
        legs.append(CurveLeg(here, found, guess, here.tangent))
        over = _why_over(found, shorter, equations)
        if over is not None:
            return (legs if over == "capture" else legs[:-1]), over
        if len(legs) > 10 and _closes(found, first._replace(tangent=tangent), length, parameters):
            return legs, "closed"
        if here.tangent @ found.tangent > _LONGER:
            length = min(1.5 * length, LONGEST_STEP)
        here = found
    return legs, "too long"


def _why_over(found: CurvePoint, shorter: Callable[[CurvePoint], float] | None, equations: Equations) -> str | None:
    """Return why a curve ends before a point; None where it does not."""
    if equations.kind != CAPTURE and found.tests[CAPTURE] < 0.0:
        return "capture"
    if found.delay > _LONGEST_DELAY:
        return "delay"
    return "shorter" if shorter is not None and shorter(found) < _UNLIKE else None


def _likeness(first: CurvePoint, frame: Frame, parameters: int) -> Callable[[CurvePoint], float] | None:
    """Return how far a loop is from repeating itself after a part of its impacts, with a sign; None where it cannot.

    A curve that comes to a loop of fewer impacts goes through it, back along its own loops begun with another impact.
    """
    count = (len(first.point) - parameters) // 2
    parts = math.gcd(count, int(frame.order))
    turns = [count // part for part in range(2, parts + 1) if parts % part == 0]
    if not turns:
        return None

    def apart(step: CurvePoint) -> np.ndarray:
        phases, coordinates = step.point[:count], step.point[count : 2 * count]
        state = np.stack([np.cos(phases), np.sin(phases), coordinates])
        return np.stack([np.roll(state, turn, axis=1) - state for turn in turns]).reshape(len(turns), -1)

    towards = apart(first)
    towards = towards / np.linalg.norm(towards, axis=1, keepdims=True)
    return lambda step: float(np.min(np.sum(apart(step) * towards, axis=1)))


def _turned(step: CurvePoint) -> CurvePoint:
    return step._replace(tangent=-step.tangent)


def _is_next(found: CurvePoint, guess: np.ndarray, length: float, here: CurvePoint) -> bool:
    return bool(np.linalg.norm(found.point - guess) < _OFF * length and here.tangent @ found.tangent > _STRAIGHT)


def _closes(found: CurvePoint, first: CurvePoint, length: float, parameters: int) -> bool:
    """Say whether a curve has come back to its beginning; whole turns of the phases count as none."""
    count = (len(first.point) - parameters) // 2
    apart = found.point - first.point
    apart[:count] = (apart[:count] + np.pi) % (2.0 * np.pi) - np.pi
    return bool(np.linalg.norm(apart) < length and found.tangent @ first.tangent > _STRAIGHT)


def _at_the_border(
    here: CurvePoint, beyond: CurvePoint, frame: Frame, equations: Equations, parameters: int
) -> CurveLeg | None:
    """Return the leg to where a curve leaves the range of a parameter; None where it cannot be found."""
    old, new = here.point[-parameters:], beyond.point[-parameters:]
    border = np.clip(new, 0.0, 1.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        shares = np.where(new == border, np.inf, (border - old) / (new - old))
    which, share = int(np.argmin(shares)), float(np.min(shares))
    guess = here.point + share * (beyond.point - here.point)
    place = len(guess) - parameters + which
    guess[place] = border[which]
    row = np.eye(len(guess))[place]
    found = solved_point(frame, guess, row, equations)
    if found is None or np.linalg.norm(found.point - guess) > LONGEST_STEP:
        return None
    if found.tangent @ here.tangent < 0.0:
        found = _turned(found)
    return CurveLeg(here, found, guess, row)


def lies_on(point: np.ndarray, way: FollowedCurve, frame: Frame, equations: Equations) -> bool:
    """Say whether a curve goes through a point, up to whole drive periods and the choice of the first impact."""
    points, parameters = way.points, len(equations.paths)
    between = np.flatnonzero((points[:-1, -1] - point[-1]) * (points[1:, -1] - point[-1]) <= 0.0)
    for index in between:
        low, high = points[index], points[index + 1]
        rise = high[-1] - low[-1]
        share = (point[-1] - low[-1]) / rise if rise else 0.0
        guess = low + share * (high - low)
        guess[-1] = point[-1]
        found = solved_point(frame, guess, np.eye(len(guess))[-1], equations)
        if found is not None and _same_loop(found.point, point, parameters):
            return True
    return False


def _same_loop(one: np.ndarray, other: np.ndarray, parameters: int) -> bool:
    count = (len(one) - parameters) // 2
    states = [np.stack([np.cos(a[:count]), np.sin(a[:count]), a[count : 2 * count]]) for a in (one, other)]
    apart = min(np.abs(np.roll(states[0], turn, axis=1) - states[1]).max(initial=0.0) for turn in range(max(count, 1)))
    return bool(apart < _SAME and np.abs(one - other)[-parameters:].max() < _SAME)


def tested_by(test: int, equations: Equations) -> Callable[[CurvePoint], float]:
    """Return the function from a point to the value of a test function by its number; 1 where it has none."""
    along = test == FOLD and equations.kind is None

    def value(step: CurvePoint) -> float:
        found = float(step.tangent[-1] if along else step.tests[test])
        return found if np.isfinite(found) else 1.0

    return value


def root_on(
    leg: CurveLeg, test: Callable[[CurvePoint], float], frame: Frame, equations: Equations
) -> tuple[float, CurvePoint] | None:
    """Return where on a leg a test function is 0, as a share of it, and the point there; None where it is nowhere."""
    if not test(leg.begin) * test(leg.end) < 0.0:
        return None

    def at(share: float) -> float:
        step = leg.at(share, frame, equations)
        return np.nan if step is None else test(step)

    try:
        share = float(np.asarray(brentq(at, 0.0, 1.0, xtol=1e-15)))
    except ValueError:
        # the guesses on the way led elsewhere
        return None
    step = leg.at(share, frame, equations)
    # a jump or a pole is no root
    return None if step is None or not abs(test(step)) < AT_A_ROOT else (share, step)
