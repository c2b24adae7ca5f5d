"""Where the solid junction forms, D_on, and where it breaks, D_off, from a contact's parameters.

Takes a contact; gives a `Junction`: gaps in nm, force in nN, stiffness in nN/nm, hysteresis in aJ (eqs. 10 to 15).

An approaching tip changes from the bridge's force curve to the JKR curve where force and stiffness of both are equal.
The force of the bridge at a gap fixes the point of the JKR curve that bears it (closed form), so that the stiffness is
one equation for the gap, which is D_on; the point of the JKR curve fixes where the curve sits on the gap axis, depth =
shift - gap. D_off is the fold of the JKR curve. A dry contact forms and breaks where its solids meet.

Which forces act depends on where the tip has been (`ContactPhase`), and within a phase they are smooth:

    DRY ----- gap falls to bridge_forms_nm ---> BRIDGE ----- gap falls to D_on ----> JUNCTION
    DRY <---- gap rises to bridge_breaks_nm --- BRIDGE <---- gap rises to D_off ---- JUNCTION
    DRY <---- gap rises to D_off, where that lies beyond the bridge's breaking ----- JUNCTION
"""

import enum
import math

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, ArrayLike, Bool, Float

from afm_jax.checks import as_argument, checked, is_traced
from afm_jax.contact.contact import Bridge, Contact, bridge_of
from afm_jax.contact.forces import jkr
from afm_jax.contact.forces.dry import Hertz
from afm_jax.contact.forces.jkr import Jkr
from afm_jax.results import ResultTuple, public_result
from afm_jax.solve.derivatives import implicit_root
from afm_jax.solve.lanes import for_each_lane
from afm_jax.solve.newton_steps import newton_steps

SMALLEST_GAP_NM = 0.01
"""The tangency is looked for between this gap and the one at which the bridge forms."""
_POINTS = 24
"""Gaps of a scan."""
Tangent = tuple[Bridge, Float[Array, "..."], Float[Array, "..."]]
"""The bridge and the JKR contact's units of load and depth."""


@public_result()
class Junction(ResultTuple):
    """The junction of a contact, and the energies that its hysteresis takes; all arrays of the parameters' shape."""

    exists: Bool[Array, "..."]
    """Whether there is a tangency; without one the rest is meaningless."""
    forms_gap_nm: Float[Array, "..."]
    """D_on, the gap at which an approaching tip forms the junction."""
    forms_root: Float[Array, "..."]
    """sqrt(A) of the JKR contact that forms."""
    shift_nm: Float[Array, "..."]
    """Gap at which the JKR depth is 0: depth = shift - gap."""
    breaks_gap_nm: Float[Array, "..."]
    """D_off, the gap at which a leaving tip breaks the junction: the fold of the JKR curve."""
    force_nn: Float[Array, "..."]
    """Force at D_on in nN."""
    stiffness_nn_per_nm: Float[Array, "..."]
    """Stiffness -dF/dD at D_on in nN/nm."""
    bridge_hysteresis_aj: Float[Array, "..."]
    """Energy that stretching the bridge beyond the gap where it formed takes."""
    junction_hysteresis_aj: Float[Array, "..."]
    """Energy that the JKR contact takes beyond the bridge between D_on and D_off."""

    @property
    def hysteresis_aj(self) -> Float[Array, "..."]:
        """Energy lost by hysteresis in one impact, in aJ."""
        return self.bridge_hysteresis_aj + self.junction_hysteresis_aj


