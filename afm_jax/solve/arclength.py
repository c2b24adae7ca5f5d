"""A point of a curve of solutions: Newton's method in a plane, and the tangent there (pseudo-arclength continuation).

n equations in n + 1 unknowns have curves of solutions. A step along the tangent is a guess; Newton's method comes back
to the curve in the plane through the guess, across the tangent. It passes folds, where the parameter turns back.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float


class EquationsAt(NamedTuple):
    """The equations at a point."""

    value: Float[np.ndarray, " n"]
    slopes: Float[np.ndarray, "n unknowns"]
    """Derivatives by all unknowns."""
    facts: Any
    """What else is known there."""


class PointInPlane(NamedTuple):
    """Where Newton's method ended."""

    point: Float[np.ndarray, " unknowns"]
    moved: float
    """Largest part of the move that Newton's method would make from there: the error."""
    tangent: Float[np.ndarray, " unknowns"]
    """Of the curve, of length 1, along the plane's normal."""
    facts: Any
    """What else the equations know at the point."""


def point_in_plane(
    linearised: Callable[[Float[np.ndarray, " unknowns"]], EquationsAt | None],
    guess: Float[np.ndarray, " unknowns"],
    normal: Float[np.ndarray, " unknowns"],
    *,
    arrived: float,
    steps: int,
) -> PointInPlane | None:
    """Return where a curve meets the plane through a guess across a normal; None where the equations have no value.

    Args:
        linearised: the equations and their derivatives at a point.
        guess: point near the curve.
        normal: of the plane.
        arrived: largest part of a move that ends the search.
        steps: most of them.
    """
    point, unit = guess, np.eye(len(guess))[-1]
    for step in range(steps):
        known = linearised(point)
        if known is None:
            return None
        right = np.stack([np.append(known.value, normal @ (point - guess)), unit], axis=1)
        try:
            move, tangent = np.linalg.solve(np.vstack([known.slopes, normal]), right).T
        except np.linalg.LinAlgError:
            return None
        moved = float(np.abs(move).max())
        if not moved > arrived or step == steps - 1:
            return PointInPlane(point, moved, tangent / np.linalg.norm(tangent), known.facts)
        point = point - move
    return None
