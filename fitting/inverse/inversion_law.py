"""Laws regressed on inverted impacts: the loss u_in^2 - u_out^2 on (1, u) and on (1, u^2), and the delay law.

Both speeds and the delay of a row come from the same few numbers, so that their errors are strongly correlated; each
residual is weighted by the variance that the row's whole covariance gives it (total least squares to first order). What
all rows share, an error of Q or of the free frequency, is a nuisance with its known uncertainty.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.special import chdtrc

_PASSES = 25
_STEP = 1e-30
"""Of complex differentiation, which has no rounding."""

Formula = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]
"""Of approach speed, rebound speed and delay; works on complex numbers."""


@dataclass(frozen=True, kw_only=True)
class Regression:
    """A target regressed on terms; all arrays of the terms' number.

    Attributes:
        value: coefficients.
        covariance: of the coefficients, what the rows share included.
        random_covariance: with what the rows share exactly known.
        pulls: by how many standard errors each shared quantity is moved.
        chi2: sum of squared residuals over their variances, pulls included.
        degrees_of_freedom: rows less terms.
        residual: normalised, shape (rows,).
    """

    value: Float[np.ndarray, " p"]
    covariance: Float[np.ndarray, "p p"]
    random_covariance: Float[np.ndarray, "p p"]
    pulls: Float[np.ndarray, " shared"]
    chi2: float
    degrees_of_freedom: int
    residual: Float[np.ndarray, " rows"]

    @property
    def p_value(self) -> float:
        """Probability of a larger chi2 if the law is right; NaN without degrees of freedom."""
        return float(chdtrc(self.degrees_of_freedom, self.chi2)) if self.degrees_of_freedom > 0 else float("nan")


def loss(u: np.ndarray, w: np.ndarray, _: np.ndarray) -> np.ndarray:
    """Return u_in^2 - u_out^2 in nm^2/us^2."""
    return u * u - w * w


def one(u: np.ndarray, _w: np.ndarray, _tau: np.ndarray) -> np.ndarray:
    """Return 1."""
    return np.ones_like(u)


LOSS_TERMS: dict[str, tuple[Formula, ...]] = {
    "viscous": (one, lambda u, _w, _tau: u),
    "restitution": (one, lambda u, _w, _tau: u * u),
}
"""Of u_in^2 - u_out^2 = epsilon + c u_in, and = epsilon + (1 - r^2) u_in^2 (eq. 6)."""
DELAY_TERMS: tuple[Formula, ...] = (
    lambda u, _w, _tau: u**-0.2,
    lambda u, w, _tau: 1.0 / u - 1.0 / w,
    lambda u, _w, _tau: -1.0 / u,
)
"""Of the delay law a u^(-1/5) - b (1/u_out - 1/u_in) - d/u_in."""


def delay(_u: np.ndarray, _w: np.ndarray, tau: np.ndarray) -> np.ndarray:
    """Return the delay in us."""
    return tau


def regress(
    target: Formula,
    terms: tuple[Formula, ...],
    impacts: Float[np.ndarray, "rows 3"],
    covariances: Float[np.ndarray, "rows 3 3"],
    shared: Float[np.ndarray, "rows 3 shared"],
) -> Regression:
    """Return a target regressed on terms, both functions of quantities with correlated errors.

    Args:
        target: what is to be explained.
        terms: what it is a linear combination of.
        impacts: approach speed, rebound speed and delay of each row.
        covariances: of each row's three quantities.
        shared: by how much they move with one standard error of each quantity that all rows share.

    Raises:
        ValueError: if there are fewer rows than terms.
    """
    rows, count, extra = len(impacts), len(terms), shared.shape[2]
    if rows < count:
        raise ValueError(f"{rows} rows cannot determine {count} coefficients; measure more")
    goal, goal_slopes = _with_slopes(target, impacts)
    basis, basis_slopes = (
        np.stack(part, axis=1) for part in zip(*(_with_slopes(t, impacts) for t in terms), strict=True)
    )

    def linear(value: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the linear least-squares problem with the variances at some coefficients."""
        # by how much the residual moves with each quantity of the row
        slopes = goal_slopes - np.einsum("p,npk->nk", value, basis_slopes)
        weight = 1.0 / np.sqrt(np.einsum("nk,nkl,nl->n", slopes, covariances, slopes))
        moved = np.einsum("nk,nks->ns", slopes, shared)
        constraints = np.hstack([np.zeros((extra, count)), np.eye(extra)])
        design = np.vstack([np.hstack([basis, -moved]) * weight[:, None], constraints])
        return design, np.concatenate([goal * weight, np.zeros(extra)])

    design, right = linear(np.zeros(count))
    found = _solution(design, right)
    for _ in range(_PASSES):
        design, right = linear(found[:count])
        found, last = _solution(design, right), found
        if np.allclose(found, last, rtol=1e-12, atol=0.0):
            break
    residual = right - design @ found
    return Regression(
        value=found[:count],
        covariance=_inverse(design)[:count, :count],
        random_covariance=_inverse(design[:rows, :count]),
        pulls=found[count:],
        chi2=float(residual @ residual),
        degrees_of_freedom=rows - count,
        residual=residual[:rows],
    )


def _solution(design: Float[np.ndarray, "n p"], right: Float[np.ndarray, " n"]) -> Float[np.ndarray, " p"]:
    """Return the least-squares solution, terms of very different size brought to one."""
    size = _norm(design)
    if not np.all(np.isfinite(design / size)) or not np.all(np.isfinite(right)):
        return np.full_like(size, np.nan)
    return np.linalg.lstsq(design / size, right, rcond=None)[0] / size


def _norm(design: Float[np.ndarray, "n p"]) -> Float[np.ndarray, " p"]:
    """Return the columns' lengths, 1 for a column of zeros."""
    length = np.linalg.norm(design, axis=0)
    return np.where(length > 0.0, length, 1.0)


def _inverse(design: Float[np.ndarray, "n p"]) -> Float[np.ndarray, "p p"]:
    """Return the inverse of the normal matrix; infinite where the rows do not tell the terms apart."""
    size = _norm(design)
    scaled = design / size
    if not np.all(np.isfinite(scaled)) or np.linalg.matrix_rank(scaled, tol=1e-9) < len(size):
        return np.full((len(size), len(size)), np.inf)
    return np.linalg.inv(scaled.T @ scaled) / np.outer(size, size)


def _with_slopes(formula: Formula, impacts: Float[np.ndarray, "rows 3"]) -> tuple[np.ndarray, np.ndarray]:
    """Return a formula's values, and its slopes by the three quantities, shape (rows, 3)."""
    slopes = [np.imag(formula(*(impacts + 1j * _STEP * np.eye(3)[k]).T)) / _STEP for k in range(3)]
    return np.real(formula(*impacts.T)), np.stack(slopes, axis=1)
