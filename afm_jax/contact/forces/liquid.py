"""Forces of the liquid bridge: capillary attraction, structural repulsion, viscous drag (eqs. 10 to 13).

Takes gaps in nm; gives forces in nN (static), their potentials in aJ, and damping in nN us/nm.

The liquid is in equilibrium with its vapour, whose humidity sets the meniscus' radius of curvature (eq. 11). The
structural repulsion of the confined liquid is averaged over its oscillations; the viscous force resists squeezing and
stretching.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from afm_jax.checks import as_parameter, is_traced
from afm_jax.contact.forces.force import DissipativeForce, Parameters, StaticForce
from afm_jax.contact.parameters import DEFAULTS
from afm_jax.units import GAS_CONSTANT_J_PER_MOL_K, NM_PER_CM3_PER_M2, NN_US_PER_NM2_PER_PA_S


class Liquid(Parameters):
    """A liquid in equilibrium with its vapour; the defaults are water at the paper's 50 % relative humidity.

    Args:
        relative_humidity: pressure of the vapour over the saturated one, p/p_s, between 0 and 1.
        temperature_k: temperature in K.
        surface_tension_n_per_m: gamma_l in N/m = nN/nm.
        molar_volume_cm3_per_mol: V_m in cm^3/mol.

    Raises:
        ValueError: if a value is not positive, or the relative humidity not below 1.
    """

    relative_humidity: Float[Array, "..."] = eqx.field(converter=as_parameter, default=DEFAULTS["relative_humidity"])
    temperature_k: Float[Array, "..."] = eqx.field(converter=as_parameter, default=DEFAULTS["temperature_k"])
    surface_tension_n_per_m: Float[Array, "..."] = eqx.field(
        converter=as_parameter, default=DEFAULTS["surface_tension_n_per_m"]
    )
    molar_volume_cm3_per_mol: Float[Array, "..."] = eqx.field(
        converter=as_parameter, default=DEFAULTS["molar_volume_cm3_per_mol"]
    )

    @property
    def kelvin_radius_nm(self) -> Float[Array, "..."]:
        """The Kelvin radius r_K = |gamma_l V_m / (R_gas T ln(p/p_s))| in nm (eq. 11, positive)."""
        length = self.surface_tension_n_per_m * self.molar_volume_cm3_per_mol * NM_PER_CM3_PER_M2
        return -length / (GAS_CONSTANT_J_PER_MOL_K * self.temperature_k * jnp.log(self.relative_humidity))


def check_meniscus(tip_radius_nm: Float[Array, "..."], liquid: Liquid) -> None:
    """Check that the meniscus fits under the tip; traced values pass.

    Raises:
        ValueError: if the Kelvin radius exceeds the tip's radius.
    """
    kelvin = liquid.kelvin_radius_nm
    if is_traced(kelvin) or is_traced(tip_radius_nm) or bool(np.all(np.asarray(kelvin < tip_radius_nm))):
        return
    humidity, length, radius = (
        float(np.max(np.asarray(value))) for value in (liquid.relative_humidity, kelvin, tip_radius_nm)
    )
    raise ValueError(
        f"`relative_humidity` {humidity:g} gives a Kelvin radius of {length:.4g} nm, more than the tip radius of "
        f"{radius:g} nm: no meniscus fits under the tip; lower the humidity or take a larger `tip_radius_nm`"
    )


class Capillary(StaticForce):
    """F = -4 pi R gamma_l / (1 + D/2 r_K), eq. 10.

    Args:
        tip_radius_nm: R in nm.
        liquid: gives gamma_l and r_K.

    Raises:
        ValueError: if the radius is not positive, or below the Kelvin radius (no such meniscus).
    """

    tip_radius_nm: Float[Array, "..."] = eqx.field(converter=as_parameter, default=DEFAULTS["tip_radius_nm"])
    liquid: Liquid = eqx.field(default_factory=Liquid)

    def __check_init__(self):
        self.check_ranges()
        check_meniscus(self.tip_radius_nm, self.liquid)

    @property
    def pull_nn(self) -> Float[Array, "..."]:
        """The attraction at gap 0, 4 pi R gamma_l, in nN."""
        return 4.0 * jnp.pi * self.tip_radius_nm * self.liquid.surface_tension_n_per_m

    def coefficients(self) -> tuple[Float[Array, "..."], ...]:
        """Return 8 pi R gamma_l r_K and 1/(2 r_K)."""
        length = 2.0 * self.liquid.kelvin_radius_nm
        return self.pull_nn * length, 1.0 / length

    @staticmethod
    def potential_of(coefficients: tuple[Float[Array, "..."], ...], gap: Float[Array, "..."]) -> Float[Array, "..."]:
        """Return 8 pi R gamma_l r_K ln(1 + D/2 r_K) in aJ; 0 at contact."""
        energy, rate = coefficients
        return energy * jnp.log(1.0 + gap * rate)


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

    amplitude_n_per_m: Float[Array, "..."] = eqx.field(
        converter=as_parameter, default=DEFAULTS["structural_amplitude_n_per_m"]
    )
    decay_nm: Float[Array, "..."] = eqx.field(converter=as_parameter, default=DEFAULTS["structural_decay_nm"])
    offset_nm: Float[Array, "..."] = eqx.field(converter=as_parameter, default=DEFAULTS["structural_offset_nm"])
    tip_radius_nm: Float[Array, "..."] = eqx.field(converter=as_parameter, default=DEFAULTS["tip_radius_nm"])
    liquid: Liquid = eqx.field(default_factory=Liquid)

    def __check_init__(self):
        self.check_ranges()
        check_meniscus(self.tip_radius_nm, self.liquid)

    @property
    def strength_nn(self) -> Float[Array, "..."]:
        """The force at gap 0, in nN: A_0 tau exp(delta/tau) times the share of the meniscus."""
        # a^2 = R^2 (1 - (1 - 2 r_K/R)^2) = 4 r_K (R - r_K)
        kelvin = self.liquid.kelvin_radius_nm
        share = -jnp.expm1(-2.0 * kelvin * (1.0 - kelvin / self.tip_radius_nm) / self.decay_nm)
        return self.amplitude_n_per_m * self.decay_nm * jnp.exp(self.offset_nm / self.decay_nm) * share

    def coefficients(self) -> tuple[Float[Array, "..."], ...]:
        """Return tau times the force at gap 0, and -1/tau."""
        return self.decay_nm * self.strength_nn, -1.0 / self.decay_nm

    @staticmethod
    def potential_of(coefficients: tuple[Float[Array, "..."], ...], gap: Float[Array, "..."]) -> Float[Array, "..."]:
        """Return tau F in aJ; 0 far away."""
        energy, rate = coefficients
        return energy * jnp.exp(gap * rate)


class Viscous(DissipativeForce):
    """F = -(3 pi/2) eta R^2 (dD/dt) / D, eq. 12.

    Args:
        viscosity_pa_s: eta in Pa s.
        tip_radius_nm: R in nm.

    Raises:
        ValueError: if the viscosity is negative or the radius not positive.
    """

    viscosity_pa_s: Float[Array, "..."] = eqx.field(converter=as_parameter, default=DEFAULTS["viscosity_pa_s"])
    tip_radius_nm: Float[Array, "..."] = eqx.field(converter=as_parameter, default=DEFAULTS["tip_radius_nm"])

    def coefficients(self) -> tuple[Float[Array, "..."], ...]:
        """Return (3 pi/2) eta R^2 in nN us."""
        return (1.5 * jnp.pi * self.viscosity_pa_s * NN_US_PER_NM2_PER_PA_S * self.tip_radius_nm**2,)

    @staticmethod
    def damping_of(coefficients: tuple[Float[Array, "..."], ...], gap: Float[Array, "..."]) -> Float[Array, "..."]:
        """Return (3 pi/2) eta R^2 / D in nN us/nm."""
        return coefficients[0] / gap
