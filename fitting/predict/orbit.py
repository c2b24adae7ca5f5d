"""The orbit of one row over the table of a law, what the instrument reads of it, and how both change.

The unknowns of an orbit are x = (coordinate of the impact in the law, phase of the drive at arrival in rad, delay in
us); it closes where three gaps vanish: of height, of velocity and of the delay, which depends on itself through the
platform's motion. `_evaluated` computes gaps and readings of a block of rows with their derivatives by x and by what is
local to a row (`Local`), and `_scanned` finds where orbits may be. Around these two compiled programs Newton's method
runs in NumPy (`followed`): inside a compiled loop its program would take ten times as long to compile.
"""

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from afm_jax.apparatus.cantilever import Cantilever
from afm_jax.apparatus.platform import Platform
from afm_jax.apparatus.surface import detected, height_of_free_deflection
from afm_jax.impact.closure import ClosingSystem, OrbitProblem, closure, coordinates_of_roots
from afm_jax.impact.lasting_impact import corrected, depth_of_impact, middle_of_contact
from afm_jax.impact.law import BRIDGE_NM, ImpactLaw
from afm_jax.impact.law_table import KNOTS, LawTable
from afm_jax.impact.orbits import FlightEnds, lockin, peak_amplitude
from afm_jax.solve.lanes import compiled_quickly
from afm_jax.units import RAD_PER_US_PER_KHZ

READINGS = 3
"""Peak and lock-in amplitude in nm, phase in degrees."""
BLOCK = 32
"""Rows that one call of a program takes; of instantaneous laws, which need no search, twice as many."""
_PLACES = np.linspace(0.02, KNOTS - 1.5, 4 * KNOTS)
"""Coordinates at which the closing condition is scanned."""
_CROSSINGS = 6
"""Changes of sign that are followed, the fastest ones; besides them one close pair that the scan stepped over."""
_NEAR_PAIR = 0.02
"""Closing condition below which an extremum between two points of the scan may hide a pair of roots."""
_LEAVING = 0.4
"""Fraction of the drive's period that a leaving tip may take to lose its energy: beyond, no law of impacts holds."""
_LONGEST_STEP = np.array([1.5, 0.3])
"""Longest step of Newton's method in coordinate and phase."""
_ARRIVED, _CLOSED = 1e-8, 1e-6
"""Step at which it stops, and gaps that an orbit may have."""
NEAR_FOLD = 1e-3
"""`Orbits.fold` below which an orbit is close to one."""
_NEWTON_STEPS = 14
_HEIGHTS = np.linspace(0.0, 1.0, 258)[1:-1]
"""Fractions of a flight at which its height over the platform is looked at."""


class Row(NamedTuple):
    """What is known of rows: columns of a table, of shape (rows,); ``phase_deg`` is the measured one, 0 for none.

    Arrays of NumPy outside compiled programs, of JAX and of one row inside.
    """

    order: Any
    drive_frequency_khz: Any
    drive_amplitude_nm: Any
    offset_nm: Any
    phase_deg: Any
    free: Any

    def take(self, which: Int[np.ndarray, " some"]) -> "Row":
        """Return some of the rows."""
        return Row(*(column[which] for column in self))


class Local(NamedTuple):
    """What law and instrument are for rows, of shape (rows,): derivatives are taken by all of it.

    Attributes:
        square: change of the law's w^2 in nm^2/us^2.
        late: change of its delay in us.
        hertz, lead_nm, offset_nm, lead_square: coefficients of the law (`LawTable`).
        free_frequency_khz, quality_factor: of the cantilever; infinite Q: no air damping.
        drive_calibration: true over stated amplitude of the drive.
        offset_origin_nm: what the stated offset lacks.
        tip_calibration: read over true amplitude of the tip.
        phase_zero_deg: what the instrument adds to every phase.
    """

    square: Float[Array, " rows"]
    late: Float[Array, " rows"]
    hertz: Float[Array, " rows"]
    lead_nm: Float[Array, " rows"]
    offset_nm: Float[Array, " rows"]
    lead_square: Float[Array, " rows"]
    free_frequency_khz: Float[Array, " rows"]
    quality_factor: Float[Array, " rows"]
    drive_calibration: Float[Array, " rows"]
    offset_origin_nm: Float[Array, " rows"]
    tip_calibration: Float[Array, " rows"]
    phase_zero_deg: Float[Array, " rows"]


