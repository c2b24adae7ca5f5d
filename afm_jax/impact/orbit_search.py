"""Where the orbits are: every root of the closing condition, without and with a collision delay."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from afm_jax.impact.orbit_closure import (
    OrbitProblem,
    capture_coordinate,
    closing_residual,
    closure,
    instantaneous_quartic,
    speeds_at,
)
from afm_jax.impact.polynomial_roots import real_roots

_SLOTS = 16
SCAN_POINTS = 8192
"""Coordinates at which the delayed closing condition is scanned: some 500 to the decade of approach speed."""
_BISECTIONS = 60


class OrbitRoots(NamedTuple):
    """Roots of the closing condition.

    ``coordinate`` in nm/us and ``found``, one a slot; ``complete``: there were no more roots than slots.
    """

    coordinate: Float[Array, " slots"]
    found: Bool[Array, " slots"]
    complete: Bool[Array, ""]


def find_roots(problem: OrbitProblem) -> OrbitRoots:
    """Return all coordinates of orbits, ascending in approach speed, without derivatives; harmless ones elsewhere."""
    problem = lax.stop_gradient(problem)
    driven = (problem.platform.amplitude_nm > 0.0) & (problem.platform.offset_rate_nm_per_us == 0.0)
    search = _quartic_roots if problem.law.delay is None else _scanned_roots
    coordinate, found, complete = search(problem)
    safe = jnp.where(found, coordinate, empty_coordinate(problem))
    regular = jax.vmap(closure, in_axes=(0, None))(safe, problem).regular
    return OrbitRoots(safe, found & driven & regular, complete)


def empty_coordinate(problem: OrbitProblem) -> Float[Array, ""]:
    """Return a coordinate for slots without a root: some speed well above capture, harmless to compute with."""
    return 2.0 * problem.platform.top_speed_nm_per_us + 2.0 * jnp.sqrt(problem.law.epsilon + 1.0)


def _quartic_roots(problem: OrbitProblem) -> OrbitRoots:
    """Solve (Y cosine)^2 + (Y sine)^2 = (Y determinant)^2, a quartic in Y over beta omega."""
    quartic = instantaneous_quartic(problem)
    scale = problem.platform.top_speed_nm_per_us
    low = capture_coordinate(problem.law) / scale
    # Cauchy's bound; a quartic without leading term (no loss at exact resonance) has a root at infinity, not here.
    top = jnp.max(jnp.abs(quartic))
    leading = jnp.maximum(jnp.abs(quartic[0]), 1e-15 * top)
    high = jnp.maximum(1.0 + top / jnp.where(leading > 0.0, leading, 1.0), 2.0 * low + 1.0)
    roots, found = real_roots(quartic, low, high)
    return OrbitRoots(roots * scale, found & (roots > low), jnp.array(True))  # noqa: FBT003


def _scanned_roots(problem: OrbitProblem) -> OrbitRoots:
    """Scan the delayed closing condition, split intervals that hold an extremum, bisect every bracket.

    A delay as long as a drive period is no brief impact any more (the lead grows without bound towards capture): such
    coordinates are left out.
    """
    grid = _scan_grid(problem)
    residual = jax.vmap(closing_residual, in_axes=(0, None))
    value, slope = jax.vmap(jax.value_and_grad(closing_residual), in_axes=(0, None))(grid, problem)
    left, right = grid[:-1], grid[1:]
    # Two close roots leave no sign change but an extremum between: the secant of the slopes says where.
    bends = (value[:-1] * slope[:-1] < 0.0) & (value[1:] * slope[1:] > 0.0)
    share = slope[:-1] / jnp.where(slope[:-1] != slope[1:], slope[:-1] - slope[1:], 1.0)
    middle = left + (right - left) * jnp.where(bends, jnp.clip(share, 0.01, 0.99), 0.5)
    inner = residual(middle, problem)
    ends = jnp.stack([left, middle], 1).ravel(), jnp.stack([middle, right], 1).ravel()
    values = jnp.stack([value[:-1], inner], 1).ravel(), jnp.stack([inner, value[1:]], 1).ravel()
    delay = jax.vmap(lambda y: speeds_at(y, problem.law).delay)(ends[0])
    brief = jnp.abs(delay) < problem.platform.period_us
    bracket = (values[0] * values[1] < 0.0) & brief
    chosen = jnp.nonzero(bracket, size=_SLOTS, fill_value=0)[0]
    count = jnp.sum(bracket)
    found = jnp.arange(_SLOTS) < count
    root = _bisect(lambda y: residual(y, problem), ends[0][chosen], ends[1][chosen], values[0][chosen])
    return OrbitRoots(root, found, count <= _SLOTS)


def _scan_grid(problem: OrbitProblem) -> Float[Array, " points"]:
    """Return coordinates from just above capture to speeds that no orbit reaches, dense in the logarithm of Y - q."""
    scale = problem.platform.top_speed_nm_per_us
    low = capture_coordinate(problem.law)
    spread = jnp.geomspace(1e-7, 1e5, SCAN_POINTS)
    # From q on in steps of the drive's speed, and of q itself where q is the smaller one.
    return low + spread * jnp.maximum(scale, low)


def _bisect(residual, left, right, value_left) -> Float[Array, " slots"]:
    def halve(_, ends):
        a, b = ends
        middle = 0.5 * (a + b)
        same = residual(middle) * value_left > 0.0
        return jnp.where(same, middle, a), jnp.where(same, b, middle)

    a, b = lax.fori_loop(0, _BISECTIONS, halve, (left, right))
    return 0.5 * (a + b)
