"""Sine and cosine together, as polynomials that vectorise.

Takes an angle in rad; gives both, differentiable.

XLA's float64 sine and cosine on a CPU are scalar library calls of 10-14 ns an element; the pair below costs about
2 ns in a vectorised loop, which is a factor of four in the impact map. Accuracy: 1 unit in the last place of 1, plus
the rounding of the argument itself.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

# pi/2 in three parts of 33 bits (fdlibm), so that multiples up to 2^20 are exact, and a remainder.
_HALF_PI_PARTS = (1.57079632673412561417e00, 6.07710050630396597660e-11, 2.02226624879595063154e-21)
_TWO_OVER_PI = 6.36619772367581382433e-01
# Minimax coefficients on [-pi/4, pi/4] (fdlibm's kernels, highest power first).
_SINE = (
    1.58969099521155010221e-10,
    -2.50507602534068634195e-08,
    2.75573137070700676789e-06,
    -1.98412698298579493134e-04,
    8.33333333332248946124e-03,
    -1.66666666666666324348e-01,
)
_COSINE = (
    -1.13596475577881948265e-11,
    2.08757232129817482790e-09,
    -2.75573143513906633035e-07,
    2.48015872894767294178e-05,
    -1.38888888888741095749e-03,
    4.16666666666666019037e-02,
)


@jax.custom_jvp
def sine_cosine(angle: Float[Array, "..."]) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
    """Return the sine and the cosine of an angle in rad, each of the angle's shape.

    In float64 by polynomials after reduction to [-pi/4, pi/4]; other precisions use JAX's own functions.
    """
    if angle.dtype != jnp.float64:
        return jnp.sin(angle), jnp.cos(angle)
    quadrant = jnp.round(angle * _TWO_OVER_PI)
    rest = angle
    for part in _HALF_PI_PARTS:
        rest = rest - quadrant * part
    square = rest * rest
    sine = rest + rest * square * horner(_SINE, square)
    cosine = 1.0 - 0.5 * square + square * square * horner(_COSINE, square)
    # The quadrant modulo 4 in floating point: no integer overflow however large the angle is.
    turn = quadrant - 4.0 * jnp.floor(0.25 * quadrant)
    swapped = (turn == 1.0) | (turn == 3.0)
    sine, cosine = jnp.where(swapped, cosine, sine), jnp.where(swapped, sine, cosine)
    return jnp.where(turn >= 2.0, -sine, sine), jnp.where((turn == 1.0) | (turn == 2.0), -cosine, cosine)


@sine_cosine.defjvp
def _sine_cosine_jvp(primals, tangents):
    """Differentiate: d sin = cos, d cos = -sin; the polynomials' own derivatives would lose digits."""
    (angle,), (rate,) = primals, tangents
    sine, cosine = sine_cosine(angle)
    return (sine, cosine), (cosine * rate, -sine * rate)


def horner(coefficients: tuple[float, ...], x: Float[Array, "..."]) -> Float[Array, "..."]:
    """Return a polynomial's value at x, its coefficients given highest power first."""
    value = jnp.full_like(x, coefficients[0])
    for coefficient in coefficients[1:]:
        value = value * x + coefficient
    return value
