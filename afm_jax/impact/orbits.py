"""Single-impact orbits, one impact in N drive periods (eq. 9): which there are, whether they last, and their readings.

Phases are in rad (drive) and degrees (readings), speeds in nm/us, amplitudes in nm, delays in us.

`single_impact_orbits` takes a scene with a law and returns every orbit of an order N. The roots of the closing
condition (`closure`) are approach speeds; `orbit_state` makes of a root the motion, the flight between two impacts;
`is_admissible` says whether the flight passes through the platform, `is_stable` judges by the map's Jacobian (eq. 8);
at the end stands what an experiment reads of the flight: peak height, lock-in amplitude and phase. Fits take the same
functions for impacts of every kind (`coordinates_of_roots`, `steady_orbits`, `readings_of`).
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, ArrayLike, Bool, Complex, Float

from afm_jax.apparatus.cantilever import Cantilever
from afm_jax.apparatus.platform import Platform
from afm_jax.apparatus.scene import Scene
from afm_jax.apparatus.surface import FreeFrame, Surface, Wave, free_frame, size_and_lag
from afm_jax.checks import as_argument, checked, is_traced, require_float64
from afm_jax.impact.closure import (
    COARSE,
    OrbitPlace,
    OrbitProblem,
    closing_residual,
    closure,
    find_roots,
    map_gaps,
    speeds_at_place,
)
from afm_jax.impact.first_impact import Flight, first_impact
from afm_jax.impact.jacobian import contact_jacobian, flight_jacobian
from afm_jax.impact.lasting_impact import crawls, depth_of_impact, middle_of_contact
from afm_jax.impact.law import Impact, ImpactLaw, Law, Speeds, TabulatedLaw, impact_law_of
from afm_jax.outcomes import Outcome
from afm_jax.results import Result, public_result
from afm_jax.solve.derivatives import absent, implicit_root, implicit_system
from afm_jax.solve.lanes import compiled_quickly
from afm_jax.solve.newton_steps import newton_steps
from afm_jax.units import within_turn

_ARRIVAL_TOLERANCE = 1e-7
"""Drive periods by which the first impact of a flight may lie before the orbit's own, by rounding."""


