"""Many tips iterated by the impact map at once: the engine behind exponents, bifurcation diagrams and basins.

Lanes run in blocks that fit the processor's cache, two threads take one block after the other, and lanes whose motion
has ended drop out between calls. A block is written as arrays, not as a `vmap` of one tip: what only a resting tip
needs (chatter summed up, the ride, the release) is computed in the steps in which a tip of the block rests, and no
others. Times count within the drive's period, so that long motions keep the digits of their phase.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from afm_jax.apparatus.scene import Scene
from afm_jax.apparatus.surface import FreeFrame, free_frame
from afm_jax.checks import require_float64
from afm_jax.contact.collide import capture_speed
from afm_jax.contact.contact import Contact
from afm_jax.contact.law_of_contact import law_of_contact
from afm_jax.impact.law import Law, impact_law_of
from afm_jax.impact.map import Departure, NextImpact, Search, impact_after
from afm_jax.impact.orbits import fastest_steady_orbit, orbit_problem
from afm_jax.motion.law_motion import CONSTANT_PUSH, Bed, or_rest, through_impact
from afm_jax.motion.record import ContactKind, State
from afm_jax.motion.start import default_start
from afm_jax.outcomes import Outcome
from afm_jax.solve.lanes import again_for, in_blocks

MAX_STEPS = 2000
"""Steps of the search for one impact."""
_QUICK_STEPS = 14
"""Steps that all tips of a block take together; those that need more go on among themselves."""
_RIDE_PERIODS = 1.1
"""Drive periods within which a resting tip is let go, or never: its push repeats every one."""


_TOUCHING = 1e-13
"""Gap over the heights it is the difference of, below which it is rounding."""
_FEW = 16
"""Tips of a block whose rest, or long search, is computed together."""
_ORBITS_AT_ONCE = 128
_RISEN = 0.9
"""Of the gap at which the bridge breaks: from there a tip on its way up is free."""


class Tips(NamedTuple):
    """Tips at the beginning of a flight each, arrays of one lane a tip."""

    time_us: Float[Any, " lanes"]
    """Within the first drive period."""
    periods: Float[Any, " lanes"]
    """Whole drive periods gone before."""
    gap_nm: Float[Any, " lanes"]
    """0 just after an impact, next to nothing after a release."""
    velocity_nm_per_us: Float[Any, " lanes"]
    """In the lab."""
    outcome: Int[Any, " lanes"]
    """An `Outcome`: IMPACT while the motion goes on, else how it ended."""


class MapStep(NamedTuple):
    """One step of the map, arrays of one lane a tip; numbers without meaning where a tip had ended before."""

    start: Tips
    impact: NextImpact
    """Times count from the same period as the start's."""
    rested: Bool[Array, " lanes"]
    """The tip came to rest on the platform, by a capture or by chatter."""
    end: Tips


def advance(scenes: Scene, tips: Tips) -> MapStep:
    """Return the next impacts of a block of tips, and where their flights after them begin.

    Args:
        scenes: a batch of scenes, every number of one lane a tip.
        tips: where they are.
    """
    going = tips.outcome == Outcome.IMPACT
    impact = jax.vmap(partial(_one_impact, max_steps=_QUICK_STEPS))(scenes, tips)
    slow = going & (impact.outcome == Outcome.STEP_LIMIT)
    longer = jax.vmap(partial(_one_impact, max_steps=MAX_STEPS))
    impact = again_for(longer, slow, (scenes, tips), impact, block=_FEW)
    return _landed(scenes, tips, impact)


