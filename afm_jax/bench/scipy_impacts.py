"""The same problem with general-purpose integrators, SciPy's or SUNDIALS': an event, restarted after every impact."""

import math
import time
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from afm_jax.apparatus.scene import Scene
from afm_jax.bench.integrators import Integrator, integrate_to_event

_STEPS_A_PERIOD = 3
"""At least so many: an event is seen by its signs at the ends of a step, and longer ones would miss impacts."""
_LONGEST_FLIGHT_PERIODS = 50


class ScipyRun(NamedTuple):
    """Impacts by a general-purpose integrator.

    ``states``: time in us and velocity after, shape (impacts + 1, 2), the start first; ``seconds``: time taken;
    ``evaluations``: of the equation of motion, over all impacts.
    """

    states: NDArray[np.float64]
    seconds: float
    evaluations: int


def scipy_impacts(
    scene: Scene, start: tuple[float, float], impacts: int, *, tolerance: float, method: str = "DOP853"
) -> ScipyRun:
    """Follow a tip over a number of impacts (eqs. 2, 3 and 6, without collision delay and ramp).

    Args:
        scene: a scene with plain numbers.
        start: time in us and velocity just after an impact.
        impacts: how many.
        tolerance: relative and absolute tolerance, the latter in nm and nm/us.
        method: see `Integrator`.

    Raises:
        ValueError: if the tip is captured or meets no platform within 50 drive periods.
    """
    constants = _Constants.of(scene)
    states, evaluations = [start], 0
    began = time.perf_counter()
    for _ in range(impacts):
        state, calls = _next(constants, states[-1], tolerance, method)
        states.append(state)
        evaluations += calls
    return ScipyRun(np.array(states), time.perf_counter() - began, evaluations)


class _Constants(NamedTuple):
    """A scene as Python floats, which is what SciPy's callbacks are fastest with."""

    omega_squared: float
    damping: float
    amplitude: float
    drive: float
    offset: float
    r: float
    epsilon: float
    viscous_loss: float

    @classmethod
    def of(cls, scene: Scene) -> "_Constants":
        law, cantilever, platform = scene.interaction, scene.cantilever, scene.platform
        return cls(
            float(cantilever.angular_frequency) ** 2,
            2.0 * float(cantilever.decay_rate),
            float(platform.amplitude_nm),
            float(platform.angular_frequency),
            float(platform.offset_nm),
            float(law.r),
            float(law.epsilon),
            float(law.viscous_loss),
        )


def _next(k: _Constants, start: tuple[float, float], tolerance: float, method: str) -> tuple[tuple[float, float], int]:
    t1, velocity = start
    period = 2.0 * math.pi / k.drive

    def motion(_, state):
        return (state[1], -k.omega_squared * state[0] - k.damping * state[1])

    def gap(t, state):
        # the start itself is no event, whatever rounding makes of its gap of 0
        return state[0] - k.offset - k.amplitude * math.cos(k.drive * t) if t > t1 else 1.0

    flight = integrate_to_event(
        motion,
        (t1, t1 + _LONGEST_FLIGHT_PERIODS * period),
        (k.offset + k.amplitude * math.cos(k.drive * t1), velocity),
        [gap],
        Integrator(method, tolerance, tolerance, period / _STEPS_A_PERIOD),
        direction=-1.0,
    )
    arrival = flight.time
    platform_velocity = -k.amplitude * k.drive * math.sin(k.drive * arrival)
    approach = platform_velocity - float(flight.state[1])
    square = (k.r * approach) ** 2 - k.viscous_loss * approach - k.epsilon
    if approach <= 0.0 or square <= 0.0:
        raise ValueError(f"the platform captures the tip at {arrival:g} us")
    return (arrival, platform_velocity + math.sqrt(square)), flight.evaluations
