"""Points of a branch where the nature of its orbit changes, located, and followed through two parameters.

A special point is where a test function changes its sign between two points, located by Brent's method along the curve.
In two parameters the closing equations together with the test function are followed.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from afm_jax.dynamics.contact_orbits import ContactFlights
from afm_jax.dynamics.curves import (
    AT_A_ROOT,
    CAPTURE,
    DOUBLING,
    FOLD,
    GRAZING,
    KINDS,
    TORUS,
    CurveLeg,
    CurvePoint,
    Equations,
    FollowedCurve,
    Frame,
    followed_both_ways,
    lies_on,
    loop_at,
    read_points,
    root_on,
    split_point,
    tested_by,
)
from afm_jax.dynamics.impact_loop import LoopReading
from afm_jax.scenefile.parameter_paths import ParameterRange

_ASIDE = 1e-5
"""Of a step between points: how far to either side of a grazing or a capture is looked."""
_AT_AN_END = 1e-4
"""Test function below which a contact's curve has been lost at its root."""
_SAME_POINT = 1e-7
"""Of the range: distance below which special points of one kind that follow each other are one."""
_LONG_ENOUGH = 1e-5
"""Length over which is extrapolated from there."""


class SpecialPoint(NamedTuple):
    """Where the nature of an orbit changes."""

    kind: str
    """One of `KINDS`."""
    parameter: float
    branch: int
    """Number of the branch that it lies on."""
    position: float
    """Where on it, in points: 2.5 is between the third and the fourth."""
    admissible: bool
    """Whether the map flies the orbit (at a grazing and a capture: on one side)."""
    unknowns: Float[np.ndarray, " n"]
    reading: LoopReading
    test: int
    """Number of the test function that vanishes."""


class OrbitBranch(NamedTuple):
    """An orbit followed through the range, both ways from where it was found."""

    parameter: Float[np.ndarray, " points"]
    unknowns: Float[np.ndarray, "points n"]
    reading: LoopReading
    ends: tuple[str, str]
    """Why it ends there, at either end."""


class Meeting(NamedTuple):
    """A point of a curve in two parameters that is special in two ways, or where the curve has a cusp."""

    kind: str
    parameter: float
    second: float


class SpecialCurve(NamedTuple):
    """A special point followed through two parameters."""

    kind: str
    parameter: Float[np.ndarray, " points"]
    second: Float[np.ndarray, " points"]
    admissible: np.ndarray
    meetings: tuple[Meeting, ...]
    ends: tuple[str, str]


def special_points_of(way: FollowedCurve, number: int, frame: Frame, equations: Equations) -> list[SpecialPoint]:
    """Return the special points of a branch in their order along it, and where a contact's curve was lost at one."""
    found = []
    for leg, place in way.places():
        for test in range(len(KINDS)):
            root = root_on(leg, tested_by(test, equations), frame, equations)
            if root is not None and (test != TORUS or _is_complex(root[1])):
                share, step = root
                position = place(share)
                if test == CAPTURE:
                    # there the branch ends: its last point is beside it
                    position = 0.0 if position < 1.0 and way.ends[0] == "capture" else np.ceil(position)
                found.append((position, test, step, [step.point, *_beside(leg, share, test, frame, equations)]))
    if equations.flights is not None:
        found += [(place, test, step, [seen]) for place, test, step, seen in _at_lost_ends(way)]
    if not found:
        return []
    found.sort(key=lambda one: one[0])
    reading = read_points(np.stack([point for *_, seen in found for point in seen]), frame, equations)
    low, width = float(frame.low[0]), float(frame.width[0])
    special, first = [], 0
    for place, test, step, seen in found:
        own = jax.tree.map(lambda part, first=first: part[first], reading)
        flown = bool(reading.admissible[first : first + len(seen)].any())
        first += len(seen)
        kind = _kind_of(test, step, frame, equations)
        parameter = low + width * float(step.point[-1])
        if test == CAPTURE and kind == KINDS[GRAZING] and not flown:
            # the tip rests while the sample goes through it: no motion comes to that
            continue
        point = SpecialPoint(kind, parameter, number, place, flown, step.point[:-1], own, test)
        if special and _is_the_same(special[-1], point, width):
            # where an impact's speed vanishes, the lowest point of the flight is at the surface, too
            special[-1] = special[-1]._replace(admissible=special[-1].admissible or flown)
        else:
            special.append(point)
    return special


def _is_the_same(one: SpecialPoint, other: SpecialPoint, width: float) -> bool:
    """Say whether two special points are one, which two test functions have found."""
    return one.kind == other.kind and abs(one.parameter - other.parameter) < _SAME_POINT * width


def _beside(leg: CurveLeg, share: float, test: int, frame: Frame, equations: Equations) -> list[np.ndarray]:
    """Return the points on either side of a grazing or a capture: on one of them the orbit may be flown."""
    if test not in (GRAZING, CAPTURE):
        return []
    steps = (leg.at(share + apart, frame, equations) for apart in (-_ASIDE, _ASIDE))
    return [step.point for step in steps if step is not None]


