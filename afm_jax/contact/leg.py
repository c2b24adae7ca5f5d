"""What the legs through a contact share: Gauss nodes over the whole of a leg, and whether they are enough."""

from functools import cache
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from afm_jax.contact.driven import ContactState
from afm_jax.contact.settings import QuickSetting


class Leg(NamedTuple):
    """A leg of the quick way through a driven contact; arrays of the tips' shape."""

    state: ContactState
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


def nodes_along(
    count: int, like: Float[Array, "..."]
) -> tuple[Float[Array, "..."], Float[Array, "nodes"], Float[Array, "nodes nodes"]]:  # noqa: F821
    """Return `gauss_nodes` as arrays, the nodes with axes behind them that broadcast against `like`."""
    points, weights, cumulative = (jnp.asarray(part, like.dtype) for part in gauss_nodes(count))
    return points.reshape(-1, *(1,) * like.ndim), weights, cumulative


@cache
def gauss_nodes(count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return Gauss-Legendre nodes and weights on [0, 1], and the matrix that integrates from 0 to each node."""
    roots, weights = np.polynomial.legendre.leggauss(count)
    degrees = np.arange(count)
    # integral of P_k from -1 to x is (P_(k+1) - P_(k-1))/(2k + 1)
    values = np.polynomial.legendre.legvander(roots, count)
    integrals = np.empty((count, count))
    integrals[:, 0] = roots + 1.0
    integrals[:, 1:] = (values[:, 2:] - values[:, :-2]) / (2.0 * degrees[1:] + 1.0)
    # coefficients of the interpolant: c_k = (2k + 1)/2 sum_j w_j P_k(x_j) f_j, exact up to the highest degree
    project = (degrees[:, None] + 0.5) * values[:, :-1].T * weights
    return 0.5 * (roots + 1.0), 0.5 * weights, 0.5 * integrals @ project


@cache
def mean_matrix(count: int) -> np.ndarray:
    """Return what takes f at Gauss nodes on [0, 1] to its means (1/y^2) int_0^y f d(y^2), at the nodes and at 1."""
    points, weights, _ = gauss_nodes(count)
    values = np.polynomial.legendre.legvander(2.0 * points - 1.0, count - 1)
    project = (2.0 * np.arange(count)[:, None] + 1.0) * values.T * weights
    shares, share_weights, _ = gauss_nodes(count + 1)

    def mean(y):
        series = np.polynomial.legendre.legvander(2.0 * y * shares - 1.0, count - 1)
        return (2.0 * shares * share_weights) @ series @ project

    return np.stack([mean(y) for y in (*points, 1.0)])


@cache
def _last_coefficients(count: int) -> np.ndarray:
    """Return the rows that take values at Gauss nodes to the last two coefficients of their Legendre series."""
    points, weights, _ = gauss_nodes(count)
    values = np.polynomial.legendre.legvander(2.0 * points - 1.0, count - 1)
    degrees = np.arange(count)[-2:]
    return (2.0 * degrees[:, None] + 1.0) * values[:, -2:].T * weights
