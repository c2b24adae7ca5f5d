"""The parameters of a contact and its effects, written once: scene files, options, fits and reports take theirs here.

Gives names, units, ranges and meanings; eqs. 10 to 15 say what the parameters do.

Without JAX, so that `--help` needs none.
"""

from dataclasses import dataclass

from afm_jax.units import unit_of

EFFECTS = ("capillary", "structural", "core", "viscous", "jkr")
"""The effects of the paper's contact, by the names of scene files and options."""

DRY_EFFECTS = ("van_der_waals", "viscous", "dmt", "hertz")
"""The effects of dry contacts; each has one of the last two, which are its solid contact."""

ALL_EFFECTS = (*EFFECTS, *(name for name in DRY_EFFECTS if name not in EFFECTS))
"""All of them."""

REQUIRED_EFFECTS = {
    "core": "without the core repulsion the bridge never gets as stiff as the JKR contact, so that no junction forms",
    "jkr": "the JKR contact is the solid junction itself: without it the tip would fall through the sample",
}
"""The effects that the paper's contact cannot do without, and why."""

WHY_REQUIRED = REQUIRED_EFFECTS | dict.fromkeys(
    ("dmt", "hertz"), "it is the solid contact itself: without it the tip would fall through the sample"
)
"""Why an effect that a contact has cannot be left out of it."""

REMOVABLE_EFFECTS = tuple(name for name in EFFECTS[::-1] if name not in REQUIRED_EFFECTS)
"""The effects that it can do without."""


@dataclass(frozen=True, kw_only=True)
class ContactParameter:
    """A parameter of a contact: a keyword of `Contact.paper`, a key of scene files, an option, a fit parameter.

    Attributes:
        name: with its unit, as in scene files.
        default: the paper's value.
        allowed: which values `afm_jax.checks.check_parameter` lets pass.
        meaning: what it is, in a line.
        fitted: the range of values that a fit may take.
        width: of a parameter of any sign, the scale on which a fit varies it, and how far to either side of the paper's
            value fits start; 0: varied by factors.
        spread: the factor to either side of the paper's value within which fits start.
        evenly: the range within which fits start, evenly; None: as ``width`` or ``spread`` say.
        serves: the effects that use it, one of which must be there; none: it is always used.
        unsure: standard error that is assumed where a fit holds it and nothing better is said: in its unit where there
            is a ``width`` or ``evenly``, else relative; 30 % unless said.
        advice: what to measure so that a fit determines it, if there is more to say than of any.
    """

    name: str
    default: float
    allowed: str = "positive"
    meaning: str
    fitted: tuple[float, float]
    unsure: float = 0.3
    width: float = 0.0
    spread: float = 3.0
    evenly: tuple[float, float] | None = None
    serves: tuple[str, ...] = ()
    advice: str = ""

    @property
    def unit(self) -> str:
        """In words, as the name ends."""
        return unit_of(self.name)

    def error_at(self, value: float) -> float:
        """Return the standard error that is assumed of a value at which a fit holds it."""
        return self.unsure if self.width or self.evenly else self.unsure * abs(value)

    @property
    def starts(self) -> tuple[float, float]:
        """The range within which fits start."""
        if self.width:
            return self.default - self.width, self.default + self.width
        return self.evenly or (self.default / self.spread, self.default * self.spread)


_LIQUID = ("capillary", "structural")

