"""Single-impact orbits of impacts that last: which there are, whether they last, and their amplitudes and phase."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from afm_jax.impact.implicit import implicit_root
from afm_jax.impact.lasting_closure import LastingProblem, lasting_closure, lasting_residual
from afm_jax.impact.lasting_impact import INDENTATION
from afm_jax.impact.lasting_search import find_lasting_roots, regular
from afm_jax.impact.orbit_amplitude import FlightEnds, lockin, peak_amplitude
from afm_jax.impact.orbit_closure import Speeds
from afm_jax.impact.orbit_state import NEAR_DOUBLE, contracts, ends_at_its_own_impact, trace_and_determinant

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
    trace, determinant = trace_and_determinant(impact, cantilever, platform, state.flight)
    found = found & regular(root, problem)
    # the flight counts from max(t_in, t_out) on
    skip = jnp.maximum(-state.speeds.delay, 0.0)
    admissible = ends_at_its_own_impact(cantilever, platform, state.flight, found, skip, _ARRIVAL_TOLERANCE)
    return found & contracts(trace, determinant) & admissible, found & near_fold(root, problem)


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
