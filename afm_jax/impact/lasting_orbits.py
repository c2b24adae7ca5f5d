"""Single-impact orbits of impacts that last: which there are, whether they last, and their amplitudes and phase."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from afm_jax.impact.first_impact import Flight, first_impact
from afm_jax.impact.implicit import implicit_root
from afm_jax.impact.jacobian import flight_jacobian, impact_jacobian
from afm_jax.impact.lasting_closure import LastingProblem, lasting_closure, lasting_residual
from afm_jax.impact.lasting_impact import INDENTATION
from afm_jax.impact.lasting_search import LastingRoots, find_lasting_roots, regular
from afm_jax.impact.orbit_amplitude import FlightEnds, lockin, peak_amplitude
from afm_jax.impact.orbit_closure import Speeds
from afm_jax.impact.orbit_state import NEAR_DOUBLE
from afm_jax.outcome import Outcome

_ARRIVAL_TOLERANCE = 1e-6
"""How far (in drive periods) the first impact found may lie before the orbit's own."""


class LastingState(NamedTuple):
    """The motion at one root: the impact's speeds and delay on the moving platform, and the flight's ends."""

    speeds: Speeds
    flight: FlightEnds


class LastingOrbits(NamedTuple):
    """The roots of a problem, which of them are steady (admissible and stable), peak and lock-in amplitude in nm."""

    coordinate: Float[Array, " slots"]
    steady: Bool[Array, " slots"]
    near_double: Bool[Array, " slots"]
    amplitude_nm: Float[Array, "slots 2"]


@jax.jit
def lasting_state(coordinate: Float[Array, ""], problem: LastingProblem) -> LastingState:
    """Return the motion at a root, with the root's derivatives (implicit function theorem)."""
    cantilever, platform, _, order = problem
    coordinate = implicit_root(lasting_residual, coordinate, problem)
    speeds, (cosine, sine, determinant, is_regular) = lasting_closure(coordinate, problem)
    safe = jnp.where(is_regular, determinant, 1.0)
    phase = jnp.arctan2(jnp.where(is_regular, sine / safe, 0.0), jnp.where(is_regular, cosine / safe, 1.0))
    start = (phase % (2.0 * jnp.pi)) / platform.angular_frequency
    duration = order * platform.period_us - speeds.delay
    position, platform_velocity = platform.position_and_velocity(start)
    velocity = platform_velocity + speeds.rebound
    end_position, end_velocity = cantilever.propagator(duration)(position, velocity)
    return LastingState(speeds, FlightEnds(start, duration, position, velocity, end_position, end_velocity))


def lasting_amplitudes(coordinate: Float[Array, ""], problem: LastingProblem) -> Float[Array, " 3"]:
    """Return peak and lock-in amplitude in nm and the phase in degrees of the orbit at a root, differentiable."""
    return _observed(lasting_state(coordinate, problem), problem)


def steady_lasting_orbits(problem: LastingProblem) -> LastingOrbits:
    """Return the roots that are steady motions, without derivatives: what an experiment can settle on."""
    problem = lax.stop_gradient(problem)
    roots = find_lasting_roots(problem)

    def one(root, found):
        state = lasting_state(root, problem)
        steady, near_double = _judged(root, found, state, problem)
        return steady, near_double, _observed(state, problem)[:2]

    return LastingOrbits(roots.coordinate, *jax.vmap(one)(roots.coordinate, roots.found))


def near_fold(coordinate: Float[Array, ""], problem: LastingProblem) -> Bool[Array, ""]:
    """Say whether the closing condition is nearly flat at a root."""
    _, slope = jax.jvp(lambda x: lasting_residual(x, problem), (coordinate,), (coordinate,))
    return jnp.abs(slope) < NEAR_DOUBLE


def _judged(root, found, state: LastingState, problem: LastingProblem) -> tuple[Array, Array]:
    """Return whether an orbit is admissible and stable, and whether it is close to a fold.

    Stability is that of the delayed map; what the corrections change in it is of their own order.
    """
    cantilever, platform, impact, _ = problem
    start, velocity = state.flight.start_us, state.flight.start_velocity
    arrival = start + state.flight.duration_us
    jacobian = impact_jacobian(impact, platform, arrival, state.flight.end_velocity) @ flight_jacobian(
        cantilever, platform, start, velocity, arrival
    )
    trace = jacobian[0, 0] + jacobian[1, 1]
    determinant = jacobian[0, 0] * jacobian[1, 1] - jacobian[0, 1] * jacobian[1, 0]
    stable = (jnp.abs(trace) < jnp.abs(1.0 + determinant)) & (jnp.abs(determinant) <= 1.0)
    found = found & regular(root, problem)
    return found & stable & _admissible(found, state, problem), found & near_fold(root, problem)


def _admissible(found, state: LastingState, problem: LastingProblem) -> Bool[Array, ""]:
    """Say whether the first impact of the flight is the orbit's own; the flight counts from max(t_in, t_out) on."""
    velocity = jnp.where(found, state.flight.start_velocity, -jnp.inf)
    skip = jnp.maximum(-state.speeds.delay, 0.0)
    flight = Flight(problem.cantilever, problem.platform, state.flight.start_us, velocity)
    first = first_impact(flight, skip_us=skip)
    duration = state.flight.duration_us
    hit = (first.outcome == Outcome.IMPACT) & (
        first.duration_us >= duration - _ARRIVAL_TOLERANCE * problem.platform.period_us
    )
    return (duration > 0.0) & (hit | (first.outcome == Outcome.NO_FURTHER_IMPACT))


@jax.jit
def _observed(state: LastingState, problem: LastingProblem) -> Float[Array, " 3"]:
    peak = peak_amplitude(problem.cantilever, state.flight)
    # in contact the tip is below the platform's rest surface by the indentation
    tau = problem.impact.hertz_time(state.speeds.approach)
    length, phase = lockin(
        problem.cantilever,
        problem.platform,
        state.flight,
        problem.order,
        delayed=True,
        indentation=INDENTATION * state.speeds.approach * tau**2,
    )
    return jnp.stack([peak, length, phase])


__all__ = ["LastingOrbits", "LastingRoots", "LastingState", "lasting_amplitudes", "steady_lasting_orbits"]
