"""Where the orbits are: every root of the closing condition.

Two finders. Without a delay the condition is a quartic, of which no root can be missed. With one it is scanned: every
change of sign between neighbours of the scan, and every pair of roots that it stepped over, seen by the extremum
between them.

All real roots of a polynomial in an interval, none missed: between critical points a polynomial is monotone.

The critical points are the roots of the derivative, found the same way, down to the quadratic with its formula.
Vectorises over `vmap`; no eigenvalues of companion matrices, which need a CPU and lose half the digits at double roots.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from afm_jax.impact.closure import (
    OrbitPlace,
    OrbitProblem,
    close_map,
    closing_residual,
    closure,
    instantaneous_quartic,
    place_of,
)
from afm_jax.impact.lasting_impact import PulledImpact
from afm_jax.impact.law import ImpactLaw

_MAX_STEPS = 200  # Laguerre's method needs about 5; bisection alone over the widest interval about 100
_SETTLED = 1e-12  # the last relative step; it has been cubed by then


def real_roots(
    coefficients: Float[Array, " n"], low: Float[Array, ""], high: Float[Array, ""]
) -> tuple[Float[Array, " m"], Bool[Array, " m"]]:
    """Return the real roots in [low, high] and which of them exist.

    Args:
        coefficients: highest power first, degree n - 1 >= 2; leading zeros are fine.
        low: lower end.
        high: upper end, not below `low`.

    Returns:
        m = n - 1 slots in ascending order: the root, or the slot's upper knot where it holds none; and the mask.
    """
    if coefficients.shape[0] == 3:
        return _quadratic_roots(coefficients, low, high)
    inner, _ = real_roots(_derivative(coefficients), low, high)
    knots = jnp.concatenate([low[None], inner, high[None]])
    return _monotone_roots(coefficients, knots[:-1], knots[1:])


def evaluate(coefficients: Float[Array, " n"], x: Float[Array, " m"]) -> Float[Array, " m"]:
    """Return the polynomial's values (Horner)."""
    value = jnp.full_like(x, coefficients[0])
    for index in range(1, coefficients.shape[0]):
        value = value * x + coefficients[index]
    return value


def _derivative(coefficients: Float[Array, " n"]) -> Float[Array, " m"]:
    return coefficients[:-1] * jnp.arange(coefficients.shape[0] - 1, 0, -1, dtype=coefficients.dtype)


def _quadratic_roots(coefficients: Float[Array, " 3"], low, high):
    """The formula without cancellation: the larger root by it, the other one by the product of both."""
    a, b, c = coefficients
    discriminant = b * b - 4.0 * a * c
    real = discriminant >= 0.0
    half = -0.5 * (b + jnp.where(b < 0.0, -1.0, 1.0) * jnp.sqrt(jnp.where(real, discriminant, 0.0)))
    first = jnp.where(a != 0.0, half / jnp.where(a != 0.0, a, 1.0), high)
    second = jnp.where(half != 0.0, c / jnp.where(half != 0.0, half, 1.0), first)
    roots = jnp.sort(jnp.where(real, jnp.stack([first, second]), high))
    exists = real & (roots >= low) & (roots <= high)
    return jnp.clip(roots, low, high), exists & ((a != 0.0) | (roots == second))


