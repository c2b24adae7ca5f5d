"""What a fit amounts to: the law with its band, the closest formula's parameters and intervals, rows, and the verdict."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from afm_jax.impact.law import CollisionDelay, ImpactLaw
from afm_jax.least_squares import chi2_tail, covariance_of
from afm_jax.units import TWO_SIDED_95
from afm_jax.version import version_of
from fitting.fits.law_after import (
    DELAY_TERMS,
    AtSpeeds,
    closest_loss,
    containing,
    delay_by_formula,
    rebound_by_formula,
    root_of,
    speed_range,
)
from fitting.fits.result import FitResult, FittedParameter, FittedRows, FittedTable, law_with_band, loss_of
from fitting.fits.several import Parts, Pull, pulls_of
from fitting.fits.step import bounded
from fitting.fits.verdict import Evidence, judge_fit, misfits
from fitting.infer.explain import Explained
from fitting.infer.intervals import UNDETERMINED, UNEXPLAINED, Interval, profile_interval, within_range
from fitting.infer.rows import TOO_SLOW
from fitting.infer.search import descend
from fitting.models import Task
from fitting.predict.law import FormulaLaw
from fitting.predict.orbit import NEAR_FOLD
from fitting.parameters import (
    NUISANCE_NAMES,
    PARAMETERS,
    is_of_one_table,
    name_of_table,
    parameter_called,
)
from fitting.tables.several import SeveralTables
from fitting.tables.table import AmplitudeTable

_ENOUGH = 1e-2
"""Estimated distance of chi2 to its minimum below which a fit counts as converged (one standard error is 1)."""
_AT_BOUND = 0.01
"""Loss over its error below which it is taken to vanish."""
_PROFILED = 3.0
"""Errors from its bound within which a loss has a profile interval."""
_LOSSES = {"r": 2, "viscous_loss": 1, "epsilon": 0}
"""Powers of the speed of the formula's losses."""
_ROUNDS = 8
_PACKAGES = ("afm-jax", "jax", "optax", "numpy")


@dataclass(frozen=True)
class Convergence:
    """The state of a minimum.

    Attributes:
        converged: chi2 is at a minimum, and orbits and weights have settled.
        optimiser: what the search was done with.
        iterations: of it.
        gradient: largest slope of chi2 by an unknown, per standard error.
        estimated_distance: by how much chi2 lies above its minimum, g H^-1 g.
        reason: why there is nothing to check, None if there is.
    """

    converged: bool
    optimiser: str
    iterations: int
    gradient: float
    estimated_distance: float
    reason: str | None = None


class Closest(NamedTuple):
    """Parameters, and how they change with independent unknowns of unit variance; which losses vanish."""

    names: tuple[str, ...]
    values: Float[np.ndarray, " p"]
    factor: Float[np.ndarray, "p m"]
    vanishes: tuple[bool, ...]


def convergence_of(explained: Explained, optimiser: str, iterations: int) -> Convergence:
    """Return how far chi2 is from its minimum, unknowns that are held at a bound left out."""
    end = explained.end
    jacobian, residual = end.jacobian, end.residual
    if not (np.isfinite(jacobian).all() and np.isfinite(residual).all()):
        reason = "the slopes of the residuals are not finite where the search ended"
        return Convergence(False, optimiser, iterations, np.inf, np.inf, reason)  # noqa: FBT003
    moves = ~_held(explained)
    slope, covariance = jacobian.T @ residual, covariance_of(jacobian[:, moves].T @ jacobian[:, moves])
    known = np.isfinite(np.diag(covariance))
    step = np.where(known, np.where(np.isfinite(covariance), covariance, 0.0) @ np.where(known, slope[moves], 0.0), 0.0)
    distance = float(slope[moves] @ step)
    errors = np.sqrt(np.where(known, np.diag(covariance), 0.0))
    gradient = float(np.max(np.abs(2.0 * slope[moves] * errors), initial=0.0))
    return Convergence(explained.settled and distance < _ENOUGH, optimiser, iterations, gradient, distance)


