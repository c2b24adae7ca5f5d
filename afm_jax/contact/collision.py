"""A free tip through the contact: one tip, one set of parameters; the batch is in `collide`."""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from afm_jax.contact.bridge_leg import Passage, Turn, Way, margin_of, pass_bridge, pass_by_collocation, way_through
from afm_jax.contact.contact import Contact
from afm_jax.contact.driven import free_tip
from afm_jax.contact.junction import Junction
from afm_jax.contact.junction_leg import JunctionWay, pass_through_junction
from afm_jax.contact.settings import Setting
from afm_jax.outcome import CollisionOutcome


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
    contact: Contact,
    junction: Junction,
    approach_speed: Float[Array, "..."],
    mass: Float[Array, "..."],
    setting: Setting,
    crossing: Callable[[Way], Passage] | None = None,
) -> Ways:
    """Return the three parts of one collision, each from the energy that the one before leaves.

    `crossing`, if not None, replaces the setting's way of crossing the bridge.
    """
    cross = crossing or (lambda way: pass_bridge(way, setting))
    tip, forces = free_tip(contact, junction, mass), contact.forces.static
    forms, breaks = contact.bridge_forms_nm, junction.breaks_gap_nm
    outer = jnp.maximum(contact.bridge_breaks_nm, breaks)
    pull_in, pull_out = (-forces(gap) * gap for gap in (forms, outer))

    start = 0.5 * mass * approach_speed * approach_speed
    gaps = (forms, junction.forms_gap_nm)
    inward = cross(way_through(tip, gaps, start, margin_of(start, pull_in), inward=True))
    solid = pass_through_junction(tip, inward.energy_aj, setting.junction_nodes)

    def way_out(margin: Float[Array, "..."]) -> Way:
        return way_through(tip, (outer, breaks), solid.energy_aj, margin, inward=False)

    # a short first pass tells how fast the tip is at the end, and so which variable takes the square root out
    trial = way_out(jnp.full_like(start, 1e-3))
    if trial.quiet:
        end = trial.total_aj - trial.end_potential_aj
    elif setting.careful:
        end = pass_bridge(trial, setting).energy_aj
    else:
        end = pass_by_collocation(trial, 6, 1).energy_aj
    outward = cross(way_out(margin_of(end, pull_out)))

    # at an end that pulls, a slow tip's drag must be small against the pull for the substitution to hold
    calm_in, calm_out = (
        (pull <= 0.0) | (tip.bridge.damping(gap) * gap * jnp.sqrt(2.0 * jnp.maximum(pull, 0.0) / mass) <= 0.1 * pull)
        for gap, pull in ((forms, pull_in), (outer, pull_out))
    )
    # Few steps are enough where dissipation is small against the energies along the way and no repulsion almost stops
    # the tip inside the bridge.
    reach = jnp.minimum(start + jnp.maximum(pull_in, 0.0), inward.energy_aj)
    easy_in = (inward.dissipated_aj < 0.2 * reach) & (inward.energy_aj > 0.1 * start) & calm_in
    easy_out = (outward.dissipated_aj < 0.2 * solid.energy_aj) & calm_out
    return Ways(inward, solid, outward, outer, easy_in & (easy_out | (solid.energy_aj <= 0.0)))


def collision_of(
    contact: Contact, junction: Junction, approach_speed: Float[Array, "..."], mass: Float[Array, "..."], ways: Ways
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


def collision_of_turn(
    contact: Contact, junction: Junction, approach_speed: Float[Array, "..."], mass: Float[Array, "..."], turn: Turn
) -> Collision:
    """Return the collision of a tip that turns in the bridge."""
    free = turn.energy_aj > 0.0
    rebound = jnp.where(free, jnp.sqrt(2.0 * jnp.where(free, turn.energy_aj, 1.0) / mass), 0.0)
    outside = contact.bridge_forms_nm / approach_speed + contact.bridge_breaks_nm / jnp.where(free, rebound, 1.0)
    outcome = jnp.where(free, CollisionOutcome.TURNED_IN_BRIDGE, CollisionOutcome.CAPTURED_BY_BRIDGE)
    forces = contact.forces
    return Collision(
        approach_speed_nm_per_us=approach_speed,
        rebound_speed_nm_per_us=rebound,
        collision_delay_us=jnp.where(free, turn.time_us - outside, 0.0),
        captured=~free,
        outcome=outcome.astype(jnp.int32),
        time_in_contact_us=jnp.where(free, turn.time_us, 0.0),
        time_in_junction_us=jnp.zeros_like(rebound),
        deepest_gap_nm=turn.gap_nm,
        bridge_hysteresis_aj=forces.potential(contact.bridge_breaks_nm) - forces.potential(contact.bridge_forms_nm),
        junction_hysteresis_aj=jnp.zeros_like(junction.junction_hysteresis_aj),
        viscous_loss_aj=turn.dissipated_aj,
        end_energy_aj=turn.energy_aj,
    )
