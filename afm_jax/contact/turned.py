"""An impact that the bridge turns round before the junction forms: its repulsion stops a slow tip.

The turning gap is where the energy that is left equals the potential. Both ways are integrated at Gauss nodes in
ln D = outer + (inner - outer) sin^2(pi p/2), which takes out the square roots of the speed at both ends.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from afm_jax.contact.bridge import Bridge, bridge_of
from afm_jax.contact.contact import Contact
from afm_jax.contact.junction import Junction
from afm_jax.contact.passage_collocation import nodes_along

_NODES = 48
_SWEEPS = 12
_ROUNDS = 2
_SCAN = 256


class Turn(NamedTuple):
    """What an impact that turns in the bridge ends with."""

    turns: Bool[Array, "..."]
    """Whether the tip turns before it reaches the gap where the junction forms."""
    gap_nm: Float[Array, "..."]
    energy_aj: Float[Array, "..."]
    """Kinetic energy where the bridge breaks, signed."""
    dissipated_aj: Float[Array, "..."]
    time_us: Float[Array, "..."]
    """From the formation of the bridge to its breaking."""
    settled: Bool[Array, "..."]
    """Whether the sweeps for the dissipated energy settled."""


def turn_in_bridge(
    contact: Contact,
    junction: Junction,
    approach_speed: Float[Array, "..."],
    mass: Float[Array, "..."],
    spent: Float[Array, "..."],
) -> Turn:
    """Return the impact of a tip that turns in the bridge.

    Args:
        contact: the contact.
        junction: where the tip would form it.
        approach_speed: in nm/us.
        mass: in ng.
        spent: energy dissipated on the way in, estimated, in aJ.
    """
    bridge = bridge_of(contact)
    forms, breaks = contact.bridge_forms_nm, contact.bridge_breaks_nm
    total = 0.5 * mass * approach_speed**2 + bridge.potential(forms)
    gap, turns = _turning_gap(bridge, forms, junction.forms_gap_nm, total - spent)
    for _ in range(_ROUNDS):
        lost, _, _ = _cross(bridge, mass, forms, gap, total)
        gap, turns = _turning_gap(bridge, forms, junction.forms_gap_nm, total - lost)
    lost, time_in, settled_in = _cross(bridge, mass, forms, gap, total)
    left = bridge.potential(gap)
    lost_out, time_out, settled_out = _cross(bridge, mass, gap, breaks, left)
    energy = left - bridge.potential(breaks) - lost_out
    return Turn(turns, gap, energy, lost + lost_out, time_in + time_out, settled_in & settled_out)


def _turning_gap(
    bridge: Bridge, outer: Float[Array, "..."], inner: Float[Array, "..."], level: Float[Array, "..."]
) -> tuple[Float[Array, "..."], Bool[Array, "..."]]:
    """Return the largest gap at which the potential rises to a level, and whether there is one."""
    fixed, known = lax.stop_gradient((bridge, level))

    def missing(log_gap, model=fixed, value=known):
        return model.potential(jnp.exp(log_gap)) - value

    points = lax.stop_gradient(
        jnp.log(outer) + jnp.log(inner / outer) * jnp.linspace(0.0, 1.0, _SCAN, dtype=level.dtype)
    )
    potential = fixed.potential(jnp.exp(points))
    # only repulsion stops a tip, so that it turns closer to the sample than where the potential is least
    beyond = jnp.arange(_SCAN) > jnp.argmin(potential)
    stopped = beyond & (potential >= known)
    first = jnp.maximum(jnp.argmax(stopped), 1)

    def halve(_, ends):
        middle = 0.5 * (ends[0] + ends[1])
        inside = missing(middle) >= 0.0
        return jnp.where(inside, ends[0], middle), jnp.where(inside, middle, ends[1])

    _, point = lax.fori_loop(0, 60, halve, (points[first - 1], points[first]))
    # two Newton steps carry first and second derivatives
    for _ in range(2):
        slope = jax.grad(lambda at: missing(at, bridge, level))(point)
        steep = slope != 0.0
        point = point - jnp.where(steep, missing(point, bridge, level) / jnp.where(steep, slope, 1.0), 0.0)
    return jnp.exp(point), stopped.any()


def _cross(
    bridge: Bridge,
    mass: Float[Array, "..."],
    start: Float[Array, "..."],
    end: Float[Array, "..."],
    level: Float[Array, "..."],
) -> tuple[Float[Array, "..."], Float[Array, "..."], Bool[Array, "..."]]:
    """Return energy dissipated, time, and whether the sweeps settled, for a total energy at the start."""
    points, weights, cumulative = nodes_along(_NODES, level)
    share = jnp.sin(0.5 * jnp.pi * points) ** 2
    width = jnp.log(end / start)
    gap = start * jnp.exp(width * share)
    path = jnp.abs(width) * 0.5 * jnp.pi * jnp.sin(jnp.pi * points) * gap
    damping = bridge.damping(gap)
    available = level - bridge.potential(gap)

    def rates(spent):
        kinetic = available - spent
        moving = kinetic > 0.0
        speed = jnp.sqrt(jnp.where(moving, 2.0 * kinetic / mass, 1.0))
        return jnp.where(moving, path * damping * speed, 0.0), jnp.where(moving, path / speed, 0.0)

    spent = jnp.zeros_like(available)
    before = jnp.zeros_like(level)
    for _ in range(0 if bridge.conserves else _SWEEPS):
        losses, _ = rates(spent)
        spent, before = jnp.tensordot(cumulative, losses, axes=1), jnp.tensordot(weights, losses, axes=1)
    losses, times = rates(spent)
    lost = jnp.tensordot(weights, losses, axes=1)
    settled = jnp.abs(lost - before) <= 1e-9 * (jnp.abs(level) + jnp.abs(lost)) + 1e-12
    return lost, jnp.tensordot(weights, times, axes=1), settled
