"""The impact law with delay that stands for a resolved contact: what it predicts of orbits is where to start."""

import jax.numpy as jnp
import numpy as np

from afm_jax.contact.collide import capture_speed, collide
from afm_jax.contact.contact import Contact
from afm_jax.contact.junction import find_junction
from afm_jax.impact.law import CollisionDelay, ImpactLaw

_SPEEDS = 12
_LOWEST, _TOP = 1.4, 500.0
"""From this multiple of the capture speed to this speed in nm/us."""
_SLOWEST = 5.0
"""Lowest speed, in nm/us, where no speed is captured."""


def law_of_contact(contact: Contact, mass_ng: float) -> ImpactLaw | None:
    """Return the law u_out^2 = u_in^2 - c u_in - epsilon, with delay, of a contact; None if every tip is captured.

    Epsilon is the hysteresis, 2 E/m; c and the delay's three parameters are linear least squares to twelve collisions.

    Args:
        contact: the contact, of numbers.
        mass_ng: the tip's mass in ng.

    Raises:
        ValueError: if the contact has no junction.
    """
    slowest = float(capture_speed(contact, mass_ng))
    if not np.isfinite(slowest):
        return None
    low = max(_LOWEST * slowest, _SLOWEST)
    u = np.geomspace(low, max(_TOP, 4.0 * low), _SPEEDS)
    # a guess needs no more digits
    found = collide(contact, jnp.asarray(u), mass_ng, accuracy=1e-6)
    w, delay = np.asarray(found.rebound_speed_nm_per_us), np.asarray(found.collision_delay_us)
    free = ~np.asarray(found.captured) & (w > 0.0)
    if np.count_nonzero(free) <= 3:
        return None
    u, w, delay = u[free], w[free], delay[free]
    epsilon = 2.0 * float(find_junction(contact).hysteresis_aj) / mass_ng
    # relative residuals of u_out^2, so that fast tips do not count alone
    lost = (u * u - w * w - epsilon) / u
    viscous = max(float(np.mean(lost)), 0.0)
    terms = np.stack([u**-0.2, 1.0 / u - 1.0 / w, -1.0 / u], axis=1)
    hertz, lead, offset = np.linalg.lstsq(terms, delay, rcond=None)[0].tolist()
    return ImpactLaw(1.0, max(epsilon, 0.0), viscous, CollisionDelay(hertz, lead, offset))
