"""All real roots of a polynomial in an interval, none missed: between critical points a polynomial is monotone.

The critical points are the roots of the derivative, found the same way, down to the quadratic with its formula.
Vectorises over `vmap`; no eigenvalues of companion matrices, which need a CPU and lose half the digits at double roots.
"""

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

_MAX_STEPS = 200  # Newton needs about 10; bisection alone over the widest interval about 100
_SETTLED = 1e-12  # the last relative step; Newton has squared it by then


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
    """Newton's method kept inside a shrinking bracket, on every interval at once."""
    derivative = _derivative(coefficients)
    value_left, value_right = evaluate(coefficients, left), evaluate(coefficients, right)
    # A root on a knot belongs to the interval on its left; one on `low` itself to the first interval.
    first = jnp.arange(left.shape[0]) == 0
    found = (value_left * value_right < 0.0) | ((value_right == 0.0) & (left < right)) | (first & (value_left == 0.0))
    rising = value_right > value_left

    def unsettled(state):
        step, _, _, x, move = state
        return (step < _MAX_STEPS) & jnp.any(jnp.abs(move) > _SETTLED * jnp.abs(x))

    def narrow(state):
        step, a, b, x, move = state
        value, slope = evaluate(coefficients, x), evaluate(derivative, x)
        beyond = (value > 0.0) == rising
        a, b = jnp.where(beyond, a, x), jnp.where(beyond, x, b)
        newton = -value / jnp.where(slope != 0.0, slope, 1.0)
        # Bisect where Newton would leave the bracket or shrinks its steps by less than half.
        slow = jnp.abs(2.0 * value) > jnp.abs(move * slope)
        trusted = (x + newton > a) & (x + newton < b) & ~slow & (slope != 0.0)
        move = jnp.where(trusted, newton, 0.5 * (a + b) - x)
        move = jnp.where(found & (value != 0.0), move, 0.0)
        return step + 1, a, b, x + move, move

    width = jnp.where(found, right - left, 0.0)
    _, _, _, root, _ = lax.while_loop(unsettled, narrow, (0, left, right, 0.5 * (left + right), width))
    root = jnp.where(first & (value_left == 0.0), left, jnp.where(value_right == 0.0, right, root))
    return jnp.where(found, root, right), found
