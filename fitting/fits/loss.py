"""What a fitted impact takes, in the quantities that people ask for: energies, r and delta, capture."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

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
    """What an impact takes at an approach speed in nm/us, with its 95 % band; None: its mass is not known."""

    approach_speed_nm_per_us: float
    energy_aj: WithInterval | None
    energy_ev: WithInterval | None


@dataclass(frozen=True)
class Loss:
    """What impacts take: energies at three speeds that were measured, and what the printed parameters say.

    Attributes:
        energies: at three speeds, of the law.
        energies_reason: why they are not known; None where they are.
        r: the fit's parameter; None of a model without.
        epsilon_nm2_per_us2: likewise.
        delta_aj: energy lost to adhesion, m epsilon/2.
        delta_ev: in electron volts.
        formula_off: largest distance of the formula with the printed parameters from the law, over the measured speeds,
            relative to the rebound speed; None of a model without a formula.
        formula_off_at_nm_per_us: approach speed where it is that far.
        capture_speed_nm_per_us: of the law, extrapolated.
    """

    energies: tuple[EnergyLost, ...]
    energies_reason: str | None
    r: WithInterval | None
    epsilon_nm2_per_us2: WithInterval | None
    delta_aj: WithInterval | None
    delta_ev: WithInterval | None
    formula_off: float | None
    formula_off_at_nm_per_us: float | None
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


NO_MASS = "the table gives neither mass_ng nor spring_constant_n_per_m"


def energy_lost(speed: float, rebound: float, error: float, mass_ng: float | None) -> EnergyLost:
    """Return the energy that an impact takes; its interval ends at 0, for a sample at rest gives none.

    Args:
        speed: approach speed in nm/us.
        rebound: rebound speed.
        error: standard error of that.
        mass_ng: of the tip; None: not known.
    """
    if mass_ng is None:
        return EnergyLost(speed, None, None)
    taken = interval_of(0.5 * mass_ng * (speed**2 - rebound**2), mass_ng * rebound * error, lowest=0.0)
    return EnergyLost(speed, taken, scaled(taken, EV_PER_AJ))


def rebound_by_formula(values: Mapping[str, float], speeds: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Return u_out of the formula of a law's parameters at approach speeds in nm/us; 0 where the tip is captured."""
    square = (values.get("r", 1.0) * speeds) ** 2 - values.get("viscous_loss", 0.0) * speeds
    return np.sqrt(np.maximum(square - values.get("epsilon", 0.0), 0.0))


class Nearness(NamedTuple):
    """How near formulas of a family come to a law: the largest distance, relative to the rebound speed, and where."""

    off: float
    at_nm_per_us: float


def nearness(
    speeds: Float[np.ndarray, " n"], rebound: Float[np.ndarray, " n"], formula: Float[np.ndarray, " n"]
) -> Nearness:
    """Return how far rebound speeds of a formula are from those of a law, 0 where the tip is captured."""
    off = np.where(rebound > 0.0, np.abs(formula / np.where(rebound > 0.0, rebound, 1.0) - 1.0), 0.0)
    worst = int(np.argmax(off))
    return Nearness(float(off[worst]), float(speeds[worst]))


_COLUMNS = {"r": 2, "viscous_loss": 1, "epsilon": 0}
"""Powers of the speed: u_in^2 - u_out^2 = (1 - r^2) u^2 + c u + epsilon, each term a loss."""


def closest_loss(
    family: Sequence[str],
    speeds: Float[np.ndarray, " n"],
    rebound: Float[np.ndarray, " n"],
    weight: Float[np.ndarray, " n"],
    fixed: Mapping[str, float],
) -> dict[str, float]:
    """Return the parameters of the formula closest to a law from anywhere, to first order; no loss is negative.

    Least squares in u_out^2 over 2 u_out of the law, a problem without other minima. `closest_member` polishes from
    parameters close by, with errors.

    Args:
        family: of r, viscous_loss and epsilon those that are looked for.
        speeds: approach speeds in nm/us.
        rebound: of the law, all positive.
        weight: of each.
        fixed: values of others of them.
    """
    from scipy.optimize import nnls  # noqa: PLC0415 (half a second that most fits do not need)

    if not family:
        return {}
    lost = speeds**2 - rebound**2
    for name in [name for name in _COLUMNS if name in fixed]:
        lost = lost - (1.0 - fixed[name] ** 2 if name == "r" else fixed[name]) * speeds ** _COLUMNS[name]
    steep = 0.5 * weight / rebound
    matrix = steep[:, None] * np.stack([speeds ** _COLUMNS[name] for name in family], axis=1)
    scale = np.linalg.norm(matrix, axis=0)
    size, _ = nnls(matrix / scale, steep * lost)
    terms = zip(family, (size / scale).tolist(), strict=True)
    return {name: max(1.0 - term, 0.0) ** 0.5 if name == "r" else term for name, term in terms}


def nearest_of(
    family: Sequence[str],
    speeds: Float[np.ndarray, " n"],
    rebound: Float[np.ndarray, " n"],
    half_width: Float[np.ndarray, " n"],
) -> Nearness:
    """Return how near the laws of a family of losses come to a law, in rebound speeds over the half-width of its band.

    Args:
        family: of r, viscous_loss and epsilon those that the family has.
        speeds: approach speeds in nm/us.
        rebound: of the law.
        half_width: of its band.
    """
    free = (rebound > 0.0) & (half_width > 0.0)
    u, w = speeds[free], rebound[free]
    return nearness(u, w, rebound_by_formula(closest_loss(family, u, w, 1.0 / half_width[free], {}), u))