def _held(explained: Explained) -> np.ndarray:
    """Say which unknowns are losses that vanish: of instantaneous laws."""
    law: Any = explained.model.law
    held = np.zeros(explained.end.theta.size, bool)
    if not law.lasting:
        normal = np.diag(explained.end.jacobian.T @ explained.end.jacobian)
        own = np.arange(held.size) < len(law.names)
        held = own & (explained.end.theta <= _AT_BOUND / np.sqrt(np.maximum(normal, 1e-300)))
    return held


def covariance_of_unknowns(explained: Explained) -> Float[np.ndarray, "k k"]:
    """Return the covariance of the unknowns; what vanishes is held, with the variance it would have if it were free."""
    held, jacobian = _held(explained), explained.end.jacobian
    if not held.any():
        return covariance_of(jacobian.T @ jacobian)
    full, found = covariance_of(jacobian.T @ jacobian), np.zeros((held.size, held.size))
    found[np.ix_(~held, ~held)] = covariance_of(jacobian[:, ~held].T @ jacobian[:, ~held])
    found[held, held] = np.diag(full)[held]
    return found


def closest_parameters(explained: Explained, own: tuple[str, ...], fixed: Mapping[str, float]) -> Closest:
    """Return the parameters of the model's own formula closest to the law, and the instrument's quantities.

    Of instantaneous laws and contacts they are the unknowns themselves. Else least squares in the rebound speed, then
    in the delay, each weighted by the law's variance, within the parameters' bounds: errors contain what the formula
    leaves out.

    Args:
        explained: the fit.
        own: the model's parameters.
        fixed: values of others of them.
    """
    model, theta = explained.model, explained.end.theta
    root, law = root_of(covariance_of_unknowns(explained)), model.law
    known: Any = law
    if law.lasting and isinstance(law, FormulaLaw):
        values, factor, vanishes = _projected(explained, own, fixed)
    else:
        held = _held(explained)
        places = [model.names.index(name) for name in own]
        unknowns = np.array([theta[i] for i in places])
        values = np.array([float(known.value_of(name, y)) for name, y in zip(own, unknowns, strict=True)])
        slope = [known.slope_of(name, y) for name, y in zip(own, unknowns, strict=True)]
        factor = np.array(slope)[:, None] * root[places]
        vanishes = tuple(bool(held[i]) for i in places)
    first = len(model.names) - len(model.instrument)
    quantities = [(q.at(float(y)), q.slope(float(y))) for q, y in zip(model.instrument, theta[first:], strict=True)]
    of_instrument = np.reshape([slope for _, slope in quantities], (-1, 1)) * root[first:]
    return Closest(
        (*own, *(quantity.name for quantity in model.instrument)),
        np.append(values, [value for value, _ in quantities]),
        np.concatenate([factor, of_instrument]),
        (*vanishes, *(False for _ in quantities)),
    )


