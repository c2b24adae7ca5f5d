"""A point of a curve of solutions in a plane across the curve, and the tangent there (pseudo-arclength continuation).

Takes f with its derivatives, a guess and a normal, all without units; gives the point and the tangent.

n equations f in n + 1 unknowns x have curves of solutions. A step along the tangent is a guess; Newton's method for f
and the plane's equation, normal . (x - guess) = 0, comes back to the curve. It passes folds, where a parameter turns
back.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from afm_jax.solve.newton_rows import LinearisedRows, Newton, newton_rows

_CLOSING = Newton(rounds=12, step_tolerance=1e-11)


class EquationsAt(NamedTuple):
    """The equations of a curve at a point."""

    residual: Float[np.ndarray, " n"]
    slopes: Float[np.ndarray, "n unknowns"]
    """Derivatives of the residuals by all unknowns."""
    details: Any = None
    """What else the evaluation has found there."""


class PointInPlane(NamedTuple):
    """A point of a curve."""

    x: Float[np.ndarray, " unknowns"]
    tangent: Float[np.ndarray, " unknowns"]
    """Unit vector along the curve, on the side of the plane's normal."""
    details: Any
    """What the last evaluation of the equations has found besides, one Newton step before the point."""


def point_in_plane(
    equations: Callable[[Float[np.ndarray, " unknowns"]], EquationsAt | None],
    guess: Float[np.ndarray, " unknowns"],
    normal: Float[np.ndarray, " unknowns"],
) -> PointInPlane | None:
    """Return where a curve meets the plane through a guess across a normal; None where Newton's method finds no point.

    Args:
        equations: the equations and their derivatives at a point; None where they have no value.
        guess: point near the curve, in the plane.
        normal: of the plane.
    """

    def bordered(points: Float[np.ndarray, "1 unknowns"], _: Any) -> LinearisedRows:
        here = equations(points[0])
        if here is None:
            return LinearisedRows(np.full_like(points, np.nan), np.full((1, len(guess), len(guess)), np.nan))
        residual = np.append(here.residual, normal @ (points[0] - guess))
        slopes = np.vstack([here.slopes, normal])
        return LinearisedRows(residual[None], slopes[None], [(slopes, here.details)])

    root = newton_rows(bordered, guess[None], _CLOSING)
    if not root.converged[0]:
        return None
    slopes, details = root.details[0]
    along = np.linalg.solve(slopes, np.eye(len(guess))[-1])
    return PointInPlane(root.x[0], along / np.linalg.norm(along), details)