def _landed(scenes: Scene, tips: Tips, impact: NextImpact) -> MapStep:
    """Return the step of tips to impacts that were found."""
    going = tips.outcome == Outcome.IMPACT
    captured = going & (impact.outcome == Outcome.CAPTURED)
    landed = captured | (going & (impact.outcome == Outcome.IMPACT))
    surface = scenes.platform
    rebound = impact.velocity_after_nm_per_us - surface.velocity(impact.time_us)
    leaving = Departure(impact.time_us, jnp.zeros_like(rebound), impact.velocity_after_nm_per_us)
    no = jnp.zeros_like(going)
    # without adhesion alone a tip that came to rest may leave again, and chatter comes to an end
    law = impact_law_of(scenes)
    may_rest = landed & (~law.adheres) & (captured | (rebound < jax.vmap(_slowest_chatter)(scenes)))

    (time, gap, velocity), rested, held = again_for(
        jax.vmap(_rest), may_rest, (scenes, impact), (leaving, no, no), block=_FEW
    )
    stuck = (captured & law.adheres) | held
    goes_on = landed & ~stuck
    outcome = jnp.where(goes_on, Outcome.IMPACT, jnp.where(stuck, Outcome.CAPTURED, impact.outcome))
    whole = jnp.floor(jnp.where(goes_on, time, 0.0) / surface.period_us)
    end = Tips(
        time_us=jnp.where(goes_on, time - whole * surface.period_us, tips.time_us),
        periods=tips.periods + whole,
        gap_nm=jnp.where(goes_on, gap, 0.0),
        velocity_nm_per_us=jnp.where(goes_on, velocity, tips.velocity_nm_per_us),
        outcome=jnp.where(going, outcome, tips.outcome).astype(tips.outcome.dtype),
    )
    return MapStep(tips, impact, rested, end)


def _one_impact(scene: Scene, tip: Tips, *, max_steps: int) -> NextImpact:
    departure = Departure(tip.time_us, tip.gap_nm, tip.velocity_nm_per_us)
    return impact_after(scene, departure, Search(max_steps), flies=tip.outcome == Outcome.IMPACT)


def _slowest_chatter(scene: Scene) -> Float[Array, ""]:
    """Return a bound in nm/us of the rebound speeds from which on impacts may be summed up (`law_motion.chatter`)."""
    surface, bed = scene.platform, Bed(scene.cantilever, scene.platform)
    omega, decay = scene.cantilever.angular_frequency, scene.cantilever.decay_rate
    reach = jnp.abs(surface.offset_nm) + surface.amplitude_nm
    push = surface.largest_acceleration_nm_per_us2 + 2.0 * decay * surface.top_speed_nm_per_us + omega**2 * reach
    return 0.5 * CONSTANT_PUSH * push * (1.0 - impact_law_of(scene).slow_restitution) / bed.fastest


def _rest(scene: Scene, impact: NextImpact) -> tuple[Departure, Bool[Array, ""], Bool[Array, ""]]:
    """Return where the next flight begins, whether the tip rested before, and whether it does for ever."""
    landed = (impact.outcome == Outcome.IMPACT) | (impact.outcome == Outcome.CAPTURED)
    until = jnp.where(landed, impact.arrival_time_us, 0.0) + _RIDE_PERIODS * scene.platform.period_us
    row, departure, _ = through_impact(scene, impact, landed, until)
    held = row.kind == ContactKind.HELD
    rested = (row.kind == ContactKind.CHATTER) | (impact.outcome == Outcome.CAPTURED)
    return departure, rested & ~held, held


class Record(NamedTuple):
    """What is kept of impacts, arrays (lanes, impacts); NaN where there was none. Times within the drive's period."""

    arrival_us: Float[Any, "lanes impacts"]
    approach_nm_per_us: Float[Any, "lanes impacts"]
    departure_us: Float[Any, "lanes impacts"]
    """After a rest that of the release."""
    velocity_after_nm_per_us: Float[Any, "lanes impacts"]
    arrival_periods: Float[Any, "lanes impacts"]
    """Whole drive periods before the arrival."""
    departure_periods: Float[Any, "lanes impacts"]
    near_grazing: Bool[Any, "lanes impacts"]
    rested: Bool[Any, "lanes impacts"]

    def turns(self, period_us: Float[np.ndarray, " lanes"]) -> Float[np.ndarray, "lanes impacts"]:
        """Return the times of the departures in drive periods."""
        return self.departure_periods + self.departure_us / period_us[:, None]


@partial(jax.jit, static_argnames=("impacts",))
def skipped(scenes: Scene, tips: Tips, *, impacts: int) -> Tips:
    """Return a block of tips some impacts later."""
    return lax.fori_loop(0, impacts, lambda _, now: advance(scenes, now).end, tips)


@partial(jax.jit, static_argnames=("impacts",))
def recorded(scenes: Scene, tips: Tips, *, impacts: int) -> tuple[Tips, Record]:
    """Return a block of tips some impacts later, and the impacts, with axes (impacts, lanes)."""

    def one(now: Tips, _: None) -> tuple[Tips, Record]:
        step = advance(scenes, now)
        return step.end, record_of(scenes, step)

    return lax.scan(one, tips, length=impacts)


