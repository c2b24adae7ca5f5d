"""A contact: forces over a gap, a solid contact, and the gaps at which the bridge forms and breaks.

Takes the parameters, units in their names (eqs. 10 to 15); gives potential in aJ, force in nN, stiffness in nN/nm and
damping in nN us/nm at a gap in nm.

`Contact` holds the parameters; `Bridge` is what is computed from them once, for many evaluations of potential and
damping.
"""

from collections.abc import Callable, Sequence
from dataclasses import fields, replace
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.tree_util import Partial
from jaxtyping import Array, ArrayLike, Float

from afm_jax.checks import as_parameter, check_kind, check_parameter, is_traced, readable
from afm_jax.contact.forces.dry import Dmt, Hertz, dry_curve
from afm_jax.contact.forces.force import (
    DissipativeForce,
    ElasticCurve,
    Force,
    ForceSum,
    StaticForce,
    terms_of,
)
from afm_jax.contact.forces.jkr import Jkr
from afm_jax.contact.forces.liquid import Capillary, Liquid, Structural, Viscous
from afm_jax.contact.forces.solid import CoreRepulsion, VanDerWaals
from afm_jax.contact.parameters import ALL_EFFECTS, DEFAULTS, EFFECTS, PAPER, REQUIRED_EFFECTS
from afm_jax.solve.derivatives import slope_of
from afm_jax.units import AJ_NM6_PER_J_M6


