"""Whether to trust a fit, in words: what makes it invalid, and what a reader should know besides.

A fit is valid only if what is left of the amplitudes passes an absolute test, whatever the options:
chi2 by its probability; with a robust loss the share of outliers, and chi2 without them by its probability; with scaled
errors the scale, and what is known of the parameters; always that neighbouring residuals are not correlated, neither in
the table's order (a drift, a sweep the model does not follow) nor over the approach speed (a wrong law).
"""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float

from afm_jax.least_squares import IMPROBABLE, chi2_tail
from fitting.fits.discrepancy import Held
from fitting.fits.intervals import Convergence
from fitting.fits.loss import NO_MASS
from fitting.fits.minimum import TOO_SLOW
from fitting.fits.objective import MOST_OUTLIERS, OUTLIER
from fitting.fits.result import FittedParameter, FittedRows
from fitting.parameters import DELAY_NAMES, is_nuisance, name_of_table, parameter_called
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
ASSUMED_ERROR_OF_Q = 0.05
"""Relative standard error of a quality factor that is given without one."""
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
    """Standard deviations by which residuals run together over the speed, and by which beside what that added."""
    unbent: Float[np.ndarray, "rows k"] | None = None
    """Residuals of the rows without that, where it was added: it goes after outliers."""
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

    @property
    def refusal(self) -> str:
        """Why hardly a row is one that the model can be read off."""
        return _NO_TAPS if self.tapped else _REFUSED


def judge_fit(evidence: Evidence) -> tuple[list[str], list[str]]:
    """Return what makes a fit invalid, and its warnings; each a sentence."""
    return [evidence.refusal] if evidence.refused else _reasons(evidence), _warnings(evidence)


def _reasons(evidence: Evidence) -> list[str]:
    reasons = []
    convergence = evidence.convergence
    undetermined = [] if _may_stay_open(evidence) else _undetermined(evidence)
    if convergence.reason is not None:
        reasons.append(f"Not converged: {convergence.reason}.")
    elif undetermined:
        reasons.append(
            f"Not identified: the amplitudes do not determine {' and '.join(undetermined)}; "
            f"{'; '.join(dict.fromkeys(helpful_measurement(name) for name in undetermined))}."
        )
    elif not convergence.converged:
        reasons.append(
            ("Not converged: " + _distance_in_words(convergence.estimated_distance))
            + ("" if convergence.outward else ", and a parameter is held at a bound it would leave")
            + "."
        )
    missing = np.flatnonzero((evidence.rows.orbits == 0) & evidence.rows.used)
    if missing.size:
        reasons.append(f"No stable orbit at the fitted law for {_rows_in_words(evidence.table, missing)}.")
    if evidence.untabulated:
        where = _rows_in_words(evidence.table, np.array(evidence.untabulated))
        reasons.append(
            f"The table of the fitted contact's impacts misses its accuracy for {where}: the contact's numbers are too "
            "extreme; hold some of them fixed."
        )
    misfit = misfits(evidence)
    if misfit:
        reasons.append(f"The model does not explain the data: {'; '.join(misfit)}. {_why_not_explained(evidence)}")
    reasons += [*_no_way_down(evidence), *_contradictions(evidence), *_different_laws(evidence)]
    if evidence.freedom <= 0:
        reasons.append("As many parameters as amplitudes: the goodness of fit cannot be judged.")
    # a tapping curve tells those of the delay only together; the law does not hang on each
    together = (*(DELAY_NAMES if evidence.table.tapping else ()), *_undetermined(evidence))
    for name in (name for name in evidence.parameters if name not in together):
        parameter = evidence.parameters[name]
        if parameter.interval95 == (None, None) and not misfit and not undetermined:
            reasons.append(f"{name} is not identified: {parameter.interval_reason}; {helpful_measurement(name)}.")
    return reasons


def _distance_in_words(distance: float) -> str:
    if not np.isfinite(distance):
        return "chi2 bends downwards where the search ended, which is no minimum"
    return f"chi2 lies an estimated {distance:.2g} above its minimum"


def _no_way_down(evidence: Evidence) -> list[str]:
    """Return what says that the model discrepancy was not found: no part of the step to it lowers chi2, computed."""
    if evidence.stuck is None:
        return []
    begin, expected = evidence.stuck
    said = (
        "Not converged: to first order the model discrepancy would lower chi2 from "
        f"{begin:.1f} to {expected:.1f}, but computed not even a sixteenth of it does; the amplitudes are far from "
        "linear in the law, as they are near folds: leave such rows out."
    )
    return [said]


