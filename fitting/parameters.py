"""The parameters of fitted models, written once: fits, plans, inversion, help texts and reports take theirs here.

Without JAX or NumPy, so that `--help` needs none.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass

from afm_jax.contact.parameters import CONTACT_PARAMETERS, PAPER


@dataclass(frozen=True, kw_only=True)
class Parameter:
    """A fit parameter: what it is, where it may lie, and where a search for it starts.

    Attributes:
        name: as in tables, options and reports; a parameter of the law is called like its field of `ImpactLaw`, one of
            the delay like its field of `CollisionDelay` with "delay_" before it.
        unit: in words.
        meaning: what it is, in a line.
        lowest: end of the range that a fit may take.
        highest: its other end.
        reference: the value that stands for its absence.
        sign: of a loss of instantaneous laws, on which side of the reference its values lie.
        width: of a parameter of the law that may have any sign, the scale on which it varies.
        starts: range within which searches start, of the loss of r, else of the value; even where there is a ``width``
            or it is ``even``, else logarithmic; None: no search starts from it.
        even: see ``starts``.
        drive_power: ``starts`` are in units of this power of the drives' speeds beta omega, the lowest of the slowest
            drive and the highest of the fastest, for on them depends what an impact captures.
        mass_power: likewise of the effective mass in ng.
        advice: what to measure so that the amplitudes determine it, if there is more to say than of any.
    """

    name: str
    unit: str = ""
    meaning: str = ""
    lowest: float = -math.inf
    highest: float = math.inf
    reference: float = 0.0
    sign: int = 0
    width: float = 0.0
    starts: tuple[float, float] | None = None
    even: bool = False
    drive_power: float = 0.0
    mass_power: float = 0.0
    advice: str = ""


_SLOW = "measure slow impacts too: small drives, close to where the orbit is lost"

LAW = (
    Parameter(
        name="r",
        meaning="coefficient of restitution",
        lowest=0.01,
        highest=1.0,
        reference=1.0,
        sign=-1,
        starts=(0.7, 1e-4),
        advice="measure fast impacts too: large drives on resonance, and give the quality factor with its error",
    ),
    Parameter(
        name="epsilon",
        unit="nm^2/us^2",
        meaning="adhesion, 2 delta/m",
        lowest=0.0,
        sign=1,
        starts=(1e-4, 30.0),
        drive_power=2.0,
        advice=_SLOW,
    ),
    Parameter(
        name="viscous_loss",
        unit="nm/us",
        meaning="loss linear in speed",
        lowest=0.0,
        sign=1,
        starts=(1e-4, 10.0),
        drive_power=1.0,
        advice="measure over a wider range of drives at the same frequency",
    ),
)
"""What an impact law is made of."""

DELAY = (
    Parameter(
        name="delay_hertz",
        unit="us (nm/us)^0.2",
        meaning="Hertz contact time at 1 nm/us",
        lowest=0.0,
        # a factor of 5 around the paper's tip
        starts=(0.04, 1.0),
        mass_power=0.4,
        advice="measure at several orders, detuned to both sides of each resonance",
    ),
    Parameter(
        name="delay_lead_nm",
        unit="nm",
        meaning="lead of a slow retract",
        lowest=-300.0,
        highest=300.0,
        width=5.0,
        starts=(0.0, 10.0),
        advice=_SLOW,
    ),
    Parameter(
        name="delay_offset_nm",
        unit="nm",
        meaning="offset of the contact surface, twice",
        lowest=-100.0,
        highest=100.0,
        width=1.0,
        starts=(-0.5, 1.5),
        advice="measure at several offsets and drives",
    ),
)
"""What a collision delay is made of."""

NUISANCES = (
    Parameter(name="quality_factor", meaning="of the free resonance", lowest=0.51),
    Parameter(
        name="offset_origin_nm",
        unit="nm",
        meaning="to be added to the table's offsets",
    ),
    Parameter(
        name="tip_calibration",
        meaning="measured over true amplitude of the tip",
        lowest=0.1,
        highest=10.0,
    ),
    Parameter(
        name="drive_calibration",
        meaning="true over stated amplitude of the platform, or of the free tip",
        lowest=0.1,
        highest=10.0,
    ),
    Parameter(
        name="free_frequency_khz",
        unit="kHz",
        meaning="of the free resonance",
        lowest=1e-3,
    ),
    Parameter(
        name="phase_zero_deg",
        unit="degrees",
        meaning="what the instrument adds to every phase",
    ),
    Parameter(
        name="phase_drift_deg",
        unit="degrees",
        meaning="what the phase drifts by from the first row to the last",
    ),
    Parameter(
        name="free_amplitude_drift",
        meaning="what the free amplitude drifts by from the first row to the last, over itself",
        lowest=-0.9,
        highest=0.9,
    ),
)
"""What the instrument adds; each has a Gaussian constraint."""
DRIFT_NAMES = ("phase_drift_deg", "free_amplitude_drift")
"""Those that are only of a table whose rows stand in order of time."""
PRIOR_NUISANCES = tuple(nuisance for nuisance in NUISANCES if nuisance.name not in DRIFT_NAMES)
"""Those that may be known before anything is measured."""

CONTACT = tuple(
    Parameter(
        name=known.name,
        unit=known.unit,
        lowest=known.fitted[0],
        highest=known.fitted[1],
        width=known.width,
        starts=known.starts,
        even=known.evenly is not None,
        advice=known.advice,
    )
    for known in CONTACT_PARAMETERS
)
"""The parameters of `Contact.paper`, by its keywords."""

PARAMETERS = {parameter.name: parameter for parameter in (*LAW, *DELAY, *NUISANCES, *CONTACT)}
"""All of them by name."""

_OF = " of "


def name_of_table(name: str, table: str) -> str:
    """Return what a nuisance that a table has to itself is called where several tables are fitted together."""
    return f"{name}{_OF}{table}"


def parameter_called(name: str) -> Parameter:
    """Return the parameter of a name, that of a nuisance of one table too."""
    return PARAMETERS[name.partition(_OF)[0]]


def is_of_one_table(name: str) -> bool:
    """Say whether a name is that of a nuisance that one of several tables has to itself."""
    return _OF in name


def is_nuisance(name: str) -> bool:
    """Say whether a name is that of a nuisance, of one table or of all."""
    return name.partition(_OF)[0] in NUISANCE_NAMES


USUAL_ERRORS = {
    "free_frequency_khz": 2e-4,
    "quality_factor": 0.05,
    "spring_constant_n_per_m": 0.05,
    "tip_calibration": 0.01,
}
"""Relative standard errors of what is given of an instrument without one."""
USUAL_DRIFTS = {"phase_drift_deg": 3.0, "free_amplitude_drift": 0.03}
"""Standard errors of the drifts over a table whose rows stand in order of time, where nothing says them."""


@dataclass(frozen=True, kw_only=True)
class LawFormula:
    """A law that can be fitted, of the loss or of the delay.

    Attributes:
        paper: its parameters, with their values for the paper's contact: what is believed where nothing was measured.
        formula: of rebound speed or delay.
        meaning: what it says, in a line.
    """

    paper: dict[str, float]
    formula: str
    meaning: str


LAWS = {
    "restitution": LawFormula(
        paper={"r": 0.998}, formula="u_out = r u_in", meaning="a restitution without adhesion (r)"
    ),
    "law": LawFormula(
        paper={"r": 0.998, "epsilon": 122.0},
        formula="u_out^2 = r^2 u_in^2 - epsilon",
        meaning="a restitution with adhesion (r, epsilon)",
    ),
    "viscous": LawFormula(
        paper={"epsilon": 113.6, "viscous_loss": 0.5},
        formula="u_out^2 = u_in^2 - viscous_loss u_in - epsilon",
        meaning="a loss linear in speed with adhesion (epsilon, viscous_loss)",
    ),
    "full": LawFormula(
        paper={"r": 0.9999, "epsilon": 114.0, "viscous_loss": 0.48},
        formula="u_out^2 = r^2 u_in^2 - viscous_loss u_in - epsilon",
        meaning="a restitution, a loss linear in speed and adhesion (r, epsilon, viscous_loss)",
    ),
}
DELAY_LAW = LawFormula(
    paper={"delay_hertz": 0.206, "delay_lead_nm": 5.64, "delay_offset_nm": 0.726},
    formula="tau = delay_hertz u_in^(-1/5) - delay_lead_nm (1/u_out - 1/u_in) - delay_offset_nm/u_in",
    meaning="the collision delay, which amplitudes near resonance need",
)
DELAY_NAMES = tuple(DELAY_LAW.paper)
LAW_NAMES = tuple(parameter.name for parameter in (*LAW, *DELAY))
LOSS_SHAPE, DELAY_SHAPE = "loss_speed_squared_nm2_per_us2", "delay_square_nm2_per_us"
"""What decides the shape of loss and delay in the model discrepancy, each with a prior; no law is printed with them:
the square of the speed by which a bridge's pull raises that of the drag; the second term of the lead of a slow way out.
"""
NUISANCE_NAMES = tuple(parameter.name for parameter in NUISANCES)
CONTACT_NAMES = tuple(parameter.name for parameter in CONTACT)
CONTACT_DEFAULT = ("relative_humidity", "adhesion_energy_j_per_m2", "viscosity_pa_s", "modulus_gpa")
"""What the model "contact" fits if nothing else is asked for."""
MODELS = {
    **{name: tuple(law.paper) for name, law in LAWS.items()},
    **{f"{name}+delay": (*law.paper, *DELAY_NAMES) for name, law in LAWS.items()},
    "contact": (),
}
"""Parameters of each model; those of "contact" are chosen."""


def model_parameters(
    model: str, free: tuple[str, ...] | None = None, fixed: Mapping[str, float] | None = None
) -> tuple[str, ...]:
    """Return the names of the parameters that a model's fit has, nuisances apart.

    Args:
        model: a key of `MODELS`.
        free: those that are fitted; None: all of a law and its delay, of "contact" `CONTACT_DEFAULT`, that are not
            fixed.
        fixed: values at which others are held; those of a contact that are neither are the paper's.

    Raises:
        ValueError: if there is no such model or parameter, none is fitted, one is twice, one of a law is neither fitted
            nor fixed, or a value is impossible.
    """
    if model not in MODELS:
        raise ValueError(f"`model` must be one of {', '.join(MODELS)}, but is {model!r}")
    names, held = CONTACT_NAMES if model == "contact" else MODELS[model], fixed or {}
    usual = CONTACT_DEFAULT if model == "contact" else names
    chosen = tuple(name for name in usual if name not in held) if free is None else free
    for option, given in (("fixed", held), ("free", chosen)):
        for name in given:
            if name not in names:
                raise ValueError(
                    f"`{option}` must name parameters of the model {model!r} ({', '.join(names)}), but one is {name!r}"
                )
    for name, value in held.items():
        parameter = PARAMETERS[name]
        if name in chosen:
            raise ValueError(f"{name} is both fitted (`free=...`) and held (`fixed=...`); remove it from one")
        if not math.isfinite(value) or not parameter.lowest <= value <= parameter.highest:
            between = f"between {parameter.lowest:g} and {parameter.highest:g} {parameter.unit}".rstrip()
            raise ValueError(f"`fixed`: {name} must lie {between}, but is {value!r}")
    if len(set(chosen)) < len(chosen) or not chosen:
        raise ValueError("`free` must name at least one parameter that is not fixed, and none twice")
    # of a contact what is neither fitted nor held is the paper's
    loose = [name for name in MODELS[model] if name not in (*chosen, *held)]
    if loose:
        raise ValueError(f"{' and '.join(loose)} must be fitted (`free=...`) or held at a value (`fixed=...`)")
    return chosen if model == "contact" else tuple(sorted(chosen, key=names.index))


def paper_values(model: str, mass_ng: float = 1.0) -> dict[str, float]:
    """Return the values of a model's parameters for the paper's contact.

    Args:
        model: a key of `MODELS`.
        mass_ng: of the tip; the paper's is 1. Losses of squared speed are an energy over the mass.
    """
    if model == "contact":
        return PAPER
    values = LAWS[model.removesuffix("+delay")].paper
    values = values | DELAY_LAW.paper if model.endswith("+delay") else values
    power = {"epsilon": -1.0, "viscous_loss": -1.0}
    return {name: value * mass_ng ** power.get(name, PARAMETERS[name].mass_power) for name, value in values.items()}
