"""Orbits with sticking phases: complete chatter, rest, release. Where the scene lets a tip go, and what comes of it.

Where the surface lets a resting tip go depends on the scene alone, so that nothing has to be solved: the orbit is what
becomes of the released tip, if it comes to rest again. Followed through a parameter it ends where the rest does, or
where a flight grazes and what follows is another motion.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from afm_jax.apparatus.scene import Scene, drive_of
from afm_jax.apparatus.surface import surface_of
from afm_jax.checks import require_float64
from afm_jax.dynamics.continuation import Continuation
from afm_jax.dynamics.curves import family_of
from afm_jax.dynamics.impact_loop import LoopReading, driven_part
from afm_jax.dynamics.special_points import OrbitBranch, SpecialPoint
from afm_jax.impact.law import impact_law_of
from afm_jax.motion.law_motion import Bed, first_release, take_off
from afm_jax.motion.observe import peaks_of_flights
from afm_jax.motion.record import ContactKind, to_lab
from afm_jax.motion.simulate import simulate
from afm_jax.scenefile.parameter_paths import ParameterRange, check_ranges, scene_family
from afm_jax.solve.derivatives import bracketed_root
from afm_jax.solve.lanes import Report, filled
from afm_jax.units import within_turn

_MOST_RESTS = 32
_FLIGHTS = 64
_LONGEST = 64
"""Drive periods after which a flight that has not come to rest counts as one that never does."""
_NARROWED = 1e-10
"""Of the range."""
_SHORT_REST = 0.05
"""Of a drive period: a rest that is shorter where the orbit ends has come to nothing there."""
_SHORT_FLIGHT = 1e-6
"""Of the range: where the orbit is lost so close to where the surface no longer lets go, this is why."""
_NO_TEST = -1


class StickingOrbit(NamedTuple):
    """A motion that repeats with a rest on the surface in it: infinitely many ever smaller impacts, rest, release.

    A small disturbance is forgotten in the rest: both multipliers are 0, and it is stable.
    """

    order: int
    """N, drive periods until the motion repeats."""
    rests: int
    """Rests in them."""
    release_phase_rad: float
    """Drive phase at which the surface lets the tip go; of the first rest."""
    rest_us: float
    """From the last impact followed to the release, in a response period."""
    impacts: int
    """Impacts followed one by one; those summed up as chatter not counted."""
    peak_amplitude_nm: float


def sticking_orbit(scene: Scene) -> StickingOrbit | str:
    """Return the orbit with a rest that a tip at rest ends up on, or a sentence on why there is none.

    Args:
        scene: one scene with an `ImpactLaw`, driven with one period.

    Raises:
        RuntimeError: if JAX is not set to 64-bit floats.
        TypeError: if the scene's interaction is not an impact law.
        ValueError: if the drive does not repeat.
    """
    require_float64(scene)
    law, period = impact_law_of(scene), drive_of(scene).period_us
    driven_part(scene)
    if bool(law.adheres) or law.delay is not None:
        return "with adhesion or a delay a tip that comes to rest stays"
    surface, response = surface_of(scene)
    bed = Bed(scene.cantilever, surface)
    times = period * jnp.arange(256.0) / 256.0
    push = np.asarray(jax.vmap(bed.push)(times))
    if push.min() >= 0.0 or push.max() <= 0.0:
        return f"the surface {'never lets go' if push.min() >= 0.0 else 'never presses'} a tip that rests on it"
    release = float(first_release(bed, times[int(np.argmax(push))], times[-1] + 2.0 * period).time_us)
    first, resting, impacts, peak = release, 0.0, 0, -np.inf
    for rests in range(1, _MOST_RESTS + 1):
        until = jnp.asarray(release + _LONGEST * period)
        leg = take_off(bed, jnp.asarray(release), until)
        gap_rate = leg[2] - surface.velocity(leg[0])
        start = to_lab(surface, response, leg[0], leg[1], gap_rate)
        rows = simulate(scene, start, _LONGEST * period).contacts
        kind, arrival, rebound = (
            np.asarray(p) for p in (rows.kind, rows.arrival_time_us, rows.rebound_speed_nm_per_us)
        )
        departed = rows.departure_time_us, rows.departure_position_nm, rows.departure_velocity_nm_per_us
        rested = np.flatnonzero((kind == ContactKind.CHATTER) | ((kind == ContactKind.IMPACT) & (rebound == 0.0)))
        if not rested.size:
            return f"a tip that is let go does not come to rest again within {_LONGEST} drive periods"
        row = int(rested[0])
        again = float(departed[0][row])
        impacts += row
        resting += again - float(arrival[row])
        lands = slice(0, row + 1)
        begins = [
            np.append(np.asarray(part), np.asarray(column)[:row]) for part, column in zip(start, departed, strict=True)
        ]
        # filled up, so that few programs are compiled
        flights = [filled(part, len(part) + -len(part) % _FLIGHTS) for part in (*begins, arrival[lands])]
        peak = max(peak, float(peaks_of_flights(scene, *flights).max()))
        apart = (again - first) / period
        if abs(apart - round(apart)) < 1e-6:
            omega = drive_of(scene).angular_frequency
            return StickingOrbit(round(apart), rests, within_turn(first * omega, 2.0 * np.pi), resting, impacts, peak)
        release = again
    return f"a tip that is let go does not repeat itself within {_MOST_RESTS} rests"


def follow_sticking(
    scene: Scene, order: int, given: ParameterRange, *, values: int = 65, report: Report | None = None
) -> Continuation:
    """Follow the orbit with rests on the surface through a parameter.

    Args:
        scene: one scene with an `ImpactLaw`, driven with one period.
        order: N, drive periods in which the orbit repeats.
        given: the parameter and its range.
        values: at which the orbit is looked for, before the ends of where it exists are narrowed.
        report: told how many of how many values are done.

    Returns:
        Branches between the values where the orbit begins and ends, located to 1e-10 of the range. Their special points
        are ``rest_lost``, where the rest shrinks to nothing, ``held``, where the surface no longer lets go, and
        ``grazing``, where a flight touches the surface and another motion follows. Multipliers are 0: the rest forgets
        what was before.

    Raises:
        RuntimeError: if JAX is not set to 64-bit floats.
        TypeError: if the scene's interaction is not an impact law.
        ValueError: if the drive does not repeat, or the parameter or its range is none of the scene's.
    """
    require_float64(scene)
    impact_law_of(scene)
    check_ranges(scene, given)
    family, width = scene_family(scene, given.path), given.high - given.low

    def at(fraction: float) -> StickingOrbit | None:
        orbit = sticking_orbit(family(given.low + width * fraction))
        return orbit if isinstance(orbit, StickingOrbit) and orbit.order == order else None

    fractions, orbits = np.linspace(0.0, 1.0, values).tolist(), []
    for number, fraction in enumerate(fractions):
        orbits.append(at(fraction))
        if report is not None:
            report(number + 1, values)
    short = _SHORT_REST * drive_of(scene).period_us

    def least(fraction: float) -> float:
        return _least_push(family(given.low + width * fraction))

    stretches = [_ended(at, least, fractions, orbits, stretch, short) for stretch in _stretches(orbits)]
    branches, special = [], []
    for number, (points, ends) in enumerate(stretches):
        places = given.low + width * np.array([fraction for fraction, _ in points])
        readings = _readings([orbit for _, orbit in points], [family(value) for value in places])
        branches.append(OrbitBranch(places, np.zeros((len(points), 0)), readings, ends))
        for place, kind in ((0, ends[0]), (len(points) - 1, ends[1])):
            if kind != "range":
                reading = jax.tree.map(lambda part, place=place: part[place], readings)
                point = SpecialPoint(
                    kind=kind,
                    parameter=float(places[place]),
                    branch=number,
                    position=float(place),
                    admissible=True,
                    unknowns=np.zeros(0),
                    reading=reading,
                    test=_NO_TEST,
                )
                special.append(point)
    of_range = family_of(scene, order, (given,), driven_part(scene))
    return Continuation(order, 0, given, None, tuple(branches), tuple(special), (), 0, of_range, sticking=True)


_At = Callable[[float], StickingOrbit | None]
_OrbitThere = tuple[float, StickingOrbit]


def _rests(orbit: StickingOrbit | None) -> int:
    return 0 if orbit is None else orbit.rests


def _stretches(orbits: list[StickingOrbit | None]) -> list[range]:
    """Return where neighbours have an orbit with as many rests."""
    cuts = [k for k in range(1, len(orbits)) if _rests(orbits[k]) != _rests(orbits[k - 1])]
    pairs = zip([0, *cuts], [*cuts, len(orbits)], strict=True)
    return [range(*pair) for pair in pairs if _rests(orbits[pair[0]])]


def _least_push(scene: Scene) -> float:
    """Return the least push of the surface on a tip that rests on it, a constant and a cosine of the drive's period."""
    turns = np.arange(8) / 8.0
    bed = Bed(scene.cantilever, surface_of(scene)[0])
    push = np.asarray(jax.vmap(bed.push)(drive_of(scene).period_us * jnp.asarray(turns)))
    return float(push.mean() - 2.0 * np.abs(np.mean(push * np.exp(2j * np.pi * turns))))


