"""The driven damped oscillator in front of a background: the model that a free resonance sweep is fitted with.

m z'' + (m Omega/Q) z' + k z = F cos(omega t), Omega^2 = k/m, has the response z = |A L| cos(omega t + arg(A L)) with

    L(f) = (f0^2/Q) / (f0^2 - f^2 + i f f0/Q),    f0 = Omega/2 pi,

which is -i at f0. A base that moves by d cos(omega t) is the force F = k d; a detector that sees the deflection against
the base, z - d, adds a constant to A L, and so do electrical crosstalk and the rest of the piezo's spectrum. Therefore

    with phase:      z(f) = A L + B + C x            (A, B, C complex; x from -1 to 1 over the sweep)
    amplitude only:  |z|^2 = a |L|^2 + b + c Re L     (b also holds noise in quadrature)
    power:           the same for a thermal spectrum, |z|^2 its density: white noise shakes the lever, b is the floor

of which a background keeps the first terms (``TERMS``). The second line is |A L + B|^2 up to terms of the order 1/Q^2,
in parameters that the amplitude determines; A and B themselves it leaves ambiguous.

An averaged periodogram of K spectra scatters as a gamma distribution: -2 log L = 2 K sum(u - 1 - ln u) + const with u =
measured/fitted density. Each term is the square of a residual, so that least squares maximises the likelihood.
"""

from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from afm_jax.least_squares import whole_covariance_of
from fitting.calibration.result import PointErrors
from fitting.calibration.sweep import ResonanceSweep
from fitting.fits.intervals import Convergence, check_minimum
from fitting.fits.objective import BATCH, PLAIN, Objective, lowest, polish
from fitting.forward import Linearised, Prediction
from fitting.models import Problem
from fitting.parameters import Parameter

TERMS = {
    "phase": {"none": 2, "constant": 4, "linear": 6},
    "amplitude": {"none": 1, "floor": 2, "constant": 3},
    "power": {"none": 1, "floor": 2, "constant": 3},
}
"""How many linear parameters each background leaves, for sweeps with and without phase."""
LINEAR_NAMES = {
    "phase": (
        "response_cos",
        "response_sin",
        "background_cos",
        "background_sin",
        "background_slope_cos",
        "background_slope_sin",
    ),
    "amplitude": ("response_squared", "floor_squared", "interference"),
    "power": ("response_squared", "floor_squared", "interference"),
}
_PADDING = 64
"""Sweeps are filled up to a multiple of this, so that few shapes are compiled."""


def response_parts(frequency: Any, natural: Any, quality_factor: Any) -> tuple[Any, Any]:
    """Return real and imaginary part of L, the response of the oscillator, -i at its natural frequency.

    Args:
        frequency: of the drive; numbers, NumPy or JAX arrays, which broadcast.
        natural: Omega/2 pi in the same unit.
        quality_factor: Q.
    """
    # The product keeps the digits that the difference of squares would lose close to the resonance.
    detuning = (natural - frequency) * (natural + frequency)
    damping = frequency * natural / quality_factor
    scale = natural**2 / quality_factor / (detuning**2 + damping**2)
    return scale * detuning, -scale * damping


class Points(NamedTuple):
    """A sweep as the model takes it: amplitudes in units of the largest one; weights are 0 in rows that fill up."""

    frequency_khz: Float[Array, " n"]
    position: Float[Array, " n"]  # x, from -1 to 1 over the sweep
    amplitude: Float[Array, " n"]
    measured: Complex[Array, " n"]  # as a vector; without phase the amplitude once more
    turn: Complex[Array, " n"]  # of modulus 1: turns the direction of the first error onto the real axis
    weight: Float[Array, "n 2"]  # 1/error along that direction and across it; of a power spectrum the root of K


@dataclass(frozen=True)
class SweepProblem(Problem):
    """What is fitted to a sweep: frequency, quality factor and linear parameters; `model` is the background.

    Attributes:
        reference_khz: frequency from which the coordinate of the frequency counts.
        width_khz: its unit.
    """

    reference_khz: float = 1.0
    width_khz: float = 1.0

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """The parameters in the order of every vector."""
        far = 1e12
        frequency = Parameter(
            name="frequency_khz",
            unit="kHz",
            lowest=0.0,
            highest=far,
            reference=self.reference_khz,
            width=self.width_khz,
        )
        quality_factor = Parameter(name="quality_factor", lowest=0.5, highest=far)
        others = (Parameter(name=name, lowest=-far, highest=far, width=1.0) for name in self.names[2:])
        return (frequency, quality_factor, *others)