def _projected(
    explained: Explained, own: tuple[str, ...], fixed: Mapping[str, float]
) -> tuple[Float[np.ndarray, " p"], Float[np.ndarray, "p m"], tuple[bool, ...]]:
    used = explained.weights.used.any(axis=1) & ~explained.model.data.row.free
    speeds = explained.end.orbits.approach[used & np.isfinite(explained.end.orbits.approach)]
    law = explained.law_at(speeds)
    there = law.law[0] > 0.0
    u, (rebound, delay), factor = speeds[there], law.law[:, there], law.factor[:, there]
    if u.size < len(own) or not np.isfinite(factor).all():
        known: Any = explained.model.law
        values = known.values(explained.model.of_law(explained.end.theta))
        nothing = np.full((len(own), factor.shape[2]), np.nan)
        return np.array([values[name] for name in own]), nothing, (False,) * len(own)
    weight = 1.0 / np.maximum(np.linalg.norm(factor, axis=2), 1e-300)
    losses, late = ([name for name in own if name in kind] for kind in (_LOSSES, DELAY_TERMS))
    values = dict(fixed) | closest_loss(losses, u, rebound, weight[0], fixed, _ROUNDS)
    w = np.maximum(rebound_by_formula(values, u), 0.1 * rebound)
    by_loss = {"r": values.get("r", 1.0) * u**2 / w, "epsilon": -0.5 / w, "viscous_loss": -0.5 * u / w}
    bounds = {"r": 1.0, "epsilon": 0.0, "viscous_loss": 0.0}
    vanishing = {name for name in losses if values[name] == bounds[name]}
    changes: dict[str, np.ndarray] = {}

    def project(names: list[str], slope: np.ndarray, change: np.ndarray, weight: np.ndarray) -> None:
        moved = np.linalg.lstsq(weight[:, None] * slope, weight[:, None] * change, rcond=None)[0]
        changes.update(zip(names, moved, strict=True))

    moving = [name for name in losses if name not in vanishing]
    slope = np.reshape([by_loss[name] for name in moving], (-1, u.size)).T
    project(moving, slope, factor[0], weight[0])
    for name in vanishing:
        # as if it were free, for its limit
        both = np.column_stack([slope, by_loss[name]])
        alone = np.linalg.lstsq(weight[0][:, None] * both, weight[0][:, None] * factor[0], rcond=None)[0][-1]
        changes[name] = alone
    columns = np.reshape([DELAY_TERMS[name](u, w) for name in late], (-1, u.size)).T
    begin = np.array([_start_of(name) for name in late])
    ends = np.reshape([(PARAMETERS[name].lowest, PARAMETERS[name].highest) for name in late], (-1, 2))
    start = dict(zip(late, begin.tolist(), strict=True)) | {n: v for n, v in fixed.items() if n in DELAY_TERMS}
    off = weight[1] * (delay_by_formula(start, u, w) - delay)
    moved = bounded(off, weight[1][:, None] * columns, begin, ends, np.ones(len(late), dtype=bool))
    values |= dict(zip(late, (begin + moved).tolist(), strict=True))
    along = np.zeros_like(factor[0])
    for name, column in zip(moving, slope.T, strict=True):
        along += np.outer(column, changes[name])
    # the formula's delay changes with its rebound speed
    lead = values.get("delay_lead_nm", fixed.get("delay_lead_nm", 0.0))
    project(late, columns, factor[1] - lead / w[:, None] ** 2 * along, weight[1])
    return (
        np.array([values[name] for name in own]),
        np.array([changes[name] for name in own]),
        tuple(name in vanishing for name in own),
    )


def _start_of(name: str) -> float:
    return {"delay_hertz": 0.2, "delay_lead_nm": 5.0}.get(name, 0.0)


def formula_of(values: Mapping[str, float], lasting: bool) -> ImpactLaw:
    """Return the impact law of a formula's parameters."""
    delay = None
    if lasting:
        names = ("delay_hertz", "delay_lead_nm", "delay_offset_nm")
        delay = CollisionDelay(*(float(values.get(name, 0.0)) for name in names))
    return ImpactLaw(
        float(values.get("r", 1.0)), float(values.get("epsilon", 0.0)), float(values.get("viscous_loss", 0.0)), delay
    )


class Fitted(NamedTuple):
    """A fit before it is judged.

    Attributes:
        explained: the law and the rows.
        before: without what was added for runs of residuals.
        other: another minimum that may be the true one; None: there is none.
        profile: chi2 with one unknown held at a value, the others following.
        convergence: of the minimum.
        settings: every option of the fit.
        error_scale: by which errors were scaled; None: they were not.
        robust: whether outliers were looked for.
    """

    explained: Explained
    before: Explained
    other: Explained | None
    profile: Any
    convergence: Convergence
    settings: dict[str, Any]
    error_scale: float | None
    robust: bool


