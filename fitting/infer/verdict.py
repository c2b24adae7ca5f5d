"""Whether to trust a fit, in words: what makes it invalid, and what a reader should know besides.

A fit is valid only if what is left of the amplitudes passes an absolute test, whatever the options:
chi2 by its probability, of a robust fit without outliers, and the share of these; with scaled errors the scale; always
that neighbouring residuals are not correlated, neither in the table's order (a drift, a sweep the model does not
follow) nor over the approach speed (a wrong law).

The rules are the three lists at the end: `MISFITS`, `REASONS` and `WARNINGS`.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from afm_jax.outcomes import Rule, Rules, judge
from afm_jax.solve.least_squares import IMPROBABLE, LARGEST_SCALE, PULLED, TORN
from fitting.infer.explain import LARGEST_SHARE, MOST_OUTLIERS, OUTLIER
from fitting.infer.intervals import UNSETTLED
from fitting.infer.result import NO_MASS, Convergence, FittedParameter, FittedRows
from fitting.infer.rows import OUTLIER_LEFT_OUT
from fitting.models import Held
from fitting.parameters import (
    CONTACT_NAMES,
    DELAY_NAMES,
    USUAL_DRIFTS,
    USUAL_ERRORS,
    name_of_table,
    parameter_called,
)
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
"""Correlation of neighbouring residuals, or their slope along the rows, in standard deviations of those of independent
ones, from which they are taken to be correlated: by chance in one fit of ten thousand."""
_NEGLIGIBLE = 0.3
"""Root mean square of the residuals, in errors, below which their pattern is of no consequence."""
_FEWEST_NEIGHBOURS = 8
_FASTEST_KHZ, _SMALLEST_NM = 2e4, 1.0
"""Highest frequency of a cantilever, and smallest amplitude that has impacts: a bridge alone is that long."""
_REFUSED = (
    "No law of impacts can be read off this curve: on nearly all of its rows impacts are too slow, or the lever's own "
    "pull turns the tip round; drive 3 to 10 % above resonance, with a large free amplitude. The energy of a tap needs "
    "no law: `afm-jax tapping CURVE`."
)
_CAUSES = (
    "Another law may (near resonance a collision delay decides: models with +delay; `compare` tries several), the "
    "errors may be too small, the calibration (quality_factor, amplitudes, offsets) off, impacts longer than a fifth "
    "of a period (measure at lower frequencies), or some rows not single-impact orbits (if only a few: `robust=True`)"
)


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
    correlations: Float[np.ndarray, "p p"]
    other_minimum: tuple[dict[str, float], float] | None = None
    error_scale: float | None = None
    robust: bool = False
    untabulated: tuple[int, ...] = ()
    """Rows whose impacts the table of a contact does not hold to its accuracy."""
    refused: bool = False
    """Hardly a row is left that a law of impacts can be read off."""
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

    @property
    def outliers(self) -> Bool[np.ndarray, " rows"]:
        """Which rows are far off."""
        return np.any(np.abs(np.nan_to_num(self.rows.residual)) > OUTLIER, axis=1)


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


def _one_sided(evidence: Evidence) -> str:
    """Return which rows are far off to one side, in words; nothing where residuals of either sign are as large.

    A robust fit leaves such rows out, and is not asked.
    """
    residual = evidence.rows.residual if evidence.unwidened is None else evidence.unwidened
    count = np.isfinite(residual).sum(axis=1)
    of_row = np.nansum(residual, axis=1) / np.sqrt(np.maximum(count, 1))
    rows = int((count > 0).sum())
    excess = float(np.sum(of_row**3) / np.sqrt(15.0 * max(rows, 1)))
    if rows <= _FEWEST_NEIGHBOURS or abs(excess) < _ONE_SIDED or evidence.robust:
        return ""
    far = np.argsort(-np.sign(excess) * of_row)[: max(1, rows // 10)]
    side = "above" if excess > 0.0 else "below"
    said = f"residuals are far off to one side ({excess:+.3g} standard deviations of their cubes)"
    return f"{said}: predicted {side} what was read for {_lines(evidence, np.sort(far))}"


def _too_many_outliers(evidence: Evidence) -> str:
    """Return how many rows of a robust fit are far off, in words, if it leaves so many out no longer."""
    far, used = int(evidence.outliers.sum()), int(evidence.rows.used.sum())
    most = f"a robust fit leaves at most one row of {1.0 / MOST_OUTLIERS:g} out"
    said = f"{far} of {used} rows are off by more than {OUTLIER:g} errors, and {most}"
    return said if evidence.robust and far > max(1.0, MOST_OUTLIERS * used) else ""


def _pulled(evidence: Evidence, least: float, most: float) -> list[str]:
    """Return the parameters so many standard errors from what was measured of them otherwise, in words."""
    said = []
    for name, parameter in evidence.parameters.items():
        given, error = parameter.constraint or (parameter.value, np.inf)
        pull = abs(parameter.value - given) / error
        if least < pull <= most:
            what = (
                f"{name} = {parameter.value:.5g} is {pull:.1f} standard errors from the given {given:g} +- {error:.2g}"
            )
            said.append(what)
    return said


def _not_explained(evidence: Evidence) -> str:
    """Return on which grounds the model does not explain the data, what may be the reason, and which rows are off."""
    grounds = misfits(evidence)
    worst = np.max(np.abs(np.nan_to_num(evidence.rows.residual)), axis=1)
    far = np.argsort(-worst)[: max(1, len(worst) // 20)]
    return f"{'; '.join(grounds)}. {_CAUSES}; farthest off: {_lines(evidence, np.sort(far))}." if grounds else ""


def _disagreeing(evidence: Evidence) -> str:
    """Return which tables' laws are not that of the others, in words; nothing where all may have one."""
    pulls = np.array(evidence.pulls)
    far = sorted(np.flatnonzero(pulls * pulls.size < IMPROBABLE), key=lambda t: pulls[t])
    return "; ".join(f"{evidence.table.labels[t]} differs from the others (probability {pulls[t]:.1g})" for t in far)