@partial(jax.jit, static_argnames="kind")
def model_at(values: Float[Array, " p"], points: Points, kind: str) -> Complex[Array, " n"]:
    """Return the model at every point: the complex response, or for the kind "amplitude" its modulus."""
    real, imaginary = response_parts(points.frequency_khz, values[0], values[1])
    linear = values[2:]
    if kind == "phase":
        terms = jnp.stack(
            [jax.lax.complex(real, imaginary), *(map(_as_complex, (jnp.ones_like(real), points.position)))]
        )
        factors = jax.lax.complex(linear[0::2], linear[1::2])
        return factors @ terms[: len(factors)]
    terms = jnp.stack([real**2 + imaginary**2, jnp.ones_like(real), real])
    square = linear @ terms[: len(linear)]
    # Trial steps may leave a negative square behind; its root and the root's slope must stay finite.
    positive = square > 1e-12
    return _as_complex(jnp.where(positive, jnp.sqrt(jnp.where(positive, square, 1.0)), 1e-6))


def _as_complex(real: Float[Array, " n"]) -> Complex[Array, " n"]:
    return jax.lax.complex(real, jnp.zeros_like(real))


@partial(jax.jit, static_argnames="kind")
def slope_at(values: Float[Array, " p"], points: Points, kind: str) -> Complex[Array, " n"]:
    """Return the derivative of the model by the frequency, per kHz; the slope of a background is left out."""
    frequency = points.frequency_khz
    move = jax.jvp(
        lambda moved: model_at(values, points._replace(frequency_khz=moved), kind),
        (frequency,),
        (jnp.ones_like(frequency),),
    )
    return move[1]


@partial(jax.jit, static_argnames="kind")
def _linearised(values: Float[Array, "sets p"], points: Points, kind: str):
    def residual(one):
        if kind == "power":
            used = points.weight[:, 0] > 0.0
            ratio = jnp.where(used, points.amplitude, 1.0) / jnp.where(used, model_at(one, points, kind).real, 1.0)
            return -points.weight[:, 0] * deviance_root(ratio**2)
        turned = points.turn * (model_at(one, points, kind) - points.measured)
        along = turned.real * points.weight[:, 0]
        return jnp.concatenate([along, turned.imag * points.weight[:, 1]]) if kind == "phase" else along

    return jax.vmap(residual)(values), jax.vmap(jax.jacfwd(residual))(values)


def deviance_root(ratio: Float[Array, " n"]) -> Float[Array, " n"]:
    """Return the root of 2 (u - 1 - ln u) with the sign of u - 1, smooth through u = 1.

    Args:
        ratio: u, above 0.
    """
    apart = ratio - 1.0
    near = jnp.abs(apart) < 1e-3
    # sqrt(1 - 2 d/3 + d^2/2), to the order that is left in 64 bits
    series = apart * jnp.sqrt(1.0 - jnp.where(near, 2.0 * apart / 3.0 - apart**2 / 2.0 + 0.4 * apart**3, 0.0))
    away = jnp.where(near, 2.0, ratio)
    return jnp.where(near, series, jnp.sign(away - 1.0) * jnp.sqrt(2.0 * (away - 1.0 - jnp.log(away))))


