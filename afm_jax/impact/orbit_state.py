"""A root of the closing condition as a motion: its impact, its flight, whether it can be, and whether it lasts."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from afm_jax.apparatus.cantilever import Cantilever
from afm_jax.apparatus.platform import Platform
from afm_jax.impact.first_impact import Flight, first_impact
from afm_jax.impact.implicit import implicit_root
from afm_jax.impact.jacobian import LawWithSlopes, flight_jacobian, impact_jacobian
from afm_jax.impact.orbit_amplitude import FlightEnds, lockin, peak_amplitude
from afm_jax.impact.orbit_closure import OrbitProblem, Speeds, closing_residual, closure, speeds_at
from afm_jax.impact.orbit_search import find_roots
from afm_jax.outcome import Outcome

NEAR_DOUBLE = 1e-3
"""Slope of the closing condition per relative change of speed below which a root counts as near-double (a fold)."""
_ARRIVAL_TOLERANCE = 1e-7
"""How far (in drive periods) the first impact found may lie before the orbit's own, by rounding."""


class OrbitState(NamedTuple):
    """The motion at one root: drive phase in rad just after impact, speeds, and the flight's ends."""

    phase: Float[Array, ""]
    speeds: Speeds
    flight: FlightEnds


class Verdict(NamedTuple):
    """What a root is good for: see `SingleImpactOrbits`."""

    admissible: Bool[Array, ""]
    stable: Bool[Array, ""]
    near_double: Bool[Array, ""]
    trace: Float[Array, ""]
    determinant: Float[Array, ""]


class SteadyOrbits(NamedTuple):
    """The roots of a problem, which of them are steady (admissible and stable), and their amplitudes in nm."""

    coordinate: Float[Array, " slots"]
    steady: Bool[Array, " slots"]
    near_double: Bool[Array, " slots"]
    amplitude_nm: Float[Array, "slots 2"]


def orbit_state(coordinate: Float[Array, ""], problem: OrbitProblem) -> OrbitState:
    """Return the motion at a root, with the root's derivatives (implicit function theorem)."""
    cantilever, platform, law, order = problem
    coordinate = implicit_root(closing_residual, coordinate, problem)
    speeds = speeds_at(coordinate, law)
    cosine, sine, determinant, regular = closure(coordinate, problem)
    safe = jnp.where(regular, determinant, 1.0)
    phase = jnp.arctan2(jnp.where(regular, sine / safe, 0.0), jnp.where(regular, cosine / safe, 1.0)) % (2.0 * jnp.pi)
    start = phase / platform.angular_frequency
    duration = order * platform.period_us - speeds.delay
    position, platform_velocity = platform.position_and_velocity(start)
    velocity = platform_velocity + speeds.rebound
    end_position, end_velocity = cantilever.propagator(duration)(position, velocity)
    return OrbitState(phase, speeds, FlightEnds(start, duration, position, velocity, end_position, end_velocity))


def judge(coordinate: Float[Array, ""], found: Bool[Array, ""], state: OrbitState, problem: OrbitProblem) -> Verdict:
    """Return whether an orbit is admissible, stable (eq. 8 and its generalisation) and close to a fold."""
    cantilever, platform, law, _ = problem
    trace, determinant = trace_and_determinant(law, cantilever, platform, state.flight)
    skip = None if law.delay is None else jnp.maximum(-state.speeds.delay, 0.0)
    # How fast the closing condition changes with the logarithm of Y.
    _, slope = jax.jvp(lambda y: closing_residual(y, problem), (coordinate,), (coordinate,))
    return Verdict(
        admissible=found & ends_at_its_own_impact(cantilever, platform, state.flight, found, skip, _ARRIVAL_TOLERANCE),
        stable=found & contracts(trace, determinant),
        near_double=found & (jnp.abs(slope) < NEAR_DOUBLE),
        trace=trace,
        determinant=determinant,
    )


def steady_orbits(problem: OrbitProblem) -> SteadyOrbits:
    """Return the roots that are steady motions, without derivatives: what an experiment can settle on."""
    problem = lax.stop_gradient(problem)
    roots = find_roots(problem)

    def one(root, found):
        state = orbit_state(root, problem)
        verdict = judge(root, found, state, problem)
        return verdict.admissible & verdict.stable, verdict.near_double, _amplitudes_of(state, problem)

    return SteadyOrbits(roots.coordinate, *jax.vmap(one)(roots.coordinate, roots.found))


def amplitudes(coordinate: Float[Array, ""], problem: OrbitProblem) -> Float[Array, " 2"]:
    """Return peak and lock-in amplitude in nm of the orbit at a root, differentiable in the problem."""
    return _amplitudes_of(orbit_state(coordinate, problem), problem)


def _amplitudes_of(state: OrbitState, problem: OrbitProblem) -> Float[Array, " 2"]:
    peak = peak_amplitude(problem.cantilever, state.flight)
    length, _ = lockin(
        problem.cantilever, problem.platform, state.flight, problem.order, delayed=problem.law.delay is not None
    )
    return jnp.stack([peak, length])


def trace_and_determinant(
    law: LawWithSlopes, cantilever: Cantilever, platform: Platform, flight: FlightEnds
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Return T and D of the impact map on an orbit (eq. 8 and its generalisation)."""
    arrival = flight.start_us + flight.duration_us
    jacobian = impact_jacobian(law, platform, arrival, flight.end_velocity) @ flight_jacobian(
        cantilever, platform, flight.start_us, flight.start_velocity, arrival
    )
    trace = jacobian[0, 0] + jacobian[1, 1]
    return trace, jacobian[0, 0] * jacobian[1, 1] - jacobian[0, 1] * jacobian[1, 0]


def contracts(trace: Float[Array, ""], determinant: Float[Array, ""]) -> Bool[Array, ""]:
    """Say whether a map of this trace and determinant is stable."""
    return (jnp.abs(trace) < jnp.abs(1.0 + determinant)) & (jnp.abs(determinant) <= 1.0)


def ends_at_its_own_impact(
    cantilever: Cantilever,
    platform: Platform,
    flight: FlightEnds,
    found: Bool[Array, ""],
    skip_us: Float[Array, ""] | None,
    tolerance: float,
) -> Bool[Array, ""]:
    """Say whether the first impact of the flight is the orbit's own: the flight never passes through the platform.

    Args:
        cantilever: of the free flight.
        platform: that it must not meet before its end.
        flight: from impact to impact.
        found: whether there is an orbit at all.
        skip_us: time after the start at which the flight begins to count, max(t_in, t_out); None: at once.
        tolerance: how far (in drive periods) the first impact may lie before the flight's end, by rounding.
    """
    # An empty slot does not leave the platform, so that its search ends at once.
    velocity = jnp.where(found, flight.start_velocity, -jnp.inf)
    first = first_impact(Flight(cantilever, platform, flight.start_us, velocity), skip_us=skip_us)
    duration = flight.duration_us
    hit = (first.outcome == Outcome.IMPACT) & (first.duration_us >= duration - tolerance * platform.period_us)
    # Rounding can lift the end of the flight off the platform where the impact is a graze.
    return (duration > 0.0) & (hit | (first.outcome == Outcome.NO_FURTHER_IMPACT))
