"""The laws that inverted rows follow, which of them chi2 prefers, and how far rows are from a law known otherwise.

Regressed are the loss u_in^2 - u_out^2 on (1, u) and on (1, u^2), and the delay law. Both speeds and the delay of a row
come from the same few numbers, so that their errors are strongly correlated; each residual is weighted by the variance
that the row's whole covariance gives it (total least squares to first order). What all rows share, an error of Q or of
the free frequency, is a nuisance with its known uncertainty.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from afm_jax.impact.law import Law, errors_of, extrapolation_of
from afm_jax.least_squares import IMPROBABLE, chi2_tail
from fitting.fits import law_after
from fitting.fits.law_after import root_of
from fitting.inversion.result import (
    Coefficient,
    InvertedRows,
    LawDistance,
    RegressedLaw,
    ResonanceReading,
    described,
)
from fitting.parameters import PARAMETERS
from fitting.tables.csv_text import TableError
from fitting.tables.table import AmplitudeTable

_PASSES = 25
_STEP = 1e-30
"""Of complex differentiation, which has no rounding."""

Formula = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]
"""Of approach speed, rebound speed and delay; works on complex numbers."""


_SLOW = 2.5
"""Rows below this multiple of sqrt(epsilon) are excluded: there the contact is no short event any more."""
_POINTS = 120
_DECIDED = 6.0
"""Difference of chi2 from which a law with as many coefficients is called better."""
_PLAIN = {"viscous": "a viscous loss, linear in the speed", "restitution": "a coefficient of restitution"}


@dataclass(frozen=True, kw_only=True)
class Laws:
    """The regressions, with the rows marked that entered them, and the speeds of the curves."""

    rows: InvertedRows
    speeds: Float[np.ndarray, " points"]
    laws: dict[str, RegressedLaw]
    delay: RegressedLaw | None
    preferred: str | None
    verdict: str


def regressed_laws(rows: InvertedRows) -> Laws:
    """Return the laws regressed on rows: both of the loss, and the delay's.

    Rows slower than 2.5 sqrt(epsilon), epsilon from a first regression, are excluded and named.

    Args:
        rows: inverted rows; those with `regressed` off are left out.
    """
    rows = _without_slow(rows)
    used = rows.regressed
    impacts = rows.impact[used]
    if used.sum() < 3:
        verdict = "no law is regressed: it takes three rows with amplitude and phase"
        return Laws(rows=rows, speeds=np.zeros(0), laws={}, delay=None, preferred=None, verdict=verdict)
    speeds = np.geomspace(impacts[:, 0].min(), impacts[:, 0].max(), _POINTS)
    found = {model: _regression(rows, loss, terms) for model, terms in LOSS_TERMS.items()}
    if not all(np.all(np.isfinite(one.covariance)) for one in found.values()):
        verdict = "no law is regressed: the rows have one approach speed"
        return Laws(rows=rows, speeds=speeds, laws={}, delay=None, preferred=None, verdict=verdict)
    laws = {model: _loss_law(model, found[model], rows.shared_names, speeds) for model in found}
    preferred, verdict = _verdict(laws)
    rebound = laws[preferred or "viscous"].curve
    delays = None
    if used.sum() > len(DELAY_TERMS):
        regression = _regression(rows, delay, DELAY_TERMS)
        if np.all(np.isfinite(regression.covariance)):
            delays = _delay_law(regression, rows.shared_names, speeds, rebound)
    return Laws(rows=rows, speeds=speeds, laws=laws, delay=delays, preferred=preferred, verdict=verdict)


def distance_from(law: Law, table: AmplitudeTable, rows: InvertedRows, reading: ResonanceReading) -> LawDistance:
    """Return how far inverted rows are from a law that is known otherwise, the errors of both taken together.

    Args:
        law: a formula or a table.
        table: what was inverted.
        rows: its rows.
        reading: the paper's reading of it, for a table without phases.

    Raises:
        TableError: if the law is known at none of the rows' approach speeds.
    """
    u, w, _ = rows.impact[rows.inverted].T
    reached = u if u.size else reading.approach_speed_nm_per_us
    if np.all(law.extrapolated(reached) | law.captures(reached)):
        raise TableError(
            f"{described(law)}, says nothing about {table.source}, whose impacts come at {np.min(reached):.4g} to "
            f"{np.max(reached):.4g} nm/us; give a law of these speeds"
        )
    inside = ~np.asarray(law.extrapolated(u) | law.captures(u))
    rebound, slope = np.asarray(law.rebound_speed(u)), np.asarray(law.rebound_slope(u))
    # of squares, which are all but linear in the speed
    slopes = np.stack([-2.0 * rebound * slope, 2.0 * w], axis=1)
    variance = np.einsum("ni,nij,nj->n", slopes, rows.covariance[rows.inverted][:, :2, :2], slopes)
    variance += np.sum(np.einsum("ni,nis->ns", slopes, rows.shared[rows.inverted][:, :2]) ** 2, axis=1)
    variance += (2.0 * rebound * errors_of(law, u)[0]) ** 2
    pulls = (np.abs(w**2 - rebound**2) / np.sqrt(variance))[inside]
    median = float(np.median(pulls)) if pulls.size else None
    return LawDistance(int(inside.sum()), median, extrapolation_of(law, u))


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
        return chi2_tail(self.chi2, self.degrees_of_freedom) if self.degrees_of_freedom > 0 else float("nan")


def loss(u: np.ndarray, w: np.ndarray, _: np.ndarray) -> np.ndarray:
    """Return u_in^2 - u_out^2 in nm^2/us^2."""
    return u * u - w * w


def one(u: np.ndarray, _w: np.ndarray, _tau: np.ndarray) -> np.ndarray:
    """Return 1."""
    return np.ones_like(u)


LOSS_TERMS: dict[str, dict[str, Formula]] = {
    "viscous": {"epsilon": one, "viscous_loss": lambda u, _w, _tau: u},
    "restitution": {"epsilon": one, "r": lambda u, _w, _tau: u * u},
}
"""By parameter: of u_in^2 - u_out^2 = epsilon + c u_in, and = epsilon + (1 - r^2) u_in^2 (eq. 6)."""
DELAY_TERMS: dict[str, Formula] = {
    name: lambda u, w, _tau, term=term: term(u, w) for name, term in law_after.DELAY_TERMS.items()
}
"""Of the delay law a u^(-1/5) - b (1/u_out - 1/u_in) - d/u_in."""


def delay(_u: np.ndarray, _w: np.ndarray, tau: np.ndarray) -> np.ndarray:
    """Return the delay in us."""
    return tau


def regress(
    target: Formula,
    terms: Mapping[str, Formula],
    impacts: Float[np.ndarray, "rows 3"],
    covariances: Float[np.ndarray, "rows 3 3"],
    shared: Float[np.ndarray, "rows 3 shared"],
) -> Regression:
    """Return a target regressed on terms, both functions of quantities with correlated errors.

    Args:
        target: what is to be explained.
        terms: what it is a linear combination of, by coefficient.
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
        np.stack(part, axis=1) for part in zip(*(_with_slopes(t, impacts) for t in terms.values()), strict=True)
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


