"""The peak height of a folded trace: a polynomial through the samples around the top, or a parabola through few."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from fitting.traces.lockin_fold import Fold

_GRID = 2048
_TOP = 0.6
"""Share of the peak above which a flight is fitted: a cosine's first 53 degrees, of which a quartic misses 3e-5."""
_QUARTIC_MISSES = 3e-5
_REACH = 0.35
"""Of the response period: longest stretch to each side of the top."""
_ENOUGH = 10
"""Distinct phases for a quartic; with fewer a parabola through the nearest three."""


class Peak(NamedTuple):
    """The top of the waveform.

    Attributes:
        height_nm: above the rest position.
        error_nm: from the noise.
        sampling_error_nm: by how much the polynomial may miss the top of a cosine.
        at: response phase of the top, in turns.
        weights: of the samples, whose sum with the heights is the height, shape (samples,).
        frequency_khz: of the free flight, from the bending at the top: z'' = -Omega^2 z; None where it is not positive.
    """

    height_nm: float
    error_nm: float
    sampling_error_nm: float
    at: float
    weights: Float[np.ndarray, " samples"]
    frequency_khz: float | None


def find_peak(folded: Fold) -> Peak:
    """Return the largest height of the waveform above the rest position.

    All response periods' samples near the top are fitted together: the result is the mean of the periods' maxima,
    without the bias of the maximum of noisy samples.

    Args:
        folded: of the right order.
    """
    turns = np.arange(_GRID) / _GRID
    shape = folded.waveform(2.0 * np.pi * turns)
    top = int(np.argmax(shape))
    before, after = (_reach(np.roll(shape, -top), direction) for direction in (-1, 1))
    offset = np.mod(folded.angle / (2.0 * np.pi) - turns[top] + 0.5, 1.0) - 0.5
    inside = (offset >= -before) & (offset <= after)
    if _distinct(offset[inside], folded.resolution) >= _ENOUGH:
        return _vertex(folded, turns[top], offset, inside, 4)
    # of phases 1/resolution apart three lie within 1.5 of these steps, wherever the top is
    return _vertex(folded, turns[top], offset, np.abs(offset) <= 1.500001 / folded.resolution, 2)


def _reach(shape: Float[np.ndarray, " grid"], direction: int) -> float:
    """Return how far the waveform stays above its share of the top, in turns; the top is the first element."""
    ordered = shape if direction > 0 else np.roll(shape[::-1], 1)
    low = np.flatnonzero(ordered < _TOP * ordered[0])
    return min(_REACH, (int(low[0]) if len(low) else _GRID) / _GRID)


def _distinct(offset: Float[np.ndarray, " n"], resolution: float) -> int:
    return len(np.unique(np.round(offset * max(resolution, 1.0) * 2.0)))


def _vertex(folded: Fold, top: float, offset: Float[np.ndarray, " samples"], inside: np.ndarray, degree: int) -> Peak:
    """Return the maximum of the polynomial fitted to the samples inside."""
    scale = float(np.max(np.abs(offset[inside])))
    x = offset[inside] / scale
    design = np.vander(x, degree + 1, increasing=True)
    inverse = np.linalg.pinv(design)
    values = inverse @ folded.height[inside]
    grid = np.linspace(-1.0, 1.0, 4001)
    at = float(grid[np.argmax(np.polynomial.polynomial.polyval(grid, values))])
    slope, bend = (np.polynomial.polynomial.polyval(at, np.polynomial.polynomial.polyder(values, m)) for m in (1, 2))
    if bend < 0.0:
        at = float(np.clip(at - slope / bend, -1.0, 1.0))
    height = float(np.polynomial.polynomial.polyval(at, values))
    # the height does not depend on where the top lies, to first order
    weights = np.zeros(len(offset))
    weights[inside] = at ** np.arange(degree + 1) @ inverse
    bend_us = float(bend) / (scale * folded.period_us) ** 2
    frequency = 1e3 * np.sqrt(-bend_us / height) / (2.0 * np.pi) if bend_us < 0.0 < height else None
    spacing = folded.period_us / folded.resolution
    # at its top cos between three points h apart is off by at most h^4/45, between four by less than h^4/20
    off = _QUARTIC_MISSES * abs(height) if degree > 2 else bend_us**2 / max(abs(height), 1e-300) * spacing**4 / 20.0
    place = float(np.mod(top + at * scale, 1.0))
    return Peak(height, folded.error_of(weights), float(off), place, weights, frequency)
