"""The lag of the tip behind its drive, out of a phase with an instrument's own sign and zero."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

Numbers = float | Float[np.ndarray, "..."]
_NEAR_DEG = 20.0
"""How near to a lag of the opposite sign the free tip's phase must be to be told as one."""


def free_lag_deg(drive: str, frequency_ratio: Numbers, quality_factor: Numbers) -> Float[np.ndarray, "..."]:
    """Return the lag of the free tip behind its drive in degrees: of its height (force) or of the deflection (base).

    With gamma = 1 - s^2 + i s/Q the height lags by arg gamma, the deflection behind the base by arg gamma - arg(1 -
    gamma).

    >>> [round(float(free_lag_deg(drive, 1.0, 200.0)), 2) for drive in ("force", "base")]
    [90.0, 90.29]
    """
    gamma = 1.0 - frequency_ratio**2 + 1j * frequency_ratio / quality_factor
    lag = np.angle(gamma) - (np.angle(1.0 - gamma) if drive == "base" else 0.0)
    return np.asarray(np.rad2deg(lag))


class PhaseSense(NamedTuple):
    """How a phase becomes a lag: lag = sign (phase - zero_deg), and a sentence about it, empty where nothing is odd."""

    sign: float
    zero_deg: float
    note: str

    def lag_deg(self, phase_deg: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
        """Return the lag of a phase."""
        return self.sign * (phase_deg - self.zero_deg)


def sense_of(free_phase_deg: float, free_lag: float, *, sign_given: bool = False) -> PhaseSense:
    """Return sign and zero of a phase from what the free tip reads and what its lag is.

    A free tip that reads the opposite of its lag (-90 degrees for 90) is of a phase that leads; one that reads another
    number has a zero of its own, and its sign is taken as it is.

    Args:
        free_phase_deg: reading of the free tip.
        free_lag: what frequency and Q give.
        sign_given: whether the caller said the sign.
    """
    opposite = (free_phase_deg + free_lag + 180.0) % 360.0 - 180.0
    if not sign_given and abs(opposite) < _NEAR_DEG and abs(free_lag) > _NEAR_DEG:
        note = (
            f"Sign: the free tip reads {free_phase_deg:.1f} deg where its lag is {free_lag:.1f}: the phase leads, and "
            "was taken with the opposite sign."
        )
        return PhaseSense(-1.0, free_phase_deg + free_lag, note)
    zero = free_phase_deg - free_lag
    quarters = round(zero / 90.0)
    note = ""
    if quarters % 4 and abs(zero - 90.0 * quarters) < _NEAR_DEG:
        note = (
            f"Zero: the free tip reads {free_phase_deg:.1f} deg where its lag is {free_lag:.1f}: the instrument's zero "
            f"is {90 * quarters:+d} degrees off, and was set by the free tip."
        )
    return PhaseSense(1.0, zero, note)
