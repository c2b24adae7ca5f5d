"""The structural repulsion of a confined liquid, averaged over its oscillations (eq. 13)."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from afm_jax.contact.forces.force import StaticForce
from afm_jax.contact.forces.liquid import Liquid, check_meniscus
from afm_jax.parameters import as_argument, as_parameter, check_parameter


class Structural(StaticForce):
    """F = A_0 tau exp(-(D - delta)/tau) (1 - exp(-a^2/(2 R tau))), a = R sin(arccos(1 - 2 r_K/R)), eq. 13.

    Args:
        amplitude_n_per_m: A_0 in N/m.
        decay_nm: tau in nm.
        offset_nm: delta in nm.
        tip_radius_nm: R in nm.
        liquid: gives r_K.

    Raises:
        ValueError: if a value is outside its range, or the Kelvin radius exceeds the tip's (no such meniscus).
    """

    amplitude_n_per_m: Float[Array, "..."] = eqx.field(converter=as_parameter, default=40.0)
    decay_nm: Float[Array, "..."] = eqx.field(converter=as_parameter, default=0.6)
    offset_nm: Float[Array, "..."] = eqx.field(converter=as_parameter, default=0.6)
    tip_radius_nm: Float[Array, "..."] = eqx.field(converter=as_parameter, default=100.0)
    liquid: Liquid = eqx.field(default_factory=Liquid)

    def __check_init__(self):
        check_parameter("amplitude_n_per_m", self.amplitude_n_per_m, "not negative")
        check_parameter("decay_nm", self.decay_nm, "positive")
        check_parameter("offset_nm", self.offset_nm, "finite")
        check_parameter("tip_radius_nm", self.tip_radius_nm, "positive")
        check_meniscus(self.tip_radius_nm, self.liquid)

    @property
    def strength_nn(self) -> Float[Array, "..."]:
        """The force at gap 0, in nN: A_0 tau exp(delta/tau) times the share of the meniscus."""
        # a^2 = R^2 (1 - (1 - 2 r_K/R)^2) = 4 r_K (R - r_K)
        kelvin = self.liquid.kelvin_radius_nm
        share = -jnp.expm1(-2.0 * kelvin * (1.0 - kelvin / self.tip_radius_nm) / self.decay_nm)
        return self.amplitude_n_per_m * self.decay_nm * jnp.exp(self.offset_nm / self.decay_nm) * share

    def __call__(self, gap_nm: ArrayLike, gap_rate_nm_per_us: ArrayLike = 0.0) -> Float[Array, "..."]:
        """Return the force in nN at a gap in nm; the rate does not matter."""
        del gap_rate_nm_per_us
        return self.strength_nn * jnp.exp(-as_argument(gap_nm) / self.decay_nm)

    def coefficients(self) -> tuple[Float[Array, "..."], ...]:
        """Return tau times the force at gap 0, and -1/tau."""
        return self.decay_nm * self.strength_nn, -1.0 / self.decay_nm

    @staticmethod
    def potential_of(coefficients: tuple[Float[Array, "..."], ...], gap: Float[Array, "..."]) -> Float[Array, "..."]:
        """Return tau F in aJ; 0 far away."""
        energy, rate = coefficients
        return energy * jnp.exp(gap * rate)
