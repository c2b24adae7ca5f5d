"""The phases of contact and their hysteresis: which force law holds depends on where the tip has been.

DRY -> BRIDGE when the gap falls to `bridge_forms_nm`; BRIDGE -> DRY when it rises to `bridge_breaks_nm`;
BRIDGE -> JUNCTION when it falls to D_on; JUNCTION -> BRIDGE at D_off, or straight to DRY where D_off lies beyond the
bridge's range. Within a phase every force is smooth.
"""

import enum

import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float, Int

from afm_jax.checks import as_argument
from afm_jax.contact.contact import Contact
from afm_jax.contact.junction import Junction


class Phase(enum.IntEnum):
    """What is between tip and sample."""

    DRY = 0
    BRIDGE = 1
    JUNCTION = 2


def next_phase(contact: Contact, junction: Junction, phase: ArrayLike, gap_nm: ArrayLike) -> Int[Array, "..."]:
    """Return the phase that follows from a phase once the gap, in nm, has moved; itself if no threshold was crossed."""
    here, gap = jnp.asarray(phase), as_argument(gap_nm)
    from_dry = jnp.where(gap <= contact.bridge_forms_nm, Phase.BRIDGE, Phase.DRY)
    within = jnp.where(gap >= contact.bridge_breaks_nm, Phase.DRY, Phase.BRIDGE)
    from_bridge = jnp.where(gap <= junction.forms_gap_nm, Phase.JUNCTION, within)
    from_junction = jnp.where(gap >= junction.breaks_gap_nm, within, Phase.JUNCTION)
    moved = jnp.where(here == Phase.DRY, from_dry, jnp.where(here == Phase.BRIDGE, from_bridge, from_junction))
    return moved.astype(jnp.int32)


def force_in_phase(
    contact: Contact, junction: Junction, phase: ArrayLike, gap_nm: ArrayLike, gap_rate_nm_per_us: ArrayLike = 0.0
) -> Float[Array, "..."]:
    """Return the force on the tip in nN in a phase, at a gap in nm that changes at a rate in nm/us.

    Nothing acts in DRY, all forces of the bridge in BRIDGE, the JKR contact alone in JUNCTION.
    """
    gap = as_argument(gap_nm)
    dry = jnp.zeros_like(gap)
    # the bridge's forces have no value at contact: there the junction's are meant, and the other branch is guarded
    bridge = contact.forces(jnp.where(gap > 0.0, gap, 1.0), gap_rate_nm_per_us)
    solid = contact.junction.force(junction.shift_nm - gap)
    here = jnp.asarray(phase)
    return jnp.where(here == Phase.DRY, dry, jnp.where(here == Phase.BRIDGE, bridge, solid))