def record_of(scenes: Scene, step: MapStep) -> Record:
    """Return what is kept of a step, arrays of one lane a tip."""
    impact, end = step.impact, step.end
    landed = (step.start.outcome == Outcome.IMPACT) & (end.outcome == Outcome.IMPACT)
    platform = scenes.platform
    arrival = jnp.where(landed, impact.arrival_time_us, 0.0)
    whole = jnp.floor(arrival / platform.period_us)
    approach = platform.velocity(arrival) - impact.velocity_before_nm_per_us

    def known(value: Array) -> Array:
        return jnp.where(landed, value, jnp.nan)

    return Record(
        arrival_us=known(arrival - whole * platform.period_us),
        approach_nm_per_us=known(approach),
        departure_us=known(end.time_us),
        velocity_after_nm_per_us=known(end.velocity_nm_per_us),
        arrival_periods=known(step.start.periods + whole),
        departure_periods=known(end.periods),
        near_grazing=landed & impact.near_grazing,
        rested=landed & step.rested,
    )


def evenly_spread(count: int) -> Float[np.ndarray, "count 2"]:
    """Return pairs that fill the unit square evenly: multiples of the plastic number's inverse powers, modulo 1."""
    plastic = 1.324717957244746
    return np.arange(1.0, count + 1.0)[:, None] / [plastic, plastic**2] % 1.0


def leaving_tips(scenes: Scene) -> Tips:
    """Return tips that leave the platform upward at its highest speed, at that speed again or twice the capture speed.

    Args:
        scenes: a batch of scenes.
    """
    platform, interaction = scenes.platform, scenes.interaction
    time = 0.75 * platform.period_us
    if isinstance(interaction, Contact):
        slowest, gap = jax.vmap(capture_speed)(interaction, scenes.cantilever.mass_ng), interaction.bridge_breaks_nm
    else:
        slowest, gap = impact_law_of(scenes).capture_speed_nm_per_us, jnp.zeros_like(time)
    rebound = jnp.maximum(platform.top_speed_nm_per_us, jnp.where(jnp.isfinite(slowest), 2.0 * slowest, 0.0))
    return tips_at(scenes, time, platform.velocity(time) + rebound)._replace(gap_nm=gap)


def bouncing_tips(scenes: Scene) -> Tips:
    """Return tips where there is motion: on the stable single-impact orbit of the order nearest to resonance.

    The fastest one if there are several; of a contact that of the law closest to it. Where there is none the tip is one
    of `leaving_tips`.

    Args:
        scenes: a batch of scenes, driven by the sample alone.
    """
    usual, gap = leaving_tips(scenes), jnp.zeros_like(scenes.platform.frequency_khz)
    found = laws_of(scenes)
    if found is None:
        return usual
    law, known = found
    if isinstance(scenes.interaction, Contact):
        gap = scenes.interaction.bridge_breaks_nm

    def work(lanes: tuple[Scene, Array]) -> tuple[Array, Tips]:
        return _on_orbits(*lanes)

    there, tips = in_blocks(work, (Scene(scenes.cantilever, scenes.platform, law), gap), block=_ORBITS_AT_ONCE)
    return jax.tree.map(lambda own, other: jnp.where(there & known, own, other), tips, usual)


@jax.jit
def _on_orbits(scenes: Scene, clearance_nm: Float[Array, " lanes"]) -> tuple[Bool[Array, " lanes"], Tips]:
    """Return which scenes with laws have a stable orbit, and tips on them, about as high above the platform as told."""

    def one(scene: Scene, clearance: Array) -> tuple[Array, ...]:
        platform = scene.platform
        order = jnp.round(platform.angular_frequency / (2.0 * scene.cantilever.angular_frequency))
        law = impact_law_of(scene)
        orbit, steady = fastest_steady_orbit(orbit_problem(scene.cantilever, platform, law, jnp.maximum(1.0, order)))
        start, velocity = orbit.flight.start_us, orbit.flight.start_velocity
        rise = clearance / orbit.speeds.rebound
        height, speed = scene.cantilever.propagator(rise)(platform.position(start), velocity)
        gap = jnp.where(clearance > 0.0, height - platform.position(start + rise), 0.0)
        risen = (clearance == 0.0) | (gap > _RISEN * clearance)
        return steady & risen & law.leaves, (start + rise) % platform.period_us, gap, speed

    there, time, gap, velocity = jax.vmap(one)(scenes, clearance_nm)
    return there, tips_at(scenes, time, velocity)._replace(gap_nm=gap)


