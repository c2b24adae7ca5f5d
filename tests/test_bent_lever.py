"""Taps of a tip on a bent lever against the tests' own integrator, and against full simulations."""

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from afm_jax.apparatus.cantilever import Cantilever
from afm_jax.apparatus.platform import Platform
from afm_jax.apparatus.surface import detected
from afm_jax.contact.bent_lever import tapped
from afm_jax.contact.contact import Contact
from afm_jax.impact.closure import TAPPED, OrbitProblem, Scan, find_roots
from afm_jax.impact.orbits import steady_orbits
from fitting import read_table
from tests.reference_contact_forces import ContactParameters
from tests.reference_driven_contact import DrivenContact, follow
from tests.tapping_truths import MASS_NG, tapping_truth

LEVER = Cantilever(90.0, 200.0, 16.81)
OMEGA = 2e-3 * np.pi * 90.0
MIXED: dict[str, Any] = {"tip_radius_nm": 50.0, "relative_humidity": 0.42, "modulus_gpa": 70.0}
MIXED |= {"adhesion_energy_j_per_m2": 0.22}
pytestmark = pytest.mark.slow


def test_taps_are_collisions_of_the_undriven_lever():
    impact = tapped(Contact.paper(**MIXED), LEVER, jnp.array([2.0, 26.0]))
    seen = set()
    for pull, approach in ((12.0, 7.0), (12.0, 10.5), (12.0, 11.5), (3.7, 9.0), (21.0, 17.0), (21.0, 40.0)):
        tap = jax.jit(type(impact).tap)(impact, jnp.array(approach), jnp.array(pull))
        # at the plane the lever is bent by pull/Omega^2
        plane = -pull / OMEGA**2
        lever = DrivenContact(
            amplitude_nm=0.0,
            drive_frequency_khz=90.0,
            offset_nm=plane - 4.7,
            quality_factor=None,
            mass_ng=16.81,
            contact=ContactParameters(**MIXED),
        )
        contact = follow(lever, 0.0, plane, -approach, contacts=1).contacts[0]
        seen.add(contact.junctions)
        assert float(tap.speeds.rebound) == pytest.approx(contact.rebound_speed_nm_per_us, rel=1e-7)
        assert float(tap.speeds.delay) == pytest.approx(contact.departure_time_us, abs=2e-4)
    assert seen == {0, 1}


def test_light_taps_have_the_slopes_of_their_table():
    """What the adhesion of a junction that never forms changes is the places of the series alone."""

    def time(adhesion):
        contact = Contact.paper(**MIXED | {"adhesion_energy_j_per_m2": adhesion})
        impact = tapped(contact, LEVER, jnp.array([0.5, 26.0]))
        return impact.tap(jnp.array(3.0), jnp.array(1.0)).speeds.delay

    at = jnp.array([0.2199, 0.22, 0.2201])
    times, slopes = jax.jit(jax.vmap(lambda x: jax.jvp(time, (x,), (jnp.ones(()),))))(at)
    assert slopes[1] != 0.0
    assert float(slopes[1]) == pytest.approx(float(times[2] - times[0]) / 2e-4, rel=1e-4)


@jax.jit
def read_of(impact, cantilever, free_nm, frequency_khz, offset_nm):
    """Return amplitude and lag of the fastest steady orbit, and whether there is one."""
    platform = Platform(free_nm, frequency_khz, offset_nm + impact.plane_nm)
    problem = OrbitProblem(cantilever, platform, impact, jnp.ones(()))
    orbits = steady_orbits(problem)
    slot = jnp.argmax(jnp.where(orbits.steady, orbits.place.coordinate, -jnp.inf))
    _, size, phase = orbits.amplitude_nm[slot]
    ratio = frequency_khz / cantilever.frequency_khz
    read = detected(size, phase, free_nm, ratio, cantilever.quality_factor, base=False)
    return jnp.stack(read), orbits.steady[slot]


NEAREST = {11: (4e-4, 0.01), 21: (4e-4, 0.01), 22: (4e-4, 0.03), 23: (3e-3, 0.5)}
"""How near amplitudes and phases (degrees) come to those of a table's rows."""
READ = {
    # on resonance and 3 % above it; nearer the sample taps are slow and last a quarter of the period
    "tapping_712_0_1_8.csv": (0, [1.0, 30.0], None),
    "tapping_712_0_1.03_12.csv": (0, [1.0, 30.0], None),
    # the nearest heights, where drive and lever cancel; the last tap takes a third of a period
    "tapping_712_1_1.03_12.csv": (1, [-1.1, 28.0], NEAREST),
}


@pytest.mark.parametrize("name", READ)
def test_taps_are_read_as_full_simulations_are(name: str):
    """The full scene in time, followed until it repeats."""
    number, pulls, rows = READ[name]
    truth = tapping_truth(number)
    table = read_table(Path(__file__).parent / "tapping_tables" / name)
    assert table.lockin_amplitude_nm is not None
    assert table.phase_lag_deg is not None
    if rows is None:
        far = np.flatnonzero(-table.offset_nm > 0.35 * table.excitation_nm)
        assert far.size >= 12
        rows = {int(row): (1e-4, 0.006) for row in far}
    cantilever = Cantilever(90.0, truth.quality_factor, MASS_NG)
    impact = tapped(Contact.paper(**truth.parameters), cantilever, jnp.array(pulls))
    for row, (nearness, degrees) in rows.items():
        drive = (table.excitation_nm[row], table.drive_frequency_khz[row], table.offset_nm[row])
        (amplitude, lag), steady = read_of(impact, cantilever, *map(jnp.asarray, drive))
        assert steady
        assert amplitude == pytest.approx(table.lockin_amplitude_nm[row], rel=nearness)
        assert (lag - table.phase_lag_deg[row] + 180.0) % 360.0 - 180.0 == pytest.approx(0.0, abs=degrees)


def test_light_and_hard_taps_beside_each_other_are_both_found():
    """A row of a fit on its way: orbits 0.1 nm/us apart to either side of the first hard tap, where the scan jumps."""
    found: dict[str, Any] = {"relative_humidity": 0.327516, "adhesion_energy_j_per_m2": 0.154908, "viscosity_pa_s": 0.0}
    contact = Contact.paper(tip_radius_nm=15.0, modulus_gpa=43.4047, **found)
    lever = Cantilever(89.9984, 136.187, MASS_NG)
    impact = tapped(contact, lever, jnp.array([1.5, 26.0]))
    platform = Platform(80.04042, 90.0, -70.4127964 + impact.plane_nm)
    problem = OrbitProblem(lever, platform, impact, jnp.ones(()))
    dense = Scan(8192, 0.1, 1.0, crossings=6, turns=2, slots=6)
    some, all_of = (jax.jit(find_roots, static_argnums=1)(problem, scan) for scan in (TAPPED, dense))
    # from the jump between them Newton's method goes to either: that is one orbit
    speeds, expected = (np.asarray(one.place.coordinate)[np.asarray(one.found)] for one in (some, all_of))
    assert len(expected) == 2
    assert np.ptp(expected) < 0.15
    np.testing.assert_allclose(np.sort(speeds), np.sort(expected), rtol=1e-7)
