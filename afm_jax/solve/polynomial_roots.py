"""All real roots of a polynomial in an interval, none missed: between critical points a polynomial is monotone.

Takes coefficients and an interval, without units; gives roots in slots, and which slots hold one.

The critical points are the roots of the derivative, found in the same way, down to the quadratic with its formula. The
search vectorises over `vmap`, and needs no eigenvalues of companion matrices, which run on a CPU alone and lose half
the digits at double roots.
"""

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

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
    inner, _ = real_roots(jnp.polyder(coefficients), low, high)
    knots = jnp.concatenate([low[None], inner, high[None]])
    return _monotone_roots(coefficients, knots[:-1], knots[1:])


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
    first_derivative = jnp.polyder(coefficients)
    second_derivative = jnp.polyder(first_derivative)
    value_left, value_right = jnp.polyval(coefficients, left), jnp.polyval(coefficients, right)
    # A root on a knot belongs to the interval on its left; one on `low` itself to the first interval.
    first = jnp.arange(left.shape[0]) == 0
    inside = value_left * value_right < 0.0
    found = inside | ((value_right == 0.0) & (left < right)) | (first & (value_left == 0.0))
    rising = value_right > value_left

    def unsettled(state):
        step, _, _, x, move = state
        # Laguerre's method needs about 5; bisection alone over the widest interval about 100
        return (step < 200) & jnp.any(jnp.abs(move) > _SETTLED * jnp.abs(x))

    def narrow(state):
        step, a, b, x, move = state
        value, slope = jnp.polyval(coefficients, x), jnp.polyval(first_derivative, x)
        bend = jnp.polyval(second_derivative, x)
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
