"""The capture speed: the approach speed below which a contact does not let the tip go again."""

import math

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, ArrayLike, Float

from afm_jax.contact.accuracy_settings import CAREFUL
from afm_jax.contact.collision import go_through
from afm_jax.contact.contact import Contact
from afm_jax.contact.junction import Junction, explain_missing_junction, find_junction
from afm_jax.contact.turned import turn_in_bridge
from afm_jax.impact.implicit import implicit_root
from afm_jax.parameters import as_parameter, check_parameter, is_traced, refuse_float32

_POINTS = 64
_ROUNDS = 9


def capture_speed(contact: Contact, mass_ng: ArrayLike = 1.0) -> Float[Array, ""]:
    """Return the approach speed in nm/us at which the tip would come to rest where contact ends.

    It is the root of the kinetic energy that is left there, which is a smooth function of the approach speed with a
    sign; the largest root, if there are several. 0 if every tip leaves, infinite if none does up to a thousand times
    the speed that hysteresis alone would ask for. Differentiable in every parameter.

    Args:
        contact: the contact, of numbers.
        mass_ng: the tip's mass in ng.

    Raises:
        RuntimeError: if the contact was built before JAX was set to the 64-bit floats that it now computes in.
        ValueError: if the contact has no junction, or the mass is not positive.
    """
    refuse_float32(contact)
    check_parameter("mass_ng", mass_ng, "positive")
    speed, exists = _capture_speed(contact, as_parameter(mass_ng))
    if not is_traced(exists) and not bool(exists):
        raise ValueError(f"the contact has no junction: {explain_missing_junction(contact)}")
    return speed


@jax.jit
def _capture_speed(contact: Contact, mass: Float[Array, ""]) -> tuple[Array, Array]:
    junction = find_junction(contact)
    fixed = lax.stop_gradient((contact, junction, mass))
    # sqrt(2 hysteresis / m) without dissipation, which raises it; less where the bridge turns the tip round
    scale = jnp.log(jnp.sqrt(2.0 * jnp.maximum(fixed[1].hysteresis_aj, 1e-6) / fixed[2]))
    width = jnp.asarray([math.log(0.01), math.log(1e3)], scale.dtype)

    def narrow(ends, _):
        # one small program for all rounds: the first looks far and wide, each further one inside an interval
        points = ends[0] + (ends[1] - ends[0]) * jnp.linspace(0.0, 1.0, _POINTS, dtype=scale.dtype)
        held = jax.vmap(lambda point: end_energy(jnp.exp(point), fixed))(points) <= 0.0
        last = _POINTS - 1 - jnp.argmax(held[::-1])
        inside = jnp.stack([points[last], points[jnp.minimum(last + 1, _POINTS - 1)]])
        return inside, (held.any(), held[-1])

    ends, (any_held, top_held) = lax.scan(narrow, scale + width, None, length=_ROUNDS)
    found = jnp.exp(ends[0])
    root = implicit_root(end_energy, found, (contact, junction, mass))
    held = jnp.where(top_held[0], jnp.inf, root)
    return jnp.where(any_held[0], held, 0.0), junction.exists


def end_energy(approach_speed: Float[Array, ""], model: tuple[Contact, Junction, Float[Array, ""]]) -> Float[Array, ""]:
    """Return the kinetic energy left where the tip has least on its way out, in aJ; negative by what is missing."""
    contact, junction, mass = model
    ways = go_through(contact, junction, approach_speed, mass, CAREFUL)
    through = jnp.minimum(ways.junction.energy_aj, ways.outward.energy_aj)
    turn = turn_in_bridge(contact, junction, approach_speed, mass, ways.inward.dissipated_aj)
    return jnp.where(turn.turns & (ways.inward.energy_aj <= 0.0), turn.energy_aj, through)
