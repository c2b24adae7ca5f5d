"""Law scenes for the package and for the event-driven reference, and their rows beside each other."""

from typing import Any

import jax.numpy as jnp
import numpy as np

from afm_jax.apparatus.cantilever import Cantilever
from afm_jax.apparatus.drives import BaseDrive, ForceDrive, Tone
from afm_jax.apparatus.platform import Platform
from afm_jax.apparatus.scene import Scene
from afm_jax.impact.law import ImpactLaw
from afm_jax.motion.record import Simulation, State
from afm_jax.motion.simulate import simulate
from tests.reference_law_motion import Cosines, LawCourse, LawSystem

PRESSING = LawSystem(Cosines(4.0, 0.0, ((5.0, 20.0, 0.0),)), r=0.3, quality_factor=40.0)
"""A slow platform that presses the tip up most of the time, and lets it go near its lowest point."""
PRESSING_START, PRESSING_DURATION = (3.0, 12.0, -4.0), 72.0
ROWS = 24
"""One number for most tests: it shapes the program, and programs are shared."""


def scene_of(system: LawSystem) -> Scene:
    """Return the package's scene for the reference's system."""
    quality = None if np.isinf(system.quality_factor) else system.quality_factor
    first, *more = system.platform.parts
    second = Tone(*more[0]) if more else None
    platform = Platform(first[0], first[1], system.platform.offset, system.platform.rate, second)
    bases, forces = ([Tone(*part) for part in motion.parts] for motion in (system.base, system.force))
    base = BaseDrive(bases[0].amplitude, bases[0].frequency_khz, bases[0].phase_deg) if bases else None
    force = (
        ForceDrive(forces[0].amplitude, forces[0].frequency_khz, forces[0].phase_deg, *forces[1:]) if forces else None
    )
    law = ImpactLaw(system.r, system.epsilon, system.viscous_loss)
    return Scene(Cantilever(system.frequency_khz, quality), platform, law, base, force)


def simulated(
    scene: Scene, start: tuple[float, float, float], duration: float, rows: int = ROWS, **options: Any
) -> Simulation:
    return simulate(scene, State(*(jnp.asarray(value) for value in start)), duration, max_contacts=rows, **options)


def assert_same_rows(simulation: Simulation, course: LawCourse, rows: int) -> None:
    """Check the first rows and what they say of arrival and departure."""
    contacts, exact = simulation.contacts, np.array(course.rows[:rows])
    pairs = (
        (contacts.arrival_time_us, 1e-8),
        (contacts.arrival_velocity_nm_per_us, 1e-6),
        (contacts.departure_time_us, 1e-8),
        (contacts.departure_velocity_nm_per_us, 1e-6),
    )
    for column, (values, atol) in enumerate(pairs):
        # DOP853 at 1e-12 over some periods, stretched by about 2 an impact
        np.testing.assert_allclose(np.asarray(values)[:rows], exact[:, column], rtol=0.0, atol=atol)