class SweepObjective(Objective):
    """Chi2 of a sweep and a background; the optimiser, the checks and the intervals of `fitting` work on it."""

    def __init__(self, points: Points, kind: str, problem: SweepProblem):
        """Keep what every evaluation shares."""
        self.points, self.kind, self.problem, self.background = points, kind, problem, problem

    def at_values(self, values: Float[np.ndarray, "sets p"]) -> Linearised:
        """Return residuals and their Jacobian by the values, in batches that share one compilation; of rows nothing."""
        count = len(values)
        filled = np.concatenate([values, np.repeat(values[-1:], -count % BATCH, axis=0)])
        parts = [
            _linearised(jnp.asarray(filled[first : first + BATCH]), self.points, self.kind)
            for first in range(0, len(filled), BATCH)
        ]
        residual, jacobian = (np.concatenate([np.asarray(part) for part in side]) for side in zip(*parts, strict=True))
        no_rows = Prediction(*(jnp.zeros(0) for _ in Prediction._fields))
        return Linearised(residual[:count], jacobian[:count], no_rows)

    def with_errors(
        self,
        along: Float[np.ndarray, " n"],
        across: Float[np.ndarray, " n"],
        direction: Complex[np.ndarray, " n"] | None = None,
    ) -> "SweepObjective":
        """Return the objective with other errors, in a direction of their own where one is given."""
        rows = len(self.points.amplitude)
        weight = np.pad(1.0 / np.stack([along, across], axis=1), ((0, rows - len(along)), (0, 0)))
        points = self.points._replace(weight=jnp.asarray(weight))
        if direction is not None:
            turn = np.pad(np.conj(direction), (0, rows - len(direction)), constant_values=1.0)
            points = points._replace(turn=jnp.asarray(turn))
        return SweepObjective(points, self.kind, self.background)


def points_of(sweep: ResonanceSweep, *, reverse: bool) -> Points:
    """Return a sweep for the model: errors of 1 along and across the measured vector.

    Args:
        sweep: the sweep.
        reverse: take the phase with the opposite sign.
    """
    phase = np.zeros(sweep.points) if sweep.phase_deg is None else np.deg2rad(sweep.phase_deg)
    direction = np.exp((-1j if reverse else 1j) * phase)
    frequency, amplitude = sweep.frequency_khz, sweep.amplitude / sweep.amplitude.max()
    filling = (0, -sweep.points % _PADDING)
    columns = (
        np.pad(frequency, filling, mode="edge"),
        np.pad(2.0 * (frequency - frequency[0]) / np.ptp(frequency) - 1.0, filling),
        np.pad(amplitude, filling),
        np.pad(amplitude * direction, filling),
        np.pad(np.conj(direction), filling, constant_values=1.0),
        np.pad(np.ones((sweep.points, 2)), (filling, (0, 0))),
    )
    return Points(*map(jnp.asarray, columns))


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
    if kind == "power":
        weight = 2.0 * weight / np.asarray(points.amplitude)[:used, None]
    turn = np.asarray(points.turn)[:used]
    turned = turn * np.asarray(points.measured)[:used]
    if kind != "phase":
        design, measured = weight[:, :1] * columns, weight[:, 0] * np.real(turned)
    else:
        basis = turn[:, None] * np.hstack([columns, 1j * columns])
        design = np.vstack([weight[:, :1] * np.real(basis), weight[:, 1:] * np.imag(basis)])
        measured = np.concatenate([weight[:, 0] * np.real(turned), weight[:, 1] * np.imag(turned)])
    solution, *_ = np.linalg.lstsq(design, measured, rcond=None)
    return float(np.sum((design @ solution - measured) ** 2))


SMALLEST = 1e-7
"""Error of an estimated noise in units of the largest amplitude: a sweep without noise must not divide by zero."""


