"""Cubics through two points with slopes: where a step meets a threshold, or turns."""

import jax.numpy as jnp
from jaxtyping import Array, Float

_STEPS = 4


def crossing_share(start: Array, start_slope: Array, end: Array, end_slope: Array) -> Float[Array, "..."]:
    """Return the share of a step at which its cubic, from one side of 0 to the other, vanishes.

    Args:
        start: value at the start.
        start_slope: slope there, times the length of the step.
        end: value at the end, of the other sign.
        end_slope: slope there, times the length of the step.
    """
    bend = 3.0 * (end - start) - 2.0 * start_slope - end_slope
    twist = 2.0 * (start - end) + start_slope + end_slope
    share = start / jnp.where(start == end, 1.0, start - end)
    # written out: a few steps of Newton's method cost less than a loop, and a miss is only tried again
    for _ in range(_STEPS):
        value = start + share * (start_slope + share * (bend + share * twist))
        slope = start_slope + share * (2.0 * bend + 3.0 * share * twist)
        share = jnp.clip(share - value / jnp.where(slope == 0.0, 1.0, slope), 0.0, 1.0)
    return share


def turning_point(start: Array, start_slope: Array, end: Array, end_slope: Array) -> tuple[Array, Array]:
    """Return share and value of the extremum of a step's cubic whose slope changes sign; arguments as above."""
    bend = 3.0 * (end - start) - 2.0 * start_slope - end_slope
    twist = 2.0 * (start - end) + start_slope + end_slope
    # 3 twist x^2 + 2 bend x + start_slope = 0, the root between 0 and 1 in the form that does not cancel
    square = bend * bend - 3.0 * twist * start_slope
    real = square > 0.0
    root = jnp.where(real, jnp.sqrt(jnp.where(real, square, 1.0)), 0.0)
    below = jnp.where(start_slope > 0.0, root, -root) - bend
    share = start_slope / jnp.where(below == 0.0, 1.0, below)
    share = jnp.clip(share, 0.0, 1.0)
    return share, start + share * (start_slope + share * (bend + share * twist))