def intervals_of(fitted: Fitted, closest: Closest) -> list[Interval]:
    """Return the 95 % interval of every parameter.

    Profile intervals of instantaneous laws, linear ones else, but where epsilon is less than three errors from its
    bound.
    """
    explained = fitted.explained
    law: Any = explained.model.law
    errors = np.linalg.norm(closest.factor, axis=1)
    own, intervals = len(closest.names) - len(explained.model.instrument), []
    for i, (name, value) in enumerate(zip(closest.names, closest.values.tolist(), strict=True)):
        parameter, error = parameter_called(name), float(errors[i])
        if not np.isfinite(error):
            intervals.append(Interval(None, None, UNDETERMINED))
            continue
        near = lasting_epsilon = law.lasting and name == "epsilon" and name in explained.model.names
        if lasting_epsilon:
            place = explained.model.names.index(name)
            near = explained.covariance[place, place] > _PROFILED**-2
        if (law.lasting and not near) or is_of_one_table(name):
            reach = TWO_SIDED_95 * error
            intervals.append(within_range(parameter, Interval(value - reach, value + reach, None, "linear")))
            continue
        intervals.append(_profile_of(fitted, name, i < own))
    return intervals


def _profile_of(fitted: Fitted, name: str, own: bool) -> Interval:
    """Return the profile interval of a parameter, by its unknown."""
    model, end = fitted.explained.model, fitted.explained.end
    law: Any = model.law
    place = model.names.index(name)
    error = float(np.sqrt(covariance_of_unknowns(fitted.explained)[place, place]))
    parameter, first = parameter_called(name), len(model.names) - len(model.instrument)
    if own:
        ends = sorted(float(law.unknown_of(name, max(end_of, 1e-300))) for end_of in (parameter.lowest, parameter.highest))

        if law.lasting:
            # a loss of a thousandth of it is none
            ends[0] = float(end.theta[place]) - np.log(1e3)

        def value_of(y: float) -> float:
            return float(law.value_of(name, y))
    else:
        quantity = model.instrument[place - first]
        ends, value_of = [-_FAR, _FAR], lambda y: float(quantity.at(y))

    def rise(y: float) -> float:
        return fitted.profile(place, y) - end.chi2

    found = profile_interval(rise, float(end.theta[place]), error, *ends)
    low, high = (None if y is None else value_of(y) for y in (found.low, found.high))
    if own and name == "r":
        low, high = high, low
    reason = found.reason
    if reason:
        # in words of the parameter, not of its unknown
        names = ("upper", "lower") if name == "r" else ("lower", "upper")
        parts = []
        for which, said in zip(("lower end: ", "upper end: "), names, strict=True):
            for part in reason.split("; "):
                if part.startswith(which):
                    bound = parameter.lowest if said == "lower" else parameter.highest
                    text = part.removeprefix(which)
                    if text.startswith("reaches"):
                        text = f"reaches the end of its range, {bound:g}"
                    parts.append(f"{said} end: {text}")
        reason = "; ".join(sorted(parts))
    return within_range(parameter, Interval(low, high, reason, found.kind))


_FAR = 1e3


def profile_lasting(explained: Explained):
    """Return chi2 with one unknown held at a value, the others following, weights as they are."""

    def at(place: int, value: float) -> float:
        theta, fixed = explained.end.theta.copy(), np.zeros(explained.end.theta.size, bool)
        fixed[place] = True
        covariance = explained.covariance
        if np.isfinite(covariance).all():
            theta = theta + covariance[place] / covariance[place, place] * (value - theta[place])
        theta[place] = value
        end = descend(explained.model, theta, explained.end.orbits, explained.weights, most=15, fixed=fixed)
        return end.chi2

    return at