COUNT = len(Local._fields)


def platform_and_cantilever(local: Local, row: Row, drive: str) -> tuple[Cantilever, Platform]:
    """Return what one row swings on and over: a driven tip sees the sample move by its own free amplitude."""
    cantilever = Cantilever(local.free_frequency_khz, local.quality_factor, 1.0)
    amplitude = row.drive_amplitude_nm * local.drive_calibration
    if drive != "sample":
        amplitude = amplitude / local.tip_calibration
    if drive == "base":
        ratio = row.drive_frequency_khz / local.free_frequency_khz
        amplitude = height_of_free_deflection(amplitude, ratio, local.quality_factor)
    return cantilever, Platform(amplitude, row.drive_frequency_khz, row.offset_nm + local.offset_origin_nm)


AnyLaw = LawTable | ImpactLaw
"""A table where impacts last, a formula without a delay where they do not."""


def _law(local: Local, table: AnyLaw) -> AnyLaw:
    """Return the law with the coefficients of one row."""
    if isinstance(table, ImpactLaw):
        return table
    return dataclasses.replace(
        table, hertz=local.hertz, lead_nm=local.lead_nm, offset_nm=local.offset_nm, lead_square=local.lead_square
    )


class _Turn(NamedTuple):
    """One turn of the map: gaps (height, velocity, delay), readings, and what else is known of it."""

    gaps: Float[Array, " 3"]
    readings: Float[Array, " 3"]
    state: Float[Array, " 10"]
    """u, w, flight's duration, heights and velocities at its ends, surface's rates; see `_State`."""


def _turn(x: Float[Array, " 3"], local: Local, row: Row, table: AnyLaw, drive: str) -> _Turn:
    """Follow an impact and the flight after it."""
    coordinate, phase, delay = x
    (cantilever, platform), law, order = platform_and_cantilever(local, row, drive), _law(local, table), row.order
    omega = platform.angular_frequency
    if isinstance(law, ImpactLaw):
        instant = law.speeds(coordinate)
        free = speeds = instant._replace(rebound=jnp.sqrt(instant.rebound**2 + local.square))
        middle, depth = (jnp.zeros_like(phase), jnp.zeros_like(phase)), 0.0
    else:
        free = law.speeds_with(coordinate, local.square, local.late)
        middle = middle_of_contact(cantilever, platform, phase / omega + 0.5 * delay)
        speeds = corrected(free, middle, cantilever, law)
        depth = depth_of_impact(law, speeds.approach, speeds.rebound, middle, cantilever, omega / order)
    start = phase / omega + delay
    duration = order * platform.period_us - delay
    height, rate = platform.position_and_velocity(start)
    position, velocity = cantilever.propagator(duration)(height, rate + speeds.rebound)
    flight = FlightEnds(start, duration, height, rate + speeds.rebound, position, velocity)
    landing = platform.motion(phase / omega)
    gaps = jnp.stack(
        [
            (position - landing.position) / platform.amplitude_nm,
            (velocity - landing.velocity + speeds.approach) / platform.top_speed_nm_per_us,
            omega * (speeds.delay - delay),
        ]
    )
    lock_in = lockin(cantilever, platform, flight, order, delayed=law.delayed, indentation=depth)
    readings = shown(jnp.stack([peak_amplitude(cantilever, flight), *lock_in]), local, row, platform, drive)
    pull = cantilever.acceleration(position, velocity) - landing.acceleration
    state = [speeds.approach, free.rebound, duration, *flight[2:4], pull, *middle, platform.amplitude_nm]
    return _Turn(gaps, readings, jnp.stack([*state, platform.offset_nm]))


