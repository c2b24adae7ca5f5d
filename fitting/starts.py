"""Where a fit starts: a coarse grid over what a model's parameters can be."""

import inspect

import numpy as np
from jaxtyping import Float

from afm_jax.contact.contact import Contact
from afm_jax.units import RAD_PER_US_PER_KHZ
from fitting.measurement import Measurement
from fitting.models import CONTACT_NAMES, NUISANCE_NAMES, Problem

_GRID_PER_PARAMETER = {1: 96, 2: 16}
_SPREAD_POINTS = 64
"""Points of a low-discrepancy sequence, where a grid would have too many."""
_CONTACT_FACTOR = 3.0
"""Contact parameters are tried within this factor of the paper's value."""


def starts(problem: Problem, measurement: Measurement) -> Float[np.ndarray, "points p"]:
    """Return the values to start from, logarithmic in every loss; nuisances stay where they were measured.

    Adhesion and viscous loss are laid out in terms of the drive's speed beta omega, on which capture depends.
    """
    own = [name for name in problem.names if name not in NUISANCE_NAMES]
    ranges = _ranges(measurement)
    if len(own) in _GRID_PER_PARAMETER and not problem.lasting:
        count = _GRID_PER_PARAMETER[len(own)]
        mesh = np.meshgrid(*(ranges[name](np.linspace(0.0, 1.0, count)) for name in own), indexing="ij")
        columns = {name: axis.ravel() for name, axis in zip(own, mesh, strict=True)}
    else:
        places = _spread(_SPREAD_POINTS, len(own))
        columns = {name: ranges[name](place) for name, place in zip(own, places.T, strict=True)}
    count = len(columns[own[0]])
    known = dict(zip(problem.names, np.asarray(measurement.constraint_value).tolist(), strict=True))
    return np.stack([columns.get(name, np.full(count, known[name])) for name in problem.names], axis=1)


def _spread(count: int, dimensions: int) -> Float[np.ndarray, "count dimensions"]:
    """Return the additive recurrence of Kronecker whose steps are powers of the generalised golden ratio (Roberts)."""
    ratio = 2.0
    for _ in range(60):
        # x^(d+1) = x + 1
        ratio = (1.0 + ratio) ** (1.0 / (dimensions + 1))
    steps = ratio ** -np.arange(1.0, dimensions + 1.0)
    return np.mod(0.5 + np.outer(np.arange(1, count + 1), steps), 1.0)


def _ranges(measurement: Measurement):
    """Return by name what a place between 0 and 1 stands for."""
    rows = measurement.rows
    drive = RAD_PER_US_PER_KHZ * np.asarray(rows.drive_amplitude_nm) * np.asarray(rows.drive_frequency_khz)
    slow, fast = float(drive.min()), float(drive.max())
    mass = float(np.asarray(measurement.cantilever.mass_ng))

    def between(low, high):
        return lambda place: low * (high / low) ** np.asarray(place)

    # the Hertz time grows with mass^0.4; a factor of 5 around the paper's tip
    hertz = 0.2 * mass**0.4
    losses = {
        "r": lambda place: 1.0 - between(0.7, 1e-4)(place),
        "epsilon": between(1e-4 * slow**2, 30.0 * fast**2),
        "viscous_loss": between(1e-4 * slow, 10.0 * fast),
        "delay_hertz": between(hertz / 5.0, hertz * 5.0),
        "delay_lead_nm": lambda place: 10.0 * np.asarray(place),
        "delay_offset_nm": lambda place: 2.0 * np.asarray(place) - 0.5,
    }
    return losses | {name: _around(name) for name in CONTACT_NAMES}


def _around(name: str):
    usual = _usual(name)
    if name == "relative_humidity":
        return lambda place: 0.1 + 0.8 * np.asarray(place)
    if usual <= 0.0 or name == "structural_offset_nm":
        return lambda place: usual + 0.4 * (np.asarray(place) - 0.5)
    factor = (
        1.3 if name in {"temperature_k", "surface_tension_n_per_m", "molar_volume_cm3_per_mol"} else _CONTACT_FACTOR
    )
    return lambda place: usual * factor ** (2.0 * np.asarray(place) - 1.0)


def _usual(name: str) -> float:
    """Return the paper's value of a contact parameter."""
    return float(inspect.signature(Contact.paper).parameters[name].default)
