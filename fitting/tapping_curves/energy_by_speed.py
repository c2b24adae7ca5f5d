"""Energy of a tap against the tip's speed at the sample, beside what impact laws make of it.

A law with restitution and adhesion, u_out^2 = r^2 u^2 - epsilon, takes E = m ((1 - r^2) u^2 + epsilon)/2, one with a
loss linear in speed E = m (viscous_loss u + epsilon)/2. Both are straight lines, in u^2 and in u.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from afm_jax.least_squares import chi2_tail
from fitting.tapping_curves.curve import Rows

_ROUNDS = 3
FEWEST_SPEEDS = 4
"""Rows of known speed from which a line is drawn through their energies."""


@dataclass(frozen=True, kw_only=True, eq=False)
class LawOfEnergies:
    """A law's line through energies against speed.

    Attributes:
        formula: of the energy.
        parameters: value and standard error of each, from noise and speeds alone.
        chi2: of the rows about it.
        degrees_of_freedom: of chi2.
        energy_aj: at the rows' speeds.
    """

    formula: str
    parameters: dict[str, tuple[float, float]]
    chi2: float
    degrees_of_freedom: int
    energy_aj: Float[np.ndarray, " rows"]

    @property
    def p_value(self) -> float:
        """Probability of a larger chi2 if the law is right."""
        return chi2_tail(self.chi2, self.degrees_of_freedom)


def laws_of_energies(
    speed: Rows, speed_error: Rows, energy: Rows, energy_error: Rows, mass: float
) -> list[LawOfEnergies]:
    """Return the two laws' lines through energies in aJ at speeds in nm/us, with errors in both, the mass in ng."""
    found = []
    for formula, power, name in (
        ("E = m ((1 - r^2) u^2 + epsilon)/2", 2, "one_less_r_squared"),
        ("E = m (viscous_loss u + epsilon)/2", 1, "viscous_loss_nm_per_us"),
    ):
        basis = 0.5 * mass * np.stack([speed**power, np.ones_like(speed)], axis=1)
        error = energy_error
        at, covariance = np.zeros(2), np.zeros((2, 2))
        for _ in range(_ROUNDS):
            whitened = basis / error[:, None]
            covariance = np.linalg.inv(whitened.T @ whitened)
            at = covariance @ (whitened.T @ (energy / error))
            slope = 0.5 * mass * at[0] * power * speed ** (power - 1)
            error = np.hypot(energy_error, slope * speed_error)
        values = dict(
            zip(
                (name, "epsilon_nm2_per_us2"),
                zip(at.tolist(), np.sqrt(np.diag(covariance)).tolist(), strict=True),
                strict=True,
            )
        )
        chi2 = float(np.sum(((energy - basis @ at) / error) ** 2))
        found.append(
            LawOfEnergies(
                formula=formula, parameters=values, chi2=chi2, degrees_of_freedom=len(speed) - 2, energy_aj=basis @ at
            )
        )
    return found