def _monotone_roots(coefficients, left: Float[Array, " m"], right: Float[Array, " m"]):
    """Laguerre's method kept inside a shrinking bracket, on every interval at once."""
    degree = coefficients.shape[0] - 1
    first_derivative = _derivative(coefficients)
    second_derivative = _derivative(first_derivative)
    value_left, value_right = evaluate(coefficients, left), evaluate(coefficients, right)
    # A root on a knot belongs to the interval on its left; one on `low` itself to the first interval.
    first = jnp.arange(left.shape[0]) == 0
    inside = value_left * value_right < 0.0
    found = inside | ((value_right == 0.0) & (left < right)) | (first & (value_left == 0.0))
    rising = value_right > value_left

    def unsettled(state):
        step, _, _, x, move = state
        return (step < _MAX_STEPS) & jnp.any(jnp.abs(move) > _SETTLED * jnp.abs(x))

    def narrow(state):
        step, a, b, x, move = state
        value, slope = evaluate(coefficients, x), evaluate(first_derivative, x)
        bend = evaluate(second_derivative, x)
        beyond = (value > 0.0) == rising
        a, b = jnp.where(beyond, a, x), jnp.where(beyond, x, b)
        square = (degree - 1) * ((degree - 1) * slope**2 - degree * value * bend)
        divisor = slope + jnp.where(slope < 0.0, -1.0, 1.0) * jnp.sqrt(jnp.maximum(square, 0.0))
        nearer = jnp.where(divisor != 0.0, -degree * value / jnp.where(divisor != 0.0, divisor, 1.0), jnp.inf)
        # Bisect where a step would leave the bracket or is more than half the last; the last ones are rounding.
        quick = (x + nearer >= a) & (x + nearer <= b) & (jnp.abs(2.0 * nearer) <= jnp.abs(move))
        trusted = quick | (jnp.abs(nearer) <= _SETTLED * jnp.abs(x))
        move = jnp.where(trusted, nearer, 0.5 * (a + b) - x)
        move = jnp.where(inside & (value != 0.0), move, 0.0)
        return step + 1, a, b, x + move, move

    width = jnp.where(inside, right - left, 0.0)
    _, _, _, root, _ = lax.while_loop(unsettled, narrow, (0, left, right, 0.5 * (left + right), width))
    root = jnp.where(first & (value_left == 0.0), left, jnp.where(value_right == 0.0, right, root))
    return jnp.where(found, root, right), found


_LEAVING = 0.4
"""Share of the drive's period that a leaving tip may take to lose its energy: beyond, no law of impacts holds."""
_REGULA_FALSI, _BEFORE_NEWTON = 20, 10
"""Steps towards a root of the scalar condition: to its last digit, and to where Newton's method goes on."""
_SECTIONS = 16
_GOLDEN = 0.6180339887498949
_NEWTON = 6
_SAME = 1e-7
"""Relative difference of approach speeds below which roots are one."""
_CLOSED = 1e-9
"""By how much a turn of the map may miss its start, in units of the drive: near a fold rounding leaves as much."""


class Scan(NamedTuple):
    """How closely the closing condition is looked at."""

    points: int
    """Coordinates, at equal ratios of their distance from capture."""
    lowest: float
    """Distance from capture at which they begin, in terms of the drive's speed or the capture coordinate."""
    highest: float
    crossings: int
    """Changes of sign that are followed."""
    turns: int
    """Extrema without one that are looked at for a pair of roots."""
    slots: int
    """Roots there is room for."""
    within: int = 0
    """Coordinates at which an interval with a change of sign is looked at again, `points/crossings`; 0: it is not."""


FINE = Scan(8192, 1e-7, 1e5, crossings=16, turns=6, slots=16)
"""Some 680 points to the decade: for whoever asks for all orbits."""
COARSE = Scan(512, 1e-3, 1e4, crossings=6, turns=2, slots=10)
"""Some 70 to the decade: for fits, which search a hundred thousand times."""
TAPPED = Scan(192, 1e-2, 3.0, crossings=6, turns=2, slots=6, within=32)
"""Of taps, each of which takes long to look up, and none of which is much faster than the drive. From light to hard
ones the condition jumps: to either side of that there may be an orbit, and between neighbours of the scan both."""


class OrbitRoots(NamedTuple):
    """Roots of the closing condition.

    ``place`` and ``found``, one a slot; ``complete``: there were no more roots than slots.
    """

    place: OrbitPlace
    found: Bool[Array, " slots"]
    complete: Bool[Array, ""]


def find_roots(problem: OrbitProblem, scan: Scan = FINE) -> OrbitRoots:
    """Return all places of orbits, ascending in approach speed, without derivatives; harmless ones elsewhere.

    Args:
        problem: what orbits are of.
        scan: how closely is looked where there is a delay; without one there are 4 slots.
    """
    problem = lax.stop_gradient(problem)
    driven = (problem.platform.amplitude_nm > 0.0) & (problem.platform.offset_rate_nm_per_us == 0.0)
    coordinate, found, complete = _quartic_roots(problem) if _is_quartic(problem) else _scanned_roots(problem, scan)
    safe = jnp.where(found, coordinate, harmless_coordinate(problem))
    if problem.impact.lasts:
        place, there = jax.vmap(follow_root, in_axes=(0, None, 0))(safe, problem, found)
    else:
        place, there = jax.vmap(_regular, in_axes=(0, None))(safe, problem)
    found = found & driven & there
    if problem.impact.lasts:
        found = found & ~_seen_before(place.coordinate, found)
    return OrbitRoots(OrbitPlace(jnp.where(found, place.coordinate, safe), place.phase), found, complete)


