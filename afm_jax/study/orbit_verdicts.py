"""Which of many scenes have a stable single-impact orbit: the question behind charts and amplitude curves."""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from afm_jax.apparatus.scene import Scene
from afm_jax.impact.orbits import single_impact_orbits

BLOCK = 1000
"""Scenes computed together: few enough for the cache, many enough to fill the vector units; one program."""


class OrbitVerdicts(NamedTuple):
    """What there is at each scene, one row an order 1, 2, ..., one column a scene (NumPy arrays).

    ``stable``: an orbit that is admissible and stable. ``admissible``: an admissible orbit, stable or not.
    ``peak_amplitude_nm``: of the stable one (the highest, if there are several); NaN where there is none.
    """

    stable: Bool[np.ndarray, "orders scenes"]
    admissible: Bool[np.ndarray, "orders scenes"]
    peak_amplitude_nm: Float[np.ndarray, "orders scenes"]

    def any_stable(self) -> Bool[np.ndarray, " scenes"]:
        """Return where an orbit of any order is stable."""
        return np.asarray(self.stable.any(axis=0))

    def any_admissible(self) -> Bool[np.ndarray, " scenes"]:
        """Return where an orbit of any order is admissible."""
        return np.asarray(self.admissible.any(axis=0))


def orbit_verdicts(
    scenes: Scene, *, first_order: int = 1, last_order: int, report: Callable[[int], object] = lambda _: None
) -> OrbitVerdicts:
    """Find the single-impact orbits of many scenes for a range of orders.

    Args:
        scenes: a batch of scenes: every parameter has shape (scenes,).
        first_order: lowest order N.
        last_order: highest order N.
        report: called with each order before it is computed.

    Raises:
        RuntimeError: if JAX is not set to 64-bit floats.
    """
    blocks, count = _blocks(scenes), jax.tree.leaves(scenes)[0].shape[0]
    rows = []
    for order in range(first_order, last_order + 1):
        report(order)
        found = [_one_order(block, jnp.asarray(float(order))) for block in blocks]
        rows.append([np.concatenate(column)[:count] for column in zip(*found, strict=True)])
    return OrbitVerdicts(*(np.stack(column) for column in zip(*rows, strict=True)))


def _blocks(scenes: Scene) -> list[Scene]:
    """Return a batch of scenes in blocks of one length, the last of them filled up."""

    def cut(leaf: Array) -> Float[np.ndarray, "blocks lanes"]:
        values = np.asarray(leaf)
        return np.pad(values, (0, -len(values) % BLOCK), mode="edge").reshape(-1, BLOCK)

    cut_up = jax.tree.map(cut, scenes)
    return [jax.tree.map(lambda leaf, one=one: leaf[one], cut_up) for one in range(len(jax.tree.leaves(cut_up)[0]))]


@eqx.filter_jit
def _one_order(scenes: Scene, order: Float[Array, ""]) -> tuple[Array, Array, Array]:
    def one(scene: Scene) -> tuple[Array, Array, Array]:
        orbits = single_impact_orbits(scene, order)
        admissible = orbits.exists & orbits.admissible
        steady = admissible & orbits.stable
        highest = jnp.max(jnp.where(steady, orbits.peak_amplitude_nm, -jnp.inf))
        return jnp.any(steady), jnp.any(admissible), jnp.where(jnp.any(steady), highest, jnp.nan)

    return jax.vmap(one)(scenes)
