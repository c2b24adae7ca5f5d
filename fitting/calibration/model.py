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

from functools import partial
from itertools import product

import numpy as np
from jaxtyping import Complex, Float

from afm_jax.solve.least_squares import Lowest, Sum, levenberg_marquardt
from fitting.calibration.sweep import Resonance

Points = Float[np.ndarray, " points"]
Response = Complex[np.ndarray, " points"]


def measured_response(sweep: Resonance) -> Response:
    """Return what was measured as complex numbers, in units of the largest amplitude."""
    phase = np.zeros(sweep.points) if sweep.phase_deg is None else np.deg2rad(sweep.phase_deg)
    return sweep.amplitude / sweep.amplitude.max() * np.exp(1j * phase)


def response(frequency: Float[np.ndarray, " n"], natural: float, quality_factor: float) -> Complex[np.ndarray, "n 3"]:
    """Return L and its derivatives by ln f0 and ln Q, columns of an array."""
    # the product keeps the digits that the difference of squares would lose close to the resonance
    damping = 1j * frequency * natural / quality_factor
    below = (natural - frequency) * (natural + frequency) + damping
    shape = natural**2 / quality_factor / below
    by_natural = 2.0 * shape - shape * (2.0 * natural**2 + damping) / below
    return np.stack([shape, by_natural, -shape + shape * damping / below], axis=1)


def _terms(sweep: Resonance, natural: float, quality_factor: float) -> Float[np.ndarray, "n terms 3"]:
    """Return what the linear parameters multiply, and its derivatives by ln f0 and ln Q.

    The sum is z, all its real parts and below them all imaginary ones, or |z|^2.
    """
    shape = response(sweep.frequency_khz, natural, quality_factor)
    constant = np.ones((sweep.points, 1)) * [1.0, 0.0, 0.0]
    if sweep.model == "phase":
        columns = [shape, constant, sweep.position[:, None] * constant]
        return _parts(np.stack([turn * column for column in columns for turn in (1.0, 1j)], axis=1))
    square = np.real(np.conj(shape[:, :1]) * shape) * [1.0, 2.0, 2.0]
    return np.stack([square, constant, np.real(shape)], axis=1)


def deviance_root(ratio: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Return the root of 2 (u - 1 - ln u) with the sign of u - 1, of ratios u above 0."""
    apart = ratio - 1.0
    return np.sign(apart) * np.sqrt(2.0 * np.maximum(apart - np.log1p(apart), 0.0))


def _parts(numbers: Complex[np.ndarray, "n ..."]) -> Float[np.ndarray, "m ..."]:
    """Return all real parts, and below them all imaginary parts."""
    return np.concatenate([np.real(numbers), np.imag(numbers)])


def _evaluate(sweep: Resonance, wanted: Float[np.ndarray, " n"], error: Points, place: Float[np.ndarray, " p"]) -> Sum:
    """Return chi2 at ln f0, ln Q and the linear parameters; arguments as of `minimum`."""
    terms = _terms(sweep, *np.exp(place[:2]).tolist())
    values = np.einsum("ntd,t->nd", terms, place[2:])
    model, slopes = values[:, 0], np.concatenate([values[:, 1:], terms[:, :, 0]], axis=1)
    if sweep.model == "phase":
        residual, steep, error = model - wanted, np.ones_like(model), np.tile(error, 2)
    else:
        # a trial step may leave nothing of a square, or a negative one, whose root is none
        model = np.maximum(model, 1e-12)
        residual = np.sqrt(model) - np.sqrt(wanted)
        steep = 0.5 / np.sqrt(model)
    if sweep.model == "power":
        ratio = wanted / model
        residual = -deviance_root(ratio)
        steep = np.divide(1.0 - ratio, residual, out=np.ones_like(ratio), where=residual != 0.0) / model
    residual, slopes = residual / error, slopes * (steep / error)[:, None]
    return Sum(float(residual @ residual), residual, slopes)


def _linear(
    sweep: Resonance, wanted: Float[np.ndarray, " n"], natural: float, quality_factor: float
) -> tuple[float, Float[np.ndarray, " p"]]:
    """Return the sum of squares about which the best place for a frequency and a quality factor leaves, and it."""
    weight = np.ones(len(wanted))
    if sweep.model != "phase":
        # such that the errors are about those of the amplitude, or of the density
        size = np.maximum(np.sqrt(wanted), 1e-6)
        weight = 1.0 / (size**2 if sweep.model == "power" else 2.0 * np.maximum(size, 0.03))
    design = weight[:, None] * _terms(sweep, natural, quality_factor)[:, :, 0]
    found = np.linalg.lstsq(design, weight * wanted, rcond=1e-9)[0]
    # a negative square is a dip, no resonance
    dip = sweep.model != "phase" and found[0] <= 0.0
    chi2 = np.inf if dip else float(np.sum((design @ found - weight * wanted) ** 2))
    return chi2, np.array([np.log(natural), np.log(quality_factor), *found])


def minimum(sweep: Resonance, error: Points) -> tuple[Lowest, Response, bool]:
    """Return the least squares of a scan, from the best place of a grid of frequencies and widths.

    A place is ln f0, ln Q and the linear parameters: real and imaginary parts of A, B, C in turn; or a, b, c.

    Args:
        sweep: the scan.
        error: of each point, in units of the largest amplitude; of a spectrum the relative error of a density.

    Returns:
        Where chi2 is smallest; the model's response (or amplitude) there, in units of the largest amplitude; and
        whether the phase was taken with the opposite sign.
    """
    frequency, measured = sweep.frequency_khz, measured_response(sweep)
    span, peak = np.ptp(frequency), frequency[np.argmax(sweep.amplitude)]
    step = span / (len(np.unique(frequency)) - 1)
    # half of them lie around the largest amplitude, where a peak narrower than the grid would be
    near = np.clip(peak + step * np.linspace(-3.0, 3.0, 13), frequency[0], frequency[-1])
    grid = product(
        [_parts(measured), _parts(np.conj(measured))] if sweep.model == "phase" else [np.abs(measured) ** 2],
        [*np.linspace(frequency[0], frequency[-1], 12).tolist(), *near.tolist()],
        np.maximum(frequency.mean() / np.geomspace(0.3 * step, 3.0 * span, 10), 0.6).tolist(),
    )
    starts = ((*_linear(sweep, *place), place[0]) for place in grid)
    _, start, wanted = min(starts, key=lambda start: start[0])
    longest = np.append([1.0, 1.0], np.full(len(start) - 2, np.inf))
    evaluate = partial(_evaluate, sweep, wanted, error)
    best = levenberg_marquardt(evaluate, start, settled=1e-20, most=100, longest=longest)
    model = _terms(sweep, *np.exp(best.place[:2]).tolist())[:, :, 0] @ best.place[2:]
    if sweep.model != "phase":
        return best, np.sqrt(model) + 0j, False
    return best, np.array([1.0, 1j]) @ model.reshape(2, -1), bool(np.any(wanted != _parts(measured)))


def chi2_without_resonance(sweep: Resonance, error: Points) -> float:
    """Return chi2 of a parabola through amplitude or response, which has no resonance; arguments as of `minimum`."""
    columns = np.vander(sweep.position, 3).astype(complex)
    measured = measured_response(sweep)
    # the root of a density has half its relative error
    noise = 0.5 * error * np.abs(measured) if sweep.spectrum else error
    solution = np.linalg.lstsq(columns / noise[:, None], measured / noise, rcond=None)[0]
    return float(np.sum(np.abs((columns @ solution - measured) / noise) ** 2))
