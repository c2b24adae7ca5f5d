"""The capillary attraction of a liquid bridge (eq. 10)."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from afm_jax.contact.forces.force import StaticForce
from afm_jax.contact.forces.liquid import Liquid, check_meniscus
from afm_jax.parameters import as_argument, as_parameter, check_parameter


class Capillary(StaticForce):
    """F = -4 pi R gamma_l / (1 + D/2 r_K), eq. 10.

    Args:
        tip_radius_nm: R in nm.
        liquid: gives gamma_l and r_K.

    Raises:
        ValueError: if the radius is not positive, or below the Kelvin radius (no such meniscus).
    """

    tip_radius_nm: Float[Array, "..."] = eqx.field(converter=as_parameter, default=100.0)
    liquid: Liquid = eqx.field(default_factory=Liquid)

    def __check_init__(self):
        check_parameter("tip_radius_nm", self.tip_radius_nm, "positive")
        check_meniscus(self.tip_radius_nm, self.liquid)

    @property
    def pull_nn(self) -> Float[Array, "..."]:
        """The attraction at gap 0, 4 pi R gamma_l, in nN."""
        return 4.0 * jnp.pi * self.tip_radius_nm * self.liquid.surface_tension_n_per_m

    def __call__(self, gap_nm: ArrayLike, gap_rate_nm_per_us: ArrayLike = 0.0) -> Float[Array, "..."]:
        """Return the force in nN at a gap in nm; the rate does not matter."""
        del gap_rate_nm_per_us
        return -self.pull_nn / (1.0 + as_argument(gap_nm) / (2.0 * self.liquid.kelvin_radius_nm))

    def coefficients(self) -> tuple[Float[Array, "..."], ...]:
        """Return 8 pi R gamma_l r_K and 1/(2 r_K)."""
        length = 2.0 * self.liquid.kelvin_radius_nm
        return self.pull_nn * length, 1.0 / length

    @staticmethod
    def potential_of(coefficients: tuple[Float[Array, "..."], ...], gap: Float[Array, "..."]) -> Float[Array, "..."]:
        """Return 8 pi R gamma_l r_K ln(1 + D/2 r_K) in aJ; 0 at contact."""
        energy, rate = coefficients
        return energy * jnp.log(1.0 + gap * rate)