def _regression(rows: InvertedRows, target: Formula, terms: Mapping[str, Formula]) -> Regression:
    used = rows.regressed
    return regress(target, terms, rows.impact[used], rows.covariance[used], rows.shared[used])


def _without_slow(rows: InvertedRows) -> InvertedRows:
    """Return the rows with slow ones excluded from the laws, where enough remain."""
    if rows.regressed.sum() < 4:
        return rows
    epsilon = float(_regression(rows, loss, LOSS_TERMS["viscous"]).value[0])
    limit = _SLOW * np.sqrt(max(epsilon, 0.0))
    slow = rows.regressed & (rows.impact[:, 0] < limit)
    kept = rows.regressed & ~slow
    if kept.sum() < 3:
        return rows
    reason = f"not in the laws: slower than 2.5 sqrt(epsilon) = {limit:.3g} nm/us, where an impact is no short event"
    note = tuple(
        "; ".join(filter(None, (old, reason))) if out else old for old, out in zip(rows.note, slow, strict=True)
    )
    return replace(rows, regressed=kept, note=note)


def _loss_law(
    model: str, found: Regression, shared: tuple[str, ...], speeds: Float[np.ndarray, " points"]
) -> RegressedLaw:
    basis = np.stack([term(speeds, speeds, speeds) for term in LOSS_TERMS[model].values()], axis=1)
    square = speeds**2 - basis @ found.value
    free = square > 0.0
    curve = np.sqrt(np.where(free, square, np.nan))
    changes = basis @ root_of(found.covariance) / (2.0 * curve[:, None])
    value, total, random = found.value.copy(), np.diag(found.covariance).copy(), np.diag(found.random_covariance).copy()
    if model == "restitution":
        # the coefficient is 1 - r^2
        r = float(np.sqrt(max(1.0 - value[1], 1e-12)))
        value[1] = r
        total[1], random[1] = total[1] / (4.0 * r * r), random[1] / (4.0 * r * r)
    return _law(model, found, (value, total, random), shared, (curve, changes))


def _delay_law(
    found: Regression,
    shared: tuple[str, ...],
    speeds: Float[np.ndarray, " points"],
    rebound: Float[np.ndarray, " points"],
) -> RegressedLaw:
    basis = np.stack([term(speeds, rebound, speeds) for term in DELAY_TERMS.values()], axis=1)
    changes = basis @ root_of(found.covariance)
    values = (found.value, np.diag(found.covariance), np.diag(found.random_covariance))
    return _law("delay", found, values, shared, (basis @ found.value, changes))


def _law(
    model: str,
    found: Regression,
    values: tuple[np.ndarray, np.ndarray, np.ndarray],
    shared: tuple[str, ...],
    curve: tuple[np.ndarray, np.ndarray],
) -> RegressedLaw:
    parameters = {
        name.removeprefix("delay_"): Coefficient(
            value=float(value),
            unit=PARAMETERS[name].unit,
            standard_error=float(np.sqrt(total)),
            systematic_error=float(np.sqrt(max(total - random, 0.0))) if shared else None,
        )
        for name, value, total, random in zip(LOSS_TERMS.get(model, DELAY_TERMS), *values, strict=True)
    }
    return RegressedLaw(
        model=model,
        parameters=parameters,
        chi2=found.chi2,
        degrees_of_freedom=found.degrees_of_freedom,
        p_value=found.p_value,
        pulls=dict(zip(shared, found.pulls.tolist(), strict=True)),
        curve=curve[0],
        curve_changes=curve[1],
    )


def _verdict(laws: dict[str, RegressedLaw]) -> tuple[str | None, str]:
    """Return the model that chi2 prefers, None where it does not tell, and a sentence that says so."""
    best, other = sorted(laws.values(), key=lambda law: law.chi2)
    numbers = f"chi2 {best.chi2:.1f} against {other.chi2:.1f}, {best.degrees_of_freedom} degrees of freedom each"
    if other.chi2 - best.chi2 < _DECIDED:
        return None, f"the rows do not tell restitution from viscous loss ({numbers})"
    verdict = f"the rows support {_PLAIN[best.model]}, rather than {_PLAIN[other.model]} ({numbers})"
    if best.p_value < IMPROBABLE:
        verdict += "; but neither law explains them"
    return best.model, verdict
