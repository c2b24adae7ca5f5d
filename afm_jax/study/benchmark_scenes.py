"""The scenes that speed and accuracy are measured on, and where their tips start."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from afm_jax.apparatus.cantilever import Cantilever
from afm_jax.apparatus.platform import Platform
from afm_jax.apparatus.scene import Scene
from afm_jax.impact.batch import iterate_batch
from afm_jax.impact.law import ImpactLaw
from afm_jax.outcome import Outcome
from afm_jax.presets import FREE_FREQUENCY_KHZ, drive_frequency_khz, figure2_scene


class Starts(NamedTuple):
    """Where tips start: ``time_us`` and ``velocity_nm_per_us``, both of shape (batch,)."""

    time_us: Float[Array, " batch"]
    velocity_nm_per_us: Float[Array, " batch"]


class BenchmarkScene(NamedTuple):
    """A scene to measure, and whether a tip keeps its digits there.

    ``chaotic``: nearby tips part, so that errors can be told impact by impact only.
    """

    name: str
    scene: Scene
    chaotic: bool


def regular_scene() -> BenchmarkScene:
    """Return the scene of the stated aims: n = 1, beta = 2 nm, sigma = -1 nm, r = 0.5, undamped."""
    return BenchmarkScene("regular", figure2_scene(1.0, 2.0), chaotic=False)


def chaotic_scene() -> BenchmarkScene:
    """Return a scene between the tongues of orders 1 and 2: n = 1.5, r = 0.8, otherwise the regular one."""
    platform = Platform(2.0, drive_frequency_khz(1.5), -1.0)
    return BenchmarkScene("chaotic", Scene(Cantilever(FREE_FREQUENCY_KHZ), platform, ImpactLaw(0.8)), chaotic=True)


def grazing_scene() -> BenchmarkScene:
    """Return a scene with slow impacts and chatter, a platform above the rest position: n = 0.722, sigma = 1 nm."""
    platform = Platform(2.0, drive_frequency_khz(0.722), 1.0)
    return BenchmarkScene("grazing", Scene(Cantilever(FREE_FREQUENCY_KHZ), platform, ImpactLaw(0.8)), chaotic=True)


def high_order_scene() -> BenchmarkScene:
    """Return a scene with one impact in five drive periods: n = 5.02, beta = 4 nm, Q = 40, r = 0.9."""
    platform = Platform(4.0, drive_frequency_khz(5.02), 0.0)
    return BenchmarkScene(
        "order 5", Scene(Cantilever(FREE_FREQUENCY_KHZ, 40.0), platform, ImpactLaw(0.9)), chaotic=False
    )


def settled_starts(scene: Scene, batch: int, *, settling: int = 200, spread: float = 1e-2) -> Starts:
    """Return starts near where the motion settles, the first of them the same for every batch size.

    Args:
        scene: the scene.
        batch: how many.
        settling: impacts after which the motion counts as settled.
        spread: share of a drive period, and relative part of the rebound speed, by which starts on a regular
            attractor are scattered around it.

    Raises:
        ValueError: if tips do not stay in motion in this scene.
    """
    lanes = 64
    scattered = scattered_starts(scene, lanes)
    rows = iterate_batch(scene, scattered.time_us, scattered.velocity_nm_per_us, settling)
    flying = np.flatnonzero(np.asarray(rows.outcome[:, -1]) == Outcome.IMPACT)
    if flying.size == 0:
        raise ValueError("no tip stays in motion in this scene; speeds cannot be measured")
    lane = jnp.asarray(flying[np.arange(batch) % flying.size])
    period = scene.platform.period_us
    time = jnp.mod(rows.time_us[lane, -1], period)
    rebound = rows.velocity_after_nm_per_us[lane, -1] - scene.platform.velocity(rows.time_us[lane, -1])
    first, second = _evenly_spread(batch)
    moved = time + spread * period * (first - 0.5)
    return Starts(moved, scene.platform.velocity(moved) + rebound * (1.0 + spread * (second - 0.5)))


def scattered_starts(scene: Scene, batch: int) -> Starts:
    """Return starts all over the drive period, rebound speeds from 0.5 to 4 times the platform's top speed."""
    first, second = _evenly_spread(batch)
    time = scene.platform.period_us * first
    return Starts(time, scene.platform.velocity(time) + (0.5 + 3.5 * second) * scene.platform.top_speed_nm_per_us)


def _evenly_spread(batch: int) -> tuple[Float[Array, " batch"], Float[Array, " batch"]]:
    """Return pairs that fill the unit square evenly (multiples of the plastic number's powers, modulo 1)."""
    index = jnp.arange(1.0, batch + 1.0)
    plastic = 1.324717957244746
    return jnp.mod(index / plastic, 1.0), jnp.mod(index / plastic**2, 1.0)


def cast(scene: Scene, dtype: str) -> Scene:
    """Return a scene whose parameters have another precision, "float32" or "float64"."""
    return jax.tree.map(lambda leaf: leaf.astype(dtype), scene)
