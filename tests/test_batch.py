"""Batches in blocks: the same impacts as one by one, for any batch size."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from afm_jax import Scene, iterate_map
from afm_jax.dynamics.starts import evenly_spread
from afm_jax.impact.map import iterate_batch
from afm_jax.scenefile.scenefile import load_scene

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


def test_a_parameter_of_another_length_is_named():
    scene = with_r(load_scene("figure2"), jnp.full(3, 0.5))
    with pytest.raises(ValueError, match=r"shape \(3,\).*match \(2,\)"):
        iterate_batch(scene, jnp.zeros(2), jnp.full(2, 6.0), 1)
