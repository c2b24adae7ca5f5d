"""What a fitted impact takes, in the quantities that people ask for: energies, the paper's r and delta, capture."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from afm_jax.contact.law_of_contact import closest_law
from afm_jax.units import TWO_SIDED_95

EV_PER_AJ = 1.0 / 0.1602176634
"""Electron volts in an attojoule (exact in SI)."""


@dataclass(frozen=True)
class WithInterval:
    """A value and the ends of its 95 % interval, None where no error is known."""

    value: float
    interval95: tuple[float | None, float | None]


@dataclass(frozen=True)
class EnergyLost:
    """The energy that an impact takes at an approach speed in nm/us, with its 95 % band."""

    approach_speed_nm_per_us: float
    energy_aj: WithInterval
    energy_ev: WithInterval


@dataclass(frozen=True)
class Equivalent:
    """The paper's law (eq. 6) that comes closest to the fitted one over a range of approach speeds in nm/us.

    Least squares of the rebound speed at even speeds, as of the paper's own fit. ``delta`` is m epsilon/2, the energy
    lost to adhesion; ``worst_error`` how far this law is off somewhere, relative to the fitted rebound speed.
    """

    slowest_nm_per_us: float
    fastest_nm_per_us: float
    r: WithInterval
    epsilon_nm2_per_us2: WithInterval
    delta_aj: WithInterval
    delta_ev: WithInterval
    worst_error: float


@dataclass(frozen=True)
class Loss:
    """Energies at three speeds that were measured, the paper's laws over ranges, the capture speed (extrapolated)."""

    energies: tuple[EnergyLost, ...]
    equivalents: tuple[Equivalent, ...]
    capture_speed_nm_per_us: WithInterval


def interval_of(value: float, error: float, lowest: float = -np.inf, highest: float = np.inf) -> WithInterval:
    """Return a value with its 95 % interval, cut off where nothing can be."""
    if not np.isfinite(error):
        return WithInterval(value, (None, None))
    reach = TWO_SIDED_95 * error
    return WithInterval(value, (float(max(value - reach, lowest)), float(min(value + reach, highest))))


def scaled(known: WithInterval, factor: float) -> WithInterval:
    """Return a value and its interval in another unit."""
    low, high = (None if end is None else end * factor for end in known.interval95)
    return WithInterval(known.value * factor, (low, high))


def energy_lost(speed: float, rebound: float, error: float, mass_ng: float) -> EnergyLost:
    """Return the energy that an impact takes; its interval ends at 0, for a sample at rest gives none.

    Args:
        speed: approach speed in nm/us.
        rebound: rebound speed.
        error: standard error of that.
        mass_ng: of the tip.
    """
    taken = interval_of(0.5 * mass_ng * (speed**2 - rebound**2), mass_ng * rebound * error, lowest=0.0)
    return EnergyLost(speed, taken, scaled(taken, EV_PER_AJ))


def equivalent(
    speeds: Float[np.ndarray, " n"],
    rebound: Float[np.ndarray, " n"],
    factor: Float[np.ndarray, "n k"],
    mass_ng: float,
) -> Equivalent | None:
    """Return the closest law of the paper; None where the tip is captured at most speeds.

    Args:
        speeds: approach speeds in nm/us.
        rebound: rebound speeds, 0 where the tip is captured.
        factor: changes of the rebound speed with independent unknowns of unit variance; NaN: not known.
        mass_ng: of the tip.
    """
    free = rebound > 0.0
    if 2 * free.sum() < free.size:
        return None
    u, w = speeds[free], rebound[free]
    law, _ = closest_law(u, w, "law", "absolute")
    r, epsilon = float(law.r), float(law.epsilon)
    # w = sqrt(r^2 u^2 - epsilon) to first order in r and epsilon
    slope = np.stack([r * u**2, np.full_like(u, -0.5)], axis=1) / w[:, None]
    spread = np.linalg.pinv(slope) @ factor[free] if np.isfinite(factor).all() else np.full((2, 1), np.nan)
    error_of_r, error_of_epsilon = np.sqrt(np.sum(spread**2, axis=1)).tolist()
    adhesion = interval_of(epsilon, error_of_epsilon, lowest=0.0)
    delta = scaled(adhesion, 0.5 * mass_ng)
    return Equivalent(
        slowest_nm_per_us=float(u[0]),
        fastest_nm_per_us=float(u[-1]),
        r=interval_of(r, error_of_r, highest=1.0),
        epsilon_nm2_per_us2=adhesion,
        delta_aj=delta,
        delta_ev=scaled(delta, EV_PER_AJ),
        worst_error=float(np.max(np.abs(np.sqrt(np.maximum((r * u) ** 2 - epsilon, 0.0)) / w - 1.0))),
    )
