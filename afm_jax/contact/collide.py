"""Batches of collisions: many speeds, or many contacts, in blocks of flat memory."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, ArrayLike, Float

from afm_jax.contact.accuracy_settings import CAREFUL, Setting, setting_of
from afm_jax.contact.collision import Collision, collision_of, go_through
from afm_jax.contact.contact import Contact
from afm_jax.contact.junction import Junction, explain_missing_junction, find_junction
from afm_jax.contact.turned import turn_in_bridge
from afm_jax.outcome import CollisionOutcome
from afm_jax.parameters import as_parameter, check_parameter, is_traced

BLOCK = 512
"""Tips computed side by side: few enough to stay in the processor's cache."""


def collide(
    contact: Contact,
    approach_speed_nm_per_us: ArrayLike,
    mass_ng: ArrayLike = 1.0,
    *,
    accuracy: float = 1e-9,
    method: str = "diffrax",
) -> Collision:
    """Return what becomes of free tips that hit a sample at rest.

    Works under `jit`, `vmap`, `grad` and `jvp`, in every parameter of the contact. A million speeds are one call.

    Args:
        contact: the contact; its parameters are numbers, or arrays of the speeds' shape to differ from tip to tip.
        approach_speed_nm_per_us: speeds in nm/us, of any shape.
        mass_ng: the tip's mass in ng; a number, or an array of the speeds' shape.
        accuracy: wanted relative accuracy of the rebound speed, and a tenth of the delay's in us; picks the cheapest
            setting that reaches it (`afm-jax accuracy collide` shows what each costs).
        method: "diffrax" (Runge-Kutta steps in the gap) or "collocation".

    Returns:
        A `Collision` with arrays of the speeds' shape.

    Raises:
        ValueError: if the contact has no junction, the mass is not positive, shapes do not fit, or there is no such
            method or accuracy. Speeds that are not positive and finite are outcomes, not errors.

    >>> import jax
    >>> with jax.enable_x64(True):
    ...     print(round(float(collide(Contact.paper(), 20.0).rebound_speed_nm_per_us), 4))
    16.6251
    """
    setting = setting_of(method, accuracy)
    check_parameter("mass_ng", mass_ng, "positive")
    speeds = as_parameter(approach_speed_nm_per_us)
    mass = jnp.asarray(mass_ng, speeds.dtype)
    for leaf in (*jax.tree.leaves(contact), mass):
        if leaf.ndim and leaf.shape != speeds.shape:
            raise ValueError(
                f"parameters must be numbers or have the speeds' shape {speeds.shape}, but one has {leaf.shape}"
            )
    result = _collide(contact, speeds, mass, setting)
    _complain(contact, result)
    return result


def _complain(contact: Contact, result: Collision) -> None:
    """Raise for a single contact that has no junction at all."""
    if is_traced(result.outcome) or any(leaf.ndim for leaf in jax.tree.leaves(contact)):
        return
    if np.any(np.asarray(result.outcome) == CollisionOutcome.NO_JUNCTION):
        raise ValueError(f"the contact has no junction: {explain_missing_junction(contact)}")


