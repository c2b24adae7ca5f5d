"""The fit of an impact law to amplitude tables: the public function, and the steps that it takes.

`fit` finds the minimum of chi2 (`find_fit`: screen, minimise, and again with the model's own errors) and says what it
amounts to (`summarise`: the step to the law with the model discrepancy, another minimum, intervals, verdict, result).
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from afm_jax.checks import checked, require_float64
from afm_jax.contact.parameters import EFFECTS
from afm_jax.least_squares import chi2_tail
from afm_jax.solve.lanes import compiling
from afm_jax.version import version_of
from fitting.fits.estimate import (
    FitEstimate,
    Found,
    courses_along_rows,
    estimate_of,
    programs_of_laws,
)
from fitting.fits.intervals import UNEXPLAINED, Interval, profile_intervals, within_range
from fitting.fits.law_after import holding, speed_range
from fitting.fits.minimum import minimum_with_model_errors, rescale_errors, settle, starts, untabulated
from fitting.fits.objective import ROBUST, Objective, lowest, warm_up_steps
from fitting.fits.result import (
    FitResult,
    FittedParameter,
    FittedTable,
    Loss,
    law_with_band,
    loss_of,
)
from fitting.fits.several import Pull
from fitting.fits.verdict import Evidence, judge_fit, misfits
from fitting.forward import programs_of_search
from fitting.models import held_of, split_held, task_of
from fitting.parameters import NUISANCE_NAMES, is_of_one_table, model_parameters, name_of_table, parameter_called
from fitting.tables.several import SeveralTables
from fitting.tables.table import AmplitudeTable, as_table


@checked
def fit(  # noqa: PLR0913
    table: AmplitudeTable | Sequence[AmplitudeTable] | Any,
    model: str = "law",
    *,
    share: Sequence[str] = (),
    scale_errors: bool = False,
    free: Sequence[str] | None = None,
    fixed: dict[str, float] | None = None,
    constraints: dict[str, tuple[float, float]] | None = None,
    effects: Sequence[str] = EFFECTS,
    robust: bool = False,
) -> FitResult:
    """Fit an impact law to measured amplitudes of single-impact orbits.

    Args:
        table: from `read_table`, the path of a file, or a data frame as `AmplitudeTable.from_dataframe` takes it; what
            it gives with an error (Q, calibrations) is a nuisance with that constraint. A Q without error is taken to
            be known to 5 % where impacts last, and exactly by the instantaneous laws. Several of them: one law for all,
            each with nuisances of its own.
        model: "restitution" (r), "law" (r, epsilon; eq. 6), "viscous" (epsilon, viscous_loss) or "full" (all three),
            each instantaneous or with "+delay", the collision delay; or "contact", physical parameters of the resolved
            contact. On resonance, where a tapping curve determines no impact law, "contact" still can be fitted.
        share: nuisances that several tables have in common, by name; "all": every one.
        scale_errors: take the amplitudes' errors as relative only and scale them until chi2 equals its degrees of
            freedom (the error of Q stays); the result is valid only if the scale is believable and what is left of the
            amplitudes random (see `verdict`).
        free: the parameters that are fitted; None: all of a law and its delay, of "contact" (keywords of
            `Contact.paper`) relative humidity, adhesion energy, viscosity and modulus, without those fixed.
        fixed: values at which other parameters of the model are held; of "contact" what is not named is the paper's.
        constraints: value and standard error of what else is known, by parameter: a nuisance (`quality_factor`,
            `tip_calibration`, `drive_calibration`, `offset_origin_nm`), which then is fitted along, or one of the
            model's parameters. With several tables a nuisance's constraint holds for each of them. In a fit of
            "contact" a constrained parameter that is not free is held at its value, and its error adds to the errors
            of the fitted ones; a held parameter without constraint gets an assumed error, which the report names.
        effects: for "contact": the effects there are.
        robust: let outliers count linearly from two errors on; the result is valid only if they are few and the other
            amplitudes are explained.

    Returns:
        Values, errors, intervals, goodness of fit and a verdict; see `FitResult`.

    Raises:
        ValueError: if there is no such model or parameter, a constraint is impossible or degenerate with the model,
            there are fewer measured amplitudes than parameters, or tables have no law in common.
        RuntimeError: if JAX is not set to 64-bit floats.
    """
    whole = tables_of(table)
    found = find_fit(
        whole,
        model,
        share=share,
        scale_errors=scale_errors,
        free=free,
        fixed=fixed,
        constraints=constraints,
        effects=effects,
        robust=robust,
    )
    return summarise(whole, found)


def tables_of(given: Any) -> AmplitudeTable | SeveralTables:
    """Return what was given as a table, or as several."""

    def table_of(given: Any) -> AmplitudeTable:
        return AmplitudeTable.from_dataframe(given) if hasattr(given, "columns") else as_table(given)

    if isinstance(given, SeveralTables):
        return given
    if isinstance(given, str) or not isinstance(given, Sequence):
        return table_of(given)
    if not given:
        raise ValueError("there is no table: give one, or the path of one")
    tables = tuple(map(table_of, given))
    return tables[0] if len(tables) == 1 else SeveralTables(tables)


def find_fit(  # noqa: PLR0913
    table: AmplitudeTable | SeveralTables,
    model: str,
    *,
    share: Sequence[str] = (),
    scale_errors: bool = False,
    free: Sequence[str] | None = None,
    fixed: dict[str, float] | None = None,
    constraints: dict[str, tuple[float, float]] | None = None,
    effects: Sequence[str] = EFFECTS,
    robust: bool = False,
) -> Found:
    """Return the minimum of a fit; arguments and errors as of `fit`."""
    require_float64()
    errors: dict[str, float] = {}
    if model == "contact":
        own = model_parameters(model, None if free is None else tuple(free), fixed)
        fixed, constraints, errors = split_held(own, fixed, constraints)
    if isinstance(table, AmplitudeTable) and share:
        raise ValueError("`share` is about several tables: leave it out, or give more than one")
    known, problem, measurement = task_of(
        table, model, share=share, free=free, fixed=fixed, constraints=constraints, effects=effects
    )
    amplitudes = int(np.asarray(measurement.rows.measured).sum())
    if amplitudes < len(problem.own):
        raise ValueError(
            f"{table.source}: {amplitudes} measured amplitude{'s' if amplitudes != 1 else ''} cannot determine the "
            f"{len(problem.own)} parameters of the model {model!r}; measure at other drives, orders or offsets too"
        )
    begin = starts(problem, measurement)[0]
    stated = Objective(measurement, problem, robust=robust)
    needed = *programs_of_search(begin, measurement, problem), lambda: warm_up_steps(len(problem.names))
    with compiling(*programs_of_laws(begin, measurement, problem), first=needed):
        objective, minimum, model_errors, refused = minimum_with_model_errors(stated)
    scale = None
    if scale_errors:
        objective, minimum, scale = rescale_errors(objective, minimum, len(problem.own))
    settings = {
        "model": model,
        "error_scale": scale,
        "robust": ROBUST if robust else None,
        "constraints": known,
        "free": list(problem.own),
        "fixed": dict(fixed or {}),
        "effects": list(effects) if model == "contact" else None,
        "held": held_of(problem.own, tuple(effects), fixed or {}, errors) if model == "contact" else (),
    }
    if isinstance(table, SeveralTables):
        settings["share"] = list(share)
    return Found(stated, objective, minimum, model_errors, settings, refused)


def summarise(table: AmplitudeTable | SeveralTables, found: Found) -> FitResult:
    """Return errors, intervals, checks and verdict of a minimum."""
    estimate = estimate_of(table, found)
    other = other_minimum(estimate)
    evidence = evidence_of(estimate, other)
    # Errors that assume the model would be confident numbers about a law that is not there.
    explained = not misfits(evidence)
    if explained:
        parameters = parameters_with_intervals(estimate)
        if other is not None:
            theirs = parameters_with_intervals(other)
            parameters = {name: parameter.containing(theirs[name]) for name, parameter in parameters.items()}
        evidence = replace(evidence, parameters=parameters)
    return result_of(estimate, other, evidence, explained=explained)


_HARDLY_TOLD, _LOOKED_AT = 4.0, 30.0
"""Rise of chi2 over the best minimum up to which another one may be the true one; and the rise up to which another end
of the search is minimised further, where impacts last, before that is decided."""


def other_minimum(estimate: FitEstimate) -> FitEstimate | None:
    """Return another minimum that the data hardly tell from the best one, None if there is none."""
    at, found, problem = estimate.at, estimate.at.found, estimate.at.problem
    errors = _errors(at.covariance)
    errors = np.where(np.isfinite(errors) & (errors > 0.0), errors, np.inf)

    def apart(values: Float[np.ndarray, "n p"]) -> Bool[np.ndarray, " n"]:
        return np.max(np.abs(values - at.values) / errors, axis=1) > 5.0

    ends = found.minimum.ends[apart(found.minimum.ends)]
    if not ends.size:
        return None
    # where impacts last, these ends come from stated errors and a robust loss: take chi2 with the errors as used
    chi2 = np.sum(found.objective.residual(ends) ** 2, axis=1)
    place = lowest(chi2)
    if not chi2[place] < at.chi2 + (_LOOKED_AT if problem.lasting else _HARDLY_TOLD):
        return None
    here = problem.coordinates(ends[place])
    minimum = replace(found.minimum, coordinates=here, ends=ends[place][None], chi2=chi2[place][None])
    if problem.lasting:
        minimum = settle(found.objective, minimum)
    if not apart(problem.values(minimum.coordinates)[None]).any():
        return None
    other = estimate_of(at.table, replace(found, minimum=minimum))
    above = min(other.at.chi2 - at.chi2, other.chi2 - estimate.chi2)
    return other if above < _HARDLY_TOLD else None


def evidence_of(estimate: FitEstimate, other: FitEstimate | None) -> Evidence:
    """Return all that the verdict looks at, the parameters without errors and intervals yet.

    A new ground for an invalid fit is a field of `Evidence` that is set here, and a rule in `fitting/fits/verdict.py`.
    """
    at, problem, rows = estimate.at, estimate.at.problem, estimate.rows
    robust, scale = at.found.objective.robust, at.settings["error_scale"]
    judged = at.freedom > 0 and scale is None and not robust
    unexplained = [Interval(None, None, UNEXPLAINED)] * len(at.values)
    discrepancy = None if estimate.after is None else estimate.after[1]
    unwidened = None
    if estimate.runs is not None:
        unwidened = np.where(np.isfinite(rows.residual), estimate.runs.residual[: at.table.rows], np.nan)
    return Evidence(
        table=at.table,
        parameters=_parameters(estimate, np.full(len(at.values), np.inf), unexplained),
        convergence=at.convergence,
        rows=rows,
        chi2=estimate.chi2,
        freedom=at.freedom,
        p_value=chi2_tail(estimate.chi2, at.freedom) if judged else float("nan"),
        other_minimum=None if other is None else (dict(zip(problem.names, other.values, strict=True)), other.chi2),
        error_scale=scale,
        robust=robust,
        correlations=_correlations(estimate.covariance),
        untabulated=tuple(np.flatnonzero(untabulated(at.objective, at.values, at.speeds)).tolist()),
        contact_share=estimate.contact_share,
        refused=at.found.refused,
        contact=problem.model == "contact",
        pulls=tuple(pull.p_value for pull in estimate.tables or ()),
        run=(0.0, 0.0) if estimate.runs is None else (estimate.runs.before, estimate.runs.beside),
        short=0.0 if discrepancy is None else discrepancy.short,
        held=() if discrepancy is None else tuple(effect.held for effect in discrepancy.held),
        unwidened=unwidened,
        independent_residual=estimate.independent_residual,
        stuck=estimate.stuck,
        courses=courses_along_rows(at),
    )


def parameters_with_intervals(estimate: FitEstimate) -> dict[str, FittedParameter]:
    """Return the parameters with their errors and, where all are determined, profile intervals.

    Intervals are profiled at the minimum. After a step from value x and error s to x' and s', an end e of an interval
    becomes x' + (s'/s)(e - x).
    """
    at, errors, before = estimate.at, _errors(estimate.covariance), _errors(estimate.at.covariance)
    if not np.all(np.isfinite(errors)) or not np.all(np.isfinite(at.covariance)):
        # With one parameter adrift there is no minimum to follow for the others.
        nothing = Interval(None, None, "the data do not determine the parameters")
        return _parameters(estimate, errors, [nothing] * len(errors))
    intervals = profile_intervals(at.objective, at.values, at.covariance, at.chi2)
    if estimate.after is not None:
        for i, profile in enumerate(intervals):
            # at a bound the closest formula has no error of its own
            growth = errors[i] / before[i] if at.free[i] and before[i] > 0.0 else 1.0
            moved = profile.moved(at.values[i], estimate.values[i], growth)
            intervals[i] = within_range(at.problem.parameters[i], moved)
    return _parameters(estimate, errors, intervals)


def _parameters(
    estimate: FitEstimate, errors: Float[np.ndarray, " k"], intervals: Sequence[Interval]
) -> dict[str, FittedParameter]:
    """Return the parameters with errors and intervals."""
    at, problem = estimate.at, estimate.at.problem
    parameters = {}
    for i, (name, interval) in enumerate(zip(problem.names, intervals, strict=True)):
        parameters[name] = FittedParameter(
            value=float(estimate.values[i]),
            unit=parameter_called(name).unit,
            standard_error=float(errors[i]) if at.free[i] and np.isfinite(errors[i]) else None,
            interval95=(interval.low, interval.high),
            interval_reason=interval.reason,
            interval_kind=None,
            undetermined=not np.isfinite(estimate.covariance[i, i]),
            at_bound=not bool(at.free[i]),
            constraint=at.constraints.get(name),
        )
    return parameters


_PACKAGES = ("afm-jax", "jax", "optax", "numpy")


def result_of(estimate: FitEstimate, other: FitEstimate | None, evidence: Evidence, *, explained: bool) -> FitResult:
    """Return the result of a fit: the law and its loss with their bands, and the verdict.

    Args:
        estimate: values and law.
        other: of another minimum that the data hardly tell from it: bands hold it, too; None: there is none.
        evidence: what the verdict looks at.
        explained: the model explains the amplitudes; else nothing has errors.
    """
    at, problem = estimate.at, estimate.at.problem
    shown = estimate.covariance if explained else np.full_like(estimate.covariance, np.inf)
    law = holding(at.law(shown, estimate.after), None if other is None else other.law)
    reasons, warnings = judge_fit(evidence)
    common = [i for i, name in enumerate(problem.names) if not is_of_one_table(name)]
    loss: Loss | None = None
    if np.isfinite(at.speeds).any():
        formula = None
        if problem.model != "contact":
            formula = at.settings["fixed"] | {name: known.value for name, known in evidence.parameters.items()}
        reached = speed_range(estimate.rows.approach_speed_nm_per_us[estimate.rows.used])
        loss = loss_of(law, reached, at.table.mass_ng, evidence.parameters, formula)
    return FitResult(
        model=problem.model,
        parameters={name: known for name, known in evidence.parameters.items() if not is_of_one_table(name)},
        correlations=_correlations(shown)[np.ix_(common, common)],
        chi2=estimate.chi2,
        degrees_of_freedom=at.freedom,
        p_value=evidence.p_value,
        aic=at.chi2 + 2.0 * len(at.values),
        valid=not reasons,
        reasons=reasons,
        warnings=warnings,
        law=law_with_band(
            law,
            at.speeds,
            lasting=problem.lasting,
            formula=estimate.formula,
            mass_ng=at.table.mass_ng,
            origin=f"{problem.model} fitted to {at.table.source}",
        ),
        loss=loss,
        rows=estimate.rows,
        convergence=at.convergence,
        table=at.table,
        settings=at.settings,
        versions={name: version_of(name) for name in _PACKAGES},
        tables=_fitted_tables(estimate, evidence.parameters),
    )


def _fitted_tables(estimate: FitEstimate, parameters: dict[str, FittedParameter]) -> tuple[FittedTable, ...]:
    """Return what there is to say of each of several tables; nothing of one."""
    table, rows, law = estimate.at.table, estimate.rows, estimate.at.free_law
    if not isinstance(table, SeveralTables):
        return ()
    pulls = [Pull(np.nan, np.nan, np.full(len(law), np.nan), np.nan)] * len(table.labels)
    if estimate.tables is not None:
        pulls = estimate.tables
    fitted = []
    for t, (member, label, pull) in enumerate(zip(table.tables, table.labels, pulls, strict=True)):
        mine = table.number == t
        nuisances = {name: name_of_table(name, label) for name in NUISANCE_NAMES}
        fitted.append(
            FittedTable(
                source=member.source,
                name=label,
                rows=member.rows,
                used=int(rows.used[mine].sum()),
                chi2=pull.chi2,
                readings=int(np.isfinite(rows.residual[mine]).sum()),
                pull=_or_none(pull.pull),
                p_value=_or_none(pull.p_value),
                pulls={name: _or_none(size) for name, size in zip(law, pull.pulls, strict=True)},
                nuisances={name: parameters[key] for name, key in nuisances.items() if key in parameters},
            )
        )
    return tuple(fitted)


def _or_none(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def _errors(covariance: Float[np.ndarray, "p p"]) -> Float[np.ndarray, " p"]:
    return np.sqrt(np.diag(covariance))


def _correlations(covariance: Float[np.ndarray, "p p"]) -> Float[np.ndarray, "p p"]:
    error = _errors(covariance)
    known = np.isfinite(error) & (error > 0.0)
    safe = np.where(known, error, 1.0)
    matrix = np.where(np.isfinite(covariance), covariance, 0.0) / np.outer(safe, safe)
    return np.where(np.outer(known, known), matrix, np.nan)
