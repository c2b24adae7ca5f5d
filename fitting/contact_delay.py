"""The collision delay of a contact: its lag and its lead, and the delay law fitted to it.

Extrapolate the straight paths in and out to gap 0; the delay is the time between the two crossings, and the
difference of two times:

    lag   the time that the tip spends in the solid junction: what its finite stiffness needs to turn the tip round;
    lead  what the straight paths take from the bridge's formation to gap 0 and from there to the end of contact, less
          the time that the tip needs for these ways outside the junction: it is pulled in, and on the way out still
          has the energy that hysteresis takes only later.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from afm_jax.contact.collide import capture_speed
from afm_jax.contact.contact import Contact
from afm_jax.impact.law import CollisionDelay
from afm_jax.parameters import require_float64
from fitting.contact_law import range_above_capture, rebounds

LOWEST_SPEED, TOP_SPEED = 1.37, 700.0
"""The range if none is given: for the paper's contact 15 to 700 nm/us."""


@dataclass(frozen=True)
class ContactDelay:
    """The delay of a contact against the approach speed, and the law fitted to it; times in us, shapes (n,).

    Attributes:
        delay: the fitted law.
        approach_speed_nm_per_us: the speeds, at equal ratios.
        rebound_speed_nm_per_us: of the contact.
        delay_us: of the contact, lag less lead.
        lag_us: time in the solid junction.
        lead_us: by how much the ways outside the junction are shorter in time than the straight paths to gap 0.
        fitted_us: delay of the law at the contact's speeds.
    """

    delay: CollisionDelay
    approach_speed_nm_per_us: Float[np.ndarray, " n"]
    rebound_speed_nm_per_us: Float[np.ndarray, " n"]
    delay_us: Float[np.ndarray, " n"]
    lag_us: Float[np.ndarray, " n"]
    lead_us: Float[np.ndarray, " n"]
    fitted_us: Float[np.ndarray, " n"]

    @property
    def speed_range(self) -> tuple[float, float]:
        """Lowest and highest approach speed, in nm/us."""
        return float(self.approach_speed_nm_per_us[0]), float(self.approach_speed_nm_per_us[-1])

    @property
    def rms_us(self) -> float:
        """Root of the mean square of the fit's errors."""
        return float(np.sqrt(np.mean((self.fitted_us - self.delay_us) ** 2)))

    @property
    def worst_us(self) -> float:
        """Largest error of the fit."""
        return float(np.abs(self.fitted_us - self.delay_us).max())


def fit_delay(
    contact: Contact, *, speed_range: tuple[float, float] | None = None, mass_ng: float = 1.0, points: int = 512
) -> ContactDelay:
    """Return a contact's delay, and the delay law a u^(-1/5) - b (1/w - 1/u) - d/u that is closest to it.

    The law is linear in its parameters: plain linear least squares of the delay in us, with u and w, the approach and
    the rebound speed, of the contact. The speeds are at equal ratios, so that each doubling of the speed counts alike.

    Args:
        contact: the contact, of numbers.
        speed_range: lowest and highest approach speed in nm/us; None: from 1.37 times the capture speed to 700 nm/us.
        mass_ng: the tip's mass in ng.
        points: number of speeds, at least 3.

    Raises:
        RuntimeError: if JAX does not compute in 64 bits, or did not when the contact was built.
        ValueError: if the contact has no junction, a tip of the range is captured, or the range or the number of points
            is not possible.
    """
    require_float64(contact)
    if points < 3:
        raise ValueError(f"`points` must be at least the number of parameters, 3, but is {points}")
    low, high = range_above_capture(speed_range, float(capture_speed(contact, mass_ng)), LOWEST_SPEED, TOP_SPEED)
    found = rebounds(contact, np.geomspace(low, high, points), mass_ng)
    names = ("approach_speed_nm_per_us", "rebound_speed_nm_per_us", "collision_delay_us", "time_in_junction_us")
    approach, rebound, delay, lag = (found[name] for name in names)
    terms = np.stack([approach**-0.2, 1.0 / approach - 1.0 / rebound, -1.0 / approach], axis=1)
    values, *_ = np.linalg.lstsq(terms, delay, rcond=None)
    return ContactDelay(
        delay=CollisionDelay(*values.tolist()),
        approach_speed_nm_per_us=approach,
        rebound_speed_nm_per_us=rebound,
        delay_us=delay,
        lag_us=lag,
        lead_us=lag - delay,
        fitted_us=terms @ values,
    )
