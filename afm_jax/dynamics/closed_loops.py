"""Closed loops where parameters are at shares of their ranges: what is solved for a point of a curve, and its solution.

The unknowns of `impact_loop` are followed by the parameters' shares. Newton's method closes a loop in a plane, with a
test function that vanishes besides on curves in two parameters:

    fold             the tangent's share in the parameter, on curves in two parameters 1 - T + D
    period_doubling  1 + T + D, a multiplier -1
    torus            D - 1 with |T| < 2, a pair of multipliers on the unit circle
    grazing          the lowest point of a flight above the surface; or an impact without adhesion whose speed vanishes
    capture          the distance of the slowest impact from capture
"""

from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from afm_jax.apparatus.scene import Scene
from afm_jax.dynamics.contact_orbits import ContactFlights, CurveUnits
from afm_jax.dynamics.impact_loop import (
    ImpactLoop,
    LoopReading,
    closing_gaps,
    impacts_at,
    loop_of,
    nearest_approach,
    reading_of,
    trace_and_determinant_of,
)
from afm_jax.scenefile.parameter_paths import ParameterRange, with_numbers
from afm_jax.solve.arclength import EquationsAt, point_in_plane
from afm_jax.solve.derivatives import largest
from afm_jax.solve.lanes import in_blocks
from afm_jax.solve.newton import Newton

KINDS = ("fold", "period_doubling", "torus", "grazing", "capture")
FOLD, DOUBLING, TORUS, GRAZING, CAPTURE = range(len(KINDS))
_CLOSING = Newton(rounds=12, step_tolerance=1e-11)
"""Steps towards a point: phases in rad, speeds of the fastest impact, parameters of their ranges."""
BLOCK = 64
"""Points of a curve read together: one program."""


class Frame(NamedTuple):
    """What a curve is followed in: the scene, N, the coordinates' scale, and the parameters' ranges."""

    scene: Scene
    order: Float[Array, ""]
    scale: Float[Array, ""]
    low: Float[Array, " parameters"]
    width: Float[Array, " parameters"]


class Equations(NamedTuple):
    """What is solved, a different program each: which parameters move, and which test function is 0; None: none is."""

    paths: tuple[str, ...]
    driven: str
    samples: int
    kind: int | None = None
    flights: ContactFlights | None = None
    """Of a scene with a contact, whose equations are simulated."""


def frame_of(scene: Scene, order: int, scale: float, ranges: Sequence[ParameterRange]) -> Frame:
    """Return what curves in some parameters are followed in; the scale in nm/us."""
    low, high = (jnp.asarray([getattr(one, end) for one in ranges]) for end in ("low", "high"))
    return Frame(scene, jnp.asarray(float(order)), jnp.asarray(scale), low, high - low)


def loop_at(shares: Float[Array, " parameters"], frame: Frame, equations: Equations) -> ImpactLoop:
    """Return what is closed where the parameters are at shares of their ranges."""
    values = dict(zip(equations.paths, frame.low + frame.width * shares, strict=True))
    return loop_of(with_numbers(frame.scene, values), frame.order, equations.driven)


def split_point(point: Array, equations: Equations) -> tuple[Array, Array]:
    """Return the unknowns of a point and the parameters' shares."""
    count = point.shape[0] - len(equations.paths)
    return point[:count], point[count:]


