"""The bundled experiment on the paper's contact, made once for all tests that look at it."""

import functools

import jax.numpy as jnp
import numpy as np

from afm_jax.contact.collide import collide
from afm_jax.contact.contact import Contact
from afm_jax.contact.parameters import EFFECTS
from fitting.examples.make_contact_amplitudes import example_experiment
from fitting.simulated.experiment import SimulatedExperiment


@functools.cache
def paper_experiment() -> SimulatedExperiment:
    return example_experiment()


def paper_collisions(approach_speeds: np.ndarray, **changes: float) -> tuple[np.ndarray, np.ndarray]:
    """Return rebound speeds and delays of free tips at the paper's contact: no orbit, no platform, no air.

    One program for any contact and number of speeds.

    Args:
        approach_speeds: at most 128, in nm/us.
        changes: parameters of another contact.
    """
    padded = np.resize(approach_speeds, 128)
    found = collide(Contact.of(EFFECTS, **changes), jnp.asarray(padded))
    count = len(approach_speeds)
    return np.asarray(found.rebound_speed_nm_per_us)[:count], np.asarray(found.collision_delay_us)[:count]
