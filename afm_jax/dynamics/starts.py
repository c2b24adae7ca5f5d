"""Where motions begin: tips of many scenes, in the frame in which every drive is a sample that moves with one cosine.

States are us, nm and nm/us; the frame is that of eq. 2.

`sample_driven` takes scenes into that frame and checks that they repeat; `batch_and_tips` gives their tips there, from
a start in the lab or on the stable single-impact orbit of the order nearest to resonance.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float

from afm_jax.apparatus.scene import RANGE_OF_ONE, Scene
from afm_jax.apparatus.surface import FreeFrame, free_frame
from afm_jax.checks import require_float64
from afm_jax.contact.contact import Contact
from afm_jax.contact.law_of_contact import approximate_law
from afm_jax.dynamics.many_tips import MAX_STEPS, Tips, after_impacts
from afm_jax.impact.law import impact_law_of
from afm_jax.impact.map import Departure, NextImpact, Search, impact_after
from afm_jax.impact.orbits import fastest_steady_orbit, orbit_problem
from afm_jax.motion.law_motion import or_rest
from afm_jax.motion.record import State
from afm_jax.motion.start import gap_of_departure, rebound_of_leaving
from afm_jax.outcomes import Outcome
from afm_jax.solve.lanes import WIDTHS, in_blocks


class SampleDriven(NamedTuple):
    """Scenes as their freely moving tips see them, whatever drives them: over a platform that moves with one cosine."""

    scenes: Scene
    """Without base and force; impacts and contacts are the same ones at the same times of the frame's clock."""
    frame: FreeFrame

    def start(self, start: State) -> State:
        """Return a start in the lab as it is in the frame."""
        frame = self.frame
        if frame.response is None:
            return start
        omega = frame.platform.angular_frequency
        time = start.time_us + (2.0 * jnp.pi - frame.phase_rad % (2.0 * jnp.pi)) / omega
        height, velocity = self.response(time)
        return State(time, start.position_nm - height, start.velocity_nm_per_us - velocity)

    @jax.jit
    def response(self, time_us: ArrayLike) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
        """Return height and velocity of what the frame leaves out, at a time of its clock: the free tip's response."""
        time, wave = jnp.asarray(time_us), self.frame.response
        if wave is None:
            return jnp.zeros_like(time), jnp.zeros_like(time)
        columns = jax.tree.map(lambda part: part.reshape(*part.shape, *[1] * (time.ndim - part.ndim)), wave)
        return columns.value_and_rate(time)


def sample_driven(scenes: Scene) -> SampleDriven:
    """Return scenes as their freely moving tips see them, checked that they repeat with one drive period.

    Raises:
        RuntimeError: if JAX is not set to 64-bit floats, or was not when the scenes were built.
        ValueError: if the tip meets nothing, the offset ramps, what the tip sees rests, or the drive has several
            frequencies.
    """
    require_float64(scenes)
    if scenes.interaction is None:
        raise ValueError("the scene has no interaction: a tip that meets nothing has no impacts")
    if np.any(np.asarray(scenes.platform.offset_rate_nm_per_us) != 0.0):
        raise ValueError("`offset_rate_nm_per_us` must be 0 here: under a ramp no motion repeats")
    frame = free_frame(scenes)
    if not np.all(np.asarray(frame.periodic)):
        raise ValueError(
            f"the drive has several frequencies, so that no period of the drive repeats; {RANGE_OF_ONE}, or `simulate` "
            "scenes one by one"
        )
    if not np.all(np.asarray(frame.platform.amplitude_nm) > 0.0):
        raise ValueError("`amplitude_nm` of the platform must be positive here: on a resting platform motion dies away")
    if frame.response is not None:
        scenes = Scene(scenes.cantilever, frame.platform, scenes.interaction)
    return SampleDriven(scenes, frame)


def batch_and_tips(scene: Scene, start: State | None = None) -> tuple[Scene, Tips]:
    """Return one scene or many as a batch of scenes, and where their tips begin.

    Args:
        scene: one scene, or a batch of scenes.
        start: the tip in the lab; None: `bouncing_tips`.

    Raises:
        ValueError: if the tip cannot start there.
    """
    if scene.platform.frequency_khz.ndim == 0:
        scene = jax.tree.map(lambda leaf: jnp.asarray(leaf)[None], scene)
    if start is None:
        return scene, bouncing_tips(scene)
    if not isinstance(scene.interaction, Contact):
        tips = landed_tips(scene, start)
        if np.all(np.asarray(tips.outcome) == Outcome.INVALID_START):
            raise ValueError("the tip cannot start there: the start is not finite, or inside the sample")
        return scene, tips
    gap = start.position_nm - scene.platform.position(start.time_us)
    return scene, tips_at(scene, start.time_us, start.velocity_nm_per_us)._replace(gap_nm=gap)


