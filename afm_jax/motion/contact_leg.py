"""A leg of the quick way through a driven contact, computed at Gauss nodes over the whole of it; whether it holds."""

from functools import cache
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from afm_jax.contact.passage_collocation import gauss_nodes
from afm_jax.motion.contact_settings import QuickSetting
from afm_jax.motion.driven import Place


class Leg(NamedTuple):
    """A leg of the quick way; arrays of the tips' shape."""

    place: Place
    """Where it ends."""
    deepest_gap_nm: Float[Array, "..."]
    holds: Bool[Array, "..."]


def settled(
    change: Float[Array, "nodes ..."],
    pace: Float[Array, "nodes ..."],
    duration: Float[Array, "..."],
    setting: QuickSetting,
) -> Bool[Array, "..."]:
    """Say whether the sweeps of a leg have settled, and its nodes are enough for the Legendre series of its pace.

    Args:
        change: of the kinetic energies in the last sweep, relative.
        pace: time per share of the leg, at the nodes.
        duration: of the leg.
        setting: what is allowed.
    """
    rows = jnp.asarray(_last_coefficients(pace.shape[0]), pace.dtype)
    tail = jnp.max(jnp.abs(jnp.tensordot(rows, pace, axes=1)), axis=0)
    return (jnp.max(change, axis=0) < setting.tolerance) & (tail < setting.tail * duration) & jnp.isfinite(duration)


@cache
def _last_coefficients(count: int) -> np.ndarray:
    """Return the rows that take values at Gauss nodes to the last two coefficients of their Legendre series."""
    points, weights, _ = gauss_nodes(count)
    values = np.polynomial.legendre.legvander(2.0 * points - 1.0, count - 1)
    degrees = np.arange(count)[-2:]
    return (2.0 * degrees[:, None] + 1.0) * values[:, -2:].T * weights
