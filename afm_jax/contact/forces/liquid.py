"""The liquid of the bridge, and its radius of curvature in equilibrium with the humid air (eq. 11)."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from afm_jax.parameters import as_parameter, check_parameter, is_traced, readable
from afm_jax.units import GAS_CONSTANT_J_PER_MOL_K, NM_PER_CM3_PER_M2


class Liquid(eqx.Module):
    """A liquid in equilibrium with its vapour; the defaults are water at the paper's 50 % relative humidity.

    Args:
        relative_humidity: pressure of the vapour over the saturated one, p/p_s, between 0 and 1.
        temperature_k: temperature in K.
        surface_tension_n_per_m: gamma_l in N/m = nN/nm.
        molar_volume_cm3_per_mol: V_m in cm^3/mol.

    Raises:
        ValueError: if a value is not positive, or the relative humidity not below 1.
    """

    relative_humidity: Float[Array, "..."] = eqx.field(converter=as_parameter, default=0.5)
    temperature_k: Float[Array, "..."] = eqx.field(converter=as_parameter, default=293.15)
    surface_tension_n_per_m: Float[Array, "..."] = eqx.field(converter=as_parameter, default=0.0728)
    molar_volume_cm3_per_mol: Float[Array, "..."] = eqx.field(converter=as_parameter, default=18.0795)

    __repr__ = readable

    def __check_init__(self):
        check_parameter("relative_humidity", self.relative_humidity, "between 0 and 1")
        check_parameter("temperature_k", self.temperature_k, "positive")
        check_parameter("surface_tension_n_per_m", self.surface_tension_n_per_m, "positive")
        check_parameter("molar_volume_cm3_per_mol", self.molar_volume_cm3_per_mol, "positive")

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