@public_result(picture="afm_jax.plots.dynamics:orbits_figure")
class SingleImpactOrbits(Result, eqx.Module):
    """All (1, N) orbits of a scene, ascending in approach speed, in a fixed number of slots.

    Without a collision delay there are 4 slots, as many as eq. 9 can have roots; with one there are 16. Every
    attribute has the slots' shape; where ``exists`` is False the numbers are NaN, and so are their derivatives.

    Attributes:
        exists: the slot holds a root of eq. 9 with V' > v_p > V that satisfies eq. 6 with the positive root.
        admissible: the flight does not pass through the platform on its way.
        stable: |trace| < |1 + determinant| and |determinant| <= 1 of the linearised map.
        near_double: close to a fold, where two orbits merge and derivatives diverge.
        phase_rad: drive phase omega t just after impact, in [0, 2 pi).
        velocity_after_nm_per_us: tip velocity V' in the lab just after impact.
        velocity_before_nm_per_us: tip velocity V just before.
        approach_speed_nm_per_us: u_in relative to the platform.
        rebound_speed_nm_per_us: u_out relative to the platform, as it is on the moving platform.
        delay_us: collision delay, likewise.
        peak_amplitude_nm: largest height above the rest position.
        lockin_amplitude_nm: amplitude at the response frequency omega/N.
        lockin_phase_deg: its phase, modulo 360/N; t = 0 when the platform is highest.
        trace: T of the linearised map.
        determinant: D of the linearised map.
        complete: scalar; False if there were more orbits than slots (with a delay only).
        drive_lockin_amplitude_nm: amplitude of the height at the drive's frequency omega, where every lock-in reads a
            tip that base or force drives; None where the platform alone drives, as the two that follow.
        drive_lockin_phase_deg: phase of the height at omega; t = 0 when the platform is highest.
        phase_lag_deg: by how much the height, over a moving base the deflection, lags behind base or force at omega.
        peak_deflection_nm: largest deflection z - z_b; None without a moving base, as those that follow.
        deflection_lockin_amplitude_nm: amplitude of the deflection at the response frequency omega/N.
        deflection_lockin_phase_deg: phase of the deflection at omega/N, modulo 360/N.
        deflection_drive_lockin_amplitude_nm: amplitude of the deflection at the drive's frequency omega.
        deflection_drive_lockin_phase_deg: phase of the deflection at omega.
        extrapolated: of a law that is a table: the approach speed is outside the table's; None of a formula.
    """

    exists: Bool[Array, "..."]
    admissible: Bool[Array, "..."]
    stable: Bool[Array, "..."]
    near_double: Bool[Array, "..."]
    phase_rad: Float[Array, "..."]
    velocity_after_nm_per_us: Float[Array, "..."]
    velocity_before_nm_per_us: Float[Array, "..."]
    approach_speed_nm_per_us: Float[Array, "..."]
    rebound_speed_nm_per_us: Float[Array, "..."]
    delay_us: Float[Array, "..."]
    peak_amplitude_nm: Float[Array, "..."]
    lockin_amplitude_nm: Float[Array, "..."]
    lockin_phase_deg: Float[Array, "..."]
    trace: Float[Array, "..."]
    determinant: Float[Array, "..."]
    complete: Bool[Array, "..."]
    drive_lockin_amplitude_nm: Float[Array, "..."] | None = None
    drive_lockin_phase_deg: Float[Array, "..."] | None = None
    phase_lag_deg: Float[Array, "..."] | None = None
    peak_deflection_nm: Float[Array, "..."] | None = None
    deflection_lockin_amplitude_nm: Float[Array, "..."] | None = None
    deflection_lockin_phase_deg: Float[Array, "..."] | None = None
    deflection_drive_lockin_amplitude_nm: Float[Array, "..."] | None = None
    deflection_drive_lockin_phase_deg: Float[Array, "..."] | None = None
    extrapolated: Bool[Array, "..."] | None = None


@checked
def single_impact_orbits(scene: Scene, order: ArrayLike) -> SingleImpactOrbits:
    """Return every single-impact orbit of an order (eq. 9; damped, with viscous loss and delay).

    Args:
        scene: a scene with a law (`ImpactLaw`, `TabulatedLaw`), driven by sample, base, force or several with one
            frequency, without offset ramp.
        order: N, drive periods between impacts; a positive integer, scalar.

    Returns:
        The orbits in a fixed number of slots with a mask, differentiable in the scene's parameters. Without a delay
        they are all roots of a quartic; with one, all that a scan of 8192 speeds brackets, close pairs included. With
        r = 0 there are none: every impact is a capture, `simulate` follows what becomes of the tip.

    Raises:
        RuntimeError: if JAX is not set to 64-bit floats, or was not when the scene was built.
        TypeError: if the scene's interaction is not an impact law.
        ValueError: if the order is not a positive integer, the platform's offset ramps, the drive has several
            frequencies, or an undamped cantilever is driven at its free one.
    """
    require_float64(scene)
    impact_law_of(scene)
    number = np.ones(()) if is_traced(order) else np.asarray(order)
    if number.ndim or not number >= 1.0 or number % 1.0:
        raise ValueError(f"`order` must be a positive integer, but is {order}")
    frame = free_frame(scene)
    if not is_traced(frame.periodic) and not np.all(frame.periodic):
        raise ValueError("there are no periodic orbits: the drive has several frequencies")
    rate = scene.platform.offset_rate_nm_per_us
    if not is_traced(rate) and np.any(np.asarray(rate) != 0.0):
        raise ValueError(f"`offset_rate_nm_per_us` must be 0 for a periodic orbit, but is {np.asarray(rate).flat[0]:g}")
    return _single_impact_orbits(scene, frame, jnp.asarray(order, scene.platform.frequency_khz.dtype))


