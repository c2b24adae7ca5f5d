"""The closing conditions of an orbit of m impacts in N drive periods, all its flights at once, and what it is good for.

Takes a scene with a law, phases in rad and coordinates in nm/us; gives residuals, without unit, their slopes, and
readings in nm, nm/us, us (eqs. 2 to 8).

Unknowns are the drive phase at which the tip arrives at each impact and the coordinate of that impact
(`Law.speeds`), in which the law is smooth up to capture. Every flight has to end at height and velocity of the next
arrival: 2 m smooth equations, with no search for a first impact in them, that go on through folds and past a graze.
Whether the tip really makes those flights is another question, and that of the map: `flies`.

The linearised map of the whole loop is the product of its flights' and impacts' Jacobians.
"""

import abc
import math
from collections.abc import Sequence
from functools import reduce
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from afm_jax.apparatus.cantilever import Cantilever
from afm_jax.apparatus.platform import Platform
from afm_jax.apparatus.scene import Scene, drive_of
from afm_jax.apparatus.surface import Surface
from afm_jax.impact.first_impact import Flight
from afm_jax.impact.jacobian import contact_jacobian, flight_jacobian
from afm_jax.impact.lasting_impact import speeds_of_lasting_impact
from afm_jax.impact.law import Law, Speeds
from afm_jax.impact.orbits import FlightEnds, ends_at_its_own_impact, highest_of_flight
from afm_jax.scenefile.parameter_paths import ParameterRange, with_numbers
from afm_jax.solve.arclength import EquationsAt, PointInPlane
from afm_jax.solve.derivatives import largest
from afm_jax.solve.lanes import power_of_two
from afm_jax.units import within_turn

KINDS = ("fold", "period_doubling", "grazing", "capture")
FOLD, DOUBLING, GRAZING, CAPTURE = range(len(KINDS))
"""Kinds of special points, by the numbers of the test functions that are 0 there (`LoopFamily.tests`)."""


class ImpactLoop(NamedTuple):
    """What an (m, N) orbit is an orbit of: the surface is the one that the free tip sees (`surface_of`).

    The unknowns of a loop are m drive phases at the arrivals in rad, ascending, and m coordinates of the impacts
    (`Impact.speeds`) in the unit of speeds.
    """

    cantilever: Cantilever
    surface: Platform | Surface
    response: Surface | None
    impact: Law
    period_us: Float[Array, ""]
    """N drive periods."""
    angular_frequency: Float[Array, ""]
    """Of the drive, in rad/us."""
    speed_unit: Float[Array, ""]
    """Unit of the coordinates among a loop's unknowns, in nm/us."""


class Impacts(NamedTuple):
    """The impacts of a loop, each with the flight that follows it; heights and velocities against the resting tip.

    Times and durations in us, speeds in nm/us, heights in nm.
    """

    arrival_us: Float[Array, " m"]
    speeds: Speeds
    leaving_us: Float[Array, " m"]
    height: Float[Array, " m"]
    velocity: Float[Array, " m"]
    duration_us: Float[Array, " m"]


def driven_part(scene: Scene) -> str:
    """Return which part of a scene sets its period: "platform", "base" or "force".

    Raises:
        ValueError: if no motion can repeat under its drive; says why.
    """
    drive = drive_of(scene)
    if drive.aperiodic is not None:
        raise ValueError(f"there are no periodic orbits: {drive.aperiodic}")
    parts = {"base": scene.base, "force": scene.force}
    moving = [name for name, part in parts.items() if part is not None and any(float(t.amplitude) for t in part.tones)]
    return "platform" if float(scene.platform.amplitude_nm) or not moving else moving[0]


def impacts_at(unknowns: Float[Array, " n"], loop: ImpactLoop) -> Impacts:
    """Return the impacts that the unknowns of a loop stand for."""
    count = unknowns.shape[0] // 2
    omega, impact, surface = loop.angular_frequency, loop.impact, loop.surface
    arrival = unknowns[:count] / omega

    def speeds_of(time, coordinate):
        free = impact.speeds(coordinate)
        return speeds_of_lasting_impact(free, impact, time, loop.cantilever, surface) if impact.lasts else free

    speeds = jax.vmap(speeds_of)(arrival, loop.speed_unit * unknowns[count:])
    leaving = arrival + speeds.delay
    height, velocity = surface.position_and_velocity(leaving)
    following = jnp.append(arrival[1:], arrival[:1] + loop.period_us)
    return Impacts(arrival, speeds, leaving, height, velocity + speeds.rebound, following - leaving)


