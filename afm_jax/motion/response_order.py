"""Which motion repeats: m contacts in N drive periods, and how far it still is from repeating exactly."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

LONGEST = 32
"""Most contacts that a response may have before it counts as broadband."""
_REPETITIONS = 6
"""Repetitions in each of the two blocks whose comparison gives the rate of approach."""

_ROUNDING = 1e-8
"""Distance below which a block has arrived, its rate being rounding; not of the tolerance, lest slow motion passes."""


class Repetition(NamedTuple):
    """How a sequence of contacts repeats."""

    contacts: int
    """m, contacts until it repeats."""
    periods: int
    """N, drive periods until it repeats."""
    remaining: float
    """Estimated distance from the motion it tends to; of the velocity scale, phases in rad."""


def find_repetition(
    times_us: Float[np.ndarray, " contacts"],
    velocities: Float[np.ndarray, " contacts"],
    period_us: float,
    *,
    tolerance: float,
    longest: int = LONGEST,
) -> Repetition | None:
    """Return the shortest repetition of a sequence of departures, closer than a tolerance; None if there is none.

    Two departures m contacts apart differ by a velocity and a phase. Their distance e is the largest over a block of
    six repetitions; from the block before, q = (e/e_before)^(1/6) is the rate per repetition, and e q/(1 - q) what is
    left of the geometric series. A block takes a maximum because distances oscillate where an approach spirals.

    Args:
        times_us: when each contact ended, in order.
        velocities: velocity of the tip then, in nm/us.
        period_us: of the drive.
        tolerance: largest remaining distance that counts as none.
        longest: largest m to try.
    """
    for contacts in range(1, longest + 1):
        block = _REPETITIONS * contacts
        if len(times_us) < 2 * block + contacts:
            break
        last = slice(len(times_us) - 2 * block - contacts, None)
        steps = _steps(times_us[last], velocities[last], contacts, period_us)
        if steps is None:
            continue
        periods, distance = steps
        before, now = float(distance[:block].max()), float(distance[block:].max())
        rate = (now / before) ** (1.0 / _REPETITIONS) if before > 0.0 else 0.0
        remaining = now if now <= _ROUNDING else (now * rate / (1.0 - rate) if rate < 1.0 else np.inf)
        if max(now, remaining) <= tolerance:
            return Repetition(contacts, periods, float(remaining))
    return None


def _steps(
    times: np.ndarray, velocities: np.ndarray, contacts: int, period: float
) -> tuple[int, Float[np.ndarray, " steps"]] | None:
    """Return N and the distances between departures m contacts apart; None where their N differ or are 0."""
    apart = (times[contacts:] - times[:-contacts]) / period
    periods = np.round(apart)
    if periods[-1] < 1 or np.any(periods != periods[-1]):
        return None
    scale = max(float(np.abs(velocities).max()), np.finfo(float).tiny)
    angle = 2.0 * np.pi * np.abs(apart - periods)
    speed = np.abs(velocities[contacts:] - velocities[:-contacts]) / scale
    return int(periods[-1]), np.maximum(angle, speed)
