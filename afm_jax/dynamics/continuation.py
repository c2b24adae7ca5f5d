"""Orbits followed through a parameter by pseudo-arclength, round folds, with the points where their nature changes.

The unknowns of `impact_loop`, followed by the parameter as a share of its range, lie on a curve. From a point of it a
step along the tangent is a guess, Newton's method closes the loop again in the plane across the tangent. A special
point is where a test function changes its sign between two points, located by Brent's method along the curve:

    fold             the tangent's share in the parameter, on curves in two parameters 1 - T + D
    period_doubling  1 + T + D, a multiplier -1
    torus            D - 1 with |T| < 2, a pair of multipliers on the unit circle
    grazing          the lowest point of a flight above the surface; or an impact without adhesion whose speed vanishes
    capture          the distance of the slowest impact from capture

In two parameters the same equations together with the test function are followed.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float
from scipy.optimize import brentq

from afm_jax.apparatus.scene import Scene, drive_of
from afm_jax.checks import require_float64
from afm_jax.contact.contact import Contact
from afm_jax.dynamics.contact_orbits import ContactFlights, CurveUnits, contact_loops
from afm_jax.dynamics.impact_loop import (
    ImpactLoop,
    LoopReading,
    closing_gaps,
    coordinate_of,
    driven_part,
    impacts_at,
    loop_of,
    nearest_approach,
    reading_of,
    samples_for,
    trace_and_determinant_of,
)
from afm_jax.dynamics.impact_orbits import MOST_IMPACTS, many_impact_orbits
from afm_jax.impact.law import impact_law_of
from afm_jax.impact.orbits import single_impact_orbits
from afm_jax.results import public_result
from afm_jax.scenefile.parameter_paths import (
    ParameterRange,
    check_ranges,
    parameter_values,
    scene_family,
    with_numbers,
)

KINDS = ("fold", "period_doubling", "torus", "grazing", "capture")
_FOLD, _DOUBLING, _TORUS, _GRAZING, _CAPTURE = range(len(KINDS))

FIRST_STEP = 0.01
LONGEST_STEP = 0.05
"""Steps along a curve: phases in rad, speeds of the fastest impact, parameters of their ranges."""
_SHORTEST_STEP = 1e-7
_MOST_POINTS = 3000
_STRAIGHT = 0.98
"""Smallest cosine between the tangents of neighbouring points."""
_LONGER = 0.998
"""Cosine from which on the next step is longer."""
_NEWTON_STEPS = 10
_ARRIVED = 1e-11
_OFF = 0.3
"""Farthest that a point may lie from its guess, of the step: beyond, it may belong to another curve."""
_NEAR = 0.1
"""Farthest that the first point of a curve may lie from where an orbit was found."""
_ROOT = 1e-7
"""Largest test function at a root; a jump or a pole is none."""
_LONGEST_DELAY = 0.5
"""Of a drive period: beyond, a law's delay has lost its meaning close to capture."""
_AT_AN_END = 1e-4
"""Test function below which a contact's curve has been lost at its root."""
_LONG_ENOUGH = 1e-5
"""Length over which is extrapolated from there."""
_UNLIKE = 1e-3
"""Distance at which a loop counts as one that repeats a shorter one."""
_VALUES_TRIED = 9
_FEWER_TRIED = 3
_SAME = 1e-5
_BLOCK = 64
"""Points read together: one program."""


class Frame(NamedTuple):
    """What a curve is followed in: the scene, N, the coordinates' scale, and the parameters' ranges."""

    scene: Scene
    order: Float[Array, ""]
    scale: Float[Array, ""]
    low: Float[Array, " parameters"]
    width: Float[Array, " parameters"]


class Equations(NamedTuple):
    """What is solved, a different program each: which parameters move, and which test function is 0; None: none is."""

    paths: tuple[str, ...]
    driven: str
    samples: int
    kind: int | None = None
    flights: ContactFlights | None = None
    """Of a scene with a contact, whose equations are simulated."""


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