def shown(seen: Float[Array, " 3"], local: Local, row: Row, platform: Platform, drive: str) -> Float[Array, " 3"]:
    """Return the readings of an orbit: peak and lock-in amplitude in nm, and of phases 360/N apart the measured one.

    A new reading of a table is one more entry here, in `Row` and in the tables' columns.

    Args:
        seen: peak and lock-in amplitude and phase of the orbit itself.
        local: calibration and zero of the instrument.
        row: the row.
        platform: that the tip sees.
        drive: what is driven.
    """
    peak, amplitude, angle = seen
    if drive != "sample":
        ratio = row.drive_frequency_khz / local.free_frequency_khz
        amplitude, angle = detected(
            jnp.where(row.free, 0.0, amplitude), angle, platform.amplitude_nm, ratio, local.quality_factor,
            base=drive == "base",
        )  # fmt: skip
        peak = jnp.zeros_like(peak)
    period = 360.0 / row.order
    apart = angle + local.phase_zero_deg - row.phase_deg
    angle = row.phase_deg + (apart + 0.5 * period) % period - 0.5 * period
    return jnp.stack([peak * local.tip_calibration, amplitude * local.tip_calibration, angle])


@compiled_quickly(static_argnames="drive")
def _evaluated(
    x: Float[Array, "rows 3"], local: Float[Array, "rows local"], row: Row, table: AnyLaw, drive: str
) -> tuple[Float[Array, "rows 7 all"], Float[Array, "rows 7"], Float[Array, "rows 10"]]:
    """Return gaps, readings and approach speed with derivatives by x and what is local, and the rest of the turns."""

    def one(x, local, row):
        def everything(both):
            turn = _turn(both[:3], Local(*both[3:]), row, table, drive)
            found = jnp.concatenate([turn.gaps, turn.readings, turn.state[:1]])
            return found, (found, turn.state)

        return jax.jacfwd(everything, has_aux=True)(jnp.concatenate([x, local]))

    slopes, (found, state) = jax.vmap(one)(x, local, row)
    return slopes, found, state


@compiled_quickly(static_argnames="drive")
def _scanned(
    local: Float[Array, "rows local"], row: Row, table: LawTable, drive: str
) -> tuple[Float[Array, "rows starts 3"], Bool[Array, "rows starts"]]:
    """Return x near which the closing condition of rows vanishes, the fastest first, and which of them there are."""

    def one(local, row):
        here = Local(*local)
        problem = OrbitProblem(*platform_and_cantilever(here, row, drive), _law(here, table), row.order)
        omega = problem.platform.angular_frequency

        def at(place):
            speeds, system = closure(place, problem)
            soon = jnp.abs(speeds.delay) * omega < jnp.pi
            soon &= BRIDGE_NM / speeds.rebound < _LEAVING * problem.platform.period_us
            return system.residual, _phase(system) - omega * speeds.delay, speeds.delay, soon

        value, phase, delay, soon = jax.vmap(at)(jnp.asarray(_PLACES))
        crossing = (value[:-1] * value[1:] < 0.0) & soon[:-1] & soon[1:]
        count, size = crossing.shape[0], jnp.abs(value)
        found = count - 1 - jnp.nonzero(crossing[::-1], size=_CROSSINGS, fill_value=count)[0]
        left = jnp.maximum(found, 0)
        part = value[left] / (value[left] - value[left + 1])
        places = jnp.asarray(_PLACES)
        crossed = places[left] + part * (places[left + 1] - places[left])
        same = (value[:-2] * value[1:-1] > 0.0) & (value[1:-1] * value[2:] > 0.0) & soon[1:-1]
        dip = same & (size[1:-1] < jnp.minimum(size[:-2], size[2:])) & (size[1:-1] < _NEAR_PAIR)
        lowest = jnp.argmin(jnp.where(dip, size[1:-1], jnp.inf)) + 1
        beside = jnp.stack([lowest - 1, lowest + 1])
        nearest = jnp.concatenate([jnp.where(part < 0.5, left, left + 1), beside])
        starts = jnp.stack([jnp.append(crossed, places[beside]), phase[nearest], delay[nearest]], axis=1)
        return starts, jnp.append(found >= 0, jnp.stack([dip.any()] * 2)) & jnp.isfinite(starts).all(axis=1)

    return jax.vmap(one)(local, row)


