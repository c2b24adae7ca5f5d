"""A platform, a base and a force of two frequencies each, and times to look at them."""

from typing import Any

import jax.numpy as jnp
import numpy as np

from afm_jax.apparatus.cantilever import Cantilever
from afm_jax.apparatus.drives import BaseDrive, ForceDrive, Tone
from afm_jax.apparatus.platform import Platform
from afm_jax.apparatus.scene import Scene
from afm_jax.apparatus.surface import Surface

PER_KHZ = 2e-3 * np.pi
MASS = 1.7
TIMES = np.array([0.0, 0.37, 5.1, 23.7])
BASE = BaseDrive(0.8, 88.0, 30.0, Tone(0.3, 181.0, -70.0))
FORCE = ForceDrive(0.6, 93.0, 200.0, Tone(0.9, 40.0, 10.0))
PLATFORM = Platform(2.0, 180.0, -1.0, 1e-2, Tone(0.7, 33.0, 50.0))
FULL = Scene(Cantilever(90.0, 40.0, MASS), PLATFORM, None, BASE, FORCE)


def both(motion: Platform | Surface) -> Any:
    """Return position and velocity at `TIMES`, shape (2, times)."""
    return np.array(motion.position_and_velocity(jnp.asarray(TIMES)))
