"""Amplitude and phase of a tapping tip from its contact's table of collisions, against the driven contact in time."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from afm_jax.apparatus.cantilever import Cantilever
from afm_jax.apparatus.drives import ForceDrive
from afm_jax.apparatus.platform import Platform
from afm_jax.apparatus.scene import Scene
from afm_jax.apparatus.surface import detected, drive_per_free_height
from afm_jax.contact.contact import Contact
from afm_jax.contact.law_of_contact import tabulated
from afm_jax.impact.closure import OrbitProblem
from afm_jax.impact.lasting_impact import TabulatedImpact, middle_of_contact
from afm_jax.impact.orbits import amplitudes, orbit_state, steady_orbits
from afm_jax.motion.follow import follow_long
from afm_jax.motion.observe import observe
from afm_jax.motion.start import default_start

CANTILEVER = {"frequency_khz": 90.0, "quality_factor": 200.0, "mass_ng": 16.81}


class Read(NamedTuple):
    """Lock-in amplitude in nm and lag in degrees; of a prediction approach speed over capture, and g tau/u too."""

    amplitude_nm: Any
    lag_deg: Any
    speed: Any = np.nan
    pull: Any = np.nan


def truth(contact: Contact, ratio: float, free_nm: float, offset_nm: float) -> Read:
    """Return what a lock-in reads of the driven contact, followed until it repeats; NaN if not one impact a period."""
    cantilever, frequency = Cantilever(**CANTILEVER), 90.0 * ratio
    force = ForceDrive(free_nm * float(drive_per_free_height(cantilever, frequency, ForceDrive)), frequency)
    scene = Scene(cantilever, Platform(0.0, frequency, offset_nm), contact, force=force)
    run = follow_long(scene, default_start(scene), 20_000.0, until_settled=True)
    periods = run.verdict.periods
    if periods is None or run.verdict.contacts != periods:
        return Read(np.nan, np.nan)
    # what dies away slowly may count as several periods: a lock-in reads the drive's frequency
    seen = observe(scene, run.simulation, verdict=run.verdict)
    return Read(seen.drive_lockin_amplitude_nm, seen.phase_lag_deg)


@jax.jit
def predicted(impact: TabulatedImpact, ratio: jax.Array, free_nm: jax.Array, offset_nm: jax.Array) -> Read:
    """Return the same of the fastest steady orbit over a platform in the free tip's frame."""
    cantilever, platform = Cantilever(**CANTILEVER), Platform(free_nm, 90.0 * ratio, offset_nm)
    problem = OrbitProblem(cantilever, platform, impact, jnp.ones(()))
    orbits = steady_orbits(problem)
    slot = jnp.argmax(jnp.where(orbits.steady, orbits.place.coordinate, -jnp.inf))
    place = jax.tree.map(lambda part: part[slot], orbits.place)
    state = orbit_state(place, problem)
    _, amplitude, phase = amplitudes(place, problem)
    size, lag = detected(amplitude, phase, free_nm, ratio, cantilever.quality_factor, base=False)
    middle = middle_of_contact(cantilever, platform, state.flight.start_us - 0.5 * state.speeds.delay)
    u = state.speeds.approach
    return Read(size, lag, u / impact.lowest, middle.acceleration * impact.hertz_contact.time(u) / u)


ROWS = [(100.0, 1.1, 80.0), (20.0, 1.1, 80.0)]
"""Radius of the tip in nm, frequency over the free one, free amplitude in nm."""
SHARES = (0.8, 0.4)
"""Of the free amplitude: distance of the sample from the rest position."""


def compared() -> np.ndarray:
    """Return one row a curve and height: errors in nm and degrees, amplitude, speed over capture and g tau/u."""
    rows = []
    for radius, ratio, free in ROWS:
        contact = Contact.paper(tip_radius_nm=radius)
        impact = tabulated(contact, jnp.asarray(CANTILEVER["mass_ng"]))
        for share in SHARES:
            exact = truth(contact, ratio, free, -share * free)
            found = predicted(impact, *(jnp.asarray(number) for number in (ratio, free, -share * free)))
            both = np.array([[float(part) for part in read] for read in (found, exact)])
            rows.append([*(both[0, :2] - both[1, :2]), both[1, 0], *both[0, 2:]])
    return np.array(rows)


@pytest.mark.slow
def test_tapping_amplitudes_and_phases_are_those_of_the_driven_contact():
    nm, degrees, amplitude, speed, pull = compared().T
    used = (speed > 4.0) & (pull < 0.8) & np.isfinite(nm)
    assert np.count_nonzero(used) >= 4
    assert np.max(np.abs(nm[used])) < 0.07
    assert np.max(np.abs(degrees[used])) < 0.1
    assert np.median(np.abs(nm / amplitude)[used]) < 1e-3
    assert np.median(np.abs(degrees[used])) < 0.01
