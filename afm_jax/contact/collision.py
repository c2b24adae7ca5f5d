"""A free tip through the contact: one tip, one set of parameters; the batch is in `collide`."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from afm_jax.contact.accuracy_settings import Setting
from afm_jax.contact.contact import Contact
from afm_jax.contact.junction import Junction
from afm_jax.contact.junction_way import JunctionWay, pass_through_junction
from afm_jax.contact.passage import Passage, Way, margin_of
from afm_jax.contact.passage_collocation import pass_by_collocation
from afm_jax.contact.passage_steps import pass_in_steps
from afm_jax.outcome import CollisionOutcome

_QUADRATURE_NODES = 14


class Collision(NamedTuple):
    """What collisions end with; arrays of one shape.

    Energies are in aJ. Where the tip is captured rebound speed, delay and time in junction are 0: see `outcome`.
    """

    approach_speed_nm_per_us: Float[Array, "..."]
    rebound_speed_nm_per_us: Float[Array, "..."]
    collision_delay_us: Float[Array, "..."]
    """Time between the crossings of gap 0 by the straight paths in and out."""
    captured: Bool[Array, "..."]
    outcome: Int[Array, "..."]
    """A `CollisionOutcome`."""
    time_in_contact_us: Float[Array, "..."]
    """From the formation of the bridge to its breaking."""
    time_in_junction_us: Float[Array, "..."]
    deepest_gap_nm: Float[Array, "..."]
    """Smallest gap, negative where the tip indents the sample."""
    bridge_hysteresis_aj: Float[Array, "..."]
    junction_hysteresis_aj: Float[Array, "..."]
    viscous_loss_aj: Float[Array, "..."]
    end_energy_aj: Float[Array, "..."]
    """Kinetic energy at the end, signed: for a captured tip minus what it lacks to leave; 0 at the capture speed."""


class Ways(NamedTuple):
    """The three parts of a collision that forms the junction."""

    inward: Passage
    junction: JunctionWay
    outward: Passage
    outer_gap_nm: Float[Array, "..."]
    """Gap at which contact ends."""
    resolved: Bool[Array, "..."]
    """Whether the setting's few steps are enough."""


def go_through(
    contact: Contact, junction: Junction, approach_speed: Float[Array, ""], mass: Float[Array, ""], setting: Setting
) -> Ways:
    """Return the three parts of one collision, each from the energy that the one before leaves."""
    forces = contact.forces
    start = 0.5 * mass * approach_speed * approach_speed
    forms, gap = contact.bridge_forms_nm, junction.forms_gap_nm
    way_in = Way(forces, mass, forms, gap, start, margin_of(start, forces, forms), inward=True)
    inward = _pass(way_in, setting, setting.inward)
    solid = pass_through_junction(contact.junction, junction, inward.energy_aj, mass, setting.junction_nodes)
    outer = jnp.maximum(contact.bridge_breaks_nm, junction.breaks_gap_nm)
    way_out = Way(
        forces, mass, outer, junction.breaks_gap_nm, solid.energy_aj, jnp.full_like(start, 1e-3), inward=False
    )
    # a short first pass tells how fast the tip is at the end, and so which variable takes the square root out
    if forces.dissipative.terms:
        end = pass_by_collocation(way_out, 8, 2).energy_aj
    else:
        end = way_out.available_aj(outer)
    way_out = Way(
        forces, mass, outer, junction.breaks_gap_nm, solid.energy_aj, margin_of(end, forces, outer), inward=False
    )
    outward = _pass(way_out, setting, setting.outward)
    return Ways(inward, solid, outward, outer, _resolved(way_in, inward, way_out, outward))


def _pass(way: Way, setting: Setting, size: int) -> Passage:
    if not way.forces.dissipative.terms:
        return pass_by_collocation(way, max(size, _QUADRATURE_NODES), 0)
    if setting.rule == "collocation":
        return pass_by_collocation(way, size, setting.sweeps)
    return pass_in_steps(way, size)


def _resolved(way_in: Way, inward: Passage, way_out: Way, outward: Passage) -> Bool[Array, ""]:
    """Say whether dissipation and turning points are far enough from what few steps resolve.

    Dissipation must be small against the energies along the way; at the outer end a slow tip's drag must be small
    against the pull of the bridge. A tip that hardly reaches the junction is slow inside the bridge.
    """

    def pull(way: Way) -> Float[Array, ""]:
        return jnp.maximum(-way.forces.static(way.outer_gap_nm) * way.outer_gap_nm, 0.0)

    def drag(way: Way) -> Float[Array, ""]:
        speed = way.speed(pull(way))
        return way.forces.damping(way.outer_gap_nm) * way.outer_gap_nm * speed

    reach = way_in.start_energy_aj + pull(way_in)
    fast_in = (inward.dissipated_aj < 0.2 * jnp.minimum(reach, inward.energy_aj)) & (
        inward.energy_aj > 0.1 * way_in.start_energy_aj
    )
    captured = way_out.start_energy_aj <= 0.0
    fast_out = outward.dissipated_aj < 0.2 * jnp.maximum(way_out.start_energy_aj, 0.0)
    calm = (drag(way_in) <= 0.1 * pull(way_in)) & (drag(way_out) <= 0.1 * pull(way_out))
    return fast_in & (captured | (fast_out & calm))


def collision_of(
    contact: Contact, junction: Junction, approach_speed: Float[Array, ""], mass: Float[Array, ""], ways: Ways
) -> Collision:
    """Return the collision that three ways make, for a tip that forms the junction."""
    energy = ways.outward.energy_aj
    reached = ways.inward.energy_aj > 0.0
    broke = ways.junction.energy_aj > 0.0
    free = reached & broke & (energy > 0.0)
    square = 2.0 * jnp.where(free, energy, 1.0) / mass
    rebound = jnp.where(free, jnp.sqrt(square), 0.0)
    contact_time = ways.inward.time_us + ways.junction.time_us + ways.outward.time_us
    outside = contact.bridge_forms_nm / approach_speed + ways.outer_gap_nm / jnp.where(free, rebound, 1.0)
    outcome = jnp.where(
        free,
        CollisionOutcome.REBOUND,
        jnp.where(reached & ~broke, CollisionOutcome.CAPTURED_BY_JUNCTION, CollisionOutcome.CAPTURED_BY_BRIDGE),
    )
    return Collision(
        approach_speed_nm_per_us=approach_speed,
        rebound_speed_nm_per_us=rebound,
        collision_delay_us=jnp.where(free, contact_time - outside, 0.0),
        captured=~free,
        outcome=outcome.astype(jnp.int32),
        time_in_contact_us=jnp.where(free, contact_time, 0.0),
        time_in_junction_us=jnp.where(free, ways.junction.time_us, 0.0),
        deepest_gap_nm=ways.junction.deepest_gap_nm,
        bridge_hysteresis_aj=junction.bridge_hysteresis_aj,
        junction_hysteresis_aj=junction.junction_hysteresis_aj,
        viscous_loss_aj=ways.inward.dissipated_aj + ways.outward.dissipated_aj,
        end_energy_aj=jnp.where(
            free, energy, jnp.minimum(energy, jnp.minimum(ways.junction.energy_aj, ways.inward.energy_aj))
        ),
    )
