"""Single-impact orbits: one impact in N drive periods (eq. 9); admissible, stable, and what one measures of them."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float

from afm_jax.apparatus.scene import Scene, require_sample_drive
from afm_jax.impact.law import impact_law_of
from afm_jax.impact.orbit_amplitude import lockin, peak_amplitude
from afm_jax.impact.orbit_closure import OrbitProblem
from afm_jax.impact.orbit_search import find_roots
from afm_jax.impact.orbit_state import judge, orbit_state
from afm_jax.parameters import is_traced, readable, require_float64


class SingleImpactOrbits(eqx.Module):
    """All (1, N) orbits of a scene, ascending in approach speed, in a fixed number of slots.

    Without a collision delay there are 4 slots, as many as eq. 9 can have roots; with one there are 16. Every
    attribute has the slots' shape; where ``exists`` is False the numbers are NaN.

    Attributes:
        exists: the slot holds a root of eq. 9 with V' > v_p > V that satisfies eq. 6 with the positive root.
        admissible: the flight does not pass through the platform on its way.
        stable: |trace| < |1 + determinant| and |determinant| <= 1 of the linearised map.
        near_double: close to a fold, where two orbits merge and derivatives diverge.
        phase_rad: drive phase omega t just after impact, in [0, 2 pi).
        velocity_after_nm_per_us: tip velocity V' in the lab just after impact.
        velocity_before_nm_per_us: tip velocity V just before.
        approach_speed_nm_per_us: u_in relative to the platform.
        rebound_speed_nm_per_us: u_out relative to the platform.
        delay_us: collision delay.
        peak_amplitude_nm: largest height above the rest position.
        lockin_amplitude_nm: amplitude at the response frequency omega/N.
        lockin_phase_deg: its phase, modulo 360/N; t = 0 when the platform is highest.
        trace: T of the linearised map.
        determinant: D of the linearised map.
        complete: scalar; False if there were more orbits than slots (with a delay only).
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

    __repr__ = readable


def single_impact_orbits(scene: Scene, order: ArrayLike) -> SingleImpactOrbits:
    """Return every single-impact orbit of an order (eq. 9; damped, with viscous loss and delay).

    Args:
        scene: a scene whose interaction is an `ImpactLaw`, without offset ramp and second frequency.
        order: N, drive periods between impacts; a positive integer, scalar.

    Returns:
        The orbits in a fixed number of slots with a mask, differentiable in the scene's parameters. Without a delay
        they are all roots of a quartic; with one, all that a scan of 8192 speeds brackets, close pairs included.

    Raises:
        RuntimeError: if JAX is not set to 64-bit floats, or was not when the scene was built.
        TypeError: if the scene's interaction is not an impact law.
        ValueError: if the order is not a positive integer, the platform's offset ramps, or the scene has another drive
            than one cosine of the platform.
    """
    require_float64(scene)
    impact_law_of(scene)
    require_sample_drive(scene)
    _check_order(order)
    rate = scene.platform.offset_rate_nm_per_us
    if not is_traced(rate) and np.any(np.asarray(rate) != 0.0):
        raise ValueError(f"`offset_rate_nm_per_us` must be 0 for a periodic orbit, but is {np.asarray(rate).flat[0]:g}")
    return _single_impact_orbits(scene, jnp.asarray(order, scene.platform.frequency_khz.dtype))


def _check_order(order: ArrayLike) -> None:
    if is_traced(order):
        return
    number = np.asarray(order)
    if number.ndim or not np.isfinite(number) or number != np.round(number) or number < 1:
        raise ValueError(f"`order` must be a positive integer, but is {order}")


@jax.jit
def _single_impact_orbits(scene: Scene, order: Float[Array, ""]) -> SingleImpactOrbits:
    problem = OrbitProblem(scene.cantilever, scene.platform, impact_law_of(scene), order)
    roots = find_roots(problem)
    orbits = jax.vmap(_orbit, in_axes=(0, 0, None))(roots.coordinate, roots.found, problem)
    return eqx.tree_at(lambda result: result.complete, orbits, roots.complete)


def _orbit(coordinate: Float[Array, ""], found: Bool[Array, ""], problem: OrbitProblem) -> SingleImpactOrbits:
    """Return what there is to know about one root; NaN where there is none."""
    state = orbit_state(coordinate, problem)
    verdict = judge(coordinate, found, state, problem)
    flight, speeds = state.flight, state.speeds
    amplitude, angle = lockin(
        problem.cantilever, problem.platform, flight, problem.order, delayed=problem.law.delay is not None
    )

    def known(value):
        return jnp.where(found, value, jnp.nan)

    return SingleImpactOrbits(
        exists=found,
        admissible=verdict.admissible,
        stable=verdict.stable,
        near_double=verdict.near_double,
        phase_rad=known(state.phase),
        velocity_after_nm_per_us=known(flight.start_velocity),
        velocity_before_nm_per_us=known(flight.end_velocity),
        approach_speed_nm_per_us=known(speeds.approach),
        rebound_speed_nm_per_us=known(speeds.rebound),
        delay_us=known(speeds.delay),
        peak_amplitude_nm=known(peak_amplitude(problem.cantilever, flight)),
        lockin_amplitude_nm=known(amplitude),
        lockin_phase_deg=known(angle),
        trace=known(verdict.trace),
        determinant=known(verdict.determinant),
        complete=found,
    )