@public_result(picture="afm_jax.plots.branches:continuation_figure")
class Continuation(NamedTuple):
    """What `continue_orbits` finds."""

    order: int
    impacts: int
    range: ParameterRange
    second: ParameterRange | None
    branches: tuple[OrbitBranch, ...]
    special: tuple[SpecialPoint, ...]
    curves: tuple[SpecialCurve, ...]
    rejected: int
    """Orbits found to begin with whose flights pass through the surface; not followed."""
    frame: Frame
    equations: Equations


def continue_orbits(
    scene: Scene, order: int, given: ParameterRange, *, impacts: int = 1, second: ParameterRange | None = None
) -> Continuation:
    """Follow the (m, N) orbits of a scene through a parameter, and their special points through a second one.

    Orbits are looked for at the scene's own value, if that is in the range, and at 9 values in the range; every one
    that the map flies is followed both ways, through folds, to the ends of the range, to capture or until the curve
    closes. A flight that comes to pass through the surface (grazing) ends no curve: its points are not admissible.

    Args:
        scene: one scene with an `ImpactLaw` or a `Contact`, driven with one period. A contact's curves end where the
            orbit grazes and where it is captured; their cusps are not looked for.
        order: N, drive periods in which the orbit repeats.
        given: the parameter and its range.
        impacts: m, impacts in them; 0: the motion of a tip that meets nothing.
        second: another parameter and its range, which holds the scene's own value; None: no curves are followed.

    Raises:
        RuntimeError: if JAX is not set to 64-bit floats.
        TypeError: if the tip meets nothing.
        ValueError: if the drive does not repeat, a parameter or a range is none of the scene's, or order and impacts
            are no numbers of impacts and periods.
    """
    require_float64(scene)
    ranges = (given,) if second is None else (given, second)
    _check(scene, order, impacts, ranges)
    driven = driven_part(scene)
    if second is not None:
        own = parameter_values(scene)[second.path]
        if not second.low <= own <= second.high:
            raise ValueError(f"{second}: the range must hold the scene's own value, {own:g}, where the curves begin")
    flights = ContactFlights(scene, order, (given.path,)) if isinstance(scene.interaction, Contact) else None
    equations = Equations((given.path,), driven, samples_for(scene, order, driven), flights=flights)
    starts, rejected = _orbits_in_range(scene, order, impacts, given, flights)
    scale = max((loop[impacts:].max() for _, loop in starts if impacts), default=1.0)
    frame = _frame(scene, order, scale, (given,))
    ways: list[_Way] = []
    for place, loop in starts:
        start = np.concatenate([loop[:impacts], loop[impacts:] / scale, [place]])
        if not any(_lies_on(start, way, frame, equations) for way in ways):
            way = _both_ways(start, frame, equations)
            if way is not None:
                ways.append(way)
    branches = tuple(_branch(way, frame, equations) for way in ways)
    special = tuple(
        point
        for number, (way, branch) in enumerate(zip(ways, branches, strict=True))
        for point in _special_points(way, branch, number, frame, equations)
    )
    # the point behind a capture at the beginning goes
    special = tuple(one._replace(position=one.position - (ways[one.branch].ends[0] == "capture")) for one in special)
    branches = tuple(map(_before_capture, branches))
    curves = ()
    if second is not None:
        wide, own = _frame(scene, order, scale, ranges), parameter_values(scene)[second.path]
        curves = _curves(special, wide, equations, second, own)
    return Continuation(order, impacts, given, second, branches, special, curves, rejected, frame, equations)


