"""Periodic motions of many scenes by Newton's method: starts that come back to themselves after a response period."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

_STEPS = 12
_CLOSED = 1e-9
"""Distance from closing, of the motion's size, at which the start is found."""
_DIFFERENCE = 1e-5
"""Of the motion's size: between the error of a simulated period, 1e-9 of it, and the map's curvature."""
_STABLE = 0.9999
"""Largest modulus of a multiplier that counts as stable, being known to 1e-4."""


class Periodic(NamedTuple):
    """Where a search ended, one column a row."""

    starts: Float[np.ndarray, "3 rows"]
    """Time, position and velocity."""
    found: Bool[np.ndarray, " rows"]
    """Whether the motion closes."""
    stable: Bool[np.ndarray, " rows"]
    """Whether both multipliers of the linearised map are below 1 in modulus."""


def find_periodic(
    ends: Callable[[Float[np.ndarray, "3 n"], Int[np.ndarray, " n"]], Float[np.ndarray, "2 n"]],
    starts: Float[np.ndarray, "3 rows"],
    rows: Int[np.ndarray, " rows"],
    *,
    angular_frequency: float,
) -> Periodic:
    """Return starts whose motion comes back to them.

    Newton's method on x - F(x) = 0, x = (z, v), with the slopes of F by one-sided differences.

    Args:
        ends: F: of starts and the numbers of their scenes, position and velocity one response period later.
        starts: first guesses: time in us, position in nm and velocity in nm/us.
        rows: the numbers of their scenes.
        angular_frequency: of the free tip in rad/us; turns velocities into lengths.
    """
    starts = np.array(starts)
    count = len(rows)
    found, stable = np.zeros(count, bool), np.zeros(count, bool)
    alive = np.arange(count)
    for _ in range(_STEPS):
        if not alive.size:
            break
        place = starts[1:, alive]
        size = np.hypot(place[0], place[1] / angular_frequency) * np.array([[1.0], [angular_frequency]])
        moved = np.stack([place, *(place + _DIFFERENCE * size * unit[:, None] for unit in np.eye(2))])
        times = np.broadcast_to(starts[0, alive], (3, 1, len(alive)))
        trial = np.concatenate([times, moved], axis=1).transpose(1, 0, 2).reshape(3, -1)
        end = ends(trial, np.tile(rows[alive], 3)).reshape(2, 3, -1)
        # slopes[i, j]: of coordinate i by coordinate j
        slopes = (end[:, 1:] - end[:, :1]) / (_DIFFERENCE * size)
        gap = end[:, 0] - place
        jacobian = np.moveaxis(slopes, -1, 0)
        known = np.isfinite(jacobian).all(axis=(1, 2)) & np.isfinite(gap).all(axis=0)
        closed = known & (np.max(np.abs(gap) / size, axis=0) <= _CLOSED)
        found[alive[closed]] = True
        safe = np.where(known[:, None, None], jacobian, 0.0)
        stable[alive] = known & (np.abs(np.linalg.eigvals(safe)).max(axis=1) < _STABLE)
        step = np.linalg.solve(np.eye(2) - safe, np.where(known, gap, 0.0).T[:, :, None])[:, :, 0].T
        go = known & ~closed
        starts[1:, alive[go]] += step[:, go]
        alive = alive[go]
    return Periodic(starts, found, stable)