@compiled_quickly(static_argnames="drive")
def _rooted(
    local: Float[Array, "rows local"], row: Row, law: ImpactLaw, drive: str
) -> tuple[Float[Array, "rows 4 3"], Bool[Array, "rows 4"]]:
    """Return x of all orbits of rows whose impacts are instantaneous, the roots of quartics, and which there are."""

    def one(local, row):
        problem = OrbitProblem(*platform_and_cantilever(Local(*local), row, drive), law, row.order)
        roots = coordinates_of_roots(problem)

        def at(coordinate):
            system = closure(coordinate, problem).system
            return jnp.stack([coordinate, system.phase, 0.0]), system.regular

        x, regular = jax.vmap(at)(roots.coordinate)
        return x, roots.found & regular

    return jax.vmap(one)(local, row)


def _phase(system: ClosingSystem) -> Float[Array, ""]:
    """Return the direction of the phase just after impact, whether or not this is an orbit."""
    return jnp.arctan2(system.sine * system.determinant, system.cosine * system.determinant)


class Orbits(NamedTuple):
    """Orbits of rows, or where Newton's method gave up; arrays of NumPy with a first axis of rows.

    Attributes:
        x: coordinate, phase of arrival in rad, delay in us; NaN where there is none.
        closes: there is an orbit.
        steady: it is stable and does not pass through the platform; as `closes` where nobody asked.
        growing: it would be steady, but disturbances of it grow while they turn round; not where nobody asked.
        determinant: of the map's Jacobian (eq. 8): above 1 they grow.
        readings: peak, lock-in, phase, as `_shown`.
        slopes: derivatives of the readings by what is local, the orbit moving along.
        approach, rebound: of the free tip, in nm/us.
        pull, change: acceleration at mid contact in nm/us^2 and its derivative by time.
        fold: determinant of the gaps' slopes over the product of their norms, 0 at a fold; of instantaneous impacts the
            slope of the closing condition.
    """

    x: Float[np.ndarray, "rows 3"]
    closes: Bool[np.ndarray, " rows"]
    steady: Bool[np.ndarray, " rows"]
    growing: Bool[np.ndarray, " rows"]
    determinant: Float[np.ndarray, " rows"]
    readings: Float[np.ndarray, "rows 3"]
    slopes: Float[np.ndarray, "rows 3 local"]
    approach: Float[np.ndarray, " rows"]
    rebound: Float[np.ndarray, " rows"]
    pull: Float[np.ndarray, " rows"]
    change: Float[np.ndarray, " rows"]
    fold: Float[np.ndarray, " rows"]

    def take(self, which) -> "Orbits":
        """Return those of some rows."""
        return Orbits(*(column[which] for column in self))


def starts_of(
    local: Float[np.ndarray, "rows local"], row: Row, table: AnyLaw, drive: str
) -> tuple[Int[np.ndarray, " starts"], Float[np.ndarray, "starts 3"]]:
    """Return where orbits of rows may be, or where they are if impacts are instantaneous: which row, and x.

    Args:
        local: of each row, columns as `Local`; its changes of the law are not looked at.
        row: the rows.
        table: the law.
        drive: what is driven.
    """
    local = local.copy()
    local[:, :2] = 0.0
    search = _scanned if isinstance(table, LawTable) else _rooted
    x, there = _in_blocks(search, table, drive, local, row)
    which, slot = np.nonzero(there)
    return which, x[which, slot]