@partial(jax.jit, static_argnames="setting")
def _collide(contact: Contact, speeds: Float[Array, "..."], mass: Float[Array, "..."], setting: Setting) -> Collision:
    leaves, structure = jax.tree.flatten((contact, mass))
    varied = [leaf.ndim > 0 for leaf in leaves]
    contact_varies = any(varied[:-1])
    junction = None if contact_varies else find_junction(contact)

    def block(values: tuple[Array, ...]) -> Collision:
        speed, *own = values
        rest = iter(own)
        lanes = [next(rest) if varies else leaf for varies, leaf in zip(varied, leaves, strict=True)]
        return _collide_block(*jax.tree.unflatten(structure, lanes), junction, speed, setting)

    columns = [speeds.ravel(), *(leaf.ravel() for leaf, varies in zip(leaves, varied, strict=True) if varies)]
    size = columns[0].shape[0]
    if size <= BLOCK:
        result = block(tuple(columns))
        return jax.tree.map(lambda part: part.reshape(speeds.shape), result)
    rows = -(-size // BLOCK)
    # the last block is filled up with the last tip
    filled = [jnp.concatenate([column, jnp.broadcast_to(column[-1:], (rows * BLOCK - size,))]) for column in columns]
    result = lax.map(block, tuple(column.reshape(rows, BLOCK) for column in filled))
    return jax.tree.map(lambda part: part.reshape(rows * BLOCK)[:size].reshape(speeds.shape), result)


def _collide_block(contact, mass, junction: Junction | None, speeds: Array, setting: Setting) -> Collision:
    """Return the collisions of one block; those that few steps do not resolve are computed again with many."""
    axes = jax.tree.map(lambda leaf: 0 if leaf.ndim else None, (contact, mass))
    lanes_differ = any(leaf.ndim for leaf in jax.tree.leaves(contact))

    def one(contact, mass, speed):
        place = find_junction(contact) if junction is None else junction
        valid = (speed > 0.0) & jnp.isfinite(speed)
        safe = jnp.where(valid, speed, 1.0)
        ways = go_through(contact, place, safe, mass, setting)
        return place, safe, collision_of(contact, place, safe, mass, ways), ways.resolved, valid

    place, safe, quick, resolved, valid = jax.vmap(
        one, in_axes=(*axes, 0), out_axes=(0 if lanes_differ else None, 0, 0, 0, 0)
    )(contact, mass, speeds)

    def careful():
        return jax.vmap(_careful, in_axes=(axes[0], 0 if lanes_differ else None, axes[1], 0))(
            contact, place, mass, safe
        )

    checked = lax.cond(jnp.all(resolved | ~valid), lambda: (quick, resolved), careful)
    result = jax.tree.map(lambda fast, slow: jnp.where(resolved, fast, slow), quick, checked[0])
    trusted = resolved | checked[1]
    exists = place.exists
    outcome = jnp.where(trusted, result.outcome, CollisionOutcome.UNRESOLVED)
    outcome = jnp.where(exists, outcome, CollisionOutcome.NO_JUNCTION)
    outcome = jnp.where(valid, outcome, CollisionOutcome.INVALID_START).astype(jnp.int32)
    good = outcome <= CollisionOutcome.CAPTURED_BY_JUNCTION
    cleared = jax.tree.map(lambda part: jnp.where(good, part, jnp.zeros_like(part)), result)
    return cleared._replace(approach_speed_nm_per_us=speeds, outcome=outcome)


def _careful(contact, place: Junction, mass, speed):
    """Return one collision in many steps, and whether these resolve it."""
    ways = go_through(contact, place, speed, mass, CAREFUL)
    through = collision_of(contact, place, speed, mass, ways)
    turn = turn_in_bridge(contact, place, speed, mass, ways.inward.dissipated_aj)
    leaves = turn.energy_aj > 0.0
    rebound = jnp.where(leaves, jnp.sqrt(2.0 * jnp.where(leaves, turn.energy_aj, 1.0) / mass), 0.0)
    outside = contact.bridge_forms_nm / speed + contact.bridge_breaks_nm / jnp.where(leaves, rebound, 1.0)
    turned = through._replace(
        rebound_speed_nm_per_us=rebound,
        collision_delay_us=jnp.where(leaves, turn.time_us - outside, 0.0),
        captured=~leaves,
        outcome=jnp.where(leaves, CollisionOutcome.TURNED_IN_BRIDGE, CollisionOutcome.CAPTURED_BY_BRIDGE).astype(
            jnp.int32
        ),
        time_in_contact_us=jnp.where(leaves, turn.time_us, 0.0),
        time_in_junction_us=jnp.zeros_like(rebound),
        deepest_gap_nm=turn.gap_nm,
        junction_hysteresis_aj=jnp.zeros_like(rebound),
        viscous_loss_aj=turn.dissipated_aj,
        end_energy_aj=turn.energy_aj,
    )
    result = jax.tree.map(lambda a, b: jnp.where(turn.turns, a, b), turned, through)
    start = 0.5 * mass * speed**2
    # dissipation cannot exceed what there was: the start's energy and what the bridge's pull adds
    sane = jnp.isfinite(result.end_energy_aj) & jnp.isfinite(result.viscous_loss_aj) & jnp.isfinite(start)
    return result, sane