def first_errors(
    sweep: ResonanceSweep, noise: float | None, guess: float
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Return the errors that a fit starts with, along and across the vector, in units of the largest amplitude.

    Args:
        sweep: the sweep.
        noise: error of every point as a share of the largest amplitude, for a sweep without errors of its own.
        guess: the error where nothing is known.
    """
    largest = sweep.amplitude.max()
    if sweep.spectrum:
        along = np.full(sweep.points, 1.0 / np.sqrt(sweep.averages or 1.0))
    elif sweep.amplitude_error is None:
        along = np.full(sweep.points, max(guess, SMALLEST) if noise is None else noise)
    else:
        along = sweep.amplitude_error / largest
    if sweep.phase_error_deg is None:
        return along, along
    # Far from the resonance the vector may be shorter than its noise.
    across = np.maximum(sweep.amplitude / largest, 1e-6) * np.deg2rad(sweep.phase_error_deg)
    return along, across


def with_estimated_errors(
    objective: SweepObjective, values: Float[np.ndarray, " p"], points: int
) -> tuple[SweepObjective, float, float]:
    """Return the objective with errors that explain the misfit of a fit.

    The noise of a lock-in amplifier is equal in all directions. A drive whose frequency is rounded or wanders moves the
    response along its curve besides, by the slope dz/df times the error of the frequency: with the phase measured, the
    two are told apart by their direction. Without it all misfit is taken as noise of the amplitude.

    Returns:
        The objective, the noise in units of the largest amplitude, and the jitter of the frequency in kHz.
    """
    model = np.asarray(model_at(values, objective.points, objective.kind))[:points]
    misfit = model - np.asarray(objective.points.measured)[:points]
    parameters = len(values)
    if objective.kind == "amplitude":
        noise = float(np.sqrt(np.sum(np.real(misfit) ** 2) / (points - parameters)))
        along = np.full(points, max(noise, SMALLEST))
        return objective.with_errors(along, along), noise, 0.0
    slope = np.asarray(slope_at(values, objective.points, objective.kind))[:points]
    steep = np.abs(slope)
    direction = np.where(steep > 0.0, slope, 1.0) / np.where(steep > 0.0, steep, 1.0)
    turned = misfit * np.conj(direction)
    freedom = points - parameters / 2.0
    noise = max(float(np.sqrt(np.sum(np.imag(turned) ** 2) / freedom)), SMALLEST)
    excess = np.sum(np.real(turned) ** 2) * points / freedom - points * noise**2
    jitter = float(np.sqrt(max(excess, 0.0) / np.sum(steep**2)))
    along = np.hypot(noise, jitter * steep)
    return objective.with_errors(along, np.full(points, noise), direction), noise, jitter


_SETTLED = 1e-10
"""Estimated distance of chi2 to its minimum at which the polish stops."""
_HZ_PER_KHZ = 1e3
_ROUNDS = 3
"""How often errors are estimated and the fit repeated; in the third round little changes."""


@dataclass(frozen=True)
class SweepFit:
    """A minimum of chi2 and what belongs to it; `data` counts the numbers measured, two a point with phase."""

    objective: SweepObjective
    coordinates: Float[np.ndarray, " p"]
    values: Float[np.ndarray, " p"]
    residual: Float[np.ndarray, " n"]
    covariance: Float[np.ndarray, "p p"]
    convergence: Convergence
    errors: PointErrors
    reverse: bool
    data: int

    @property
    def chi2(self) -> float:
        """Sum of squared residuals."""
        return float(np.sum(self.residual**2))

    @property
    def aic(self) -> float:
        """Akaike's criterion."""
        return self.chi2 + 2.0 * len(self.values)

    @property
    def freedom(self) -> int:
        """Numbers measured less parameters."""
        return self.data - len(self.values)

    @property
    def points(self) -> int:
        """The number of points of the frequency scan."""
        return self.data // (2 if self.objective.kind == "phase" else 1)


def kind_of(sweep: ResonanceSweep) -> str:
    """Return "phase" or "amplitude": what of a sweep is fitted."""
    if sweep.spectrum:
        return "power"
    return "amplitude" if sweep.phase_deg is None else "phase"


def fit_sweep(sweep: ResonanceSweep, background: str, noise: float | None, *, scale_errors: bool) -> SweepFit:
    """Fit a sweep in front of a background.

    Args:
        sweep: the sweep.
        background: a key of `TERMS` for the sweep's kind.
        noise: error of every point as a share of the largest amplitude, or None.
        scale_errors: scale given errors such that chi2/dof = 1.
    """
    kind = kind_of(sweep)
    terms = TERMS[kind][background]
    grids = []
    for reverse in (False, True) if kind == "phase" else (False,):
        points = points_of(sweep, reverse=reverse)
        grids.append((*starts(points, sweep.points, kind, terms), reverse))
    values, square, reverse = min(grids, key=lambda grid: grid[1])
    data = sweep.points * (2 if kind == "phase" else 1)
    along, across = first_errors(sweep, noise, np.sqrt(square / max(data - terms - 2, 1)))
    best = values[0]
    names = ("frequency_khz", "quality_factor", *LINEAR_NAMES[kind][:terms])
    problem = SweepProblem(background, names, reference_khz=float(best[0]), width_khz=float(best[0] / best[1] / 2.0))
    objective = SweepObjective(points_of(sweep, reverse=reverse), kind, problem).with_errors(along, across)
    coordinates = _polished(objective, problem.coordinates(values))
    if sweep.spectrum:
        factor = 1.0 if sweep.averages and not scale_errors else _misfit(objective, coordinates, data)
        objective = objective.with_errors(along * factor, across)
        scatter = float(along[0] * factor)
        origin = "averages" if sweep.averages else "estimated"
        scale = factor if scale_errors and sweep.averages else None
        errors = PointErrors(origin, scale, 0.5 * scatter * float(np.median(sweep.amplitude)), None)
    elif sweep.amplitude_error is None and noise is None:
        objective, coordinates, errors = _estimated(objective, coordinates, sweep, data)
    else:
        factor = _misfit(objective, coordinates, data) if scale_errors else 1.0
        # A fit without any misfit keeps its errors.
        factor = factor if factor > 0.0 else 1.0
        objective = objective.with_errors(along * factor, across * factor)
        origin = "noise" if sweep.amplitude_error is None else "file"
        typical = float(np.median(along) * factor * sweep.amplitude.max())
        errors = PointErrors(origin, factor if scale_errors else None, typical, None)
    return _finished(objective, coordinates, errors, reverse=reverse, data=data)


def _estimated(
    objective: SweepObjective, coordinates: Float[np.ndarray, " p"], sweep: ResonanceSweep, data: int
) -> tuple[SweepObjective, Float[np.ndarray, " p"], PointErrors]:
    """Estimate the errors from the misfit and fit again, a few times over."""
    level = jitter = 0.0
    for _ in range(_ROUNDS):
        values = objective.problem.values(coordinates)
        objective, level, jitter = with_estimated_errors(objective, values, sweep.points)
        coordinates = _polished(objective, coordinates[None])
    # The two sums of squares are met, their weighted sum only nearly; a sweep without noise keeps its least errors.
    factor = _misfit(objective, coordinates, data) if level > SMALLEST else 1.0
    along, across = factor / np.asarray(objective.points.weight)[: sweep.points].T
    jitter_hz = _HZ_PER_KHZ * jitter * factor if objective.kind == "phase" else None
    errors = PointErrors("estimated", None, float(level * factor * sweep.amplitude.max()), jitter_hz)
    return objective.with_errors(along, across), coordinates, errors


def refit(fit: SweepFit, sweep: ResonanceSweep, background: str) -> SweepFit:
    """Fit the same sweep with the same errors in front of another background."""
    kind = fit.objective.kind
    terms = TERMS[kind][background]
    values, _ = starts(fit.objective.points, sweep.points, kind, terms)
    # Beside the grid's points: the fit that is there already, its linear parameters cut or filled up with zeros.
    known = np.zeros(terms + 2)
    kept = min(len(known), len(fit.values))
    known[:kept] = fit.values[:kept]
    values[-1] = known
    problem = fit.objective.background
    names = ("frequency_khz", "quality_factor", *LINEAR_NAMES[kind][:terms])
    own = SweepProblem(background, names, reference_khz=problem.reference_khz, width_khz=problem.width_khz)
    objective = SweepObjective(fit.objective.points, kind, own)
    coordinates = _polished(objective, own.coordinates(values))
    return _finished(objective, coordinates, fit.errors, reverse=fit.reverse, data=fit.data)


def _polished(objective: SweepObjective, starting: Float[np.ndarray, "starts p"]) -> Float[np.ndarray, " p"]:
    result = polish(objective, starting, PLAIN, settled=_SETTLED)
    return result.coordinates[lowest(result.objective)]


def _misfit(objective: SweepObjective, coordinates: Float[np.ndarray, " p"], data: int) -> float:
    """Return the root of chi2/dof."""
    residual, _ = objective.linearise(coordinates[None])
    return float(np.sqrt(np.sum(residual**2) / (data - len(coordinates))))


def _finished(objective: SweepObjective, coordinates, errors: PointErrors, *, reverse: bool, data: int) -> SweepFit:
    residual, jacobian = objective.linearise(coordinates[None])
    values, slopes = objective.problem.values_and_slopes(coordinates)
    convergence = check_minimum(objective, coordinates, np.ones(len(values), dtype=bool))
    covariance = whole_covariance_of(jacobian[0].T @ jacobian[0])
    if np.all(np.isfinite(covariance)):
        covariance = covariance * np.outer(slopes, slopes)
    return SweepFit(objective, coordinates, values, residual[0], covariance, convergence, errors, reverse, data)
