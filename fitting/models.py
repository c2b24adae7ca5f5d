"""What can be fitted: models as lists of parameters, and what a set of values stands for.

Fit parameters: their units, where they may lie, and the coordinates the optimiser works in.

The optimiser's coordinate of a loss (1 - r, epsilon, viscous loss) is its square root: the bound 0 becomes an interior,
smooth minimum of the coordinate, so that a fit that ends at the bound converges like any other and is recognised there.

What a prediction is compared with: a table's rows as arrays, the cantilever, and the Gaussian constraints.

Values of contact parameters that a fit holds fixed, checked.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from afm_jax.apparatus.cantilever import Cantilever
from afm_jax.contact.parameters import CONTACT_PARAMETERS, EFFECTS
from afm_jax.impact.law import CollisionDelay, ImpactLaw
from fitting.tables.table import AmplitudeTable

Numbers = Float[np.ndarray, "..."] | float
"""Arrays, and the NumPy scalars that come of taking one element of them."""


@dataclass(frozen=True)
class Parameter:
    """A fit parameter: its unit and what it means in words, and where it may lie.

    With a ``sign`` the coordinate y is that of value = reference + sign y^2 (a loss); with a ``width`` that of
    value = reference + width y (any sign); else the coordinate is the logarithm of the value. The ``advice`` says
    what to measure so that the amplitudes determine it.
    """

    name: str
    unit: str
    meaning: str
    lowest: float
    highest: float
    reference: float = 0.0
    sign: int = 0
    width: float = 0.0
    advice: str = ""

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


_SLOW = "measure slow impacts too: small drives, close to where the orbit is lost"

LAW = (
    Parameter(
        "r",
        "",
        "coefficient of restitution",
        lowest=0.01,
        highest=1.0,
        reference=1.0,
        sign=-1,
        advice="measure fast impacts too: large drives on resonance, and give the quality factor with its error",
    ),
    Parameter("epsilon", "nm^2/us^2", "adhesion, 2 delta/m", lowest=0.0, highest=1e12, sign=1, advice=_SLOW),
    Parameter(
        "viscous_loss",
        "nm/us",
        "loss linear in speed",
        lowest=0.0,
        highest=1e6,
        sign=1,
        advice="measure over a wider range of drives at the same frequency",
    ),
)
"""What an impact law is made of."""

DELAY = (
    Parameter(
        "delay_hertz",
        "us (nm/us)^0.2",
        "Hertz contact time at 1 nm/us",
        lowest=0.0,
        highest=1e3,
        sign=1,
        advice="measure at several orders, detuned to both sides of each resonance",
    ),
    Parameter("delay_lead_nm", "nm", "lead of a slow way out", lowest=-300.0, highest=300.0, width=5.0, advice=_SLOW),
    Parameter(
        "delay_offset_nm",
        "nm",
        "offset of the contact surface, twice",
        lowest=-100.0,
        highest=100.0,
        width=1.0,
        advice="measure at several offsets and drives",
    ),
)
"""What a collision delay is made of."""

NUISANCES = (
    Parameter("quality_factor", "", "free resonance", lowest=0.51, highest=1e9),
    Parameter("offset_origin_nm", "nm", "what the table's offsets lack", lowest=-1e3, highest=1e3, width=1.0),
    Parameter("tip_calibration", "", "measured over true amplitude of the tip", lowest=0.1, highest=10.0),
    Parameter("drive_calibration", "", "true over stated amplitude of the platform", lowest=0.1, highest=10.0),
)
"""What the instrument adds; each has a Gaussian constraint."""

CONTACT = tuple(
    Parameter(
        known.name,
        known.unit,
        known.meaning,
        *known.fitted,
        width=known.width,
        advice=known.advice,
    )
    for known in CONTACT_PARAMETERS
)
"""The parameters of `Contact.paper`, by its keywords."""

PARAMETERS = {parameter.name: parameter for parameter in (*LAW, *DELAY, *NUISANCES, *CONTACT)}


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


ROWS_PER_PROGRAM = 32
"""Rows are padded to multiples of this, so that programs by rows (gradients, a scout's fit) have few shapes."""


class Rows(NamedTuple):
    """A table as arrays of shape (rows,), and measured values and errors of shape (rows, 2): peak, lock-in.

    What was not measured, and every padded row, has ``measured`` False; its value and error are 1. ``no_orbit``: the
    drive was tried and no steady orbit seen.
    """

    order: Float[Array, " rows"]
    drive_frequency_khz: Float[Array, " rows"]
    drive_amplitude_nm: Float[Array, " rows"]
    offset_nm: Float[Array, " rows"]
    amplitude_nm: Float[Array, "rows 2"]
    error_nm: Float[Array, "rows 2"]
    measured: Bool[Array, "rows 2"]
    no_orbit: Bool[Array, " rows"]


class Measurement(NamedTuple):
    """Everything a prediction is compared with.

    Attributes:
        rows: the table, padded.
        cantilever: as the table gives it.
        constraint_value: what is known of each parameter beforehand, shape (p,).
        constraint_error: its standard error, infinite where nothing is known.
        contact: for the model "contact" its parameters that are not fitted, by keyword of `Contact.paper`.
    """

    rows: Rows
    cantilever: Cantilever
    constraint_value: Float[Array, " p"]
    constraint_error: Float[Array, " p"]
    contact: dict[str, Float[Array, ""]]


def constraints_of(
    table: AmplitudeTable, constraints: dict[str, tuple[float, float]] | None
) -> dict[str, tuple[float, float]]:
    """Return everything that is known beforehand: what the table says, and what the caller adds or says instead."""
    known = dict(table.calibration)
    if table.quality_factor is not None and table.quality_factor_error is not None:
        known["quality_factor"] = table.quality_factor, table.quality_factor_error
    return known | dict(constraints or {})


def measurement_of(
    table: AmplitudeTable,
    problem: Problem,
    constraints: dict[str, tuple[float, float]] | None = None,
    fixed: dict[str, float] | None = None,
) -> Measurement:
    """Return a table as padded arrays (float64).

    Args:
        table: the amplitudes.
        problem: the model; its parameters' order is that of the constraints.
        constraints: value and standard error of what is known beforehand, by parameter; else the table says.
        fixed: contact parameters that are not the paper's.
    """
    known = constraints_of(table, constraints)
    pairs = [
        known.get(name, (parameter.reference, np.inf))
        for name, parameter in zip(problem.names, problem.parameters, strict=True)
    ]
    contact = {name: jnp.asarray(float(value)) for name, value in (fixed or {}).items() if name in CONTACT_NAMES}
    return Measurement(
        rows=rows_of(table),
        cantilever=Cantilever(table.free_frequency_khz, table.quality_factor, table.mass_ng),
        constraint_value=jnp.asarray([float(value) for value, _ in pairs]),
        constraint_error=jnp.asarray([float(error) for _, error in pairs]),
        contact=contact,
    )


def rows_of(table: AmplitudeTable) -> Rows:
    """Return the rows of a table, padded to a multiple of `ROWS_PER_PROGRAM`."""
    size = -(-table.rows // ROWS_PER_PROGRAM) * ROWS_PER_PROGRAM

    def padded(column, filler=None):
        column = np.asarray(column, float)
        filler = column[-1] if filler is None else filler
        return np.concatenate([column, np.full(size - column.shape[0], filler)])

    def pair(peak, lockin):
        columns = [np.full(table.rows, np.nan) if c is None else c for c in (peak, lockin)]
        return np.stack([padded(column, np.nan) for column in columns], axis=1)

    # NumPy up to here: every JAX operation outside a compiled program would be compiled by itself.
    amplitude = pair(table.peak_amplitude_nm, table.lockin_amplitude_nm)
    error = pair(table.peak_amplitude_error_nm, table.lockin_amplitude_error_nm)
    measured = np.isfinite(amplitude)
    unseen = np.zeros(table.rows) if table.no_orbit is None else np.nan_to_num(table.no_orbit)
    return Rows(
        order=jnp.asarray(padded(table.order)),
        drive_frequency_khz=jnp.asarray(padded(table.drive_frequency_khz)),
        drive_amplitude_nm=jnp.asarray(padded(table.drive_amplitude_nm)),
        offset_nm=jnp.asarray(padded(table.offset_nm)),
        amplitude_nm=jnp.asarray(np.where(measured, amplitude, 1.0)),
        error_nm=jnp.asarray(np.where(measured, error, 1.0)),
        measured=jnp.asarray(measured),
        no_orbit=jnp.asarray(padded(unseen, 0.0) > 0.0),
    )


def check_contact_values(model: str, fixed: dict[str, float] | None) -> None:
    """Check the values of contact parameters that are held fixed.

    Raises:
        ValueError: if the model has none, or a name or value is impossible.
    """
    if not fixed:
        return
    if model != "contact":
        raise ValueError(f"`fixed` gives values of contact parameters; the model {model!r} has none")
    for name, value in fixed.items():
        if name not in CONTACT_NAMES:
            raise ValueError(
                f"`fixed` must name parameters of the contact ({', '.join(CONTACT_NAMES)}), but one is {name!r}"
            )
        parameter = PARAMETERS[name]
        if not math.isfinite(value) or not parameter.lowest <= value <= parameter.highest:
            between = f"between {parameter.lowest:g} and {parameter.highest:g} {parameter.unit}".rstrip()
            raise ValueError(f"`fixed`: {name} must lie {between}, but is {value!r}")
