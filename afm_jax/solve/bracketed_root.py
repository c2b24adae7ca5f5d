"""A root of a function of one number between two places where its signs differ (Brent's method)."""

from collections.abc import Callable

import numpy as np


def bracketed_root(function: Callable[[float], float], low: float, high: float, *, tolerance: float) -> float:
    """Return where a continuous function is 0 between two numbers, either of which may be the larger.

    Args:
        function: from a number to a number.
        low: one end of the bracket.
        high: the other end; the function has the other sign there.
        tolerance: absolute, of the root.

    Raises:
        ValueError: if the function has one sign at both ends, or is NaN on the way.
    """
    from scipy.optimize import brentq  # noqa: PLC0415 (half a second, seldom needed)

    return float(np.asarray(brentq(function, low, high, xtol=tolerance)))
