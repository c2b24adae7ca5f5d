"""Where a simulation begins: on an orbit that the impact law predicts, leaving the platform, or as a file says.

Takes a scene, and maybe a phase in degrees, a height in nm and a velocity in nm/us; gives a `State`: us, nm, nm/us in
the lab (orbits by eq. 9).
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from afm_jax.apparatus.cantilever import Cantilever
from afm_jax.apparatus.platform import Platform
from afm_jax.apparatus.scene import Scene, drive_of
from afm_jax.apparatus.surface import Surface, free_frame, surface_of
from afm_jax.checks import as_parameter
from afm_jax.contact.collide import capture_speed
from afm_jax.contact.contact import Contact
from afm_jax.contact.junction import end_of_contact
from afm_jax.contact.law_of_contact import approximate_law
from afm_jax.impact.law import Law
from afm_jax.impact.orbits import single_impact_orbits
from afm_jax.motion.record import State, to_gap, to_lab
from afm_jax.motion.trajectory import fly
from afm_jax.solve.newton_steps import newton_steps

_NEWTON_STEPS, _CLOSE = 12, 1e-9
"""Steps to where a flight has risen to a gap, and what may be left of that in nm."""
_PUSH = 1e-3
"""Of the rebound speed, by which a start misses an unstable orbit: rounding may hold a tip there for ever."""


def default_start(scene: Scene) -> State:
    """Return where a simulation of a scene begins that has no start of its own.

    Driven with one frequency: just after the impact of the single-impact orbit that the scene's law, or the law with
    delay closest to its contact, has for the order nearest to resonance; a stable one, the fastest if there are
    several, or else beside the fastest unstable one. Without an orbit: with a drive of base or force at rest where that
    is above the sample, else leaving
    the platform upward at its highest speed, at that speed again or twice the capture speed relative to it. A free
    cantilever starts at rest.

    Args:
        scene: one scene, its numbers known.

    Raises:
        ValueError: if the scene's contact has no junction.
        RuntimeError: if JAX is not set to 64-bit floats.
    """
    if scene.interaction is None:
        return state(0.0, 0.0, 0.0)
    law = scene.interaction
    if isinstance(law, Contact):
        law = approximate_law(law, float(scene.cantilever.mass_ng))
    seconds = (part.second for part in (scene.platform, scene.base, scene.force) if part is not None)
    still = eqx.tree_at(
        lambda s: s.platform.offset_rate_nm_per_us, scene, jnp.zeros_like(scene.platform.offset_rate_nm_per_us)
    )
    periodic = not any(second is not None for second in seconds) and drive_of(still).aperiodic is None
    on_orbit = _on_orbit(scene, still, law) if periodic and law is not None else None
    if on_orbit is not None:
        return on_orbit
    if (scene.base or scene.force) and -scene.platform.position(0.0) > 2.0 * gap_of_departure(scene) + 1.0:
        return state(0.0, 0.0, 0.0)
    return _leaving(scene)


def start_of(scene: Scene, start: tuple[float, float, float] | None) -> State:
    """Return the state of a scene file's start, at the first time from 0 on at which the drive has its phase.

    Args:
        scene: the scene; with a start also many, which repeat with one drive period each.
        start: phase of the drive in degrees, height above the platform in nm, velocity in the lab in nm/us (a `Start`);
            None: `default_start`.
    """
    if start is None:
        return default_start(scene)
    phase, height, velocity = start
    many = scene.platform.frequency_khz.ndim > 0
    period = free_frame(scene).platform.period_us if many else drive_of(scene).period_us
    time = as_parameter((phase % 360.0) / 360.0 * period)
    return State(time, scene.platform.position(time) + height, jnp.full_like(time, velocity))


def state(time_us: float, position_nm: float, velocity_nm_per_us: float) -> State:
    """Return a state of plain numbers as one of arrays."""
    return State(*(as_parameter(float(value)) for value in (time_us, position_nm, velocity_nm_per_us)))


def gap_of_departure(scene: Scene) -> Float[Array, "..."]:
    """Return the gap in nm at which flights begin, of one scene or a batch: 0 after an impact of a law.

    After a contact it is where that ends (`end_of_contact`).
    """
    if isinstance(scene.interaction, Contact):
        return end_of_contact(scene.interaction)
    return jnp.zeros_like(scene.platform.frequency_khz)


def _on_orbit(scene: Scene, still: Scene, law: Law) -> State | None:
    """Return the state just after the impact of the predicted orbit, that of the scene without ramp; None without."""
    omega = drive_of(still).angular_frequency
    order = max(1, round(omega / (2.0 * float(scene.cantilever.angular_frequency))))
    predicted = eqx.tree_at(lambda s: s.interaction, still, law)
    orbits = single_impact_orbits(predicted, float(order))
    admissible = np.asarray(orbits.exists) & np.asarray(orbits.admissible)
    stable = admissible & np.asarray(orbits.stable)
    wanted = stable if stable.any() else admissible
    if not wanted.any():
        return None
    slot = int(np.argmax(np.where(wanted, np.asarray(orbits.approach_speed_nm_per_us), -np.inf)))
    time = float(orbits.phase_rad[slot]) / omega
    velocity = float(orbits.velocity_after_nm_per_us[slot])
    height, speed = (float(part) for part in scene.platform.position_and_velocity(time))
    if not isinstance(scene.interaction, Contact):
        return state(time, height, velocity if stable.any() else velocity + _PUSH * (velocity - speed))
    begin = state(time, height, velocity)
    risen, rises = _risen(scene.cantilever, *surface_of(scene), begin, gap_of_departure(scene))
    return risen if rises else None


@jax.jit
def _risen(
    cantilever: Cantilever, surface: Platform | Surface, response: Surface | None, begin: State, gap: Float[Array, ""]
) -> tuple[State, Bool[Array, ""]]:
    """Return where a flight that leaves the platform first has a gap, and whether it rises that far."""
    leaving = to_gap(surface, response, begin)

    def missing(end: Array) -> tuple[Array, Array]:
        reached, rate = fly(cantilever, surface, *leaving, begin.time_us, end)
        return reached - gap, rate

    end = newton_steps(missing, begin.time_us + gap / leaving[1], _NEWTON_STEPS)
    short, rate = missing(end)
    rises = (end >= begin.time_us) & (rate > 0.0) & (jnp.abs(short) < _CLOSE * (1.0 + gap))
    return to_lab(surface, response, end, gap, rate), rises


def _leaving(scene: Scene) -> State:
    """Return a tip that leaves the platform upward at its highest speed."""
    drive = drive_of(scene)
    time = 0.75 * drive.period_us
    height, speed = (float(part) for part in scene.platform.position_and_velocity(time))
    rebound = float(rebound_of_leaving(scene))
    return state(time, height + float(gap_of_departure(scene)), speed + (rebound or drive.angular_frequency))


def rebound_of_leaving(scene: Scene) -> Float[Array, ""]:
    """Return the speed off the platform in nm/us of a tip that begins there: the platform's, or twice that of capture.

    The larger of them; of a scene with an interaction.
    """
    interaction = scene.interaction
    if isinstance(interaction, Contact):
        slowest = capture_speed(interaction, scene.cantilever.mass_ng)
    else:
        slowest = interaction.capture_speed_nm_per_us
    return jnp.maximum(scene.platform.top_speed_nm_per_us, jnp.where(jnp.isfinite(slowest), 2.0 * slowest, 0.0))