def _at_lost_ends(way: FollowedCurve) -> list[tuple[float, int, CurvePoint, np.ndarray]]:
    """Return grazings and captures at which a contact's curve ends: beyond, its map flies otherwise, or not at all.

    The curve has come within a millionth and less; the rest is extrapolated. Last is the curve's own last point.
    """
    found = []
    for legs, end, place in ((way.behind, 0, 0.0), (way.ahead, 1, float(len(way.steps) - 1))):
        if way.ends[end] != "lost" or not legs:
            continue
        last = legs[-1].end
        apart = (leg.begin for leg in reversed(legs) if np.linalg.norm(leg.begin.point - last.point) > _LONG_ENOUGH)
        before = next(apart, legs[0].begin)
        for test in (GRAZING, CAPTURE):
            falls = float(before.tests[test] - last.tests[test])
            if 0.0 <= last.tests[test] < _AT_AN_END and falls > 0.0:
                share = float(last.tests[test]) / falls
                point = last.point + share * (last.point - before.point)
                found.append((place, test, last._replace(point=point), last.point))
    return found


def _kind_of(test: int, step: CurvePoint, frame: Frame, equations: Equations) -> str:
    """Return what a root of a test function is: where the law captures nothing, an impact that vanishes is a graze."""
    return KINDS[GRAZING] if test == CAPTURE and captures_nothing(step.point, frame, equations) else KINDS[test]


def captures_nothing(point: Float[np.ndarray, " n"], frame: Frame, equations: Equations) -> bool:
    """Say whether the impacts of a point of a curve are of a law without adhesion, which any speed leaves."""
    if equations.flights is not None:
        return False
    _, shares = split_point(jnp.asarray(point), equations)
    return float(loop_at(shares, frame, equations).impact.lowest) == 0.0


def _is_complex(step: CurvePoint) -> bool:
    """Say whether the multipliers are a complex pair, given D = 1: |T| < 2."""
    return abs(float(step.tests[DOUBLING] - step.tests[FOLD])) < 4.0


def special_curves(
    special: Sequence[SpecialPoint], frame: Frame, equations: Equations, second: ParameterRange, own: float
) -> tuple[SpecialCurve, ...]:
    """Return the curves in two parameters through special points that the map flies, each once."""
    curves: list[tuple[int, FollowedCurve]] = []
    found, both = [], None
    share = (own - second.low) / (second.high - second.low)
    for point in special:
        first = (point.parameter - float(frame.low[0])) / float(frame.width[0])
        start = np.concatenate([point.unknowns, [first, share]])
        paths = (*equations.paths, second.path)
        own_equations = equations._replace(paths=paths, kind=point.test)
        if equations.flights is not None:
            both = both or ContactFlights(frame.scene, int(frame.order), paths)
            own_equations = own_equations._replace(flights=both)
        passed = (way for test, way in curves if test == point.test)
        if not point.admissible or any(lies_on(start, way, frame, own_equations) for way in passed):
            continue
        way = followed_both_ways(start, frame, own_equations)
        if way is not None:
            curves.append((point.test, way))
            found.append(_special_curve(point.kind, way, frame, own_equations))
    return tuple(found)


def _special_curve(kind: str, way: FollowedCurve, frame: Frame, equations: Equations) -> SpecialCurve:
    low, width = np.asarray(frame.low), np.asarray(frame.width)

    def at(step: CurvePoint) -> np.ndarray:
        return low + width * step.point[-2:]

    meetings = []
    for leg, _ in way.places():
        for test in range(len(KINDS)):
            # an impact without speed, or of a captured tip, has no linearised map
            if test == equations.kind or (equations.kind == CAPTURE and test != GRAZING):
                continue
            root = root_on(leg, tested_by(test, equations), frame, equations)
            if root is not None:
                name = f"{kind}_{_kind_of(test, root[1], frame, equations)}"
                meetings.append(Meeting(name, *at(root[1]).tolist()))
        if equations.kind == FOLD:
            root = root_on(leg, _cusp_function(leg), frame, equations)
            if root is not None:
                meetings.append(Meeting("cusp", *at(root[1]).tolist()))
    values = np.stack([at(step) for step in way.steps])
    if equations.kind in (GRAZING, CAPTURE):
        # they are the border of what the map flies: only the other border can be passed
        other = np.array([step.tests[GRAZING + CAPTURE - equations.kind] for step in way.steps])
        admissible = ~(other < -AT_A_ROOT)
    else:
        admissible = np.asarray(read_points(way.points, frame, equations).admissible)
    return SpecialCurve(kind, values[:, 0], values[:, 1], admissible, tuple(meetings), way.ends)


def _cusp_function(leg: CurveLeg) -> Callable[[CurvePoint], float]:
    """Return the test function of cusps: where both parameters turn round, their share in the tangent vanishes."""
    direction = leg.begin.tangent[-2:]
    direction = direction / np.linalg.norm(direction)
    return lambda step: float(step.tangent[-2:] @ direction)