def _check(scene: Scene, order: int, impacts: int, ranges: Sequence[ParameterRange]) -> None:
    if int(order) != order or order < 1:
        raise ValueError(f"`order` must be a positive integer, but is {order}")
    if int(impacts) != impacts or not 0 <= impacts <= MOST_IMPACTS:
        raise ValueError(f"`impacts` must be an integer from 0 to {MOST_IMPACTS}, but is {impacts}")
    if not isinstance(scene.interaction, Contact):
        impact_law_of(scene)
    elif impacts == 0:
        raise ValueError("`impacts` must be 1 or more in a scene with a contact, but is 0")
    check_ranges(scene, *ranges)
    for given in ranges:
        for end in (given.low, given.high):
            driven_part(scene_family(scene, given.path)(end))


def _frame(scene: Scene, order: int, scale: float, ranges: Sequence[ParameterRange]) -> Frame:
    low, high = (jnp.asarray([getattr(one, end) for one in ranges]) for end in ("low", "high"))
    return Frame(scene, jnp.asarray(float(order)), jnp.asarray(scale), low, high - low)


# The equations and their solution.


def loop_at(shares: Float[Array, " parameters"], frame: Frame, equations: Equations) -> ImpactLoop:
    """Return what is closed where the parameters are at shares of their ranges."""
    values = dict(zip(equations.paths, frame.low + frame.width * shares, strict=True))
    return loop_of(with_numbers(frame.scene, values), frame.order, equations.driven)


def _split(point: Array, equations: Equations) -> tuple[Array, Array]:
    count = point.shape[0] - len(equations.paths)
    return point[:count], point[count:]


