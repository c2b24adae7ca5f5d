"""Orbits of m contacts in N drive periods: closed by Newton's method on the simulated map from departure to departure.

First guesses are the orbits of the law with delay that comes closest to the contact, unstable ones included, and what
tips come to that are simulated for a while. The map's Jacobian is the forward derivative of the simulation, so that a
loop is closed to rounding and its multipliers are exact.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from afm_jax.apparatus.scene import Scene, drive_of
from afm_jax.checks import require_float64
from afm_jax.contact.contact import Contact
from afm_jax.contact.law_of_contact import law_of_contact
from afm_jax.dynamics.contact_sequence import departures_after, follow_contacts
from afm_jax.dynamics.impact_loop import LoopReading
from afm_jax.dynamics.impact_orbits import (
    ManyImpactOrbits,
    check_loop,
    is_stable,
    loops_told_apart,
    many_impact_orbits,
    multipliers_of,
)
from afm_jax.dynamics.iteration import evenly_spread, leaving_tips
from afm_jax.motion.observe import peaks_of_flights
from afm_jax.motion.record import ContactKind
from afm_jax.motion.simulate import DEFAULT_ACCURACY

_STARTS = 8
"""Tips that are simulated for guesses."""
_SETTLING = 60
"""Contacts before their guesses."""
_WINDOW = 0.05
"""Periods by which the contacts of a guess may miss N drive periods."""
_NEWTON_STEPS = 25
_TURN, _SHARE = 0.3, 0.3
"""Longest step of Newton's method: in a phase, rad, and of a speed."""
_ARRIVED = 1e-10
"""Largest last step and remaining gap of a closed loop, in rad and of the fastest speed."""
_LANES = 16
"""Contacts followed together, one program."""
_LONGEST_CONTACT = 0.5
"""Time that a contact may take beyond where it was expected to end, in flights of the loop."""


def contact_orbits(scene: Scene, order: int, impacts: int, *, accuracy: float = DEFAULT_ACCURACY) -> ManyImpactOrbits:
    """Return the orbits of m contacts in N drive periods of a scene with a contact.

    Args:
        scene: one scene with a `Contact`, driven with one period.
        order: N, drive periods until the motion repeats.
        impacts: m, contacts in them.
        accuracy: of `simulate`.

    Returns:
        The orbits; a contact begins where the bridge forms and ends where it breaks. In the reading phases and
        velocities after are those of the departures, delays those between straight paths extrapolated to gap 0
        (as in `collide`); ``loops`` holds departure phases in rad and rebound speeds in
        nm/us. Stable orbits that eight tips do not come to and unstable ones that the closest law lacks are not found.

    Raises:
        RuntimeError: if JAX is not set to 64-bit floats.
        TypeError: if the scene's interaction is no contact.
        ValueError: if order or impacts is no positive integer, there are more impacts than 64, or the drive does not
            repeat.
    """
    require_float64(scene)
    if not isinstance(scene.interaction, Contact):
        raise TypeError("`scene` must have a `Contact`; `many_impact_orbits` has the orbits of a law")
    check_loop(order, impacts)
    aperiodic = drive_of(scene).aperiodic
    if aperiodic is not None:
        raise ValueError(f"there are no periodic orbits: {aperiodic}")
    guesses = [*_orbits_of_law(scene, order, impacts), *_simulated(scene, order, impacts, accuracy)]
    loops = [loop for guess in guesses if (loop := _closed(guess, scene, order, accuracy)) is not None]
    told = loops_told_apart(np.array(loops).reshape(-1, 2 * impacts), order)
    known = [(reading, loop) for loop in told if (reading := _reading(loop, scene, order, accuracy)) is not None]
    known.sort(key=lambda one: -float(one[0].peak_amplitude_nm))
    fields = [*[jnp.zeros((0, impacts))] * 6, *[jnp.zeros(0)] * 3, jnp.zeros(0, bool), jnp.zeros(0)]
    reading = LoopReading(*fields)
    if known:
        reading = jax.tree.map(
            lambda *parts: np.stack([np.asarray(part) for part in parts]), *(one for one, _ in known)
        )
    loops = np.array([loop for _, loop in known]).reshape(-1, 2 * impacts)
    multipliers = multipliers_of(np.asarray(reading.trace), np.asarray(reading.determinant))
    return ManyImpactOrbits(loops, reading, multipliers, is_stable(multipliers))


