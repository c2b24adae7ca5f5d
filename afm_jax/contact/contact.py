"""A contact: the liquid bridge's forces, the junction's, and the gaps at which the bridge forms and breaks.

The liquid bridge as its crossings need it: potential and damping, with everything computed once that can be.
"""

from collections.abc import Sequence
from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from afm_jax.checks import as_parameter, check_kind, check_parameter, is_traced, readable
from afm_jax.contact.forces.force import DissipativeForce, Force, ForceSum, StaticForce, terms_of
from afm_jax.contact.forces.jkr import Jkr
from afm_jax.contact.forces.liquid import Capillary, Liquid, Structural, Viscous
from afm_jax.contact.forces.solid import CoreRepulsion
from afm_jax.contact.parameters import EFFECTS, PAPER, REQUIRED_EFFECTS
from afm_jax.units import AJ_NM6_PER_J_M6


def _flat(forces: Force | Sequence[Force]) -> ForceSum:
    check_kind("forces", forces, Force | Sequence[Force])
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
    bridge_forms_nm: Float[Array, "..."] = eqx.field(converter=as_parameter, default=PAPER["bridge_forms_nm"])
    bridge_breaks_nm: Float[Array, "..."] = eqx.field(converter=as_parameter, default=PAPER["bridge_breaks_nm"])

    __repr__ = readable

    def __check_init__(self):
        check_kind("junction", self.junction, Jkr)
        check_parameter("bridge_forms_nm", self.bridge_forms_nm, "positive")
        check_parameter("bridge_breaks_nm", self.bridge_breaks_nm, "positive")
        traced = is_traced(self.bridge_forms_nm) or is_traced(self.bridge_breaks_nm)
        # in NumPy: inside a traced function JAX would trace the comparison of two known numbers, too
        if not traced and bool((np.asarray(self.bridge_breaks_nm) < np.asarray(self.bridge_forms_nm)).any()):
            raise ValueError(
                "`bridge_breaks_nm` must not be smaller than `bridge_forms_nm`: a bridge that breaks before it forms "
                "would give energy away"
            )

    @classmethod
    def paper(  # noqa: PLR0913
        cls,
        *,
        effects: Sequence[str] = EFFECTS,
        relative_humidity: ArrayLike = PAPER["relative_humidity"],
        temperature_k: ArrayLike = PAPER["temperature_k"],
        surface_tension_n_per_m: ArrayLike = PAPER["surface_tension_n_per_m"],
        molar_volume_cm3_per_mol: ArrayLike = PAPER["molar_volume_cm3_per_mol"],
        viscosity_pa_s: ArrayLike = PAPER["viscosity_pa_s"],
        tip_radius_nm: ArrayLike = PAPER["tip_radius_nm"],
        structural_amplitude_n_per_m: ArrayLike = PAPER["structural_amplitude_n_per_m"],
        structural_decay_nm: ArrayLike = PAPER["structural_decay_nm"],
        structural_offset_nm: ArrayLike = PAPER["structural_offset_nm"],
        core_constant_j_m6: ArrayLike = PAPER["core_constant_j_m6"],
        adhesion_energy_j_per_m2: ArrayLike = PAPER["adhesion_energy_j_per_m2"],
        modulus_gpa: ArrayLike = PAPER["modulus_gpa"],
        bridge_forms_nm: ArrayLike = PAPER["bridge_forms_nm"],
        bridge_breaks_nm: ArrayLike = PAPER["bridge_breaks_nm"],
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


FORCES = {"capillary": Capillary, "structural": Structural, "core": CoreRepulsion, "viscous": Viscous}
"""The force behind each effect."""

_NAMES = {force: name for name, force in FORCES.items()}


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


class Bridge(eqx.Module):
    """The forces of a bridge, reduced to their coefficients.

    A force's parameters enter thousands of evaluations of its potential; what depends on them alone is computed here.
    ``arrow``: -1 where time runs backwards, so that drag gives the energy that it takes; None: it does not.
    """

    static_kinds: tuple[type[StaticForce], ...] = eqx.field(static=True)
    static: tuple[tuple[Float[Array, "..."], ...], ...]
    dissipative_kinds: tuple[type[DissipativeForce], ...] = eqx.field(static=True)
    dissipative: tuple[tuple[Float[Array, "..."], ...], ...]
    arrow: Float[Array, "..."] | float | None = None

    @property
    def conserves(self) -> bool:
        """Whether there is no dissipative force."""
        return not self.dissipative_kinds

    def potential(self, gap: Float[Array, "..."]) -> Float[Array, "..."]:
        """Return the potential of all static forces in aJ at a gap in nm."""
        terms = zip(self.static_kinds, self.static, strict=True)
        return sum((kind.potential_of(parts, gap) for kind, parts in terms), start=jnp.zeros_like(gap))

    def force(self, gap: Float[Array, "..."]) -> Float[Array, "..."]:
        """Return the force of all static forces in nN at a gap in nm."""
        return -jax.jvp(self.potential, (gap,), (jnp.ones_like(gap),))[1]

    def stiffness(self, gap: Float[Array, "..."]) -> Float[Array, "..."]:
        """Return -dF/dD of all static forces in nN/nm at a gap in nm."""
        return -jax.jvp(self.force, (gap,), (jnp.ones_like(gap),))[1]

    def damping(self, gap: Float[Array, "..."]) -> Float[Array, "..."]:
        """Return the damping of all dissipative forces in nN us/nm at a gap in nm."""
        terms = zip(self.dissipative_kinds, self.dissipative, strict=True)
        total = sum((kind.damping_of(parts, gap) for kind, parts in terms), start=jnp.zeros_like(gap))
        return total if self.arrow is None else self.arrow * total

    def reversed(self) -> "Bridge":
        """Return the bridge for a motion that is followed against time."""
        return replace(self, arrow=-1.0)


def bridge_of(contact: Contact) -> Bridge:
    """Return a contact's bridge.

    Raises:
        TypeError: if a force is neither static nor dissipative.
    """
    for term in contact.forces.terms:
        if not isinstance(term, StaticForce | DissipativeForce):
            raise TypeError(f"{type(term).__name__} must be a StaticForce or a DissipativeForce to be part of a bridge")
    static = [term for term in contact.forces.terms if isinstance(term, StaticForce)]
    dissipative = [term for term in contact.forces.terms if isinstance(term, DissipativeForce)]
    return Bridge(
        static_kinds=tuple(type(term) for term in static),
        static=tuple(term.coefficients() for term in static),
        dissipative_kinds=tuple(type(term) for term in dissipative),
        dissipative=tuple(term.coefficients() for term in dissipative),
    )
