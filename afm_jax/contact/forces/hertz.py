"""The elastic repulsion of a sphere pressed into a plane, without adhesion (Hertz 1882)."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from afm_jax.contact.forces.force import StaticForce
from afm_jax.parameters import as_argument, as_parameter, check_parameter


class Hertz(StaticForce):
    """F = K sqrt(R) (D_0 - D)^(3/2) where the gap D is below D_0, else 0.

    Args:
        modulus_gpa: reduced modulus K in GPa, 1/K = (3/4) sum of (1 - nu^2)/E, as in the paper's JKR model.
        tip_radius_nm: R in nm.
        contact_gap_nm: D_0, the gap at which the surfaces touch, in nm.

    Raises:
        ValueError: if the modulus or the radius is not positive.
    """

    modulus_gpa: Float[Array, "..."] = eqx.field(converter=as_parameter, default=100.0)
    tip_radius_nm: Float[Array, "..."] = eqx.field(converter=as_parameter, default=100.0)
    contact_gap_nm: Float[Array, "..."] = eqx.field(converter=as_parameter, default=0.0)

    def __check_init__(self):
        check_parameter("modulus_gpa", self.modulus_gpa, "positive")
        check_parameter("tip_radius_nm", self.tip_radius_nm, "positive")
        check_parameter("contact_gap_nm", self.contact_gap_nm, "finite")

    def __call__(self, gap_nm: ArrayLike, gap_rate_nm_per_us: ArrayLike = 0.0) -> Float[Array, "..."]:
        """Return the force in nN at a gap in nm; the rate does not matter."""
        del gap_rate_nm_per_us
        depth, root = depth_and_root(self.contact_gap_nm - as_argument(gap_nm))
        return self.modulus_gpa * jnp.sqrt(self.tip_radius_nm) * depth * root

    def coefficients(self) -> tuple[Float[Array, "..."], ...]:
        """Return (2/5) K sqrt(R) and D_0."""
        return 0.4 * self.modulus_gpa * jnp.sqrt(self.tip_radius_nm), self.contact_gap_nm

    @staticmethod
    def potential_of(coefficients: tuple[Float[Array, "..."], ...], gap: Float[Array, "..."]) -> Float[Array, "..."]:
        """Return (2/5) K sqrt(R) (D_0 - D)^(5/2) in aJ; 0 out of contact."""
        factor, contact_gap = coefficients
        depth, root = depth_and_root(contact_gap - gap)
        return factor * depth**2 * root


def depth_and_root(depth_nm: Float[Array, "..."]) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
    """Return an indentation and its square root, both 0 where it is not positive."""
    touching = depth_nm > 0.0
    inside = jnp.where(touching, depth_nm, 1.0)
    return jnp.where(touching, inside, 0.0), jnp.where(touching, jnp.sqrt(inside), 0.0)
