"""What the pictures of a motion share: the stretch of time that is shown, and the tip along it."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from matplotlib.axes import Axes

from afm_jax.apparatus.scene import Scene
from afm_jax.contact.contact import Contact
from afm_jax.contact.phases import Phase
from afm_jax.motion.drive_period import Drive, drive_of
from afm_jax.motion.record import ContactKind, Contacts, Simulation
from afm_jax.motion.trajectory import Trajectory, dense_path
from afm_jax.plots.picture_style import ACCENT, BLUE

_CONTACTS_SHOWN = 6
_PERIODS_SHOWN = 6.0
"""Of the slower of drive and free vibration, where there are no contacts."""
_POINTS = 3000
_BESIDE_US = 1e-7
"""How far before and after a jump its two sides are looked at."""
_LONGEST_HELD = 4.0
"""Drive periods of a held tip that are shown: it is integrated step by step."""


class Look(NamedTuple):
    """A simulation and the stretch of it that is shown."""

    scene: Scene
    simulation: Simulation
    drive: Drive
    from_us: float
    to_us: float
    path: Trajectory
    """Over the stretch, fine enough for its contacts."""
    used: Bool[np.ndarray, " rows"]
    """Which rows of the table of contacts are contacts."""

    @property
    def contacts(self) -> Contacts:
        """The table of contacts."""
        return self.simulation.contacts

    def between(self, from_us: float, to_us: float) -> Trajectory:
        """Return the part of the path between two times."""
        inside = (self.path.time_us >= from_us) & (self.path.time_us <= to_us)
        return Trajectory(*(column[inside] for column in self.path))

    @property
    def touched(self) -> bool:
        """Whether the tip ever met the sample."""
        return bool(self.used.any())

    @property
    def left(self) -> bool:
        """Whether the tip ever left it again."""
        return bool(np.isfinite(self.departure_us).any())

    @property
    def arrival_us(self) -> Float[np.ndarray, " contacts"]:
        """When each contact began."""
        return np.asarray(self.contacts.arrival_time_us)[self.used]

    @property
    def departure_us(self) -> Float[np.ndarray, " contacts"]:
        """When each contact ended; infinite where it did not."""
        return np.asarray(self.contacts.departure_time_us)[self.used]


def look_at(scene: Scene, simulation: Simulation) -> Look:
    """Return the last contacts of a motion, or its last periods, ready to be drawn.

    Args:
        scene: the scene that was simulated.
        simulation: of one scene.

    Raises:
        ValueError: if the simulation is a batch, or did not get beyond its start.
    """
    if np.ndim(simulation.count):
        raise ValueError("a picture is of one simulation: pick one of the batch")
    first, last = float(simulation.start.time_us), float(simulation.final.time_us)
    if not last > first:
        raise ValueError("the simulation did not get beyond its start: there is nothing to draw")
    drive, rows = drive_of(scene), simulation.contacts
    used = np.asarray(rows.kind) != ContactKind.NONE
    arrival, departure = np.asarray(rows.arrival_time_us)[used], np.asarray(rows.departure_time_us)[used]
    period = max(drive.period_us, 1e3 / float(scene.cantilever.frequency_khz))
    end, begin = last, last - _PERIODS_SHOWN * period
    if used.any():
        if not np.isfinite(departure[-1]):
            end = min(last, float(arrival[-1]) + _LONGEST_HELD * period)
        shown = float(arrival[-min(_CONTACTS_SHOWN, arrival.size)])
        begin = min(shown - 0.3 * period, end - 2.0 * period)
    begin = max(begin, first)
    times = np.linspace(begin, end, _POINTS)
    dense = dense_path(scene, simulation, begin, end)
    if used.any():
        times = np.union1d(times, dense.nodes(begin, end)[0])
        edges = _edges(rows, used)
        edges = edges[(edges > begin + _BESIDE_US) & (edges < end - _BESIDE_US)]
        times = np.union1d(times, np.concatenate([edges - _BESIDE_US, edges, edges + _BESIDE_US]))
    return Look(scene, simulation, drive, begin, end, dense.at(times), used)


def _edges(rows: Contacts, used: Bool[np.ndarray, " rows"]) -> Float[np.ndarray, " edges"]:
    """Return when the phase of contact changes: there the force jumps, and the velocity of a law."""
    columns = [rows.arrival_time_us, rows.departure_time_us]
    if rows.detail is not None:
        columns += [rows.detail.junction_forms_us, rows.detail.junction_breaks_us]
    return np.concatenate([np.asarray(column)[used] for column in columns])


def shade_phases(axes: Axes, path: Trajectory, contact: object) -> None:
    """Shade where the tip is in the bridge or in the junction, or held by the platform of a law."""
    resolved = isinstance(contact, Contact)
    names = {Phase.BRIDGE: "liquid bridge", Phase.JUNCTION: "solid junction" if resolved else "held by the platform"}
    for phase, colour in ((Phase.BRIDGE, BLUE), (Phase.JUNCTION, ACCENT)):
        inside = path.phase == phase
        edges = np.diff(np.concatenate([[0], inside.astype(int), [0]]))
        label: str | None = names[phase]
        for begin, stop in zip(np.flatnonzero(edges > 0), np.flatnonzero(edges < 0), strict=True):
            right = path.time_us[min(stop, path.time_us.size - 1)]
            axes.axvspan(path.time_us[begin], right, color=colour, alpha=0.18, linewidth=0, label=label)
            label = None
