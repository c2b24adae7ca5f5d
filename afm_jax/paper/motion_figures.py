"""The data of the paper's figures 8, 10 and 11, motions of the contact model, with what it says of them checked.

Figure 8 is the Poincare section of several starts, told apart into what is broadband and what locks to the drive;
figures 10 and 11 are settled motions under a slowly rising offset, beside the orbits of the impact law.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from afm_jax.apparatus.scene import Scene
from afm_jax.contact.law_of_contact import law_of_contact
from afm_jax.impact.orbits import single_impact_orbits
from afm_jax.motion.follow import follow_long
from afm_jax.motion.record import ContactKind, Simulation, State
from afm_jax.motion.section import Departures, departures
from afm_jax.motion.simulate import simulate
from afm_jax.motion.start import default_start, start_of
from afm_jax.paper.charts import PaperFigure, Statement
from afm_jax.scenefile import presets

CONTACTS_OF_A_PIECE = 400
_SETTLING_PERIODS = 250.0
"""Drive periods at the first offset; hundreds of us, several decay times of a free vibration (141 us)."""


Report = Callable[[str], object]


class Ramp(NamedTuple):
    """A motion whose offset rises steadily."""

    rate_nm_per_us: float
    motion: Departures
    offset_nm: Float[np.ndarray, " contacts"]
    """Of the platform, at each departure."""
    law_peak_nm: Float[np.ndarray, " contacts"]
    """Peak height of the stable (1,1) orbit of the impact law with delay at these offsets; NaN where there is none."""

    def offset_at(self, time_us: float) -> float:
        """Return the offset in nm at a time."""
        platform = self.motion.scene.platform
        return float(platform.offset_nm + platform.offset_rate_nm_per_us * time_us)


def slow_ramps(
    scene_of: Callable[..., Scene], ramps: tuple[tuple[float, float], ...], *, report: Report = lambda _: None
) -> tuple[float, list[Ramp]]:
    """Settle a scene at its first offset, then raise the offset at several rates.

    Args:
        scene_of: the scene of an offset in nm and a rate in nm/us; without them at its first offset.
        ramps: rate in nm/us and last offset in nm of each.
        report: told how far it is.

    Returns:
        The settled peak height in nm at the first offset, and the ramps.
    """
    still = scene_of()
    period, first = float(still.platform.period_us), float(still.platform.offset_nm)
    begin = default_start(still)
    until = float(begin.time_us) + _SETTLING_PERIODS * period
    settled = _followed(still, begin, until, report, f"settling at {first:g} nm")
    # the drive does not change under a shift by whole periods
    time = float(settled.departure_time_us[-1])
    start = State(
        *(
            jnp.asarray(value)
            for value in (
                time % period,
                settled.departure_position_nm[-1],
                settled.departure_velocity_nm_per_us[-1],
            )
        )
    )
    found = []
    for rate, last in ramps:
        scene = scene_of(first - rate * float(start.time_us), rate)
        until = float(start.time_us) + (last - first) / rate
        motion = _followed(scene, start, until, report, f"ramp of {rate:g} nm/us")
        offset = first + rate * (motion.departure_time_us - float(start.time_us))
        found.append(Ramp(rate, motion, offset, law_peaks(still, offset)))
    return float(settled.peak_height_nm[np.isfinite(settled.peak_height_nm)][-1]), found


def _followed(scene: Scene, start: State, until_us: float, report: Report, what: str) -> Departures:
    """Return a motion followed to a time."""
    run = follow_long(
        scene,
        start,
        until_us - float(start.time_us),
        piece_contacts=CONTACTS_OF_A_PIECE,
        report=told_of_progress(report, what, until_us),
    )
    return departures(scene, run.simulation)


def told_of_progress(report: Report, what: str, until_us: float) -> Callable[[float, int], None]:
    """Return a report of time and contacts that says in words how far a motion is."""

    def told(time_us: float, contacts: int) -> None:
        _ = report(f"{what}: {contacts} contacts, {100.0 * min(1.0, time_us / until_us):.0f} % of the time")

    return told


def law_peaks(scene: Scene, offset_nm: Float[np.ndarray, " offsets"]) -> Float[np.ndarray, " offsets"]:
    """Return the peak heights of stable (1,1) orbits of the law with delay closest to a scene's contact.

    Args:
        scene: the scene.
        offset_nm: of the platform.
    """
    law = law_of_contact(scene.interaction, float(scene.cantilever.mass_ng))
    if law is None:
        return np.full(offset_nm.shape, np.nan)
    ideal = eqx.tree_at(lambda s: s.interaction, scene, law, is_leaf=lambda node: node is scene.interaction)

    @jax.jit
    @jax.vmap
    def peak(offset):
        orbits = single_impact_orbits(eqx.tree_at(lambda s: s.platform.offset_nm, ideal, offset), 1.0)
        good = orbits.exists & orbits.admissible & orbits.stable
        return jnp.max(jnp.where(good, orbits.peak_amplitude_nm, -jnp.inf))

    heights = np.asarray(peak(jnp.asarray(offset_nm)))
    return np.where(np.isfinite(heights), heights, np.nan)


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


class RampCourse(NamedTuple):
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


def survey(velocities: tuple[float, ...], *, report: Report = lambda _: None) -> list[RampCourse]:
    """Follow figure 8's scene from several starts, each until it locks.

    Args:
        velocities: of the starts, in nm/us, all at drive phase 270 degrees and 5 nm above the platform.
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
            _UNTIL_US - float(start.time_us),
            enough=lambda motion: _has_come_to_rest(motion, period),
            piece_contacts=CONTACTS_OF_A_PIECE,
            report=told_of_progress(report, f"from {velocity:g} nm/us", _UNTIL_US),
        )
        motion = departures(scene, run.simulation)
        courses.append(RampCourse(velocity, motion, *locked_from(motion.departure_time_us, period)))
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