def _in_blocks(program, table: AnyLaw, drive: str, *trees):
    """Return what a program makes of rows, a fixed number at a time."""
    count = len(jax.tree.leaves(trees)[0])
    block = BLOCK if isinstance(table, LawTable) else 4 * BLOCK
    parts = []
    for first in range(0, count, block):
        some = np.minimum(np.arange(first, first + block), count - 1)
        part = program.outside()(*jax.tree.map(lambda column, some=some: np.asarray(column)[some], trees), table, drive)
        parts.append([np.asarray(array)[: count - first] for array in part])
    return [np.concatenate(arrays) for arrays in zip(*parts, strict=True)]


def evaluated(x: Float[np.ndarray, "rows 3"], local: Float[np.ndarray, "rows local"], row: Row, table, drive: str):
    """Return what `_evaluated` makes of any number of rows, as arrays of NumPy."""
    return _in_blocks(_evaluated, table, drive, x, local, row)


def followed(
    x: Float[np.ndarray, "rows 3"],
    local: Float[np.ndarray, "rows local"],
    row: Row,
    table: AnyLaw,
    drive: str,
    *,
    most: int = _NEWTON_STEPS,
    judge: bool = True,
) -> Orbits:
    """Return the orbits that Newton's method finds from x, with readings and their derivatives.

    Args:
        x: one start for every row; of instantaneous impacts the orbit itself.
        local: of each row, columns as `Local`.
        row: the rows; a free tip needs no orbit.
        table: the law.
        drive: what is driven.
        most: evaluations at most.
        judge: say which are steady.
    """
    x, count = x.copy(), len(x)
    slopes = np.zeros((count, 7, 3 + COUNT))
    found = np.ones((count, 7))
    state = np.zeros((count, 10))
    moving, most = np.arange(count), most if isinstance(table, LawTable) else 1
    with np.errstate(all="ignore"):
        for left in reversed(range(most)):
            some = row.take(moving)
            slopes[moving], found[moving], state[moving] = evaluated(x[moving], local[moving], some, table, drive)
            if not left:
                break
            step = -_solved(slopes[moving, :3, :3], found[moving, :3, None])[..., 0]
            step /= np.maximum(np.max(np.abs(step[:, :2]) / _LONGEST_STEP, axis=1), 1.0)[:, None]
            goes = (np.abs(step[:, :2]).max(axis=1) > _ARRIVED) & ~some.free
            moving = moving[goes]
            if not moving.size:
                break
            x[moving] += step[goes]
            x[moving, 0] = np.clip(x[moving, 0], 1e-4, KNOTS - 1.01)
        gaps = slopes[:, :3, :3]
        along = slopes[:, 3:6, 3:] - slopes[:, 3:6, :3] @ _solved(gaps, slopes[:, :3, 3:])
        along = np.where(row.free[:, None, None], slopes[:, 3:6, 3:], along)
        closes = np.isfinite(along).all(axis=(1, 2)) & (np.abs(found[:, :3]).max(axis=1) < _CLOSED)
        trace, determinant = _trace_and_determinant(slopes[:, 6, 0], gaps, state, row)
        orbits = Orbits(
            x, closes | row.free, closes | row.free, np.zeros(count, bool), determinant,
            found[:, 3:6], along, *state[:, :2].T, *state[:, 6:8].T,
            fold=np.linalg.det(gaps) / np.prod(np.linalg.norm(gaps, axis=2), axis=1),
        )  # fmt: skip
        if isinstance(table, ImpactLaw):
            orbits = orbits._replace(fold=_slope_of_closing(x, gaps, state, local))
        if judge:
            there = closes & (np.abs(trace) < np.abs(1.0 + determinant))
            some = np.flatnonzero(there)
            there[some] = _flies(x[some], state[some], local[some], row.take(some))
            orbits = orbits._replace(
                steady=(there & (np.abs(determinant) <= 1.0)) | row.free, growing=there & (determinant > 1.0)
            )
    return orbits


