"""Readings of instantaneous impacts: every orbit of a row is a root of a quartic.

`searched` looks for the roots and takes the steady one that was measured; `read_at` gives the readings there,
differentiable by law and instrument (implicit function theorem).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from afm_jax.impact.closure import OrbitPlace, OrbitProblem
from afm_jax.impact.law import ImpactLaw
from afm_jax.impact.orbits import orbit_state, readings_of, steady_orbits
from fitting.predict.orbit import Local, Row, platform_and_cantilever, shown


class Seen(NamedTuple):
    """The readings of a row, and the orbit they belong to.

    Attributes:
        readings: peak and lock-in amplitude in nm and phase in degrees; without an orbit no amplitude, and the phase
            that is farthest off.
        orbits: how many steady ones there are; of a free tip one.
        near_fold: the one that was taken is close to a fold.
        approach: its approach speed in nm/us; NaN without one.
        coordinate: of its impact in the law.
        phase: of the drive at the impact, in rad.
    """

    readings: Float[Array, " 3"]
    orbits: Int[Array, ""]
    near_fold: Bool[Array, ""]
    approach: Float[Array, ""]
    coordinate: Float[Array, ""]
    phase: Float[Array, ""]


def searched(
    law: ImpactLaw, local: Local, row: Row, read: Float[Array, " 3"], error: Float[Array, " 3"], drive: str
) -> Seen:
    """Return what is read of one row: of the steady orbit that explains it best; no derivatives.

    Args:
        law: instantaneous.
        local: the instrument; what it says of the law is not looked at.
        row: what was set.
        read: what was measured, NaN where nothing was.
        error: its standard errors.
        drive: what is driven.
    """
    cantilever, platform = platform_and_cantilever(local, row, drive)
    problem = OrbitProblem(cantilever, platform, law, row.order)
    roots = steady_orbits(problem)
    of_slots = jax.vmap(lambda seen: shown(seen, local, row, platform, drive))(roots.amplitude_nm)
    size = jnp.sum(jnp.where(jnp.isfinite(read), (of_slots - read) / error, 0.0) ** 2, axis=1)
    slot = jnp.argmin(jnp.where(roots.steady, size, jnp.inf))
    impact = roots.steady[slot] & ~row.free
    nothing = jnp.stack([0.0, 0.0, row.phase_deg + 180.0 / row.order])
    coordinate = roots.place.coordinate[slot]
    return Seen(
        readings=jnp.where(impact | row.free, of_slots[slot], nothing),
        orbits=jnp.where(row.free, 1, jnp.sum(roots.steady)),
        near_fold=impact & roots.near_double[slot],
        approach=jnp.where(impact, law.speeds(coordinate).approach, jnp.nan),
        coordinate=coordinate,
        phase=orbit_state(OrbitPlace(coordinate, jnp.zeros(())), problem).phase,
    )


def read_at(coordinate: Float[Array, ""], law: ImpactLaw, local: Local, row: Row, drive: str) -> Float[Array, " 3"]:
    """Return the readings of the orbit whose impact has a coordinate; the other arguments as of `searched`."""
    cantilever, platform = platform_and_cantilever(local, row, drive)
    problem = OrbitProblem(cantilever, platform, law, row.order)
    state = orbit_state(OrbitPlace(coordinate, jnp.zeros(())), problem)
    return shown(readings_of(state, problem), local, row, platform, drive)