def _orbits_of_law(scene: Scene, order: int, impacts: int) -> list[np.ndarray]:
    """Return the orbits of the law with delay closest to the contact, as guesses."""
    law = law_of_contact(scene.interaction, float(scene.cantilever.mass_ng))
    if law is None:
        return []
    simple = eqx.tree_at(lambda parts: parts.interaction, scene, law)
    reading = many_impact_orbits(simple, order, impacts).reading
    omega, gap = drive_of(scene).angular_frequency, float(scene.interaction.bridge_breaks_nm)
    found = []
    for phase, rebound in zip(reading.phase_rad, reading.rebound_speed_nm_per_us, strict=True):
        # `phase_rad` is within a turn: the impacts follow one another
        turns = _rising(phase)
        found.append(np.concatenate([turns + omega * gap / rebound, rebound]))
    return found


def _rising(phase: Float[np.ndarray, " m"]) -> Float[np.ndarray, " m"]:
    turned = phase.copy()
    for place in range(1, len(turned)):
        turned[place] += 2.0 * np.pi * np.ceil((turned[place - 1] - turned[place]) / (2.0 * np.pi))
    return turned


def _simulated(scene: Scene, order: int, impacts: int, accuracy: float) -> list[np.ndarray]:
    """Return what a few tips do after a while, where it nearly repeats, as guesses."""
    scenes = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (_STARTS, *leaf.shape)), scene)
    tips = leaving_tips(scenes)
    period = drive_of(scene).period_us
    across, up = evenly_spread(_STARTS).T
    time = period * across
    faster = np.asarray(tips.velocity_nm_per_us - scene.platform.velocity(tips.time_us)) * (0.5 + 3.0 * up)
    tips = tips._replace(time_us=time, velocity_nm_per_us=np.asarray(scene.platform.velocity(time)) + faster)
    _, record = follow_contacts(scenes, tips, skip=_SETTLING, record=2 * impacts + 1, accuracy=accuracy)
    turns = record.departure_periods + record.departure_us / period
    rebound = record.velocity_after_nm_per_us - np.asarray(scene.platform.velocity(record.departure_us))
    found = []
    for lane in range(_STARTS):
        for begin in range(impacts + 1):
            own = turns[lane, begin : begin + impacts + 1]
            if abs(own[-1] - own[0] - order) < _WINDOW:
                phases = 2.0 * np.pi * (own[:-1] - np.floor(own[0]))
                found.append(np.concatenate([phases, rebound[lane, begin : begin + impacts]]))
    return found


def _closed(guess: np.ndarray, scene: Scene, order: int, accuracy: float) -> np.ndarray | None:
    """Return the loop that Newton's method finds, departure phases and rebound speeds; None where it finds none."""
    loop, count = guess.copy(), len(guess) // 2
    for _ in range(_NEWTON_STEPS):
        size = loop[count:].max()
        flown = _flown(loop, scene, order, accuracy)
        if flown is None:
            return None
        step = -np.linalg.lstsq(flown.slopes, flown.gaps, rcond=None)[0]
        relative = np.concatenate([step[:count] / _TURN, step[count:] / (_SHARE * loop[count:])])
        loop = loop + step / max(1.0, np.abs(relative).max())
        weights = np.repeat([1.0, 1.0 / size], count)
        if np.abs(step * weights).max() < _ARRIVED and np.abs(flown.gaps * weights).max() < _ARRIVED:
            return loop
    return None


class _Flown(NamedTuple):
    """A loop as it was flown: by how much departures miss the next ones, in phase and rebound speed, and why."""

    gaps: Float[np.ndarray, " n"]
    slopes: Float[np.ndarray, "n n"]
    contacts: Any
    """`Contacts`, m rows."""
    jacobian: Float[np.ndarray, "m 2 2"]