def tangent_growth(course: RampCourse) -> Growth:
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


BROADBAND_CONTACTS = 400
BROADBAND_NM = (3.0, 110.0)
BAND_NM = 39.0
RISE_NM = (51.0, 150.0)


def section_statements(courses: Sequence[RampCourse], attractor: RampCourse, growth: Growth | None) -> list[Statement]:
    """Figure 8: a long broadband motion without capture, and the band in which it ends.

    Args:
        courses: the motions from all starts.
        attractor: the one whose end is shown.
        growth: of small distances along a broadband motion, where it was computed.
    """
    lengths = {f"{course.velocity_nm_per_us:g}": course.broadband for course in courses}
    longest = max(courses, key=lambda course: course.broadband)
    peaks = longest.motion.peak_height_nm[: longest.broadband]
    peaks = peaks[np.isfinite(peaks)]
    low, high = float(np.min(peaks, initial=np.inf)), float(np.max(peaks, initial=-np.inf))
    captured = [course.velocity_nm_per_us for course in courses if course.motion.captured]
    statements = [
        Statement(
            f"from some starts the motion is broadband, with peaks from {BROADBAND_NM[0]:g} to {BROADBAND_NM[1]:g} nm, "
            f"for at least {BROADBAND_CONTACTS} impacts, and no start ends in capture",
            longest.broadband >= BROADBAND_CONTACTS
            and low <= BROADBAND_NM[0]
            and high >= BROADBAND_NM[1]
            and not captured,
            {
                "start_nm_per_us": longest.velocity_nm_per_us,
                "starts": len(courses),
                "starts_that_are_broadband_so_long": sum(course.broadband >= BROADBAND_CONTACTS for course in courses),
                "peak_height_nm": [low, high],
                "broadband_impacts_from": lengths,
                "captured_from_nm_per_us": captured,
            },
        ),
        _band(attractor),
        _transient(courses),
    ]
    if growth is not None:
        statements.append(_growth(growth))
    return statements


def _band(course: RampCourse) -> Statement:
    end = course.motion.peak_height_nm[course.broadband :]
    end = end[np.isfinite(end)]
    last = end[-min(50, end.size) :]
    near = course.periods is not None and bool(np.all(np.abs(last - BAND_NM) < 2.0))
    numbers: dict[str, Any] = {
        "impacts_before": course.broadband,
        "drive_periods_per_impact": course.periods,
        "last_peak_heights_nm": [float(last.min()), float(last.max())] if last.size else None,
    }
    return Statement(
        f"from {course.velocity_nm_per_us:g} nm/us the motion settles into a band near {BAND_NM:g} nm around a (1,5) "
        "orbit",
        near and course.periods == 5,
        numbers,
    )


def _transient(courses: Sequence[RampCourse]) -> Statement:
    """Say what the broadband motion becomes: the paper calls it a strange attractor."""
    ends = {f"{course.velocity_nm_per_us:g}": course.periods for course in courses}
    locked = [course for course in courses if course.periods is not None]
    lengths = [course.broadband for course in locked]
    # an unlucky start may outlast the simulation: how long one stays broadband is a matter of rounding
    return Statement(
        "the broadband motion is a transient (the paper: an attractor): most starts, or all, lock to the (1,5) orbit",
        len(locked) > 0.5 * len(courses) and all(course.periods == 5 for course in locked),
        {
            "drive_periods_per_impact_at_the_end_from": ends,
            "locked_share": len(locked) / len(courses),
            "broadband_impacts_before": [min(lengths), max(lengths)] if lengths else None,
        },
    )


