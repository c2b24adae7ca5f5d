"""Contacts that the tip left, in order: the paper's Poincare section, and flights between them to be drawn."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from afm_jax.apparatus.scene import Scene, drive_of
from afm_jax.motion.observe import peaks_between_contacts
from afm_jax.motion.record import MotionOutcome, Simulation, contacts_left
from afm_jax.motion.settle import held_since, is_stuck
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
        drive_phase_deg=_drive_phase_deg(scene, time),
        departure_velocity_nm_per_us=np.asarray(rows.departure_velocity_nm_per_us)[has_left],
        approach_speed_nm_per_us=np.asarray(rows.approach_speed_nm_per_us)[has_left],
    )


def _drive_phase_deg(scene: Scene, time_us: Float[np.ndarray, " times"]) -> Float[np.ndarray, " times"]:
    return 360.0 * within_turn(time_us / drive_of(scene).period_us, 1.0)


class Departures(NamedTuple):
    """Every contact that the tip left, and the flight after it; NumPy arrays of one row a contact."""

    scene: Scene
    arrival_time_us: Float[np.ndarray, " contacts"]
    approach_speed_nm_per_us: Float[np.ndarray, " contacts"]
    departure_time_us: Float[np.ndarray, " contacts"]
    departure_position_nm: Float[np.ndarray, " contacts"]
    departure_velocity_nm_per_us: Float[np.ndarray, " contacts"]
    peak_height_nm: Float[np.ndarray, " contacts"]
    """Of the flight after each contact; NaN where it was not followed to its end."""
    begin_us: float
    end_us: float
    """Of what is known; the last departure where there was no room for more contacts."""
    held_from_us: float | None
    """When the contact began that holds the tip to the end (`is_stuck`); None if none does."""

    @property
    def captured(self) -> bool:
        """Whether the sample holds the tip at the end."""
        return self.held_from_us is not None

    @property
    def drive_phase_deg(self) -> Float[np.ndarray, " contacts"]:
        """Phase of the drive at each departure, in [0, 360)."""
        return _drive_phase_deg(self.scene, self.departure_time_us)

    def path(self, points: int = 24) -> Float[np.ndarray, "2 times"]:
        """Return times in us and heights in nm along all flights that ended, a straight line through every contact."""
        begin, stop = self.departure_time_us[:-1, None], self.arrival_time_us[1:, None]
        times = begin + (stop - begin) * np.linspace(0.0, 1.0, points)
        position, velocity = (
            jnp.asarray(column)[:-1, None] for column in (self.departure_position_nm, self.departure_velocity_nm_per_us)
        )
        heights, _ = self.scene.cantilever.propagator(times - begin)(position, velocity)
        return np.stack([times.reshape(-1), np.asarray(heights).reshape(-1)])


def departures(scene: Scene, simulation: Simulation) -> Departures:
    """Return the contacts that the tip left, of one scene that its platform alone drives."""
    rows, has_left = simulation.contacts, contacts_left(simulation)
    columns = [np.asarray(getattr(rows, name))[has_left] for name in Departures._fields if name in rows._fields]
    peaks = peaks_between_contacts(scene, simulation)
    full = simulation.outcome == MotionOutcome.CONTACT_LIMIT
    left_us = columns[2]
    return Departures(
        scene,
        *columns,
        peak_height_nm=np.append(peaks, np.full(left_us.size - peaks.size, np.nan)),
        begin_us=float(simulation.start.time_us),
        end_us=float(left_us[-1]) if full and left_us.size else float(simulation.final.time_us),
        held_from_us=held_since(simulation) if is_stuck(scene, simulation) else None,
    )
