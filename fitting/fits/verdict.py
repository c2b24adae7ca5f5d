"""Whether to trust a fit, in words: what makes it invalid, and what a reader should know besides.

A fit is valid only if what is left of the amplitudes passes an absolute test, whatever the options:
chi2 by its probability; with a robust loss the share of outliers, and chi2 without them by its probability; with scaled
errors the scale, and what is known of the parameters; always that neighbouring residuals are not correlated, neither in
the table's order (a drift, a sweep the model does not follow) nor over the approach speed (a wrong law).

The rules are the three lists at the end: `MISFITS`, `REASONS` and `WARNINGS`.
"""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from afm_jax.least_squares import IMPROBABLE, chi2_tail
from afm_jax.outcomes import Rule, judge
from fitting.fits.intervals import Convergence
from fitting.fits.minimum import TOO_SLOW
from fitting.fits.objective import MOST_OUTLIERS, OUTLIER
from fitting.fits.result import NO_MASS, FittedParameter, FittedRows
from fitting.models import ASSUMED_ERROR_OF_Q, Held
from fitting.parameters import DELAY_NAMES, DRIFT_NAMES, is_nuisance, name_of_table, parameter_called
from fitting.tables.several import SeveralTables, repeats_of
from fitting.tables.table import ERRORS_OF_REPEATS, AmplitudeTable

_TIED = 0.995
"""Correlation beyond which two parameters are called determined only together."""
_STATED = 0.003
"""Relative model error from which rows are named."""
_ONE_SIDED = 4.5
"""Sum of the cubed residuals, in standard deviations of that of independent ones, from which rows are off to one side:
by chance in one fit of three thousand."""
_RUN, _LONGEST_RUN = 3.0, 3.5
"""Standard deviations by which residuals run together over the speed from which that is said, and what is left of that
beside a wider model discrepancy from which the model does not explain the table."""
LARGEST_SCALE = 3.0
"""Scale of the errors that is believed: a spread given for that of a mean, a 3 sigma limit for 1 sigma. Errors that
would have to be larger are no matter of scale, and have to be stated nearer to the truth."""
_CORRELATED = 4.0
"""Correlation of neighbouring residuals, in standard deviations of those of independent ones, from which they are
taken to be correlated: by chance in one fit of ten thousand."""
_NEGLIGIBLE = 0.3
"""Root mean square of the residuals, in errors, below which their pattern is of no consequence."""
_FEWEST_NEIGHBOURS = 8
_LONG_CONTACT = 0.2
"""Share of the drive's period in contact from which a misfit is laid to it: the corrections are fitted up to there."""
_REFUSED = (
    "No law of impacts can be read off this curve: on nearly all of its rows impacts are too slow, or the lever's own "
    "pull turns the tip round; drive 3 to 10 % above resonance, with a large free amplitude, or fit the contact's own "
    "parameters (--model contact), which needs no law."
)
_NO_TAPS = (
    "The contact's taps explain hardly a row of this curve: it has no steady tap a period there; fix what "
    "is known of it (--fix tip_radius_nm=20, for example), or leave out rows that are not one impact a period."
)
_AT_BOUND = 0.005
_PULLED, _TORN = 2.0, 3.0
"""Distance from what is known of a quantity, in its standard errors, from which it is named, and not believed."""


