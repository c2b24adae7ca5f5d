"""Batches of collisions: many speeds, or many contacts, in blocks of flat memory."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, ArrayLike, Bool, Float

from afm_jax.contact.accuracy_settings import CAREFUL, Setting, setting_of
from afm_jax.contact.collision import Collision, collision_of, collision_of_turn, go_through
from afm_jax.contact.contact import Contact
from afm_jax.contact.junction import Junction, explain_missing_junction, find_junction
from afm_jax.contact.turned import Turn, turn_in_bridge
from afm_jax.outcome import CollisionOutcome
from afm_jax.parameters import as_parameter, check_parameter, is_traced
from afm_jax.stored_program import stored

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
    # one axis of tips inside, the speeds' own shape outside
    contact, mass = jax.tree.map(lambda leaf: leaf.ravel() if leaf.ndim else leaf, (contact, mass))
    quick, resolved = _quick(contact, mass, speeds.ravel(), setting)
    result = _resolve(contact, mass, speeds.ravel(), quick, resolved)
    _complain(contact, result)
    return jax.tree.map(lambda part: part.reshape(speeds.shape), result)


def collide_in_blocks(
    contact: Contact,
    speeds: Float[np.ndarray, " n"],
    mass_ng: float = 1.0,
    *,
    accuracy: float = 1e-9,
    method: str = "diffrax",
) -> dict[str, np.ndarray]:
    """Return the fields of `Collision` of many speeds, filled up to whole blocks so that one program serves all.

    Raises:
        ValueError: as `collide`.
    """
    size = BLOCK * -(-len(speeds) // BLOCK)
    filled = np.concatenate([speeds, np.full(size - len(speeds), speeds[-1])])
    found = collide(contact, filled, mass_ng, accuracy=accuracy, method=method)
    return {name: np.asarray(part)[: len(speeds)] for name, part in found._asdict().items()}


def batch_of(contact: Contact, mass_ng: ArrayLike, speeds: Float[Array, " tips"], setting: Setting) -> Collision:
    """Return a batch by one setting, without a second look at what its few steps do not resolve: for measurements."""
    return _quick(contact, jnp.asarray(mass_ng, speeds.dtype), speeds, setting)[0]


def _complain(contact: Contact, result: Collision) -> None:
    """Raise for a single contact that has no junction at all."""
    if is_traced(result.outcome) or any(leaf.ndim for leaf in jax.tree.leaves(contact)):
        return
    if np.any(np.asarray(result.outcome) == CollisionOutcome.NO_JUNCTION):
        raise ValueError(f"the contact has no junction: {explain_missing_junction(contact)}")


@stored("setting")
def _quick(
    contact: Contact, mass: Float[Array, "..."], speeds: Float[Array, "..."], setting: Setting
) -> tuple[Collision, Bool[Array, "..."]]:
    """Return the collisions of a batch in few steps, and which of them these resolve."""
    leaves = jax.tree.leaves(contact)
    shared = None if any(leaf.ndim for leaf in leaves) else find_junction(contact)

    def one(contact, mass, speed):
        place = _junctions(contact) if shared is None else shared
        valid = (speed > 0.0) & jnp.isfinite(speed)
        safe = jnp.where(valid, speed, 1.0)
        ways = go_through(contact, place, safe, mass, setting)
        found = collision_of(contact, place, safe, mass, ways)
        return _judged(found, speed, place.exists, valid), ways.resolved | ~valid | ~place.exists

    return _in_blocks(one, contact, mass, speeds)


@stored()
def _careful(contact: Contact, mass: Float[Array, "..."], speeds: Float[Array, "..."]) -> Collision:
    """Return the collisions of a batch in many steps, turning points in the bridge included."""

    def one(contact, mass, speed):
        place = _junctions(contact)
        valid = (speed > 0.0) & jnp.isfinite(speed)
        safe = jnp.where(valid, speed, 1.0)
        ways = go_through(contact, place, safe, mass, CAREFUL)
        turn = _turns(contact, place, mass, safe, ways.inward.dissipated_aj)
        through = collision_of(contact, place, safe, mass, ways)
        turned = collision_of_turn(contact, place, safe, mass, turn)
        turns = turn.turns & (ways.inward.energy_aj <= 0.0)
        found = jax.tree.map(lambda a, b: jnp.where(turns, a, b), turned, through)
        finite = jnp.isfinite(found.end_energy_aj) & jnp.isfinite(found.viscous_loss_aj) & (turn.settled | ~turns)
        return _judged(found, speed, place.exists, valid, finite), finite

    return _in_blocks(one, contact, mass, speeds)[0]


def _axes(tree: Any) -> Any:
    """Return the axes of `vmap` for parameters that are numbers or have one value a tip."""
    return jax.tree.map(lambda leaf: 0 if leaf.ndim else None, tree)


def _junctions(contact: Contact) -> Junction:
    """Return the junction of a contact, or of each of many."""
    if not any(leaf.ndim for leaf in jax.tree.leaves(contact)):
        return find_junction(contact)
    return jax.vmap(find_junction, in_axes=(_axes(contact),))(contact)


def _turns(contact: Contact, place: Junction, mass: Array, speeds: Array, spent: Array) -> Turn:
    return jax.vmap(turn_in_bridge, in_axes=(_axes(contact), _axes(place), 0, _axes(mass), 0))(
        contact, place, speeds, mass, spent
    )


def _judged(found: Collision, speed: Array, exists: Array, valid: Array, finite: ArrayLike = True) -> Collision:  # noqa: FBT002
    """Return a collision with its outcome, and with zeros where there is none."""
    outcome = jnp.where(finite, found.outcome, CollisionOutcome.UNRESOLVED)
    outcome = jnp.where(exists, outcome, CollisionOutcome.NO_JUNCTION)
    outcome = jnp.where(valid, outcome, CollisionOutcome.INVALID_START).astype(jnp.int32)
    good = outcome <= CollisionOutcome.CAPTURED_BY_JUNCTION
    cleared = jax.tree.map(lambda part: jnp.where(good, part, jnp.zeros_like(part)), found)
    return cleared._replace(approach_speed_nm_per_us=speed, outcome=outcome)


def _in_blocks(one: Callable, contact: Contact, mass: Float[Array, "..."], speeds: Float[Array, "..."]) -> Any:
    """Map a collision over a batch, in blocks that stay in the processor's cache: memory does not grow with it."""
    leaves, structure = jax.tree.flatten((contact, mass))
    varied = [leaf.ndim > 0 for leaf in leaves]

    def block(columns: list[Array]) -> Any:
        speed, *own = columns
        rest = iter(own)
        lanes = [next(rest) if varies else leaf for varies, leaf in zip(varied, leaves, strict=True)]
        return one(*jax.tree.unflatten(structure, lanes), speed)

    columns = [speeds, *(leaf for leaf, varies in zip(leaves, varied, strict=True) if varies)]
    size = speeds.shape[0]
    if size <= BLOCK:
        return block(columns)
    rows = -(-size // BLOCK)
    # the last block is filled up with the last tip
    filled = [jnp.concatenate([column, jnp.broadcast_to(column[-1:], (rows * BLOCK - size,))]) for column in columns]
    result = lax.map(jax.checkpoint(block), [column.reshape(rows, BLOCK) for column in filled])
    return jax.tree.map(lambda part: part.reshape(rows * BLOCK)[:size], result)


def _resolve(
    contact: Contact, mass: Float[Array, "..."], speeds: Float[Array, "..."], quick: Collision, resolved: Array
) -> Collision:
    """Return the quick collisions, with those that few steps do not resolve computed again in many.

    Where the numbers can be looked at, only those tips are computed again; inside `jit` all are, if any needs it.
    """
    if is_traced(resolved):
        # recomputed in reverse mode: what many steps leave behind would not fit into memory
        careful = jax.checkpoint(lambda: _careful(contact, mass, speeds))
        again = lax.cond(jnp.all(resolved), lambda: quick, careful)
        return jax.tree.map(lambda fast, slow: jnp.where(resolved, fast, slow), quick, again)
    open_tips = np.flatnonzero(~np.asarray(resolved))
    if not open_tips.size:
        return quick
    # sizes are rounded up to powers of two, so that few programs serve all batches
    chosen = np.resize(open_tips, 1 << int(np.ceil(np.log2(open_tips.size))))
    own_contact, own_mass = jax.tree.map(lambda leaf: leaf[chosen] if leaf.ndim else leaf, (contact, mass))
    slow = _careful(own_contact, own_mass, speeds[chosen])
    count = open_tips.size
    return jax.tree.map(lambda fast, careful: fast.at[open_tips].set(careful[:count]), quick, slow)
