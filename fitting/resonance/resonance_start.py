"""Where the fit of a sweep starts: a grid of frequencies and quality factors, the linear parameters solved for."""

import numpy as np
from jaxtyping import Complex, Float

from fitting.optimise import BATCH
from fitting.resonance.resonance_model import Points, response_parts

_FREQUENCIES, _QUALITY_FACTORS, _BACKGROUNDS = 48, 20, 3


def starts(points: Points, used: int, kind: str, terms: int) -> tuple[Float[np.ndarray, "starts p"], float]:
    """Return the best points of the grid as parameter values, and the sum of squares of the very best.

    Args:
        points: the sweep, with filled-up rows at the end.
        used: how many rows are points.
        kind: "phase" or "amplitude".
        terms: number of linear parameters.
    """
    frequency = np.asarray(points.frequency_khz)[:used]
    amplitude = np.asarray(points.amplitude)[:used]
    position = np.asarray(points.position)[:used]
    span, peak = np.ptp(frequency), frequency[np.argmax(amplitude)]
    step = span / (len(np.unique(frequency)) - 1)
    # The second half lies around the largest amplitude, where a peak narrower than the grid would be.
    near = peak + step * np.linspace(-6.0, 6.0, _FREQUENCIES // 2)
    natural = np.concatenate([np.linspace(frequency[0], frequency[-1], _FREQUENCIES // 2), near])
    natural = np.clip(natural, frequency[0], frequency[-1])
    candidates, sums = [], []
    for width in np.geomspace(0.3 * step, 3.0 * span, _QUALITY_FACTORS):
        quality_factor = max(frequency.mean() / width, 0.6)
        real, imaginary = response_parts(frequency, natural[:, None], quality_factor)
        shape = real + 1j * imaginary
        if kind == "phase":
            linear, square = _complex_terms(shape, position, np.asarray(points.measured)[:used], terms)
        else:
            linear, square = _real_terms(shape, amplitude, terms)
        candidates.append(np.column_stack([natural, np.full(len(natural), quality_factor), linear]))
        sums.append(square)
    total = np.concatenate(sums)
    best = np.argsort(total, kind="stable")[:BATCH]
    return np.concatenate(candidates)[best], float(total[best[0]])


def _complex_terms(
    shape: Complex[np.ndarray, "grid n"], position: Float[np.ndarray, " n"], measured: Complex[np.ndarray, " n"], terms
):
    columns = [shape, np.ones_like(shape), np.broadcast_to(position, shape.shape)][: terms // 2]
    design = np.stack(columns, axis=2)
    linear = _solve(design, np.broadcast_to(measured, shape.shape))
    square = np.sum(np.abs(np.einsum("gnk,gk->gn", design, linear) - measured) ** 2, axis=1)
    return np.stack([np.real(linear), np.imag(linear)], axis=2).reshape(len(shape), terms), square


def _real_terms(shape: Complex[np.ndarray, "grid n"], amplitude: Float[np.ndarray, " n"], terms):
    """Fit the square of the amplitude, weighted such that the errors are about those of the amplitude."""
    weight = 1.0 / np.maximum(2.0 * amplitude, 0.05)
    columns = [np.abs(shape) ** 2, np.ones(shape.shape), np.real(shape)][:terms]
    design = np.stack(columns, axis=2)
    linear = _solve(design * weight[:, None], np.broadcast_to(weight * amplitude**2, shape.shape))
    predicted = np.sqrt(np.maximum(np.einsum("gnk,gk->gn", design, linear), 0.0))
    square = np.sum((predicted - amplitude) ** 2, axis=1)
    # A negative response is a dip, not a resonance.
    return linear, np.where(linear[:, 0] > 0.0, square, np.inf)


def _solve(design, measured):
    """Return the least-squares solution for every point of the grid; a little damping keeps dependent columns apart."""
    normal = np.einsum("gnk,gnl->gkl", design.conj(), design)
    diagonal = np.einsum("gkk->gk", normal).real
    normal = normal + 1e-9 * diagonal.max(axis=1)[:, None, None] * np.eye(design.shape[2])
    right = np.einsum("gnk,gn->gk", design.conj(), measured)
    return np.linalg.solve(normal, right[..., None])[..., 0]


def sum_without_resonance(points: Points, used: int, kind: str) -> float:
    """Return chi2 of the best smooth curve without a resonance: a parabola through amplitude or response."""
    position = np.asarray(points.position)[:used]
    columns = np.vander(position, _BACKGROUNDS)
    weight = np.asarray(points.weight)[:used]
    turn = np.asarray(points.turn)[:used]
    turned = turn * np.asarray(points.measured)[:used]
    if kind == "amplitude":
        design, measured = weight[:, :1] * columns, weight[:, 0] * np.real(turned)
    else:
        basis = turn[:, None] * np.hstack([columns, 1j * columns])
        design = np.vstack([weight[:, :1] * np.real(basis), weight[:, 1:] * np.imag(basis)])
        measured = np.concatenate([weight[:, 0] * np.real(turned), weight[:, 1] * np.imag(turned)])
    solution, *_ = np.linalg.lstsq(design, measured, rcond=None)
    return float(np.sum((design @ solution - measured) ** 2))
