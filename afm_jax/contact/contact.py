"""A contact: the liquid bridge's forces, the junction's, and the gaps at which the bridge forms and breaks."""

from collections.abc import Sequence

import equinox as eqx
from jaxtyping import Array, ArrayLike, Float

from afm_jax.checks import as_parameter, check_parameter, is_traced, readable
from afm_jax.contact.forces.force import Force, ForceSum, terms_of
from afm_jax.contact.forces.jkr import Jkr
from afm_jax.contact.forces.liquid import Capillary, Liquid, Structural, Viscous
from afm_jax.contact.forces.solid import CoreRepulsion
from afm_jax.units import AJ_NM6_PER_J_M6

EFFECTS = ("capillary", "structural", "core", "viscous", "jkr")
"""The effects of the paper's contact, by the names of scene files and options."""

REQUIRED_EFFECTS = {
    "core": "without the core repulsion the bridge never gets as stiff as the JKR contact, so that no junction forms",
    "jkr": "the JKR contact is the solid junction itself: without it the tip would fall through the sample",
}
"""The effects that a contact cannot do without, and why."""


def _flat(forces: Force | Sequence[Force]) -> ForceSum:
    terms = [forces] if isinstance(forces, Force) else list(forces)
    return ForceSum(tuple(term for force in terms for term in terms_of(force)))


class Contact(eqx.Module):
    """What happens when the tip meets the sample: bridge, junction and their hysteresis (section IV).

    Args:
        forces: the bridge's forces, as a sum (`Capillary() + CoreRepulsion()`) or a sequence; no order.
        junction: the solid junction's elastic contact.
        bridge_forms_nm: gap at which an approaching tip meets the bridge, in nm.
        bridge_breaks_nm: gap at which a leaving tip breaks it, in nm.

    Raises:
        ValueError: if a gap is not positive, or the bridge breaks at a smaller gap than it forms.

    >>> Contact(forces=Capillary() + CoreRepulsion(), junction=Jkr()).effects
    ('capillary', 'core', 'jkr')
    """

    forces: ForceSum = eqx.field(converter=_flat)
    junction: Jkr = eqx.field(default_factory=Jkr)
    bridge_forms_nm: Float[Array, "..."] = eqx.field(converter=as_parameter, default=3.5)
    bridge_breaks_nm: Float[Array, "..."] = eqx.field(converter=as_parameter, default=4.7)

    __repr__ = readable

    def __check_init__(self):
        check_parameter("bridge_forms_nm", self.bridge_forms_nm, "positive")
        check_parameter("bridge_breaks_nm", self.bridge_breaks_nm, "positive")
        traced = is_traced(self.bridge_forms_nm) or is_traced(self.bridge_breaks_nm)
        if not traced and bool((self.bridge_breaks_nm < self.bridge_forms_nm).any()):
            raise ValueError(
                "`bridge_breaks_nm` must not be smaller than `bridge_forms_nm`: a bridge that breaks before it forms "
                "would give energy away"
            )

    @classmethod
    def paper(  # noqa: PLR0913
        cls,
        *,
        effects: Sequence[str] = EFFECTS,
        relative_humidity: ArrayLike = 0.5,
        temperature_k: ArrayLike = 293.15,
        surface_tension_n_per_m: ArrayLike = 0.0728,
        molar_volume_cm3_per_mol: ArrayLike = 18.0795,
        viscosity_pa_s: ArrayLike = 1.005e-3,
        tip_radius_nm: ArrayLike = 100.0,
        structural_amplitude_n_per_m: ArrayLike = 40.0,
        structural_decay_nm: ArrayLike = 0.6,
        structural_offset_nm: ArrayLike = 0.6,
        core_constant_j_m6: ArrayLike = 1e-78,
        adhesion_energy_j_per_m2: ArrayLike = 0.3,
        modulus_gpa: ArrayLike = 100.0,
        bridge_forms_nm: ArrayLike = 3.5,
        bridge_breaks_nm: ArrayLike = 4.7,
    ) -> "Contact":
        """Return the contact of section IV; every value can be changed by its keyword, every effect left out.

        Args:
            effects: which of "capillary", "structural", "core", "viscous" and "jkr" there are; what is absent is
                absent from the compiled program.
            relative_humidity: p/p_s, between 0 and 1.
            temperature_k: temperature in K.
            surface_tension_n_per_m: gamma_l in N/m.
            molar_volume_cm3_per_mol: V_m of the liquid in cm^3/mol.
            viscosity_pa_s: eta of the liquid in Pa s.
            tip_radius_nm: R in nm.
            structural_amplitude_n_per_m: A_0 in N/m.
            structural_decay_nm: tau in nm.
            structural_offset_nm: delta in nm.
            core_constant_j_m6: B in J m^6.
            adhesion_energy_j_per_m2: w in J/m^2.
            modulus_gpa: reduced modulus K in GPa.
            bridge_forms_nm: gap at which the bridge forms, in nm.
            bridge_breaks_nm: gap at which it breaks, in nm.

        Raises:
            ValueError: if an effect is unknown or a required one missing, or a value outside its range.
        """
        check_effects(effects)
        liquid = Liquid(relative_humidity, temperature_k, surface_tension_n_per_m, molar_volume_cm3_per_mol)
        makers = {
            "capillary": lambda: Capillary(tip_radius_nm, liquid),
            "structural": lambda: Structural(
                structural_amplitude_n_per_m, structural_decay_nm, structural_offset_nm, tip_radius_nm, liquid
            ),
            "core": lambda: CoreRepulsion(core_constant_j_m6 * AJ_NM6_PER_J_M6, tip_radius_nm),
            "viscous": lambda: Viscous(viscosity_pa_s, tip_radius_nm),
        }
        return cls(
            forces=[make() for name, make in makers.items() if name in effects],
            junction=Jkr(adhesion_energy_j_per_m2, modulus_gpa, tip_radius_nm),
            bridge_forms_nm=bridge_forms_nm,
            bridge_breaks_nm=bridge_breaks_nm,
        )

    @property
    def effects(self) -> tuple[str, ...]:
        """The names of the effects that this contact has, forces first; own forces by their class."""
        return (*(_NAMES.get(type(term), type(term).__name__) for term in self.forces.terms), "jkr")


_NAMES = {Capillary: "capillary", Structural: "structural", CoreRepulsion: "core", Viscous: "viscous"}


def check_effects(effects: Sequence[str]) -> None:
    """Check a choice of effects.

    Raises:
        ValueError: if one is unknown or named twice, or a required one is missing; says which and why.
    """
    for name in effects:
        if name not in EFFECTS:
            raise ValueError(f"`effects` must be chosen from {', '.join(EFFECTS)}, but one is {name!r}")
    if len(set(effects)) < len(effects):
        raise ValueError("`effects` must not name an effect twice")
    for name, reason in REQUIRED_EFFECTS.items():
        if name not in effects:
            raise ValueError(f"`effects` must hold {name!r}: {reason}")
