"""A contact scene followed for long, in pieces of a few hundred contacts that share one compiled program."""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from afm_jax.apparatus.scene import Scene
from afm_jax.motion.record import ContactKind, MotionOutcome, Simulation, State
from afm_jax.motion.simulate import simulate
from afm_jax.study.flight_peaks import peaks_of_flights

CONTACTS_OF_A_PIECE = 400
_HELD_PERIODS = 3.0
_ROUNDS = 20_000
"""A held tip takes a round every 60 steps of its oscillation; a free one does not come near this many."""

Report = Callable[[str], object]


class LongMotion(NamedTuple):
    """A scene followed in pieces; each but the last ends with the departure at which the next begins.

    The columns are NumPy arrays of one row for every contact that the tip left.
    """

    scene: Scene
    pieces: tuple[Simulation, ...]
    arrival_time_us: Float[np.ndarray, " contacts"]
    approach_speed_nm_per_us: Float[np.ndarray, " contacts"]
    departure_time_us: Float[np.ndarray, " contacts"]
    departure_position_nm: Float[np.ndarray, " contacts"]
    departure_velocity_nm_per_us: Float[np.ndarray, " contacts"]
    peak_height_nm: Float[np.ndarray, " contacts"]
    """Of the flight after each contact; NaN where it was not followed to its end."""
    end_us: float
    held_from_us: float | None
    """When the contact began that holds the tip to the end, for more than three drive periods; None if none does."""
    outcome: MotionOutcome

    @property
    def captured(self) -> bool:
        """Whether the sample holds the tip at the end."""
        return self.held_from_us is not None

    @property
    def drive_phase_deg(self) -> Float[np.ndarray, " contacts"]:
        """Phase of the drive at each departure."""
        return 360.0 * np.mod(self.departure_time_us / float(self.scene.platform.period_us), 1.0)


def follow_long(
    scene: Scene,
    start: State,
    until_us: float,
    *,
    enough: Callable[[Float[np.ndarray, " contacts"]], bool] = lambda _: False,
    report: Report = lambda _: None,
) -> LongMotion:
    """Follow a contact scene to a time, or until its contacts are enough.

    Args:
        scene: one scene with a `Contact`, driven by its platform.
        start: where the motion begins.
        until_us: the end.
        enough: asked after every piece with the times of all departures so far, in us: whether to stop.
        report: told after every piece how far it is.
    """
    pieces: list[Simulation] = []
    columns: list[np.ndarray] = []
    state = start
    while True:
        piece = simulate(
            scene, state, until_us - float(state.time_us), max_contacts=CONTACTS_OF_A_PIECE, max_rounds=_ROUNDS
        )
        pieces.append(piece)
        columns.append(_departures(piece))
        times = np.concatenate(columns, axis=1)[2]
        report(f"{times.size} contacts, {100.0 * min(1.0, _reached(piece) / until_us):.0f} % of the time")
        if piece.outcome != MotionOutcome.CONTACT_LIMIT or not columns[-1].size or enough(times):
            break
        state = State(*(column[-1] for column in columns[-1][2:]))
    return _joined(scene, tuple(pieces), np.concatenate(columns, axis=1))


def path_of(motion: LongMotion, points: int = 24) -> Float[np.ndarray, "2 times"]:
    """Return times in us and heights in nm along all flights that ended, a straight line through every contact.

    Args:
        motion: the long motion.
        points: of a flight.
    """
    begin, stop = motion.departure_time_us[:-1, None], motion.arrival_time_us[1:, None]
    times = begin + (stop - begin) * np.linspace(0.0, 1.0, points)
    position, velocity = (
        jnp.asarray(p)[:-1, None] for p in (motion.departure_position_nm, motion.departure_velocity_nm_per_us)
    )
    heights, _ = motion.scene.cantilever.propagator(times - begin)(position, velocity)
    return np.stack([times.reshape(-1), np.asarray(heights).reshape(-1)])


def _departures(piece: Simulation) -> Float[np.ndarray, "columns contacts"]:
    """Return arrival time, approach speed, departure time, position and velocity of the contacts that the tip left."""
    rows = piece.contacts
    left = np.asarray(rows.kind) == ContactKind.IMPACT
    wanted = (
        rows.arrival_time_us,
        rows.approach_speed_nm_per_us,
        rows.departure_time_us,
        rows.departure_position_nm,
        rows.departure_velocity_nm_per_us,
    )
    return np.stack([np.asarray(column)[left] for column in wanted])


def _reached(piece: Simulation) -> float:
    return float(piece.final.time_us)


def _joined(scene: Scene, pieces: tuple[Simulation, ...], columns: Float[np.ndarray, "columns contacts"]) -> LongMotion:
    arrival, approach, departure, position, velocity = columns
    last = pieces[-1]
    outcome = MotionOutcome(int(last.outcome))
    full = outcome == MotionOutcome.CONTACT_LIMIT
    # beyond the last departure of a full piece nothing is kept
    end = float(departure[-1]) if full else _reached(last)
    kind = np.asarray(last.contacts.kind)
    began = np.asarray(last.contacts.arrival_time_us)[kind == ContactKind.HELD]
    held = bool(began.size) and end - float(began[0]) > _HELD_PERIODS * float(scene.platform.period_us)
    stops = np.concatenate([arrival[1:], began])
    peaks = np.full(departure.shape, np.nan)
    whole = min(stops.size, departure.size)
    if whole:
        peaks[:whole] = peaks_of_flights(scene, departure[:whole], position[:whole], velocity[:whole], stops[:whole])
    return LongMotion(
        scene=scene,
        pieces=pieces,
        arrival_time_us=arrival,
        approach_speed_nm_per_us=approach,
        departure_time_us=departure,
        departure_position_nm=position,
        departure_velocity_nm_per_us=velocity,
        peak_height_nm=peaks,
        end_us=end,
        held_from_us=float(began[0]) if held else None,
        outcome=outcome,
    )