class Contact(eqx.Module):
    """What happens when the tip meets the sample: forces over a gap, and a solid contact (section IV of the paper).

    With `Jkr()` a liquid bridge forms, in it the solid junction, and both break at larger gaps than they form. With
    `Dmt()` or `Hertz()` the contact is dry and without hysteresis: the forces act from `range_nm` inwards, where they
    are cut, to where the solids meet. Hertz's contact has no forces and begins at gap 0.

    Args:
        forces: the forces outside the solid contact, a sum (`Capillary() + CoreRepulsion()`) or a sequence; none if
            left out. Their order does not matter.
        junction: the solid contact: `Jkr()`, `Dmt()` or `Hertz()`.
        bridge_forms_nm: gap at which an approaching tip meets the bridge, in nm; of a dry contact its range.
        bridge_breaks_nm: gap at which a leaving tip breaks it, in nm; of a dry contact its range.
        range_nm: gap at which a contact with `Dmt()` begins and ends, in nm.

    Raises:
        ValueError: if a gap is not positive, the bridge breaks at a smaller gap than it forms, the range of a dry
            contact ends before the solids meet, or forces and solid contact do not go together.

    >>> Contact(forces=Capillary() + CoreRepulsion(), junction=Jkr()).effects
    ('capillary', 'core', 'jkr')
    >>> Contact(junction=Hertz()).effects
    ('hertz',)
    >>> Contact(forces=(VanDerWaals(),), junction=Dmt()).effects
    ('van_der_waals', 'dmt')
    """

    forces: ForceSum
    junction: Jkr | Dmt | Hertz
    bridge_forms_nm: Float[Array, "..."]
    bridge_breaks_nm: Float[Array, "..."]

    __repr__ = readable

    def __init__(
        self,
        forces: Force | Sequence[Force] = (),
        junction: Jkr | Dmt | Hertz | None = None,
        bridge_forms_nm: ArrayLike | None = None,
        bridge_breaks_nm: ArrayLike | None = None,
        *,
        range_nm: ArrayLike | None = None,
    ):
        """Fill in the gaps that are not given."""
        check_kind("forces", forces, Force | Sequence[Force])
        given = [forces] if isinstance(forces, Force) else forces
        self.forces = ForceSum(tuple(term for force in given for term in terms_of(force)))
        self.junction = Jkr() if junction is None else junction
        forms, breaks = PAPER["bridge_forms_nm"], PAPER["bridge_breaks_nm"]
        if isinstance(junction, Dmt):
            forms = breaks = DEFAULTS["range_nm"] if range_nm is None else range_nm
        elif isinstance(junction, Hertz):
            forms = breaks = 0.0
        if range_nm is not None and not isinstance(junction, Dmt):
            raise ValueError("`range_nm` is that of a contact with Dmt(): a bridge has two gaps, Hertz() has no range")
        self.bridge_forms_nm = as_parameter(forms if bridge_forms_nm is None else bridge_forms_nm)
        self.bridge_breaks_nm = as_parameter(breaks if bridge_breaks_nm is None else bridge_breaks_nm)

    def __check_init__(self):
        check_kind("junction", self.junction, Jkr | Dmt | Hertz)
        _check_solid(self.forces, self.junction)
        if not self.spans:
            return
        names = ("range_nm",) * 2 if self.dry else ("bridge_forms_nm", "bridge_breaks_nm")
        check_parameter(names[0], self.bridge_forms_nm, "positive")
        check_parameter(names[1], self.bridge_breaks_nm, "positive")
        gaps = self.bridge_forms_nm, self.bridge_breaks_nm, getattr(self.junction, "begins_nm", 0.0)
        if any(is_traced(gap) for gap in gaps):
            return
        # in NumPy: inside a traced function JAX would trace the comparison of known numbers, too
        forms, breaks, solid = (np.asarray(gap) for gap in gaps)
        if self.dry and not (bool(np.all(forms == breaks)) and bool(np.all(forms > solid))):
            raise ValueError(
                f"`range_nm`, where a dry contact begins and ends, must be larger than `contact_distance_nm` of "
                f"{solid.max():g}, but is {forms.min():g}"
            )
        if bool((breaks < forms).any()):
            raise ValueError(
                "`bridge_breaks_nm` must not be smaller than `bridge_forms_nm`: a bridge that breaks before it forms "
                "would give energy away"
            )

    @classmethod
    def paper(cls, *, effects: Sequence[str] = EFFECTS, **parameters: ArrayLike) -> "Contact":
        """Return the contact of section IV; every value can be changed by its keyword, every effect left out.

        Args:
            effects: which of "capillary", "structural", "core", "viscous" and "jkr" there are; what is absent is
                absent from the compiled program.
            parameters: the paper's values if left out:

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
            TypeError: if there is no such parameter.
        """
        return cls.of(effects, **parameters)

    @classmethod
    def of(cls, effects: Sequence[str], **parameters: ArrayLike) -> "Contact":
        """Return the contact of some effects, the paper's or a dry one; parameters that they do not need are ignored.

        Args:
            effects: names of `EFFECTS` with "jkr", or of `DRY_EFFECTS` with "dmt" or "hertz".
            parameters: keywords of `Contact.paper`, and "hamaker_constant_aj", "contact_distance_nm", "range_nm".

        Raises:
            ValueError: if an effect is unknown, a required one missing, two do not go together, or a value is outside
                its range.
            TypeError: if there is no such parameter.

        >>> Contact.of(["van_der_waals", "dmt"], modulus_gpa=1.0).junction.modulus_gpa.item()
        1.0
        """
        check_effects(effects)
        for name in parameters:
            if name not in DEFAULTS:
                raise TypeError(f"a contact has no parameter `{name}`; it has {', '.join(DEFAULTS)}")
        value: dict[str, Any] = DEFAULTS | parameters
        value["core_constant_aj_nm6"] = value["core_constant_j_m6"] * AJ_NM6_PER_J_M6

        def make(kind: type[Any], effect: str = "") -> Any:
            # a field has the parameter's name, in full or without the effect's in front
            names = [field.name for field in fields(kind)]
            if "liquid" in names:
                value["liquid"] = make(Liquid)
            return kind(**{name: value.get(f"{effect}_{name}", value.get(name)) for name in names})

        forces = [make(kind, effect) for effect, kind in FORCES.items() if effect in effects]
        if "hertz" in effects:
            return cls((), make(Hertz))
        if "dmt" in effects:
            return cls(forces, make(Dmt), range_nm=value["range_nm"])
        return cls(forces, make(Jkr), value["bridge_forms_nm"], value["bridge_breaks_nm"])

    @property
    def effects(self) -> tuple[str, ...]:
        """The names of the effects that this contact has, forces first; own forces by their class."""
        return tuple(_NAMES.get(type(part), type(part).__name__) for part in (*self.forces.terms, self.junction))

    @property
    def dry(self) -> bool:
        """Whether there is no bridge and no hysteresis."""
        return isinstance(self.junction, Hertz)

    @property
    def spans(self) -> bool:
        """Whether there is a gap between where the contact begins and where its solids meet: not with `Hertz`."""
        return isinstance(self.junction, Jkr | Dmt)

    @property
    def solid(self) -> ElasticCurve:
        """The solid contact in normalised variables, with what the forces pull where a dry one begins."""
        if isinstance(self.junction, Jkr):
            return self.junction.curve
        return dry_curve(self.junction, -bridge_of(self).force(self.junction.begins_nm))


FORCES = {
    "capillary": Capillary,
    "structural": Structural,
    "core": CoreRepulsion,
    "van_der_waals": VanDerWaals,
    "viscous": Viscous,
}
"""The force behind each effect."""

_NAMES = {force: name for name, force in FORCES.items()} | {Jkr: "jkr", Dmt: "dmt", Hertz: "hertz"}


