"""The viscous force of a liquid bridge that is squeezed or stretched (eq. 12)."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from afm_jax.contact.forces.force import DissipativeForce
from afm_jax.parameters import as_parameter, check_parameter
from afm_jax.units import NN_US_PER_NM2_PER_PA_S


class Viscous(DissipativeForce):
    """F = -(3 pi/2) eta R^2 (dD/dt) / D, eq. 12.

    Args:
        viscosity_pa_s: eta in Pa s.
        tip_radius_nm: R in nm.

    Raises:
        ValueError: if the viscosity is negative or the radius not positive.
    """

    viscosity_pa_s: Float[Array, "..."] = eqx.field(converter=as_parameter, default=1.005e-3)
    tip_radius_nm: Float[Array, "..."] = eqx.field(converter=as_parameter, default=100.0)

    def __check_init__(self):
        check_parameter("viscosity_pa_s", self.viscosity_pa_s, "not negative")
        check_parameter("tip_radius_nm", self.tip_radius_nm, "positive")

    def coefficients(self) -> tuple[Float[Array, "..."], ...]:
        """Return (3 pi/2) eta R^2 in nN us."""
        return (1.5 * jnp.pi * self.viscosity_pa_s * NN_US_PER_NM2_PER_PA_S * self.tip_radius_nm**2,)

    @staticmethod
    def damping_of(coefficients: tuple[Float[Array, "..."], ...], gap: Float[Array, "..."]) -> Float[Array, "..."]:
        """Return (3 pi/2) eta R^2 / D in nN us/nm."""
        return coefficients[0] / gap
