"""The laws that inverted rows follow, and which of them chi2 prefers."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from fitting.inverse.inversion_law import DELAY_TERMS, LOSS_TERMS, Formula, Regression, delay, loss, regress
from fitting.inverse.inversion_result import Coefficient, InvertedRows, RegressedLaw

_SLOW = 2.5
"""Rows below this multiple of sqrt(epsilon) are set aside: there the contact is no short event any more."""
_POINTS = 120
_DECIDED = 6.0
"""Difference of chi2 from which a law with as many coefficients is called better."""
_IMPROBABLE = 1e-3
_UNITS = {
    "epsilon": "nm^2/us^2",
    "viscous_loss": "nm/us",
    "r": "",
    "hertz": "us (nm/us)^(1/5)",
    "lead_nm": "nm",
    "offset_nm": "nm",
}
_NAMES = {
    "viscous": ("epsilon", "viscous_loss"),
    "restitution": ("epsilon", "r"),
    "delay": ("hertz", "lead_nm", "offset_nm"),
}
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

    Rows slower than 2.5 sqrt(epsilon), epsilon from a first regression, are set aside and named.

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


def _regression(rows: InvertedRows, target: Formula, terms: tuple[Formula, ...]) -> Regression:
    used = rows.regressed
    return regress(target, terms, rows.impact[used], rows.covariance[used], rows.shared[used])


def _without_slow(rows: InvertedRows) -> InvertedRows:
    """Return the rows with slow ones set aside, where enough are left."""
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
    basis = np.stack([term(speeds, speeds, speeds) for term in LOSS_TERMS[model]], axis=1)
    square = speeds**2 - basis @ found.value
    free = square > 0.0
    curve = np.sqrt(np.where(free, square, np.nan))
    spread = np.sqrt(np.einsum("np,pq,nq->n", basis, found.covariance, basis))
    value, total, random = found.value.copy(), np.diag(found.covariance).copy(), np.diag(found.random_covariance).copy()
    if model == "restitution":
        # the coefficient is 1 - r^2
        r = float(np.sqrt(max(1.0 - value[1], 1e-12)))
        value[1] = r
        total[1], random[1] = total[1] / (4.0 * r * r), random[1] / (4.0 * r * r)
    return _law(model, found, (value, total, random), shared, (curve, spread / (2.0 * curve)))


def _delay_law(
    found: Regression,
    shared: tuple[str, ...],
    speeds: Float[np.ndarray, " points"],
    rebound: Float[np.ndarray, " points"],
) -> RegressedLaw:
    basis = np.stack([term(speeds, rebound, speeds) for term in DELAY_TERMS], axis=1)
    spread = np.sqrt(np.einsum("np,pq,nq->n", basis, found.covariance, basis))
    values = (found.value, np.diag(found.covariance), np.diag(found.random_covariance))
    return _law("delay", found, values, shared, (basis @ found.value, spread))


def _law(
    model: str,
    found: Regression,
    values: tuple[np.ndarray, np.ndarray, np.ndarray],
    shared: tuple[str, ...],
    curve: tuple[np.ndarray, np.ndarray],
) -> RegressedLaw:
    parameters = {
        name: Coefficient(
            value=float(value),
            unit=_UNITS[name],
            standard_error=float(np.sqrt(total)),
            systematic_error=float(np.sqrt(max(total - random, 0.0))) if shared else None,
        )
        for name, value, total, random in zip(_NAMES[model], *values, strict=True)
    }
    return RegressedLaw(
        model=model,
        parameters=parameters,
        chi2=found.chi2,
        degrees_of_freedom=found.degrees_of_freedom,
        p_value=found.p_value,
        pulls=dict(zip(shared, found.pulls.tolist(), strict=True)),
        curve=curve[0],
        curve_error=curve[1],
    )


def _verdict(laws: dict[str, RegressedLaw]) -> tuple[str | None, str]:
    """Return the model that chi2 prefers, None where it does not tell, and the same in words."""
    best, other = sorted(laws.values(), key=lambda law: law.chi2)
    numbers = f"chi2 {best.chi2:.1f} against {other.chi2:.1f}, {best.degrees_of_freedom} degrees of freedom each"
    if other.chi2 - best.chi2 < _DECIDED:
        return None, f"the rows do not tell restitution from viscous loss ({numbers})"
    verdict = f"the rows support {_PLAIN[best.model]}, rather than {_PLAIN[other.model]} ({numbers})"
    if best.p_value < _IMPROBABLE:
        verdict += "; but neither law explains them"
    return best.model, verdict
