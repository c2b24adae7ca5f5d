"""What a fit amounts to: the law with its band, parameters and intervals, rows, and the verdict."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from afm_jax.impact.law import CollisionDelay
from afm_jax.solve.least_squares import chi2_tail, covariance_of
from afm_jax.units import TWO_SIDED_95
from afm_jax.version import version_of
from fitting.infer.closest import Closest, closest_parameters, covariance_of_unknowns, held_at_bound
from fitting.infer.explain import Explained
from fitting.infer.intervals import UNDETERMINED, UNEXPLAINED, Interval, Unknown, linear_interval, profile_interval
from fitting.infer.law import LawWithErrors, containing, speed_range
from fitting.infer.result import (
    ENOUGH,
    Convergence,
    FitResult,
    FittedLaw,
    FittedParameter,
    FittedRows,
    FittedTable,
    loss_of,
)
from fitting.infer.rows import SIZE_OF_PHASE
from fitting.infer.several import Parts, Pull, pulls_of
from fitting.infer.verdict import Evidence, judge_fit, misfits
from fitting.models import Task, readings_of
from fitting.parameters import (
    CONTACT_NAMES,
    NUISANCE_NAMES,
    is_of_one_table,
    name_of_table,
    parameter_called,
)
from fitting.predict.law import FormulaLaw
from fitting.predict.orbit import NEAR_FOLD, READINGS
from fitting.tables.several import SeveralTables
from fitting.tables.table import AmplitudeTable

_PROFILED = 3.0
"""Errors from its bound within which epsilon has a profile interval where impacts last."""
_VAGUE = 2.0
"""Error of the logarithm of a contact's parameter from which its interval is a profile's."""
_VANISHING = 1e-3
"""Part of epsilon that is none, where its logarithm is the unknown."""
_PACKAGES = ("afm-jax", "jax", "optax", "numpy")
ATTRACTED = "none: the sample only draws the tip"


class Fitted(NamedTuple):
    """A minimum before it is judged.

    Attributes:
        explained: the law and the rows.
        before: without what was added for runs of residuals.
        other: another minimum that may be the true one; None: there is none.
        profile: chi2 of what is explained with one unknown, by its place, held at a value, the others following.
        convergence: of the minimum.
    """

    explained: Explained
    before: Explained
    other: Explained | None
    profile: Callable[[Explained, int, float], float]
    convergence: Convergence


def convergence_of(explained: Explained, optimiser: str, iterations: int) -> Convergence:
    """Return how far chi2 is from its minimum, unknowns that are held at a bound left out."""
    end = explained.end
    jacobian, residual, distance, gradient = end.jacobian, end.residual, np.inf, np.inf
    reason = "the slopes of the residuals are not finite where the search ended"
    if np.isfinite(jacobian).all() and np.isfinite(residual).all():
        slope = jacobian.T @ residual
        moves = ~held_at_bound(explained) & ~((end.theta <= explained.model.lowest) & (slope > 0.0))
        covariance = covariance_of(jacobian[:, moves].T @ jacobian[:, moves])
        known = np.isfinite(np.diag(covariance))
        slope, covariance = slope[moves][known], covariance[np.ix_(known, known)]
        distance = float(slope @ covariance @ slope)
        gradient = float(np.max(np.abs(2.0 * slope * np.sqrt(np.diag(covariance))), initial=0.0))
        reason = None if explained.settled else "orbits and weights of the rows do not settle"
        if distance >= ENOUGH:
            reason = f"chi2 lies an estimated {distance:.2g} above its minimum"
    return Convergence(reason is None, optimiser, iterations, gradient, distance, reason)


def summary_of(
    table: AmplitudeTable | SeveralTables, task: Task, fitted: Fitted, settings: dict[str, Any]
) -> FitResult:
    """Return the result of a fit: the law and its loss with bands, parameters with intervals, rows, the verdict.

    Args:
        table: what was fitted.
        task: what was known beforehand.
        fitted: the minimum.
        settings: every option of the fit.
    """
    explained, problem, data = fitted.explained, task.problem, fitted.explained.model.data
    law, theta = explained.model.law, explained.model.of_law(explained.end.theta)
    chi2, rows = explained.end.chi2, _rows_of(explained, table)
    closest = closest_parameters(explained, problem.own, settings["fixed"])
    counted = data.measured & ~rows.set_aside[:, None]
    freedom = int(counted.sum() + data.no_orbit.sum()) + len(task.known) - len(closest.names)
    judged = freedom > 0 and settings["error_scale"] is None
    other, elsewhere, other_minimum = fitted.other, None, None
    if other is not None:
        elsewhere = closest_parameters(other, problem.own, settings["fixed"])
        other_minimum = dict(zip(elsewhere.names, elsewhere.values.tolist(), strict=True)), other.end.chi2
    pulls = _compare_tables(explained, table)
    speeds = np.where(rows.used, rows.approach_speed_nm_per_us, np.nan)
    evidence = Evidence(
        table=table,
        parameters=_parameters(task, closest, None),
        convergence=fitted.convergence,
        rows=rows,
        chi2=chi2,
        freedom=freedom,
        p_value=chi2_tail(chi2, freedom) if judged else float("nan"),
        other_minimum=other_minimum,
        error_scale=settings["error_scale"],
        robust=settings["robust"] is not None,
        correlations=_correlations(closest.factor),
        untabulated=tuple(np.flatnonzero(law.misses_accuracy(theta, speeds)).tolist()),
        refused=explained.refused,
        pulls=tuple(pull.p_value for pull in pulls),
        run=(fitted.before.run, explained.run),
        short=explained.short,
        unwidened=np.where(np.isfinite(rows.residual), fitted.before.residual[:, : rows.residual.shape[1]], np.nan),
        held=tuple(settings["held"]),
    )
    # errors that assume the model would be confident numbers about a law that is not there
    known = not misfits(evidence)
    if known:
        parameters = _parameters(task, closest, intervals_of(fitted, closest))
        if other is not None and elsewhere is not None:
            theirs = _parameters(task, elsewhere, intervals_of(fitted._replace(explained=other), elsewhere))
            parameters = {name: parameter.containing(theirs[name]) for name, parameter in parameters.items()}
        evidence = replace(evidence, parameters=parameters)

    def law_at(speeds: Float[np.ndarray, " n"]) -> LawWithErrors:
        law = explained.law_at(speeds)
        law = law if other is None else containing(law, other.law_at(speeds))
        # nothing is known of the errors
        nothing = law._replace(factor=np.nan * law.factor, capture_factor=np.nan * law.capture_factor)
        return law if known else nothing

    common = [not is_of_one_table(name) for name in closest.names]
    values = dict(settings["fixed"]) | {name: parameter.value for name, parameter in evidence.parameters.items()}
    formula, loss = None if problem.model == "contact" else values, None
    if np.isfinite(speeds).any():
        loss = loss_of(law_at, speed_range(speeds), table.mass_ng, evidence.parameters, formula)
    reasons, warnings = judge_fit(evidence)
    delay = CollisionDelay(*law.coefficients(theta)[0][:3]) if problem.lasting else None
    return FitResult(
        model=problem.model,
        parameters={name: one for name, one in evidence.parameters.items() if not is_of_one_table(name)},
        correlations=np.where(known, evidence.correlations, np.nan)[np.ix_(common, common)],
        chi2=chi2,
        degrees_of_freedom=freedom,
        p_value=evidence.p_value,
        aic=chi2 + 2.0 * len(closest.names),
        valid=not reasons,
        reasons=reasons,
        warnings=warnings,
        law=FittedLaw(
            law_at, speeds, delay=delay, mass_ng=table.mass_ng, origin=f"{problem.model} fitted to {table.source}"
        ),
        loss=loss,
        rows=rows,
        convergence=fitted.convergence,
        table=table,
        settings=settings,
        versions={name: version_of(name) for name in _PACKAGES},
        tables=_fitted_tables(evidence, pulls),
    )


def intervals_of(fitted: Fitted, closest: Closest) -> list[Interval]:
    """Return the 95 % interval of every parameter.

    By profile likelihood of instantaneous laws, of epsilon that is less than three errors from 0, and of a
    contact's parameter that is known to no factor of seven; else linear, in the unknown where that is a contact's.
    """
    model, covariance = fitted.explained.model, covariance_of_unknowns(fitted.explained)
    formula, intervals = isinstance(model.law, FormulaLaw), []
    # the error of a logarithm from which on an end may be far away
    positive = [name for name in model.law.own if not parameter_called(name).width]
    bounded = ["epsilon"] if formula else positive
    for name, value, error in zip(closest.names, closest.values.tolist(), closest.errors.tolist(), strict=True):
        place = model.names.index(name) if name in model.names else None
        variance = np.inf if place is None else covariance[place, place]
        far = _PROFILED * error < value if formula else variance < _VAGUE**2
        if not np.isfinite(error):
            intervals.append(Interval(None, None, UNDETERMINED))
        elif is_of_one_table(name) or (model.law.lasting and (name not in bounded or far)):
            ends = value - TWO_SIDED_95 * error, value + TWO_SIDED_95 * error
            if place is not None and not formula and name in model.law.own:
                here = fitted.explained.end.theta[place]
                reach = TWO_SIDED_95 * float(np.sqrt(variance))
                ends = model.law.value_of(name, here - reach), model.law.value_of(name, here + reach)
            intervals.append(linear_interval(parameter_called(name), *map(float, ends)))
        else:
            found = _profile_of(fitted, name, float(np.sqrt(variance)))
            # the value is the closest formula's, not the unknown's
            low, high = found.low and min(found.low, value), found.high and max(found.high, value)
            intervals.append(replace(found, low=low, high=high))
    return intervals


def _profile_of(fitted: Fitted, name: str, error: float) -> Interval:
    """Return the profile interval of a parameter that is an unknown itself, whose standard error is given."""
    model, end = fitted.explained.model, fitted.explained.end
    place, law, least = model.names.index(name), model.law, -np.inf
    here = float(end.theta[place])
    if name in law.own:
        of_value, value = (lambda value: float(law.unknown_of(name, value))), lambda y: float(law.value_of(name, y))
        least = _VANISHING * value(here) if law.lasting else least
    else:
        quantity = model.instrument[place - len(model.names) + len(model.instrument)]
        of_value, value = quantity.unknown, lambda y: float(quantity.at(y))

    def rise(y: float) -> float:
        return fitted.profile(fitted.explained, place, y) - end.chi2

    return profile_interval(rise, parameter_called(name), Unknown(here, error, of_value, value), least)


def _rows_of(explained: Explained, table: AmplitudeTable | SeveralTables) -> FittedRows:
    """Return measured and predicted readings."""
    data, orbits, weights = explained.model.data, explained.end.orbits, explained.weights
    by_law = explained.by_law_alone()
    number = explained.found.number
    read = readings_of(table)[0]
    exists, reasons, hits = number > 0, weights.reasons.copy(), ~data.row.free
    reasons[np.isfinite(read).any(axis=1) & ~data.measured.any(axis=1)] = ATTRACTED
    counted = data.measured & (reasons == "")[:, None]
    size = np.column_stack([np.abs(data.read[:, :2]), np.full(len(exists), SIZE_OF_PHASE)])
    error = np.where(counted, np.hypot(data.error, weights.model_error[:, None] * size), np.nan)
    # an instantaneous law without an orbit predicts no amplitude; one that lasts is asked for the others alone
    compared = np.where(exists[:, None] | (not explained.model.law.lasting), orbits.readings, np.nan)
    predicted = np.where(exists[:, None], by_law.readings, np.nan)
    phase = np.isfinite(read[:, 2]).any()
    return FittedRows(
        predicted_nm=predicted[:, :2],
        measured_nm=read[:, :2],
        residual=((compared - data.read) / error)[:, : READINGS if phase else 2],
        error_nm=error[:, :2],
        model_error=weights.model_error,
        used=counted.any(axis=1),
        set_aside=reasons != "",
        approach_speed_nm_per_us=np.where(exists & hits, by_law.approach, np.nan),
        orbits=number,
        near_fold=exists & hits & (np.abs(orbits.fold) < NEAR_FOLD),
        reasons=tuple(reasons.tolist()),
        predicted_phase_deg=predicted[:, 2] if phase else None,
        measured_phase_deg=read[:, 2] if phase else None,
        phase_error_deg=error[:, 2] if phase else None,
    )


def _parameters(task: Task, closest: Closest, intervals: list[Interval] | None) -> dict[str, FittedParameter]:
    """Return the parameters, with errors and intervals if the model explains the data."""
    parameters, unexplained = {}, Interval(None, None, UNEXPLAINED)
    for i, (name, error) in enumerate(zip(closest.names, closest.errors.tolist(), strict=True)):
        interval = unexplained if intervals is None else intervals[i]
        # of a contact's parameter that may be 0 for all the data say, the other end is a limit
        only_below = interval.low is None and interval.high is not None
        vanishes = closest.vanishes[i] or (name in CONTACT_NAMES and only_below)
        parameters[name] = FittedParameter(
            value=float(closest.values[i]),
            unit=parameter_called(name).unit,
            standard_error=error if intervals is not None and np.isfinite(error) and not vanishes else None,
            interval95=(interval.low, interval.high),
            interval_reason=interval.reason,
            interval_kind=interval.kind,
            undetermined=not np.isfinite(error),
            at_bound=vanishes,
            constraint=task.known.get(name),
        )
    return parameters


def _compare_tables(explained: Explained, table: AmplitudeTable | SeveralTables) -> list[Pull]:
    """Return the pulls of several tables on the law; none of one table."""
    if not isinstance(table, SeveralTables):
        return []
    model, end, tables = explained.model, explained.end, len(table.labels)
    number = np.full(end.residual.size, tables)
    number[: READINGS * table.rows] = np.repeat(table.number, READINGS)
    own = np.array([[name.partition(" of ")[2] == label for name in model.names] for label in table.labels])
    # what is known of the unknowns stands last
    of_priors = number[-len(model.names) :]
    of_priors[own.any(axis=0)] = np.argmax(own, axis=0)[own.any(axis=0)]
    blocks = [(end.jacobian[number == t], end.residual[number == t]) for t in range(tables + 1)]
    parts = Parts(
        matrix=np.array([slope.T @ slope for slope, _ in blocks]),
        vector=np.array([slope.T @ residual for slope, residual in blocks]),
        square=np.array([residual @ residual for _, residual in blocks]),
        own=own,
        law=np.flatnonzero([name in model.law.own for name in model.names]),
    )
    return pulls_of(parts)


def _fitted_tables(evidence: Evidence, pulls: list[Pull]) -> tuple[FittedTable, ...]:
    """Return what there is to say of each of several tables; nothing of one."""
    fitted, rows, table = [], evidence.rows, evidence.table
    if not isinstance(table, SeveralTables):
        return ()
    for t, (member, label, pull) in enumerate(zip(table.tables, table.labels, pulls, strict=True)):
        mine = table.number == t
        names = {name: name_of_table(name, label) for name in NUISANCE_NAMES}
        fitted.append(
            FittedTable(
                name=label,
                rows=member.rows,
                used=int(rows.used[mine].sum()),
                readings=int(np.isfinite(rows.residual[mine]).sum()),
                **pull._asdict(),
                nuisances={name: evidence.parameters[own] for name, own in names.items() if own in evidence.parameters},
            )
        )
    return tuple(fitted)


def _correlations(factor: Float[np.ndarray, "p m"]) -> Float[np.ndarray, "p p"]:
    """Return correlations of parameters that change with independent unknowns; NaN where nothing is known of one."""
    error = np.linalg.norm(factor, axis=1)
    unit = factor / np.where(error > 0.0, error, np.nan)[:, None]
    return np.where(np.isfinite(np.outer(error, error)), unit @ unit.T, np.nan)
