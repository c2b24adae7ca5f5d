"""Where the orbits of a lasting impact are: a scan of the closing condition, pairs of close roots included."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from afm_jax.impact.lasting_closure import LastingProblem, lasting_closure, lasting_residual

_CROSSINGS, _TURNS = 6, 2
"""Changes of sign that are followed, and extrema without one that are looked at for a pair of roots."""
SCAN_POINTS = 512
"""Coordinates scanned, some 70 to the decade."""
_LOWEST, _HIGHEST = 1e-3, 1e4
"""Distances from capture, in terms of the drive's speed."""
_LEAVING = 0.4
"""Share of the drive's period that a leaving tip may take to lose its energy: beyond, no law of impacts holds."""
_REGULA_FALSI = 14
_SECTIONS = 16
_GOLDEN = 0.6180339887498949
_NEWTON = 5


class LastingRoots(NamedTuple):
    """Coordinates in nm/us and which of them are roots; a harmless coordinate elsewhere."""

    coordinate: Float[Array, " slots"]
    found: Bool[Array, " slots"]


def find_lasting_roots(problem: LastingProblem) -> LastingRoots:
    """Return the roots of the closing condition, ascending but for close pairs, without derivatives."""
    problem = lax.stop_gradient(problem)
    scale = jnp.maximum(problem.platform.top_speed_nm_per_us, problem.impact.reach)
    spread = jnp.asarray(np.geomspace(_LOWEST, _HIGHEST, SCAN_POINTS))
    grid = problem.impact.lowest + spread * scale
    value = jax.vmap(lasting_residual, in_axes=(0, None))(grid, problem)
    brief = jax.vmap(_brief, in_axes=(0, None))(grid, problem)
    harmless = problem.impact.lowest + 2.0 * scale
    left, right, low, high = _brackets(grid, value, brief, problem, harmless)
    root = _regula_falsi(lambda x: jax.vmap(lasting_residual, in_axes=(0, None))(x, problem), left, right, low, high)
    return LastingRoots(root, low * high < 0.0)


def _brief(coordinate: Float[Array, ""], problem: LastingProblem) -> Bool[Array, ""]:
    """Say whether an impact is over soon: its delay, and the time in which a leaving tip loses its energy."""
    speeds = problem.impact.speeds(coordinate)
    leaving = problem.impact.length / speeds.rebound
    period = problem.platform.period_us
    return (jnp.abs(speeds.delay) < 0.5 * period) & (leaving < _LEAVING * period)


def follow_lasting_root(near: Float[Array, ""], problem: LastingProblem) -> LastingRoots:
    """Return the root close to a coordinate by Newton's method; not found where it does not settle nearby."""
    problem = lax.stop_gradient(problem)

    def improve(_, x):
        value, slope = jax.jvp(lambda y: lasting_residual(y, problem), (x,), (jnp.ones_like(x),))
        step = -value / jnp.where(slope == 0.0, jnp.inf, slope)
        reach = 0.3 * (x - problem.impact.lowest)
        return x + jnp.clip(step, -reach, reach)

    root = lax.fori_loop(0, _NEWTON, improve, near)
    settled = jnp.abs(lasting_residual(root, problem)) < 1e-9
    return LastingRoots(root, settled)


def regular(coordinate: Float[Array, ""], problem: LastingProblem) -> Bool[Array, ""]:
    """Say whether the phase is determined at a coordinate."""
    return lasting_closure(coordinate, problem).closure.regular


def _brackets(grid, value, brief, problem: LastingProblem, harmless) -> tuple[Array, Array, Array, Array]:
    """Return ends and values of intervals, last those of pairs that the grid stepped over; empty ones: 0."""
    crossing = (value[:-1] * value[1:] < 0.0) & brief[:-1] & brief[1:]
    # the fastest ones, if there are too many: close to capture the law itself ends
    at = crossing.shape[0] - 1 - jnp.nonzero(crossing[::-1], size=_CROSSINGS, fill_value=0)[0]
    real = jnp.arange(_CROSSINGS) < jnp.sum(crossing)
    parts = [_kept(real, harmless, grid[at], grid[at + 1], value[at], value[at + 1])]
    # three neighbours of one sign, the middle one closest to zero: the extremum may lie beyond
    size = jnp.abs(value)
    same = (value[:-2] * value[1:-1] > 0.0) & (value[1:-1] * value[2:] > 0.0)
    dip = same & (size[1:-1] <= size[:-2]) & (size[1:-1] <= size[2:]) & brief[1:-1]
    at = dip.shape[0] - 1 - jnp.nonzero(dip[::-1], size=_TURNS, fill_value=0)[0]
    turn, bottom = _extremum(at, grid, value, problem)
    real = (jnp.arange(_TURNS) < jnp.sum(dip)) & (bottom * value[at + 1] < 0.0)
    parts.append(_kept(real, harmless, grid[at], turn, value[at], bottom))
    parts.append(_kept(real, harmless, turn, grid[at + 2], bottom, value[at + 2]))
    left, right, low, high = (jnp.concatenate(columns) for columns in zip(*parts, strict=True))
    return left, right, low, high


def _kept(real, harmless, left, right, low, high) -> tuple[Array, Array, Array, Array]:
    """Return an interval where it is one, else an empty one at a harmless coordinate."""
    ends = jnp.where(real, left, harmless), jnp.where(real, right, harmless)
    return *ends, jnp.where(real, low, 0.0), jnp.where(real, high, 0.0)


def _extremum(at, grid, value, problem: LastingProblem) -> tuple[Array, Array]:
    """Return where the residual is closest to zero, or beyond, between a grid point and the one after next."""
    sign = jnp.sign(value[at + 1])

    height = jax.vmap(lambda x, sign: sign * lasting_residual(x, problem))

    def narrow(_, ends):
        # golden section, both inner points at once
        a, b = ends
        points = jnp.stack([b - _GOLDEN * (b - a), a + _GOLDEN * (b - a)])
        first, second = height(points.ravel(), jnp.tile(sign, 2)).reshape(2, -1)
        return jnp.where(first < second, a, points[0]), jnp.where(first < second, points[1], b)

    a, b = lax.fori_loop(0, _SECTIONS, narrow, (grid[at], grid[at + 2]))
    middle = 0.5 * (a + b)
    return middle, sign * height(middle, sign)


def _regula_falsi(residual, left, right, low, high) -> Float[Array, " slots"]:
    """Return the root of every bracket by the Illinois method: the newer end stays, the other one loses weight."""

    def narrow(_, ends):
        a, b, fa, fb = ends
        gap = fb - fa
        x = jnp.where(gap == 0.0, a, (a * fb - b * fa) / jnp.where(gap == 0.0, 1.0, gap))
        fx = residual(x)
        passed = fx * fa < 0.0
        return x, jnp.where(passed, a, b), fx, jnp.where(passed, fa, 0.5 * fb)

    return lax.fori_loop(0, _REGULA_FALSI, narrow, (left, right, low, high))[0]