@compiled_quickly()
def _single_impact_orbits(scene: Scene, frame: FreeFrame, order: Float[Array, ""]) -> SingleImpactOrbits:
    law = impact_law_of(scene)
    problem = orbit_problem(scene.cantilever, frame.platform, law, order)
    roots = find_roots(problem)
    found = roots.found & frame.periodic & law.leaves
    orbits = jax.vmap(orbit_at, in_axes=(0, 0, 0, None, None))(roots.place, found, roots.near_fold, frame, problem)
    return eqx.tree_at(lambda result: result.complete, orbits, roots.complete)


def orbit_problem(cantilever: Cantilever, platform: Platform, law: Law, order: Float[Array, ""]) -> OrbitProblem:
    """Return the problem whose roots are orbits: cantilever, platform, law and order N.

    A law with r = 0 captures every tip and has no orbits; r = 1 stands in to keep its program finite, and whoever asks
    discards the roots (`Law.leaves`).
    """
    if isinstance(law, ImpactLaw):
        law = eqx.tree_at(lambda law: law.r, law, jnp.where(law.r > 0.0, law.r, 1.0))
    return OrbitProblem(cantilever, platform, law, order)


def orbit_at(
    place: OrbitPlace, found: Bool[Array, ""], near_fold: Bool[Array, ""], frame: FreeFrame, problem: OrbitProblem
) -> SingleImpactOrbits:
    """Return one slot of `SingleImpactOrbits`: motion, verdict and readings of one root; NaN where there is none.

    Args:
        place: the root.
        found: whether it is one.
        near_fold: whether it is near-double.
        frame: of the scene.
        problem: of the frame's platform.
    """
    state = orbit_state(place, problem)
    trace, determinant = trace_and_determinant(problem.impact, problem.cantilever, problem.platform, state.flight)
    admissible = is_admissible(found, state, problem)
    # an approach that is less than the rounding of the flight's end is none
    found = found & ~jnp.isnan(trace)
    flight, speeds = state.flight, state.speeds
    velocities = jnp.stack([flight.start_velocity, flight.end_velocity])
    if frame.response is not None:
        ends = jnp.stack([flight.start_us, flight.start_us + flight.duration_us])
        velocities = velocities + _alone(frame.response).velocity(ends)
    law = problem.impact

    def known(value):
        return jnp.where(found, value, absent(value))

    return SingleImpactOrbits(
        exists=found,
        admissible=found & admissible,
        stable=found & contracts(trace, determinant),
        near_double=found & near_fold,
        phase_rad=known(within_turn(state.phase + frame.phase_rad, 2.0 * jnp.pi)),
        velocity_after_nm_per_us=known(velocities[0]),
        velocity_before_nm_per_us=known(velocities[1]),
        approach_speed_nm_per_us=known(speeds.approach),
        rebound_speed_nm_per_us=known(speeds.rebound),
        delay_us=known(speeds.delay),
        trace=known(trace),
        determinant=known(determinant),
        complete=found,
        extrapolated=found & law.extrapolated(speeds.approach) if isinstance(law, TabulatedLaw) else None,
        **{name: known(value) for name, value in _lab_readings(state, frame, problem).items()},
    )


class FlightEnds(NamedTuple):
    """A free flight between two impacts, its start and its end.

    Positions in nm, velocities in nm/us, the start's time and the duration in us.
    """

    start_us: Float[Array, ""]
    duration_us: Float[Array, ""]
    start_position: Float[Array, ""]
    start_velocity: Float[Array, ""]
    end_position: Float[Array, ""]
    end_velocity: Float[Array, ""]


class OrbitState(NamedTuple):
    """The motion at one root: drive phase in rad just after impact, speeds and delay, and the flight's ends."""

    phase: Float[Array, ""]
    speeds: Speeds
    flight: FlightEnds