def _undetermined(evidence: Evidence) -> list[str]:
    return [name for name, parameter in evidence.parameters.items() if parameter.undetermined]


def _may_stay_open(evidence: Evidence) -> bool:
    """Say whether what is not determined need not be: of a contact's taps, unless nothing is."""
    own = [name for name in evidence.parameters if not is_nuisance(name)]
    return evidence.tapped and any(not evidence.parameters[name].undetermined for name in own)


def _different_laws(evidence: Evidence) -> list[str]:
    disagreeing = _disagreeing(evidence)
    if not disagreeing or evidence.scattering:
        return []
    advice = "look at what is different there, leave it out, or let laws differ from table to table (--hierarchical)"
    return [f"The tables do not have one law: {disagreeing}; {advice}."]


def _disagreeing(evidence: Evidence) -> str:
    """Return which tables' laws are not that of the others, in words; nothing where all may have one."""
    pulls = np.array(evidence.pulls)
    far = np.flatnonzero(pulls * pulls.size < IMPROBABLE)
    named = sorted(far, key=lambda t: pulls[t])
    return "; ".join(f"{evidence.table.labels[t]} is off the others (probability {pulls[t]:.1g})" for t in named)


def _contradictions(evidence: Evidence) -> list[str]:
    """Return what says that the amplitudes contradict what was measured otherwise."""
    torn = [_pull_in_words(evidence, name, pull) for name, pull in _pulls(evidence).items() if abs(pull) > _TORN]
    if not torn:
        return []
    said = "; ".join(torn)
    return [
        (
            f"The amplitudes contradict what is known beforehand: {said}. "
            "Either that is wrong, or the model makes up for what it lacks."
        )
    ]


def misfits(evidence: Evidence) -> list[str]:
    """Return the grounds on which the model does not explain the amplitudes, each a clause; none if it does.

    The parameters' errors and intervals are not looked at.
    """
    if evidence.refused:
        return [evidence.refusal]
    found = []
    if evidence.p_value < IMPROBABLE:
        found.append(f"chi2/dof = {evidence.chi2 / evidence.freedom:.3g} (probability {evidence.p_value:.1g})")
    if evidence.robust:
        found += _robust_misfits(evidence)
    if evidence.error_scale is not None:
        found += _scaled_misfits(evidence)
    if evidence.run[1] > _LONGEST_RUN:
        found.append(
            f"residuals run together over the approach speed ({evidence.run[0]:.1f} standard deviations; "
            f"{evidence.run[1]:.1f} beside a model discrepancy of {100.0 * evidence.short:.0f} % of the loss)"
        )
    # rows of tables whose laws scatter about the predicted one are off together
    if not (evidence.robust or evidence.scattering):
        found += _one_sided(evidence)
    return found + [
        f"neighbouring residuals {where} are correlated ({excess:+.1f} standard deviations)"
        for where, excess in _correlations(evidence)
    ]


