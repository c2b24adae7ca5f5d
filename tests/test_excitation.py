"""Drives of base, tip and sample: responses and surfaces against SciPy's integration of eq. 16, and their limits."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from afm_jax.apparatus.cantilever import Cantilever
from afm_jax.apparatus.scene import Scene
from afm_jax.apparatus.surface import Surface, surface_of
from tests.driven_scenes import BASE, FORCE, MASS, PER_KHZ, PLATFORM, TIMES, both

OMEGA = PER_KHZ * 90.0

Signal = Callable[[Any], Any]


def base_motion(t: Any) -> Any:
    """Return `BASE` as the definition of a cosine says."""
    return 0.8 * np.cos(PER_KHZ * 88 * t + np.pi / 6) + 0.3 * np.cos(PER_KHZ * 181 * t - 7 * np.pi / 18)


def tip_force(t: Any) -> Any:
    """Return `FORCE` as the definition of a cosine says."""
    return 0.6 * np.cos(PER_KHZ * 93 * t + 10 * np.pi / 9) + 0.9 * np.cos(PER_KHZ * 40 * t + np.pi / 18)


def nothing(_: Any) -> float:
    return 0.0


def integrate(
    start: Any, *, quality: float | None, force: Signal = nothing, base: Signal = nothing, contact: Any = None
) -> Any:
    """Return z and z' of eq. 16, shape (2, times), in the lab."""
    stiffness, damping = MASS * OMEGA**2, 0.0 if quality is None else MASS * OMEGA / quality

    def rates(t, state):
        push = force(t) + stiffness * base(t) + (0.0 if contact is None else contact(t, state))
        return [state[1], (push - damping * state[1] - stiffness * state[0]) / MASS]

    span = (0.0, float(TIMES[-1]))
    run = solve_ivp(rates, span, start, method="DOP853", t_eval=TIMES, rtol=1e-13, atol=1e-13, max_step=0.2)
    return run.y


@pytest.mark.parametrize(
    ("base", "force", "quality"), [(BASE, None, 40.0), (None, FORCE, 2.0), (BASE, FORCE, 40.0), (BASE, FORCE, None)]
)
def test_a_free_tip_is_free_flight_plus_steady_response(base: Any, force: Any, quality: float | None):
    signals = ({"base": base_motion} if base else {}) | ({"force": tip_force} if force else {})
    cantilever = Cantilever(90.0, quality, MASS)
    _, response = surface_of(Scene(cantilever, PLATFORM, None, base, force))
    assert response is not None
    steady = both(response)
    # 1e-13 of 20 nm a step, over some 500 steps; near resonance it adds up
    np.testing.assert_allclose(integrate(steady[:, 0], quality=quality, **signals), steady, rtol=0, atol=2e-10)
    z0, v0 = 5.0, -12.0
    free = np.array([cantilever.propagator(t)(z0 - steady[0, 0], v0 - steady[1, 0]) for t in TIMES]).T
    np.testing.assert_allclose(integrate([z0, v0], quality=quality, **signals), free + steady, rtol=0, atol=2e-10)


def contact(gap: Any) -> Any:
    """Return a smooth contact force in nN: soft repulsion, some attraction further out."""
    return 40.0 * np.exp(-gap / 1.5) - 6.0 * np.exp(-((gap - 3.0) ** 2) / 4.0)


def test_the_gap_is_that_of_a_free_cantilever_over_the_surface():
    # the platform's motion as its definition says
    def height(t):
        return -1 + 1e-2 * t + 2 * np.cos(PER_KHZ * 180 * t) + 0.7 * np.cos(PER_KHZ * 33 * t + 5 * np.pi / 18)

    start = np.array([6.0, -20.0])
    lab = integrate(
        start, quality=40.0, base=base_motion, force=tip_force, contact=lambda t, state: contact(state[0] - height(t))
    )
    surface, response = surface_of(Scene(Cantilever(90.0, 40.0, MASS), PLATFORM, None, BASE, FORCE))
    assert response is not None
    steady = both(response)
    assert isinstance(surface, Surface)
    waves = [tuple(float(x) for x in (w.cosine, w.sine, w.angular_frequency)) for w in surface.waves]

    def over(t):
        return -1 + 1e-2 * t + sum(c * np.cos(w * t) + s * np.sin(w * t) for c, s, w in waves)

    moved = integrate(start - steady[:, 0], quality=40.0, contact=lambda t, state: contact(state[0] - over(t)))
    # 1e-13 a step, and contacts stretch errors by less than 100
    np.testing.assert_allclose(moved + steady, lab, rtol=0, atol=1e-9)
    np.testing.assert_allclose(moved - both(surface), lab - both(PLATFORM), rtol=0, atol=1e-9)
