"""A way through the bridge by collocation: Gauss nodes over the whole of it, the dissipation by Picard sweeps."""

from functools import cache

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from afm_jax.contact.passage import Passage, Way


def pass_by_collocation(way: Way, nodes: int, sweeps: int) -> Passage:
    """Return the passage from the values at Gauss nodes, improved in sweeps; exact for sweeps = 0 without dissipation.

    Args:
        way: the way.
        nodes: number of Gauss nodes.
        sweeps: how often the dissipation is recomputed from the speeds that it leaves.
    """
    length = way.length
    if way.bridge.conserves:
        return way.end(jnp.zeros_like(length), _time_alone(way, nodes))
    points, weights, cumulative = nodes_along(nodes, length)
    y, gap = way.place(length * points)
    available = way.available_aj(gap)
    spent = jnp.zeros_like(available)
    for _ in range(sweeps):
        losses, _ = way.rates(y, gap, available - spent)
        spent = length * jnp.tensordot(cumulative, losses, axes=1)
    losses, times = way.rates(y, gap, available - spent)
    return way.end(length * jnp.tensordot(weights, losses, axes=1), length * jnp.tensordot(weights, times, axes=1))


def _time_alone(way: Way, nodes: int) -> Float[Array, "..."]:
    """Return the time of a way without dissipation: one quadrature, its nodes in a loop of one small body."""
    points, weights, _ = gauss_nodes(nodes)

    def add(total, node):
        y, gap = way.place(way.length * node[0])
        return total + node[1] * way.rates(y, gap, way.available_aj(gap))[1], None

    pairs = jnp.asarray(np.stack([points, weights], axis=1), way.length.dtype)
    return way.length * lax.scan(add, jnp.zeros_like(way.length), pairs)[0]


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
