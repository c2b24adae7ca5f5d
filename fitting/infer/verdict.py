"""Whether to trust a fit, in words: what makes it invalid, and what a reader should know besides.

A fit is valid only if what is left of the amplitudes passes an absolute test, whatever the options:
chi2 by its probability; with a robust fit the share of outliers, and chi2 without them by its probability; with scaled
errors the scale, and what is known of the parameters; always that neighbouring residuals are not correlated, neither in
the table's order (a drift, a sweep the model does not follow) nor over the approach speed (a wrong law).

The rules are the three lists at the end: `MISFITS`, `REASONS` and `WARNINGS`.
"""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from afm_jax.least_squares import IMPROBABLE, LARGEST_SCALE, PULLED, TORN, chi2_tail
from afm_jax.outcomes import Rule, Rules, judge
from fitting.infer.explain import LARGEST_SHARE, MOST_OUTLIERS, OUTLIER
from fitting.infer.intervals import UNSETTLED
from fitting.infer.result import ENOUGH, NO_MASS, Convergence, FittedParameter, FittedRows
from fitting.infer.rows import OUTLIER_LEFT_OUT, TOO_SLOW
from fitting.models import Held
from fitting.parameters import DELAY_NAMES, DRIFT_NAMES, USUAL_ERRORS, name_of_table, parameter_called
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
    "pull turns the tip round; drive 3 to 10 % above resonance, with a large free amplitude. The energy of a tap needs "
    "no law: `afm-jax tapping CURVE`."
)
_AT_BOUND = 0.005


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
    other_minimum: tuple[dict[str, float], float] | None
    error_scale: float | None
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
    pulls: tuple[float, ...] = ()
    """Of several tables, the probability that each one's law is that of the others."""
    run: tuple[float, float] = (0.0, 0.0)
    """Standard deviations by which residuals run together over the speed, and by which beside the discrepancy added."""
    unwidened: Float[np.ndarray, "rows k"] | None = None
    """Residuals of the rows without the discrepancy that was added for runs: that goes after outliers."""
    held: tuple[Held, ...] = ()
    """What a fit of the contact holds, with its errors."""
    short: float = 0.0
    """Share of the loss by which the model discrepancy of short range was added for that."""
    courses: dict[str, list[str]] = field(default_factory=dict)
    """Which readings of a table follow its rows, whose order nothing says, by the table's label."""

    @property
    def undetermined(self) -> list[str]:
        """Names of the parameters that the data do not determine, not even to first order."""
        return [name for name, parameter in self.parameters.items() if parameter.undetermined]

    @property
    def contradictions(self) -> dict[str, float]:
        """How far each parameter is from what was measured of it otherwise, in standard errors of that."""
        known = {name: (p.value, *p.constraint) for name, p in self.parameters.items() if p.constraint is not None}
        return {name: (value - given) / error for name, (value, given, error) in known.items()}

    @property
    def outliers(self) -> Bool[np.ndarray, " rows"]:
        """Which rows are far off."""
        return np.any(np.abs(np.nan_to_num(self.rows.residual)) > OUTLIER, axis=1)

    @property
    def most_outliers(self) -> float:
        """How many outliers a robust fit may have."""
        return max(1.0, MOST_OUTLIERS * self.rows.used.sum())

    @property
    def chi2_per_freedom(self) -> float:
        """chi2 over the degrees of freedom."""
        return self.chi2 / self.freedom


def judge_fit(evidence: Evidence) -> tuple[list[str], list[str]]:
    """Return what makes a fit invalid, and its warnings; each a sentence."""
    return [_REFUSED] if evidence.refused else judge(REASONS, evidence), judge(WARNINGS, evidence)


def misfits(evidence: Evidence) -> list[str]:
    """Return the grounds on which the model does not explain the amplitudes, each a clause; none if it does.

    The parameters' errors and intervals are not looked at.
    """
    return [_REFUSED] if evidence.refused else judge(MISFITS, evidence)


