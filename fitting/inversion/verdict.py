"""The rules by which a direct inversion is judged: what makes it invalid, and what a reader should know besides."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from afm_jax.impact.law import Law
from afm_jax.least_squares import IMPROBABLE
from afm_jax.outcomes import Rule, Rules, judge
from fitting.inversion.regression import Laws
from fitting.inversion.result import LawDistance, RegressedLaw, described
from fitting.tables.table import AmplitudeTable

_OUTLIER = 16.0
"""chi2 of one degree of freedom (4 standard errors) above which a row contradicts itself."""


@dataclass(frozen=True)
class InversionEvidence:
    """What an inversion is judged by.

    Attributes:
        table: the measurements.
        with_phase: rows that have a phase and an amplitude.
        laws: the regressed laws, and the inverted rows.
        beside: the law that was given to be set beside the rows, if any.
        distance: how far the rows are from that law.
    """

    table: AmplitudeTable
    with_phase: Bool[np.ndarray, " rows"]
    laws: Laws
    beside: Law | None
    distance: LawDistance | None

    @property
    def has_phases(self) -> bool:
        """Whether any row has a phase with an amplitude."""
        return bool(self.with_phase.any())

    @property
    def regressed(self) -> int:
        """How many rows the laws were regressed on."""
        return int(self.laws.rows.regressed.sum())

    @property
    def lost(self) -> int:
        """How many rows with a phase could not be inverted."""
        return int((self.with_phase & ~self.laws.rows.inverted).sum())

    @property
    def outliers(self) -> int:
        """How many rows contradict themselves."""
        return int(contradictory(self.laws.rows.chi2).sum())

    @property
    def best_p_value(self) -> float:
        """Probability of the rows' scatter under the law that explains them better."""
        return max((law.p_value for law in self.laws.laws.values() if not np.isnan(law.p_value)), default=np.nan)


def contradictory(chi2: Float[np.ndarray, " rows"]) -> Bool[np.ndarray, " rows"]:
    """Return which rows contradict themselves, by chi2 of their three numbers; none of those with two, whose is NaN."""
    return np.asarray(chi2 > _OUTLIER)


def judge_inversion(evidence: InversionEvidence) -> tuple[list[str], list[str]]:
    """Return what makes an inversion invalid, and its warnings; each a sentence."""
    return judge(REASONS, evidence), judge(WARNINGS, evidence)


def _is_measured(law: RegressedLaw) -> bool:
    """Say whether a coefficient of a law differs from no loss by more than two standard errors."""
    for name, found in law.parameters.items():
        apart = 1.0 - found.value if name == "r" else found.value
        if found.standard_error is not None and abs(apart) > 2.0 * found.standard_error:
            return True
    return False


def _law_beside(evidence: InversionEvidence) -> list[str]:
    """Return what a reader should know of a law that is set beside the rows."""
    law, distance = evidence.beside, evidence.distance
    if law is None or distance is None:
        return []
    said = f"beside the rows is {described(law)}"
    far = distance.median_distance_in_errors
    if far is not None:
        said += (
            f"; the {distance.rows_compared} rows within these speeds are "
            f"{far:.2g} standard errors from it in the median"
        )
    if not distance.agrees:
        said += ": it is not the law of these impacts"
    return [said if distance.extrapolated is None else f"{said}. {distance.extrapolated}"]


REASONS: Rules[InversionEvidence] = [
    (
        Rule(
            lambda e: e.has_phases and not e.laws.rows.inverted.any(),
            "no row could be inverted: check the phases' sign and zero (t = 0 when the platform is highest)",
        ),
        Rule(
            lambda e: e.has_phases and not e.laws.laws,
            "{e.regressed} rows do not determine a law of two coefficients: measure at more drives",
        ),
        Rule(
            lambda e: e.best_p_value < IMPROBABLE,
            "neither law explains the rows: check the errors, Q, and the calibration of tip and drive",
        ),
        Rule(
            lambda e: bool(e.laws.laws) and not any(map(_is_measured, e.laws.laws.values())),
            "the rows determine no coefficient of either law to two standard errors: measure more finely",
        ),
    )
]
WARNINGS: Rules[InversionEvidence] = [
    Rule(
        lambda e: not e.has_phases,
        "the table has no phase: only the paper's reading on resonance, whose phase is assumed",
    ),
    Rule(
        lambda e: e.table.quality_factor is not None and e.table.quality_factor_error is None,
        "Q comes without an error: its uncertainty is not in the errors here",
    ),
    Rule(
        lambda e: e.lost > 0 and bool(e.laws.rows.inverted.any()),
        "{e.lost} rows could not be inverted (see their notes)",
    ),
    Rule(
        lambda e: e.outliers > 0,
        "{e.outliers} rows contradict themselves by more than 4 standard errors (see their notes)",
    ),
    Rule(_law_beside, "{case}"),
]