def _flown(loop: np.ndarray, scene: Scene, order: int, accuracy: float) -> _Flown | None:
    """Return a loop with each of its contacts simulated; None where one does not end in time."""
    count = len(loop) // 2
    drive = drive_of(scene)
    omega = drive.angular_frequency
    time, rebound = loop[:count] / omega, loop[count:]
    following = np.append(time[1:], time[0] + order * drive.period_us)
    flights = following - time
    if flights.min() <= 0.0 or rebound.min() <= 0.0:
        return None
    until = following + _LONGEST_CONTACT * flights.min()
    velocity = rebound + np.asarray(scene.platform.velocity(time))
    rows = _LANES * -(-count // _LANES)
    lanes = [np.pad(part, (0, rows - count), mode="edge") for part in (time, velocity, until)]
    scenes = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (rows, *leaf.shape)), scene)
    contacts, jacobian = jax.tree.map(
        lambda part: np.asarray(part)[:count], departures_after(scenes, *lanes, accuracy=accuracy)
    )
    if not ((contacts.kind == ContactKind.IMPACT).all() and np.isfinite(jacobian).all()):
        return None
    bend = np.asarray(scene.platform.acceleration(time))
    end_bend = np.asarray(scene.platform.acceleration(contacts.departure_time_us))
    # of (phase, rebound) over (time, velocity), behind and before
    behind, before = np.zeros((count, 2, 2)), np.zeros((count, 2, 2))
    behind[:, 0, 0], behind[:, 1, 0], behind[:, 1, 1] = omega, -end_bend, 1.0
    before[:, 0, 0], before[:, 1, 0], before[:, 1, 1] = 1.0 / omega, bend / omega, 1.0
    each = behind @ jacobian @ before
    phase, speed = omega * contacts.departure_time_us, contacts.rebound_speed_nm_per_us
    gaps = np.concatenate([phase - omega * following, speed - np.roll(rebound, -1)])
    slopes = np.zeros((2 * count, 2 * count))
    for place in range(count):
        after = (place + 1) % count
        for row in range(2):
            for column in range(2):
                slopes[row * count + place, column * count + place] += each[place, row, column]
            slopes[row * count + place, row * count + after] -= 1.0
    return _Flown(gaps, slopes, contacts, np.asarray(jacobian))


def _reading(loop: np.ndarray, scene: Scene, order: int, accuracy: float) -> LoopReading | None:
    """Return what there is to know of a closed loop."""
    count = len(loop) // 2
    flown = _flown(loop, scene, order, accuracy)
    if flown is None:
        return None
    contacts, whole = flown.contacts, np.eye(2)
    for matrix in flown.jacobian:
        whole = matrix @ whole
    determinant = np.prod(np.linalg.det(flown.jacobian))
    omega, contact = drive_of(scene).angular_frequency, scene.interaction
    time = loop[:count] / omega
    height, rate = (np.asarray(part) for part in scene.platform.position_and_velocity(time))
    peaks = peaks_of_flights(
        scene, time, height + float(contact.bridge_breaks_nm), loop[count:] + rate, contacts.arrival_time_us
    )
    # of the contact before each departure
    approach = np.roll(contacts.approach_speed_nm_per_us, 1)
    lasts = np.roll(contacts.departure_time_us - contacts.arrival_time_us, 1)
    straight = float(contact.bridge_forms_nm) / approach + float(contact.bridge_breaks_nm) / loop[count:]
    weights = np.repeat([1.0, 1.0 / loop[count:].max()], count)
    return LoopReading(
        *(
            jnp.asarray(part)
            for part in (
                loop[:count] % (2.0 * np.pi),
                loop[count:] + rate,
                np.roll(contacts.arrival_velocity_nm_per_us, 1),
                approach,
                loop[count:],
                lasts - straight,
                np.max(peaks),
                np.trace(whole),
                determinant,
                True,
                np.abs(flown.gaps * weights).max(),
            )
        )
    )
