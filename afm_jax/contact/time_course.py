"""One impact of a free tip in time: gap, velocity, phase and force on its way through the contact.

Takes a contact, an approach speed in nm/us and a mass in ng; gives columns of time in us, gap in nm, velocity in nm/us
and force in nN (eqs. 10 to 16).

The passages through bridge and junction are computed as in `collide`, with the gap or the root s in place of time, and
given at their Gauss nodes; these crowd where the tip is slow, so that times are not equally spaced.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Int

from afm_jax.checks import as_parameter, check_parameter, check_scalar, checked, refuse_float32
from afm_jax.contact.bridge_leg import Way, collocate, margin_of, pull_at, way_through
from afm_jax.contact.contact import Contact
from afm_jax.contact.driven import Driven, free_tip
from afm_jax.contact.junction import ContactPhase, Junction, find_junction, force_in_phase, require_junction
from afm_jax.contact.junction_leg import Stretch, stretch_in_junction, turning_root
from afm_jax.results import ResultTuple, public_result
from afm_jax.solve.derivatives import halved

_NODES = 64
_ITERATIONS = 12
_FLIGHT = 0.5
"""Free flight shown before and after contact, as a fraction of the gap at which the bridge breaks."""


@public_result(phase=ContactPhase)
class TimeCourse(ResultTuple):
    """Gap, velocity and force of a free tip during one impact on a sample at rest; arrays of one length by rising time.

    A captured tip's course ends where it first stops on its way out.
    """

    time_us: Float[np.ndarray, " points"]
    """Time since the bridge formed."""
    gap_nm: Float[np.ndarray, " points"]
    velocity_nm_per_us: Float[np.ndarray, " points"]
    """Rate dD/dt of the gap: negative on the way in."""
    phase: Int[np.ndarray, " points"]
    """What is between tip and sample, the number of a `ContactPhase`."""
    force_nn: Float[np.ndarray, " points"]
    """Force of the sample on the tip; attraction is negative."""
    captured: bool


@checked
def time_course(contact: Contact, approach_speed_nm_per_us: ArrayLike, mass_ng: ArrayLike = 1.0) -> TimeCourse:
    """Return the time course of one impact of a free tip on a sample at rest.

    Args:
        contact: the contact, of numbers.
        approach_speed_nm_per_us: speed far from the sample in nm/us.
        mass_ng: the tip's mass in ng.

    Raises:
        RuntimeError: if the contact was built before JAX was set to the 64-bit floats that it now computes in.
        ValueError: if speed or mass is not positive, the contact has no junction, or the bridge turns the tip round
            before the junction forms.
    """
    refuse_float32(contact)
    check_parameter("approach_speed_nm_per_us", approach_speed_nm_per_us, "positive")
    check_scalar("approach_speed_nm_per_us", approach_speed_nm_per_us, "draw them one by one")
    check_scalar("mass_ng", mass_ng)
    check_parameter("mass_ng", mass_ng, "positive")
    speed, mass = as_parameter(approach_speed_nm_per_us), as_parameter(mass_ng)
    junction, legs, energies = _course(contact, speed, mass)
    require_junction(contact, junction.exists)
    return _joined(
        contact, junction, float(speed), [jax.tree.map(np.asarray, leg) for leg in legs], np.asarray(energies)
    )


@jax.jit
def _course(
    contact: Contact, speed: Float[Array, ""], mass: Float[Array, ""]
) -> tuple[Junction, list[Stretch], Float[Array, "3"]]:
    """Return the four legs, and kinetic energies where the junction forms and breaks with the rebound speed."""
    junction = find_junction(contact)
    tip = free_tip(contact, junction, mass)
    solid = tip.solid
    forms, breaks = tip.forms_nm, tip.ends_nm
    start = 0.5 * mass * speed * speed

    inward, on = _crossing(
        way_through(tip, (forms, junction.forms_gap_nm), start, margin_of(start, pull_at(tip, forms)), inward=True)
    )
    level = solid.work(junction.forms_root) + on / solid.energy_scale_aj
    loading, unloading = _junction_legs(tip, level)
    off = (level - solid.work(solid.fold)) * solid.energy_scale_aj

    def way_out(outer: Float[Array, ""], margin: Float[Array, ""]) -> Way:
        return way_through(tip, (outer, junction.breaks_gap_nm), off, margin, inward=False)

    def end_at(outer: Float[Array, ""]) -> Float[Array, ""]:
        return _crossing(way_out(outer, jnp.full_like(start, 1e-3)))[1]

    end = end_at(breaks)
    # a tip that does not get out stops at the gap to which its energy just suffices
    stop = jnp.where(end > 0.0, breaks, halved(lambda gap: end_at(gap) > 0.0, junction.breaks_gap_nm, breaks)[0])
    outward, left = _crossing(way_out(stop, margin_of(jnp.maximum(end, 0.0), pull_at(tip, breaks))))
    rebound = jnp.where((off > 0.0) & (end > 0.0), jnp.sqrt(2.0 * jnp.maximum(left, 0.0) / mass), 0.0)
    return junction, [inward, loading, unloading, outward], jnp.stack([on, off, rebound])


def _crossing(way: Way) -> tuple[Stretch, Float[Array, ""]]:
    """Return a crossing of the bridge and the kinetic energy at its end; of no length where nothing acts before."""
    if not way.tip.bridge.spans:
        nothing = jnp.zeros(_NODES)
        return Stretch(nothing, nothing, nothing, jnp.zeros(())), way.total_aj - way.end_potential_aj
    collocation = collocate(way, _NODES, _ITERATIONS)
    end = collocation.passage
    velocity = -way.sense * collocation.speed
    return Stretch(collocation.lasted_us, collocation.at.gap_nm, velocity, end.time_us), end.energy_aj


def _junction_legs(tip: Driven, level: Float[Array, ""]) -> tuple[Stretch, Stretch]:
    """Return the ways from the formation of the junction to the turning point, and from there to the fold."""
    solid = tip.solid
    turn = turning_root(solid, level)
    lowest = solid.unloaded  # of the work: left of it the contact pulls
    fold = jnp.full_like(turn, solid.fold)
    breaks = level > solid.work(fold)
    stop = lowest + fold - halved(lambda s: solid.work(lowest + fold - s) < level, fold, lowest)[0]
    out = stretch_in_junction(tip, level, turn, jnp.where(breaks, fold, stop), _NODES)
    into = stretch_in_junction(tip, level, turn, tip.junction.forms_root, _NODES)
    # the way in is the way out of the same energy, backwards
    backwards = into.duration_us - into.time_us[::-1], into.gap_nm[::-1], -into.velocity[::-1], into.duration_us
    return Stretch(*backwards), out


def _joined(
    contact: Contact, junction: Junction, speed: float, legs: list[Stretch], energies: Float[np.ndarray, "3"]
) -> TimeCourse:
    """Return the legs one after the other, with free flight before and, for a tip that leaves, after them."""
    forms = float(contact.bridge_forms_nm)
    breaks = max(float(contact.bridge_breaks_nm), float(junction.breaks_gap_nm))
    if not energies[0] > 0.0:
        raise ValueError("the bridge turns the tip round before the junction forms; take a higher speed")
    flight = _FLIGHT * breaks
    before = np.array([-flight / speed, 0.0])
    parts = [(ContactPhase.DRY, before, np.array([forms + flight, forms]), np.full(2, -speed))]
    begin = 0.0
    _, off, rebound = energies
    phases = ContactPhase.BRIDGE, ContactPhase.JUNCTION, ContactPhase.JUNCTION, ContactPhase.BRIDGE
    for phase, leg in zip(phases, legs, strict=True):
        if not leg.duration_us > 0.0 or (leg is legs[-1] and off <= 0.0):
            continue
        parts.append((phase, begin + np.asarray(leg.time_us), np.asarray(leg.gap_nm), np.asarray(leg.velocity)))
        begin += float(leg.duration_us)
    captured = not rebound > 0.0
    if not captured:
        after = np.array([begin, begin + flight / rebound])
        parts.append((ContactPhase.DRY, after, np.array([breaks, breaks + flight]), np.full(2, rebound)))
    time, gap, velocity = (np.concatenate([part[place] for part in parts]) for place in (1, 2, 3))
    phase = np.concatenate([np.full(part[1].shape, int(part[0])) for part in parts])
    force = np.asarray(force_in_phase(contact, junction, phase, gap, velocity))
    return TimeCourse(time, gap, velocity, phase, force, captured)