def value_at_bound(value: float) -> str:
    """Return the value of a parameter at its bound in words: that of a loss is 0 or 1, not 3e-15."""
    return f"{round(value, 2):z.4g}"


def _not_identified(evidence: Evidence) -> str:
    """Return the parameters that the data do not determine, not even to first order, with what to measure, in words."""
    names = [name for name, parameter in evidence.parameters.items() if parameter.undetermined]
    advice = "; ".join(dict.fromkeys(_helpful_measurement(name) for name in names))
    return f"{' and '.join(names)}; {advice}" if names else ""


def _helpful_measurement(name: str) -> str:
    """Return what to measure, or to say, so that a parameter gets determined."""
    usual = "measure at other drives, orders or offsets too, or hold it fixed at a known value"
    return parameter_called(name).advice or usual


def _open_ones(evidence: Evidence) -> list[str]:
    """Return the parameters whose intervals are open to both sides, where nothing worse is known, in words.

    An end that its search did not find is no end of what the data allow: there one side is enough.
    """
    # a tapping curve tells those of the delay only together; the law does not hang on each
    together = DELAY_NAMES if evidence.table.tapping else ()
    if misfits(evidence) or _not_identified(evidence):
        return []
    return [
        f"{name} is not identified: {parameter.interval_reason}; {_helpful_measurement(name)}"
        for name, parameter in evidence.parameters.items()
        if UNSETTLED in (parameter.interval_reason or "")
        or (name not in together and parameter.interval95 == (None, None))
    ]


def _without_error(evidence: Evidence) -> list[tuple[str, float]]:
    """Return the quality factors that tables give without an error: names as the fit's parameters, and values."""
    found = []
    for table, label in zip(evidence.table.tables, evidence.table.labels, strict=True):
        if table.quality_factor is not None and table.quality_factor_error is None:
            name = name_of_table("quality_factor", label)
            found.append((name if name in evidence.parameters else "quality_factor", table.quality_factor))
    return list(dict.fromkeys(found))


def _assumed(evidence: Evidence) -> str:
    """Return what has an error only because one was assumed, in words."""
    usual = {name: (value, USUAL_ERRORS["quality_factor"] * value) for name, value in _without_error(evidence)}
    known = {held.name: (held.value, held.error) for held in evidence.held if held.assumed}
    for name, parameter in evidence.parameters.items():
        drift = 0.0, USUAL_DRIFTS.get(parameter_called(name).name)
        if parameter.constraint is not None and parameter.constraint in (usual.get(name), drift):
            known[name] = parameter.constraint
    mass = evidence.table.mass_ng is None and any(name in CONTACT_NAMES for name in evidence.parameters)
    said = [f"mass_ng = 1 ({NO_MASS})"] if mass else []
    return ", ".join([*said, *(f"{name} = {value:.4g} +- {error:.2g}" for name, (value, error) in known.items())])


def _scatter(evidence: Evidence) -> str:
    """Return how far repeated readings contradict their errors, in words."""
    repeats = repeats_of(evidence.table)
    if repeats is None or IMPROBABLE <= repeats["p_value"] <= 1.0 - IMPROBABLE:
        return ""
    rows = f"{repeats['rows']} rows of {repeats['drives']} drives"
    return f"{repeats['error_ratio']:.2g} times as much as their errors say ({rows})"


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