def _rows_of(fitted: Fitted, table: AmplitudeTable | SeveralTables, read: np.ndarray) -> FittedRows:
    """Return measured and predicted readings."""
    explained, data = fitted.explained, fitted.explained.model.data
    orbits, weights, found = explained.end.orbits, explained.weights, explained.found
    lasting = explained.model.law.lasting  # pyright: ignore[reportAttributeAccessIssue]
    exists = found.count > 0
    predicted = np.where(exists[:, None], orbits.readings, np.nan)
    padded = np.concatenate([np.abs(data.read[:, :2]), np.full((len(exists), 1), np.rad2deg(0.125))], axis=1)
    error = np.hypot(data.error, weights.model_error[:, None] * padded)
    reasons = weights.reasons.copy()
    unread = np.isfinite(read).any(axis=1) & ~data.measured.any(axis=1)
    reasons[unread] = ATTRACTED
    shown = data.measured & (weights.used | (reasons != "")[:, None] | ~exists[:, None])
    counted = weights.used if lasting else data.measured & (reasons == "")[:, None]
    with np.errstate(invalid="ignore"):
        residual = np.where(counted & exists[:, None], (orbits.readings - data.read) / error, np.nan)
    if not lasting:
        residual = np.where(counted, (orbits.readings - data.read) / error, np.nan)
    measured = np.where(unread[:, None], _padded(read), np.where(shown, data.read, np.nan))
    kinds = 3 if table.tapping or np.isfinite(_padded(read)[:, 2]).any() else 2
    phases = {}
    if kinds > 2:
        phases = {
            "predicted_phase_deg": predicted[:, 2],
            "measured_phase_deg": measured[:, 2],
            "phase_error_deg": np.where(counted, error, np.nan)[:, 2],
        }
    used = data.measured.any(axis=1) & (reasons == "")
    return FittedRows(
        predicted_nm=predicted[:, :2],
        measured_nm=measured[:, :2],
        residual=residual[:, :kinds],
        error_nm=np.where(counted, error, np.nan)[:, :2],
        model_error=weights.model_error,
        used=used,
        set_aside=(reasons != "").astype(bool),
        approach_speed_nm_per_us=np.where(exists & ~data.row.free, orbits.approach, np.nan),
        orbits=found.count,
        near_fold=exists & (np.abs(orbits.fold) < NEAR_FOLD) & ~data.row.free,
        reasons=tuple(reasons.tolist()),
        **phases,
    )


ATTRACTED = "none: the sample only draws the tip"


def _padded(read: np.ndarray) -> np.ndarray:
    return np.pad(read, ((0, 0), (0, 3 - read.shape[1])), constant_values=np.nan)


def summary_of(table: AmplitudeTable | SeveralTables, task: Task, fitted: Fitted, read: np.ndarray) -> FitResult:
    """Return the result of a fit.

    Args:
        table: what was fitted.
        task: what was known beforehand.
        fitted: the minimum.
        read: the readings of the table, those that no fit looks at too.
    """
    explained, problem = fitted.explained, task.problem
    law: Any = explained.model.law
    fixed = dict(fitted.settings["fixed"])
    closest = closest_parameters(explained, problem.own, fixed)
    rows = _rows_of(fitted, table, read)
    data = explained.model.data
    numbers = int((data.measured & (rows.set_aside == False)[:, None]).sum()) + int(data.no_orbit.sum())  # noqa: E712
    freedom = numbers + len(task.known) - len(closest.names)
    judged = freedom > 0 and fitted.error_scale is None and not fitted.robust
    unexplained = [Interval(None, None, UNEXPLAINED)] * len(closest.names)
    covariance = closest.factor @ closest.factor.T
    other = None
    if fitted.other is not None:
        there = closest_parameters(fitted.other, problem.own, fixed)
        other = dict(zip(there.names, there.values.tolist(), strict=True)), fitted.other.end.chi2
    pulls = _compare_tables(explained, table)
    share = max(fitted.before.run - 2.2, 0.0) * 0.25 if law.lasting else 0.0
    unwidened = fitted.before.residual[:, : rows.residual.shape[1]]
    evidence = Evidence(
        table=table,
        parameters=_parameters(task, closest, np.full(len(closest.names), np.inf), unexplained),
        convergence=fitted.convergence,
        rows=rows,
        chi2=explained.end.chi2,
        freedom=freedom,
        p_value=chi2_tail(explained.end.chi2, freedom) if judged else float("nan"),
        other_minimum=other,
        error_scale=fitted.error_scale,
        robust=fitted.robust,
        correlations=_correlations(covariance),
        contact_share=_contact_share(explained),
        refused=explained.refused,
        untabulated=_untabulated(explained, rows),
        held=tuple(fitted.settings["held"]),
        contact=problem.model == "contact",
        pulls=tuple(pull.p_value for pull in pulls),
        run=(fitted.before.run, explained.run),
        short=min(share, 1.0),
        unwidened=np.where(np.isfinite(rows.residual), unwidened, np.nan) if law.lasting else None,
    )
    if not misfits(evidence):
        intervals = intervals_of(fitted, closest)
        errors = np.linalg.norm(closest.factor, axis=1)
        parameters = _parameters(task, closest, errors, intervals)
        if fitted.other is not None:
            elsewhere = fitted._replace(explained=fitted.other, other=None)
            there = closest_parameters(fitted.other, problem.own, fixed)
            theirs = _parameters(task, there, np.linalg.norm(there.factor, axis=1), intervals_of(elsewhere, there))
            parameters = {name: known.containing(theirs[name]) for name, known in parameters.items()}
        evidence = replace(evidence, parameters=parameters)
        shown = covariance
    else:
        shown = np.full_like(covariance, np.inf)
    reasons, warnings = judge_fit(evidence)
    return _result(table, task, fitted, evidence, closest, shown, pulls, reasons, warnings)


