"""Figure 8: the Poincare section of several starts, told apart into what is broadband and what locks to the drive."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from afm_jax import presets
from afm_jax.motion.observe import Departures, departures
from afm_jax.motion.record import ContactKind, Simulation, State
from afm_jax.motion.settle import follow_long
from afm_jax.motion.simulate import simulate
from afm_jax.motion.start import start_of
from afm_jax.study.slow_ramps import CONTACTS_OF_A_PIECE, Report, told_of_progress

SHOWN = (40.0, 60.0, 80.0)
"""Starting velocities, in nm/us, that the figure tells apart."""
MORE = (45.0, 50.0, 55.0, 65.0, 70.0, 75.0, 90.0, 100.0, 110.0)
"""More starts: how long one stays broadband is a matter of rounding, and so differs between machines; of many it does
not depend on luck."""
_UNTIL_US = 8000.0
_RESTED_CONTACTS = 200
"""Contacts after locking in which a motion comes close to its orbit."""
_LOCKED_CONTACTS = 50
_LOCKED_WITHIN = 0.25
"""Of a drive period: how far flights may be off whole periods."""


class Course(NamedTuple):
    """The motion from one start."""

    velocity_nm_per_us: float
    """Of the start."""
    motion: Departures
    broadband: int
    """Contacts before the motion locks; all where it does not."""
    periods: int | None
    """N, drive periods from contact to contact once locked."""


class Growth(NamedTuple):
    """How a small distance grows along a motion."""

    contacts: Float[np.ndarray, " contacts"]
    exponent: Float[np.ndarray, " contacts"]
    """Mean growth exponent per contact, up to each contact."""
    error: float
    """Of the last one: from the scatter of blocks of contacts."""


def survey(
    velocities: tuple[float, ...], *, until_us: float = _UNTIL_US, report: Report = lambda _: None
) -> list[Course]:
    """Follow figure 8's scene from several starts, each until it locks.

    Args:
        velocities: of the starts, in nm/us, all at drive phase 270 degrees and 5 nm above the platform.
        until_us: longest time to follow one.
        report: told how far it is.
    """
    scene = presets.figure8_scene()
    period = float(scene.platform.period_us)
    courses = []
    for velocity in velocities:
        start = start_of(scene, presets.figure8_start(velocity))
        run = follow_long(
            scene,
            start,
            until_us - float(start.time_us),
            enough=lambda motion: _has_come_to_rest(motion, period),
            piece_contacts=CONTACTS_OF_A_PIECE,
            report=told_of_progress(report, f"from {velocity:g} nm/us", until_us),
        )
        motion = departures(scene, run.simulation)
        courses.append(Course(velocity, motion, *locked_from(motion.departure_time_us, period)))
    return courses


def _has_come_to_rest(motion: Simulation, period_us: float) -> bool:
    """Say whether a motion has been locked for so long that its orbit is seen."""
    rows = motion.contacts
    times_us = np.asarray(rows.departure_time_us)[np.asarray(rows.kind) == ContactKind.IMPACT]
    before, periods = locked_from(times_us, period_us)
    return periods is not None and times_us.size - before >= _RESTED_CONTACTS


def locked_from(times_us: Float[np.ndarray, " contacts"], period_us: float) -> tuple[int, int | None]:
    """Return after how many contacts all that follow, at least fifty, come the same number of drive periods apart.

    Args:
        times_us: departures in order.
        period_us: of the drive.

    Returns:
        The number of contacts before that and N; all contacts and None where the motion does not lock.
    """
    apart = np.diff(times_us) / period_us
    if apart.size < _LOCKED_CONTACTS:
        return times_us.size, None
    periods = round(float(np.median(apart[-_LOCKED_CONTACTS:])))
    off = np.flatnonzero(np.abs(apart - periods) > _LOCKED_WITHIN)
    first = int(off[-1]) + 1 if off.size else 0
    if periods < 1 or times_us.size - first <= _LOCKED_CONTACTS:
        return times_us.size, None
    return first, periods


def tangent_growth(course: Course) -> Growth:
    """Return how a small change of the start grows along the broadband part of a motion, by forward differentiation.

    The tangent is carried through one piece of the simulation; its size at a departure is taken from the phase of the
    drive and the rebound speed over the platform's top speed. A growth per contact does not depend on that choice in
    the long run.

    Args:
        course: the motion.
    """
    scene = course.motion.scene
    start = start_of(scene, presets.figure8_start(course.velocity_nm_per_us))
    room = min(course.broadband, CONTACTS_OF_A_PIECE)

    def departures(velocity):
        begin = State(start.time_us, start.position_nm, velocity)
        rows = simulate(scene, begin, _UNTIL_US, max_contacts=room).contacts
        return rows.departure_time_us, rows.rebound_speed_nm_per_us, rows.kind == ContactKind.IMPACT

    primals, tangents = jax.jvp(departures, (start.velocity_nm_per_us,), (jnp.ones_like(start.velocity_nm_per_us),))
    left = np.asarray(primals[2])
    omega, top = float(scene.platform.angular_frequency), float(scene.platform.top_speed_nm_per_us)
    time, speed = (np.asarray(tangent)[left] for tangent in tangents[:2])
    size = np.log(np.hypot(omega * time, speed / top))
    steps = np.diff(size)
    count = np.arange(1, steps.size + 1)
    blocks = np.array([block.mean() for block in np.array_split(steps, min(10, steps.size))])
    error = float(blocks.std(ddof=1) / np.sqrt(blocks.size))
    return Growth(count.astype(float), np.cumsum(steps) / count, error)