@jax.jit
def follow_root(
    near: Float[Array, ""], problem: OrbitProblem, wanted: Bool[Array, ""]
) -> tuple[OrbitPlace, Bool[Array, ""]]:
    """Return where the map of a lasting impact closes, close to a coordinate, and whether it does; if that is asked."""
    problem = lax.stop_gradient(problem)
    speeds, system = closure(near, problem)
    closed = close_map(place_of(near, speeds, system, problem), problem, _NEWTON, wanted)
    return OrbitPlace(*closed.unknowns), system.regular & jnp.all(jnp.abs(closed.gaps) < _CLOSED)


def _is_quartic(problem: OrbitProblem) -> bool:
    """Say whether the closing condition is a quartic: that of the formula without a delay."""
    return isinstance(problem.impact, ImpactLaw) and not problem.impact.delayed


def _seen_before(coordinate: Float[Array, " slots"], found: Bool[Array, " slots"]) -> Bool[Array, " slots"]:
    """Say which roots are those of an earlier slot: from two brackets Newton's method may come to one orbit."""
    same = jnp.abs(coordinate[:, None] - coordinate) <= _SAME * coordinate
    return jnp.any(jnp.tril(same & found, k=-1), axis=1)


def harmless_coordinate(problem: OrbitProblem) -> Float[Array, ""]:
    """Return a coordinate for slots without a root: some speed well above capture, harmless to compute with."""
    return problem.impact.lowest + 2.0 * _scale(problem) + 2.0


def _regular(coordinate: Float[Array, ""], problem: OrbitProblem) -> tuple[OrbitPlace, Bool[Array, ""]]:
    """Return the place at a root, and whether the phase is determined there."""
    speeds, system = closure(coordinate, problem)
    return place_of(coordinate, speeds, system, problem), system.regular


class _Coordinates(NamedTuple):
    """Roots of the scalar condition: coordinates, which of them are some, and whether those are all."""

    coordinate: Float[Array, " slots"]
    found: Bool[Array, " slots"]
    complete: Bool[Array, ""]


def _quartic_roots(problem: OrbitProblem) -> _Coordinates:
    """Solve (Y cosine)^2 + (Y sine)^2 = (Y determinant)^2, a quartic in Y over beta omega."""
    quartic = instantaneous_quartic(problem)
    scale = problem.platform.top_speed_nm_per_us
    low = problem.impact.lowest / scale
    # Cauchy's bound; a quartic without leading term (no loss at exact resonance) has a root at infinity, not here.
    top = jnp.max(jnp.abs(quartic))
    leading = jnp.maximum(jnp.abs(quartic[0]), 1e-15 * top)
    high = jnp.maximum(1.0 + top / jnp.where(leading > 0.0, leading, 1.0), 2.0 * low + 1.0)
    roots, found = real_roots(quartic, low, high)
    return _Coordinates(roots * scale, found & (roots > low), jnp.array(True))  # noqa: FBT003


def _scale(problem: OrbitProblem) -> Float[Array, ""]:
    return jnp.maximum(problem.platform.top_speed_nm_per_us, problem.impact.reach)


def _scanned_roots(problem: OrbitProblem, scan: Scan) -> _Coordinates:
    """Scan the closing condition from just above capture to speeds that no orbit reaches; narrow every bracket."""
    grid = problem.impact.lowest + jnp.asarray(np.geomspace(scan.lowest, scan.highest, scan.points)) * _scale(problem)
    looked = _looked_closer(grid, problem, scan) if scan.within else (_look(grid, problem),) * 2
    crossing = [_changes(at.value, at.brief) for at in looked]
    if scan.within:
        # from one interval to the next there is nothing
        own = np.arange(1, scan.points) % scan.within != 0
        crossing[1] = crossing[1] & own & jnp.repeat(_inside(crossing[0], scan)[1], scan.within)[1:]
    (grid, value, brief), closer = looked
    root, found = _narrowed(
        _crossings(crossing[1], closer.grid, closer.value, scan), _dips(brief, grid, value, scan), problem
    )
    # the fastest ones if there are too many
    fastest = jnp.argsort(jnp.where(found, -root, jnp.inf))[: scan.slots]
    order = fastest[jnp.argsort(jnp.where(found[fastest], root[fastest], jnp.inf))]
    few = jnp.all(jnp.stack([jnp.sum(one) for one in crossing]) <= scan.crossings) & (jnp.sum(found) <= scan.slots)
    return _Coordinates(root[order], found[order], few)


