"""Batches in blocks: the same impacts as one by one, for any batch size, and their derivatives."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from afm_jax import Scene, iterate_map
from afm_jax.bench.problems import regular_scene, scattered_starts
from afm_jax.impact.law import formula_of
from afm_jax.impact.map import iterate_batch
from afm_jax.verify.fifty_digits import derivatives_by_r

IMPACTS = 3


@pytest.mark.parametrize(("batch", "block"), [(1, 500), (7, 3), (7, 7), (8, 4)])
def test_blocks_change_nothing(batch: int, block: int):
    scene = regular_scene().scene
    time, velocity = (np.asarray(part)[:batch] for part in scattered_starts(scene, 8))
    rows = iterate_batch(scene, time, velocity, IMPACTS, block=block)
    alone = [iterate_map(scene, *start, IMPACTS) for start in zip(time, velocity, strict=True)]
    for name in ("time_us", "velocity_after_nm_per_us", "velocity_before_nm_per_us", "outcome", "near_grazing"):
        expected = np.stack([np.asarray(getattr(one, name)) for one in alone])
        # the same operations in another order of fused multiplications: a few roundings, grown by three impacts
        np.testing.assert_allclose(np.asarray(getattr(rows, name)), expected, rtol=1e-12, atol=1e-12)


def test_parameters_may_differ_from_row_to_row():
    scene = regular_scene().scene
    r = jnp.array([0.3, 0.5, 0.8])
    varied = eqx.tree_at(lambda one: one.interaction.r, scene, r)
    times = iterate_batch(varied, jnp.zeros(3), jnp.full(3, 6.0), IMPACTS, block=2).time_us
    for row in range(3):
        one = eqx.tree_at(lambda each: each.interaction.r, scene, r[row])
        expected = np.asarray(iterate_map(one, 0.0, 6.0, IMPACTS).time_us)
        np.testing.assert_allclose(np.asarray(times[row]), expected, rtol=1e-12)  # roundings, see above


def test_forward_and_reverse_derivatives_agree_with_50_digits():
    scene = regular_scene().scene
    starts = scattered_starts(scene, 3)

    def times(r: jax.Array) -> jax.Array:
        varied = eqx.tree_at(lambda one: one.interaction.r, scene, r)
        return iterate_batch(varied, starts.time_us, starts.velocity_nm_per_us, IMPACTS, block=2).time_us

    r = formula_of(scene).r
    found = np.asarray(jax.jit(times)(r))
    exact = [
        derivatives_by_r(scene, (float(time), float(speed)), lane)
        for time, speed, lane in zip(*starts, found, strict=True)
    ]
    for derivative in (jax.jacfwd, jax.jacrev):
        # three impacts lose at most three digits of sixteen
        np.testing.assert_allclose(np.asarray(jax.jit(derivative(times))(r)), np.array(exact), rtol=1e-12, atol=1e-13)


@pytest.mark.slow
def test_hessian_agrees_with_differences_of_the_gradient():
    # jax.custom_jvp would fail here: inside lax.scan its rule is lost in second derivatives over reverse mode
    scene = regular_scene().scene

    def last(values: jax.Array) -> jax.Array:
        varied = eqx.tree_at(lambda one: one.interaction.r, scene, values[0])
        return iterate_batch(varied, values[1:2], values[2:], 2).time_us[0, -1]

    point, step = np.array([0.5, 0.3, 6.0]), 1e-5
    gradient = jax.jit(jax.grad(last))
    moves = step * np.eye(3)
    rows = [np.asarray(gradient(point + move) - gradient(point - move)) / (2.0 * step) for move in moves]
    # a central difference with this step leaves step^2 = 1e-10 of the third derivative, and 1e-15/step = 1e-10
    np.testing.assert_allclose(np.asarray(jax.jit(jax.hessian(last))(point)), np.stack(rows), rtol=1e-6, atol=1e-8)


def test_a_parameter_of_another_length_is_named():
    scene: Scene = eqx.tree_at(lambda one: one.interaction.r, regular_scene().scene, jnp.full(3, 0.5))
    with pytest.raises(ValueError, match=r"shape \(3,\).*match \(2,\)"):
        iterate_batch(scene, jnp.zeros(2), jnp.full(2, 6.0), 1)


def test_a_slow_departure_is_not_taken_for_an_impact():
    # The gap stays below its rounding error for 1e-8 us: found by comparison with a fine scan of the exact flight.
    scene = regular_scene().scene
    time = jnp.linspace(0.0, 5.5, 2000)
    velocity = scene.platform.velocity(time) + 1e-6
    flown = iterate_batch(scene, time, velocity, 1)
    duration = np.asarray(flown.arrival_time_us[:, 0] - time)
    # g = w s + g'' s^2/2 at first: with g'' > 0 the tip leaves for good, with g'' < 0 it is back after 2 w/|g''|
    tip_acceleration = scene.cantilever.acceleration(scene.platform.position(time), velocity)
    opening = np.asarray(tip_acceleration - scene.platform.acceleration(time))
    assert (opening > 0.1).any()
    assert (opening < -0.1).any()
    # a flight that opens with g'' > 0.1 nm/us^2 lasts a good part of the 5.6 us period
    assert duration[opening > 0.1].min() > 0.01
    back = opening < -0.1
    # the next term of the series is relatively w omega^3 beta/g''^2 < 1e-2; rounding 1e-15/w/s = 1e-2 at worst
    np.testing.assert_allclose(duration[back], 2e-6 / -opening[back], rtol=5e-2)
