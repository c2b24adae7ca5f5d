"""Between the lab and the gap: heights and velocities of the tip against the surface that it sees."""

import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from afm_jax.apparatus.platform import Platform
from afm_jax.apparatus.surface import Surface
from afm_jax.motion.record import State


def to_gap(
    surface: Platform | Surface, response: Surface | None, state: State
) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
    """Return gap in nm and gap rate in nm/us of a state in the lab; arrays of any shape."""
    height, speed = surface.position_and_velocity(state.time_us)
    position, velocity = jnp.asarray(state.position_nm), jnp.asarray(state.velocity_nm_per_us)
    if response is not None:
        steady, rate = response.position_and_velocity(state.time_us)
        position, velocity = position - steady, velocity - rate
    return position - height, velocity - speed


def to_lab(
    surface: Platform | Surface, response: Surface | None, time_us: ArrayLike, gap_nm: ArrayLike, gap_rate: ArrayLike
) -> State:
    """Return the state in the lab of a gap in nm and its rate in nm/us; arrays of any shape."""
    height, speed = surface.position_and_velocity(time_us)
    position, velocity = jnp.asarray(gap_nm) + height, jnp.asarray(gap_rate) + speed
    if response is not None:
        steady, rate = response.position_and_velocity(time_us)
        position, velocity = position + steady, velocity + rate
    return State(jnp.asarray(time_us), position, velocity)
