"""The elastic contact of a dry sphere and a plane: Hertz's, and with an attraction that does not change (DMT).

Takes radius, modulus and a0 with their units in the names; gives loads in nN and depths in nm.

From the gap a0 inwards the load is K sqrt(R) delta^(3/2) - P, delta = a0 - D the depth, K the reduced modulus as in JKR
(K sqrt(R) delta^(3/2) is Hertz's law). P is what the forces outside pull with where the solids meet: H R/(6 a0^2) by
van der Waals' force (Derjaguin, Muller and Toporov). So the force is continuous, and the contact breaks where it has
formed. With s = sqrt(delta/unit), load s^3 - p, depth s^2 and work (2/5) s^5 - p s^2 are polynomials.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from afm_jax.checks import as_argument, as_parameter
from afm_jax.contact.forces.force import ElasticCurve, Parameters, Terms
from afm_jax.contact.parameters import DEFAULTS

_LEAST_ENERGY = 1e-24


class DryCurve(ElasticCurve):
    """Load s^3 - p at depth s^2; p is the attraction where the contact begins, in units of the load."""

    attraction: Float[Array, "..."]

    fold = 0.0
    reversible = True

    def load(self, s: ArrayLike) -> Float[Array, "..."]:
        """Return the normalised load s^3 - p."""
        return as_argument(s) ** 3 - self.attraction

    def depth(self, s: ArrayLike) -> Float[Array, "..."]:
        """Return the normalised depth s^2."""
        return as_argument(s) ** 2

    def depth_slope(self, s: ArrayLike) -> Float[Array, "..."]:
        """Return the derivative of the normalised depth, 2 s."""
        return 2.0 * as_argument(s)

    def work(self, s: ArrayLike) -> Float[Array, "..."]:
        """Return the normalised potential (2/5) s^5 - p s^2, 0 where the contact begins."""
        root = as_argument(s)
        return root * root * (0.4 * root**3 - self.attraction)

    def root_of_depth(self, normalised_depth: ArrayLike) -> Float[Array, "..."]:
        """Return the root of the depth, 0 outside the contact."""
        depth = as_argument(normalised_depth)
        inside = depth > 0.0
        return jnp.where(inside, jnp.sqrt(jnp.where(inside, depth, 1.0)), 0.0)

    @property
    def terms(self) -> tuple[Terms, Terms]:
        """Work and depth as polynomials of s."""
        return ((5, 0.4), (2, -self.attraction)), ((2, 1.0),)

    @property
    def unloaded(self) -> Float[Array, "..."]:
        """S without load, the third root of p."""
        return jnp.cbrt(self.attraction)

    def beyond(self, work: Float[Array, "..."]) -> Float[Array, "..."]:
        """Return an s that is not smaller than the one at which the work has a value."""
        # with s = a + b, s^3 >= a^3 + b^3, so that the work is at least (2/5) a^5 where b^3 = (5/2) p
        return (2.5 * jnp.maximum(work, 0.0)) ** 0.2 + jnp.cbrt(2.5 * self.attraction)

    def width(self, energy: Float[Array, "..."]) -> Float[Array, "..."]:
        """Return the distance in s over which a tip is slow after the contact has begun, its attraction being p s^2."""
        kinetic = jnp.maximum(energy, _LEAST_ENERGY)
        return jnp.sqrt(kinetic / (jnp.abs(self.attraction) + kinetic**0.6))

    def bend(self, s: Float[Array, "..."]) -> Float[Array, "..."]:
        """Return the size of the derivative of load times depth slope, 8 s^3 - 2 p, or 0.3 of its two terms."""
        elastic, attraction = 8.0 * s**3, 2.0 * self.attraction
        return jnp.maximum(jnp.abs(elastic - attraction), 0.3 * (elastic + jnp.abs(attraction)))

    def reach(self, s: Float[Array, "..."], energy: Float[Array, "..."]) -> Float[Array, "..."]:
        """Return the distance in s over which the load changes: s, or what a tip of that energy would come to."""
        return (s**5 + 2.5 * jnp.maximum(energy, _LEAST_ENERGY)) ** 0.2


class Hertz(Parameters):
    """Hertz's contact of a sphere and a plane, without attraction: F = K sqrt(R) (-D)^(3/2) below gap 0.

    A contact has it alone, without forces, and begins and ends at its surface, gap 0.

    Args:
        modulus_gpa: reduced modulus K in GPa = nN/nm^2.
        tip_radius_nm: R in nm.

    Raises:
        ValueError: if a value is not positive.
    """

    modulus_gpa: Float[Array, "..."] = eqx.field(converter=as_parameter, default=DEFAULTS["modulus_gpa"])
    tip_radius_nm: Float[Array, "..."] = eqx.field(converter=as_parameter, default=DEFAULTS["tip_radius_nm"])

    @property
    def begins_nm(self) -> Float[Array, "..."]:
        """The gap at which the solids meet, 0."""
        return jnp.zeros_like(self.modulus_gpa)


class Dmt(Hertz):
    """The contact of Derjaguin, Muller and Toporov: F = K sqrt(R) (a0 - D)^(3/2) - P from a0 inwards.

    P is what the forces of the contact pull with at a0: H R/(6 a0^2) with `VanDerWaals`.

    Args:
        modulus_gpa: reduced modulus K in GPa = nN/nm^2.
        tip_radius_nm: R in nm.
        contact_distance_nm: a0 in nm, the gap at which the solids meet.

    Raises:
        ValueError: if a value is not positive.
    """

    contact_distance_nm: Float[Array, "..."] = eqx.field(
        converter=as_parameter, default=DEFAULTS["contact_distance_nm"]
    )

    @property
    def begins_nm(self) -> Float[Array, "..."]:
        """The gap at which the solids meet, a0."""
        return self.contact_distance_nm


def dry_curve(junction: Hertz, attraction_nn: Float[Array, "..."]) -> DryCurve:
    """Return a dry contact in normalised variables.

    Args:
        junction: Hertz's contact or DMT's.
        attraction_nn: what the forces outside pull with where it begins.
    """
    load_nn = junction.modulus_gpa * jnp.sqrt(junction.tip_radius_nm)
    # any depth will do as a unit: 1 nm
    return DryCurve(load_nn, jnp.ones_like(load_nn), attraction_nn / load_nn)
