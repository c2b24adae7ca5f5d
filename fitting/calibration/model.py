"""A driven damped oscillator in front of a background: the least squares of a resonance scan or a thermal spectrum.

m z'' + (m Omega/Q) z' + k z = F cos(omega t), Omega^2 = k/m, has the response z = |A L| cos(omega t + arg(A L)) with

    L(f) = (f0^2/Q) / (f0^2 - f^2 + i f f0/Q),    f0 = Omega/2 pi,

which is -i at f0. A base that moves by d cos(omega t) is the force F = k d; a detector that sees the deflection against
the base adds a constant to A L, and so do electrical crosstalk and the rest of the piezo's spectrum. Therefore

    amplitude and phase:  z(f) = A L + B + C x           (A, B, C complex; x from -1 to 1 over the scan)
    amplitude only:       |z|^2 = a |L|^2 + b + c Re L   (|A L + B|^2 to order 1/Q^2; b also holds noise in quadrature)

and a thermal spectrum, |z|^2 its density, like the latter: white noise shakes the lever, b is the floor, c what other
modes add to the motion of this one.

An averaged periodogram of K spectra scatters as a gamma distribution: -2 log L = 2 K sum(u - 1 - ln u) + const with u =
measured/fitted density. Each term is the square of a residual, so that least squares maximises the likelihood.
"""

from itertools import product
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Complex, Float
from scipy.optimize import least_squares

from fitting.calibration.sweep import ResonanceSweep

_LEAST_SQUARE = 1e-12
"""Of a modelled square, in units of the largest: a trial step may leave less, or a negative one, whose root is none."""
_SEARCHES = 6
_STEPS, _SETTLED = 200, 1e-15


class ScanFit(NamedTuple):
    """A scan fitted: amplitudes in units of the largest.

    Attributes:
        frequency_khz: f0.
        quality_factor: Q.
        linear: real and imaginary parts of A, B, C in turn; or a, b, c.
        residual: of all numbers measured, each over its error; with phase those along the vectors come first.
        jacobian: of the residuals by ln f0, ln Q and ``linear``.
        model: the complex response, or the amplitude.
        reverse: the phase was taken with the opposite sign.
        left: estimated distance of chi2 to its minimum.
    """

    frequency_khz: float
    quality_factor: float
    linear: Float[np.ndarray, " terms"]
    residual: Float[np.ndarray, " n"]
    jacobian: Float[np.ndarray, "n p"]
    model: Complex[np.ndarray, " points"]
    reverse: bool
    left: float


class Points(NamedTuple):
    """A scan as the model takes it; of a spectrum ``error`` is the root of 1/K."""

    kind: str
    frequency: Float[np.ndarray, " points"]
    position: Float[np.ndarray, " points"]
    measured: Complex[np.ndarray, " points"]
    error: Float[np.ndarray, " points"]


def points_of(sweep: ResonanceSweep, error: Float[np.ndarray, " points"], *, reverse: bool) -> Points:
    """Return a scan for the model.

    Args:
        sweep: the scan.
        error: of the amplitudes, in the scan's unit; of a spectrum the relative error of a density.
        reverse: take the phase with the opposite sign.
    """
    largest, frequency = sweep.amplitude.max(), sweep.frequency_khz
    phase = np.zeros(sweep.points) if sweep.phase_deg is None else np.deg2rad(sweep.phase_deg)
    noise = error if sweep.spectrum else error / largest
    kind = "power" if sweep.spectrum else "amplitude" if sweep.phase_deg is None else "phase"
    measured = sweep.amplitude / largest * np.exp((-1j if reverse else 1j) * phase)
    position = 2.0 * (frequency - frequency[0]) / max(np.ptp(frequency), 1e-300) - 1.0
    return Points(kind, frequency, position, measured, noise)


def response(frequency: Float[np.ndarray, " n"], natural: float, quality_factor: float) -> Complex[np.ndarray, "n 3"]:
    """Return L and its derivatives by ln f0 and ln Q, columns of an array."""
    # the product keeps the digits that the difference of squares would lose close to the resonance
    damping = 1j * frequency * natural / quality_factor
    below = (natural - frequency) * (natural + frequency) + damping
    shape = natural**2 / quality_factor / below
    by_natural = 2.0 * shape - shape * (2.0 * natural**2 + damping) / below
    return np.stack([shape, by_natural, -shape + shape * damping / below], axis=1)


def _terms(points: Points, shape: Complex[np.ndarray, "n 3"]) -> Complex[np.ndarray, "n terms 3"]:
    """Return what the linear parameters multiply, and its derivatives by ln f0 and ln Q."""
    one, nothing = np.ones(len(shape)), np.zeros(len(shape))
    if points.kind == "phase":
        columns = [shape, *(np.stack([part, nothing, nothing], axis=1) for part in (one, points.position))]
        return np.stack([turn * part for part in columns for turn in (1.0, 1j)], axis=1)
    square = np.real(np.conj(shape[:, :1]) * shape) * np.array([1.0, 2.0, 2.0])
    columns = [square, np.stack([one, nothing, nothing], axis=1), np.real(shape)]
    return np.stack(columns, axis=1).astype(complex)


