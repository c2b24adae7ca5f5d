"""The closing condition of a single-impact orbit whose impact lasts, with the corrections of `lasting_impact`.

As in `orbit_closure` the two conditions are linear in cosine and sine of the phase for given speeds; the corrections
need the phase, so that three passes alternate between the two.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from afm_jax.apparatus.cantilever import Cantilever
from afm_jax.apparatus.platform import Platform
from afm_jax.impact.lasting_impact import LastingImpact, corrected, middle_of_contact
from afm_jax.impact.orbit_closure import Closure, Speeds, delayed_closure

_PASSES = 3


class LastingProblem(NamedTuple):
    """A (1, N) orbit's scene: the order N is a floating-point number, so that it can be batched."""

    cantilever: Cantilever
    platform: Platform
    impact: LastingImpact
    order: Float[Array, ""]


class LastingClosure(NamedTuple):
    """The speeds of the impact, corrected, and the linear system they lead to."""

    speeds: Speeds
    closure: Closure


@jax.jit
def lasting_closure(coordinate: Float[Array, ""], problem: LastingProblem) -> LastingClosure:
    """Return the linear system for the phase of the orbit whose impact has a coordinate."""
    cantilever, platform, impact, _ = problem
    free = impact.speeds(coordinate)

    def correct(_, speeds: Speeds) -> Speeds:
        system = _system(speeds, problem)
        # the direction of the phase, whether or not this is an orbit already
        cosine, sine = system.cosine * system.determinant, system.sine * system.determinant
        length = jnp.sqrt(cosine**2 + sine**2)
        somewhere = length > 0.0
        safe = jnp.where(somewhere, length, 1.0)
        middle = middle_of_contact(
            cantilever, platform, jnp.where(somewhere, cosine / safe, 1.0), sine / safe, speeds.delay
        )
        return corrected(free, middle, cantilever, impact)

    # a loop, because the program is compiled for every use of it
    speeds = lax.fori_loop(0, _PASSES, correct, free)
    return LastingClosure(speeds, _system(speeds, problem))


@jax.jit
def lasting_residual(coordinate: Float[Array, ""], problem: LastingProblem) -> Float[Array, ""]:
    """Return a^2 + b^2 - 1 times the squared determinant, relative to the sum of its terms: 0 on an orbit."""
    cosine, sine, determinant, _ = lasting_closure(coordinate, problem).closure
    total = cosine**2 + sine**2 + determinant**2
    return (cosine**2 + sine**2 - determinant**2) / total


def _system(speeds: Speeds, problem: LastingProblem) -> Closure:
    cantilever, platform, _, order = problem
    propagator = cantilever.propagator(order * platform.period_us - speeds.delay)
    turn = platform.angular_frequency * speeds.delay
    return delayed_closure(propagator, speeds, platform, (jnp.cos(turn), jnp.sin(turn)))