def _other_minimum(evidence: Evidence) -> str:
    """Return another minimum's chi2 and parameters, in words; nothing where there is none."""
    values, chi2 = evidence.other_minimum or ({}, 0.0)
    said = ", ".join(f"{name} = {value:.5g}" for name, value in values.items())
    return said and f"chi2 {chi2:.1f}, here {evidence.chi2:.1f}): {said}"


def _tied_pairs(evidence: Evidence) -> str:
    """Return the pairs of parameters that are determined only together, with their correlation, in words."""
    names, related = list(evidence.parameters), np.triu(evidence.correlations, 1)
    pairs = np.argwhere(np.abs(related) > _TIED).tolist()
    return ", ".join(f"{names[i]} and {names[j]} ({related[i, j]:+.3f})" for i, j in pairs)


def _excluded(evidence: Evidence) -> list[str]:
    """Return the rows that are excluded, for every reason, in words."""
    reasons = np.array(evidence.rows.reasons)
    return [
        f"{reason}: {_lines(evidence, reasons == reason)}"
        for reason in dict.fromkeys(evidence.rows.reasons)
        if reason not in ("", OUTLIER_LEFT_OUT)
    ]


def _model_error(evidence: Evidence) -> str:
    """Return how large a model error was added to which rows, in words."""
    error = np.where(evidence.rows.used, evidence.rows.model_error, 0.0)
    small = "small amplitudes" if evidence.table.tapping else "slow impacts"
    lines = _lines(evidence, error > _STATED)
    return f"{100.0 * error.max():.1f} % was added to the errors of {small}: {lines}" if lines else ""


def _unseen(evidence: Evidence) -> str:
    """Return on which rows no orbit was seen, though the model has a steady one."""
    unseen = evidence.table.no_orbit
    return "" if unseen is None else _lines(evidence, (unseen > 0) & (evidence.rows.orbits > 0))


def _courses(evidence: Evidence) -> str:
    """Return which readings follow the rows of tables that do not say that these stand in order of time, in words."""
    tables, labels, said = evidence.table.tables, evidence.table.labels, []
    ends = np.cumsum([table.rows for table in tables])[:-1]
    for table, label, residual in zip(tables, labels, np.split(evidence.rows.residual, ends), strict=True):
        if table.rows_in_order_of_time:
            continue
        for name, column in zip(("peak amplitude", "lock-in amplitude", "phase"), residual.T, strict=False):
            seen = column[np.isfinite(column)]
            course = np.linspace(-1.0, 1.0, table.rows)[np.isfinite(column)]
            count = max(seen.size, 1)
            course -= course.sum() / count
            spread = max(1.0, float(np.linalg.norm(seen)) / count**0.5)
            slope = -float(course @ seen) / max(float(np.linalg.norm(course)) * spread, 1e-300)
            if abs(slope) > _CORRELATED:
                said.append(f"{label}: {name} {slope:+.1f}")
    return ", ".join(said)


def _lines(evidence: Evidence, rows: Any) -> str:
    """Return 'line 7' or 'lines 7, 9, 12 and 3 more' of the table's file; 'line B.csv:7' of several; "" without rows.

    Args:
        evidence: with the table.
        rows: which, or for each whether it is one of them.
    """
    numbers = evidence.table.row_names[np.asarray(rows)].tolist()
    shown = ", ".join(numbers[:6]) + (f" and {len(numbers) - 6} more" if len(numbers) > 6 else "")
    return f"line{'s' if len(numbers) > 1 else ''} {shown}" if numbers else ""