class SteadyOrbits(NamedTuple):
    """The roots of a problem, which of them are steady (admissible and stable), and their readings.

    A reading is peak and lock-in amplitude in nm and the phase in degrees.
    """

    place: OrbitPlace
    steady: Bool[Array, " slots"]
    near_double: Bool[Array, " slots"]
    amplitude_nm: Float[Array, "slots 3"]


def _lab_readings(state: OrbitState, frame: FreeFrame, problem: OrbitProblem) -> dict[str, Float[Array, ""]]:
    """Return the readings of height and deflection in the lab, under the names of `SingleImpactOrbits`."""
    cantilever, order = problem.cantilever, problem.order
    peak, amplitude, angle = readings_of(state, problem)
    if frame.response is None:
        return {"peak_amplitude_nm": peak, "lockin_amplitude_nm": amplitude, "lockin_phase_deg": angle}

    free, at_drive = _phasor(amplitude, angle), _phasor(*_lockin(state, problem, at_drive=True))

    def read(motion: Wave, peak: str, of: str = "") -> dict[str, Float[Array, ""]]:
        """Return the readings of the free motion with another one added, at omega/N and at omega, and the lag."""
        wave = lax.complex(motion.cosine, -motion.sine)
        # the drive's frequency is the response's for N = 1 alone; the scene's own clock is ahead by the frame's phase
        at_response, driven = jnp.where(order == 1.0, free + wave, free), at_drive + wave
        size, behind = size_and_lag(at_response.real, at_response.imag, frame.phase_rad, order)
        drive_size, drive_behind = size_and_lag(driven.real, driven.imag, frame.phase_rad)
        return {
            peak: highest_of_flight(cantilever, state.flight, _alone(motion)),
            f"{of}lockin_amplitude_nm": size,
            f"{of}lockin_phase_deg": within_turn(-behind, 360.0 / order),
            f"{of}drive_lockin_amplitude_nm": drive_size,
            f"{of}drive_lockin_phase_deg": within_turn(-drive_behind, 360.0),
            "phase_lag_deg": size_and_lag(driven.real, driven.imag, frame.drive_phase_rad)[1],
        }

    readings = read(frame.response, "peak_amplitude_nm")
    if frame.base is not None:
        readings |= read(frame.response + -frame.base, "peak_deflection_nm", "deflection_")
    return readings


def _phasor(size: Float[Array, ""], degrees: Float[Array, ""]) -> Complex[Array, ""]:
    """Return x + i y of the motion Re((x + i y) exp(i nu t))."""
    return lax.complex(size * jnp.cos(jnp.deg2rad(degrees)), size * jnp.sin(jnp.deg2rad(degrees)))


def _alone(wave: Wave) -> Surface:
    still = jnp.zeros_like(wave.cosine)
    return Surface(still, still, (wave,))


@jax.jit
def orbit_state(place: OrbitPlace, problem: OrbitProblem) -> OrbitState:
    """Return the motion at a root, with the root's derivatives (implicit function theorem)."""
    cantilever, platform, impact, order = problem
    if impact.lasts:
        place = OrbitPlace(*implicit_system(map_gaps, jnp.stack(place), problem))
        speeds = speeds_at_place(place, problem)
        phase = place.phase + platform.angular_frequency * speeds.delay
    else:
        speeds, system = closure(implicit_root(closing_residual, place.coordinate, problem), problem)
        phase = system.phase
    phase = phase % (2.0 * jnp.pi)
    start = phase / platform.angular_frequency
    duration = order * platform.period_us - speeds.delay
    position, platform_velocity = platform.position_and_velocity(start)
    velocity = platform_velocity + speeds.rebound
    end_position, end_velocity = cantilever.propagator(duration)(position, velocity)
    return OrbitState(phase, speeds, FlightEnds(start, duration, position, velocity, end_position, end_velocity))


