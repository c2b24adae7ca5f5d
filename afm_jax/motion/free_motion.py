"""A free cantilever in time: no contacts, only the state at the end."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from afm_jax.apparatus.platform import Platform
from afm_jax.apparatus.scene import Scene
from afm_jax.apparatus.surface import Surface
from afm_jax.contact.phases import Phase
from afm_jax.motion.record import Contacts, MotionOutcome, Simulation, State


@jax.jit
def follow_free(
    scene: Scene, surface: Platform | Surface, response: Surface | None, start: State, until: Float[Array, ""]
) -> Simulation:
    """Return a free tip at the end of a simulation, in closed form; no contacts.

    Args:
        scene: the scene.
        surface: what its tip sees; not met.
        response: the steady response to drives of base and tip, or None.
        start: the tip at the start, in the lab.
        until: time of the end in us.
    """
    del surface
    position, velocity = start.position_nm, start.velocity_nm_per_us
    if response is not None:
        steady, rate = response.position_and_velocity(start.time_us)
        position, velocity = position - steady, velocity - rate
    position, velocity = scene.cantilever.propagator(until - start.time_us)(position, velocity)
    if response is not None:
        steady, rate = response.position_and_velocity(until)
        position, velocity = position + steady, velocity + rate
    none = jnp.zeros((0,), position.dtype)
    count = jnp.zeros((), jnp.int32)
    sane = jnp.isfinite(position) & jnp.isfinite(velocity)
    outcome = jnp.where(sane, MotionOutcome.FINISHED, MotionOutcome.INVALID_START).astype(jnp.int32)
    return Simulation(
        start=start,
        contacts=Contacts(none.astype(jnp.int32), *[none] * 9, detail=None),
        count=count,
        final=State(until, position, velocity),
        phase=jnp.full_like(count, Phase.DRY),
        held=jnp.zeros((), bool),
        outcome=outcome,
    )