def _result(table, task, fitted, evidence, closest, shown, pulls, reasons, warnings) -> FitResult:  # noqa: PLR0913
    explained, problem = fitted.explained, task.problem
    law: Any = explained.model.law

    def with_band(speeds: np.ndarray):
        known = explained.law_at(speeds)
        if fitted.other is not None:
            known = containing(known, fitted.other.law_at(speeds))
        if np.isinf(shown).any():
            nothing = np.full_like(known.factor, np.nan), np.full_like(known.capture_factor, np.nan)
            known = known._replace(factor=nothing[0], capture_factor=nothing[1])
        return known

    at: AtSpeeds = with_band
    rows = evidence.rows
    speeds = np.where(rows.used, rows.approach_speed_nm_per_us, np.nan)
    values = dict(fitted.settings["fixed"]) | {name: p.value for name, p in evidence.parameters.items()}
    formula = None if problem.model == "contact" else formula_of(values, law.lasting)
    loss = None
    if np.isfinite(speeds).any():
        reached = speed_range(rows.approach_speed_nm_per_us[rows.used])
        loss = loss_of(
            at, reached, table.mass_ng, evidence.parameters, None if problem.model == "contact" else values
        )
    common = [i for i, name in enumerate(closest.names) if not is_of_one_table(name)]
    return FitResult(
        model=problem.model,
        parameters={name: known for name, known in evidence.parameters.items() if not is_of_one_table(name)},
        correlations=_correlations(shown)[np.ix_(common, common)],
        chi2=explained.end.chi2,
        degrees_of_freedom=evidence.freedom,
        p_value=evidence.p_value,
        aic=explained.end.chi2 + 2.0 * len(closest.names),
        valid=not reasons,
        reasons=reasons,
        warnings=warnings,
        law=law_with_band(
            at, speeds, lasting=law.lasting, formula=formula, mass_ng=table.mass_ng,
            origin=f"{problem.model} fitted to {table.source}",
        ),
        loss=loss,
        rows=rows,
        convergence=fitted.convergence,  # pyright: ignore[reportArgumentType]
        table=table,
        settings=fitted.settings,
        versions={name: version_of(name) for name in _PACKAGES},
        tables=_fitted_tables(table, evidence, pulls, [n for n in closest.names[: len(problem.own)]]),
    )  # fmt: skip


def _parameters(task: Task, closest: Closest, errors, intervals) -> dict[str, FittedParameter]:
    """Return the parameters with errors and intervals."""
    parameters = {}
    for i, (name, interval) in enumerate(zip(closest.names, intervals, strict=True)):
        error = float(errors[i])
        parameters[name] = FittedParameter(
            value=float(closest.values[i]),
            unit=parameter_called(name).unit,
            standard_error=error if not closest.vanishes[i] and np.isfinite(error) else None,
            interval95=(interval.low, interval.high),
            interval_reason=interval.reason,
            interval_kind=interval.kind,
            undetermined=not np.isfinite(np.linalg.norm(closest.factor[i])),
            at_bound=closest.vanishes[i],
            constraint=task.known.get(name),
        )
    return parameters