def _growth(growth: Growth) -> Statement:
    exponent = float(growth.exponent[-1])
    half = float(growth.exponent[growth.exponent.size // 2])
    return Statement(
        "while it lasts, small distances grow from impact to impact: transient chaos",
        exponent > 5.0 * growth.error and abs(half - exponent) < 0.2 * exponent,
        {
            "growth_exponent_per_impact": exponent,
            "standard_error": growth.error,
            "after_half_of_the_impacts": half,
            "impacts": int(growth.contacts[-1]),
        },
    )


def sticking_statements(settled_nm: float, ramps: Sequence[Ramp]) -> list[Statement]:
    """Figure 10: the amplitude falls with the offset, then the tip sticks.

    Args:
        settled_nm: peak height before the ramp.
        ramps: slow ramps.
    """
    falls, sticks = [], []
    numbers: dict[str, Any] = {"settled_peak_nm": settled_nm}
    for ramp in ramps:
        peaks, offset = _peaks(ramp)
        # until the orbit is lost: its last impacts are single ones, with peaks below half of the first
        half = int(np.argmax(peaks < 0.5 * settled_nm)) if np.any(peaks < 0.5 * settled_nm) else peaks.size
        before = np.append(settled_nm, peaks[:half])
        falls.append(half < peaks.size and bool(np.all(np.diff(before) < 1e-3 * settled_nm)))
        held = ramp.motion.held_from_us
        sticks.append(held is not None)
        numbers[f"at_{ramp.rate_nm_per_us:g}_nm_per_us"] = {
            "half_of_the_peak_at_offset_nm": float(offset[half]) if half < peaks.size else None,
            "sticks_at_offset_nm": None if held is None else ramp.offset_at(held),
            "followed_to_offset_nm": ramp.offset_at(ramp.motion.end_us),
            "impacts": int(peaks.size),
        }
    return [
        Statement("the amplitude falls with the offset to less than half", bool(falls) and all(falls), numbers),
        Statement("then the tip sticks, to the end of the ramp", bool(sticks) and all(sticks), numbers),
    ]


def rise_statements(settled_nm: float, ramps: Sequence[Ramp]) -> list[Statement]:
    """Figure 11: the amplitude rises from 51 to 150 nm.

    Args:
        settled_nm: peak height before the ramp.
        ramps: slow ramps, the slowest last.
    """
    slowest = ramps[-1]
    peaks, _ = _peaks(slowest)
    first, last = RISE_NM
    back = float(np.max(np.maximum.accumulate(peaks) - peaks))
    law = slowest.law_peak_nm[np.isfinite(slowest.motion.peak_height_nm)]
    fast = _peaks(ramps[0])[0]
    upper = slice(peaks.size // 2, None)
    distance = float(np.max(np.abs(peaks[upper] / law[upper] - 1.0)))
    return [
        Statement(
            f"the amplitude rises from {first:g} to {last:g} nm, within 2 %",
            bool(abs(settled_nm - first) < 0.02 * first and abs(peaks[-1] - last) < 0.02 * last)
            and back < 0.02 * settled_nm
            and not slowest.motion.captured,
            {
                "peak_nm": [settled_nm, float(peaks[-1])],
                "largest_fall_back_nm": back,
                "rate_nm_per_us": slowest.rate_nm_per_us,
            },
        ),
        Statement(
            "the amplitude follows the orbit of the impact law with delay, and lags behind it the more, the faster the "
            "ramp",
            bool(distance < 0.02 and fast[-1] < peaks[-1]),
            {
                "worst_relative_distance_in_the_upper_half": distance,
                "last_peak_nm_at_rate": {f"{ramp.rate_nm_per_us:g}": float(_peaks(ramp)[0][-1]) for ramp in ramps},
            },
        ),
    ]


def _peaks(ramp: Ramp) -> tuple[np.ndarray, np.ndarray]:
    """Return peak heights and offsets of the flights that were followed to their end."""
    whole = np.isfinite(ramp.motion.peak_height_nm)
    return ramp.motion.peak_height_nm[whole], ramp.offset_nm[whole]


SECTION_POINTS = 1000
_FALL_RAMPS = ((1e-2, 5.0), (2e-3, 0.6))
"""Rate in nm/us and last offset in nm. A held tip costs a hundred times a bouncing one: the slow ramp ends soon."""
_RISE_RAMPS = ((1e-2, 2.0), (1e-3, 2.0))


@dataclass(frozen=True)
class MotionFigure(PaperFigure):
    """Figure 8, 10 or 11, a row for every contact.

    Attributes:
        courses: the motions of figure 8.
        growth: of small distances in figure 8.
        ramps: the motions of figures 10 and 11.
    """

    courses: tuple[RampCourse, ...] = ()
    growth: Growth | None = None
    ramps: tuple[Ramp, ...] = ()


def figure8(*, coarse: bool = False, report: Report = lambda _: None) -> MotionFigure:
    """Return the Poincare section: broadband stretches of several starts, and the (1,5) orbit in which they end.

    The paper shows a strange attractor; followed longer, the broadband motion turns out to be transient chaos. How many
    impacts it lasts is a matter of rounding.

    Args:
        coarse: leave out the growth of small distances.
        report: told how far it is.
    """
    courses = survey((*SHOWN, *MORE), report=report)
    growth = None
    if not coarse:
        report("growth of small distances")
        growth = tangent_growth(max(courses, key=lambda course: course.broadband))
    attractor = next(course for course in courses if course.velocity_nm_per_us == SHOWN[-1])
    statements = section_statements(courses, attractor, growth)
    numbers: dict[str, Any] = {
        "starts_nm_per_us": [course.velocity_nm_per_us for course in courses],
        "broadband_impacts": sum(course.broadband for course in courses),
    }
    return MotionFigure(_section_columns(courses), numbers, statements, tuple(courses), growth)


def figure10(*, coarse: bool = False, report: Report = lambda _: None) -> MotionFigure:
    """Return the motion below resonance under a rising offset.

    Args:
        coarse: the fastest ramp only.
        report: told how far it is.
    """
    settled, ramps = slow_ramps(presets.figure10_scene, _FALL_RAMPS[:1] if coarse else _FALL_RAMPS, report=report)
    return _ramp_figure(settled, ramps, sticking_statements(settled, ramps))


def figure11(*, coarse: bool = False, report: Report = lambda _: None) -> MotionFigure:
    """Return the motion above resonance under a rising offset.

    Args:
        coarse: no difference; the ramps are short.
        report: told how far it is.
    """
    del coarse
    settled, ramps = slow_ramps(presets.figure11_scene, _RISE_RAMPS, report=report)
    return _ramp_figure(settled, ramps, rise_statements(settled, ramps))


def _section_columns(courses: list[RampCourse]) -> dict[str, Float[np.ndarray, " contacts"]]:
    def joined(of: Callable[[RampCourse], np.ndarray]) -> np.ndarray:
        return np.concatenate([of(course) for course in courses])

    return {
        "start_velocity_nm_per_us": joined(
            lambda course: np.full(course.motion.departure_time_us.shape, course.velocity_nm_per_us)
        ),
        "contact": joined(lambda course: np.arange(course.motion.departure_time_us.size, dtype=float)),
        "locked": joined(
            lambda course: (np.arange(course.motion.departure_time_us.size) >= course.broadband).astype(float)
        ),
        "departure_time_us": joined(lambda course: course.motion.departure_time_us),
        "drive_phase_deg": joined(lambda course: course.motion.drive_phase_deg),
        "departure_velocity_nm_per_us": joined(lambda course: course.motion.departure_velocity_nm_per_us),
        "approach_speed_nm_per_us": joined(lambda course: course.motion.approach_speed_nm_per_us),
        "peak_height_nm": joined(lambda course: course.motion.peak_height_nm),
    }


def _ramp_figure(settled: float, ramps: list[Ramp], statements: list[Statement]) -> MotionFigure:
    def joined(of: Callable[[Ramp], np.ndarray]) -> np.ndarray:
        return np.concatenate([of(ramp) for ramp in ramps])

    columns = {
        "rate_nm_per_us": joined(lambda ramp: np.full(ramp.offset_nm.shape, ramp.rate_nm_per_us)),
        "departure_time_us": joined(lambda ramp: ramp.motion.departure_time_us),
        "offset_nm": joined(lambda ramp: ramp.offset_nm),
        "drive_phase_deg": joined(lambda ramp: ramp.motion.drive_phase_deg),
        "approach_speed_nm_per_us": joined(lambda ramp: ramp.motion.approach_speed_nm_per_us),
        "departure_velocity_nm_per_us": joined(lambda ramp: ramp.motion.departure_velocity_nm_per_us),
        "peak_height_nm": joined(lambda ramp: ramp.motion.peak_height_nm),
        "law_peak_height_nm": joined(lambda ramp: ramp.law_peak_nm),
    }
    numbers: dict[str, Any] = {
        "settled_peak_nm": settled,
        "rates_nm_per_us": [ramp.rate_nm_per_us for ramp in ramps],
    }
    return MotionFigure(columns, numbers, statements, ramps=tuple(ramps))


MOTION_FIGURES: dict[str, Callable[..., MotionFigure]] = {"8": figure8, "10": figure10, "11": figure11}
"""How each figure is made."""
