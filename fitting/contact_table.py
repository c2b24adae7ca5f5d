"""The law and the delay of a contact as smooth tables: what lets amplitudes be fitted by physical parameters.

A collision is followed against time, from the speed with which the tip leaves to the one with which it came: there is
no capture that way, and the speed and the time in contact are smooth functions of the rebound speed down to 0. The
capture speed is where a rebound speed of 0 comes from.
"""

from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from afm_jax.contact.bridge import Bridge, bridge_of
from afm_jax.contact.bridge_leg import margin_of, pass_by_collocation, way_through
from afm_jax.contact.contact import Contact
from afm_jax.contact.driven import free_tip
from afm_jax.contact.forces import jkr
from afm_jax.contact.junction import Junction, find_junction
from afm_jax.contact.junction_leg import pass_through_junction
from afm_jax.impact.lasting_impact import TabulatedImpact, stretched

TERMS = 32
"""Terms of the series: measured on random contacts, 24 leave errors of 1e-5, 40 gain nothing."""
FARTHEST = 400.0
"""Rebound speed where the table ends, in terms of the speed that hysteresis takes."""
SPEED_ERROR, DELAY_ERROR_US = 1e-7, 1e-6
"""Relative error of the rebound speed, and error of the delay, beyond which a table does not count."""


class _Rule(NamedTuple):
    """Gauss nodes and sweeps of a way through the bridge, and Gauss nodes of the junction."""

    nodes: int
    sweeps: int
    junction: int


_USUAL, _FINER = _Rule(13, 6, 16), _Rule(26, 12, 32)
_COMPARED = slice(0, None, 6)
"""The nodes at which the usual rule is compared with the finer one."""
_BARRIER_GAPS = 24
_LEAD_SPEEDS = np.geomspace(2.0, 30.0, 8)


class Trace(NamedTuple):
    """Where a rebound comes from, and how long it takes: nm/us and us."""

    approach_speed: Float[Array, "..."]
    time: Float[Array, "..."]


@jax.jit
def tabulated(contact: Contact, mass_ng: Float[Array, ""]) -> TabulatedImpact:
    """Return the table of a contact's free collisions, differentiable in every parameter.

    Without a junction, or where collisions cannot be followed back, the table is of nothing: its lowest speed is one
    that no orbit reaches.

    Args:
        contact: the contact, of numbers.
        mass_ng: the tip's mass in ng.
    """
    junction, bridge = find_junction(contact), bridge_of(contact)
    outer = jnp.maximum(contact.bridge_breaks_nm, junction.breaks_gap_nm)
    taken = jnp.maximum(junction.hysteresis_aj, 1e-6)
    pulled = bridge.potential(outer) - bridge.potential(junction.breaks_gap_nm)
    scale = jnp.sqrt(2.0 * jnp.maximum(pulled, 0.25 * taken) / mass_ng)
    highest = FARTHEST * jnp.sqrt(2.0 * taken / mass_ng)
    excess = scale * jnp.sinh(stretched(highest / scale) * jnp.asarray(_PLACES))
    # the root of 0 has no derivative
    left = 0.5 * mass_ng * excess**2 + _barrier(contact, bridge, junction, outer)

    def back(energies, rule):
        return jax.vmap(lambda energy: _traced_back(contact, junction, mass_ng, energy, rule))(energies)

    u, time = back(left, _USUAL)
    finer = lax.stop_gradient(back(lax.stop_gradient(left[_COMPARED]), _FINER))
    lowest = u[0]
    # through values at places that the loss has shifted a little
    far = stretched(jnp.sqrt(jnp.maximum(u[1:] ** 2 - lowest**2, 1e-12)) / scale)
    place = jnp.concatenate([-jnp.ones(1), 2.0 * far / far[-1] - 1.0])
    loss, time_terms = jnp.linalg.solve(_polynomials(place), jnp.stack([u * u - 2.0 * left / mass_ng, time], axis=1)).T
    sound = junction.exists & jnp.all(jnp.diff(u) > 0.0) & jnp.all(jnp.isfinite(loss) & jnp.isfinite(time_terms))
    delay = time[-1] - outer / jnp.sqrt(2.0 * left[-1] / mass_ng) - contact.bridge_forms_nm / u[-1]
    table = TabulatedImpact(
        loss=loss,
        time=time_terms,
        lowest=jnp.where(sound, lowest, 1e6),
        scale=scale,
        end=far[-1],
        inner_nm=contact.bridge_forms_nm,
        outer_nm=outer,
        hertz=delay * u[-1] ** 0.2,
        early_nm=jnp.zeros(()),
        length_nm=contact.bridge_breaks_nm,
        loss_error=_tail(loss),
        speed_error=jnp.max(jnp.abs(finer.approach_speed / u[_COMPARED] - 1.0)),
        time_error=_tail(time_terms) + jnp.max(jnp.abs(finer.time - time[_COMPARED])),
    )
    return replace(table, early_nm=_lead(table))


