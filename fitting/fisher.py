"""The covariance that a Fisher matrix stands for."""

import numpy as np
from jaxtyping import Float

_FLAT = 1e-12
"""Curvature, where every parameter's own is 1, below which a direction is not determined."""


def covariance_of(fisher: Float[np.ndarray, "... p p"]) -> Float[np.ndarray, "... p p"]:
    """Return the inverse of Fisher matrices; rows and columns of parameters that one does not determine are infinite.

    Where a matrix is not finite, all of its inverse is infinite.
    """
    finite = np.isfinite(fisher).all(axis=(-2, -1), keepdims=True)
    sound = np.where(finite, fisher, 0.0)
    scale = np.sqrt(np.diagonal(sound, axis1=-2, axis2=-1))
    safe = np.where(scale > 0.0, scale, 1.0)
    unit = safe[..., :, None] * safe[..., None, :]
    # parameters may be of very different size
    curvature, axes = np.linalg.eigh(sound / unit)
    flat = curvature < _FLAT
    undetermined = np.any((np.abs(axes) > 1e-6) & flat[..., None, :], axis=-1)
    inverse = (axes / np.where(flat, np.inf, curvature)[..., None, :]) @ np.swapaxes(axes, -2, -1) / unit
    return np.where(undetermined[..., :, None] | undetermined[..., None, :] | ~finite, np.inf, inverse)


def whole_covariance_of(fisher: Float[np.ndarray, "... p p"]) -> Float[np.ndarray, "... p p"]:
    """Return the inverse of Fisher matrices; all infinite where one determines not every parameter."""
    inverse = covariance_of(fisher)
    return np.where(np.isfinite(inverse).all(axis=(-2, -1), keepdims=True), inverse, np.inf)