def laws_of(scenes: Scene) -> tuple[Law, Bool[np.ndarray, " lanes"]] | None:
    """Return a batch of laws, those closest to the contacts of scenes with one, and where there is one; None: nowhere.

    Args:
        scenes: a batch of scenes.
    """
    if not isinstance(scenes.interaction, Contact):
        return impact_law_of(scenes), np.ones(len(scenes.platform.frequency_khz), bool)
    columns = [np.asarray(leaf) for leaf in (*jax.tree.leaves(scenes.interaction), scenes.cantilever.mass_ng)]
    _, first, owner = np.unique(np.stack(columns, axis=1), axis=0, return_index=True, return_inverse=True)
    each = []
    for lane in first:
        contact = jax.tree.map(lambda leaf, lane=lane: jnp.asarray(leaf)[lane], scenes.interaction)
        each.append(law_of_contact(contact, float(columns[-1][lane])))
    some = next((law for law in each if law is not None), None)
    if some is None:
        return None
    known = np.array([law is not None for law in each])[owner.ravel()]
    whole = jax.tree.map(lambda *parts: jnp.stack(parts), *(some if law is None else law for law in each))
    return jax.tree.map(lambda leaf: leaf[owner.ravel()], whole), known


def tips_at(scenes: Scene, time_us: Array, velocity_nm_per_us: Array) -> Tips:
    """Return tips that leave the platform at a time in us with a velocity in nm/us in the lab; arrays of one shape."""
    zero = jnp.zeros_like(scenes.platform.frequency_khz)
    going = jnp.full(zero.shape, int(Outcome.IMPACT), jnp.int32)
    return Tips(zero + time_us, zero, zero, zero + velocity_nm_per_us, going)


@jax.jit
def landed_tips(scenes: Scene, start: State) -> Tips:
    """Return tips just after the first impact of a flight from anywhere above the platform, or of a rest on it.

    Args:
        scenes: a batch of scenes.
        start: time, height and velocity in the lab, one value for all or one a scene.
    """

    def one(scene: Scene, start: State) -> NextImpact:
        gap = start.position_nm - scene.platform.position(start.time_us)
        # on the surface but for rounding
        gap = jnp.where(jnp.abs(gap) < _TOUCHING * (jnp.abs(start.position_nm) + scene.platform.amplitude_nm), 0.0, gap)
        departure = Departure(start.time_us, gap, start.velocity_nm_per_us)
        return or_rest(scene, departure, impact_after(scene, departure, Search(MAX_STEPS, from_above=True)))

    whole = State(*(jnp.broadcast_to(part, scenes.platform.frequency_khz.shape) for part in start))
    return _landed(scenes, tips_at(scenes, whole.time_us, whole.velocity_nm_per_us), jax.vmap(one)(scenes, whole)).end


def batch_and_tips(scene: Scene, start: State | None = None) -> tuple[Scene, Tips]:
    """Return one scene or many as a batch of scenes, and where their tips begin.

    Args:
        scene: one scene, or a batch of scenes.
        start: the tip in the lab; None: `default_start` of one scene, of many `bouncing_tips`.

    Raises:
        ValueError: if the tip cannot start there.
    """
    if scene.platform.frequency_khz.ndim == 0:
        start = default_start(scene) if start is None else start
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

    def response(self, time_us: ArrayLike) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
        """Return height and velocity of what the frame leaves out, at a time of its clock: the free tip's response."""
        time, wave = jnp.asarray(time_us), self.frame.response
        if wave is None:
            return jnp.zeros_like(time), jnp.zeros_like(time)
        cosine, sine, omega = (
            part.reshape(*part.shape, *[1] * (time.ndim - part.ndim))
            for part in (wave.cosine, wave.sine, wave.angular_frequency)
        )
        turned = jnp.cos(omega * time), jnp.sin(omega * time)
        return cosine * turned[0] + sine * turned[1], omega * (sine * turned[0] - cosine * turned[1])


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
        raise ValueError("the drive has several frequencies, so that no period of the drive repeats")
    if not np.all(np.asarray(frame.platform.amplitude_nm) > 0.0):
        raise ValueError("`amplitude_nm` of the platform must be positive here: on a resting platform motion dies away")
    if frame.response is not None:
        scenes = Scene(scenes.cantilever, frame.platform, scenes.interaction)
    return SampleDriven(scenes, frame)
