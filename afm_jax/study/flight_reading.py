"""What a simulation shows between two times: peak, lock-in amplitude and phase, energy per impact.

The flights between contacts are a closed form. Within a contact, short against the drive period, the gap is taken as
straight between the points that a simulation keeps of it: bridge formed, junction formed, deepest, junction broken,
bridge broken. So nothing is integrated twice, and a reading is a smooth function of the simulation's numbers.
"""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from afm_jax.apparatus.scene import Scene
from afm_jax.apparatus.surface import surface_of
from afm_jax.contact.contact import Contact
from afm_jax.contact.junction import find_junction
from afm_jax.motion.frames import to_lab
from afm_jax.motion.impact_integral import impact_integral
from afm_jax.motion.motion_pieces import Flights, flights_of, fly
from afm_jax.motion.record import ContactKind, Simulation

_PANELS = 8
_POINTS, _WEIGHTS = np.polynomial.legendre.leggauss(16)
_IN_CONTACT = 3
"""Gauss points on every straight piece of a contact."""


class Reading(NamedTuple):
    """What a motion shows in a window of time."""

    peak_amplitude_nm: float
    """Largest height above the rest position."""
    lockin_amplitude_nm: float
    """2/T |integral z exp(-i omega t)| at the given frequency."""
    lockin_phase_deg: float
    energy_per_impact_aj: float | None
    """None without impacts."""
    impacts: int


def read_motion(
    scene: Scene, simulation: Simulation, from_us: float, to_us: float, *, angular_frequency: float
) -> Reading:
    """Return what a simulation of one scene shows between two times.

    Args:
        scene: the scene.
        simulation: of it.
        from_us: beginning of the window.
        to_us: its end.
        angular_frequency: of the lock-in, in rad/us.
    """
    flights = flights_of(scene, simulation)
    begin, end = np.clip(flights.begin_us, from_us, to_us), np.clip(flights.end_us, from_us, to_us)
    edges = begin + (end - begin) * np.linspace(0.0, 1.0, _PANELS + 1)[:, None]
    half = 0.5 * np.diff(edges, axis=0)
    times = edges[:-1, None] + half[:, None] * (_POINTS[:, None] + 1.0)
    weights = half[:, None] * _WEIGHTS[:, None]
    count = flights.begin_us.size
    times, weights = times.reshape(-1, count), weights.reshape(-1, count)
    heights = _heights(scene, flights, times)
    turn = np.sum(weights * heights * np.exp(-1j * angular_frequency * times))
    contact_times, contact_weights, contact_heights = _contact_points(scene, simulation, from_us, to_us)
    turn += np.sum(contact_weights * contact_heights * np.exp(-1j * angular_frequency * contact_times))
    turn += impact_integral(scene, simulation, from_us, to_us, angular_frequency)
    turn *= 2.0 / (to_us - from_us)
    rows = simulation.contacts
    arrival = np.asarray(rows.arrival_time_us)
    inside = (np.asarray(rows.kind) != ContactKind.NONE) & (arrival >= from_us) & (arrival < to_us)
    lost = np.asarray(rows.energy_lost_aj)[inside]
    return Reading(
        _peak(scene, flights, times, np.where(end > begin, heights, -np.inf)),
        float(abs(turn)),
        float(np.degrees(np.angle(turn))),
        float(lost.mean()) if lost.size else None,
        int(lost.size),
    )


def _heights(scene: Scene, flights: Flights, times: np.ndarray) -> np.ndarray:
    return fly(scene, flights, times)[0] if flights.begin_us.size else np.zeros(times.shape)


def _peak(scene: Scene, flights: Flights, times: np.ndarray, heights: np.ndarray) -> float:
    """Return the largest height, by the parabola through the three highest points of the highest flight."""
    if not heights.size:
        return float("nan")
    row, flight = np.unravel_index(int(np.argmax(heights)), heights.shape)
    top = float(heights[row, flight])
    if not 0 < row < heights.shape[0] - 1:
        return top
    t, z = times[row - 1 : row + 2, flight], heights[row - 1 : row + 2, flight]
    curve = np.polyfit(t - t[1], z - z[1], 2)
    if curve[0] >= 0.0:
        return top
    vertex = t[1] - 0.5 * curve[1] / curve[0]
    one = Flights(*(part[flight : flight + 1] for part in flights))
    return float(_heights(scene, one, np.array([[vertex]]))[0, 0])


def _contact_points(
    scene: Scene, simulation: Simulation, from_us: float, to_us: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return times, weights and heights in the lab within the contacts."""
    times, weights, gaps = [np.zeros(0)], [np.zeros(0)], [np.zeros(0)]
    points, shares = np.polynomial.legendre.leggauss(_IN_CONTACT)
    for corner_times, corner_gaps in _corners(scene, simulation, from_us, to_us):
        inside = np.clip(corner_times, from_us, to_us)
        half = 0.5 * np.diff(inside)[:, None]
        at = (inside[:-1, None] + half * (points + 1.0)).reshape(-1)
        times.append(at)
        weights.append((half * shares).reshape(-1))
        gaps.append(np.interp(at, corner_times, corner_gaps))
    at = np.concatenate(times)
    lab = to_lab(*surface_of(scene), jnp.asarray(at), jnp.asarray(np.concatenate(gaps)), jnp.zeros(at.shape))
    return at, np.concatenate(weights), np.asarray(lab.position_nm)


def _corners(scene: Scene, simulation: Simulation, from_us: float, to_us: float) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return of every contact in a window the times and gaps that the simulation knows."""
    rows, last = simulation.contacts, float(simulation.final.time_us)
    arrival, departure = np.asarray(rows.arrival_time_us), np.asarray(rows.departure_time_us)
    used = (np.asarray(rows.kind) != ContactKind.NONE) & (arrival < to_us) & (departure > from_us)
    resolved = rows.detail is not None and isinstance(scene.interaction, Contact)
    known = _Gaps.of(scene.interaction) if resolved else None
    return [
        _corners_of(rows.detail, known, int(row), float(arrival[row]), min(float(departure[row]), last))
        for row in np.flatnonzero(used & (np.minimum(departure, last) > arrival))
    ]


class _Gaps(NamedTuple):
    """The gaps in nm at which something happens."""

    bridge_forms: float
    junction_forms: float
    junction_breaks: float
    bridge_breaks: float

    @classmethod
    def of(cls, contact: Contact) -> "_Gaps":
        junction = find_junction(contact)
        parts = (contact.bridge_forms_nm, junction.forms_gap_nm, junction.breaks_gap_nm, contact.bridge_breaks_nm)
        return cls(*(float(part) for part in parts))


def _corners_of(
    detail: Any, known: _Gaps | None, row: int, arrival: float, departure: float
) -> tuple[np.ndarray, np.ndarray]:
    if detail is None or known is None:
        # a law: on the surface until the next flight starts
        return np.array([arrival, departure]), np.zeros(2)
    deepest, junctions = float(detail.deepest_gap_nm[row]), int(detail.junctions[row])
    forms, breaks = float(detail.junction_forms_us[row]), float(detail.junction_breaks_us[row])
    middle = [(0.5 * (arrival + departure), deepest)]
    if junctions and arrival < forms < breaks < departure:
        middle = [
            (forms, known.junction_forms),
            (0.5 * (forms + breaks), deepest),
            (breaks, known.junction_breaks),
        ]
    corners = [(arrival, known.bridge_forms), *middle, (departure, known.bridge_breaks)]
    times, gaps = np.array(corners).T
    return times, gaps