class _Looked(NamedTuple):
    """Coordinates, the residuals there, and whether impacts are over soon."""

    grid: Float[Array, " points"]
    value: Float[Array, " points"]
    brief: Bool[Array, " points"]


def _look(grid: Float[Array, " points"], problem: OrbitProblem) -> _Looked:
    speeds, system = jax.vmap(closure, in_axes=(0, None))(grid, problem)
    value = jax.vmap(lambda system: system.residual)(system)
    if isinstance(problem.impact, PulledImpact):
        # a bent lever pulls the tip out of the bridge
        return _Looked(grid, value, jnp.abs(speeds.delay) < 0.5 * problem.platform.period_us)
    return _Looked(grid, value, jax.vmap(_brief, in_axes=(0, None))(grid, problem))


def _looked_closer(grid: Float[Array, " points"], problem: OrbitProblem, scan: Scan) -> tuple[_Looked, _Looked]:
    """Look at a scan, and at the intervals where it changes its sign: one after the other, ascending."""

    def again(_, state):
        grid, _, last = state
        here = _look(grid, problem)
        at, _ = _inside(_changes(here.value, here.brief), scan)
        share = jnp.linspace(0.0, 1.0, scan.within)
        return (grid[at, None] + share * (grid[at + 1] - grid[at])[:, None]).ravel(), last, here

    # a loop, because the residual is compiled for every use of it
    nothing = _Looked(grid, jnp.zeros_like(grid), jnp.zeros(grid.shape, bool))
    return lax.fori_loop(0, 2, again, (grid, nothing, nothing))[1:]


def _changes(value: Float[Array, " points"], brief: Bool[Array, " points"]) -> Bool[Array, " intervals"]:
    return (value[:-1] * value[1:] < 0.0) & brief[:-1] & brief[1:]


def _inside(crossing: Bool[Array, " intervals"], scan: Scan) -> tuple[Array, Array]:
    """Return where the changes of sign are, ascending, the fastest ones if there are too many, and which are some."""
    at = crossing.shape[0] - 1 - jnp.nonzero(crossing[::-1], size=scan.crossings, fill_value=0)[0]
    return at[::-1], (jnp.arange(scan.crossings) < jnp.sum(crossing))[::-1]


def _brief(coordinate: Float[Array, ""], problem: OrbitProblem) -> Bool[Array, ""]:
    """Say whether an impact is over soon: the lead grows without bound towards capture.

    One that lasts must end within half a drive period, and the tip have lost its energy by then.
    """
    period = problem.platform.period_us
    speeds = problem.impact.speeds(coordinate)
    if not problem.impact.lasts:
        return jnp.abs(speeds.delay) < period
    return (jnp.abs(speeds.delay) < 0.5 * period) & (
        problem.impact.hertz_contact.length_nm / speeds.rebound < _LEAVING * period
    )


class _Brackets(NamedTuple):
    """Ends of intervals and the residuals there; which of them are some."""

    left: Float[Array, " n"]
    right: Float[Array, " n"]
    low: Float[Array, " n"]
    high: Float[Array, " n"]
    real: Bool[Array, " n"]

    def kept(self, harmless: Float[Array, ""]) -> "_Brackets":
        """Return them with the others empty: values 0, at a harmless coordinate."""
        left, right = (jnp.where(self.real, end, harmless) for end in self[:2])
        low, high = (jnp.where(self.real, end, 0.0) for end in self[2:4])
        return _Brackets(left, right, low, high, self.real)


class _Dips(NamedTuple):
    """Three neighbours of one sign each, the middle one closest to zero: the extremum may lie beyond."""

    ends: _Brackets
    middle: Float[Array, " n"]
    """The residual there."""


def _crossings(crossing: Bool[Array, " intervals"], grid, value, scan: Scan) -> _Brackets:
    """Return the changes of sign, the fastest ones if there are too many: close to capture the law itself ends."""
    at, real = _inside(crossing, scan)
    return _Brackets(grid[at], grid[at + 1], value[at], value[at + 1], real)