@dataclass(frozen=True)
class Evidence:
    """All that the verdict looks at; ``other_minimum`` are the values of another minimum and its chi2."""

    table: AmplitudeTable | SeveralTables
    parameters: dict[str, FittedParameter]
    convergence: Convergence
    rows: FittedRows
    chi2: float
    freedom: int
    p_value: float
    autocorrelation: float
    other_minimum: tuple[dict[str, float], float] | None
    error_scale: float | None
    lasting: bool
    robust: bool
    correlations: Float[np.ndarray, "p p"]
    untabulated: tuple[int, ...] = ()
    """Rows whose impacts the table of a contact does not hold to its accuracy."""
    contact_share: float = 0.0
    """Largest share of a drive's period that the tip is in contact."""
    refused: bool = False
    """Hardly a row is left that a law of impacts can be read off."""
    contact: bool = False
    """Whether a contact was fitted."""
    tapped: bool = False
    """Whether a contact's own taps were fitted, not a law."""
    pulls: tuple[float, ...] = ()
    """Of several tables, the probability that each one's law is that of the others."""
    scattering: bool = False
    """Laws were allowed to differ from table to table."""
    run: tuple[float, float] = (0.0, 0.0)
    """Standard deviations by which residuals run together over the speed, and by which beside the discrepancy added."""
    unwidened: Float[np.ndarray, "rows k"] | None = None
    """Residuals of the rows without the discrepancy that was added for runs: that goes after outliers."""
    held: tuple[Held, ...] = ()
    """What a fit of the contact holds, with its errors."""
    hanging: dict[str, tuple[str, ...]] = field(default_factory=dict)
    """Which of them decide how well a fitted one is known."""
    short: float = 0.0
    """Share of the loss by which the model discrepancy of short range was added for that."""
    independent_residual: Float[np.ndarray, "rows k"] | None = None
    """Residuals without what is common to rows: the most likely remainders of corrections, and departures of tables;
    None: those of the rows."""
    stuck: tuple[float, float] | None = None
    """chi2 that no part of the step with the model discrepancy lowers, and what the step takes it to to first order."""
    courses: dict[str, list[str]] = field(default_factory=dict)
    """Which readings of a table follow its rows, whose order nothing says, by the table's label."""

    @property
    def refusal(self) -> str:
        """Why hardly a row is one that the model can be read off."""
        return _NO_TAPS if self.tapped else _REFUSED

    @property
    def undetermined(self) -> list[str]:
        """Names of the parameters that the data do not determine, not even to first order."""
        return [name for name, parameter in self.parameters.items() if parameter.undetermined]

    @property
    def may_stay_open(self) -> bool:
        """Whether what is not determined need not be: of a contact's taps, unless nothing is."""
        law = [name for name in self.parameters if not is_nuisance(name)]
        return self.tapped and any(not self.parameters[name].undetermined for name in law)

    @property
    def to_be_determined(self) -> list[str]:
        """Names of the parameters that are not determined, and must be."""
        return [] if self.may_stay_open else self.undetermined

    @property
    def pulled(self) -> dict[str, float]:
        """How far each parameter is from what was measured of it otherwise, in standard errors of that."""
        known = {name: (p.value, *p.constraint) for name, p in self.parameters.items() if p.constraint is not None}
        return {name: (value - given) / error for name, (value, given, error) in known.items()}

    @property
    def outliers(self) -> Bool[np.ndarray, " rows"]:
        """Which rows are far off."""
        return np.any(np.abs(np.nan_to_num(self.rows.residual)) > OUTLIER, axis=1)


def judge_fit(evidence: Evidence) -> tuple[list[str], list[str]]:
    """Return what makes a fit invalid, and its warnings; each a sentence."""
    return [evidence.refusal] if evidence.refused else judge(REASONS, evidence), judge(WARNINGS, evidence)


def misfits(evidence: Evidence) -> list[str]:
    """Return the grounds on which the model does not explain the amplitudes, each a clause; none if it does.

    The parameters' errors and intervals are not looked at.
    """
    return [evidence.refusal] if evidence.refused else judge(MISFITS, evidence)


def _correlations(evidence: Evidence) -> list[tuple[str, float]]:
    """Return in which order of the rows neighbouring residuals are correlated, and how much."""
    rows, residual = evidence.rows, evidence.independent_residual
    residual = rows.residual if residual is None else residual
    known = np.flatnonzero(np.isfinite(residual).any(axis=1) & (rows.orbits > 0))
    speed = rows.approach_speed_nm_per_us[known]
    orders = {"in the table's order": known, "over the approach speed": known[np.argsort(speed, kind="stable")]}
    found = [(where, correlation_excess(residual[order])) for where, order in orders.items()]
    return [(where, excess) for where, excess in found if abs(excess) > _CORRELATED]


def correlation_excess(residual: Float[np.ndarray, "rows k"]) -> float:
    """Return by how many standard deviations the residuals of neighbouring rows are correlated.

    The scalar products of neighbouring rows are added up. If rows are independent and as likely positive as negative,
    the sum is 0 on average, and its variance the number of neighbours times the mean squared product of two rows of the
    table: the readings of a row may go together. Outliers count as much as the smallest of them.

    Args:
        residual: of the readings in errors, row after row; NaN where nothing was measured.
    """
    bounded = np.clip(np.nan_to_num(residual), -OUTLIER, OUTLIER)
    count = len(bounded)
    if count <= _FEWEST_NEIGHBOURS or np.sum(bounded**2) < _NEGLIGIBLE**2 * np.isfinite(residual).sum():
        return 0.0
    own = np.sum(bounded**2, axis=1)
    # over all pairs, the squared products add up to the squares of this small matrix
    others = np.sum((bounded.T @ bounded) ** 2) - np.sum(own**2)
    if others <= 1e-9 * np.sum(own) ** 2:
        return 0.0
    return float(np.sum(bounded[1:] * bounded[:-1]) / np.sqrt(others / count))


