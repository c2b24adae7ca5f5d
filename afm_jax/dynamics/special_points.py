"""Points of a branch where the nature of its orbit changes, located, and followed through two parameters.

Takes a curve and its family; gives points: the parameter in its unit, m, N, multipliers (fold +1, doubling -1 of
eq. 8's matrix; grazing, capture).

A special point is where a test function changes its sign between two points, located by Brent's method along the curve.
In two parameters the closing equations together with the test function are followed.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from afm_jax.dynamics.curves import AT_A_ROOT, CurvePoint, FollowedCurve, followed_both_ways, lies_on, root_on
from afm_jax.dynamics.impact_loop import CAPTURE, GRAZING, KINDS, LoopFamily, LoopReading
from afm_jax.scenefile.parameter_paths import ParameterRange


class SpecialPoint(NamedTuple):
    """Where the nature of an orbit changes."""

    kind: str
    """One of `KINDS`."""
    parameter: float
    branch: int
    """Number of the branch that it lies on."""
    admissible: bool
    """Whether the map flies the orbit (at a grazing and a capture: on one side)."""
    point: Float[np.ndarray, " n"]
    """On the curve: the unknowns of its loop, and the parameter as a fraction of its range."""
    reading: LoopReading
    test: int
    """Number of the test function that vanishes."""


class OrbitBranch(NamedTuple):
    """An orbit followed through the range, both ways from where it was found."""

    parameter: Float[np.ndarray, " points"]
    points: Float[np.ndarray, "points n"]
    """On the curve, as of a `SpecialPoint`."""
    reading: LoopReading
    ends: tuple[str, str]
    """Why it ends there, at either end."""


class SpecialCurve(NamedTuple):
    """A special point followed through two parameters."""

    kind: str
    parameter: Float[np.ndarray, " points"]
    second: Float[np.ndarray, " points"]
    admissible: np.ndarray
    ends: tuple[str, str]


class _Root(NamedTuple):
    """A root of a test function on a branch."""

    position: float
    """Along the branch, in points."""
    test: int
    point: CurvePoint
    seen: list[np.ndarray]
    """Points whose orbits are read: that of the root first, then the curve's points on either side."""


def special_points_of(curve: FollowedCurve, number: int, family: LoopFamily) -> list[SpecialPoint]:
    """Return the special points of a branch in their order along it, and where the curve was lost at one.

    Args:
        curve: the branch.
        number: of the branch.
        family: of its loops.
    """
    low, width = float(family.low[0]), float(family.width[0])
    special = []
    for root in sorted([*_roots_on(curve, family), *at_lost_ends(curve)], key=lambda root: root.position):
        readings = family.readings(np.stack(root.seen))
        reading, admissible = jax.tree.map(lambda column: column[0], readings), bool(readings.admissible.any())
        kind = _kind_of(root.test, root.point, family)
        if root.test == CAPTURE and kind == KINDS[GRAZING] and not admissible:
            # the tip rests while the sample goes through it: no motion comes to that
            continue
        at = root.point.point
        parameter = low + width * float(at[-1])
        point = SpecialPoint(kind, parameter, number, admissible, at, reading, root.test)
        # of the range
        near = special and abs(special[-1].parameter - parameter) < 1e-7 * width
        if near and special[-1].kind == kind:
            # where an impact's speed vanishes, the lowest point of the flight is at the surface, too
            special[-1] = special[-1]._replace(admissible=special[-1].admissible or admissible)
        else:
            special.append(point)
    return special


def _roots_on(curve: FollowedCurve, family: LoopFamily) -> list[_Root]:
    """Return the roots of all test functions between the points of a branch."""
    roots = []
    for number, leg in enumerate(curve.legs):
        for test in range(len(KINDS)):
            root = root_on(leg, test, family)
            if root is None:
                continue
            fraction, point = root
            # of a grazing or a capture the map flies one side alone
            roots.append(_Root(number + fraction, test, point, [each.point for each in (point, leg.begin, leg.end)]))
    return roots


def at_lost_ends(curve: FollowedCurve) -> list[_Root]:
    """Return grazings and captures at which a curve ends: beyond, its map flies otherwise, or not at all.

    The curve has come within a thousandth and less; the rest is extrapolated. The orbit that is read is that of the
    curve's own last point.
    """
    roots = []
    for end, steps in enumerate((curve.steps[::-1], curve.steps)):
        if curve.ends[end] != "lost":
            continue
        last, position = steps[-1], float(end * len(curve.legs))
        # far enough to extrapolate from
        far = (step for step in reversed(steps) if np.linalg.norm(step.point - last.point) > 1e-5)
        before = next(far, steps[0])
        for test in (GRAZING, CAPTURE):
            left, earlier = float(last.tests[test]), float(before.tests[test])
            # the curve was lost at a root; a test is infinite where no flight has a lowest point
            if 0.0 <= left < 1e-3 and left < earlier:
                ahead = left / (earlier - left) * (last.point - before.point)
                roots.append(_Root(position, test, last._replace(point=last.point + ahead), [last.point]))
    return roots


def _kind_of(test: int, point: CurvePoint, family: LoopFamily) -> str:
    """Return what a root of a test function is: where the law captures nothing, an impact that vanishes is a graze."""
    return KINDS[GRAZING] if test == CAPTURE and family.captures_nothing(point.point) else KINDS[test]


def special_curves(
    special: Sequence[SpecialPoint], family: LoopFamily, second: ParameterRange, value: float
) -> tuple[SpecialCurve, ...]:
    """Return the curves in two parameters through special points that the map flies, each once.

    Args:
        special: points of branches in the first parameter.
        family: of the branches' loops, over both parameters.
        second: the second parameter and its range.
        value: of the second parameter at the special points.
    """
    followed: list[tuple[int, FollowedCurve]] = []
    curves = []
    for point in special:
        start = np.append(point.point, (value - second.low) / (second.high - second.low))
        with_test = replace(family, test=point.test)
        others = (curve for test, curve in followed if test == point.test)
        if not point.admissible or any(lies_on(start, curve, with_test) for curve in others):
            continue
        curve = followed_both_ways(start, with_test)
        if curve is not None:
            followed.append((point.test, curve))
            curves.append(_special_curve(point.kind, curve, with_test))
    return tuple(curves)


def _special_curve(kind: str, curve: FollowedCurve, family: LoopFamily) -> SpecialCurve:
    values = np.asarray(family.low) + np.asarray(family.width) * curve.points[:, -2:]
    if family.test in (GRAZING, CAPTURE):
        # they are the border of what the map flies: only the other border can be passed
        other = np.array([point.tests[GRAZING + CAPTURE - family.test] for point in curve.steps])
        admissible = ~(other < -AT_A_ROOT)
    else:
        admissible = np.asarray(family.readings(curve.points).admissible)
    return SpecialCurve(kind, values[:, 0], values[:, 1], admissible, curve.ends)