@checked
@jax.jit
def find_junction(contact: Contact) -> Junction:
    """Return the gaps at which a contact's solid junction forms and breaks, and the energies that its hysteresis takes.

    A dry contact forms and breaks where its solids meet. Of several tangencies the one that an approaching tip meets
    with the bridge stiffening beyond the JKR contact is taken, at the largest gap; the spurious ones near the JKR
    pull-off cross the other way.

    Args:
        contact: the contact, of numbers; `vmap` serves several.

    Returns:
        The junction, differentiable in every parameter of the contact.

    Raises:
        TypeError: if it is no contact.
    """
    if not isinstance(contact.junction, Jkr):
        return _dry_junction(contact, contact.junction)
    forces, solid, curve = bridge_of(contact), contact.junction, contact.junction.curve
    scales = solid.load_scale_nn, solid.depth_scale_nm
    log_gap, exists = _tangency(lax.stop_gradient((forces, *scales)), lax.stop_gradient(contact.bridge_forms_nm))
    gap = jnp.exp(implicit_root(_excess_stiffness, log_gap, (forces, *scales)))
    force = forces.force(gap)
    root = jkr.root_of_load(force / solid.load_scale_nn)
    shift = gap + solid.depth_scale_nm * curve.depth(root)
    breaks = shift - solid.pull_off_depth_nm
    stretched = forces.potential(contact.bridge_breaks_nm) - forces.potential(contact.bridge_forms_nm)
    # where the junction outlives the bridge, what it takes beyond the bridge's breaking is its own
    regained = forces.potential(jnp.minimum(breaks, contact.bridge_breaks_nm)) - forces.potential(gap)
    elastic = solid.energy_scale_aj * (curve.work(curve.fold) - curve.work(root))
    return Junction(
        exists=exists & (gap <= contact.bridge_forms_nm) & _meniscus_fits(contact),
        forms_gap_nm=gap,
        forms_root=root,
        shift_nm=shift,
        breaks_gap_nm=breaks,
        force_nn=force,
        stiffness_nn_per_nm=forces.stiffness(gap),
        bridge_hysteresis_aj=stretched,
        junction_hysteresis_aj=elastic - regained,
    )


def _dry_junction(contact: Contact, junction: Hertz) -> Junction:
    """Return the junction of a dry contact, without hysteresis; none where its solids meet outside its range."""
    bridge, gap = bridge_of(contact), junction.begins_nm
    none = jnp.zeros_like(gap)
    return Junction(
        exists=(gap < contact.bridge_forms_nm) | (not bridge.spans),
        forms_gap_nm=gap,
        forms_root=none,
        shift_nm=gap,
        breaks_gap_nm=gap,
        force_nn=bridge.force(gap),
        stiffness_nn_per_nm=bridge.stiffness(gap),
        bridge_hysteresis_aj=none,
        junction_hysteresis_aj=none,
    )


def end_of_contact(contact: Contact) -> Float[Array, "..."]:
    """Return the gap in nm at which contact ends: where the bridge breaks, or the junction where that outlives it.

    Args:
        contact: the contact; its parameters are numbers, or arrays with one axis.
    """
    return jnp.maximum(contact.bridge_breaks_nm, for_each_lane(find_junction, contact).breaks_gap_nm)


def _excess_stiffness(log_gap: Float[Array, "..."], model: Tangent) -> Float[Array, "..."]:
    """Return by how much the bridge is stiffer than the JKR contact that bears the same force, in nN/nm."""
    bridge, load_scale, depth_scale = model
    gap = jnp.exp(log_gap)
    return bridge.stiffness(gap) - jnp.cbrt(_elastic_cube(bridge.force(gap) / load_scale)) * load_scale / depth_scale


def _elastic_cube(load: Float[Array, "..."]) -> Float[Array, "..."]:
    """Return the third power of the JKR contact's normalised stiffness dP/dDelta at a normalised load."""
    cube = jkr.cube_of_load(load)
    # dP/dDelta = s^2 (6 s^3 - 3 sqrt(6))/(4 s^3 - SLOPE); the cube spares the scan a hundred cube roots
    share = (6.0 * cube - 3.0 * math.sqrt(6.0)) / (4.0 * cube - jkr.SLOPE)
    return cube * cube * share * share * share


def _tangency(model: Tangent, forms_nm: Float[Array, ""]) -> tuple[Array, Array]:
    """Return ln D_on and whether it exists: two nested scans for the sign change, then Newton's method."""
    least = jnp.log(jnp.full_like(forms_nm, SMALLEST_GAP_NM))
    ends = least, jnp.maximum(jnp.log(forms_nm), least)
    # in a loop, for copies take long to compile
    (low, high), found = lax.scan(lambda ends, _: _scan(model, *ends), ends, length=2)
    found = found[-1]

    def excess_and_slope(point):
        return jax.jvp(lambda at: _excess_stiffness(at, model), (point,), (jnp.ones_like(point),))

    root = newton_steps(excess_and_slope, 0.5 * (low + high), 4, low, high)
    return jnp.where(found, root, jnp.zeros_like(root)), found