def _untabulated(explained: Explained, rows: FittedRows) -> tuple[int, ...]:
    """Return the rows whose impacts the table of a contact does not hold to its accuracy."""
    law: Any = explained.model.law
    if isinstance(law, FormulaLaw):
        return ()
    speeds = np.where(rows.used, rows.approach_speed_nm_per_us, np.nan)
    return tuple(np.flatnonzero(law.misses_accuracy(explained.model.of_law(explained.end.theta), speeds)).tolist())


def _contact_share(explained: Explained) -> float:
    """Return the largest share of a drive's period that the tip is in contact."""
    model, orbits = explained.model, explained.end.orbits
    hertz = float(model.law.coefficients(model.of_law(explained.end.theta))[0][0])
    used = explained.weights.used.any(axis=1) & np.isfinite(orbits.approach)
    if not used.any():
        return 0.0
    # us times kHz; 1e-3 makes it a share of the period
    return float(np.max(1e-3 * hertz * orbits.approach[used] ** -0.2 * model.data.row.drive_frequency_khz[used]))


def _compare_tables(explained: Explained, table: AmplitudeTable | SeveralTables) -> list[Pull]:
    """Return the pulls of several tables on the law; none of one table."""
    if not isinstance(table, SeveralTables):
        return []
    model, end = explained.model, explained.end
    law: Any = model.law
    count, tables = len(model.names), len(table.labels)
    number = np.full(end.residual.size, tables)
    number[: 3 * table.rows] = np.repeat(table.number, 3)
    own = np.zeros((tables, count), bool)
    for i, name in enumerate(model.names):
        if is_of_one_table(name):
            own[table.labels.index(name.partition(" of ")[2]), i] = True
            number[end.residual.size - count + i] = int(np.flatnonzero(own[:, i])[0])
    blocks = [number == t for t in range(tables + 1)]
    matrix = np.array([end.jacobian[block].T @ end.jacobian[block] for block in blocks])
    return pulls_of(
        Parts(
            matrix=matrix,
            vector=np.array([end.jacobian[block].T @ end.residual[block] for block in blocks]),
            square=np.array([end.residual[block] @ end.residual[block] for block in blocks]),
            own=own,
            law=np.array([i for i, name in enumerate(model.names) if name in law.own]),
        )
    )


def _fitted_tables(table, evidence: Evidence, pulls: list[Pull], law: list[str]) -> tuple[FittedTable, ...]:
    """Return what there is to say of each of several tables; nothing of one."""
    if not isinstance(table, SeveralTables):
        return ()
    fitted = []
    for t, (member, label, pull) in enumerate(zip(table.tables, table.labels, pulls, strict=True)):
        mine = table.number == t
        nuisances = {name: name_of_table(name, label) for name in NUISANCE_NAMES}
        fitted.append(
            FittedTable(
                source=member.source,
                name=label,
                rows=member.rows,
                used=int(evidence.rows.used[mine].sum()),
                chi2=pull.chi2,
                readings=int(np.isfinite(evidence.rows.residual[mine]).sum()),
                pull=_or_none(pull.pull),
                p_value=_or_none(pull.p_value),
                pulls={name: _or_none(size) for name, size in zip(law, pull.pulls, strict=False)},
                nuisances={
                    name: evidence.parameters[key] for name, key in nuisances.items() if key in evidence.parameters
                },
            )
        )
    return tuple(fitted)


def _or_none(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def _correlations(covariance: Float[np.ndarray, "p p"]) -> Float[np.ndarray, "p p"]:
    error = np.sqrt(np.diag(covariance))
    known = np.isfinite(error) & (error > 0.0)
    safe = np.where(known, error, 1.0)
    matrix = np.where(np.isfinite(covariance), covariance, 0.0) / np.outer(safe, safe)
    return np.where(np.outer(known, known), matrix, np.nan)