CONTACT_PARAMETERS = (
    ContactParameter(
        name="relative_humidity",
        default=0.5,
        allowed="between 0 and 1",
        meaning="p/p_s of the vapour",
        unsure=0.1,
        fitted=(0.02, 0.99),
        evenly=(0.1, 0.9),
        serves=_LIQUID,
        advice="measure slow impacts too, or hold it fixed at the hygrometer's value",
    ),
    ContactParameter(
        name="temperature_k",
        default=293.15,
        meaning="temperature",
        unsure=0.02,
        fitted=(100.0, 1e3),
        spread=1.3,
        serves=_LIQUID,
    ),
    ContactParameter(
        name="surface_tension_n_per_m",
        default=0.0728,
        meaning="of the liquid",
        unsure=0.2,
        fitted=(1e-3, 1.0),
        spread=1.3,
        serves=_LIQUID,
    ),
    ContactParameter(
        name="molar_volume_cm3_per_mol",
        default=18.0795,
        meaning="of the liquid",
        unsure=0.1,
        fitted=(1.0, 1e3),
        spread=1.3,
        serves=_LIQUID,
    ),
    ContactParameter(
        name="viscosity_pa_s",
        default=1.005e-3,
        allowed="not negative",
        meaning="of the liquid",
        fitted=(0.0, 1.0),
        serves=("viscous",),
        advice="measure over a wider range of drives, or hold it fixed at the liquid's known value",
    ),
    ContactParameter(name="tip_radius_nm", default=100.0, meaning="R", fitted=(1.0, 1e4)),
    ContactParameter(
        name="structural_amplitude_n_per_m",
        default=40.0,
        allowed="not negative",
        meaning="A_0 of the structural force",
        fitted=(0.0, 1e4),
        serves=("structural",),
    ),
    ContactParameter(
        name="structural_decay_nm",
        default=0.6,
        meaning="tau of the structural force",
        unsure=0.2,
        fitted=(0.05, 10.0),
        serves=("structural",),
    ),
    ContactParameter(
        name="structural_offset_nm",
        default=0.6,
        allowed="finite",
        meaning="delta of the structural force",
        unsure=0.2,
        fitted=(-5.0, 5.0),
        width=0.2,
        serves=("structural",),
    ),
    ContactParameter(
        name="core_constant_j_m6",
        allowed="above 0",
        default=1e-78,
        meaning="B of the core repulsion",
        unsure=0.5,
        fitted=(1e-82, 1e-74),
        serves=("core",),
    ),
    ContactParameter(
        name="adhesion_energy_j_per_m2",
        default=0.3,
        meaning="w of the JKR contact",
        fitted=(0.02, 5.0),
        advice="measure slow impacts too, or hold it or the humidity fixed: both set the hysteresis",
        serves=("jkr",),
    ),
    ContactParameter(
        name="modulus_gpa",
        default=100.0,
        meaning="reduced modulus K of the JKR contact",
        fitted=(1.0, 2e3),
        advice="measure at several orders, detuned to both sides of each resonance",
    ),
    ContactParameter(
        name="bridge_forms_nm",
        default=3.5,
        meaning="gap at which the bridge forms",
        unsure=0.2,
        fitted=(0.5, 50.0),
        advice="hold it fixed: only slow impacts depend on it",
        serves=("jkr",),
    ),
    ContactParameter(
        name="bridge_breaks_nm",
        default=4.7,
        meaning="gap at which the bridge breaks",
        unsure=0.2,
        fitted=(0.5, 50.0),
        advice="measure slow impacts too: small drives, close to where the orbit is lost",
        serves=("jkr",),
    ),
)
"""Those of the paper's contact, in the order of scene files and help texts."""

DRY_PARAMETERS = (
    ContactParameter(
        name="hamaker_constant_aj",
        default=0.1,
        allowed="not negative",
        meaning="H of the van der Waals force; 0.1 is typical in air",
        fitted=(0.0, 10.0),
        serves=("van_der_waals",),
    ),
    ContactParameter(
        name="contact_distance_nm",
        default=0.165,
        meaning="a0, the gap at which the solids of a DMT contact meet",
        fitted=(0.05, 5.0),
        serves=("dmt",),
    ),
    ContactParameter(
        name="range_nm",
        default=20.0,
        meaning="gap at which a DMT contact begins and ends: the force is cut there",
        fitted=(1.0, 1e3),
        serves=("dmt",),
    ),
)
"""Those that only a dry contact has; it shares modulus, tip radius and viscosity."""

CONTACT_PARAMETER = {parameter.name: parameter for parameter in CONTACT_PARAMETERS}
"""The same by name."""

PAPER = {parameter.name: parameter.default for parameter in CONTACT_PARAMETERS}
"""The paper's value of each."""

DEFAULTS = PAPER | {parameter.name: parameter.default for parameter in DRY_PARAMETERS}
"""The value of each that is taken where nothing is said, those of dry contacts included."""

CONTACT_RANGES = {parameter.name: parameter.allowed for parameter in (*CONTACT_PARAMETERS, *DRY_PARAMETERS)}
"""Which values of each `afm_jax.checks.check_parameter` lets pass."""


def idle_without(name: str, effects: tuple[str, ...]) -> tuple[str, ...]:
    """Return the effects that use a parameter and are missing; none if one of those given uses it."""
    serves = next((known.serves for known in (*CONTACT_PARAMETERS, *DRY_PARAMETERS) if known.name == name), ())
    return () if not serves or set(serves) & set(effects) else serves
