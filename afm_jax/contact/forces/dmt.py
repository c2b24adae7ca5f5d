"""The contact of a stiff sphere with long-ranged adhesion (Derjaguin, Muller and Toporov 1975)."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from afm_jax.contact.forces.force import StaticForce
from afm_jax.contact.forces.hertz import Hertz
from afm_jax.parameters import as_argument, as_parameter, check_parameter


class Dmt(StaticForce):
    """Hertz contact below D_0 with the pull-off force 2 pi w R; above it the van der Waals force that joins on.

    F = K sqrt(R) (D_0 - D)^(3/2) - 2 pi w R for D < D_0, -2 pi w R (D_0/D)^2 outside. The Hamaker constant is thereby
    12 pi w D_0^2, as usual with the intermolecular distance as D_0.

    Args:
        adhesion_energy_j_per_m2: w in J/m^2 = nN/nm.
        modulus_gpa: reduced modulus K in GPa, as in `Hertz`.
        tip_radius_nm: R in nm.
        contact_gap_nm: D_0 in nm.

    Raises:
        ValueError: if the adhesion energy is negative or another value not positive.
    """

    adhesion_energy_j_per_m2: Float[Array, "..."] = eqx.field(converter=as_parameter, default=0.3)
    modulus_gpa: Float[Array, "..."] = eqx.field(converter=as_parameter, default=100.0)
    tip_radius_nm: Float[Array, "..."] = eqx.field(converter=as_parameter, default=100.0)
    contact_gap_nm: Float[Array, "..."] = eqx.field(converter=as_parameter, default=0.165)

    def __check_init__(self):
        check_parameter("adhesion_energy_j_per_m2", self.adhesion_energy_j_per_m2, "not negative")
        check_parameter("modulus_gpa", self.modulus_gpa, "positive")
        check_parameter("tip_radius_nm", self.tip_radius_nm, "positive")
        check_parameter("contact_gap_nm", self.contact_gap_nm, "positive")

    @property
    def pull_off_nn(self) -> Float[Array, "..."]:
        """The largest attraction, 2 pi w R, in nN."""
        return 2.0 * jnp.pi * self.adhesion_energy_j_per_m2 * self.tip_radius_nm

    @property
    def _elastic(self) -> Hertz:
        return Hertz(self.modulus_gpa, self.tip_radius_nm, self.contact_gap_nm)

    def __call__(self, gap_nm: ArrayLike, gap_rate_nm_per_us: ArrayLike = 0.0) -> Float[Array, "..."]:
        """Return the force in nN at a gap in nm; the rate does not matter."""
        del gap_rate_nm_per_us
        gap = as_argument(gap_nm)
        reach = self.contact_gap_nm / jnp.maximum(gap, self.contact_gap_nm)
        return self._elastic(gap) - self.pull_off_nn * reach**2

    def coefficients(self) -> tuple[Float[Array, "..."], ...]:
        """Return (2/5) K sqrt(R), D_0 and 2 pi w R."""
        return (*self._elastic.coefficients(), self.pull_off_nn)

    @staticmethod
    def potential_of(coefficients: tuple[Float[Array, "..."], ...], gap: Float[Array, "..."]) -> Float[Array, "..."]:
        """Return the potential in aJ; 0 far away."""
        factor, contact_gap, pull_off = coefficients
        outside = jnp.maximum(gap, contact_gap)
        away = -pull_off * contact_gap**2 / outside
        return Hertz.potential_of((factor, contact_gap), gap) + away - pull_off * (outside - gap)