_DRY_SOLIDS = {
    "hertz": (("hertz",), "Hertz's contact has no other forces; take 'dmt'"),
    "dmt": (("van_der_waals", "viscous", "dmt"), "there is no liquid bridge"),
}
"""The solid contact of each kind of dry contact: the effects that go with it, and why others do not."""


def _check_solid(forces: ForceSum, junction: Jkr | Dmt | Hertz) -> None:
    """Raise where the forces do not go together with the solid contact."""
    for term in forces.terms:
        name = type(term).__name__
        if isinstance(junction, Dmt) and isinstance(term, Capillary | Structural | CoreRepulsion):
            raise ValueError(f"{name}() is a force of the liquid bridge, whose solid contact is Jkr(), not Dmt()")  # noqa: TRY004
        if isinstance(junction, Hertz) and not isinstance(junction, Dmt):
            raise ValueError(f"Hertz() is a contact without other forces; {name}() acts with Dmt()")  # noqa: TRY004


def check_effects(effects: Sequence[str]) -> None:
    """Check a choice of effects.

    Raises:
        ValueError: if one is unknown or named twice, two do not go together, or a required one is missing; says which
            and why.
    """
    for name in effects:
        if name not in ALL_EFFECTS:
            raise ValueError(f"`effects` must be chosen from {', '.join(ALL_EFFECTS)}, but one is {name!r}")
    if len(set(effects)) < len(effects):
        raise ValueError("`effects` must not name an effect twice")
    solid = next((name for name in _DRY_SOLIDS if name in effects), None)
    allowed, reason = _DRY_SOLIDS[solid] if solid else (EFFECTS, "")
    for name in effects:
        if name not in allowed and solid:
            raise ValueError(f"`effects` cannot hold {name!r} with {solid!r}: {reason}")
        if name not in allowed:
            raise ValueError("`effects` with 'van_der_waals' must hold 'dmt': it is the attraction of a dry contact")
    if solid:
        return
    for name, reason in REQUIRED_EFFECTS.items():
        if name not in effects:
            raise ValueError(f"`effects` must hold {name!r}: {reason}")


class Bridge(eqx.Module):
    """The forces of a bridge as functions of the gap alone.

    A force's parameters enter thousands of evaluations of its potential; what depends on them alone is computed once.

    Attributes:
        potentials: of the static forces, in aJ.
        dampings: of the dissipative forces, in nN us/nm.
        spans: whether there is a gap between where the contact begins and where the solids meet.
        arrow: -1 where time runs backwards, so that drag gives the energy that it takes; None: it does not.
    """

    potentials: tuple[Callable[[Array], Array], ...]
    dampings: tuple[Callable[[Array], Array], ...]
    spans: bool = eqx.field(static=True, default=True)
    arrow: Float[Array, "..."] | float | None = None

    @property
    def conserves(self) -> bool:
        """Whether there is no dissipative force."""
        return not self.dampings

    def potential(self, gap: Float[Array, "..."]) -> Float[Array, "..."]:
        """Return the potential of all static forces in aJ at a gap in nm."""
        return sum((potential(gap) for potential in self.potentials), start=jnp.zeros_like(gap))

    def force(self, gap: Float[Array, "..."]) -> Float[Array, "..."]:
        """Return the force of all static forces in nN at a gap in nm."""
        return -slope_of(self.potential, gap)

    def stiffness(self, gap: Float[Array, "..."]) -> Float[Array, "..."]:
        """Return -dF/dD of all static forces in nN/nm at a gap in nm."""
        return -slope_of(self.force, gap)

    def damping(self, gap: Float[Array, "..."]) -> Float[Array, "..."]:
        """Return the damping of all dissipative forces in nN us/nm at a gap in nm."""
        total = sum((damping(gap) for damping in self.dampings), start=jnp.zeros_like(gap))
        return total if self.arrow is None else self.arrow * total

    def reversed(self) -> "Bridge":
        """Return the bridge for a motion that is followed against time."""
        return replace(self, arrow=-1.0)


def bridge_of(contact: Contact) -> Bridge:
    """Return a contact's bridge.

    Raises:
        TypeError: if a force is neither static nor dissipative.
    """
    potentials, dampings = [], []
    for term in contact.forces.terms:
        # partial functions that are trees of their coefficients
        if isinstance(term, StaticForce):
            potentials.append(Partial(type(term).potential_of, term.coefficients()))
        elif isinstance(term, DissipativeForce):
            dampings.append(Partial(type(term).damping_of, term.coefficients()))
        else:
            raise TypeError(f"{type(term).__name__} must be a StaticForce or a DissipativeForce to be part of a bridge")
    return Bridge(tuple(potentials), tuple(dampings), contact.spans)
