"""Taps of a tip on a bent lever against the driven contact of the tests' own integrator."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from afm_jax.apparatus.cantilever import Cantilever
from afm_jax.apparatus.platform import Platform
from afm_jax.contact.bent_lever import tapped
from afm_jax.contact.contact import Contact
from afm_jax.impact.closure import OrbitProblem
from afm_jax.impact.orbits import orbit_state, steady_orbits
from tests.reference_contact_forces import ContactParameters
from tests.reference_driven_contact import DrivenContact, follow

LEVER = Cantilever(90.0, 200.0, 16.81)
OMEGA = 2e-3 * np.pi * 90.0
MIXED: dict[str, Any] = {
    "tip_radius_nm": 50.0,
    "relative_humidity": 0.42,
    "adhesion_energy_j_per_m2": 0.22,
    "modulus_gpa": 70.0,
}


def system(numbers: dict[str, Any], **more: Any) -> DrivenContact:
    return DrivenContact(
        **{"drive_frequency_khz": 90.0, "mass_ng": 16.81, "contact": ContactParameters(**numbers)} | more
    )


@pytest.mark.slow
def test_taps_are_collisions_of_the_undriven_lever():
    impact = tapped(Contact.paper(**MIXED), LEVER, jnp.array([2.0, 26.0]))
    seen = set()
    for pull, approach in ((12.0, 7.0), (12.0, 10.5), (12.0, 11.5), (3.7, 9.0), (21.0, 17.0), (21.0, 40.0)):
        tap = jax.jit(type(impact).tap)(impact, jnp.array(approach), jnp.array(pull))
        # at the plane the lever is bent by pull/Omega^2
        plane = -pull / OMEGA**2
        lever = system(MIXED, amplitude_nm=0.0, offset_nm=plane - 4.7, quality_factor=None)
        contact = follow(lever, 0.0, plane, -approach, contacts=1).contacts[0]
        seen.add(contact.junctions)
        assert float(tap.speeds.rebound) == pytest.approx(contact.rebound_speed_nm_per_us, rel=1e-8)
        assert float(tap.speeds.delay) == pytest.approx(contact.departure_time_us, abs=2e-4)
    assert seen == {0, 1}


@pytest.mark.slow
@pytest.mark.parametrize(("ratio", "share"), [(1.0, 0.6), (1.0, 0.9), (1.03, 0.5)])
def test_orbits_of_taps_repeat_in_the_driven_contact(ratio: float, share: float):
    """In the free tip's frame the sample moves by the free amplitude; from an orbit the tip comes back to it."""
    impact = tapped(Contact.paper(**MIXED), LEVER, jnp.array([4.0, 30.0]))
    offset, free = -share * 80.0, 80.0
    problem = OrbitProblem(LEVER, Platform(free, 90.0 * ratio, offset + impact.plane_nm), impact, jnp.ones(()))
    orbits = steady_orbits(problem)
    assert np.any(orbits.steady)
    moved = system(MIXED, amplitude_nm=free, drive_frequency_khz=90.0 * ratio, offset_nm=offset, quality_factor=200.0)
    for slot in np.flatnonzero(orbits.steady):
        flight = orbit_state(jax.tree.map(lambda part, slot=slot: part[slot], orbits.place), problem).flight
        start, period = float(flight.start_us), 1e3 / (90.0 * ratio)
        position, velocity = float(flight.start_position), float(flight.start_velocity)
        course = follow(moved, start, position, velocity, until_us=start + period)
        assert course.position_nm == pytest.approx(position, abs=0.02)
        assert course.velocity_nm_per_us == pytest.approx(velocity, abs=0.02)
