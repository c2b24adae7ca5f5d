"""Derivatives through the impact map, by every parameter and in every lane, against differences with 50 digits."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from afm_jax.impact.map import next_impact
from afm_jax.outcomes import Outcome
from tests.package_scenes import bouncing, scene_of, stacked
from tests.reference_examples import DELAY, scene
from tests.reference_flight import Parameters, mp
from tests.reference_map import next_impact as exact_impact

START = (4.0, 60.0)
P = scene(r=0.98, epsilon=100.0, viscous_loss=0.4, delay=DELAY)
NAMES = (
    "frequency_khz",
    "quality_factor",
    "amplitude_nm",
    "drive_frequency_khz",
    "offset_nm",
    "r",
    "epsilon",
    "viscous_loss",
)


VALUES: dict[str, Any] = {name: getattr(P, name) for name in NAMES} | {"delay": DELAY}
PARAMETERS = [*NAMES, "delay0", "delay1", "delay2"]


def named(values: dict[str, Any], name: str) -> Any:
    """Return a parameter of the reference, or what stands in its place; `delay1` is the second of the delay."""
    return values["delay"][int(name[-1])] if name.startswith("delay") else values[name]


def moved(p: Parameters, name: str, step: Any) -> Parameters:
    if name.startswith("delay"):
        delay = [mp.mpf(part) for part in DELAY]
        delay[int(name[-1])] += step
        return dataclasses.replace(p, delay=tuple(delay))
    return dataclasses.replace(p, **{name: mp.mpf(getattr(p, name)) + step})


def ends(made):
    """Return time and velocity after the next impact."""
    impact = next_impact(made, *START)
    return jnp.stack([impact.time_us, impact.velocity_after_nm_per_us])


def differences(name: str) -> list[float]:
    """Return d(time, velocity after)/d(parameter) with some 30 right digits."""
    guess = float(next_impact(scene_of(P), *START).arrival_time_us)
    with mp.workdps(90):
        step = mp.mpf(10) ** -25
        ahead, behind = (exact_impact(moved(P, name, s), *START, guess) for s in (step, -step))
        return [
            float((getattr(ahead, field) - getattr(behind, field)) / (2 * step))
            for field in ("time_us", "velocity_after_nm_per_us")
        ]


@pytest.fixture(scope="module")
def slopes():
    """The map's derivatives by every parameter, forward and reverse."""
    return [
        jax.jit(mode(lambda values: ends(scene_of(dataclasses.replace(P, **values)))))(VALUES)
        for mode in (jax.jacfwd, jax.jacrev)
    ]


@pytest.mark.parametrize("name", PARAMETERS)
def test_every_parameter_has_the_derivative_that_differences_show(slopes, name):
    exact = differences(name)
    assert np.any(np.abs(exact) > 0)
    for slope in slopes:
        # Derivatives are rounded like the map, relative to terms up to 100 times as large.
        np.testing.assert_allclose(named(slope, name), exact, rtol=1e-11, atol=1e-14)


def test_a_ramp_has_the_derivative_of_differences():
    def ramped(rate):
        return ends(scene_of(P, offset_rate_nm_per_us=rate))

    for mode in (jax.jacfwd, jax.jacrev):
        # Differences: rounding of 1e-13 over 2e-5.
        np.testing.assert_allclose(mode(ramped)(0.0), (ramped(1e-5) - ramped(-1e-5)) / 2e-5, rtol=1e-7)


@pytest.mark.parametrize("delayed", [False, True])
def test_derivatives_stay_finite_in_every_lane(delayed):
    delay: dict[str, Any] = {} if delayed else {"delay": None}
    far = bouncing(offset_nm=-40.0, quality_factor=5.0, **delay)
    near = bouncing(**delay)
    made = stacked([near, near, far, near, near])
    starts = jnp.array([[4.0, 60.0], [0.0, 2.0], [0.0, 8.0], [1.0, -50.0], [jnp.nan, 60.0]])

    def value(one, start):
        impact = next_impact(one, start[0], start[1])
        landed = impact.outcome == Outcome.IMPACT
        return jnp.where(landed, impact.time_us + impact.velocity_after_nm_per_us, 0.0), impact.outcome

    outcome = jax.vmap(value)(made, starts)[1]
    ends_of_flights = [Outcome.IMPACT, Outcome.CAPTURED, Outcome.NO_FURTHER_IMPACT, *2 * [Outcome.INVALID_START]]
    assert outcome.tolist() == ends_of_flights
    by_scene, by_start = jax.jit(jax.vmap(jax.grad(value, argnums=(0, 1), has_aux=True)))(made, starts)[0]
    # The last lane starts at no number; its own derivative may be none, the others' not.
    for leaf in jax.tree.leaves((by_scene, by_start)):
        assert np.all(np.isfinite(leaf[:4]))
    assert np.all(np.asarray(by_start[0]) != 0.0)
    np.testing.assert_array_equal(by_start[1:4], 0.0)
