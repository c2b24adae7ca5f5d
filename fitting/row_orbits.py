"""The orbit that a row of a table is taken to be on: its scene, and which of its steady motions was measured."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from afm_jax.apparatus.platform import Platform
from afm_jax.contact.contact import Contact
from afm_jax.contact.law_of_contact import tabulated
from afm_jax.impact.lasting_impact import LawImpact, TabulatedImpact
from afm_jax.impact.orbit_closure import OrbitProblem, Place
from afm_jax.impact.orbit_search import follow_root, harmless_coordinate
from afm_jax.impact.orbits import near_fold, steady_orbits
from fitting.measurement import Measurement, Rows
from fitting.models import Problem


class Branch(NamedTuple):
    """The orbit that a row is taken to be on: where, whether there is one, and how many there are."""

    place: Place
    exists: Bool[Array, ""]
    orbits: Int[Array, ""]
    near_fold: Bool[Array, ""]


def impact_of(values: Float[Array, " p"], measurement: Measurement, problem: Problem) -> LawImpact | TabulatedImpact:
    """Return what an impact does at a set of values: the model's law, or the table of its contact."""
    if problem.model != "contact":
        return LawImpact(problem.law(values))
    chosen = {name: value for name, value in problem.known(values).items() if name in problem.own}
    contact = Contact.paper(effects=problem.effects, **(measurement.contact | chosen))
    return tabulated(contact, measurement.cantilever.mass_ng)


def orbit_problem(
    values: Float[Array, " p"],
    impact: LawImpact | TabulatedImpact,
    row: Rows,
    measurement: Measurement,
    problem: Problem,
) -> OrbitProblem:
    """Return the orbit's scene of one row at a set of values, for the impact that these stand for."""
    cantilever = problem.cantilever(values, measurement.cantilever)
    platform = Platform(
        row.drive_amplitude_nm * problem.nuisance(values, "drive_calibration", 1.0),
        row.drive_frequency_khz,
        row.offset_nm + problem.nuisance(values, "offset_origin_nm", 0.0),
    )
    return OrbitProblem(cantilever, platform, impact, row.order)


def branch_of(orbit: OrbitProblem, row: Rows) -> Branch:
    """Choose among a row's steady orbits; no derivatives.

    There can be several: the one that explains the measured amplitudes best counts. A row without any is predicted as
    0, which misses the measurement by all of it: a fixed penalty.
    """
    roots = steady_orbits(orbit)
    misfit = jnp.where(row.measured, (roots.amplitude_nm - row.amplitude_nm) / row.error_nm, 0.0)
    slot = jnp.argmin(jnp.where(roots.steady, jnp.sum(misfit**2, axis=1), jnp.inf))
    return Branch(
        place=Place(roots.place.coordinate[slot], roots.place.phase[slot]),
        exists=roots.steady[slot],
        orbits=jnp.sum(roots.steady, dtype=jnp.int32),
        near_fold=roots.steady[slot] & roots.near_double[slot],
    )


def followed(orbit: OrbitProblem, known: Branch) -> Branch:
    """Follow a row's orbit from where it is known to be: exact where it was found, close at other parameters."""
    harmless = harmless_coordinate(orbit)
    root, found = follow_root(jnp.where(known.exists, known.place.coordinate, harmless), orbit)
    exists = known.exists & found
    return Branch(
        place=Place(jnp.where(exists, root.coordinate, harmless), root.phase),
        exists=exists,
        orbits=jnp.where(exists, known.orbits, 0),
        near_fold=exists & near_fold(root.coordinate, orbit),
    )


def branch_near(coordinate: Float[np.ndarray, " lanes"] | Float[Array, " lanes"]) -> Branch:
    """Return orbits that are taken to be near coordinates; NaN: there is none."""
    there = jnp.isfinite(coordinate)
    near = jnp.asarray(coordinate)
    return Branch(Place(near, jnp.zeros_like(near)), there, there.astype(jnp.int32), jnp.zeros_like(there))
