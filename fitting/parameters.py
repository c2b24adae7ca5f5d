"""Fit parameters: their units, where they may lie, and the coordinates the optimiser works in.

The optimiser's coordinate of a loss (1 - r, epsilon, viscous loss) is its square root: the bound 0 becomes an interior,
smooth minimum of the coordinate, so that a fit that ends at the bound converges like any other and is recognised there.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

Numbers = Float[np.ndarray, "..."] | float
"""Arrays, and the NumPy scalars that come of taking one element of them."""


@dataclass(frozen=True)
class Parameter:
    """A fit parameter: its unit and what it means in words, and where it may lie.

    With a ``sign`` the coordinate y is that of value = reference + sign y^2 (a loss); with a ``width`` that of
    value = reference + width y (any sign); else the coordinate is the logarithm of the value.
    """

    name: str
    unit: str
    meaning: str
    lowest: float
    highest: float
    reference: float = 0.0
    sign: int = 0
    width: float = 0.0

    @property
    def bound(self) -> float | None:
        """The value at which the loss vanishes; None for a parameter without such an end."""
        return self.reference if self.sign else None

    def to_coordinate(self, value: Numbers) -> Numbers:
        """Return the optimiser's coordinate of a value."""
        if self.sign:
            return np.sqrt(np.maximum(self.sign * (value - self.reference), 0.0))
        if self.width:
            return (value - self.reference) / self.width
        return np.log(value)

    def from_coordinate(self, coordinate: Numbers) -> Numbers:
        """Return the value at a coordinate, kept in the allowed range."""
        return np.clip(self._unbounded(coordinate), self.lowest, self.highest)

    def slope(self, coordinate: Numbers) -> Numbers:
        """Return d value/d coordinate; 0 where the value is held at the end of its range."""
        value = self._unbounded(coordinate)
        inside = (value >= self.lowest) & (value <= self.highest)
        slope = 2.0 * self.sign * coordinate if self.sign else self.width or value
        return np.where(inside, slope, 0.0)

    def _unbounded(self, coordinate: Numbers) -> Numbers:
        if self.sign:
            return self.reference + self.sign * coordinate**2
        if self.width:
            return self.reference + self.width * coordinate
        return np.exp(coordinate)


LAW = (
    Parameter("r", "", "coefficient of restitution", lowest=0.01, highest=1.0, reference=1.0, sign=-1),
    Parameter("epsilon", "nm^2/us^2", "adhesion, 2 delta/m", lowest=0.0, highest=1e12, sign=1),
    Parameter("viscous_loss", "nm/us", "loss linear in speed", lowest=0.0, highest=1e6, sign=1),
)
"""What an impact law is made of."""

DELAY = (
    Parameter("delay_hertz", "us (nm/us)^0.2", "Hertz contact time at 1 nm/us", lowest=0.0, highest=1e3, sign=1),
    Parameter("delay_lead_nm", "nm", "lead of a slow way out", lowest=-300.0, highest=300.0, width=5.0),
    Parameter("delay_offset_nm", "nm", "offset of the contact surface, twice", lowest=-100.0, highest=100.0, width=1.0),
)
"""What a collision delay is made of."""

NUISANCES = (
    Parameter("quality_factor", "", "free resonance", lowest=0.51, highest=1e9),
    Parameter("offset_origin_nm", "nm", "what the table's offsets lack", lowest=-1e3, highest=1e3, width=1.0),
    Parameter("tip_calibration", "", "measured over true amplitude of the tip", lowest=0.1, highest=10.0),
    Parameter("drive_calibration", "", "true over stated amplitude of the platform", lowest=0.1, highest=10.0),
)
"""What the instrument adds; each has a Gaussian constraint."""

CONTACT = (
    Parameter("relative_humidity", "", "p/p_s", lowest=0.02, highest=0.99),
    Parameter("adhesion_energy_j_per_m2", "J/m^2", "JKR adhesion w", lowest=0.02, highest=5.0),
    Parameter("viscosity_pa_s", "Pa s", "of the liquid", lowest=1e-6, highest=1.0),
    Parameter("modulus_gpa", "GPa", "reduced modulus K", lowest=1.0, highest=2e3),
    Parameter("bridge_forms_nm", "nm", "gap at which the bridge forms", lowest=0.5, highest=50.0),
    Parameter("bridge_breaks_nm", "nm", "gap at which the bridge breaks", lowest=0.5, highest=50.0),
    Parameter("tip_radius_nm", "nm", "R", lowest=1.0, highest=1e4),
    Parameter("surface_tension_n_per_m", "N/m", "of the liquid", lowest=1e-3, highest=1.0),
    Parameter("molar_volume_cm3_per_mol", "cm^3/mol", "of the liquid", lowest=1.0, highest=1e3),
    Parameter("temperature_k", "K", "temperature", lowest=100.0, highest=1e3),
    Parameter("structural_amplitude_n_per_m", "N/m", "A_0 of the structural force", lowest=1e-3, highest=1e4),
    Parameter("structural_decay_nm", "nm", "tau of the structural force", lowest=0.05, highest=10.0),
    Parameter("structural_offset_nm", "nm", "delta of the structural force", lowest=-5.0, highest=5.0, width=0.2),
    Parameter("core_constant_j_m6", "J m^6", "B of the core repulsion", lowest=1e-82, highest=1e-74),
)
"""The parameters of `Contact.paper`, by its keywords."""

PARAMETERS = {parameter.name: parameter for parameter in (*LAW, *DELAY, *NUISANCES, *CONTACT)}
