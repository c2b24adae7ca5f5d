"""Gauss-Legendre quadrature on [0, 1]: integrals over the whole, up to each node, and the series through the values.

Takes numbers of nodes and values at them, in whatever unit; gives nodes, weights and matrices.

Values f_j at the n nodes x_j stand for the polynomial sum_k c_k P_k(2 x - 1) through them, c_k = (2 k + 1) sum_j w_j
P_k(2 x_j - 1) f_j. What is linear in f, such as its integral up to a node, is thereby a matrix of numbers.
"""

from functools import cache

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.polynomial.legendre import leggauss, legvander


def nodes_along(
    count: int, like: Float[Array, "..."]
) -> tuple[Float[Array, "..."], Float[Array, "nodes"], Float[Array, "nodes nodes"]]:  # noqa: F821
    """Return `gauss_nodes` as arrays, the nodes with axes behind them that broadcast against `like`."""
    points, weights, cumulative = (jnp.asarray(part, like.dtype) for part in gauss_nodes(count))
    return points.reshape(-1, *(1,) * like.ndim), weights, cumulative


@cache
def gauss_nodes(count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return Gauss-Legendre nodes and weights on [0, 1], and the matrix that integrates from 0 to each node."""
    roots, weights = leggauss(count)
    # integral of P_k from -1 to x is (P_(k+1) - P_(k-1))/(2k + 1)
    values = legvander(roots, count)
    integrals = np.empty((count, count))
    integrals[:, 0] = roots + 1.0
    integrals[:, 1:] = (values[:, 2:] - values[:, :-2]) / (2.0 * np.arange(1, count) + 1.0)
    return 0.5 * (roots + 1.0), 0.5 * weights, 0.5 * integrals @ _series(count)


@cache
def mean_matrix(count: int) -> np.ndarray:
    """Return what takes f at Gauss nodes on [0, 1] to its means (1/y^2) int_0^y f d(y^2), at the nodes and at 1."""
    shares, weights, _ = gauss_nodes(count + 1)

    def mean(y: float) -> np.ndarray:
        return (2.0 * shares * weights) @ legvander(2.0 * y * shares - 1.0, count - 1) @ _series(count)

    return np.stack([mean(y) for y in (*gauss_nodes(count)[0], 1.0)])


def series_tail(values: Float[Array, "nodes ..."]) -> Float[Array, "..."]:
    """Return the larger of the last two Legendre coefficients through values at Gauss nodes, in size."""
    last = jnp.asarray(_series(values.shape[0])[-2:], values.dtype)
    return jnp.max(jnp.abs(jnp.tensordot(last, values, axes=1)), axis=0)


@cache
def _series(count: int) -> np.ndarray:
    """Return the matrix that takes values at Gauss nodes to the coefficients of their Legendre series."""
    roots, weights = leggauss(count)
    return (np.arange(count)[:, None] + 0.5) * legvander(roots, count - 1).T * weights
