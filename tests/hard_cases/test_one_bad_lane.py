"""A batch with one tip that makes all the trouble: the others come out as without it, and what it costs is bounded.

Hard: a batch goes on until its last tip is done, and a number that is none in one lane must not reach another.

Right answer: the same batch with an ordinary tip in that lane.
"""

import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from afm_jax.apparatus.cantilever import Cantilever
from afm_jax.apparatus.platform import Platform
from afm_jax.apparatus.scene import Scene
from afm_jax.contact.collide import collide
from afm_jax.contact.contact import Contact
from afm_jax.impact.law import ImpactLaw
from afm_jax.impact.map import iterate_batch
from afm_jax.motion.record import State
from afm_jax.motion.simulate import simulate

pytestmark = pytest.mark.slow

LANES, BAD = 256, 77
Lanes = Callable[[float | None], Any]


def _impacts(trouble: float | None) -> Any:
    """A tip that leaves the platform at a speed of 1e-9 nm/us and chatters on it, or one that is no number."""
    scene = Scene(Cantilever(90.0, 40.0), Platform(4.0, 181.8, 3.0), ImpactLaw(r=0.95, epsilon=1e-6))
    times = np.linspace(0.0, 5.0, LANES)
    speeds = np.asarray(scene.platform.velocity(times)) + 60.0
    if trouble is not None:
        speeds[BAD] += trouble - 60.0
    return iterate_batch(scene, times, speeds, 20, block=LANES)


def _collisions(trouble: float | None) -> Any:
    """A tip a billionth above its capture speed, or one that is no number."""
    speeds = np.linspace(12.0, 200.0, LANES)
    if trouble is not None:
        speeds[BAD] = trouble
    return collide(Contact.paper(), speeds)


@jax.jit
@jax.vmap
def _moved(velocity):
    scene = Scene(Cantilever(90.0, 40.0), Platform(4.0, 181.8), Contact.paper())
    start = State(jnp.zeros(()), jnp.full((), 9.0), velocity)
    return simulate(scene, start, 12.0, max_contacts=16)


def _motions(trouble: float | None) -> Any:
    """A tip that is held and rings in the junction, or one that is no number."""
    velocities = np.linspace(80.0, 200.0, LANES)
    if trouble is not None:
        velocities[BAD] = trouble
    return _moved(velocities)


def _seconds(work: Lanes, trouble: float | None) -> float:
    """Return the least of five times."""
    taken = []
    for _ in range(5):
        begin = time.perf_counter()
        jax.block_until_ready(work(trouble))
        taken.append(time.perf_counter() - begin)
    return min(taken)


@pytest.mark.parametrize(
    ("work", "trouble", "most"),
    # measured: 1.2 1.0; 1.4 1.0; 1.8 1.1 times
    [
        (_impacts, 1e-9, 4.0),
        (_impacts, np.nan, 2.0),
        (_collisions, 10.938450059496711 * (1.0 + 1e-9), 4.0),
        (_collisions, np.nan, 2.0),
        (_motions, -8.0, 6.0),
        (_motions, np.nan, 3.0),
    ],
)
def test_the_others_are_as_without_it(work: Lanes, trouble: float, most: float):
    others = np.arange(LANES) != BAD
    for good, mixed in zip(jax.tree.leaves(work(None)), jax.tree.leaves(work(trouble)), strict=True):
        if np.ndim(good):
            np.testing.assert_array_equal(np.asarray(mixed)[others], np.asarray(good)[others])
    assert _seconds(work, trouble) < most * _seconds(work, None)
