"""The way through the junction: conservative for a free tip, so that energy gives the speed and quadrature the time.

In s = sqrt(A) the JKR potential is a polynomial and the fold, where the contact breaks, is smooth. The turning point is
a root of that polynomial; the time from the point where the junction forms to the turning point and back, and on to the
fold, is integrated after substitutions that take the square roots out: s = s_turn - y^2 at the turning point, and
s = s_fold + sigma sinh(q) at the fold, where a tip that hardly gets away is slow.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from afm_jax.contact.forces import jkr
from afm_jax.contact.junction import Junction
from afm_jax.contact.passage_collocation import nodes_along


class JunctionWay(NamedTuple):
    """What the way through the junction ends with."""

    energy_aj: Float[Array, "..."]
    """Kinetic energy where the junction breaks, signed: negative by what is missing where it does not break."""
    time_us: Float[Array, "..."]
    """Time in the junction; meaningless where the energy is not positive."""
    deepest_gap_nm: Float[Array, "..."]
    """Gap at the turning point, negative where the tip indents the sample."""


def pass_through_junction(
    solid: jkr.Jkr, junction: Junction, energy_aj: Float[Array, "..."], mass_ng: Float[Array, "..."], nodes: int
) -> JunctionWay:
    """Return the way from the formation of the junction to its breaking.

    Args:
        solid: the JKR contact.
        junction: where it forms and breaks.
        energy_aj: kinetic energy where it forms, in aJ.
        mass_ng: mass of the tip in ng.
        nodes: number of Gauss nodes of each quadrature.
    """
    unit = solid.energy_scale_aj
    level = jkr.work(junction.forms_root) + jnp.maximum(energy_aj, 0.0) / unit
    turn = turning_root(level)
    leaving = energy_aj + unit * (jkr.work(junction.forms_root) - jkr.work(jkr.FOLD))
    # speeds in units of depth: K = m (scale dDelta/dt)^2 / 2 = unit * (level - work)
    pace = solid.depth_scale_nm * jnp.sqrt(0.5 * mass_ng / unit)
    inside = _time_to_turn(junction.forms_root, turn, nodes)
    outside = _time_to_fold(junction.forms_root, jnp.maximum(leaving, 0.0) / unit, nodes)
    deepest = junction.shift_nm - solid.depth_scale_nm * jkr.depth(turn)
    return JunctionWay(leaving, pace * (2.0 * inside + outside), deepest)


def turning_root(level: Float[Array, "..."]) -> Float[Array, "..."]:
    """Return the largest s at which the normalised work is `level`, by Newton's method from above.

    The work is convex to the right of its minimum at s = 6^(1/6), so that Newton's steps from above never pass the
    root. The last two carry the derivatives (two: first and second are right).
    """
    fixed = lax.stop_gradient(level)
    far = (2.5 * jnp.maximum(fixed, 0.0)) ** 0.1
    root = jnp.cbrt(far**3 + 3.4)
    for _ in range(7):
        root = _newton(root, fixed)
    return _newton(_newton(lax.stop_gradient(root), level), level)


def _newton(root: Float[Array, "..."], level: Float[Array, "..."]) -> Float[Array, "..."]:
    slope = jkr.load(root) * jkr.depth_slope(root)
    uphill = slope > 0.0
    return root - jnp.where(uphill, (jkr.work(root) - level) / jnp.where(uphill, slope, 1.0), 0.0)


def _time_to_turn(start: Float[Array, "..."], turn: Float[Array, "..."], nodes: int) -> Float[Array, "..."]:
    """Return the integral of dDelta / sqrt(work(turn) - work) from s = start to the turning point."""
    points, weights, _ = nodes_along(nodes, turn)
    distance = turn - start
    apart = distance > 0.0
    reach = jnp.where(apart, jnp.sqrt(jnp.where(apart, distance, 1.0)), 0.0)
    s = turn - (reach * points) ** 2
    return 2.0 * reach * jnp.tensordot(weights, jkr.depth_slope(s) / jnp.sqrt(mean_slope(turn, s)), axes=1)


def mean_slope(turn: Float[Array, "..."], s: Float[Array, "..."]) -> Float[Array, "..."]:
    """Return (work(turn) - work(s)) / (turn - s) without cancellation: sums of turn^k s^(n-1-k)."""
    total = jnp.zeros_like(s)
    for degree, factor in ((10, 0.4), (7, -jkr.SLOPE), (4, 1.0)):
        powers, power = jnp.ones_like(s), jnp.ones_like(s)
        for _ in range(degree - 1):
            power = power * s
            powers = powers * turn + power
        total = total + factor * powers
    return total


def _time_to_fold(start: Float[Array, "..."], leaving: Float[Array, "..."], nodes: int) -> Float[Array, "..."]:
    """Return the integral of dDelta / sqrt(leaving + work(fold) - work) from the fold to s = start."""
    points, weights, _ = nodes_along(nodes, leaving)
    # work(fold) - work(s) is _CURVATURE (s - fold)^2 to leading order
    width = jnp.sqrt(jnp.maximum(leaving, 1e-12) / _CURVATURE)
    reach = jnp.arcsinh((start - jkr.FOLD) / width)
    # sinh and cosh from one exponential: the library's own are ten times slower
    grown = jnp.exp(reach * points)
    s = jkr.FOLD + 0.5 * width * (grown - 1.0 / grown)
    kinetic = leaving + _work_below_fold(s)
    moving = kinetic > 0.0
    pace = jkr.depth_slope(s) * 0.5 * width * (grown + 1.0 / grown) / jnp.sqrt(jnp.where(moving, kinetic, 1.0))
    return reach * jnp.tensordot(weights, jnp.where(moving, pace, 0.0), axes=1)


# work' = P Delta' and Delta'(fold) = 0, so that work''(fold) = P(fold) Delta''(fold) = P(fold) 12 fold^2
_CURVATURE = -6.0 * (jkr.FOLD**6 - 6.0**0.5 * jkr.FOLD**3) * jkr.FOLD**2


def _work_below_fold(s: Float[Array, "..."]) -> Float[Array, "..."]:
    """Return work(fold) - work(s)."""
    return jkr.work(jkr.FOLD) - jkr.work(s)
