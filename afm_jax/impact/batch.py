"""Many tips at once, at full speed: blocks of lanes that fit the processor's cache, one after the other.

A plain `vmap` over 100,000 tips streams every intermediate result through main memory, and all tips wait for the one
that needs most steps. Blocks of some hundred lanes do neither; `afm-jax bench` shows the difference.
"""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, ArrayLike, Float

from afm_jax.apparatus.scene import Scene
from afm_jax.impact.first_impact import DEFAULT_MAX_STEPS, DEFAULT_ROOT_TOLERANCE_US
from afm_jax.impact.law import impact_law_of
from afm_jax.impact.poincare import NextImpact, iterate_map
from afm_jax.parameters import require_float64

DEFAULT_BLOCK = 1000
"""Lanes that run together; 300 to 2000 differ little on processors with vector units and 0.5 to 2 MB of cache."""


def iterate_batch(
    scene: Scene,
    time_us: ArrayLike,
    velocity_nm_per_us: ArrayLike,
    impacts: int,
    *,
    block: int = DEFAULT_BLOCK,
    max_steps: int = DEFAULT_MAX_STEPS,
    root_tolerance_us: ArrayLike = DEFAULT_ROOT_TOLERANCE_US,
) -> NextImpact:
    """Return the impacts of many tips: `iterate_map` for every row of a batch of any size.

    Args:
        scene: a scene whose interaction is an `ImpactLaw`; each parameter a scalar for all rows, or of shape (batch,).
        time_us: when the first flights start, shape (batch,).
        velocity_nm_per_us: tip velocities in the lab then, shape (batch,).
        impacts: how many impacts to follow.
        block: how many tips run together; does not change a result.
        max_steps: steps of the search for one impact before it gives up.
        root_tolerance_us: remaining error of an impact time at which a search stops.

    Returns:
        A `NextImpact` of shape (batch, impacts), differentiable in scene and starts.

    Raises:
        RuntimeError: if JAX is not set to 64-bit floats, or was not when the scene was built.
        TypeError: if the scene's interaction is not an impact law.
        ValueError: if shapes do not fit together, or `impacts` or `block` is not positive.
    """
    require_float64(scene)
    impact_law_of(scene)
    dtype = scene.platform.frequency_khz.dtype
    times, velocities = jnp.asarray(time_us, dtype), jnp.asarray(velocity_nm_per_us, dtype)
    _check(scene, times, velocities, impacts, block)
    tolerance = jnp.asarray(root_tolerance_us, dtype)
    return _iterate_batch(scene, (times, velocities), tolerance, impacts=impacts, block=block, max_steps=max_steps)


def _check(scene: Scene, times: Array, velocities: Array, impacts: int, block: int) -> None:
    if times.ndim != 1 or times.shape != velocities.shape or times.size == 0:
        raise ValueError(
            "`time_us` and `velocity_nm_per_us` must have one shape (batch,) with at least one row, "
            f"but have {times.shape} and {velocities.shape}"
        )
    for leaf in jax.tree.leaves(scene):
        if leaf.ndim and leaf.shape != times.shape:
            raise ValueError(
                f"a parameter of the scene has shape {leaf.shape}; it must be a number or match {times.shape}"
            )
    for name, value in (("impacts", impacts), ("block", block)):
        if value < 1:
            raise ValueError(f"`{name}` must be a positive integer, but is {value}")


@partial(jax.jit, static_argnames=("impacts", "block", "max_steps"))
def _iterate_batch(
    scene: Scene,
    starts: tuple[Float[Array, " batch"], Float[Array, " batch"]],
    tolerance: Float[Array, ""],
    *,
    impacts: int,
    block: int,
    max_steps: int,
) -> NextImpact:
    own, shared = eqx.partition(scene, jax.tree.map(lambda leaf: leaf.ndim > 0, scene))
    batch = starts[0].shape[0]
    blocks = -(-batch // block)
    width = -(-batch // blocks)

    def into_blocks(rows):
        # The last block is filled up with copies of the last row, so that every block is the same program.
        return jnp.pad(rows, (0, blocks * width - batch), mode="edge").reshape(blocks, width)

    def one_tip(row):
        own_parameters, (time, velocity) = row
        return iterate_map(
            eqx.combine(own_parameters, shared),
            time,
            velocity,
            impacts,
            max_steps=max_steps,
            root_tolerance_us=tolerance,
        )

    rows = lax.map(jax.vmap(one_tip), jax.tree.map(into_blocks, (own, starts)))
    return jax.tree.map(lambda part: part.reshape(blocks * width, impacts)[:batch], rows)
