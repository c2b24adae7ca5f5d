"""Batches in blocks: the same impacts as one by one, for any batch size, and their derivatives."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from afm_jax import Scene, iterate_map
from afm_jax.dynamics.starts import evenly_spread
from afm_jax.impact.map import iterate_batch
from afm_jax.scenefile.scenefile import load_scene
from tests.reference_flight import Parameters, high_precision, mp
from tests.reference_map import iterate

IMPACTS = 3


def with_r(scene: Scene, r: jax.Array) -> Scene:
    return eqx.tree_at(lambda one: one.interaction.r, scene, r)


def scattered_starts(scene: Scene, batch: int) -> tuple[jax.Array, jax.Array]:
    """Return times all over the drive period, and departures at 0.5 to 4 times the platform's top speed."""
    first, second = evenly_spread(batch).T
    time = scene.platform.period_us * first
    return time, scene.platform.velocity(time) + (0.5 + 3.5 * second) * scene.platform.top_speed_nm_per_us


@pytest.mark.parametrize(("batch", "block"), [(1, 500), (7, 3), (8, 4)])
def test_blocks_change_nothing(batch: int, block: int, monkeypatch: pytest.MonkeyPatch):
    """The restitution differs from row to row."""
    monkeypatch.setattr("afm_jax.impact.map.BLOCK", block)
    scene, r = load_scene("figure2"), jnp.linspace(0.3, 0.8, batch)
    time, velocity = (np.asarray(part)[:batch] for part in scattered_starts(scene, 8))
    rows = iterate_batch(with_r(scene, r), time, velocity, IMPACTS)
    alone = [iterate_map(with_r(scene, r[row]), time[row], velocity[row], IMPACTS) for row in range(batch)]
    for name in ("time_us", "velocity_after_nm_per_us", "velocity_before_nm_per_us", "outcome", "near_grazing"):
        expected = np.stack([np.asarray(getattr(one, name)) for one in alone])
        # the same operations in another order of fused multiplications: a few roundings, grown by three impacts
        np.testing.assert_allclose(np.asarray(getattr(rows, name)), expected, rtol=1e-12, atol=1e-12)


@high_precision
def derivatives_by_r(scene: Scene, time_us: float, velocity: float) -> list[float]:
    """Return d(impact times)/dr in us by a central difference at 50 digits, right to about 30."""
    law, step = scene.interaction, mp.mpf("1e-15")
    quality = scene.cantilever.quality_factor
    own = Parameters(
        frequency_khz=float(scene.cantilever.frequency_khz),
        quality_factor=None if quality is None else float(quality),
        amplitude_nm=float(scene.platform.amplitude_nm),
        drive_frequency_khz=float(scene.platform.frequency_khz),
        offset_nm=float(scene.platform.offset_nm),
        r=float(law.r),
        epsilon=float(law.epsilon),
        viscous_loss=float(law.viscous_loss),
    )
    up, down = (iterate(replace(own, r=mp.mpf(own.r) + shift), time_us, velocity, IMPACTS) for shift in (step, -step))
    return [float((high.time_us - low.time_us) / (2 * step)) for high, low in zip(up, down, strict=True)]


def test_forward_and_reverse_derivatives_agree_with_50_digits(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("afm_jax.impact.map.BLOCK", 2)
    scene = load_scene("figure2")
    starts = scattered_starts(scene, 3)

    def times(r: jax.Array) -> jax.Array:
        return iterate_batch(with_r(scene, r), *starts, IMPACTS).time_us

    r = scene.interaction.r
    exact = [derivatives_by_r(scene, float(time), float(speed)) for time, speed in zip(*starts, strict=True)]
    for derivative in (jax.jacfwd, jax.jacrev):
        # three impacts lose at most three digits of sixteen
        np.testing.assert_allclose(np.asarray(jax.jit(derivative(times))(r)), np.array(exact), rtol=1e-12, atol=1e-13)


def test_a_parameter_of_another_length_is_named():
    scene = with_r(load_scene("figure2"), jnp.full(3, 0.5))
    with pytest.raises(ValueError, match=r"shape \(3,\).*match \(2,\)"):
        iterate_batch(scene, jnp.zeros(2), jnp.full(2, 6.0), 1)
