"""The paper's Poincare section: drive phase and velocity at every departure of the tip."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from afm_jax.apparatus.scene import Scene, drive_of
from afm_jax.motion.record import Simulation, contacts_left
from afm_jax.units import within_turn


class Section(NamedTuple):
    """The paper's section: one point a contact that the tip left; arrays of shape (contacts,)."""

    time_us: Float[np.ndarray, " contacts"]
    drive_phase_deg: Float[np.ndarray, " contacts"]
    """Of the departure, in [0, 360)."""
    departure_velocity_nm_per_us: Float[np.ndarray, " contacts"]
    approach_speed_nm_per_us: Float[np.ndarray, " contacts"]


def poincare_section(scene: Scene, simulation: Simulation) -> Section:
    """Return the drive's phase and the tip's velocity at every departure, and how fast the tip had come.

    Args:
        scene: the scene that was simulated.
        simulation: of one scene.
    """
    rows, has_left = simulation.contacts, contacts_left(simulation)
    time = np.asarray(rows.departure_time_us)[has_left]
    return Section(
        time_us=time,
        drive_phase_deg=360.0 * within_turn(time / drive_of(scene).period_us, 1.0),
        departure_velocity_nm_per_us=np.asarray(rows.departure_velocity_nm_per_us)[has_left],
        approach_speed_nm_per_us=np.asarray(rows.approach_speed_nm_per_us)[has_left],
    )