def _one_sided(evidence: Evidence) -> list[str]:
    """Return that some rows are off to one side, in words: chance gives as large residuals of either sign."""
    residual = evidence.rows.residual if evidence.unbent is None else evidence.unbent
    count = np.isfinite(residual).sum(axis=1)
    of_row = np.nansum(residual, axis=1) / np.sqrt(np.maximum(count, 1))
    rows = int((count > 0).sum())
    if rows <= _FEWEST_NEIGHBOURS:
        return []
    excess = float(np.sum(of_row**3) / np.sqrt(15.0 * rows))
    if abs(excess) < _ONE_SIDED:
        return []
    far = np.sort(np.argsort(-np.sign(excess) * of_row)[: max(1, rows // 10)])
    side = "above" if excess > 0.0 else "below"
    said = f"residuals are far off to one side ({excess:+.1f} standard deviations of their cubes)"
    return [f"{said}: predicted {side} what was read for {_rows_in_words(evidence.table, far)}"]


def _robust_misfits(evidence: Evidence) -> list[str]:
    outliers = _outliers(evidence)
    count, used = int(outliers.sum()), int(evidence.rows.used.sum())
    if count > max(1.0, MOST_OUTLIERS * used):
        bound = f"robust loss is for outliers in at most one row of {1.0 / MOST_OUTLIERS:g}"
        return [f"{count} of {used} rows are off by more than {OUTLIER:g} errors, and {bound}"]
    chi2, freedom, p_value = _without_outliers(evidence)
    if p_value < IMPROBABLE:
        return [f"without outliers chi2/dof = {chi2 / freedom:.3g} (probability {p_value:.1g})"]
    return []


def _scaled_misfits(evidence: Evidence) -> list[str]:
    found = []
    scale, pulls = evidence.error_scale or 1.0, _pulls(evidence)
    if scale > LARGEST_SCALE:
        found.append(
            f"the amplitudes' errors would have to be {scale:.3g} times those stated, and more than "
            f"{LARGEST_SCALE:g} is a misfit, not a matter of scale (if the errors are no more than weights, state them "
            "to within that)"
        )
    if pulls and chi2_tail(sum(pull**2 for pull in pulls.values()), len(pulls)) < IMPROBABLE:
        moved = ", ".join(f"{name} by {pull:+.1f}" for name, pull in pulls.items())
        found.append(f"it contradicts what is known beforehand, in standard errors: {moved}")
    return found


def _pulls(evidence: Evidence) -> dict[str, float]:
    """Return how far each parameter is from what was measured of it, in standard errors of that."""
    known = {name: (p.value, *p.constraint) for name, p in evidence.parameters.items() if p.constraint is not None}
    return {name: (value - given) / error for name, (value, given, error) in known.items()}


def _pull_in_words(evidence: Evidence, name: str, pull: float) -> str:
    parameter = evidence.parameters[name]
    given, error = parameter.constraint or (float("nan"), float("nan"))
    return f"{name} = {parameter.value:.5g} is {abs(pull):.1f} standard errors from the given {given:g} +- {error:.2g}"


def _without_outliers(evidence: Evidence) -> tuple[float, int, float]:
    """Return chi2 of the amplitudes that are no outliers and of what is known, its freedom and its probability."""
    residual, pulls = evidence.rows.residual, _pulls(evidence)
    inside = residual[np.abs(residual) <= OUTLIER]
    freedom = inside.size + len(pulls) - len(evidence.parameters)
    chi2 = float(np.sum(inside**2) + sum(pull**2 for pull in pulls.values()))
    return chi2, freedom, chi2_tail(chi2, freedom) if freedom > 0 else float("nan")


def _outliers(evidence: Evidence, scale: float = 1.0) -> Bool[np.ndarray, " rows"]:
    """Return which rows are far off; ``scale``: of the errors that residuals are in, over those that count here."""
    return np.any(scale * np.abs(np.nan_to_num(evidence.rows.residual)) > OUTLIER, axis=1)


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


def _why_not_explained(evidence: Evidence) -> str:
    worst = np.nanmax(np.abs(np.where(np.isfinite(evidence.rows.residual), evidence.rows.residual, 0.0)), axis=1)
    far = np.argsort(-worst)[: max(1, len(worst) // 20)]
    names = evidence.parameters
    tail = f"farthest off: {_unexplained_tables(evidence)}{_rows_in_words(evidence.table, np.sort(far))}"
    # counting outliers less helps where the others are well explained: not if most are off, or off together
    few = 2 * _outliers(evidence, evidence.error_scale or 1.0).sum() <= evidence.rows.used.sum()
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


def value_at_bound(value: float) -> str:
    """Return the value of a parameter at its bound in words: that of a loss is 0 or 1, not 3e-15."""
    return f"{value:z.0f}" if abs(value - round(value)) < _AT_BOUND else f"{value:.4g}"


def helpful_measurement(name: str) -> str:
    """Return what to measure, or to say, so that a parameter gets determined."""
    return (
        parameter_called(name).advice
        or "measure at other drives, orders or offsets too, or hold it fixed at a known value"
    )


def _warnings(evidence: Evidence) -> list[str]:
    return [
        *_damping_warnings(evidence),
        *_mass_warnings(evidence),
        *_unit_warnings(evidence),
        *_repeat_warnings(evidence),
        *_table_warnings(evidence),
        *_parameter_warnings(evidence),
        *_pair_warnings(evidence),
        *_run_warnings(evidence),
        *_held_warnings(evidence),
        *_row_warnings(evidence),
    ]


def _table_warnings(evidence: Evidence) -> list[str]:
    disagreeing = _disagreeing(evidence) if evidence.scattering else ""
    return [f"Far from the mean law even for this scatter: {disagreeing}."] if disagreeing else []


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


def _mass_warnings(evidence: Evidence) -> list[str]:
    """Return what there is to say of a contact's tip whose mass is not known: its forces act on it."""
    if evidence.table.mass_ng is not None or not evidence.contact:
        return []
    return [f"1 ng assumed: {NO_MASS}. Each of the contact's parameters hangs on it."]


_FASTEST_KHZ, _SMALLEST_NM = 2e4, 1.0
"""What no cantilever is faster than, and what amplitude impacts take at least: a bridge alone is that long."""


def _unit_warnings(evidence: Evidence) -> list[str]:
    """Return what there is to say of frequencies and amplitudes that no measurement of impacts has."""
    said = []
    fastest = max(table.free_frequency_khz for table in evidence.table.tables)
    if fastest > _FASTEST_KHZ:
        said.append(f"free_frequency_khz = {fastest:g} is more than any cantilever's: was it written in Hz for kHz?")
    read = evidence.rows.measured_nm[np.isfinite(evidence.rows.measured_nm)]
    usual = float(np.median(read)) if read.size else _SMALLEST_NM
    if usual < _SMALLEST_NM:
        said.append(f"Amplitudes are {usual:.2g} nm in the median: were they written in micrometres for nanometres?")
    return said


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
    if table.quality_factor is None:
        return ""
    if table.quality_factor_error is None:
        known = f"quality_factor = {table.quality_factor:g}"
        return (
            f"{known} is taken as exact. Amplitudes tell the impact's loss from the air's only as well as Q is known: "
            f"`# {known} +- 1` lets the intervals show it."
        )
    return ""


def _parameter_warnings(evidence: Evidence) -> list[str]:
    warnings = []
    explained = not misfits(evidence)
    undetermined = _undetermined(evidence)
    if explained and undetermined and _may_stay_open(evidence):
        advice = "; ".join(dict.fromkeys(helpful_measurement(name) for name in undetermined))
        warnings.append(
            f"Not determined by these taps: {' and '.join(undetermined)}, anything within their ranges explains them, "
            f"and the law's band takes that in; {advice}."
        )
    for name, pull in _pulls(evidence).items():
        if _PULLED < abs(pull) <= _TORN:
            warnings.append(f"{_pull_in_words(evidence, name, pull)}: check it, the loss hangs on it.")
    for name, parameter in evidence.parameters.items():
        low, high = parameter.interval95
        # Where the model does not explain the data, a bound is only where the misfit pushed the parameter.
        if parameter.at_bound and explained:
            limit = f"< {high:.4g}" if high is not None else f"> {low:.6g}" if low is not None else None
            reading = f": read it as a limit, {name} {limit} (95 %)" if limit else ""
            warnings.append(f"{name} is at its bound, {value_at_bound(parameter.value)}{reading}.")
        if parameter.did_not_move:
            warnings.append(f"{name} did not move from the grid point it started at.")
    if evidence.other_minimum is not None:
        found, chi2 = evidence.other_minimum
        values = ", ".join(f"{name} = {value:.5g}" for name, value in found.items())
        warnings.append(
            f"Another minimum explains the data about as well (chi2 {chi2:.1f}, here {evidence.chi2:.1f}): {values}; "
            "the band of the law and the intervals hold both."
        )
    return warnings


def _held_warnings(evidence: Evidence) -> list[str]:
    """Return what is held and how well it is taken to be known, and what hangs on it."""
    values = {one.name: f"{one.name} = {one.value:.4g} +- {one.error:.2g}" for one in evidence.held}
    assumed = [values[one.name] for one in evidence.held if one.assumed]
    warnings = []
    if assumed:
        example = next(one for one in evidence.held if one.assumed)
        known = f"{example.name}={example.value:.4g}+-{0.1 * example.error:.2g}"
        said = f"Held, with errors that are assumed: {', '.join(assumed)}; law, band and intervals hang on them"
        warnings.append(f"{said}: say what is known better, like --constrain {known}.")
    for name, others in evidence.hanging.items():
        warnings.append(f"{name} hangs on what is held: {', '.join(values[other] for other in others)}.")
    return warnings


def _run_warnings(evidence: Evidence) -> list[str]:
    run, short = evidence.run[0], 100.0 * evidence.short
    if run < _RUN or not short:
        return []
    said = f"Residuals run together over the approach speed ({run:.1f} standard deviations): the model lacks a shape"
    return [f"{said}; a model discrepancy of {short:.0f} % of the loss at any speed is in law, band and intervals."]


def _pair_warnings(evidence: Evidence) -> list[str]:
    names = list(evidence.parameters)
    pairs = [
        f"{names[i]} and {names[j]} ({evidence.correlations[i, j]:+.3f})"
        for i in range(len(names))
        for j in range(i + 1, len(names))
        if abs(evidence.correlations[i, j]) > _TIED
    ]
    if not pairs:
        return []
    return [
        f"Determined only together, hardly apart: {', '.join(pairs)}. The law may be sharp all the same: see its band."
    ]


def _row_warnings(evidence: Evidence) -> list[str]:
    warnings = []
    aside = np.flatnonzero(evidence.rows.set_aside)
    reasons = evidence.rows.reasons or (TOO_SLOW,) * len(evidence.rows.set_aside)
    for reason in dict.fromkeys(reasons[row] for row in aside):
        named = np.array([row for row in aside if reasons[row] == reason])
        warnings.append(f"Set aside, because these impacts are {reason}: {_rows_in_words(evidence.table, named)}.")
    inaccurate = np.flatnonzero(evidence.rows.used & (evidence.rows.model_error > _STATED))
    if inaccurate.size:
        worst = 100.0 * float(evidence.rows.model_error[inaccurate].max())
        small = "small amplitudes" if evidence.table.tapping else "slow impacts"
        warnings.append(
            f"A model error of up to {worst:.1f} % was added to the errors of {small}: "
            f"{_rows_in_words(evidence.table, inaccurate)}."
        )
    unseen = np.zeros(evidence.table.rows) if evidence.table.no_orbit is None else evidence.table.no_orbit
    contradicted = np.flatnonzero((unseen > 0) & (evidence.rows.orbits > 0))
    if contradicted.size:
        warnings.append(
            f"No orbit was seen, though the fitted model has a steady one, for "
            f"{_rows_in_words(evidence.table, contradicted)}: the tip may have settled on another motion; start it "
            "otherwise, or remove the row."
        )
    several = np.flatnonzero(evidence.rows.orbits > 1)
    if several.size:
        warnings.append(
            f"Several stable orbits coexist for {_rows_in_words(evidence.table, several)}: the one closest to the "
            "measurement was taken."
        )
    folds = np.flatnonzero(evidence.rows.near_fold)
    if folds.size:
        warnings.append(f"Close to a fold, where errors are not linear: {_rows_in_words(evidence.table, folds)}.")
    pairs = max(int(np.isfinite(evidence.rows.residual).sum()) - 2, 1)
    if abs(evidence.autocorrelation) > 3.0 / np.sqrt(pairs) and not _correlations(evidence):
        warnings.append(
            f"Neighbouring residuals are correlated ({evidence.autocorrelation:+.2f}): something systematic is left."
        )
    if evidence.robust:
        outliers = np.flatnonzero(_outliers(evidence))
        named = f"; outliers: {_rows_in_words(evidence.table, outliers)}" if outliers.size else ""
        chi2, freedom, p_value = _without_outliers(evidence)
        goodness = f"{chi2:.1f}/{freedom}" + (f" (probability {p_value:.2g})" if freedom > 0 else "")
        warnings.append(f"Robust loss: chi2 counts outliers linearly; without them chi2/dof = {goodness}{named}.")
    if evidence.error_scale is not None:
        warnings.append(
            f"The amplitudes' errors were scaled by {evidence.error_scale:.3g} so that chi2/dof = 1: whether they are "
            f"of the right size cannot be judged, only that the scale is believable (at most {LARGEST_SCALE:g}) and "
            "that residuals are random."
        )
    elif evidence.p_value > 1.0 - 1e-6:
        warnings.append("The errors look too large: chi2 is improbably small.")
    return warnings


def _rows_in_words(table: AmplitudeTable | SeveralTables, rows: np.ndarray) -> str:
    """Return 'line 7' or 'lines 7, 9, 12 and 3 more' of the table's file; 'line B.csv:7' of several."""
    numbers = table.row_names[rows].tolist()
    shown = ", ".join(numbers[:6]) + (f" and {len(numbers) - 6} more" if len(numbers) > 6 else "")
    return f"{'line' if len(numbers) == 1 else 'lines'} {shown}"
