"""Smooth functions of the amplitude lost: a constant and a Gaussian process (Matern 5/2), given readings.

They run over the logarithm of the amplitude lost, for energies change fastest at first contact.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.optimize import isotonic_regression

from fitting.tapping_curves.branches import ways
from fitting.tapping_curves.curve import Rows, TappingCurve

SHALLOW = 0.03
"""Loss, of the free amplitude, that is added to all: there the length in nm is that at contact."""
_LENGTH, _SIZE = 0.7, 3.0
"""Of the process: length in the logarithm of the amplitude lost, and size over the range of the readings; the size that
readings make most probable is too small for one curve in twenty."""
_MOST_BINS = 60
"""Rows of a branch beyond which neighbours are averaged."""


def losses(curve: TappingCurve, factor: float | Rows = 1.0) -> Rows:
    """Return the logarithm of what each row's amplitude has lost of the free one, smoothed along its way.

    By amplitude an energy is smooth where by height it is not: an attractive plateau ends within a nanometre.

    Args:
        curve: the curve.
        factor: true over stated free amplitude.
    """
    place, free = np.zeros(curve.rows), curve.free_amplitude_nm * factor
    for part in ways(curve):
        weights = (free[part] / curve.amplitude_error_nm[part]) ** 2
        ratio = isotonic_regression(curve.amplitude_nm[part] / free[part], weights=weights, increasing=False).x
        place[part] = np.log(SHALLOW + np.maximum(1.0 - ratio, 0.0))
    return place


class Smoother(NamedTuple):
    """A constant and a process, given readings whose neighbours are averaged in bins.

    Attributes:
        place: of the bins.
        starts: where each begins.
        weights: of the rows in their bins.
        size: standard deviation of the process.
        inverse: of the averages' covariance, noise and process.
    """

    place: Float[np.ndarray, " bins"]
    starts: Int[np.ndarray, " bins"]
    weights: Float[np.ndarray, " rows"]
    size: float
    inverse: Float[np.ndarray, "bins bins"]

    @classmethod
    def of(cls, place: np.ndarray, noise: np.ndarray, size: float, most: int = _MOST_BINS) -> "Smoother":
        """Return the smoother of rows that stand in the order of their places, for a size of the process."""
        count = min(len(place), most)
        starts = -(-np.arange(count) * len(place) // count)
        information = noise**-2.0
        total = np.add.reduceat(information, starts)
        weights = information / np.repeat(total, np.diff(starts, append=len(place)))
        middle = np.add.reduceat(weights * place, starts)
        # places of several bins may be one
        own = np.diag(1.0 / total + 1e-12 * size**2)
        root = np.linalg.inv(np.linalg.cholesky(matern(middle, middle, size) + own))
        return cls(middle, starts, weights, size, root.T @ root)

    def average(self, values: np.ndarray) -> np.ndarray:
        """Return the weighted averages over the bins of values of the rows, shape (rows, ...)."""
        return np.add.reduceat((self.weights * values.T).T, self.starts, axis=0)

    def at(self, place: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return at some places the weights of the bins, shape (places, bins), and the variance besides."""
        ones = self.inverse.sum(axis=1)
        cross = matern(place, self.place, self.size)
        left, weights = 1.0 - cross @ ones, cross @ self.inverse
        variance = self.size**2 - np.sum(weights * cross, axis=1) + left**2 / ones.sum()
        return weights + np.outer(left, ones / ones.sum()), np.maximum(variance, 0.0)

    def of_rows(self, place: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, float]:
        """Return what rows' values become at their places, and the degrees of freedom that this takes."""
        weights, _ = self.at(place)
        bins = np.repeat(np.arange(len(self.starts)), np.diff(self.starts, append=len(place)))
        return weights @ self.average(values), float(np.sum(weights[np.arange(len(place)), bins] * self.weights))


def matern(a: np.ndarray, b: np.ndarray, size: float) -> np.ndarray:
    """Return the Matern 5/2 covariance of a process between two sets of places."""
    distance = np.sqrt(5.0) * np.abs(a[:, None] - b[None, :]) / _LENGTH
    return size**2 * (1.0 + distance + distance**2 / 3.0) * np.exp(-distance)


def size_of(values: np.ndarray, noise: np.ndarray) -> float:
    """Return the size of the process of some readings: three times their range, in running means of five."""
    width = min(5, len(values))
    means = np.convolve(values, np.full(width, 1.0 / width), "valid")
    return _SIZE * max(float(np.ptp(means)), float(np.median(noise)))


def smoothed(
    curve: TappingCurve, stretches: Sequence[np.ndarray], factor: float | Rows
) -> tuple[TappingCurve, Rows, list[np.ndarray]]:
    """Return a curve with smooth readings, at which errors of energies are taken, places of its rows, and stretches.

    Args:
        curve: the curve.
        stretches: rows along which readings are smooth; they are returned in the order of their places.
        factor: true over stated free amplitude.
    """
    place = losses(curve, factor)
    stretches = [rows[np.argsort(place[rows], kind="stable")] for rows in stretches]
    amplitude, lag = curve.amplitude_nm.copy(), curve.lag_deg.copy()
    for rows in stretches:
        for readings, errors in ((amplitude, curve.amplitude_error_nm), (lag, curve.lag_error_deg)):
            smoother = Smoother.of(place[rows], errors[rows], size_of(readings[rows], errors[rows]))
            readings[rows], _ = smoother.of_rows(place[rows], readings[rows])
    return replace(curve, amplitude_nm=amplitude, lag_deg=lag), place, stretches