def _tests(unknowns: Array, frame: Frame, loop: ImpactLoop, samples: int) -> list[Array]:
    """Return the test functions in the order of `KINDS`, without dimension."""
    trace, determinant = trace_and_determinant_of(unknowns, frame.scale, loop)
    near = nearest_approach(unknowns, frame.scale, loop, samples).gap_nm
    slowest = jnp.min(unknowns[unknowns.shape[0] // 2 :], initial=jnp.inf)
    return [
        1.0 - trace + determinant,
        1.0 + trace + determinant,
        determinant - 1.0,
        near * loop.cantilever.angular_frequency / frame.scale,
        slowest - loop.impact.lowest / frame.scale,
    ]


def equations_at(point: Float[Array, " n"], frame: Frame, equations: Equations) -> Float[Array, " rows"]:
    """Return what is to be 0 at unknowns followed by the parameters' shares."""
    unknowns, shares = _split(point, equations)
    loop = loop_at(shares, frame, equations)
    gaps = closing_gaps(unknowns, frame.scale, loop)
    if equations.kind is None:
        return gaps
    test = _tests(unknowns, frame, loop, equations.samples)[equations.kind]
    return jnp.append(gaps, test)


class _Step(NamedTuple):
    """Where Newton's method arrived: the point, its last move, the tangent, test functions, the longest delay."""

    point: Any
    moved: Any
    tangent: Any
    tests: Any
    delay: Any


@partial(jax.jit, static_argnames=("equations",))
def _step(frame: Frame, guess: Array, row: Array, equations: Equations) -> _Step:
    """Return the point of a curve in the plane through a guess across a row."""

    def twice(point):
        value = equations_at(point, frame, equations)
        return value, value

    def searching(state):
        _, moved, steps, _ = state
        return (moved > _ARRIVED * 0.01) & (steps < _NEWTON_STEPS)

    def improve(state):
        point, _, steps, _ = state
        slopes, value = jax.jacfwd(twice, has_aux=True)(point)
        matrix = jnp.concatenate([slopes, row[None]])
        move = jnp.linalg.solve(matrix, jnp.append(value, row @ (point - guess)))
        return point - move, jnp.max(jnp.abs(move)), steps + 1, matrix

    count = guess.shape[0]
    begin = (guess, jnp.asarray(jnp.inf), 0, jnp.eye(count))
    point, moved, _, matrix = lax.while_loop(searching, improve, begin)
    tangent = jnp.linalg.solve(matrix, jnp.zeros(count).at[-1].set(1.0))
    tangent = tangent / jnp.linalg.norm(tangent)
    unknowns, shares = _split(point, equations)
    loop = loop_at(shares, frame, equations)
    tests = _tests(unknowns, frame, loop, equations.samples)
    delay = jnp.zeros(())
    if loop.impact.delayed:
        delays = impacts_at(unknowns, frame.scale, loop).speeds.delay
        delay = jnp.max(jnp.abs(delays)) * loop.angular_frequency / (2.0 * jnp.pi)
    return _Step(point, moved, tangent, jnp.stack(tests), delay)


def _solve(frame: Frame, guess: np.ndarray, row: np.ndarray, equations: Equations) -> _Step | None:
    """Return the same as NumPy arrays; None where the method does not arrive."""
    if equations.flights is not None:
        solved = equations.flights.solve(guess, row, _units(frame), equations.kind)
        if solved is None:
            return None
        found = _Step(*solved, 0.0)
    else:
        found = _Step(*(np.asarray(part) for part in _step(frame, jnp.asarray(guess), jnp.asarray(row), equations)))
    arrived = np.isfinite(found.point).all() and np.isfinite(found.tangent).all() and found.moved < _ARRIVED
    return found if arrived else None


def _units(frame: Frame) -> CurveUnits:
    return CurveUnits(float(frame.scale), np.asarray(frame.low), np.asarray(frame.width))


# Curves.


class _CurveLeg(NamedTuple):
    """One step of a curve: from a point to another; the guess for the second, and across what it was found."""

    begin: _Step
    end: _Step
    guess: np.ndarray
    row: np.ndarray

    def at(self, share: float, frame: Frame, equations: Equations) -> _Step | None:
        """Return the curve's point in the plane at a share of the way."""
        guess = self.begin.point + share * (self.guess - self.begin.point)
        step = _solve(frame, guess, self.row, equations)
        return step if step is None or step.tangent @ self.begin.tangent > 0.0 else _turned(step)


class _Way(NamedTuple):
    """A curve as it was followed from a point on it: backwards, and ahead."""

    first: _Step
    behind: list[_CurveLeg]
    ahead: list[_CurveLeg]
    ends: tuple[str, str]

    @property
    def steps(self) -> list[_Step]:
        """The points from one end to the other."""
        return [*(leg.end for leg in reversed(self.behind)), self.first, *(leg.end for leg in self.ahead)]

    @property
    def points(self) -> Float[np.ndarray, "points n"]:
        """The same as an array."""
        return np.stack([step.point for step in self.steps])

    def places(self) -> Iterator[tuple[_CurveLeg, Callable[[float], float]]]:
        """Give the legs, each with the function from a share of it to a place between the points."""
        count = len(self.behind)
        for index, leg in enumerate(self.behind):
            yield leg, lambda share, index=index: count - index - share
        for index, leg in enumerate(self.ahead):
            yield leg, lambda share, index=index: count + index + share


def _both_ways(start: np.ndarray, frame: Frame, equations: Equations) -> _Way | None:
    """Return the curve through a point, followed both ways; None where the point is none of a curve."""
    rows = np.eye(len(start))[-1], np.full(len(start), 1.0 / np.sqrt(len(start)))
    solved = (_solve(frame, start, row, equations) for row in rows)
    first = next((step for step in solved if step is not None and np.abs(step.point - start).max() < _NEAR), None)
    if first is None:
        return None
    ahead, why_ahead = _follow(first, first.tangent, frame, equations)
    if why_ahead == "closed":
        return _Way(first, [], ahead, ("closed", "closed"))
    behind, why_behind = _follow(first, -first.tangent, frame, equations)
    return _Way(first, behind, ahead, (why_behind, why_ahead)) if ahead or behind else None


def _follow(first: _Step, tangent: np.ndarray, frame: Frame, equations: Equations) -> tuple[list[_CurveLeg], str]:
    """Return the legs of a curve from a point in a direction, and why they end."""
    parameters = len(equations.paths)
    here, legs, length = first._replace(tangent=tangent), [], FIRST_STEP
    shorter = _likeness(first, frame, parameters)
    while len(legs) < _MOST_POINTS:
        guess = here.point + length * here.tangent
        found = _solve(frame, guess, here.tangent, equations)
        if found is None or not _is_next(found, guess, length, here):
            length *= 0.5
            if length < _SHORTEST_STEP:
                return legs, "lost"
            continue
        shares = found.point[-parameters:]
        if np.any(shares < 0.0) or np.any(shares > 1.0):
            last = _at_the_border(here, found, frame, equations, parameters)
            return (legs if last is None else [*legs, last]), "range"
        legs.append(_CurveLeg(here, found, guess, here.tangent))
        over = _why_over(found, shorter, equations)
        if over is not None:
            return (legs if over == "capture" else legs[:-1]), over
        if len(legs) > 10 and _closes(found, first._replace(tangent=tangent), length, parameters):
            return legs, "closed"
        if here.tangent @ found.tangent > _LONGER:
            length = min(1.5 * length, LONGEST_STEP)
        here = found
    return legs, "too long"


def _why_over(found: _Step, shorter: Callable[[_Step], float] | None, equations: Equations) -> str | None:
    """Return why a curve ends before a point; None where it does not."""
    if equations.kind != _CAPTURE and found.tests[_CAPTURE] < 0.0:
        return "capture"
    if found.delay > _LONGEST_DELAY:
        return "delay"
    return "shorter" if shorter is not None and shorter(found) < _UNLIKE else None


def _likeness(first: _Step, frame: Frame, parameters: int) -> Callable[[_Step], float] | None:
    """Return how far a loop is from repeating itself after a part of its impacts, with a sign; None where it cannot.

    A curve that comes to a loop of fewer impacts goes through it, back along its own loops begun with another impact.
    """
    count = (len(first.point) - parameters) // 2
    parts = math.gcd(count, int(frame.order))
    turns = [count // part for part in range(2, parts + 1) if parts % part == 0]
    if not turns:
        return None

    def apart(step: _Step) -> np.ndarray:
        phases, coordinates = step.point[:count], step.point[count : 2 * count]
        state = np.stack([np.cos(phases), np.sin(phases), coordinates])
        return np.stack([np.roll(state, turn, axis=1) - state for turn in turns]).reshape(len(turns), -1)

    towards = apart(first)
    towards = towards / np.linalg.norm(towards, axis=1, keepdims=True)
    return lambda step: float(np.min(np.sum(apart(step) * towards, axis=1)))


def _turned(step: _Step) -> _Step:
    return step._replace(tangent=-step.tangent)


def _is_next(found: _Step, guess: np.ndarray, length: float, here: _Step) -> bool:
    return bool(np.linalg.norm(found.point - guess) < _OFF * length and here.tangent @ found.tangent > _STRAIGHT)


def _closes(found: _Step, first: _Step, length: float, parameters: int) -> bool:
    """Say whether a curve has come back to its beginning; whole turns of the phases count as none."""
    count = (len(first.point) - parameters) // 2
    apart = found.point - first.point
    apart[:count] = (apart[:count] + np.pi) % (2.0 * np.pi) - np.pi
    return bool(np.linalg.norm(apart) < length and found.tangent @ first.tangent > _STRAIGHT)


def _at_the_border(here: _Step, beyond: _Step, frame: Frame, equations: Equations, parameters: int) -> _CurveLeg | None:
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
    found = _solve(frame, guess, row, equations)
    if found is None or np.linalg.norm(found.point - guess) > LONGEST_STEP:
        return None
    if found.tangent @ here.tangent < 0.0:
        found = _turned(found)
    return _CurveLeg(here, found, guess, row)


def _lies_on(point: np.ndarray, way: _Way, frame: Frame, equations: Equations) -> bool:
    """Say whether a curve goes through a point, up to whole drive periods and the choice of the first impact."""
    points, parameters = way.points, len(equations.paths)
    between = np.flatnonzero((points[:-1, -1] - point[-1]) * (points[1:, -1] - point[-1]) <= 0.0)
    for index in between:
        low, high = points[index], points[index + 1]
        rise = high[-1] - low[-1]
        share = (point[-1] - low[-1]) / rise if rise else 0.0
        guess = low + share * (high - low)
        guess[-1] = point[-1]
        found = _solve(frame, guess, np.eye(len(guess))[-1], equations)
        if found is not None and _same_loop(found.point, point, parameters):
            return True
    return False


def _same_loop(one: np.ndarray, other: np.ndarray, parameters: int) -> bool:
    count = (len(one) - parameters) // 2
    states = [np.stack([np.cos(a[:count]), np.sin(a[:count]), a[count : 2 * count]]) for a in (one, other)]
    apart = min(np.abs(np.roll(states[0], turn, axis=1) - states[1]).max(initial=0.0) for turn in range(max(count, 1)))
    return bool(apart < _SAME and np.abs(one - other)[-parameters:].max() < _SAME)


# Where curves begin.


def _orbits_in_range(
    scene: Scene, order: int, impacts: int, given: ParameterRange, flights: ContactFlights | None
) -> tuple[list[tuple[float, np.ndarray]], int]:
    """Return orbits in the range, and how many were left out as not admissible.

    Each as its share of the range, and phases in rad and coordinates in nm/us (of a contact: rebound speeds).
    """
    own = parameter_values(scene)[given.path]
    tried = np.linspace(0.0, 1.0, (_VALUES_TRIED if impacts == 1 and flights is None else _FEWER_TRIED) + 2)[1:-1]
    # the middle first
    shares = list(tried[np.argsort(np.abs(tried - 0.5), kind="stable")])
    if given.low <= own <= given.high:
        shares = [(own - given.low) / (given.high - given.low), *shares]
    if impacts == 0:
        return [(float(shares[0]), np.zeros(0))], 0
    family, found, rejected = scene_family(scene, given.path), [], 0
    for share in shares:
        value = given.low + (given.high - given.low) * share
        there = family(value)
        if flights is not None:
            loops = contact_loops(flights, np.array([value]), impacts)
        elif impacts == 1 and scene.base is None and scene.force is None and scene.platform.second is None:
            loops, passed = _single_impact_loops(there, order)
            rejected += passed
        else:
            loops = many_impact_orbits(there, order, impacts).loops
        found += [(float(share), loop) for loop in loops]
    return found, rejected


def _single_impact_loops(scene: Scene, order: int) -> tuple[Float[np.ndarray, "orbits 2"], int]:
    """Return arrival phases in rad and coordinates in nm/us of the admissible orbits, and how many are not."""
    found = single_impact_orbits(scene, order)
    exists = np.asarray(found.exists)
    good = exists & np.asarray(found.admissible)
    omega = drive_of(scene).angular_frequency
    phases = np.asarray(found.phase_rad) - omega * np.asarray(found.delay_us)
    coordinates = np.asarray(coordinate_of(found.approach_speed_nm_per_us, impact_law_of(scene)))
    return np.stack([phases, coordinates], axis=1)[good], int(np.sum(exists & ~good))


# What there is on a curve.


@partial(jax.jit, static_argnames=("equations",))
def _read(frame: Frame, points: Array, equations: Equations) -> LoopReading:
    def one(point):
        unknowns, shares = _split(point, equations)
        return reading_of(unknowns, frame.scale, loop_at(shares, frame, equations), equations.samples)

    return jax.vmap(one)(points)


def read_points(points: Float[np.ndarray, "points n"], frame: Frame, equations: Equations) -> LoopReading:
    """Return what there is to know of the orbits at points of a curve, NumPy arrays."""
    if equations.flights is not None:
        return equations.flights.readings(points, _units(frame))
    return by_blocks(lambda block: _read(frame, block, equations), points)


def by_blocks(work: Callable[[Array], Any], points: Float[np.ndarray, "points n"]) -> Any:
    """Return the results of work on points, NumPy arrays; blocks of one size, the last filled up, share a program."""
    blocks = -(-len(points) // _BLOCK)
    padded = np.concatenate([points, np.repeat(points[-1:], blocks * _BLOCK - len(points), axis=0)])
    done = [work(jnp.asarray(block)) for block in np.split(padded, blocks)]
    return jax.tree.map(lambda *parts: np.concatenate([np.asarray(part) for part in parts])[: len(points)], *done)


def _branch(way: _Way, frame: Frame, equations: Equations) -> OrbitBranch:
    points = way.points
    value = float(frame.low[0]) + float(frame.width[0]) * points[:, -1]
    return OrbitBranch(value, points[:, :-1], read_points(points, frame, equations), way.ends)


def _before_capture(branch: OrbitBranch) -> OrbitBranch:
    """Return a branch without the point after its end by capture, where there is no orbit."""
    inside = slice(int(branch.ends[0] == "capture"), len(branch.parameter) - int(branch.ends[1] == "capture"))
    return OrbitBranch(
        branch.parameter[inside],
        branch.unknowns[inside],
        jax.tree.map(lambda part: part[inside], branch.reading),
        branch.ends,
    )


def _special_points(
    way: _Way, branch: OrbitBranch, number: int, frame: Frame, equations: Equations
) -> list[SpecialPoint]:
    found = []
    for leg, place in way.places():
        for test in range(len(KINDS)):
            root = _root_on(leg, _test_function(test, equations), frame, equations)
            if root is not None and (test != _TORUS or _is_complex(root[1])):
                found.append((place(root[0]), test, root[1], root[1].point))
    if equations.flights is not None:
        found += _at_lost_ends(way)
    if not found:
        return []
    found.sort(key=lambda one: one[0])
    reading = read_points(np.stack([seen for *_, seen in found]), frame, equations)
    low, width = float(frame.low[0]), float(frame.width[0])
    special = []
    for index, (place, test, step, _) in enumerate(found):
        own = jax.tree.map(lambda part, index=index: part[index], reading)
        beside = branch.reading.admissible[[int(np.floor(place)), int(np.ceil(place))]]
        flown = bool(beside.any()) if test in (_GRAZING, _CAPTURE) else bool(own.admissible)
        kind = _kind_of(test, step, frame, equations)
        parameter = low + width * float(step.point[-1])
        special.append(SpecialPoint(kind, parameter, number, place, flown, step.point[:-1], own, test))
    return special


def _at_lost_ends(way: _Way) -> list[tuple[float, int, _Step, np.ndarray]]:
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
        for test in (_GRAZING, _CAPTURE):
            falls = float(before.tests[test] - last.tests[test])
            if 0.0 <= last.tests[test] < _AT_AN_END and falls > 0.0:
                share = float(last.tests[test]) / falls
                point = last.point + share * (last.point - before.point)
                found.append((place, test, last._replace(point=point), last.point))
    return found


def _kind_of(test: int, step: _Step, frame: Frame, equations: Equations) -> str:
    """Return what a root of a test function is: where the law captures nothing, an impact that vanishes is a graze."""
    if test == _CAPTURE and equations.flights is None:
        _, shares = _split(jnp.asarray(step.point), equations)
        if float(loop_at(shares, frame, equations).impact.lowest) == 0.0:
            return KINDS[_GRAZING]
    return KINDS[test]


def _is_complex(step: _Step) -> bool:
    """Say whether the multipliers are a complex pair, given D = 1: |T| < 2."""
    return abs(float(step.tests[_DOUBLING] - step.tests[_FOLD])) < 4.0


def _test_function(test: int, equations: Equations) -> Callable[[_Step], float]:
    along = test == _FOLD and equations.kind is None

    def value(step: _Step) -> float:
        found = float(step.tangent[-1] if along else step.tests[test])
        return found if np.isfinite(found) else 1.0

    return value


def _root_on(
    leg: _CurveLeg, test: Callable[[_Step], float], frame: Frame, equations: Equations
) -> tuple[float, _Step] | None:
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
    return None if step is None or not abs(test(step)) < _ROOT else (share, step)


def _curves(
    special: Sequence[SpecialPoint], frame: Frame, equations: Equations, second: ParameterRange, own: float
) -> tuple[SpecialCurve, ...]:
    """Return the curves in two parameters through special points that the map flies, each once."""
    curves: list[tuple[int, _Way]] = []
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
        if not point.admissible or any(_lies_on(start, way, frame, own_equations) for way in passed):
            continue
        way = _both_ways(start, frame, own_equations)
        if way is not None:
            curves.append((point.test, way))
            found.append(_special_curve(point.kind, way, frame, own_equations))
    return tuple(found)


def _special_curve(kind: str, way: _Way, frame: Frame, equations: Equations) -> SpecialCurve:
    low, width = np.asarray(frame.low), np.asarray(frame.width)

    def at(step: _Step) -> np.ndarray:
        return low + width * step.point[-2:]

    meetings = []
    for leg, _ in way.places():
        for test in range(len(KINDS)):
            # an impact without speed, or of a captured tip, has no linearised map
            if test == equations.kind or (equations.kind == _CAPTURE and test != _GRAZING):
                continue
            root = _root_on(leg, _test_function(test, equations), frame, equations)
            if root is not None:
                name = f"{kind}_{_kind_of(test, root[1], frame, equations)}"
                meetings.append(Meeting(name, *at(root[1]).tolist()))
        if equations.kind == _FOLD and equations.flights is None:
            root = _root_on(leg, _cusp_function(leg, frame, equations), frame, equations)
            if root is not None:
                meetings.append(Meeting("cusp", *at(root[1]).tolist()))
    values = np.stack([at(step) for step in way.steps])
    if equations.kind in (_GRAZING, _CAPTURE):
        # they are the border of what the map flies: only the other border can be passed
        other = np.array([step.tests[_GRAZING + _CAPTURE - equations.kind] for step in way.steps])
        admissible = ~(other < -_ROOT)
    else:
        admissible = np.asarray(read_points(way.points, frame, equations).admissible)
    return SpecialCurve(kind, values[:, 0], values[:, 1], admissible, tuple(meetings), way.ends)


def _cusp_function(leg: _CurveLeg, frame: Frame, equations: Equations) -> Callable[[_Step], float]:
    """Return the test function of cusps: how the fold bends, its sign kept along the leg."""
    _, towards = (np.asarray(part) for part in _bend_of_fold(frame, jnp.asarray(leg.begin.point), equations))

    def value(step: _Step) -> float:
        bend, normal = (np.asarray(part) for part in _bend_of_fold(frame, jnp.asarray(step.point), equations))
        return float(bend) * (1.0 if normal @ towards > 0.0 else -1.0)

    return value


@partial(jax.jit, static_argnames=("equations",))
def _bend_of_fold(frame: Frame, point: Array, equations: Equations) -> tuple[Array, Array]:
    """Return w R_xx v v and w R_p of a fold, v and w its null vectors: the bend across it, and what unfolds it."""
    unknowns, shares = _split(point, equations)

    def gaps(unknowns, shares):
        return closing_gaps(unknowns, frame.scale, loop_at(shares, frame, equations))

    left, _, right = jnp.linalg.svd(jax.jacfwd(gaps)(unknowns, shares))
    null, across = right[-1], left[:, -1]
    _, bend = jax.jvp(lambda x: jax.jvp(lambda y: gaps(y, shares), (x,), (null,))[1], (unknowns,), (null,))
    return across @ bend, across @ jax.jacfwd(lambda s: gaps(unknowns, s))(shares)
