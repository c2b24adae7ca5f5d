"""Forces between the solids: the repulsion of their atomic cores (eq. 14), and the van der Waals attraction.

Takes gaps in nm; gives forces in nN and potentials in aJ.

The attraction is that of a sphere and a plane at gaps small against the radius, not retarded (Hamaker 1937).
"""

import equinox as eqx
from jaxtyping import Array, Float

from afm_jax.checks import as_parameter, check_parameter
from afm_jax.contact.forces.force import StaticForce
from afm_jax.contact.parameters import DEFAULTS
from afm_jax.units import AJ_NM6_PER_J_M6


class CoreRepulsion(StaticForce):
    """F = B R / (180 D^8), eq. 14.

    Args:
        constant_aj_nm6: B in aJ nm^6; 1e-6 is the 1e-78 J m^6 with which the paper's junction comes out.
        tip_radius_nm: R in nm.

    Raises:
        ValueError: if a value is not positive.
    """

    constant_aj_nm6: Float[Array, "..."] = eqx.field(
        converter=as_parameter,
        default=DEFAULTS["core_constant_j_m6"] * AJ_NM6_PER_J_M6,
    )
    tip_radius_nm: Float[Array, "..."] = eqx.field(converter=as_parameter, default=DEFAULTS["tip_radius_nm"])

    def __check_init__(self):
        check_parameter("constant_aj_nm6", self.constant_aj_nm6, "above 0")

    def coefficients(self) -> tuple[Float[Array, "..."], ...]:
        """Return B R / 1260."""
        return (self.constant_aj_nm6 * self.tip_radius_nm / 1260.0,)

    @staticmethod
    def potential_of(coefficients: tuple[Float[Array, "..."], ...], gap: Float[Array, "..."]) -> Float[Array, "..."]:
        """Return B R / (1260 D^7) in aJ; 0 far away."""
        return coefficients[0] / gap**7


class VanDerWaals(StaticForce):
    """F = -H R / (6 D^2) for gaps small against the radius.

    Args:
        hamaker_constant_aj: H in aJ = 1e-18 J; 0.1 is typical in air, 0.01 across water.
        tip_radius_nm: R in nm.

    Raises:
        ValueError: if the Hamaker constant is negative or the radius not positive.
    """

    hamaker_constant_aj: Float[Array, "..."] = eqx.field(
        converter=as_parameter, default=DEFAULTS["hamaker_constant_aj"]
    )
    tip_radius_nm: Float[Array, "..."] = eqx.field(converter=as_parameter, default=DEFAULTS["tip_radius_nm"])

    def coefficients(self) -> tuple[Float[Array, "..."], ...]:
        """Return -H R / 6."""
        return (-self.hamaker_constant_aj * self.tip_radius_nm / 6.0,)

    @staticmethod
    def potential_of(coefficients: tuple[Float[Array, "..."], ...], gap: Float[Array, "..."]) -> Float[Array, "..."]:
        """Return -H R / (6 D) in aJ; 0 far away."""
        return coefficients[0] / gap