def _solved(
    matrix: Float[np.ndarray, "rows 3 3"], right: Float[np.ndarray, "rows 3 k"]
) -> Float[np.ndarray, "rows 3 k"]:
    """Return the solutions of linear systems; 0 where one is singular or not finite."""
    sound = np.asarray(np.isfinite(matrix).all(axis=(1, 2)) & np.isfinite(right).all(axis=(1, 2)))[:, None, None]
    safe = np.where(sound, matrix, np.eye(3)) + 1e-300 * np.eye(3)
    return np.linalg.solve(safe, np.where(sound, right, 0.0))


def _trace_and_determinant(
    faster, gaps, state, row: Row
) -> tuple[Float[np.ndarray, " rows"], Float[np.ndarray, " rows"]]:
    """Return both of the map's Jacobian (eq. 8), from the gaps' slopes.

    With the gaps g and h of one turn in position and velocity relative to the surface, and the relative acceleration a,
    the next impact is late by g/u and as fast as u - h - a g/u; T = 2 + t and D = 1 + t + d, t and d the trace and the
    determinant of the changes of both.

    ``faster``: derivative of the approach speed by the coordinate.
    """
    approach, pull, amplitude = state[:, 0], state[:, 5], state[:, 8]
    omega = RAD_PER_US_PER_KHZ * row.drive_frequency_khz
    # the delay follows the other two
    map_ = gaps[:, :2, :2] - gaps[:, :2, 2:] * gaps[:, 2:, :2] / gaps[:, 2:, 2:]
    map_ = map_ / np.stack([faster, 1.0 / omega], axis=1)[:, None]
    late = amplitude[:, None] * map_[:, 0] / approach[:, None]
    slow = -(amplitude * omega)[:, None] * map_[:, 1] - pull[:, None] * late
    trace = late[:, 1] + slow[:, 0]
    determinant = late[:, 1] * slow[:, 0] - slow[:, 1] * late[:, 0]
    return 2.0 + trace, 1.0 + trace + determinant


def _slope_of_closing(x, gaps, state, local) -> Float[np.ndarray, " rows"]:
    """Return the slope of the closing condition per relative change of the coordinate, as `closure.near_fold`."""
    frequency = RAD_PER_US_PER_KHZ * local[:, 6]
    decay = 0.5 * frequency / local[:, 7]
    kept = np.exp(-decay * state[:, 2])
    turn = np.sqrt(frequency**2 - decay**2) * state[:, 2]
    return x[:, 0] * np.linalg.det(gaps[:, :2, :2]) / (1.0 - 2.0 * kept * np.cos(turn) + kept**2)


def _flies(x, state, local, row: Row) -> Bool[np.ndarray, " rows"]:
    """Say which flights stay above the platform, by heights at many times."""
    _, _, duration, height, velocity, *_, amplitude, offset = state.T
    begin = np.maximum(-x[:, 2], 0.0)
    time = begin[:, None] + (duration - begin)[:, None] * _HEIGHTS
    frequency = RAD_PER_US_PER_KHZ * local[:, 6]
    decay = 0.5 * frequency / local[:, 7]
    damped = np.sqrt(frequency**2 - decay**2)
    turn = damped[:, None] * time
    along = height[:, None] * np.cos(turn) + ((velocity + decay * height) / damped)[:, None] * np.sin(turn)
    omega = RAD_PER_US_PER_KHZ * row.drive_frequency_khz
    start = x[:, 1] + omega * x[:, 2]
    surface = offset[:, None] + amplitude[:, None] * np.cos(start[:, None] + omega[:, None] * time)
    return (np.exp(-decay[:, None] * time) * along > surface).all(axis=1)
