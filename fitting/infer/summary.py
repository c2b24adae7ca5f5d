"""What a fit amounts to: the law with its band, parameters and intervals, rows, and the verdict."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from afm_jax.impact.law import CollisionDelay
from afm_jax.least_squares import chi2_tail, covariance_of
from afm_jax.units import TWO_SIDED_95
from afm_jax.version import version_of
from fitting.infer.closest import Closest, closest_parameters, covariance_of_unknowns, held_at_bound
from fitting.infer.explain import Explained
from fitting.infer.intervals import UNDETERMINED, UNEXPLAINED, Interval, Unknown, linear_interval, profile_interval
from fitting.infer.law import AtSpeeds, LawWithErrors, containing, speed_range
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
    jacobian, residual = end.jacobian, end.residual
    if not (np.isfinite(jacobian).all() and np.isfinite(residual).all()):
        reason = "the slopes of the residuals are not finite where the search ended"
        return Convergence(False, optimiser, iterations, np.inf, np.inf, reason)  # noqa: FBT003
    slope = jacobian.T @ residual
    moves = ~held_at_bound(explained) & ~((end.theta <= explained.model.lowest) & (slope > 0.0))
    covariance = covariance_of(jacobian[:, moves].T @ jacobian[:, moves])
    known = np.isfinite(np.diag(covariance))
    step = np.where(known, np.where(np.isfinite(covariance), covariance, 0.0) @ np.where(known, slope[moves], 0.0), 0.0)
    distance = float(slope[moves] @ step)
    errors = np.sqrt(np.where(known, np.diag(covariance), 0.0))
    gradient = float(np.max(np.abs(2.0 * slope[moves] * errors), initial=0.0))
    return Convergence(explained.settled and distance < ENOUGH, optimiser, iterations, gradient, distance)


def summary_of(
    table: AmplitudeTable | SeveralTables, task: Task, fitted: Fitted, settings: dict[str, Any]
) -> FitResult:
    """Return the result of a fit.

    Args:
        table: what was fitted.
        task: what was known beforehand.
        fitted: the minimum.
        settings: every option of the fit.
    """
    explained, problem, data = fitted.explained, task.problem, fitted.explained.model.data
    closest, rows = closest_parameters(explained, problem.own, settings["fixed"]), _rows_of(explained, table)
    counted = data.measured & ~rows.set_aside[:, None]
    freedom = int(counted.sum() + data.no_orbit.sum()) + len(task.known) - len(closest.names)
    judged = freedom > 0 and settings["error_scale"] is None and settings["robust"] is None
    other = None
    if fitted.other is not None:
        there = closest_parameters(fitted.other, problem.own, settings["fixed"])
        other = dict(zip(there.names, there.values.tolist(), strict=True)), fitted.other.end.chi2
    pulls = _compare_tables(explained, table)
    unexplained = [Interval(None, None, UNEXPLAINED)] * len(closest.names)
    evidence = Evidence(
        table=table,
        parameters=_parameters(task, closest, np.full(len(closest.names), np.inf), unexplained),
        convergence=fitted.convergence,
        rows=rows,
        chi2=explained.end.chi2,
        freedom=freedom,
        p_value=chi2_tail(explained.end.chi2, freedom) if judged else float("nan"),
        other_minimum=other,
        error_scale=settings["error_scale"],
        robust=settings["robust"] is not None,
        correlations=_correlations(closest.factor),
        untabulated=_untabulated(explained, rows),
        contact_share=_contact_share(explained),
        refused=explained.refused,
        contact=problem.model == "contact",
        pulls=tuple(pull.p_value for pull in pulls),
        run=(fitted.before.run, explained.run),
        short=explained.short,
        unwidened=np.where(np.isfinite(rows.residual), fitted.before.residual[:, : rows.residual.shape[1]], np.nan),
        held=tuple(settings["held"]),
        courses=courses_along_rows(explained, table),
    )
    # errors that assume the model would be confident numbers about a law that is not there
    known = not misfits(evidence)
    if known:
        evidence = replace(evidence, parameters=_known_parameters(task, fitted, closest, settings))
    return _result(task, fitted, evidence, closest, pulls, settings, known=known)


def _known_parameters(
    task: Task, fitted: Fitted, closest: Closest, settings: dict[str, Any]
) -> dict[str, FittedParameter]:
    """Return the parameters with errors and intervals, so large that they hold those of another minimum too."""
    parameters = _parameters(task, closest, closest.errors, intervals_of(fitted, closest))
    if fitted.other is None:
        return parameters
    there = closest_parameters(fitted.other, task.problem.own, settings["fixed"])
    elsewhere = fitted._replace(explained=fitted.other, other=None)
    theirs = _parameters(task, there, there.errors, intervals_of(elsewhere, there))
    return {name: parameter.containing(theirs[name]) for name, parameter in parameters.items()}


def intervals_of(fitted: Fitted, closest: Closest) -> list[Interval]:
    """Return the 95 % interval of every parameter.

    By profile likelihood of instantaneous laws, of epsilon where that is less than three errors from 0, and of a
    contact's parameter that is known to no factor of seven; else linear, in the unknown where that is a contact's.
    """
    model, covariance = fitted.explained.model, covariance_of_unknowns(fitted.explained)
    formula, intervals = isinstance(model.law, FormulaLaw), []
    # the error of a logarithm from which on an end may be far away
    positive = [name for name in model.law.own if not parameter_called(name).width]
    bounded = {"epsilon": 1.0 / _PROFILED} if formula else dict.fromkeys(positive, _VAGUE)
    for name, value, error in zip(closest.names, closest.values.tolist(), closest.errors.tolist(), strict=True):
        place = model.names.index(name) if name in model.names else None
        variance = np.inf if place is None else covariance[place, place]
        if not np.isfinite(error):
            intervals.append(Interval(None, None, UNDETERMINED))
        elif is_of_one_table(name) or (model.law.lasting and (name not in bounded or variance < bounded[name] ** 2)):
            ends = value - TWO_SIDED_95 * error, value + TWO_SIDED_95 * error
            if place is not None and not formula and name in model.law.own:
                here, reach = fitted.explained.end.theta[place], TWO_SIDED_95 * float(np.sqrt(variance))
                ends = model.law.value_of(name, here - reach), model.law.value_of(name, here + reach)
            intervals.append(linear_interval(parameter_called(name), *map(float, ends)))
        else:
            intervals.append(_profile_of(fitted, name, float(np.sqrt(variance))))
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
    read = readings_of(table)[0]
    kinds, number = read.shape[1], explained.found.number
    exists, reasons = number > 0, weights.reasons.copy()
    drawn = np.isfinite(read).any(axis=1) & ~data.measured.any(axis=1)
    reasons[drawn] = ATTRACTED
    counted = data.measured & (reasons == "")[:, None]
    size = np.concatenate([np.abs(data.read[:, :2]), np.full((len(exists), 1), SIZE_OF_PHASE)], axis=1)
    error = np.where(counted, np.hypot(data.error, weights.model_error[:, None] * size), np.nan)
    # an instantaneous law without an orbit predicts no amplitude; one that lasts is asked for the others alone
    compared = np.where(exists[:, None] | (not explained.model.law.lasting), orbits.readings, np.nan)
    predicted = np.where(exists[:, None], explained.by_law_alone().readings, np.nan)
    phases = {}
    if kinds == READINGS:
        phases = {
            "predicted_phase_deg": predicted[:, 2],
            "measured_phase_deg": read[:, 2],
            "phase_error_deg": error[:, 2],
        }
    return FittedRows(
        predicted_nm=predicted[:, :2],
        measured_nm=read[:, :2],
        residual=((compared - data.read) / error)[:, :kinds],
        error_nm=error[:, :2],
        model_error=weights.model_error,
        used=counted.any(axis=1),
        set_aside=(reasons != "").astype(bool),
        approach_speed_nm_per_us=np.where(exists & ~data.row.free, explained.by_law_alone().approach, np.nan),
        orbits=number,
        near_fold=exists & (np.abs(orbits.fold) < NEAR_FOLD) & ~data.row.free,
        reasons=tuple(reasons.tolist()),
        **phases,
    )


_KINDS = (("peak amplitude", ""), ("lock-in amplitude", ""), ("phase", "degrees"))
"""What is read, and its unit if it does not drift by a share."""
_FOLLOWING = 4.0
"""Slope of the residuals along the rows, in its standard errors, beyond which it is not taken to be chance."""


def courses_along_rows(explained: Explained, table: AmplitudeTable | SeveralTables) -> dict[str, list[str]]:
    """Return which readings of a table follow its rows, and by how much from the first to the last, by its label.

    Only tables that say nothing of the order of their rows are looked at. Of each reading a course along the rows is
    fitted beside everything else.
    """
    data, end, weights = explained.model.data, explained.end, explained.weights
    if not np.isfinite(end.jacobian).all():
        return {}
    freedom = max(int(weights.used.sum()) - len(explained.model.law.own), 1)
    scale, courses = np.sqrt(max(1.0, end.chi2 / freedom)), {}
    basis, size, _ = np.linalg.svd(
        end.jacobian / np.maximum(np.linalg.norm(end.jacobian, axis=0), 1e-300), full_matrices=False
    )
    basis = basis[:, size > 1e-10 * max(float(size[0]), 1e-300)]
    for number, (member, label) in enumerate(zip(table.tables, table.labels, strict=True)):
        mine = data.number == number
        for kind, (name, unit) in enumerate(_KINDS):
            if member.rows_in_order_of_time or not weights.used[mine, kind].any():
                continue
            course = np.zeros((mine.size, READINGS))
            share = 1.0 if unit else np.abs(end.orbits.readings[mine, kind])
            course[mine, kind] = np.where(weights.used[mine, kind], np.linspace(-0.5, 0.5, member.rows) * share, 0.0)
            white = np.einsum("nij,nj->ni", weights.whitening, course).ravel()
            column = np.append(white, np.zeros(end.residual.size - white.size))
            apart = column - basis @ (basis.T @ column)
            length = float(apart @ apart)
            if length <= 1e-6 * float(column @ column):
                continue
            slope = -float(apart @ end.residual) / length
            if abs(slope) * np.sqrt(length) > _FOLLOWING * scale:
                drift = f"{slope:+.2g} {unit}" if unit else f"{100.0 * slope:+.2g} %"
                courses.setdefault(label, []).append(f"{name} {drift}")
    return courses


def _result(
    task: Task,
    fitted: Fitted,
    evidence: Evidence,
    closest: Closest,
    pulls: list[Pull],
    settings: dict[str, Any],
    *,
    known: bool,
) -> FitResult:
    """Return the result of a fit whose errors are known, or are not: the law and its loss with bands, the verdict."""
    explained, table, problem, rows = fitted.explained, evidence.table, task.problem, evidence.rows

    def law_at(speeds: Float[np.ndarray, " n"]) -> LawWithErrors:
        law = explained.law_at(speeds)
        if fitted.other is not None:
            law = containing(law, fitted.other.law_at(speeds))
        return law if known else law.without_errors()

    at: AtSpeeds = law_at
    values = dict(settings["fixed"]) | {name: parameter.value for name, parameter in evidence.parameters.items()}
    formula = None if problem.model == "contact" else values
    speeds = np.where(rows.used, rows.approach_speed_nm_per_us, np.nan)
    loss = None
    if np.isfinite(speeds).any():
        loss = loss_of(at, speed_range(speeds), table.mass_ng, evidence.parameters, formula)
    reasons, warnings = judge_fit(evidence)
    coefficients, _ = explained.model.law.coefficients(explained.model.of_law(explained.end.theta))
    common = [i for i, name in enumerate(closest.names) if not is_of_one_table(name)]
    return FitResult(
        model=problem.model,
        parameters={name: one for name, one in evidence.parameters.items() if not is_of_one_table(name)},
        correlations=_correlations(closest.factor if known else np.full_like(closest.factor, np.nan))[
            np.ix_(common, common)
        ],
        chi2=explained.end.chi2,
        degrees_of_freedom=evidence.freedom,
        p_value=evidence.p_value,
        aic=explained.end.chi2 + 2.0 * len(closest.names),
        valid=not reasons,
        reasons=reasons,
        warnings=warnings,
        law=FittedLaw(
            at,
            speeds,
            delay=CollisionDelay(*coefficients[:3]) if problem.lasting else None,
            mass_ng=table.mass_ng,
            origin=f"{problem.model} fitted to {table.source}",
        ),
        loss=loss,
        rows=rows,
        convergence=fitted.convergence,
        table=table,
        settings=settings,
        versions={name: version_of(name) for name in _PACKAGES},
        tables=_fitted_tables(evidence, pulls, problem.own),
    )


def _parameters(
    task: Task, closest: Closest, errors: Float[np.ndarray, " p"], intervals: list[Interval]
) -> dict[str, FittedParameter]:
    """Return the parameters with errors and intervals."""
    parameters = {}
    for i, (name, interval) in enumerate(zip(closest.names, intervals, strict=True)):
        error = float(errors[i])
        # of a contact's parameter that may be 0 for all the data say, the other end is a limit
        vanishes = closest.vanishes[i] or (name in CONTACT_NAMES and interval.low is None and interval.high is not None)
        parameters[name] = FittedParameter(
            value=float(closest.values[i]),
            unit=parameter_called(name).unit,
            standard_error=error if not vanishes and np.isfinite(error) else None,
            interval95=(interval.low, interval.high),
            interval_reason=interval.reason,
            interval_kind=interval.kind,
            undetermined=not np.isfinite(closest.errors[i]),
            at_bound=vanishes,
            constraint=task.known.get(name),
        )
    return parameters


def _untabulated(explained: Explained, rows: FittedRows) -> tuple[int, ...]:
    """Return the rows whose impacts the table of a contact does not hold to its accuracy."""
    law, theta = explained.model.law, explained.model.of_law(explained.end.theta)
    speeds = np.where(rows.used, rows.approach_speed_nm_per_us, np.nan)
    return tuple(np.flatnonzero(law.misses_accuracy(theta, speeds)).tolist())


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
    law = model.law
    count, tables = len(model.names), len(table.labels)
    number = np.full(end.residual.size, tables)
    number[: 3 * table.rows] = np.repeat(table.number, 3)
    own = np.zeros((tables, count), bool)
    for i, name in enumerate(model.names):
        if is_of_one_table(name):
            own[table.labels.index(name.partition(" of ")[2]), i] = True
            number[end.residual.size - count + i] = int(np.flatnonzero(own[:, i])[0])
    places = np.array([i for i, name in enumerate(model.names) if name in law.own])
    # r falls where its unknown, 1 - r^2, grows
    sign = np.sign([law.slope_of(model.names[i], float(end.theta[i])) for i in places])
    blocks = [number == t for t in range(tables + 1)]
    matrix = np.array([end.jacobian[block].T @ end.jacobian[block] for block in blocks])
    parts = Parts(
        matrix=matrix,
        vector=np.array([end.jacobian[block].T @ end.residual[block] for block in blocks]),
        square=np.array([end.residual[block] @ end.residual[block] for block in blocks]),
        own=own,
        law=places,
    )
    return [pull._replace(pulls=sign * pull.pulls) for pull in pulls_of(parts)]


def _fitted_tables(evidence: Evidence, pulls: list[Pull], law: tuple[str, ...]) -> tuple[FittedTable, ...]:
    """Return what there is to say of each of several tables; nothing of one."""
    table, fitted = evidence.table, []
    if not isinstance(table, SeveralTables):
        return ()

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


def _correlations(factor: Float[np.ndarray, "p m"]) -> Float[np.ndarray, "p p"]:
    """Return correlations of parameters that change with independent unknowns; NaN where nothing is known of one."""
    error = np.linalg.norm(factor, axis=1)
    known = np.isfinite(error) & (error > 0.0)
    unit = np.where(known[:, None], factor / np.where(known, error, 1.0)[:, None], 0.0)
    return np.where(np.outer(known, known), unit @ unit.T, np.nan)
