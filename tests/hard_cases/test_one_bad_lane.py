"""A batch with one tip that makes all the trouble: the others come out as without it.

Hard: a batch goes on until its last tip is done, and a number that is none in one lane must not reach another.

Right answer: the same batch with an ordinary tip in that lane.
"""

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


def _impacts(velocity: np.ndarray) -> Any:
    """Impacts; a tip of -30 nm/us takes to the air a hundred nanometres below rest and is hardly reached again."""
    offset = np.where(velocity < 0.0, -100.0, -1.0)
    platform = Platform(4.0 * np.ones(LANES), 181.8 * np.ones(LANES), offset, np.zeros(LANES))
    scene = Scene(Cantilever(90.0, 1e7), platform, ImpactLaw(r=0.95, epsilon=1.0))
    return iterate_batch(scene, np.linspace(0.0, 5.0, LANES), np.abs(velocity), 20)


def _collisions(velocity: np.ndarray) -> Any:
    """Collisions; a tip a billionth above its capture speed is resolved much more finely."""
    return collide(Contact.paper(), velocity)


@jax.jit
@jax.vmap
def _motions(velocity):
    """Motions over a contact; a tip that comes at 8 nm/us is held and rings in the junction."""
    scene = Scene(Cantilever(90.0, 40.0), Platform(4.0, 181.8), Contact.paper())
    start = State(jnp.zeros(()), jnp.full((), 9.0), velocity)
    return simulate(scene, start, 12.0, max_contacts=16)


@pytest.mark.parametrize(
    ("work", "slowest", "trouble"),
    [(_impacts, 40.0, -30.0), (_collisions, 12.0, 10.938450059496711 * (1.0 + 1e-9)), (_motions, 80.0, -8.0)],
)
def test_the_others_are_as_without_it(work, slowest: float, trouble: float):
    good, lane = np.linspace(slowest, 200.0, LANES), np.arange(LANES) == BAD
    expected = jax.tree.leaves(work(good))
    for batch in (np.where(lane, trouble, good), np.where(lane, np.nan, good)):
        for ours, right in zip(jax.tree.leaves(work(batch)), expected, strict=True):
            if np.ndim(right):
                # gathered with others, a lane is computed in another order
                np.testing.assert_allclose(np.asarray(ours)[~lane], np.asarray(right)[~lane], rtol=1e-12)
