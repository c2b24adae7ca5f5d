"""The capture speed: the approach speed below which a contact does not let the tip go again."""

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
from afm_jax.parameters import as_parameter, check_parameter, is_traced

_SCAN = 96
_HALVINGS = 52


def capture_speed(contact: Contact, mass_ng: ArrayLike = 1.0) -> Float[Array, ""]:
    """Return the approach speed in nm/us at which the tip would come to rest where contact ends.

    It is the root of the kinetic energy that is left there, which is a smooth function of the approach speed with a
    sign; the largest root, if there are several. 0 if every tip leaves, infinite if none does up to a thousand times
    the speed that hysteresis alone would ask for. Differentiable in every parameter.

    Args:
        contact: the contact, of numbers.
        mass_ng: the tip's mass in ng.

    Raises:
        ValueError: if the contact has no junction, or the mass is not positive.
    """
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
    least = jnp.sqrt(2.0 * jnp.maximum(lax.stop_gradient(junction.hysteresis_aj), 1e-6) / fixed[2])
    speeds = least * jnp.geomspace(0.01, 1e3, _SCAN, dtype=least.dtype)
    bound = jax.vmap(lambda speed: end_energy(speed, fixed))(speeds) <= 0.0
    last = _SCAN - 1 - jnp.argmax(bound[::-1])

    def halve(_, ends):
        middle = 0.5 * (ends[0] + ends[1])
        held = end_energy(middle, fixed) <= 0.0
        return jnp.where(held, middle, ends[0]), jnp.where(held, ends[1], middle)

    ends = speeds[last], speeds[jnp.minimum(last + 1, _SCAN - 1)]
    found, _ = lax.fori_loop(0, _HALVINGS, halve, ends)
    root = implicit_root(end_energy, found, (contact, junction, mass))
    held = jnp.where(bound[-1], jnp.inf, root)
    return jnp.where(bound.any(), held, 0.0), junction.exists


def end_energy(approach_speed: Float[Array, ""], model: tuple[Contact, Junction, Float[Array, ""]]) -> Float[Array, ""]:
    """Return the kinetic energy left where the tip has least on its way out, in aJ; negative by what is missing."""
    contact, junction, mass = model
    ways = go_through(contact, junction, approach_speed, mass, CAREFUL)
    through = jnp.minimum(ways.junction.energy_aj, ways.outward.energy_aj)
    turn = turn_in_bridge(contact, junction, approach_speed, mass, ways.inward.dissipated_aj)
    return jnp.where(turn.turns & (ways.inward.energy_aj <= 0.0), turn.energy_aj, through)
