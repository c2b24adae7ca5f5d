"""Poincare sections of a simulated motion: at its contacts, and once every drive period."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from afm_jax.apparatus.scene import Scene
from afm_jax.motion.drive_period import drive_of
from afm_jax.motion.record import ContactKind, Simulation
from afm_jax.motion.trajectory import trajectory


class Section(NamedTuple):
    """The paper's section: one point a contact that the tip left; arrays of shape (contacts,)."""

    time_us: Float[np.ndarray, " contacts"]
    drive_phase_deg: Float[np.ndarray, " contacts"]
    """Of the departure, in [0, 360)."""
    departure_velocity_nm_per_us: Float[np.ndarray, " contacts"]
    approach_speed_nm_per_us: Float[np.ndarray, " contacts"]


class Strobe(NamedTuple):
    """The tip once every drive period; arrays of shape (periods,)."""

    time_us: Float[np.ndarray, " periods"]
    position_nm: Float[np.ndarray, " periods"]
    velocity_nm_per_us: Float[np.ndarray, " periods"]


def poincare_section(scene: Scene, simulation: Simulation) -> Section:
    """Return phase of the drive and velocity at every departure, and how fast the tip had come.

    Args:
        scene: the scene that was simulated.
        simulation: of one scene.
    """
    rows = simulation.contacts
    left = np.isin(np.asarray(rows.kind), (ContactKind.IMPACT, ContactKind.CHATTER))
    time = np.asarray(rows.departure_time_us)[left]
    return Section(
        time_us=time,
        drive_phase_deg=360.0 * ((time / drive_of(scene).period_us) % 1.0),
        departure_velocity_nm_per_us=np.asarray(rows.departure_velocity_nm_per_us)[left],
        approach_speed_nm_per_us=np.asarray(rows.approach_speed_nm_per_us)[left],
    )


def strobe(scene: Scene, simulation: Simulation, *, phase_deg: float = 0.0, from_us: float | None = None) -> Strobe:
    """Return the tip whenever the drive has a phase.

    Args:
        scene: the scene that was simulated.
        simulation: of one scene.
        phase_deg: the phase of the drive.
        from_us: where to begin; the simulation's start if None.
    """
    period = drive_of(scene).period_us
    first = float(simulation.start.time_us) if from_us is None else from_us
    lowest = int(np.ceil(first / period - phase_deg / 360.0))
    highest = int(np.floor(float(simulation.final.time_us) / period - phase_deg / 360.0))
    times = (np.arange(lowest, highest + 1) + phase_deg / 360.0) * period
    path = trajectory(scene, simulation, times)
    return Strobe(times, path.position_nm, path.velocity_nm_per_us)