def _one_sided(evidence: Evidence) -> float:
    """Return by how many standard deviations some rows are off to one side; 0.0 where that is not much, or not asked.

    Chance gives as large residuals of either sign. A robust fit is for such rows, and those of tables whose laws
    scatter about the predicted one are off together.
    """
    of_row, rows = _residual_of_rows(evidence)
    if rows <= _FEWEST_NEIGHBOURS or evidence.robust or evidence.scattering:
        return 0.0
    excess = float(np.sum(of_row**3) / np.sqrt(15.0 * rows))
    return excess if abs(excess) >= _ONE_SIDED else 0.0


def _residual_of_rows(evidence: Evidence) -> tuple[Float[np.ndarray, " rows"], int]:
    """Return the residual of each row, all its readings together, in units of one; and how many rows have any."""
    residual = evidence.rows.residual if evidence.unwidened is None else evidence.unwidened
    count = np.isfinite(residual).sum(axis=1)
    return np.nansum(residual, axis=1) / np.sqrt(np.maximum(count, 1)), int((count > 0).sum())


def _rows_to_one_side(evidence: Evidence, excess: float) -> str:
    of_row, rows = _residual_of_rows(evidence)
    far = np.sort(np.argsort(-np.sign(excess) * of_row)[: max(1, rows // 10)])
    side = "above" if excess > 0.0 else "below"
    return (
        f"residuals are far off to one side ({excess:+.1f} standard deviations of their cubes): predicted {side} what "
        f"was read for {_lines(evidence, far)}"
    )


def _without_outliers(evidence: Evidence) -> tuple[float, int, float]:
    """Return chi2 of the amplitudes that are no outliers and of what is known, its freedom and its probability."""
    residual, pulls = evidence.rows.residual, evidence.pulled
    inside = residual[np.abs(residual) <= OUTLIER]
    freedom = inside.size + len(pulls) - len(evidence.parameters)
    chi2 = float(np.sum(inside**2) + sum(pull**2 for pull in pulls.values()))
    return chi2, freedom, chi2_tail(chi2, freedom) if freedom > 0 else float("nan")


def _pull_in_words(evidence: Evidence, name: str, pull: float) -> str:
    parameter = evidence.parameters[name]
    given, error = parameter.constraint or (float("nan"), float("nan"))
    return f"{name} = {parameter.value:.5g} is {abs(pull):.1f} standard errors from the given {given:g} +- {error:.2g}"


def _distance_in_words(distance: float) -> str:
    if not np.isfinite(distance):
        return "chi2 bends downwards where the search ended, which is no minimum"
    return f"chi2 lies an estimated {distance:.2g} above its minimum"


def _why_not_explained(evidence: Evidence) -> str:
    worst = np.nanmax(np.abs(np.where(np.isfinite(evidence.rows.residual), evidence.rows.residual, 0.0)), axis=1)
    far = np.argsort(-worst)[: max(1, len(worst) // 20)]
    names = evidence.parameters
    tail = f"farthest off: {_unexplained_tables(evidence)}{_lines(evidence, np.sort(far))}"
    # counting outliers less helps where the others are well explained: not if most are off, or off together
    scaled = (evidence.error_scale or 1.0) * np.abs(np.nan_to_num(evidence.rows.residual))
    few = 2 * np.any(scaled > OUTLIER, axis=1).sum() <= evidence.rows.used.sum()
    if few and not evidence.robust and not _correlations(evidence):
        tail += " (if only a few are wrong: --robust)"
    if evidence.contact_share > _LONG_CONTACT:
        return (
            f"Impacts last up to {100.0 * evidence.contact_share:.0f} % of a drive period: too long to be impacts of a "
            f"platform that hardly moves meanwhile; measure at lower frequencies, or at lower orders; {tail}."
        )
    if evidence.lasting:
        other = (
            "The loss may depend on the speed otherwise (try viscous+delay), the"
            if names.keys() & {"r", "viscous_loss"} == {"r"}
            else "The"
        )
        return (
            f"{other} errors may be too small, the calibration (quality_factor, amplitudes, offsets) off, or some rows "
            f"not single-impact orbits; {tail}."
        )
    return (
        "The impacts may last too long for an instantaneous law (a collision delay decides amplitudes near resonance: "
        f"try the model with +delay), the errors may be too small, or the calibration off; {tail}."
    )


def _unexplained_tables(evidence: Evidence) -> str:
    """Return which of several tables are not explained by themselves: 'B.csv (chi2 141/60); '; nothing of one table."""
    if not isinstance(evidence.table, SeveralTables):
        return ""
    named = []
    for t, label in enumerate(evidence.table.labels):
        residual = evidence.rows.residual[evidence.table.number == t]
        residual = residual[np.isfinite(residual)]
        chi2 = float(residual @ residual)
        if len(evidence.table.labels) * chi2_tail(chi2, residual.size) < IMPROBABLE:
            named.append((chi2 / residual.size, f"{label} (chi2 {chi2:.0f}/{residual.size}); "))
    return "".join(words for _, words in sorted(named, reverse=True))


def _disagreeing(evidence: Evidence) -> str:
    """Return which tables' laws are not that of the others, in words; nothing where all may have one."""
    pulls = np.array(evidence.pulls)
    far = np.flatnonzero(pulls * pulls.size < IMPROBABLE)
    named = sorted(far, key=lambda t: pulls[t])
    return "; ".join(f"{evidence.table.labels[t]} is off the others (probability {pulls[t]:.1g})" for t in named)


def value_at_bound(value: float) -> str:
    """Return the value of a parameter at its bound in words: that of a loss is 0 or 1, not 3e-15."""
    return f"{value:z.0f}" if abs(value - round(value)) < _AT_BOUND else f"{value:.4g}"


def helpful_measurement(name: str) -> str:
    """Return what to measure, or to say, so that a parameter gets determined."""
    return (
        parameter_called(name).advice
        or "measure at other drives, orders or offsets too, or hold it fixed at a known value"
    )


def _damping_warnings(evidence: Evidence) -> list[str]:
    warnings: dict[str, list[str]] = {}
    for table, label in zip(evidence.table.tables, evidence.table.labels, strict=True):
        own = name_of_table("quality_factor", label)
        along = evidence.parameters.get(own) or evidence.parameters.get("quality_factor")
        said = _damping_warning(table, along)
        if said:
            warnings.setdefault(said, []).append(label)
    if not isinstance(evidence.table, SeveralTables):
        return list(warnings)
    return [f"{', '.join(labels)}: {said}" for said, labels in warnings.items()]


def _damping_warning(table: AmplitudeTable, along: FittedParameter | None) -> str:
    """Return what there is to say of a table's quality factor, which was fitted along or not; "" for nothing."""
    if along is not None:
        assumed = (table.quality_factor or 0.0, ASSUMED_ERROR_OF_Q * (table.quality_factor or 0.0))
        if table.quality_factor_error is not None or along.constraint != assumed:
            return ""
        given, error = assumed
        return (
            f"quality_factor = {given:g} is given without an error: {100.0 * ASSUMED_ERROR_OF_Q:g} % was assumed "
            f"({given:g} +- {error:.3g}). The loss hangs on it: state it, like `# quality_factor = {given:g} +- 1`."
        )
    if table.quality_factor is None or table.quality_factor_error is not None:
        return ""
    known = f"quality_factor = {table.quality_factor:g}"
    return (
        f"{known} is taken as exact. Amplitudes tell the impact's loss from the air's only as well as Q is known: "
        f"`# {known} +- 1` lets the intervals show it."
    )


def _repeat_warnings(evidence: Evidence) -> list[str]:
    """Return what repeated readings say of the errors, or that these are theirs."""
    said = [remark for one in evidence.table.tables for remark in one.remarks if remark.startswith(ERRORS_OF_REPEATS)]
    if said:
        return [f"{remark[0].upper()}{remark[1:]}." for remark in dict.fromkeys(said)]
    repeats = repeats_of(evidence.table)
    if repeats is None or IMPROBABLE <= repeats.p_value <= 1.0 - IMPROBABLE:
        return []
    large = repeats.error_ratio > 1.0
    return [
        f"Readings of a drive scatter {repeats.error_ratio:.2g} times as much as their errors say ({repeats.rows} rows "
        f"of {repeats.drives} drives): "
        + ("the errors are too small, or something drifted." if large else "the errors are larger than the noise.")
    ]


_FASTEST_KHZ, _SMALLEST_NM = 2e4, 1.0
"""What no cantilever is faster than, and what amplitude impacts take at least: a bridge alone is that long."""


def _fastest_khz(evidence: Evidence) -> float:
    return max(table.free_frequency_khz for table in evidence.table.tables)


def _usual_nm(evidence: Evidence) -> float:
    read = evidence.rows.measured_nm[np.isfinite(evidence.rows.measured_nm)]
    return float(np.median(read)) if read.size else _SMALLEST_NM


def _named_limit(evidence: Evidence, name: str) -> str:
    parameter = evidence.parameters[name]
    low, high = parameter.interval95
    limit = f"< {high:.4g}" if high is not None else f"> {low:.6g}" if low is not None else None
    reading = f": read it as a limit, {name} {limit} (95 %)" if limit else ""
    return f"{name} is at its bound, {value_at_bound(parameter.value)}{reading}."


def _other_minimum(evidence: Evidence, other: tuple[dict[str, float], float]) -> str:
    values = ", ".join(f"{name} = {value:.5g}" for name, value in other[0].items())
    return (
        f"Another minimum explains the data about as well (chi2 {other[1]:.1f}, here {evidence.chi2:.1f}): {values}; "
        "the band of the law and the intervals hold both."
    )


def _open_ones(evidence: Evidence) -> list[str]:
    """Return the names of parameters whose intervals are open to both sides, where nothing worse is known."""
    # a tapping curve tells those of the delay only together; the law does not hang on each
    together = (*(DELAY_NAMES if evidence.table.tapping else ()), *evidence.undetermined)
    if misfits(evidence) or evidence.to_be_determined:
        return []
    return [
        name
        for name, parameter in evidence.parameters.items()
        if name not in together and parameter.interval95 == (None, None)
    ]


def _advice(names: list[str]) -> str:
    return "; ".join(dict.fromkeys(helpful_measurement(name) for name in names))


def _held_in_words(held: Held) -> str:
    return f"{held.name} = {held.value:.4g} +- {held.error:.2g}"


def _assumed(_: Evidence, held: list[Held]) -> str:
    better = f"{held[0].name}={held[0].value:.4g}+-{0.1 * held[0].error:.2g}"
    return (
        f"Held, with errors that are assumed: {', '.join(map(_held_in_words, held))}; law, band and intervals hang on "
        f"them: say what is known better, like --constrain {better}."
    )


def _hanging(evidence: Evidence, case: tuple[str, tuple[str, ...]]) -> str:
    name, others = case
    values = {held.name: _held_in_words(held) for held in evidence.held}
    return f"{name} hangs on what is held: {', '.join(values[other] for other in others)}."


def _tied_pairs(evidence: Evidence) -> list[str]:
    """Return the pairs of parameters that are determined only together, with their correlation."""
    names, matrix = list(evidence.parameters), evidence.correlations
    return [
        f"{names[i]} and {names[j]} ({matrix[i, j]:+.3f})"
        for i in range(len(names))
        for j in range(i + 1, len(names))
        if abs(matrix[i, j]) > _TIED
    ]


def _excluded(evidence: Evidence) -> dict[str, Any]:
    """Return the rows that are excluded, by the reason."""
    rows = np.flatnonzero(evidence.rows.set_aside)
    reasons = evidence.rows.reasons or (TOO_SLOW,) * len(evidence.rows.set_aside)
    return {
        reason: np.array([row for row in rows if reasons[row] == reason])
        for reason in dict.fromkeys(reasons[row] for row in rows)
    }


def _model_error(evidence: Evidence, rows: Any) -> str:
    worst = 100.0 * float(evidence.rows.model_error[rows].max())
    small = "small amplitudes" if evidence.table.tapping else "slow impacts"
    return f"A model error of up to {worst:.1f} % was added to the errors of {small}: {_lines(evidence, rows)}."


def _unseen(evidence: Evidence) -> Bool[np.ndarray, " rows"]:
    """Return on which rows no orbit was seen, though the model has a steady one."""
    unseen = np.zeros(evidence.table.rows) if evidence.table.no_orbit is None else evidence.table.no_orbit
    return (unseen > 0) & (evidence.rows.orbits > 0)


def _neighbours_alike(evidence: Evidence) -> bool:
    """Say whether neighbouring residuals are correlated, though not so much that the fit is not valid."""
    pairs = max(int(np.isfinite(evidence.rows.residual).sum()) - 2, 1)
    return bool(abs(evidence.autocorrelation) > 3.0 / np.sqrt(pairs) and not _correlations(evidence))


def _robust_loss(evidence: Evidence) -> str:
    outliers = np.flatnonzero(evidence.outliers)
    named = f"; outliers: {_lines(evidence, outliers)}" if outliers.size else ""
    chi2, freedom, p_value = _without_outliers(evidence)
    goodness = f"{chi2:.1f}/{freedom}" + (f" (probability {p_value:.2g})" if freedom > 0 else "")
    return f"Robust loss: chi2 counts outliers linearly; without them chi2/dof = {goodness}{named}."


def _course(evidence: Evidence, case: tuple[str, list[str]]) -> str:
    label, courses = case
    several = f"{label}: " if len(evidence.table.labels) > 1 else ""
    return (
        f"{several}Residuals follow the rows ({', '.join(courses)} from the first to the last), as drifts do. If the "
        "rows stand as they were measured, say `# rows = in order of time`: drifts are then fitted along."
    )


def _untold_drifts(evidence: Evidence) -> list[str]:
    """Return the drifts along the rows that are hardly told by anything but what is assumed of them."""
    return [
        f"{name} = {known.constraint[0]:g} +- {known.constraint[1]:g}"
        for name, known in evidence.parameters.items()
        if parameter_called(name).name in DRIFT_NAMES
        and known.constraint is not None
        and (known.standard_error or np.inf) > 0.5 * known.constraint[1]
    ]


def _lines(evidence: Evidence, rows: Any) -> str:
    """Return 'line 7' or 'lines 7, 9, 12 and 3 more' of the table's file; 'line B.csv:7' of several."""
    numbers = evidence.table.row_names[np.asarray(rows)].tolist()
    shown = ", ".join(numbers[:6]) + (f" and {len(numbers) - 6} more" if len(numbers) > 6 else "")
    return f"{'line' if len(numbers) == 1 else 'lines'} {shown}"


def _any(rows: Any) -> list[Any]:
    """Return the numbers of marked rows as one case; none where no row is marked."""
    numbers = np.flatnonzero(rows)
    return [numbers] if numbers.size else []


def _together(parts: Any) -> list[Any]:
    """Return everything as one case; none where there is nothing."""
    return [parts] if parts else []


MISFITS: tuple[Rule[Evidence] | tuple[Rule[Evidence], ...], ...] = (
    Rule(
        lambda e: e.p_value < IMPROBABLE,
        lambda e, _: f"chi2/dof = {e.chi2 / e.freedom:.3g} (probability {e.p_value:.1g})",
    ),
    (
        Rule(
            lambda e: e.robust and e.outliers.sum() > max(1.0, MOST_OUTLIERS * e.rows.used.sum()),
            lambda e, _: (
                f"{e.outliers.sum()} of {e.rows.used.sum()} rows are off by more than {OUTLIER:g} errors, and robust "
                f"loss is for outliers in at most one row of {1.0 / MOST_OUTLIERS:g}"
            ),
        ),
        Rule(
            lambda e: [rest for rest in [_without_outliers(e)] if e.robust and rest[2] < IMPROBABLE],
            lambda _, rest: f"without outliers chi2/dof = {rest[0] / rest[1]:.3g} (probability {rest[2]:.1g})",
        ),
    ),
    Rule(
        lambda e: (e.error_scale or 0.0) > LARGEST_SCALE,
        lambda e, _: (
            f"the amplitudes' errors would have to be {e.error_scale:.3g} times those stated, and more than "
            f"{LARGEST_SCALE:g} is a misfit, not a matter of scale (if the errors are no more than weights, state them "
            "to within that)"
        ),
    ),
    Rule(
        lambda e: (
            e.error_scale is not None
            and bool(e.pulled)
            and chi2_tail(sum(pull**2 for pull in e.pulled.values()), len(e.pulled)) < IMPROBABLE
        ),
        lambda e, _: (
            "it contradicts what is known beforehand, in standard errors: "
            + ", ".join(f"{name} by {pull:+.1f}" for name, pull in e.pulled.items())
        ),
    ),
    Rule(
        lambda e: e.run[1] > _LONGEST_RUN,
        lambda e, _: (
            f"residuals run together over the approach speed ({e.run[0]:.1f} standard deviations; "
            f"{e.run[1]:.1f} beside a model discrepancy of {100.0 * e.short:.0f} % of the loss)"
        ),
    ),
    Rule(lambda e: _together(_one_sided(e)), _rows_to_one_side),
    Rule(
        _correlations,
        lambda _, case: f"neighbouring residuals {case[0]} are correlated ({case[1]:+.1f} standard deviations)",
    ),
)
"""Grounds on which the model does not explain the amplitudes, each a clause."""

REASONS: tuple[Rule[Evidence] | tuple[Rule[Evidence], ...], ...] = (
    (
        Rule(
            lambda e: e.convergence.reason is not None,
            lambda e, _: f"Not converged: {e.convergence.reason}.",
        ),
        Rule(
            lambda e: _together(e.to_be_determined),
            lambda _, names: (
                f"Not identified: the amplitudes do not determine {' and '.join(names)}; {_advice(names)}."
            ),
        ),
        Rule(
            lambda e: not e.convergence.converged,
            lambda e, _: (
                f"Not converged: {_distance_in_words(e.convergence.estimated_distance)}"
                f"{'' if e.convergence.outward else ', and a parameter is held at a bound it would leave'}."
            ),
        ),
    ),
    Rule(
        lambda e: _any((e.rows.orbits == 0) & e.rows.used),
        lambda e, rows: f"No stable orbit at the fitted law for {_lines(e, rows)}.",
    ),
    Rule(
        lambda e: _together(e.untabulated),
        lambda e, rows: (
            f"The table of the fitted contact's impacts misses its accuracy for {_lines(e, rows)}: the contact's "
            "numbers are too extreme; hold some of them fixed."
        ),
    ),
    Rule(
        lambda e: _together(misfits(e)),
        lambda e, grounds: f"The model does not explain the data: {'; '.join(grounds)}. {_why_not_explained(e)}",
    ),
    Rule(
        lambda e: _together(e.stuck),
        lambda _, chi2: (
            f"Not converged: to first order the model discrepancy would lower chi2 from {chi2[0]:.1f} to "
            f"{chi2[1]:.1f}, but computed not even a sixteenth of it does; the amplitudes are far from linear in the "
            "law, as they are near folds: leave such rows out."
        ),
    ),
    Rule(
        lambda e: _together([_pull_in_words(e, name, pull) for name, pull in e.pulled.items() if abs(pull) > _TORN]),
        lambda _, torn: (
            f"The amplitudes contradict what is known beforehand: {'; '.join(torn)}. "
            "Either that is wrong, or the model makes up for what it lacks."
        ),
    ),
    Rule(
        lambda e: _together("" if e.scattering else _disagreeing(e)),
        lambda _, tables: (
            f"The tables do not have one law: {tables}; look at what is different there, leave it out, or let laws "
            "differ from table to table (--hierarchical)."
        ),
    ),
    Rule(
        lambda e: e.freedom <= 0,
        lambda *_: "As many parameters as amplitudes: the goodness of fit cannot be judged.",
    ),
    Rule(
        _open_ones,
        lambda e, name: f"{name} is not identified: {e.parameters[name].interval_reason}; {helpful_measurement(name)}.",
    ),
)
"""What makes a fit invalid."""

WARNINGS: tuple[Rule[Evidence], ...] = (
    Rule(_damping_warnings, lambda _, said: said),
    Rule(
        lambda e: e.table.mass_ng is None and e.contact,
        lambda *_: f"1 ng assumed: {NO_MASS}. Each of the contact's parameters hangs on it.",
    ),
    Rule(
        lambda e: _fastest_khz(e) > _FASTEST_KHZ,
        lambda e, _: (
            f"free_frequency_khz = {_fastest_khz(e):g} is more than any cantilever's: was it written in Hz for kHz?"
        ),
    ),
    Rule(
        lambda e: _usual_nm(e) < _SMALLEST_NM,
        lambda e, _: (
            f"Amplitudes are {_usual_nm(e):.2g} nm in the median: were they written in micrometres for nanometres?"
        ),
    ),
    Rule(_repeat_warnings, lambda _, said: said),
    Rule(
        lambda e: _together(_disagreeing(e) if e.scattering else ""),
        lambda _, tables: f"Far from the mean law even for this scatter: {tables}.",
    ),
    Rule(
        lambda e: _together(e.undetermined if e.may_stay_open and not misfits(e) else []),
        lambda _, names: (
            f"Not determined by these taps: {' and '.join(names)}, anything within their ranges explains them, and the "
            f"law's band takes that in; {_advice(names)}."
        ),
    ),
    Rule(
        lambda e: [(name, pull) for name, pull in e.pulled.items() if _PULLED < abs(pull) <= _TORN],
        lambda e, case: f"{_pull_in_words(e, *case)}: check it, the loss hangs on it.",
    ),
    Rule(
        # where the model does not explain the data, a bound is only where the misfit pushed the parameter
        lambda e: [name for name, known in e.parameters.items() if known.at_bound and not misfits(e)],
        _named_limit,
    ),
    Rule(
        lambda e: [name for name, known in e.parameters.items() if known.did_not_move],
        lambda _, name: f"{name} did not move from the grid point it started at.",
    ),
    Rule(lambda e: _together(e.other_minimum), _other_minimum),
    Rule(
        lambda e: _together(_tied_pairs(e)),
        lambda _, pairs: (
            f"Determined only together, hardly apart: {', '.join(pairs)}. The law may be sharp all the same: see its "
            "band."
        ),
    ),
    Rule(
        lambda e: e.run[0] >= _RUN and e.short > 0.0,
        lambda e, _: (
            f"Residuals run together over the approach speed ({e.run[0]:.1f} standard deviations): the model lacks a "
            f"shape; a model discrepancy of {100.0 * e.short:.0f} % of the loss at any speed is in law, band and "
            "intervals."
        ),
    ),
    Rule(lambda e: _together([held for held in e.held if held.assumed]), _assumed),
    Rule(lambda e: e.hanging.items(), _hanging),
    Rule(
        lambda e: _excluded(e).items(),
        lambda e, case: f"Set aside, because these impacts are {case[0]}: {_lines(e, case[1])}.",
    ),
    Rule(lambda e: _any(e.rows.used & (e.rows.model_error > _STATED)), _model_error),
    Rule(
        lambda e: _any(_unseen(e)),
        lambda e, rows: (
            f"No orbit was seen, though the fitted model has a steady one, for {_lines(e, rows)}: the tip may have "
            "settled on another motion; start it otherwise, or remove the row."
        ),
    ),
    Rule(
        lambda e: _any(e.rows.orbits > 1),
        lambda e, rows: (
            f"Several stable orbits coexist for {_lines(e, rows)}: the one closest to the measurement was taken."
        ),
    ),
    Rule(
        lambda e: _any(e.rows.near_fold),
        lambda e, rows: f"Close to a fold, where errors are not linear: {_lines(e, rows)}.",
    ),
    Rule(
        _neighbours_alike,
        lambda e, _: f"Neighbouring residuals are correlated ({e.autocorrelation:+.2f}): something systematic is left.",
    ),
    Rule(lambda e: e.robust, lambda e, _: _robust_loss(e)),
    Rule(
        lambda e: e.error_scale is not None,
        lambda e, _: (
            f"The amplitudes' errors were scaled by {e.error_scale:.3g} so that chi2/dof = 1: whether they are of the "
            f"right size cannot be judged, only that the scale is believable (at most {LARGEST_SCALE:g}) and that "
            "residuals are random."
        ),
    ),
    Rule(
        lambda e: e.error_scale is None and e.p_value > 1.0 - 1e-6,
        lambda *_: "The errors look too large: chi2 is improbably small.",
    ),
    Rule(lambda e: e.courses.items(), _course),
    Rule(
        lambda e: _together(_untold_drifts(e)),
        lambda _, drifts: (
            f"Hardly told by the rows, which stand in order of time, only assumed: {', '.join(drifts)}. Rows of the "
            "free tip before and after the others tell drifts; `--constrain` takes what is known of them."
        ),
    ),
)
"""What a reader should know besides."""
