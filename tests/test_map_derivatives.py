"""Derivatives through the impact map, by every parameter and in every lane, against differences with 50 digits."""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from afm_jax.impact.map import iterate_map, next_impact
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


def leaf_of(made: Any, name: str) -> Any:
    """Return the leaf of a scene that holds a parameter of the reference."""
    where = {
        "frequency_khz": made.cantilever.frequency_khz,
        "quality_factor": made.cantilever.quality_factor,
        "drive_frequency_khz": made.platform.frequency_khz,
        "amplitude_nm": made.platform.amplitude_nm,
        "offset_nm": made.platform.offset_nm,
    }
    delay = made.interaction.delay
    part = {"delay0": delay.hertz, "delay1": delay.lead_nm, "delay2": delay.offset_nm}
    return (where | part).get(name) if name in where | part else getattr(made.interaction, name)


def ends(made, start):
    """Return time and velocity after the next impact."""
    impact = next_impact(made, start[0], start[1])
    return jnp.stack([impact.time_us, impact.velocity_after_nm_per_us])


def moved(p: Parameters, name: str, step: Any) -> Parameters:
    if name.startswith("delay"):
        delay = [mp.mpf(part) for part in DELAY]
        delay[int(name[-1])] += step
        return dataclasses.replace(p, delay=tuple(delay))
    return dataclasses.replace(p, **{name: mp.mpf(getattr(p, name)) + step})


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


@pytest.fixture(scope="session")
def slopes():
    """The map's derivatives by every leaf of the scene, forward and reverse."""
    made, start = scene_of(P), jnp.array(START)
    return [jax.jit(mode(ends))(made, start) for mode in (jax.jacfwd, jax.jacrev)]


@pytest.mark.parametrize("name", [*NAMES, "delay0", "delay1", "delay2"])
def test_every_parameter_has_the_derivative_that_differences_show(slopes, name):
    exact = differences(name)
    assert np.any(np.abs(exact) > 0)
    for slope in slopes:
        # Derivatives are rounded like the map, relative to terms up to 100 times as large.
        np.testing.assert_allclose(leaf_of(slope, name), exact, rtol=1e-11, atol=1e-14)


def test_the_mass_has_no_say_and_the_ramp_has_that_of_differences(slopes):
    start = jnp.array(START)
    ahead, behind = (ends(scene_of(P, offset_rate_nm_per_us=s), start) for s in (1e-5, -1e-5))
    for slope in slopes:
        np.testing.assert_array_equal(slope.cantilever.mass_ng, 0.0)
        # Differences: rounding of 1e-13 over 2e-5.
        np.testing.assert_allclose(slope.platform.offset_rate_nm_per_us, (ahead - behind) / 2e-5, rtol=1e-7)


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
    expected = [
        Outcome.IMPACT,
        Outcome.CAPTURED,
        Outcome.NO_FURTHER_IMPACT,
        Outcome.INVALID_START,
        Outcome.INVALID_START,
    ]
    assert [int(o) for o in outcome] == expected
    by_scene, by_start = jax.jit(jax.vmap(jax.grad(value, argnums=(0, 1), has_aux=True)))(made, starts)[0]
    # The last lane starts at no number; its own derivative may be none, the others' not.
    for leaf in jax.tree.leaves((by_scene, by_start)):
        assert np.all(np.isfinite(leaf[:4]))
    assert np.all(np.asarray(by_start[0]) != 0.0)
    np.testing.assert_array_equal(by_start[1:4], 0.0)


@pytest.mark.slow
def test_second_derivatives_through_a_sequence_are_right():
    # Reverse mode through a scan treats rules of differentiation in its own way: once a source of wrong Hessians.
    p = scene()
    made = scene_of(p)
    rows = iterate_map(made, *START, 2)
    guesses = [float(time) for time in rows.arrival_time_us]

    def exact(time, velocity):
        for guess in guesses:
            impact = exact_impact(p, time, velocity, guess)
            time, velocity = impact.time_us, impact.velocity_after_nm_per_us
        return time

    with mp.workdps(60):
        at = (mp.mpf(START[0]), mp.mpf(START[1]))
        expected = [float(mp.diff(exact, at, orders)) for orders in ((2, 0), (1, 1), (0, 2))]

    def automatic(start):
        return iterate_map(made, start[0], start[1], 2).time_us[-1]

    hessian = np.asarray(jax.jit(jax.jacfwd(jax.jacrev(automatic)))(jnp.array(START)))
    # Second derivatives add up terms up to 1e3 times as large.
    np.testing.assert_allclose(hessian[[0, 0, 1], [0, 1, 1]], expected, rtol=1e-9)


def test_a_captured_tip_has_finite_derivatives_of_its_time():
    made = bouncing(delay=None)
    slope = jax.grad(lambda start: next_impact(made, start[0], start[1]).arrival_time_us)(jnp.array([0.0, 2.0]))
    assert np.all(np.isfinite(slope))
    impact = next_impact(made, 0.0, 2.0)
    assert int(impact.outcome) == Outcome.CAPTURED
    after = jax.grad(lambda one: next_impact(one, 0.0, 2.0).velocity_after_nm_per_us)(made)
    assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(eqx.filter(after, eqx.is_array)))