def closing_gaps(unknowns: Float[Array, " n"], loop: ImpactLoop) -> Float[Array, " n"]:
    """Return by how much every flight misses the next arrival: m heights times Omega, m velocities, over the unit."""
    impacts = impacts_at(unknowns, loop)
    height, velocity = loop.surface.position_and_velocity(impacts.arrival_us)
    position, speed = loop.cantilever.propagator(impacts.duration_us)(impacts.height, impacts.velocity)
    omega = loop.cantilever.angular_frequency
    missed = position - jnp.roll(height, -1)
    slower = speed - jnp.roll(velocity - impacts.speeds.approach, -1)
    return jnp.concatenate([omega * missed, slower]) / loop.speed_unit


def trace_and_determinant_of(
    unknowns: Float[Array, " n"], loop: ImpactLoop
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Return T and D of the linearised map of a closed loop; of the free motion where there is no impact in it."""
    cantilever, surface = loop.cantilever, loop.surface
    if unknowns.shape[0] == 0:
        p = cantilever.propagator(loop.period_us)
        return p.position_per_position + p.velocity_per_velocity, jnp.exp(-2.0 * cantilever.decay_rate * loop.period_us)
    impacts = impacts_at(unknowns, loop)

    def step_of_map(leaving, velocity, duration, before):
        arrival = leaving + duration
        contact = contact_jacobian(loop.impact, cantilever, surface, arrival, before)
        return contact @ flight_jacobian(cantilever, surface, leaving, velocity, arrival)

    before = surface.velocity(impacts.arrival_us) - impacts.speeds.approach
    parts = jax.vmap(step_of_map)(impacts.leaving_us, impacts.velocity, impacts.duration_us, jnp.roll(before, -1))
    return trace_and_determinant(parts)


def trace_and_determinant(maps: Float[Any, "m 2 unknowns"]) -> tuple[Any, Any]:
    """Return T and D of linearised maps one after the other, by their first two unknowns."""
    whole = reduce(lambda product, each: each[:, :2] @ product, list(maps), np.eye(2))
    # the determinant as a product of those of the parts: that of the whole cancels
    return whole[0, 0] + whole[1, 1], (maps[:, 0, 0] * maps[:, 1, 1] - maps[:, 0, 1] * maps[:, 1, 0]).prod()


def flights_of(unknowns: Float[Array, " n"], loop: ImpactLoop) -> tuple[Float[Array, " m"], ...]:
    """Return the flights of a loop as `lowest_gap` takes them; of a tip that meets nothing its rest in the frame."""
    if unknowns.shape[0] == 0:
        zero = jnp.zeros((1,))
        # more than one response period, so that the nearest approach is inside
        return zero, zero, zero, zero, 1.25 * loop.period_us[None]
    impacts = impacts_at(unknowns, loop)
    # a flight counts from max(t_in, t_out) on
    first = jnp.maximum(-impacts.speeds.delay, 0.0)
    return impacts.leaving_us, impacts.height, impacts.velocity, first, impacts.duration_us


def lowest_gap(
    cantilever: Cantilever, surface: Platform | Surface, flights: tuple[Float[Array, " m"], ...], samples: int
) -> Float[Array, ""]:
    """Return the lowest point of flights above the surface in nm, differentiable.

    It is negative where a flight would pass through the surface, and infinite where no flight has a lowest point.

    Args:
        cantilever: of the flights.
        surface: below them.
        flights: when each begins in us, height in nm and velocity in nm/us there, the time after the beginning from
            which on it counts, and its duration.
        samples: heights computed in every flight; the lowest of them is improved by Newton's method.
    """
    begin_us, height, velocity, first_us, lasts_us = flights

    def motion(start, height, velocity, after):
        position, speed = cantilever.propagator(after)(height, velocity)
        level, rate = surface.position_and_velocity(start + after)
        bend = cantilever.acceleration(position, speed) - surface.acceleration(start + after)
        return position - level, speed - rate, bend

    step = (lasts_us - first_us) / samples
    after = first_us[:, None] + step[:, None] * jnp.arange(samples + 1.0)
    gap, _, _ = motion(begin_us[:, None], height[:, None], velocity[:, None], after)
    left, middle, right = gap[:, :-2], gap[:, 1:-1], gap[:, 2:]
    lowest = (middle <= left) & (middle <= right)
    bend = right - 2.0 * middle + left
    vertex = middle - (right - left) ** 2 / (8.0 * jnp.where(bend > 0.0, bend, 1.0))
    place = jnp.argmin(jnp.where(lowest, vertex, jnp.inf))
    flight, sample = place // (samples - 1), place % (samples - 1) + 1
    start = begin_us[flight], height[flight], velocity[flight]
    guess, width = lax.stop_gradient((after[flight, sample], step[flight]))

    def improve(_, time):
        _, slope, bend = motion(*lax.stop_gradient(start), time)
        move = -slope / jnp.where(bend > 0.0, bend, jnp.inf)
        return jnp.clip(time + move, guess - width, guess + width)

    # its own change counts nothing, because the gap is lowest there
    gap, _, _ = motion(*start, lax.stop_gradient(lax.fori_loop(0, 6, improve, guess)))
    return jnp.where(lowest.any(), gap, jnp.inf)


def flies(unknowns: Float[Array, " n"], loop: ImpactLoop) -> Bool[Array, ""]:
    """Say whether every flight of a closed loop is one of the map: its first impact is the loop's next one."""
    if unknowns.shape[0] == 0:
        return -loop.surface.offset_nm >= loop.surface.reach_nm
    impacts = impacts_at(unknowns, loop)
    drive_us = 2.0 * jnp.pi / loop.angular_frequency

    def flies_freely(leaving, velocity, duration, rebound, delay):
        flight = Flight(loop.cantilever, loop.surface, leaving, velocity)
        skip = jnp.maximum(-delay, 0.0) if loop.impact.delayed else None
        return (rebound > 0.0) & ends_at_its_own_impact(flight, duration, skip, drive_us)

    speeds = impacts.speeds
    free = jax.vmap(flies_freely)(
        impacts.leaving_us, impacts.velocity, impacts.duration_us, speeds.rebound, speeds.delay
    )
    return jnp.all(free) & jnp.all(speeds.approach > 0.0)


def highest_point(unknowns: Float[Array, " n"], loop: ImpactLoop, samples: int) -> Array:
    """Return the largest height of the tip above its rest position, in nm."""
    return highest_of_flights(loop.cantilever, loop.response, flights_of(unknowns, loop), samples)


def highest_of_flights(
    cantilever: Cantilever, response: Surface | None, flights: tuple[Float[Array, " m"], ...], samples: int
) -> Float[Array, ""]:
    """Return the largest height of flights in nm in the lab; arguments as of `lowest_gap` and `highest_of_flight`."""
    begin_us, height, velocity, _, lasts_us = flights
    ends = FlightEnds(begin_us, lasts_us, height, velocity, *cantilever.propagator(lasts_us)(height, velocity))
    return largest(jax.vmap(lambda flight: highest_of_flight(cantilever, flight, response, samples))(ends))


def rolled_states(loop: Float[np.ndarray, " n"]) -> Float[np.ndarray, "shifts 3 m"]:
    """Return the impacts of a loop in turn, begun with each of them: cosine and sine of the phase, speed."""
    phases, speeds = np.split(loop, 2)
    state = np.stack([np.cos(phases), np.sin(phases), speeds])
    return np.stack([np.roll(state, -shift, axis=1) for shift in range(max(len(phases), 1))])


class LoopReading(eqx.Module):
    """What there is to know of a closed loop; the first six have a number for each impact.

    Attributes:
        phase_rad: drive phase just after each impact, in [0, 2 pi).
        velocity_after_nm_per_us: tip velocity in the lab just after.
        velocity_before_nm_per_us: just before.
        approach_speed_nm_per_us: relative to the surface.
        rebound_speed_nm_per_us: relative to the surface.
        delay_us: collision delay.
        peak_amplitude_nm: largest height above the rest position.
        trace: T of the linearised map.
        determinant: D of it.
        admissible: every flight is one of the map.
        missing: by how much the loop does not close, of its speeds.
    """

    phase_rad: Float[Array, "*loops m"]
    velocity_after_nm_per_us: Float[Array, "*loops m"]
    velocity_before_nm_per_us: Float[Array, "*loops m"]
    approach_speed_nm_per_us: Float[Array, "*loops m"]
    rebound_speed_nm_per_us: Float[Array, "*loops m"]
    delay_us: Float[Array, "*loops m"]
    peak_amplitude_nm: Float[Array, "*loops"]
    trace: Float[Array, "*loops"]
    determinant: Float[Array, "*loops"]
    admissible: Bool[Array, "*loops"]
    missing: Float[Array, "*loops"]


def reading_of(unknowns: Float[Array, " n"], loop: ImpactLoop, samples: int) -> LoopReading:
    """Return what there is to know of a closed loop.

    Args:
        unknowns: of the loop.
        loop: what it closes.
        samples: of `lowest_gap`.
    """
    trace, determinant = trace_and_determinant_of(unknowns, loop)
    impacts = impacts_at(unknowns, loop)
    after = impacts.velocity
    before = loop.surface.velocity(impacts.arrival_us) - impacts.speeds.approach
    if loop.response is not None:
        after = after + loop.response.velocity(impacts.leaving_us)
        before = before + loop.response.velocity(impacts.arrival_us)
    return LoopReading(
        phase_rad=within_turn(impacts.leaving_us * loop.angular_frequency, 2.0 * jnp.pi),
        velocity_after_nm_per_us=after,
        velocity_before_nm_per_us=before,
        approach_speed_nm_per_us=impacts.speeds.approach,
        rebound_speed_nm_per_us=impacts.speeds.rebound,
        delay_us=impacts.speeds.delay,
        peak_amplitude_nm=highest_point(unknowns, loop, samples),
        trace=trace,
        determinant=determinant,
        admissible=flies(unknowns, loop),
        missing=jnp.max(jnp.abs(closing_gaps(unknowns, loop)), initial=0.0),
    )


class LoopFamily(eqx.Module):
    """Closed loops of a scene whose parameters move: what is solved along a curve of them, and in which units.

    Loops of laws (`LawLoops`) and of simulated contacts (`ContactLoops`) differ in its methods. What is static
    makes a program of its own.
    """

    scene: Scene
    order: Float[Array, ""]
    """N."""
    speed_unit: Float[Array, ""]
    """Unit of a loop's speeds or coordinates in nm/us."""
    low: Float[Array, " parameters"]
    """Lower ends of the parameters' ranges."""
    width: Float[Array, " parameters"]
    """Widths of the ranges: parameters count as fractions of them."""
    paths: tuple[str, ...] = eqx.field(static=True)
    """Of the parameters that move."""
    driven: str = eqx.field(static=True)
    """The part of the scene that sets the period (`driven_part`)."""
    samples: int = eqx.field(static=True)
    """Heights at which every flight is evaluated for its lowest point: a power of 2."""
    test: int | None = eqx.field(static=True, default=None)
    """Number of the test function that is 0 besides; None: none is."""

    @classmethod
    def of(cls, scene: Scene, order: int, ranges: Sequence[ParameterRange] = ()) -> Any:
        """Return the loops of one scene in N drive periods, over the ranges of some parameters; the unit is 1 nm/us.

        Raises:
            ValueError: if no motion can repeat under the scene's drive.
        """
        low, high = (jnp.asarray([getattr(given, end) for given in ranges], float) for end in ("low", "high"))
        paths, driven = tuple(given.path for given in ranges), driven_part(scene)
        ratio = float(scene.cantilever.frequency_khz) / float(getattr(scene, driven).frequency_khz)
        # for every period of the faster of drive and tip
        heights = power_of_two(math.ceil(32 * order * max(1.0, ratio)), 64)
        numbers = scene, jnp.asarray(float(order)), jnp.ones(()), low, high - low, paths, driven
        return cls(*numbers, min(4096, heights))

    @abc.abstractmethod
    def found(self, values: Float[np.ndarray, " parameters"], impacts: int) -> Float[np.ndarray, "loops n"]:
        """Return the loops of m impacts that a search finds and that the map flies, in rad and nm/us.

        Args:
            values: of the parameters.
            impacts: m.
        """

    @abc.abstractmethod
    def linearised(self, point: Float[np.ndarray, " n"]) -> EquationsAt | None:
        """Return the closing conditions and the wanted test function at a point of a curve; None: it has no value.

        Args:
            point: m phases in rad, m speeds in the unit of speeds, the parameters as fractions of their ranges.
        """

    @abc.abstractmethod
    def tests(self, solved: PointInPlane) -> tuple[Float[np.ndarray, " kinds"], float]:
        """Return the test functions at a point of a curve, and the longest delay of an impact in drive periods.

        Without dimension, in the order of `KINDS`:

            fold             1 - T + D; on curves in one parameter the tangent's component along it counts instead
            period_doubling  1 + T + D, a multiplier -1
            grazing          the lowest point of a flight above the surface
            capture          the distance of the slowest impact from capture; without adhesion its speed
        """

    @abc.abstractmethod
    def readings(self, points: Float[np.ndarray, "points n"]) -> LoopReading:
        """Return the readings of the orbits at points of a curve, NumPy arrays."""

    def captures_nothing(self, point: Float[np.ndarray, " n"]) -> bool:  # noqa: ARG002
        """Say whether impacts at a point of a curve are of a law without adhesion, which any speed leaves."""
        return False

    def scene_at(self, values: Any) -> Scene:
        """Return the scene where the parameters have some values, which may be traced."""
        return with_numbers(self.scene, dict(zip(self.paths, values, strict=True)))

    def units(self, impacts: int) -> Float[np.ndarray, " n"]:
        """Return the units of a loop's unknowns: m phases in rad, m speeds or coordinates in nm/us."""
        return np.repeat([1.0, float(self.speed_unit)], impacts)

    def loops_and_values(self, points: Float[np.ndarray, "points n"]) -> tuple[np.ndarray, np.ndarray]:
        """Return the loops in rad and nm/us, and the values of the parameters, at points of a curve."""
        count = points.shape[1] - len(self.low)
        values = np.asarray(self.low) + np.asarray(self.width) * points[:, count:]
        return points[:, :count] * self.units(count // 2), values