def _scan(model: Tangent, low: Float[Array, ""], high: Float[Array, ""]) -> tuple[tuple[Array, Array], Array]:
    """Return the outermost interval of ln D where the bridge gets stiffer than the JKR contact, and if there is one.

    Without one, the interval around the least excess of stiffness is returned: a narrow crossing may hide there.
    """
    bridge, load_scale, depth_scale = model
    points = jnp.linspace(high, low, _POINTS)
    step, gaps = (high - low) / (_POINTS - 1), jnp.exp(points)
    load = bridge.force(gaps) / load_scale
    stiffness = bridge.stiffness(gaps) * depth_scale / load_scale
    borne = load > -1.5
    excess = stiffness * stiffness * stiffness - _elastic_cube(load)
    crossing = (borne & (excess > 0.0))[1:] & (borne & ~(excess > 0.0))[:-1]
    close = jnp.where(borne & (stiffness > 0.0), excess, jnp.inf)
    found, left = crossing.any(), points[1 + jnp.argmax(crossing)]
    place = jnp.where(jnp.isfinite(close.min()), points[jnp.argmin(close)], low)
    return (jnp.where(found, left, place - step), jnp.where(found, left + step, place + step)), found


def _meniscus_fits(contact: Contact) -> Bool[Array, "..."]:
    """Say whether the Kelvin radius stays below the tip's, where a force of the contact has a liquid."""
    fits = contact.bridge_forms_nm > 0.0
    for term in contact.forces.terms:
        liquid = getattr(term, "liquid", None)
        if liquid is not None:
            fits = fits & (liquid.kelvin_radius_nm < getattr(term, "tip_radius_nm", jnp.inf))
    return fits


def require_junction(contact: Contact, exists: Bool[Array, "..."]) -> None:
    """Raise where a contact of numbers has no junction; whether it has one may be traced, and is then not looked at.

    Raises:
        ValueError: says why there is none.
    """
    if not is_traced(exists) and not np.all(np.asarray(exists)):
        raise ValueError(f"the contact has no junction: {explain_missing_junction(contact)}")


def explain_missing_junction(contact: Contact) -> str:
    """Say in one line why a contact has no junction, and what would mend it."""
    if contact.dry:
        return "the solids meet outside the range of the forces; make `range_nm` larger than `contact_distance_nm`"
    if not bool(_meniscus_fits(contact)):
        return "the Kelvin radius exceeds the tip radius; lower `relative_humidity` or take a larger `tip_radius_nm`"
    gaps = jnp.geomspace(SMALLEST_GAP_NM, contact.bridge_forms_nm, 400)
    bridge = bridge_of(contact)
    stiffness, force = bridge.stiffness(gaps), bridge.force(gaps)
    tension = 1.5 * contact.solid.load_scale_nn
    if not bool((stiffness[0] > 0) & (force[0] > 0)):
        return "the bridge does not get stiffer than the JKR contact as the gap closes: it needs a core repulsion"
    if bool(((force < -tension) & (stiffness > 0.0)).any()):
        return (
            f"the bridge pulls harder than the JKR contact bears in tension ({float(tension):.3g} nN); "
            "a larger `adhesion_energy_j_per_m2` would bear it"
        )
    return (
        f"force and stiffness of bridge and JKR contact are equal at no gap from {SMALLEST_GAP_NM} nm to "
        f"{float(contact.bridge_forms_nm):.4g} nm, where the bridge forms; check the core constant, the modulus and "
        "`bridge_forms_nm`"
    )


class ContactPhase(enum.IntEnum):
    """What is between tip and sample: nothing (DRY), a liquid bridge, or the solid junction."""

    DRY = 0
    BRIDGE = 1
    JUNCTION = 2


def force_in_phase(
    contact: Contact, junction: Junction, phase: ArrayLike, gap_nm: ArrayLike, gap_rate_nm_per_us: ArrayLike = 0.0
) -> Float[Array, "..."]:
    """Return the force on the tip in nN in a phase, at a gap in nm that changes at a rate in nm/us.

    Nothing acts in DRY, all forces of the bridge in BRIDGE, the solid contact alone in JUNCTION.
    """
    gap = as_argument(gap_nm)
    dry = jnp.zeros_like(gap)
    # the bridge's forces have no value at contact: there the junction's are meant, and the other branch is guarded
    bridge = contact.forces(jnp.where(gap > 0.0, gap, 1.0), gap_rate_nm_per_us)
    solid = contact.solid.force(junction.shift_nm - gap)
    here = jnp.asarray(phase)
    return jnp.where(here == ContactPhase.DRY, dry, jnp.where(here == ContactPhase.BRIDGE, bridge, solid))