def _dips(brief: Bool[Array, " points"], grid, value, scan: Scan) -> _Dips:
    """Return where the scan may have stepped over a pair of roots."""
    size = jnp.abs(value)
    same = (value[:-2] * value[1:-1] > 0.0) & (value[1:-1] * value[2:] > 0.0)
    dip = same & (size[1:-1] <= size[:-2]) & (size[1:-1] <= size[2:]) & brief[1:-1]
    at, real = _lowest_of(jnp.where(dip, size[1:-1], jnp.inf), scan.turns)
    return _Dips(_Brackets(grid[at], grid[at + 2], value[at], value[at + 2], real), value[at + 1])


def _lowest_of(size: Float[Array, " n"], count: int) -> tuple[Array, Array]:
    """Return where the smallest numbers are, and which of them are finite."""

    def take(size, _):
        place = jnp.argmin(size)
        return size.at[place].set(jnp.inf), (place, jnp.isfinite(size[place]))

    _, (at, real) = lax.scan(take, size, None, length=count)
    return at, real


def _narrowed(crossings: _Brackets, dips: _Dips, problem: OrbitProblem) -> tuple[Array, Array]:
    """Return the root of every bracket, and which there are: of changes of sign, then left and right in every dip.

    Changes of sign are narrowed by the Illinois method: the newer end stays, the other one loses weight. In a dip a
    golden section goes to the extremum first, with both inner points at once in the places of the two roots to either
    side of it. All in one loop, because the residual is compiled for every use of it.
    """
    residual = jax.vmap(closing_residual, in_axes=(0, None))
    harmless = harmless_coordinate(problem)
    count, turns = crossings.left.shape[0], dips.middle.shape[0]
    sign = jnp.sign(dips.middle)
    waits = jnp.arange(count + 2 * turns) >= count
    illinois = _BEFORE_NEWTON if problem.impact.lasts else _REGULA_FALSI

    def pairs(middle, bottom) -> _Brackets:
        """Return the brackets to either side of the extrema."""
        (left, right, low, high, real), across = dips.ends, bottom * dips.middle < 0.0
        columns = ((left, middle), (middle, right), (low, bottom), (bottom, high), (real & across, real & across))
        return _Brackets(*(jnp.concatenate(column) for column in columns)).kept(harmless)

    def narrow(step, state):
        brackets, (a, b) = state
        points = jnp.stack([b - _GOLDEN * (b - a), a + _GOLDEN * (b - a)])
        points = jnp.where(step < _SECTIONS, points, 0.5 * (a + b))
        gap = brackets.high - brackets.low
        chord = brackets.left * brackets.high - brackets.right * brackets.low
        x = jnp.where(gap == 0.0, brackets.left, chord / jnp.where(gap == 0.0, 1.0, gap))
        x = jnp.where(waits & (step <= _SECTIONS), jnp.pad(points.ravel(), (count, 0)), x)
        value = residual(x, problem)
        first, second = value[count:].reshape(2, -1) * sign
        inner = jnp.where(first < second, a, points[0]), jnp.where(first < second, points[1], b)
        passed = value * brackets.low < 0.0
        closer = _Brackets(
            x,
            jnp.where(passed, brackets.left, brackets.right),
            value,
            jnp.where(passed, brackets.low, 0.5 * brackets.high),
            brackets.real,
        )
        either = jax.tree.map(
            lambda head, tail: jnp.concatenate([head[:count], tail]), brackets, pairs(points[0], value[count:][:turns])
        )
        begun = jnp.where(waits, step > _SECTIONS, step < illinois)
        brackets = jax.tree.map(
            lambda new, found, old: jnp.where(begun, new, jnp.where(step == _SECTIONS, found, old)),
            closer,
            either,
            brackets,
        )
        return brackets, inner

    empty = jax.tree.map(lambda part: jnp.zeros((2 * turns,), part.dtype), dips.ends).kept(harmless)
    begin = jax.tree.map(lambda head, tail: jnp.concatenate([head, tail]), crossings.kept(harmless), empty)
    steps = _SECTIONS + 1 + illinois
    brackets, _ = lax.fori_loop(0, steps, narrow, (begin, (dips.ends.left, dips.ends.right)))
    return brackets.left, brackets.real