def is_admissible(found: Bool[Array, ""], state: OrbitState, problem: OrbitProblem) -> Bool[Array, ""]:
    """Say whether an orbit's flight does not pass through the platform on its way, and the tip leaves the bridge.

    Args:
        found: whether there is an orbit; a slot without one is not admissible.
        state: its motion.
        problem: what it is an orbit of.
    """
    cantilever, platform, impact, _ = problem
    # the flight counts from max(t_in, t_out) on
    skip = jnp.maximum(-state.speeds.delay, 0.0) if impact.delayed else None
    # an empty slot does not leave the platform, so that its search ends at once
    velocity = jnp.where(found, state.flight.start_velocity, -jnp.inf)
    flight = Flight(cantilever, platform, state.flight.start_us, velocity)
    flies = found & ends_at_its_own_impact(flight, state.flight.duration_us, skip, platform.period_us)
    if isinstance(impact, Law) and impact.delayed:
        flies = flies & ~crawls(impact, impact.at_approach(state.speeds.approach), cantilever)
    return flies


def steady_orbits(problem: OrbitProblem) -> SteadyOrbits:
    """Return the roots that are steady motions, without derivatives: what an experiment can settle on.

    A delayed closing condition is scanned coarsely: orbits close to each other or to capture may be missed.
    """
    problem = lax.stop_gradient(problem)
    roots = find_roots(problem, COARSE)

    def judged(place: OrbitPlace, found: Bool[Array, ""]) -> Any:
        state = orbit_state(place, problem)
        of_map = trace_and_determinant(problem.impact, problem.cantilever, problem.platform, state.flight)
        return is_admissible(found, state, problem) & contracts(*of_map), readings_of(state, problem)

    steady, readings = jax.vmap(judged)(roots.place, roots.found)
    return SteadyOrbits(roots.place, steady, roots.near_fold, readings)


def fastest_steady_orbit(problem: OrbitProblem) -> tuple[OrbitState, Bool[Array, ""]]:
    """Return the steady motion of the greatest approach speed, without derivatives, and whether there is one.

    The roots are those of `steady_orbits`.
    """
    orbits = steady_orbits(problem)
    states = jax.vmap(orbit_state, in_axes=(0, None))(orbits.place, lax.stop_gradient(problem))
    fastest = jnp.argmax(jnp.where(orbits.steady, states.speeds.approach, -jnp.inf))
    return jax.tree.map(lambda leaf: leaf[fastest], states), jnp.any(orbits.steady)


@jax.jit
def readings_of(state: OrbitState, problem: OrbitProblem) -> Float[Array, " 3"]:
    """Return peak and lock-in amplitude in nm and the phase in degrees of an orbit's free motion."""
    return jnp.stack([peak_amplitude(problem.cantilever, state.flight), *_lockin(state, problem)])


