"""Periodic functions fitted to samples: harmonics of the response frequency by least squares."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Complex, Float
from scipy.linalg import solve_toeplitz

PER_RESPONSE = 16
"""Harmonics of the response frequency per drive period in it: what an impact's kink leaves beyond them is below 1 %."""
GAP_SHARE = 0.4
"""Harmonics times the widest gap between phases; below 0.5 least squares stays well conditioned (Gröchenig 1992)."""
_SAMPLES_PER_PARAMETER = 3


@dataclass(frozen=True)
class Harmonics:
    """A periodic function sum over k of C_k exp(i k theta), k from -K to K, C_-k the conjugate of C_k.

    Attributes:
        coefficients: C_0 to C_K, shape (K + 1,).
        of_first: what the inverse normal matrix makes of the unit vector k = 1, shape (2 K + 1,): its weights.
    """

    coefficients: Complex[np.ndarray, " harmonics"]
    of_first: Complex[np.ndarray, " lines"]

    def __call__(self, angle: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
        """Return the function at angles in rad."""
        return 2.0 * np.real(_polynomial(self.coefficients[1:], angle)) + float(self.coefficients[0].real)

    def first_weights(self, angle: Float[np.ndarray, " n"]) -> Complex[np.ndarray, " n"]:
        """Return the weights w of the samples in C_1 = sum of w z.

        Args:
            angle: of the samples that were fitted.
        """
        highest = len(self.coefficients) - 1
        upper = _polynomial(self.of_first[highest + 1 :], angle)
        lower = _polynomial(self.of_first[:highest][::-1], -angle)
        return np.conj(upper + lower + self.of_first[highest])


def fit_harmonics(
    angle: Float[np.ndarray, " samples"], height: Float[np.ndarray, " samples"], highest: int
) -> Harmonics:
    """Fit the harmonics 0 to K to samples by least squares.

    The normal matrix has the entries sum of exp(i (l - k) theta): it is Toeplitz, and only 2 K + 1 of them differ.

    Args:
        angle: omega t/N of the samples, in rad.
        height: of the samples.
        highest: K, not above `highest_harmonic`.
    """
    turn = np.exp(1j * angle)
    sums = np.empty(2 * highest + 1, dtype=np.complex128)
    moments = np.empty(highest + 1, dtype=np.complex128)
    wave = np.ones_like(turn)
    for k in range(2 * highest + 1):
        sums[k] = wave.sum()
        if k <= highest:
            moments[k] = np.vdot(wave, height)
        wave *= turn
    both = np.concatenate([np.conj(moments[:0:-1]), moments])
    unit = np.zeros(2 * highest + 1, dtype=np.complex128)
    unit[highest + 1] = 1.0
    # the first column holds k - l = 0, 1, ...; the first row its conjugate
    found = solve_toeplitz((np.conj(sums), sums), np.stack([both, unit], axis=1))
    return Harmonics(found[highest:, 0], found[:, 1])


def highest_harmonic(angle: Float[np.ndarray, " samples"], order: int) -> int:
    """Return how many harmonics the samples determine, from the widest gap between their phases; at least 1.

    Args:
        angle: of the samples, in rad.
        order: N, drive periods in a response period.
    """
    gap = widest_gap(angle)
    return max(1, min(PER_RESPONSE * order, int(GAP_SHARE / gap), len(angle) // (2 * _SAMPLES_PER_PARAMETER)))


def widest_gap(angle: Float[np.ndarray, " samples"]) -> float:
    """Return the widest gap between the phases of the samples, as a share of the response period."""
    turns = np.sort(np.mod(angle / (2.0 * np.pi), 1.0))
    return float(max(np.max(np.diff(turns), initial=0.0), 1.0 - turns[-1] + turns[0]))


def _polynomial(coefficients: Complex[np.ndarray, " k"], angle: Float[np.ndarray, " n"]) -> Complex[np.ndarray, " n"]:
    """Return the sum of c_k exp(i k theta), k = 1, 2, ..., by Horner's rule."""
    turn = np.exp(1j * angle)
    total = np.zeros_like(turn)
    for value in coefficients[::-1]:
        total = (total + value) * turn
    return total
