"""What can be fitted: models as lists of parameters, and what a set of values stands for."""

from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from afm_jax.apparatus.cantilever import Cantilever
from afm_jax.contact.contact import EFFECTS
from afm_jax.impact.law import CollisionDelay, ImpactLaw
from fitting.parameters import CONTACT, DELAY, NUISANCES, PARAMETERS, Parameter

LAWS = {
    "restitution": ("r",),
    "law": ("r", "epsilon"),
    "viscous": ("epsilon", "viscous_loss"),
}
DELAY_NAMES = tuple(parameter.name for parameter in DELAY)
NUISANCE_NAMES = tuple(parameter.name for parameter in NUISANCES)
CONTACT_NAMES = tuple(parameter.name for parameter in CONTACT)
CONTACT_DEFAULT = ("relative_humidity", "adhesion_energy_j_per_m2", "viscosity_pa_s", "modulus_gpa")
"""What the model "contact" fits if nothing else is asked for."""
MODELS = {**LAWS, **{f"{name}+delay": (*names, *DELAY_NAMES) for name, names in LAWS.items()}, "contact": ()}
"""Parameters of each model; those of "contact" are chosen."""


def model_parameters(model: str, free: tuple[str, ...] | None = None) -> tuple[str, ...]:
    """Return the names of a model's own parameters, nuisances apart.

    Args:
        model: a key of `MODELS`.
        free: for "contact": which of its parameters are fitted; None for `CONTACT_DEFAULT`.

    Raises:
        ValueError: if there is no such model or parameter, or a law's parameters are to be chosen.
    """
    if model not in MODELS:
        raise ValueError(f"`model` must be one of {', '.join(MODELS)}, but is {model!r}")
    if model != "contact":
        if free is not None:
            raise ValueError(f"`free` chooses among the contact's parameters; the model {model!r} has none to choose")
        return MODELS[model]
    chosen = CONTACT_DEFAULT if free is None else free
    for name in chosen:
        if name not in CONTACT_NAMES:
            raise ValueError(f"`free` must be chosen from {', '.join(CONTACT_NAMES)}, but one is {name!r}")
    if len(set(chosen)) < len(chosen) or not chosen:
        raise ValueError("`free` must name at least one parameter, and none twice")
    return chosen


@dataclass(frozen=True)
class Problem:
    """What is fitted: the model's parameters, then nuisances; and which effects a contact has."""

    model: str
    names: tuple[str, ...]
    effects: tuple[str, ...] = EFFECTS

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """The parameters in the order of every vector."""
        return tuple(PARAMETERS[name] for name in self.names)

    @property
    def lasting(self) -> bool:
        """Whether impacts take time: a delay, or the contact itself."""
        return self.model.endswith("+delay") or self.model == "contact"

    @property
    def own(self) -> tuple[str, ...]:
        """The names of the model's parameters, without nuisances."""
        return tuple(name for name in self.names if name not in NUISANCE_NAMES)

    def values(self, coordinates: Float[np.ndarray, "... p"]) -> Float[np.ndarray, "... p"]:
        """Return the parameters' values at optimiser coordinates."""
        columns = zip(self.parameters, np.moveaxis(coordinates, -1, 0), strict=True)
        return np.stack([p.from_coordinate(y) for p, y in columns], axis=-1)

    def values_and_slopes(
        self, coordinates: Float[np.ndarray, "... p"]
    ) -> tuple[Float[np.ndarray, "... p"], Float[np.ndarray, "... p"]]:
        """Return the values and their derivatives by the coordinates."""
        columns = zip(self.parameters, np.moveaxis(coordinates, -1, 0), strict=True)
        return self.values(coordinates), np.stack([p.slope(y) for p, y in columns], axis=-1)

    def coordinates(self, values: Float[np.ndarray, "... p"]) -> Float[np.ndarray, "... p"]:
        """Return optimiser coordinates of parameter values."""
        columns = zip(self.parameters, np.moveaxis(values, -1, 0), strict=True)
        return np.stack([p.to_coordinate(value) for p, value in columns], axis=-1)

    def known(self, values: Float[Array, " p"]) -> dict[str, Float[Array, ""]]:
        """Return the parameters by name."""
        return dict(zip(self.names, values, strict=True))

    def law(self, values: Float[Array, " p"]) -> ImpactLaw:
        """Return the impact law, with its delay; what the model leaves out is lossless."""
        known = self.known(values)
        delay = None
        if self.lasting:
            hertz, lead_nm, offset_nm = (known[name] for name in DELAY_NAMES)
            delay = CollisionDelay(hertz, lead_nm, offset_nm)
        return ImpactLaw(
            r=known.get("r", 1.0),
            epsilon=known.get("epsilon", 0.0),
            viscous_loss=known.get("viscous_loss", 0.0),
            delay=delay,
        )

    def cantilever(self, values: Float[Array, " p"], measured: Cantilever) -> Cantilever:
        """Return the cantilever, with its fitted quality factor where that is a nuisance."""
        known = self.known(values)
        if "quality_factor" not in known:
            return measured
        return Cantilever(measured.frequency_khz, known["quality_factor"], measured.mass_ng)

    def nuisance(self, values: Float[Array, " p"], name: str, neutral: float) -> Float[Array, ""]:
        """Return a nuisance, or its neutral value where it is not a parameter."""
        return self.known(values).get(name, jnp.asarray(neutral))
