"""The law and the delay of a contact as smooth tables: what lets amplitudes be fitted by physical parameters."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from afm_jax.contact.collide import batch_of
from afm_jax.contact.contact import Contact
from afm_jax.contact.junction import Junction, find_junction
from afm_jax.contact.settings import setting_of
from afm_jax.impact.lasting_impact import USUAL_LEAD, TabulatedImpact

NODES = 32
_NEAREST, _FARTHEST = 0.06, 400.0
"""Distances from the slowest speed that the table spans, in units of that speed."""
_SLOWEST = 2.0
"""Slowest speed in nm/us of a contact without hysteresis."""
_SETTING = setting_of("collocation", 1e-9)
_GAUSS, _WEIGHTS = np.polynomial.legendre.leggauss(8)


def tabulated(contact: Contact, mass_ng: Float[Array, ""]) -> TabulatedImpact:
    """Return the table of a contact's free collisions, differentiable in every parameter.

    The loss u_in^2 - u_out^2 and the delay with its lead added are smooth in the logarithm of the distance from the
    capture speed, which need not be exact: hysteresis and drag give it to a few per cent.

    Args:
        contact: the contact, of numbers.
        mass_ng: the tip's mass in ng.
    """
    junction = find_junction(contact)
    lowest = jnp.maximum(_slowest(contact, junction, mass_ng), _SLOWEST)
    # without a junction there is no impact: a table of nothing, at speeds that no orbit reaches
    lowest = jnp.where(junction.exists, lowest, 1e6)
    places = np.cos(np.pi * (np.arange(NODES) + 0.5) / NODES)
    start, end = jnp.log(_NEAREST * lowest), jnp.log(_FARTHEST * lowest)
    u = lowest + jnp.exp(start + 0.5 * (end - start) * (jnp.asarray(places) + 1.0))
    found = batch_of(contact, mass_ng, u, _SETTING)
    w = jnp.where(found.rebound_speed_nm_per_us > 0.0, found.rebound_speed_nm_per_us, 1.0)
    lead = contact.bridge_breaks_nm * USUAL_LEAD
    to_series = jnp.asarray(_to_series())
    return TabulatedImpact(
        loss=to_series @ (u * u - w * w),
        delay=to_series @ (found.collision_delay_us + lead * (1.0 / w - 1.0 / u)),
        lowest=lowest,
        start=start,
        end=end,
        lead_nm=lead,
        early_nm=_lead(u, w, found.collision_delay_us, lowest),
        length_nm=contact.bridge_breaks_nm,
    )


def _lead(u: Array, w: Array, delay: Array, lowest: Array) -> Float[Array, ""]:
    """Return b of the delay law a u^(-1/5) - b (1/w - 1/u) - d/u that is closest between 2 and 30 times `lowest`."""
    weight = jnp.where((u > 2.0 * lowest) & (u < 30.0 * lowest), 1.0, 0.0)
    terms = jnp.stack([u**-0.2, 1.0 / u - 1.0 / w, -1.0 / u], axis=1) * weight[:, None]
    scale = jnp.sqrt(jnp.sum(terms**2, axis=0))
    terms = terms / scale
    return jnp.linalg.solve(terms.T @ terms, terms.T @ (weight * delay))[1] / scale[1]


def _slowest(contact: Contact, junction: Junction, mass_ng: Float[Array, ""]) -> Float[Array, ""]:
    """Return about the capture speed: u^2 = 2 E/m + c u, with hysteresis E and drag c of the straight ways."""
    ways = (junction.forms_gap_nm, contact.bridge_forms_nm), (junction.breaks_gap_nm, contact.bridge_breaks_nm)
    drag = sum((_drag(contact, near, far) for near, far in ways), jnp.zeros(())) * 2.0 / mass_ng
    return 0.5 * (drag + jnp.sqrt(drag**2 + 8.0 * jnp.maximum(junction.hysteresis_aj, 0.0) / mass_ng))


def _drag(contact: Contact, near: Float[Array, ""], far: Float[Array, ""]) -> Float[Array, ""]:
    """Return the integral of the damping over the gap, in nN us; 0 where the way is empty."""
    half = 0.5 * jnp.log(jnp.maximum(far / near, 1.0))
    gaps = near * jnp.exp(half * (jnp.asarray(_GAUSS) + 1.0))
    return half * jnp.sum(jnp.asarray(_WEIGHTS) * contact.forces.damping(gaps) * gaps)


def _to_series() -> np.ndarray:
    """Return the matrix from values at Chebyshev's points to coefficients."""
    angles = np.pi * (np.arange(NODES) + 0.5) / NODES
    matrix = 2.0 / NODES * np.cos(np.outer(np.arange(NODES), angles))
    matrix[0] *= 0.5
    return matrix