def _lockin(
    state: OrbitState, problem: OrbitProblem, *, at_drive: bool = False
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Return lock-in amplitude in nm and phase in degrees of the free motion, at omega/N or at the drive's omega."""
    cantilever, platform, impact, order = problem
    depth = 0.0
    if impact.lasts:
        # in contact the tip is below the platform's rest surface by the indentation
        approach, rebound, delay = state.speeds
        middle = middle_of_contact(cantilever, platform, state.flight.start_us - 0.5 * delay)
        nu = platform.angular_frequency / (1.0 if at_drive else order)
        depth = depth_of_impact(impact, approach, rebound, middle, cantilever, nu)
    ends = state.flight
    return lockin(cantilever, platform, ends, order, delayed=impact.delayed, indentation=depth, at_drive=at_drive)


def trace_and_determinant(
    impact: Impact, cantilever: Cantilever, platform: Platform, flight: FlightEnds
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Return T and D of the impact map on an orbit (eq. 8 and its generalisation)."""
    arrival = flight.start_us + flight.duration_us
    jacobian = contact_jacobian(impact, cantilever, platform, arrival, flight.end_velocity) @ flight_jacobian(
        cantilever, platform, flight.start_us, flight.start_velocity, arrival
    )
    trace = jacobian[0, 0] + jacobian[1, 1]
    return trace, jacobian[0, 0] * jacobian[1, 1] - jacobian[0, 1] * jacobian[1, 0]


def contracts(trace: Float[Array, ""], determinant: Float[Array, ""]) -> Bool[Array, ""]:
    """Say whether an orbit is stable, its linearised map of trace T and determinant D: |T| < |1 + D|, |D| <= 1."""
    return (jnp.abs(trace) < jnp.abs(1.0 + determinant)) & (jnp.abs(determinant) <= 1.0)


def ends_at_its_own_impact(
    flight: Flight, duration_us: Float[Array, ""], skip_us: Float[Array, ""] | None, drive_us: Float[Array, ""]
) -> Bool[Array, ""]:
    """Say whether the first impact of a flight is the one at its end: it never passes through the surface before.

    Args:
        flight: its beginning, over the surface that it must not meet.
        duration_us: until its own impact.
        skip_us: time after the start at which the flight begins to count, max(t_in, t_out); None: at once.
        drive_us: the drive's period.
    """
    first = first_impact(flight, skip_us=skip_us)
    hit = (first.outcome == Outcome.IMPACT) & (first.duration_us >= duration_us - _ARRIVAL_TOLERANCE * drive_us)
    # rounding can lift the end of the flight off the surface where the impact is a graze
    return (duration_us > 0.0) & (hit | (first.outcome == Outcome.NO_FURTHER_IMPACT))


_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(12)
"""Gauss's rule for the integral of the platform's height over a delay."""
SAMPLES = 512
"""Heights computed of a flight that has no closed form for its highest."""


def peak_amplitude(cantilever: Cantilever, flight: FlightEnds) -> Float[Array, ""]:
    """Return the largest height of the tip above its rest position during a flight, in nm.

    The amplitude decays, so the first turning point after the start is the highest one inside the flight:
    tan(Omega_d s) = v/((gamma v + Omega^2 z)/Omega_d).
    """
    omega_d = cantilever.damped_angular_frequency
    fall = cantilever.decay_rate * flight.start_velocity + cantilever.angular_frequency**2 * flight.start_position
    # At rest at the start (v = 0) there is nothing to turn: keep the angle's derivative finite there.
    moving = (flight.start_velocity != 0.0) | (fall != 0.0)
    angle = jnp.arctan2(jnp.where(moving, flight.start_velocity, 1.0), jnp.where(moving, fall / omega_d, 0.0))
    # A tip that starts downward turns at the bottom first; the top follows half a turn later.
    turn = jnp.where(angle > 0.0, angle, angle + 2.0 * jnp.pi) / omega_d
    top, _ = cantilever.propagator(turn)(flight.start_position, flight.start_velocity)
    ends = jnp.maximum(flight.start_position, flight.end_position)
    return jnp.where(turn < flight.duration_us, jnp.maximum(ends, top), ends)


def highest_of_flight(
    cantilever: Cantilever, flight: FlightEnds, motion: Surface | None, samples: int = SAMPLES
) -> Float[Array, ""]:
    """Return the largest height in nm during a flight, or the largest sum of the height and another motion.

    Args:
        cantilever: of the free flight.
        flight: from impact to impact.
        motion: added to it: a steady response, less a base's motion where the deflection is meant; None: nothing.
        samples: heights looked at; the highest of them is improved by Newton's method.
    """
    if motion is None:
        return peak_amplitude(cantilever, flight)

    def at(after):
        position, velocity = cantilever.propagator(after)(flight.start_position, flight.start_velocity)
        height, rate = motion.position_and_velocity(flight.start_us + after)
        bend = cantilever.acceleration(position, velocity) + motion.acceleration(flight.start_us + after)
        return position + height, velocity + rate, bend

    def rate_and_bend(after):
        _, rate, bend = at(after)
        return rate, jnp.minimum(bend, 0.0)

    step = flight.duration_us / samples
    times = step * jnp.arange(samples + 1.0)
    best = times[jnp.argmax(at(times)[0])]
    top = newton_steps(rate_and_bend, best, 5, jnp.maximum(best - step, 0.0), jnp.minimum(best + step, times[-1]))
    # its own change counts nothing, because the height is largest there
    return at(lax.stop_gradient(top))[0]


def lockin(
    cantilever: Cantilever,
    platform: Platform,
    flight: FlightEnds,
    order: ArrayLike,
    *,
    delayed: bool,
    indentation: ArrayLike = 0.0,
    at_drive: bool = False,
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Return lock-in amplitude in nm and phase in degrees of an orbit at its response frequency omega/N, or omega.

    a exp(i phi) = 2/T int z exp(-i nu t) dt over one response period T = N drive periods, z the height over rest;
    nu = omega/N and phi modulo 360/N, or with `at_drive` nu = omega and phi modulo 360. The flight's part I of the
    integral is closed: with [.] the difference of the flight's ends and e = exp(-i nu t),

        I (Omega^2 - nu^2 + i nu Omega/Q) = -[v e] - (i nu + Omega/Q) [z e].

    The rest of the period is a collision delay, in which the tip is on the platform or below it.

    Args:
        cantilever: of the flight.
        platform: drives, and carries the tip during a delay.
        flight: from impact to impact.
        order: N, drive periods between impacts.
        delayed: whether there is a delay between the flight's end and the next start.
        indentation: time integral, over the delay, of the depth below the platform, in nm us.
        at_drive: read at the drive's omega instead of omega/N.
    """
    period = as_argument(order) * platform.period_us
    turns = 1.0 if at_drive else as_argument(order)
    nu = platform.angular_frequency / turns
    loss = 2.0 * cantilever.decay_rate
    end_us = flight.start_us + flight.duration_us
    first, last = _turned_back(nu, flight.start_us), _turned_back(nu, end_us)
    # Real and imaginary parts side by side, as arrays of shape (2,).
    velocity = flight.end_velocity * last - flight.start_velocity * first
    position = flight.end_position * last - flight.start_position * first
    source = -velocity - loss * position - nu * jnp.array([-position[1], position[0]])
    real, imaginary = cantilever.angular_frequency**2 - nu**2, nu * loss
    size = real**2 + imaginary**2
    # Without damping a free flight can be exactly resonant with the response; no orbit lives there.
    size = jnp.where(size == 0.0, 1.0, size)
    integral = jnp.array([real * source[0] + imaginary * source[1], real * source[1] - imaginary * source[0]]) / size
    if delayed:
        next_start_us = flight.start_us + period
        integral = integral + _platform_integral(platform, nu, end_us, next_start_us)
        integral = integral - indentation * _turned_back(nu, 0.5 * (end_us + next_start_us))
    cosine, sine = 2.0 / period * integral
    phase = within_turn(jnp.rad2deg(jnp.arctan2(sine, cosine)), 360.0 / turns)
    return jnp.sqrt(cosine**2 + sine**2), phase


def _turned_back(nu: Float[Array, ""], time_us: Float[Array, "..."]) -> Float[Array, "2 ..."]:
    """Return exp(-i nu t) as its real and imaginary part."""
    return jnp.stack([jnp.cos(nu * time_us), -jnp.sin(nu * time_us)])


def _platform_integral(
    platform: Platform, nu: Float[Array, ""], begin_us: Float[Array, ""], end_us: Float[Array, ""]
) -> Float[Array, " 2"]:
    """Integrate z_p exp(-i nu t) between two times by Gauss's rule; the interval is a collision delay."""
    half = 0.5 * (end_us - begin_us)
    times = 0.5 * (begin_us + end_us) + half * jnp.asarray(_NODES, half.dtype)
    weighted = half * jnp.asarray(_WEIGHTS, half.dtype) * platform.position(times)
    # A product and a sum: under vmap a matrix product of this size costs ten times as much.
    return jnp.sum(_turned_back(nu, times) * weighted, axis=1)
