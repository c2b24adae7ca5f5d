"""What can be fitted: models as lists of parameters, and the coordinates the optimiser works in.

The optimiser's coordinate of a loss (1 - r, epsilon, viscous loss) is its square root: the bound 0 becomes an interior,
smooth minimum of the coordinate, so that a fit that ends at the bound converges like any other and is recognised there.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Array, Float

from afm_jax.apparatus.cantilever import Cantilever
from afm_jax.impact.law import ImpactLaw

Numbers = Float[np.ndarray, "..."] | float
"""Arrays, and the NumPy scalars that come of taking one element of them."""


@dataclass(frozen=True)
class Parameter:
    """A fit parameter: its unit and what it means in words, and where it may lie.

    ``reference`` and ``sign`` define the coordinate y by value = reference + sign y^2; a sign of 0 means that the
    coordinate is the logarithm of the value.
    """

    name: str
    unit: str
    meaning: str
    lowest: float
    highest: float
    reference: float = 0.0
    sign: int = 0

    @property
    def bound(self) -> float | None:
        """The value at which the loss vanishes; None for a parameter without such an end."""
        return self.reference if self.sign else None

    def to_coordinate(self, value: Numbers) -> Numbers:
        """Return the optimiser's coordinate of a value."""
        if self.sign:
            return np.sqrt(np.maximum(self.sign * (value - self.reference), 0.0))
        return np.log(value)

    def from_coordinate(self, coordinate: Numbers) -> Numbers:
        """Return the value at a coordinate, kept in the allowed range."""
        value = self.reference + self.sign * coordinate**2 if self.sign else np.exp(coordinate)
        return np.clip(value, self.lowest, self.highest)

    def slope(self, coordinate: Numbers) -> Numbers:
        """Return d value/d coordinate; 0 where the value is held at the end of its range."""
        value = self.reference + self.sign * coordinate**2 if self.sign else np.exp(coordinate)
        inside = (value >= self.lowest) & (value <= self.highest)
        return np.where(inside, 2.0 * self.sign * coordinate if self.sign else value, 0.0)


PARAMETERS = {
    "r": Parameter("r", "", "coefficient of restitution", lowest=0.01, highest=1.0, reference=1.0, sign=-1),
    "epsilon": Parameter("epsilon", "nm^2/us^2", "adhesion, 2 delta/m", lowest=0.0, highest=1e12, sign=1),
    "viscous_loss": Parameter("viscous_loss", "nm/us", "loss linear in speed", lowest=0.0, highest=1e6, sign=1),
    "quality_factor": Parameter("quality_factor", "", "free resonance, constrained", lowest=0.51, highest=1e9),
}

MODELS = {
    "restitution": ("r",),
    "law": ("r", "epsilon"),
    "viscous": ("epsilon", "viscous_loss"),
}


def law_parameters(model: str) -> tuple[str, ...]:
    """Return the names of a model's law parameters.

    Raises:
        ValueError: if there is no such model.
    """
    if model not in MODELS:
        raise ValueError(f"`model` must be one of {', '.join(MODELS)}, but is {model!r}")
    return MODELS[model]


@dataclass(frozen=True)
class Problem:
    """What is fitted: the law's parameters and, where the table gives Q with an uncertainty, Q as a nuisance."""

    model: str
    names: tuple[str, ...]

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """The parameters in the order of every vector."""
        return tuple(PARAMETERS[name] for name in self.names)

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

    def law(self, values: Float[Array, " p"]) -> ImpactLaw:
        """Return the impact law; what the model leaves out is lossless."""
        known = dict(zip(self.names, values, strict=True))
        return ImpactLaw(
            r=known.get("r", 1.0), epsilon=known.get("epsilon", 0.0), viscous_loss=known.get("viscous_loss", 0.0)
        )

    def cantilever(self, values: Float[Array, " p"], measured: Cantilever) -> Cantilever:
        """Return the cantilever, with its fitted quality factor where that is a nuisance."""
        if "quality_factor" not in self.names:
            return measured
        quality_factor = values[self.names.index("quality_factor")]
        return Cantilever(measured.frequency_khz, quality_factor, measured.mass_ng)
