"""The package's scenes for the references' parameters, and compiled programs that several tests share."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from afm_jax.apparatus.cantilever import Cantilever
from afm_jax.apparatus.platform import Platform
from afm_jax.apparatus.scene import Scene
from afm_jax.impact.law import CollisionDelay, ImpactLaw
from afm_jax.impact.map import next_impact
from tests.brute_force import Flights
from tests.reference_examples import DELAY, scene
from tests.reference_flight import Parameters

LANES = 512
"""Shape of the batches below: every test fills up to it, so that each structure is compiled once."""


def scene_of(p: Parameters, *, offset_rate_nm_per_us: float = 0.0) -> Scene:
    """Return the package's scene for the reference's parameters."""
    delay = None if p.delay is None else CollisionDelay(*p.delay, corrections=False)
    return Scene(
        Cantilever(p.frequency_khz, p.quality_factor),
        Platform(p.amplitude_nm, p.drive_frequency_khz, p.offset_nm, offset_rate_nm_per_us),
        ImpactLaw(r=p.r, epsilon=p.epsilon, viscous_loss=p.viscous_loss, delay=delay),
    )


def bouncing(reduced: float = 1.01, **changes: Any) -> Scene:
    """Return a damped scene with a delay, every parameter its own keyword; `delay=None` and others can be replaced."""
    return scene_of(scene(reduced, **({"viscous_loss": 0.3, "delay": DELAY} | changes)))


def stacked(scenes: list[Scene]) -> Scene:
    """Return scenes of one structure as one whose parameters have a leading axis."""
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *scenes)


def scenes_of(flights: Flights, **law: Any) -> Scene:
    """Return one scene a flight, all damped (no damping is an infinite quality factor), with the same law."""
    rows = flights.time_us.shape
    platform = Platform(flights.amplitude_nm, flights.drive_frequency_khz, flights.offset_nm, np.zeros(rows))
    cantilever = Cantilever(flights.frequency_khz, flights.quality_factor, np.ones(rows))
    values = {"r": 0.5, "epsilon": 0.0, "viscous_loss": 0.0} | law
    full = {name: np.full(rows, value) for name, value in values.items()}
    return Scene(cantilever, platform, ImpactLaw(full["r"], full["epsilon"], full["viscous_loss"]))


_batch = jax.jit(jax.vmap(next_impact))


def next_impacts(scenes: Scene, times: Any, velocities: Any) -> Any:
    """Return the `NextImpact` of a batch of any size, LANES at a time, its attributes NumPy arrays."""
    count = len(times)
    blocks = []
    for first in range(0, count, LANES):
        index = np.minimum(np.arange(first, first + LANES), count - 1)
        lanes = jax.tree.map(lambda leaf, index=index: leaf[index], scenes)
        blocks.append(_batch(lanes, np.asarray(times)[index], np.asarray(velocities)[index]))
    joined = jax.tree.map(lambda *leaves: np.concatenate(leaves)[:count], *blocks)
    return eqx.tree_at(lambda rows: rows.outcome, joined, joined.outcome.astype(int))
