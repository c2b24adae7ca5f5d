"""A Hertz contact under a constant pull: duration and indentation by quadrature, and how the code's series is made.

x'' = -x^(3/2) - kappa/T, x(0) = 0, x'(0) = 1, T = 3.2181 the time that it takes without a pull. Energy gives
x'^2 = 1 - 2 c x - (4/5) x^(5/2), c = kappa/T, and so every integral over the contact.

`python -m tests.reference_hertz` prints the coefficients that `afm_jax/impact/lasting_impact.py` holds.
"""

from collections.abc import Callable

import numpy as np
from scipy.integrate import quad
from scipy.optimize import brentq
from scipy.special import beta

DEEPEST = 1.25**0.4
"""Of x'' = -x^(3/2) from x = 0 at speed 1: 1/2 = (2/5) x^(5/2)."""
HERTZ_TIME = 0.8 * DEEPEST * beta(0.4, 0.5)


def under_pull(kappa: float, stiffness: float = 0.0) -> tuple[float, float]:
    """Return F, the duration over T, and H, the integral of x over T^2; with a spring, -stiffness x, too."""
    c, high = kappa / HERTZ_TIME, 1.0

    def squared_speed(x: float) -> float:
        return 1.0 - 2.0 * c * x - 0.8 * x**2.5 - stiffness * x * x

    while squared_speed(high) > 0.0:
        high *= 2.0
    turn: float = brentq(squared_speed, 0.0, high, xtol=1e-15)  # pyright: ignore[reportAssignmentType]

    def integral(weight: Callable[[float], float]) -> float:
        # x = turn (1 - s^2) takes the root out of the turning point
        def inner(s: float) -> float:
            x, below = turn * (1.0 - s * s), turn * s * s
            bend = (turn**2.5 - x**2.5) / below if below > 1e-9 * turn else 2.5 * turn**1.5
            return weight(x) * 4.0 * np.sqrt(turn) / np.sqrt(2.0 * c + 0.8 * bend + stiffness * (turn + x))

        return quad(inner, 0.0, 1.0, epsabs=1e-13, epsrel=1e-13)[0]

    return integral(lambda _: 1.0) / HERTZ_TIME, integral(lambda x: x) / HERTZ_TIME**2


def rational(degree: int, low: float, high: float) -> np.ndarray:
    """Return numerators of (F - 1)/kappa and H and the denominator of both, lowest power first, (3, degree + 1)."""
    kappa = 0.5 * (low + high) + 0.5 * (high - low) * np.cos(np.linspace(0.0, np.pi, 121))
    lasts, deep = np.array([under_pull(float(k)) for k in kappa]).T
    powers = kappa[:, None] ** np.arange(degree + 1)
    nothing, weight = np.zeros_like(powers), np.ones_like(kappa)
    found = np.zeros((3, degree + 1))
    for _ in range(60):
        # linear in all coefficients, with the last denominator as the weight: errors are relative to F and H
        over = powers * (kappa / lasts / weight)[:, None], powers / (deep * weight)[:, None]
        longer = ((lasts - 1.0) / lasts / weight)[:, None] * powers
        rows = [np.hstack([over[0], nothing, -longer[:, 1:]])]
        rows += [np.hstack([nothing, over[1], -(powers / weight[:, None])[:, 1:]])]
        matrix = np.vstack(rows)
        scale = np.linalg.norm(matrix, axis=0)
        solved = np.linalg.lstsq(matrix / scale, np.concatenate([longer[:, 0], 1.0 / weight]))[0] / scale
        found = np.insert(solved, 2 * (degree + 1), 1.0).reshape(3, -1)
        weight = np.abs(powers @ found[2])
    return found


if __name__ == "__main__":
    for row in rational(6, -3.0, 4.0):
        print("    (" + ", ".join(f"{number:.10e}" for number in row) + "),")