MISFITS: Rules[Evidence] = (
    (
        Rule(lambda e: not np.isfinite(e.chi2), "no orbits were found at the fitted law"),
        Rule(
            lambda e: [e.chi2 / e.freedom] if e.p_value < IMPROBABLE else [],
            "chi2/dof = {case:.3g} (probability {e.p_value:.1g})",
        ),
    ),
    Rule(_too_many_outliers, "{case}"),
    Rule(
        lambda e: (e.error_scale or 0.0) > LARGEST_SCALE,
        "the amplitudes' errors would have to be {e.error_scale:.3g} times those stated, and more than "
        f"{LARGEST_SCALE:g} is a misfit, not a matter of scale",
    ),
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
        Rule(lambda e: not np.isfinite(e.convergence.estimated_distance), "Not converged: {e.convergence.reason}."),
        Rule(_not_identified, "Not identified: the amplitudes do not determine {case}."),
        Rule(lambda e: not e.convergence.converged, "Not converged: {e.convergence.reason}."),
    ),
    Rule(lambda e: _lines(e, (e.rows.orbits == 0) & e.rows.used), "No stable orbit at the fitted law for {case}."),
    Rule(
        lambda e: e.untabulated and _lines(e, e.untabulated),
        "The table of the fitted contact's impacts misses its accuracy for {case}: the contact's numbers are too "
        "extreme; hold some of them fixed.",
    ),
    Rule(_not_explained, "The model does not explain the data: {case}"),
    Rule(
        lambda e: "; ".join(_pulled(e, TORN, np.inf)),
        "The amplitudes contradict what is known beforehand: {case}. "
        "Either that is wrong, or the model makes up for what it lacks.",
    ),
    Rule(_disagreeing, "The tables do not have one law: {case}; find what is different there, or leave it out."),
    Rule(lambda e: e.freedom <= 0, "As many parameters as amplitudes: the goodness of fit cannot be judged."),
    Rule(_open_ones, "{case}."),
)
"""What makes a fit invalid."""

WARNINGS: Rules[Evidence] = (
    Rule(
        lambda e: [f"{name} = {value:g}" for name, value in _without_error(e) if name not in e.parameters],
        "{case} is assumed to be exact. Amplitudes separate the impact's loss from the air's only as well as Q is "
        "known: give its error, like `# {case} +- 1`.",
    ),
    Rule(
        _assumed,
        "Assumed, because nothing states it: {case}. Law, band and intervals depend on it: state what is known, like "
        "`# quality_factor = 40 +- 1`, or by `constraints=...`.",
    ),
    Rule(
        lambda e: [f for f in [max(table.free_frequency_khz for table in e.table.tables)] if f > _FASTEST_KHZ],
        "free_frequency_khz = {case:g} is more than any cantilever's: was it written in Hz for kHz?",
    ),
    Rule(
        lambda e: [usual for usual in [float(np.nanmedian(e.rows.measured_nm))] if usual < _SMALLEST_NM],
        "Amplitudes are {case:.2g} nm in the median: were they written in micrometres for nanometres?",
    ),
    Rule(
        lambda e: [one for table in e.table.tables for one in table.remarks if one.startswith(ERRORS_OF_REPEATS)],
        "{case}.",
    ),
    Rule(_scatter, "Readings of a drive scatter {case}: the errors are of another size, or something drifted."),
    Rule(lambda e: _pulled(e, PULLED, TORN), "{case}: check it, the loss depends on it."),
    Rule(_limits, "{case}."),
    Rule(
        _other_minimum,
        "Another minimum explains the data about as well ({case}; the band of the law and the intervals hold both.",
    ),
    Rule(_tied_pairs, "Determined only together, hardly apart: {case}; the law's band may be narrow all the same."),
    Rule(
        lambda e: [100.0 * e.short] if e.run[0] >= _RUN and e.short > 0.0 else [],
        "Residuals run together over the approach speed ({e.run[0]:.1f} standard deviations): the model lacks a "
        "shape; a model discrepancy of {case:.0f} % of the loss at any speed is in law, band and intervals.",
    ),
    Rule(_excluded, "Excluded, because these impacts are {case}."),
    Rule(_model_error, "A model error of up to {case}."),
    Rule(
        _unseen,
        "No orbit was seen, though the fitted model has a steady one, for {case}: the tip may have settled on another "
        "motion; start it otherwise, or remove the row.",
    ),
    Rule(
        lambda e: _lines(e, e.rows.orbits > 1),
        "Several stable orbits coexist for {case}: the one closest to the measurement was used.",
    ),
    Rule(lambda e: _lines(e, e.rows.near_fold), "Close to a fold, where errors are not linear: {case}."),
    Rule(
        lambda e: _lines(e, e.outliers | np.isin(e.rows.reasons or "", OUTLIER_LEFT_OUT)) if e.robust else "",
        "Robust fit: these outliers are left out: {case}.",
    ),
    Rule(
        lambda e: e.error_scale is not None,
        "The amplitudes' errors were scaled by {e.error_scale:.3g} so that chi2/dof = 1: whether they are of the right "
        "size cannot be judged.",
    ),
    Rule(lambda e: e.p_value > 1.0 - 1e-6, "The errors look too large: chi2 is improbably small."),
    Rule(
        _courses,
        "Residuals follow the rows ({case} standard deviations from the first to the last), as drifts do. If the rows "
        "stand as they were measured, say `# rows = in order of time`: drifts are then fitted along.",
    ),
)
"""What a reader should also know."""