def _ended(
    at: _At,
    least: Callable[[float], float],
    fractions: list[float],
    orbits: list[StickingOrbit | None],
    stretch: range,
    short_us: float,
) -> tuple[list[_OrbitThere], tuple[str, str]]:
    """Return the points of a stretch with its narrowed ends, and why it ends there."""
    points = [(fractions[k], orbit) for k in stretch if (orbit := orbits[k]) is not None]
    ends = []
    for last, beyond in ((0, stretch[0] - 1), (-1, stretch[-1] + 1)):
        if not 0 <= beyond < len(fractions):
            ends.append("range")
            continue
        end, kind = _narrowed(at, points[last], fractions[beyond]), None
        if least(end[0]) < 0.0 <= least(fractions[beyond]):
            # shortly before, the flight is too short to be flown
            held = bracketed_root(least, end[0], fractions[beyond], tolerance=1e-14)
            if abs(held - end[0]) < _SHORT_FLIGHT:
                end, kind = (held, end[1]), "held"
        if end[0] != points[last][0]:
            points = [end, *points] if last == 0 else [*points, end]
        ends.append(kind or ("rest_lost" if end[1].rest_us < short_us else "grazing"))
    return points, (ends[0], ends[1])


def _narrowed(at: _At, inside: _OrbitThere, outside: float) -> _OrbitThere:
    """Return the last point on the inner side of an end of the orbit."""
    while abs(outside - inside[0]) > _NARROWED:
        middle = 0.5 * (inside[0] + outside)
        orbit = at(middle)
        if orbit is not None and orbit.rests == inside[1].rests:
            inside = middle, orbit
        else:
            outside = middle
    return inside


def _readings(orbits: list[StickingOrbit], scenes: list[Scene]) -> LoopReading:
    """Return what there is to know of the orbits; in place of an impact stands the release."""
    rows = []
    for orbit, scene in zip(orbits, scenes, strict=True):
        surface, response = surface_of(scene)
        time = orbit.release_phase_rad / drive_of(scene).angular_frequency
        velocity = float(to_lab(surface, response, time, 0.0, 0.0).velocity_nm_per_us)
        nothing, moves = jnp.zeros(1), jnp.asarray([velocity])
        row = LoopReading(
            phase_rad=jnp.asarray([orbit.release_phase_rad]),
            velocity_after_nm_per_us=moves,
            velocity_before_nm_per_us=moves,
            approach_speed_nm_per_us=nothing,
            rebound_speed_nm_per_us=nothing,
            delay_us=nothing,
            peak_amplitude_nm=jnp.asarray(orbit.peak_amplitude_nm),
            trace=jnp.zeros(()),
            determinant=jnp.zeros(()),
            admissible=jnp.ones((), bool),
            missing=jnp.zeros(()),
        )
        rows.append(row)
    return jax.tree.map(lambda *parts: np.stack([np.asarray(part) for part in parts]), *rows)