def _correlations(evidence: Evidence) -> list[tuple[str, float]]:
    """Return in which order of the rows neighbouring residuals are correlated, and how much."""
    rows, residual = evidence.rows, evidence.rows.residual
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


def _one_sided(evidence: Evidence) -> list[str]:
    """Return that some rows are off to one side: chance gives as large residuals of either sign.

    A robust fit is for such rows.
    """
    residual = evidence.rows.residual if evidence.unwidened is None else evidence.unwidened
    count = np.isfinite(residual).sum(axis=1)
    of_row = np.nansum(residual, axis=1) / np.sqrt(np.maximum(count, 1))
    rows = int((count > 0).sum())
    excess = float(np.sum(of_row**3) / np.sqrt(15.0 * max(rows, 1)))
    if rows <= _FEWEST_NEIGHBOURS or abs(excess) < _ONE_SIDED or evidence.robust:
        return []
    far = np.argsort(-np.sign(excess) * of_row)[: max(1, rows // 10)]
    side = "above" if excess > 0.0 else "below"
    said = f"residuals are far off to one side ({excess:+.3g} standard deviations of their cubes)"
    return [f"{said}: predicted {side} what was read for {_lines(evidence, np.sort(far))}"]


def _without_outliers(evidence: Evidence) -> tuple[float, int, float]:
    """Return chi2 of the amplitudes that are no outliers and of what is known, its freedom and its probability."""
    residual, pulls = evidence.rows.residual, evidence.contradictions
    inside = residual[np.abs(residual) <= OUTLIER]
    freedom = inside.size + len(pulls) - len(evidence.parameters)
    chi2 = float(np.sum(inside**2) + sum(pull**2 for pull in pulls.values()))
    return chi2, freedom, chi2_tail(chi2, freedom) if freedom > 0 else float("nan")


def _pull_in_words(evidence: Evidence, name: str, pull: float) -> str:
    parameter = evidence.parameters[name]
    given, error = parameter.constraint or (float("nan"), float("nan"))
    return f"{name} = {parameter.value:.5g} is {abs(pull):.1f} standard errors from the given {given:g} +- {error:.2g}"


def _contradicted(evidence: Evidence) -> list[str]:
    """Return by how much scaled amplitudes contradict what is known beforehand, taken together, in words."""
    pulls = evidence.contradictions
    if evidence.error_scale is None or not pulls:
        return []
    improbable = chi2_tail(sum(pull**2 for pull in pulls.values()), len(pulls)) < IMPROBABLE
    return [", ".join(f"{name} by {pull:+.1f}" for name, pull in pulls.items())] if improbable else []


def _torn(evidence: Evidence) -> list[str]:
    """Return what the amplitudes contradict of what was measured otherwise, in words."""
    torn = [_pull_in_words(evidence, name, pull) for name, pull in evidence.contradictions.items() if abs(pull) > TORN]
    return ["; ".join(torn)] if torn else []


def _not_converged(evidence: Evidence) -> list[str]:
    """Return how far the search is from a minimum, in words."""
    convergence = evidence.convergence
    if convergence.converged:
        return []
    if not np.isfinite(convergence.estimated_distance):
        return ["chi2 bends downwards where the search ended, which is no minimum"]
    if convergence.estimated_distance < ENOUGH:
        return ["which orbits the rows have, and what they count, does not settle"]
    return [f"chi2 lies an estimated {convergence.estimated_distance:.2g} above its minimum"]


def _not_explained(evidence: Evidence) -> list[str]:
    """Return on which grounds the model does not explain the data, and what may be the reason, in words."""
    grounds = misfits(evidence)
    return [f"{'; '.join(grounds)}. {_why_not_explained(evidence)}"] if grounds else []


def _why_not_explained(evidence: Evidence) -> str:
    worst = np.nanmax(np.abs(np.where(np.isfinite(evidence.rows.residual), evidence.rows.residual, 0.0)), axis=1)
    far = np.argsort(-worst)[: max(1, len(worst) // 20)]
    tail = f"farthest off: {_lines(evidence, np.sort(far))}"
    # counting outliers less helps where the others are well explained: not if most are off, or off together
    scaled = (evidence.error_scale or 1.0) * np.abs(np.nan_to_num(evidence.rows.residual))
    few = 2 * np.any(scaled > OUTLIER, axis=1).sum() <= evidence.rows.used.sum()
    if few and not evidence.robust and not _correlations(evidence):
        tail += " (if only a few are wrong: `robust=True`)"
    if evidence.contact_share > _LONG_CONTACT:
        return (
            f"Impacts last up to {100.0 * evidence.contact_share:.0f} % of a drive period: too long to be impacts of a "
            f"platform that hardly moves meanwhile; measure at lower frequencies, or at lower orders; {tail}."
        )
    return (
        "Another law may (near resonance a collision delay decides: models with +delay; `compare` tries several), "
        "the errors may be too small, the calibration (quality_factor, amplitudes, offsets) off, or some rows not "
        f"single-impact orbits; {tail}."
    )


def _disagreeing(evidence: Evidence) -> list[str]:
    """Return which tables' laws are not that of the others, in words; nothing where all may have one."""
    pulls = np.array(evidence.pulls)
    far = np.flatnonzero(pulls * pulls.size < IMPROBABLE)
    named = sorted(far, key=lambda t: pulls[t])
    said = [f"{evidence.table.labels[t]} is off the others (probability {pulls[t]:.1g})" for t in named]
    return ["; ".join(said)] if said else []


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
        usual = USUAL_ERRORS["quality_factor"]
        assumed = (table.quality_factor or 0.0, usual * (table.quality_factor or 0.0))
        if table.quality_factor_error is not None or along.constraint != assumed:
            return ""
        given, error = assumed
        return (
            f"quality_factor = {given:g} is given without an error: {100.0 * usual:g} % was assumed "
            f"({given:g} +- {error:.3g}). The loss depends on it: state it, like `# quality_factor = {given:g} +- 1`."
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


def _usual_nm(evidence: Evidence) -> list[float]:
    """Return the median of the amplitudes, none where nothing was read."""
    read = evidence.rows.measured_nm[np.isfinite(evidence.rows.measured_nm)]
    return [float(np.median(read))] if read.size else []


def _limits(evidence: Evidence) -> list[str]:
    """Return which parameters are at their bounds, and the limits that they are to be read as, in words.

    Where the model does not explain the data, a bound is only where the misfit pushed the parameter.
    """
    found = []
    for name, parameter in {} if misfits(evidence) else evidence.parameters.items():
        low, high = parameter.interval95
        if parameter.at_bound:
            limit = f"< {high:.4g}" if high is not None else f"> {low:.6g}" if low is not None else None
            reading = f": read it as a limit, {name} {limit} (95 %)" if limit else ""
            found.append(f"{name} is at its bound, {value_at_bound(parameter.value)}{reading}")
    return found


def _other_minimum(evidence: Evidence) -> list[str]:
    if evidence.other_minimum is None:
        return []
    values, chi2 = evidence.other_minimum
    said = ", ".join(f"{name} = {value:.5g}" for name, value in values.items())
    return [f"chi2 {chi2:.1f}, here {evidence.chi2:.1f}): {said}"]


def _open_ones(evidence: Evidence) -> list[str]:
    """Return the parameters whose intervals are open to both sides, where nothing worse is known, in words.

    An end that its search did not find is no end of what the data allow: there one side is enough.
    """
    # a tapping curve tells those of the delay only together; the law does not hang on each
    together = (*(DELAY_NAMES if evidence.table.tapping else ()), *evidence.undetermined)
    if misfits(evidence) or _not_identified(evidence):
        return []
    unsettled = {name for name, known in evidence.parameters.items() if UNSETTLED in (known.interval_reason or "")}
    return [
        f"{name} is not identified: {parameter.interval_reason}; {helpful_measurement(name)}"
        for name, parameter in evidence.parameters.items()
        if name in unsettled or (name not in together and parameter.interval95 == (None, None))
    ]


def _not_identified(evidence: Evidence) -> list[str]:
    """Return the parameters that the data do not determine and must, with what to measure, in words."""
    names = evidence.undetermined
    return [f"{' and '.join(names)}; {_advice(names)}"] if names else []


def _advice(names: list[str]) -> str:
    return "; ".join(dict.fromkeys(helpful_measurement(name) for name in names))


def _held_in_words(held: Held) -> str:
    return f"{held.name} = {held.value:.4g} +- {held.error:.2g}"


def _assumed(evidence: Evidence) -> list[str]:
    """Return what is held with errors that are assumed, and how to say them, in words."""
    held = [held for held in evidence.held if held.assumed]
    if not held:
        return []
    better = f'`constraints={{"{held[0].name}": ({held[0].value:.4g}, {0.1 * held[0].error:.2g})}}`'
    said = f"{', '.join(map(_held_in_words, held))}; law, band and intervals hang on them"
    return [f"{said}: say what is known better, like {better}"]


def _tied_pairs(evidence: Evidence) -> list[str]:
    """Return the pairs of parameters that are determined only together, with their correlation, in words."""
    names, matrix = list(evidence.parameters), evidence.correlations
    pairs = [
        f"{names[i]} and {names[j]} ({matrix[i, j]:+.3f})"
        for i in range(len(names))
        for j in range(i + 1, len(names))
        if abs(matrix[i, j]) > _TIED
    ]
    return [", ".join(pairs)] if pairs else []


def _excluded(evidence: Evidence) -> list[str]:
    """Return the rows that are excluded, for every reason, in words."""
    rows = np.flatnonzero(evidence.rows.set_aside)
    reasons = evidence.rows.reasons or (TOO_SLOW,) * len(evidence.rows.set_aside)
    return [
        f"{reason}: {_lines(evidence, [row for row in rows if reasons[row] == reason])}"
        for reason in dict.fromkeys(reasons[row] for row in rows)
        if reason != OUTLIER_LEFT_OUT
    ]


def _model_error(evidence: Evidence) -> list[str]:
    """Return how large a model error was added to which rows, in words."""
    rows = np.flatnonzero(evidence.rows.used & (evidence.rows.model_error > _STATED))
    worst = 100.0 * float(evidence.rows.model_error[rows].max(initial=0.0))
    small = "small amplitudes" if evidence.table.tapping else "slow impacts"
    return [f"{worst:.1f} % was added to the errors of {small}: {_lines(evidence, rows)}"] if rows.size else []


def _unseen(evidence: Evidence) -> Bool[np.ndarray, " rows"]:
    """Return on which rows no orbit was seen, though the model has a steady one."""
    unseen = np.zeros(evidence.table.rows) if evidence.table.no_orbit is None else evidence.table.no_orbit
    return (unseen > 0) & (evidence.rows.orbits > 0)


def _robust_loss(evidence: Evidence) -> list[str]:
    """Return the goodness of a robust fit without its outliers, and which these are, in words."""
    if not evidence.robust:
        return []
    chi2, freedom, p_value = _without_outliers(evidence)
    probability = f" (probability {p_value:.2g})" if freedom > 0 else ""
    left_out = np.isin(evidence.rows.reasons or "", OUTLIER_LEFT_OUT)
    outliers = "".join(f"; outliers: {lines}" for lines in _named(evidence, evidence.outliers | left_out))
    return [f"{chi2:.1f}/{freedom}{probability}{outliers}"]


def _courses(evidence: Evidence) -> list[str]:
    """Return which readings follow the rows of each table, in words."""
    several = len(evidence.table.labels) > 1
    return [
        f"{f'{label}: ' if several else ''}Residuals follow the rows ({', '.join(courses)} from the first to the last)"
        for label, courses in evidence.courses.items()
    ]


def _untold_drifts(evidence: Evidence) -> list[str]:
    """Return the drifts along the rows that are hardly told by anything but what is assumed of them, in words."""
    drifts = [
        f"{name} = {known.constraint[0]:g} +- {known.constraint[1]:g}"
        for name, known in evidence.parameters.items()
        if parameter_called(name).name in DRIFT_NAMES
        and known.constraint is not None
        and (known.standard_error or np.inf) > 0.5 * known.constraint[1]
    ]
    return [", ".join(drifts)] if drifts else []


def _named(evidence: Evidence, marked: Bool[np.ndarray, " rows"]) -> list[str]:
    """Return marked rows in words; nothing where no row is marked."""
    rows = np.flatnonzero(marked)
    return [_lines(evidence, rows)] if rows.size else []


def _lines(evidence: Evidence, rows: Any) -> str:
    """Return 'line 7' or 'lines 7, 9, 12 and 3 more' of the table's file; 'line B.csv:7' of several."""
    numbers = evidence.table.row_names[np.asarray(rows)].tolist()
    shown = ", ".join(numbers[:6]) + (f" and {len(numbers) - 6} more" if len(numbers) > 6 else "")
    return f"{'line' if len(numbers) == 1 else 'lines'} {shown}"


MISFITS: Rules[Evidence] = (
    Rule(lambda e: e.p_value < IMPROBABLE, "chi2/dof = {e.chi2_per_freedom:.3g} (probability {e.p_value:.1g})"),
    (
        Rule(
            lambda e: [(n, e.rows.used.sum()) for n in [e.outliers.sum()] if e.robust and n > e.most_outliers],
            "{case[0]} of {case[1]} rows are off by more than "
            f"{OUTLIER:g} errors, and a robust fit leaves at most one row of {1.0 / MOST_OUTLIERS:g} out",
        ),
        Rule(
            lambda e: [
                (chi2 / freedom, p_value)
                for chi2, freedom, p_value in [_without_outliers(e)]
                if e.robust and p_value < IMPROBABLE
            ],
            "without outliers chi2/dof = {case[0]:.3g} (probability {case[1]:.1g})",
        ),
    ),
    Rule(
        lambda e: (e.error_scale or 0.0) > LARGEST_SCALE,
        "the amplitudes' errors would have to be {e.error_scale:.3g} times those stated, and more than "
        f"{LARGEST_SCALE:g} is a misfit, not a matter of scale (if the errors are no more than weights, state them "
        "to within that)",
    ),
    Rule(_contradicted, "it contradicts what is known beforehand, in standard errors: {case}"),
    Rule(
        lambda e: [100.0 * e.short] if e.run[1] > _LONGEST_RUN or e.short >= LARGEST_SHARE else [],
        "residuals run together over the approach speed ({e.run[0]:.1f} standard deviations; {e.run[1]:.1f} beside a "
        "model discrepancy of {case:.0f} % of the loss)",
    ),
    Rule(_one_sided, "{case}"),
    Rule(_correlations, "neighbouring residuals {case[0]} are correlated ({case[1]:+.1f} standard deviations)"),
)
"""Grounds on which the model does not explain the amplitudes, each a clause."""

REASONS: Rules[Evidence] = (
    (
        Rule(lambda e: e.convergence.reason is not None, "Not converged: {e.convergence.reason}."),
        Rule(_not_identified, "Not identified: the amplitudes do not determine {case}."),
        Rule(_not_converged, "Not converged: {case}."),
    ),
    Rule(lambda e: _named(e, (e.rows.orbits == 0) & e.rows.used), "No stable orbit at the fitted law for {case}."),
    Rule(
        lambda e: [_lines(e, e.untabulated)] if e.untabulated else [],
        "The table of the fitted contact's impacts misses its accuracy for {case}: the contact's numbers are too "
        "extreme; hold some of them fixed.",
    ),
    Rule(_not_explained, "The model does not explain the data: {case}"),
    Rule(
        _torn,
        "The amplitudes contradict what is known beforehand: {case}. "
        "Either that is wrong, or the model makes up for what it lacks.",
    ),
    Rule(
        _disagreeing,
        "The tables do not have one law: {case}; look at what is different there, or leave it out.",
    ),
    Rule(lambda e: e.freedom <= 0, "As many parameters as amplitudes: the goodness of fit cannot be judged."),
    Rule(_open_ones, "{case}."),
)
"""What makes a fit invalid."""

WARNINGS: Rules[Evidence] = (
    Rule(_damping_warnings, "{case}"),
    Rule(
        lambda e: e.table.mass_ng is None and e.contact,
        f"1 ng assumed: {NO_MASS}. Each of the contact's parameters depends on it.",
    ),
    Rule(
        lambda e: [f for f in [max(table.free_frequency_khz for table in e.table.tables)] if f > _FASTEST_KHZ],
        "free_frequency_khz = {case:g} is more than any cantilever's: was it written in Hz for kHz?",
    ),
    Rule(
        lambda e: [usual for usual in _usual_nm(e) if usual < _SMALLEST_NM],
        "Amplitudes are {case:.2g} nm in the median: were they written in micrometres for nanometres?",
    ),
    Rule(_repeat_warnings, "{case}"),
    Rule(
        lambda e: [_pull_in_words(e, name, by) for name, by in e.contradictions.items() if PULLED < abs(by) <= TORN],
        "{case}: check it, the loss depends on it.",
    ),
    Rule(_limits, "{case}."),
    Rule(
        _other_minimum,
        "Another minimum explains the data about as well ({case}; the band of the law and the intervals hold both.",
    ),
    Rule(
        _tied_pairs,
        "Determined only together, hardly apart: {case}. The law may be sharp all the same: see its band.",
    ),
    Rule(
        lambda e: [100.0 * e.short] if e.run[0] >= _RUN and e.short > 0.0 else [],
        "Residuals run together over the approach speed ({e.run[0]:.1f} standard deviations): the model lacks a "
        "shape; a model discrepancy of {case:.0f} % of the loss at any speed is in law, band and intervals.",
    ),
    Rule(_assumed, "Held, with errors that are assumed: {case}."),
    Rule(_excluded, "Excluded, because these impacts are {case}."),
    Rule(_model_error, "A model error of up to {case}."),
    Rule(
        lambda e: _named(e, _unseen(e)),
        "No orbit was seen, though the fitted model has a steady one, for {case}: the tip may have settled on another "
        "motion; start it otherwise, or remove the row.",
    ),
    Rule(
        lambda e: _named(e, e.rows.orbits > 1),
        "Several stable orbits coexist for {case}: the one closest to the measurement was taken.",
    ),
    Rule(lambda e: _named(e, e.rows.near_fold), "Close to a fold, where errors are not linear: {case}."),
    Rule(_robust_loss, "Robust fit: outliers are left out; without them chi2/dof = {case}."),
    Rule(
        lambda e: e.error_scale is not None,
        "The amplitudes' errors were scaled by {e.error_scale:.3g} so that chi2/dof = 1: whether they are of the right "
        f"size cannot be judged, only that the scale is believable (at most {LARGEST_SCALE:g}) and that residuals are "
        "random.",
    ),
    Rule(
        lambda e: e.error_scale is None and e.p_value > 1.0 - 1e-6,
        "The errors look too large: chi2 is improbably small.",
    ),
    Rule(
        _courses,
        "{case}, as drifts do. If the rows stand as they were measured, say `# rows = in order of time`: drifts are "
        "then fitted along.",
    ),
    Rule(
        _untold_drifts,
        "The rows, which stand in order of time, hardly determine what is assumed here: {case}. Rows of the free tip "
        "before and after the others determine drifts; `constraints=...` takes what is known of them.",
    ),
)
"""What a reader should know besides."""
