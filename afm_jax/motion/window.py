"""Over which stretch of a simulation its observables are taken."""

from typing import NamedTuple

import numpy as np

from afm_jax.apparatus.scene import Scene
from afm_jax.motion.drive_period import Drive, drive_of
from afm_jax.motion.record import ContactKind, Simulation
from afm_jax.motion.settled import Settled

_LAST_SHARE = 0.2


class Window(NamedTuple):
    """A stretch of time, in us, whole response periods of the drive where it is long enough."""

    from_us: float
    to_us: float
    periods: int
    """N: drive periods in a response period; where nothing repeats the nearest integer between two contacts."""
    responses: int
    """Whole response periods in the stretch; 0 where it is shorter than one."""


def window_of(scene: Scene, simulation: Simulation, verdict: Settled, drive: Drive | None = None) -> Window:
    """Return the last response period of a settled motion, else whole response periods in the last fifth.

    The end is moved into a flight where there is one, so that no contact is cut in a motion that repeats.

    Args:
        scene: the scene.
        simulation: of one scene.
        verdict: what `settled` says of it.
        drive: in whose periods to count; the scene's if None.
    """
    drive = drive_of(scene) if drive is None else drive
    first, last = float(simulation.start.time_us), float(simulation.final.time_us)
    periods = verdict.periods or _likely_order(simulation, drive.period_us, stuck=verdict.stuck)
    response = periods * drive.period_us
    if verdict.settled and not verdict.stuck and last - first >= response:
        end = last if verdict.contacts == 0 else _middle_of_a_flight(simulation, response)
        return Window(max(end - response, first), end, periods, 1)
    whole = int(_LAST_SHARE * (last - first) / response)
    if whole == 0:
        # too short for a fifth: one response period if there is one at all
        whole = int(last - first >= response)
    begin = last - whole * response if whole else last - _LAST_SHARE * (last - first)
    return Window(begin, last, periods, whole)


def _likely_order(simulation: Simulation, period_us: float, *, stuck: bool) -> int:
    """Return the nearest integer to the mean number of drive periods between contacts, over the last fifth of them."""
    rows = simulation.contacts
    times = np.asarray(rows.departure_time_us)[np.asarray(rows.kind) == ContactKind.IMPACT]
    some = times[-max(5, int(_LAST_SHARE * len(times))) :]
    if stuck or len(some) < 2:
        return 1
    return max(1, round(float(some[-1] - some[0]) / (len(some) - 1) / period_us))


def _middle_of_a_flight(simulation: Simulation, response_us: float) -> float:
    """Return the middle of the longest flight that ends in the last response period."""
    rows, last = simulation.contacts, float(simulation.final.time_us)
    used = np.asarray(rows.kind) != ContactKind.NONE
    arrival, departure = np.asarray(rows.arrival_time_us)[used], np.asarray(rows.departure_time_us)[used]
    begin = np.maximum(arrival, departure)
    end = np.append(arrival[1:], last)
    flights = np.isfinite(begin) & (end > last - response_us) & (end > begin)
    longest = int(np.argmax(np.where(flights, end - np.where(np.isfinite(begin), begin, 0.0), -np.inf)))
    return 0.5 * float(begin[longest] + end[longest])
