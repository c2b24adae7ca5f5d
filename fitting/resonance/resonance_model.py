"""The driven damped oscillator in front of a background: the model that a free resonance sweep is fitted with.

m z'' + (m Omega/Q) z' + k z = F cos(omega t), Omega^2 = k/m, has the response z = |A L| cos(omega t + arg(A L)) with

    L(f) = (f0^2/Q) / (f0^2 - f^2 + i f f0/Q),    f0 = Omega/2 pi,

which is -i at f0. A base that moves by d cos(omega t) is the force F = k d; a detector that sees the deflection against
the base, z - d, adds a constant to A L, and so do electrical crosstalk and the rest of the piezo's spectrum. Therefore

    with phase:      z(f) = A L + B + C x            (A, B, C complex; x from -1 to 1 over the sweep)
    amplitude only:  |z|^2 = a |L|^2 + b + c Re L     (b also holds noise in quadrature)

of which a background keeps the first terms (``TERMS``). The second line is |A L + B|^2 up to terms of the order 1/Q^2,
in parameters that the amplitude determines; A and B themselves it leaves ambiguous.
"""

from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from fitting.forward import Linearised, Prediction
from fitting.models import Problem
from fitting.optimise import BATCH, Objective
from fitting.parameters import Numbers, Parameter
from fitting.resonance.resonance_sweep import ResonanceSweep

TERMS = {
    "phase": {"none": 2, "constant": 4, "linear": 6},
    "amplitude": {"none": 1, "floor": 2, "constant": 3},
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
    weight: Float[Array, "n 2"]  # 1/error along that direction and across it


@dataclass(frozen=True)
class LinearParameter(Parameter):
    """A parameter whose coordinate is (value - reference)/scale."""

    scale: float = 1.0

    def to_coordinate(self, value: Numbers) -> Numbers:
        """Return the optimiser's coordinate of a value."""
        return (value - self.reference) / self.scale

    def from_coordinate(self, coordinate: Numbers) -> Numbers:
        """Return the value at a coordinate."""
        return self.reference + self.scale * coordinate

    def slope(self, coordinate: Numbers) -> Numbers:
        """Return d value/d coordinate."""
        return np.full_like(coordinate, self.scale)


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
        frequency = LinearParameter(
            "frequency_khz", "kHz", "natural frequency", 0.0, far, self.reference_khz, scale=self.width_khz
        )
        quality_factor = Parameter("quality_factor", "", "quality factor", lowest=0.5, highest=1e9)
        return (frequency, quality_factor, *(LinearParameter(name, "", "", -far, far) for name in self.names[2:]))


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
        turned = points.turn * (model_at(one, points, kind) - points.measured)
        along = turned.real * points.weight[:, 0]
        return jnp.concatenate([along, turned.imag * points.weight[:, 1]]) if kind == "phase" else along

    return jax.vmap(residual)(values), jax.vmap(jax.jacfwd(residual))(values)


class SweepObjective(Objective):
    """Chi2 of a sweep and a background; the optimiser, the checks and the intervals of `fitting` work on it."""

    def __init__(self, points: Points, kind: str, problem: SweepProblem):
        """Keep what every evaluation shares."""
        self.points, self.kind, self.problem = points, kind, problem

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
        """Return the same with other errors, in a direction of their own where one is given."""
        rows = len(self.points.amplitude)
        weight = np.pad(1.0 / np.stack([along, across], axis=1), ((0, rows - len(along)), (0, 0)))
        points = self.points._replace(weight=jnp.asarray(weight))
        if direction is not None:
            turn = np.pad(np.conj(direction), (0, rows - len(direction)), constant_values=1.0)
            points = points._replace(turn=jnp.asarray(turn))
        return SweepObjective(points, self.kind, self.problem)


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
