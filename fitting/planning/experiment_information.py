"""What measurements say of parameters: Fisher information, its inverse, and how good a set of measurements is by it."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from fitting.fisher import covariance_of

CRITERIA = ("D", "A")
_RIDGE = 1e-9
"""Information added to every parameter, relative to that of all candidates together, while points are chosen: with it
the first points, which alone determine nothing, can be compared."""


class Criterion(NamedTuple):
    """How good an information matrix is for the parameters that matter; more is better.

    D: log det of the information about them, the others marginalised, log det F - log det F_nuisances. A: minus the sum
    of their variances, each in units of the parameter's size squared.
    """

    kind: str
    matters: Bool[np.ndarray, " p"]
    size: Float[np.ndarray, " p"]
    ridge: Float[np.ndarray, " p"]

    def __call__(self, information: Float[np.ndarray, "n p p"]) -> Float[np.ndarray, " n"]:
        """Return the score of every information matrix."""
        unit = 1.0 / np.sqrt(self.ridge / _RIDGE)
        scaled = unit[:, None] * information * unit + _RIDGE * np.eye(len(unit))
        if self.kind == "A":
            variance = np.diagonal(np.linalg.inv(scaled), axis1=1, axis2=2) * unit**2
            return -np.sum((variance / self.size**2)[:, self.matters], axis=1)
        nuisances = np.flatnonzero(~self.matters)
        whole = np.linalg.slogdet(scaled)[1]
        if nuisances.size == 0:
            return whole
        return whole - np.linalg.slogdet(scaled[:, nuisances[:, None], nuisances])[1]


def criterion_of(
    kind: str,
    matters: Bool[np.ndarray, " p"],
    size: Float[np.ndarray, " p"],
    largest: Float[np.ndarray, "p p"],
) -> Criterion:
    """Return the criterion for choosing among candidates.

    Args:
        kind: "D" or "A".
        matters: which parameters are to be known well.
        size: of every parameter, what a relative error refers to.
        largest: information of all candidates and all that is known, together: it sets the scale of the ridge.
    """
    strength = np.diag(largest)
    return Criterion(kind, matters, size, _RIDGE * np.where(strength > 0.0, strength, size**-2.0))


def standard_errors(information: Float[np.ndarray, "p p"]) -> Float[np.ndarray, " p"]:
    """Return the standard error of every parameter, the others unknown; infinite where it is not determined."""
    return np.sqrt(np.diag(covariance_of(information)))