def _traced_back(
    contact: Contact, junction: Junction, mass: Float[Array, ""], left: Float[Array, ""], rule: _Rule
) -> Trace:
    """Return where a tip comes from that leaves with an energy: out, junction and in, each followed against time."""
    tip = free_tip(contact, junction, mass)
    tip = tip._replace(bridge=tip.bridge.reversed())
    bridge, solid = tip.bridge, contact.junction
    forms, breaks = contact.bridge_forms_nm, junction.breaks_gap_nm
    outer = jnp.maximum(contact.bridge_breaks_nm, breaks)
    margin = margin_of(left, bridge.force(outer) * -outer)
    out = pass_by_collocation(way_through(tip, (outer, breaks), left, margin, inward=True), rule.nodes, rule.sweeps)
    elastic = solid.energy_scale_aj * (jkr.work(jkr.FOLD) - jkr.work(junction.forms_root))
    formed = out.energy_aj + elastic
    inside = pass_through_junction(tip, formed, rule.junction)
    came = formed + bridge.potential(junction.forms_gap_nm) - bridge.potential(forms)
    margin = margin_of(jnp.maximum(came, 0.0), bridge.force(forms) * -forms)
    back = pass_by_collocation(
        way_through(tip, (forms, junction.forms_gap_nm), formed, margin, inward=False), rule.nodes, rule.sweeps
    )
    approach = jnp.sqrt(2.0 * jnp.maximum(back.energy_aj, 1e-12) / mass)
    return Trace(approach, out.time_us + inside.time_us + back.time_us)


def _barrier(contact: Contact, bridge: Bridge, junction: Junction, outer: Float[Array, ""]) -> Float[Array, ""]:
    """Return the energy in aJ that a tip must leave with to have passed every barrier: 0 if the end is the highest.

    Drag, which a barrier spares the tip, is left out: with a barrier the table begins a little above capture.
    """
    share = jnp.asarray(np.linspace(0.0, 1.0, _BARRIER_GAPS))
    on, breaks = junction.forms_gap_nm, junction.breaks_gap_nm
    out = bridge.potential(breaks * (outer / breaks) ** share) - bridge.potential(outer)
    # the junction's fold stands as high as the bridge where it breaks; what it takes, the tip had before
    elastic = contact.junction.energy_scale_aj * (jkr.work(jkr.FOLD) - jkr.work(junction.forms_root))
    inward = bridge.potential(on * (contact.bridge_forms_nm / on) ** share) - bridge.potential(on)
    before = inward - elastic + bridge.potential(breaks) - bridge.potential(outer)
    return jnp.maximum(jnp.maximum(out.max(), before.max()), 0.0)


def _lead(table: TabulatedImpact) -> Float[Array, ""]:
    """Return b of the delay law a u^(-1/5) - b (1/w - 1/u) - d/u closest from 2 to 30 times the capture speed."""
    u, w, delay = jax.vmap(table.speeds)(table.lowest * jnp.asarray(_LEAD_SPEEDS))
    terms = jnp.stack([u**-0.2, 1.0 / u - 1.0 / w, -1.0 / u], axis=1)
    scale = jnp.sqrt(jnp.sum(terms**2, axis=0))
    terms = terms / scale
    return jnp.linalg.solve(terms.T @ terms, terms.T @ delay)[1] / scale[1]


_PLACES = 0.5 - 0.5 * np.cos(np.pi * np.arange(TERMS) / (TERMS - 1))


def _polynomials(place: Float[Array, " n"]) -> Float[Array, "n n"]:
    """Return Chebyshev's polynomials of all degrees at places in [-1, 1]."""
    rows = [jnp.ones_like(place), place]
    for _ in range(TERMS - 2):
        rows.append(2.0 * place * rows[-1] - rows[-2])
    return jnp.stack(rows, axis=1)


def _tail(terms: Float[Array, " terms"]) -> Float[Array, ""]:
    """Return what the last terms add at most, which is more than what is missing beyond them."""
    return jnp.sum(jnp.abs(terms[-3:]))