@jax.jit
def landed_tips(scenes: Scene, start: State) -> Tips:
    """Return tips just after the first impact of a flight from anywhere above the platform, or of a rest on it.

    Args:
        scenes: a batch of scenes.
        start: time, height and velocity in the lab, one value for all or one a scene.
    """

    def first_impact_of(scene: Scene, start: State) -> NextImpact:
        gap = start.position_nm - scene.platform.position(start.time_us)
        # on the surface but for the rounding of the heights it is the difference of
        gap = jnp.where(jnp.abs(gap) < 1e-13 * (jnp.abs(start.position_nm) + scene.platform.amplitude_nm), 0.0, gap)
        departure = Departure(start.time_us, gap, start.velocity_nm_per_us)
        return or_rest(scene, departure, impact_after(scene, departure, Search(MAX_STEPS, from_above=True)))

    starts = State(*(jnp.broadcast_to(part, scenes.platform.frequency_khz.shape) for part in start))
    tips = tips_at(scenes, starts.time_us, starts.velocity_nm_per_us)
    return after_impacts(scenes, tips, jax.vmap(first_impact_of)(scenes, starts))[0]


@jax.jit
def leaving_tips(scenes: Scene) -> Tips:
    """Return tips that leave the platform upward at its highest speed, at that speed again or twice the capture speed.

    Args:
        scenes: a batch of scenes.
    """
    platform, time = scenes.platform, 0.75 * scenes.platform.period_us
    return tips_at(scenes, time, platform.velocity(time) + jax.vmap(rebound_of_leaving)(scenes))


def bouncing_tips(scenes: Scene) -> Tips:
    """Return tips where there is motion: on the stable single-impact orbit of the order nearest to resonance.

    The fastest one if there are several; of contacts that of the law closest to the first one. Where there is none the
    tip is one of `leaving_tips`.

    Args:
        scenes: a batch of scenes, driven by the sample alone.
    """
    usual, gap, law = leaving_tips(scenes), gap_of_departure(scenes), scenes.interaction
    if isinstance(law, Contact):
        contact, mass = jax.tree.map(lambda leaf: jnp.asarray(leaf)[0], (law, scenes.cantilever.mass_ng))
        law = approximate_law(contact, float(mass))
        if law is None:
            return usual
        law = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (len(gap), *leaf.shape)), law)

    def work(lanes: tuple[Scene, Array]) -> tuple[Array, Tips]:
        return _on_orbits(*lanes)

    there, tips = in_blocks(work, (Scene(scenes.cantilever, scenes.platform, law), gap), widths=WIDTHS[:-1])
    return jax.tree.map(lambda on_orbit, elsewhere: np.where(there, on_orbit, elsewhere), tips, usual)


@jax.jit
def _on_orbits(scenes: Scene, clearance_nm: Float[Array, " lanes"]) -> tuple[Bool[Array, " lanes"], Tips]:
    """Return which scenes with laws have a stable orbit, and tips on them that have risen to a gap in nm."""

    def on_orbit_of(scene: Scene, clearance: Array) -> tuple[Array, ...]:
        platform = scene.platform
        order = jnp.round(platform.angular_frequency / (2.0 * scene.cantilever.angular_frequency))
        law = impact_law_of(scene)
        orbit, steady = fastest_steady_orbit(orbit_problem(scene.cantilever, platform, law, jnp.maximum(1.0, order)))
        start, velocity = orbit.flight.start_us, orbit.flight.start_velocity
        rise = clearance / orbit.speeds.rebound
        height, speed = scene.cantilever.propagator(rise)(platform.position(start), velocity)
        # a tip that comes so far in a straight path's time comes there: the path bends by less, where it rises at all
        risen = height - platform.position(start + rise) >= 0.9 * clearance
        return steady & risen & law.leaves, (start + rise) % platform.period_us, speed

    there, time, velocity = jax.vmap(on_orbit_of)(scenes, clearance_nm)
    return there, tips_at(scenes, time, velocity)._replace(gap_nm=clearance_nm)


@jax.jit
def tips_at(scenes: Scene, time_us: Array, velocity_nm_per_us: Array) -> Tips:
    """Return tips that leave the platform at a time in us with a velocity in nm/us in the lab; arrays of one shape."""
    zero = jnp.zeros_like(scenes.platform.frequency_khz)
    going = jnp.full(zero.shape, int(Outcome.IMPACT), jnp.int32)
    return Tips(zero + time_us, zero, gap_of_departure(scenes), zero + velocity_nm_per_us, going)


def evenly_spread(count: int) -> Float[np.ndarray, "count 2"]:
    """Return pairs that fill the unit square evenly: multiples of the plastic number's inverse powers, modulo 1."""
    plastic = 1.324717957244746
    return np.arange(1.0, count + 1.0)[:, None] / [plastic, plastic**2] % 1.0