def _tests(unknowns: Array, frame: Frame, loop: ImpactLoop, equations: Equations) -> list[Array]:
    """Return the test functions in the order of `KINDS`, without dimension."""
    trace, determinant = trace_and_determinant_of(unknowns, frame.scale, loop)
    near = nearest_approach(unknowns, frame.scale, loop, equations.samples).gap_nm
    if equations.kind == CAPTURE:
        near = jnp.minimum(near, _rise_when_captured(unknowns, frame, loop))
    speeds = unknowns[unknowns.shape[0] // 2 :]
    slowest = -largest(-speeds) if speeds.size else jnp.inf
    return [
        1.0 - trace + determinant,
        1.0 + trace + determinant,
        determinant - 1.0,
        near * loop.cantilever.angular_frequency / frame.scale,
        slowest - loop.impact.lowest / frame.scale,
    ]


def _rise_when_captured(unknowns: Array, frame: Frame, loop: ImpactLoop) -> Array:
    """Return how the gap opens after the slowest impact, which leaves without speed: z'' - z_p'' over Omega^2, in nm.

    Where it is negative the tip passes through the surface, in a dip too shallow and short to be seen among samples.
    """
    impacts = impacts_at(unknowns, frame.scale, loop)
    slowest = jnp.argmin(unknowns[unknowns.shape[0] // 2 :])
    leaving, height, velocity = impacts.leaving_us[slowest], impacts.height[slowest], impacts.velocity[slowest]
    omega, decay = loop.cantilever.angular_frequency, loop.cantilever.decay_rate
    return -height - (2.0 * decay * velocity + jax.grad(loop.surface.velocity)(leaving)) / omega**2


def equations_at(point: Float[Array, " n"], frame: Frame, equations: Equations) -> Float[Array, " rows"]:
    """Return what is to be 0 at unknowns followed by the parameters' shares."""
    unknowns, shares = split_point(point, equations)
    loop = loop_at(shares, frame, equations)
    gaps = closing_gaps(unknowns, frame.scale, loop)
    if equations.kind is None:
        return gaps
    test = _tests(unknowns, frame, loop, equations)[equations.kind]
    return jnp.append(gaps, test)


class CurvePoint(NamedTuple):
    """A point of a curve: its coordinates, the curve's tangent, the test functions, and the longest delay."""

    point: Any
    tangent: Any
    tests: Any
    delay: Any


@partial(jax.jit, static_argnames=("equations",))
def _linearised(frame: Frame, point: Array, equations: Equations) -> tuple[Array, Array]:
    def twice(point):
        value = equations_at(point, frame, equations)
        return value, value

    slopes, value = jax.jacfwd(twice, has_aux=True)(point)
    return value, slopes


@partial(jax.jit, static_argnames=("equations",))
def _tests_and_delay(frame: Frame, point: Array, equations: Equations) -> tuple[Array, Array]:
    unknowns, shares = split_point(point, equations)
    loop = loop_at(shares, frame, equations)
    delay = jnp.zeros(())
    if loop.impact.delayed:
        delays = impacts_at(unknowns, frame.scale, loop).speeds.delay
        delay = jnp.max(jnp.abs(delays)) * loop.angular_frequency / (2.0 * jnp.pi)
    return jnp.stack(_tests(unknowns, frame, loop, equations)), delay


def solved_point(frame: Frame, guess: np.ndarray, row: np.ndarray, equations: Equations) -> CurvePoint | None:
    """Return the point of a curve in the plane through a guess across a row, NumPy arrays; None where there is none."""
    flights = equations.flights

    def linearised(point: np.ndarray) -> EquationsAt | None:
        if flights is not None:
            return flights.linearised(point, units_of(frame), equations.kind)
        return EquationsAt(*(np.asarray(part) for part in _linearised(frame, jnp.asarray(point), equations)))

    point = point_in_plane(linearised, guess, row, _CLOSING)
    if point is None:
        return None
    if flights is None:
        tests, delay = (np.asarray(part) for part in _tests_and_delay(frame, jnp.asarray(point.x), equations))
    else:
        tests, delay = flights.tests(point.details, units_of(frame)), 0.0
    return CurvePoint(point.x, point.tangent, tests, delay)


def units_of(frame: Frame) -> CurveUnits:
    """Return what a frame measures speeds and parameters in."""
    return CurveUnits(float(frame.scale), np.asarray(frame.low), np.asarray(frame.width))


@partial(jax.jit, static_argnames=("equations",))
def _read(frame: Frame, points: Array, equations: Equations) -> LoopReading:
    def one(point):
        unknowns, shares = split_point(point, equations)
        return reading_of(unknowns, frame.scale, loop_at(shares, frame, equations), equations.samples)

    return jax.vmap(one)(points)


def read_points(points: Float[np.ndarray, "points n"], frame: Frame, equations: Equations) -> LoopReading:
    """Return what there is to know of the orbits at points of a curve, NumPy arrays."""
    if equations.flights is not None:
        return equations.flights.readings_of_points(points, units_of(frame))
    return in_blocks(lambda block: _read(frame, block, equations), points, block=BLOCK, widths=())