def deviance_root(ratio: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Return the root of 2 (u - 1 - ln u) with the sign of u - 1, of ratios u above 0."""
    apart = ratio - 1.0
    near = np.abs(apart) < 1e-3
    # to the order that is left in 64 bits
    series = apart * np.sqrt(1.0 - np.where(near, 2.0 * apart / 3.0 - apart**2 / 2.0 + 0.4 * apart**3, 0.0))
    away = np.where(near, 2.0, ratio)
    return np.where(near, series, np.sign(away - 1.0) * np.sqrt(2.0 * (away - 1.0 - np.log(away))))


def _evaluate(points: Points, place: Float[np.ndarray, " p"]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return residuals, their Jacobian, and the model at ln f0, ln Q and the linear parameters."""
    shape = response(points.frequency, *np.exp(place[:2]).tolist())
    terms = _terms(points, shape)
    value, *slopes = np.moveaxis(np.einsum("ntd,t->nd", terms, place[2:]), 1, 0)
    by_place = np.concatenate([np.stack(slopes, axis=1), terms[:, :, 0]], axis=1)
    if points.kind == "phase":
        size = np.abs(points.measured)
        turn = np.conj(points.measured) / np.where(size > 0.0, size, 1.0) + (size == 0.0)
        both = [(turn * (value - points.measured)), turn[:, None] * by_place]
        parts = [(np.real(part).T / points.error, np.imag(part).T / points.error) for part in both]
        return np.concatenate(parts[0]), np.concatenate(parts[1], axis=1).T, value
    square = np.maximum(np.real(value), _LEAST_SQUARE)
    by_place = np.where(np.real(value)[:, None] > _LEAST_SQUARE, np.real(by_place), 0.0)
    amplitude, measured = np.sqrt(square), np.real(points.measured)
    if points.kind == "amplitude":
        return (amplitude - measured) / points.error, by_place / (2.0 * amplitude * points.error)[:, None], amplitude
    ratio = measured**2 / square
    root = deviance_root(ratio)
    steep = np.where(np.abs(root) > 1e-6, (ratio - 1.0) / np.where(root == 0.0, 1.0, root), 1.0)
    return -root / points.error, by_place * (steep / square / points.error)[:, None], amplitude


def _linear(points: Points, natural: float, quality_factor: float) -> tuple[Float[np.ndarray, " terms"], float]:
    """Return the linear parameters of an oscillator, and the sum of squares that they leave."""
    columns = _terms(points, response(points.frequency, natural, quality_factor))[:, :, 0]
    if points.kind == "phase":
        design, wanted = np.concatenate([np.real(columns), np.imag(columns)]), points.measured
        wanted = np.concatenate([np.real(wanted), np.imag(wanted)])
    else:
        # weighted such that the errors are about those of the amplitude, or of the density
        size = np.maximum(np.real(points.measured), 1e-6)
        weight = 1.0 / (size**2 if points.kind == "power" else 2.0 * np.maximum(size, 0.03))
        design, wanted = weight[:, None] * np.real(columns), weight * np.real(points.measured) ** 2
    found = np.linalg.lstsq(design, wanted, rcond=1e-9)[0]
    # a negative square is a dip, no resonance
    dip = points.kind != "phase" and found[0] <= 0.0
    return found, np.inf if dip else float(np.sum((design @ found - wanted) ** 2))


def minimum(sweep: ResonanceSweep, error: Float[np.ndarray, " points"]) -> ScanFit:
    """Return the least squares of a scan, from the best places of a grid of frequencies and widths.

    Args:
        sweep: the scan.
        error: of each point; see `points_of`.
    """
    frequency = sweep.frequency_khz
    span, peak = np.ptp(frequency), frequency[np.argmax(sweep.amplitude)]
    step = span / (len(np.unique(frequency)) - 1)
    # half of them lie around the largest amplitude, where a peak narrower than the grid would be
    near = np.clip(peak + step * np.linspace(-3.0, 3.0, 13), frequency[0], frequency[-1])
    grid = product(
        [*np.linspace(frequency[0], frequency[-1], 12).tolist(), *near.tolist()],
        np.maximum(frequency.mean() / np.geomspace(0.3 * step, 3.0 * span, 10), 0.6).tolist(),
        (False, True) if sweep.phase_deg is not None else (False,),
    )
    ways = [points_of(sweep, error, reverse=reverse) for reverse in (False, True)]
    starts = sorted(((_linear(ways[way], f, q), f, q, way) for f, q, way in grid), key=lambda start: start[0][1])
    reverse = starts[0][3]
    points = ways[reverse]
    alike = [start for start in starts if start[3] == reverse][:_SEARCHES]
    best = [np.array([np.log(f), np.log(q), *linear]) for (linear, _), f, q, _ in alike]

    def apart(place: Float[np.ndarray, " p"]) -> Float[np.ndarray, " n"]:
        return _evaluate(points, place)[0]

    def slopes(place: Float[np.ndarray, " p"]) -> Float[np.ndarray, "n p"]:
        return _evaluate(points, place)[1]

    exact: dict[str, Any] = {"jac": slopes, "xtol": _SETTLED, "ftol": _SETTLED, "gtol": _SETTLED, "max_nfev": _STEPS}
    ends = [least_squares(apart, place, method="lm", **exact) for place in best]
    place = min(ends, key=lambda end: end.cost).x
    residual, jacobian, model = _evaluate(points, place)
    # what one more step would gain
    left = float(np.sum((jacobian @ np.linalg.lstsq(jacobian, residual, rcond=1e-12)[0]) ** 2))
    natural, quality_factor = np.exp(place[:2]).tolist()
    return ScanFit(natural, quality_factor, place[2:], residual, jacobian, model + 0j, reverse, left)


def chi2_without_resonance(sweep: ResonanceSweep, error: Float[np.ndarray, " points"]) -> float:
    """Return chi2 of the best smooth curve without a resonance: a parabola through amplitude or response."""
    points = points_of(sweep, error, reverse=False)
    columns = np.vander(points.position, 3).astype(complex)
    # the root of a density has half its relative error
    noise = 0.5 * points.error * np.abs(points.measured) if points.kind == "power" else points.error
    solution = np.linalg.lstsq(columns / noise[:, None], points.measured / noise, rcond=None)[0]
    return float(np.sum(np.abs((columns @ solution - points.measured) / noise) ** 2))
