"""From a minimum to an estimate: one linear step to the law with the model discrepancy, its errors and predictions.

At the minimum of chi2 the model is assumed to be exact. Where impacts last, `estimate_of` adds what the model leaves
out (`discrepancy`), as unknowns with priors beside the parameters: as much of the linear step as lowers chi2, computed
and not linearised, leads to the law. Of several tables it also says how far each one's law is from that of the others.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from afm_jax.impact.law import ImpactLaw, Law, TabulatedLaw
from afm_jax.solve.lanes import compiled_quickly
from fitting.fits.discrepancy import ModelDiscrepancy, effects_of_held, with_runs
from fitting.fits.intervals import Convergence, at_bound, check_minimum, covariance
from fitting.fits.law_after import (
    LAW_POINTS,
    ClosestMember,
    ModelLaw,
    law_before,
    member_after,
    points_of_law,
    speed_range,
)
from fitting.fits.minimum import ATTRACTED, Minimum, ModelErrors
from fitting.fits.objective import ROBUST, Objective, soft_square
from fitting.fits.result import FittedRows, table_of_law
from fitting.fits.several import Pull, parts_of, pulls_of
from fitting.fits.step import (
    PARTS_AT_ONCE,
    Descended,
    LinearStep,
    StepRows,
    StepSystem,
    descending_part,
    longest_run,
    rows_of_fit,
    settled_step,
    system_of,
)
from fitting.forward import Linearised, Predicted, predict
from fitting.models import Held, Measurement, Problem, readings_of
from fitting.tables.several import SeveralTables
from fitting.tables.table import AmplitudeTable


@dataclass(frozen=True)
class Found:
    """A minimum before it is summarised.

    Attributes:
        stated: the objective with the errors as stated.
        objective: with the errors as used: the model's own added, rows excluded.
        minimum: of it.
        model_errors: of the rows.
        settings: every option of the fit.
        refused: hardly a row of the table is one that a law of impacts can be read off.
    """

    stated: Objective
    objective: Objective
    minimum: Minimum
    model_errors: ModelErrors
    settings: dict[str, Any]
    refused: bool = False


class AtMinimum(NamedTuple):
    """What the model says at a minimum, assumed to be exact.

    Attributes:
        table: the table that is fitted, or all of several.
        found: the minimum.
        objective: follows each row's orbit from where it is at the minimum: from here on orbits move only a little.
        values: of the parameters.
        free: which of them are not at their bound.
        convergence: what the checks of the minimum found.
        linear: residuals, slopes and predictions there, with every orbit searched for.
        residual: of the readings, plain, row by row.
        chi2: the sum of squares.
        covariance: of the values.
        rows: measured and predicted amplitudes.
        speeds: approach speeds in nm/us of the rows that are used, NaN elsewhere.
    """

    table: AmplitudeTable | SeveralTables
    found: Found
    objective: Objective
    values: Float[np.ndarray, " p"]
    free: Bool[np.ndarray, " p"]
    convergence: Convergence
    linear: Linearised
    residual: Float[np.ndarray, "rows k"]
    chi2: float
    covariance: Float[np.ndarray, "p p"]
    rows: FittedRows
    speeds: Float[np.ndarray, " rows"]

    @property
    def problem(self) -> Problem:
        """The model and its parameters."""
        return self.objective.problem

    @property
    def settings(self) -> dict[str, Any]:
        """Every option of the fit."""
        return self.found.settings

    @property
    def constraints(self) -> dict[str, tuple[float, float]]:
        """What is known beforehand: value and standard error by parameter."""
        return dict(self.settings["constraints"])

    @property
    def data(self) -> int:
        """How many numbers are compared: readings, rows without orbit, and what is known beforehand."""
        rows = self.found.objective.measurement.rows
        return int(np.asarray(rows.measured).sum()) + int(np.asarray(rows.no_orbit).sum()) + len(self.constraints)

    @property
    def freedom(self) -> int:
        """The degrees of freedom: numbers compared, minus parameters fitted."""
        return self.data - len(self.values)

    @property
    def free_law(self) -> list[str]:
        """Names of the law's parameters that are not at their bound."""
        return [name for name, free in zip(self.problem.own, self.free, strict=False) if free]

    def law(self, covariance: Float[np.ndarray, "k k"], after: tuple[LinearStep, ModelDiscrepancy] | None) -> ModelLaw:
        """Return the law after a step from the minimum, with a covariance of its parameters."""
        return ModelLaw(self.problem, self.objective.measurement, self.values, covariance, after)


class FitEstimate(NamedTuple):
    """The law, values and errors of a fit, with the model discrepancy where there is one.

    Attributes:
        at: the minimum that the step was taken from.
        values: of the parameters of the model's formula that is closest to the law.
        covariance: of these, with what the formula leaves out.
        chi2: with the model discrepancy.
        rows: measured and predicted amplitudes of the law.
        independent_residual: residuals in errors without the most likely part that rows share: remainders of the
            corrections, and deviations of the tables' laws.
        after: the step, as much of it as lowers chi2, and the discrepancy that it leads to; None: there is none.
        stuck: chi2 that no part of the step lowers, and what the whole step takes it to to first order; None elsewhere.
        runs: what was found of residuals that run together over the speed.
        contact_share: largest share of a drive's period that the tip is in contact.
        tables: what several tables say of one another.
    """

    at: AtMinimum
    values: Float[np.ndarray, " p"]
    covariance: Float[np.ndarray, "p p"]
    chi2: float
    rows: FittedRows
    independent_residual: Float[np.ndarray, "rows k"]
    after: tuple[LinearStep, ModelDiscrepancy] | None = None
    stuck: tuple[float, float] | None = None
    runs: "Runs | None" = None
    contact_share: float = 0.0
    tables: list[Pull] | None = None

    @property
    def law(self) -> ModelLaw:
        """The law with its errors."""
        return self.at.law(self.covariance, self.after)

    @property
    def formula(self) -> ImpactLaw | None:
        """The model's formula that is closest to the law after the step; None of a contact, which has none."""
        problem, fixed = self.at.problem, self.at.objective.measurement.fixed
        if problem.model == "contact":
            return None
        return problem.law(jnp.asarray(self.at.values if self.after is None else self.values), fixed)


class Runs(NamedTuple):
    """Residuals that run together over the approach speed, and what was added to the discrepancy for them.

    Attributes:
        before: by how many standard deviations they do.
        beside: by how many beside what that added to the discrepancy.
        residual: of the readings without that addition.
    """

    before: float
    beside: float
    residual: Float[np.ndarray, "rows k"]


def estimate_of(table: AmplitudeTable | SeveralTables, found: Found) -> FitEstimate:
    """Return the law, values and errors that a minimum stands for, with the model discrepancy where impacts last."""
    at = at_minimum(table, found)
    estimate = FitEstimate(at, at.values, at.covariance, at.chi2, at.rows, at.rows.residual)
    rows = _rows_to_step_from(at)
    if rows is None:
        return estimate
    discrepancy, system, runs = _discrepancy_of(at, rows)
    tables = _compare_tables(at, system)
    used = np.isfinite(at.speeds)
    # Hertz time in us times the drive's frequency in kHz; 1e-3 makes it a share of the period
    contact_share = float(np.max(1e-3 * rows.hertz_time[: used.size][used] * table.drive_frequency_khz[used]))
    estimate = estimate._replace(runs=runs, tables=tables, contact_share=contact_share)
    if not at.problem.lasting:
        return estimate

    def predicted(steps: list[LinearStep]) -> Predicted:
        return _predicted_after(at, steps, discrepancy)

    part = settled_step(descending_part(system, predicted), system, predicted)
    return _after_step(estimate, part, discrepancy, system)


def at_minimum(table: AmplitudeTable | SeveralTables, found: Found) -> AtMinimum:
    """Return what the model says at a minimum: residuals, slopes, covariance, and whether it is a minimum."""
    searching = found.objective
    values = searching.problem.values(found.minimum.coordinates)
    objective = searching.following(values)
    free = ~at_bound(objective, values)
    convergence = check_minimum(objective, found.minimum.coordinates, free)
    linear = searching.at_values(values[None])
    residual = searching.misfit(linear)
    rows = _rows_at(table, found, linear, residual)
    return AtMinimum(
        table=table,
        found=found,
        objective=objective,
        values=values,
        free=free,
        convergence=convergence,
        linear=linear,
        residual=residual,
        chi2=float(np.sum(np.asarray(linear.residual)[0] ** 2)),
        covariance=covariance(objective, values, free),
        rows=rows,
        speeds=np.where(rows.used, rows.approach_speed_nm_per_us, np.nan),
    )


def _rows_at(
    table: AmplitudeTable | SeveralTables, found: Found, linear: Linearised, residual: Float[np.ndarray, "rows k"]
) -> FittedRows:
    """Return the rows of a table beside what the model predicts for them at the minimum."""
    count, columns = table.rows, found.objective.measurement.rows
    prediction: Any = jax.tree.map(lambda leaf: np.asarray(leaf)[0, :count], linear.prediction)
    used, exists = np.asarray(columns.measured)[:count], prediction.orbits > 0
    read, stated = readings_of(table)[0], np.asarray(found.stated.measurement.rows.measured)[:count]
    reasons = found.model_errors.reasons[:count].copy()
    reasons[np.isfinite(read).any(axis=1) & ~stated.any(axis=1)] = ATTRACTED
    predicted = np.where(exists[:, None], prediction.amplitude_nm, np.nan)
    measured = np.where(used | (reasons != "")[:, None], read, np.nan)
    error = np.where(used, np.asarray(columns.error_nm)[:count], np.nan)
    phases = {}
    if measured.shape[1] > 2:
        phases = {
            "predicted_phase_deg": predicted[:, 2],
            "measured_phase_deg": measured[:, 2],
            "phase_error_deg": error[:, 2],
        }
    return FittedRows(
        predicted_nm=predicted[:, :2],
        measured_nm=measured[:, :2],
        residual=np.where(used, residual[:count], np.nan),
        error_nm=error[:, :2],
        model_error=found.model_errors.model_error[:count],
        used=np.asarray(used.any(axis=1)),
        set_aside=(reasons != "").astype(bool),
        approach_speed_nm_per_us=np.where(exists, prediction.approach_speed_nm_per_us, np.nan),
        orbits=prediction.orbits,
        near_fold=prediction.near_fold,
        reasons=tuple(reasons.tolist()),
        **phases,
    )


def _rows_to_step_from(at: AtMinimum) -> StepRows | None:
    """Return the rows as the linear step sees them; None where there is nothing to step to.

    There is nothing for instantaneous laws of one table, for a law that is refused, and without finite slopes.
    """
    joint = at.found.objective.measurement.joint
    if not (at.problem.lasting or joint) or at.found.refused or not np.isfinite(at.speeds).any():
        return None
    scale = at.settings["error_scale"] or 1.0
    rows = rows_of_fit(at.found.stated, at.objective, at.values, at.found.model_errors, scale)
    return rows if all(np.isfinite(part).all() for part in (rows.residual, rows.jacobian, *rows.slopes)) else None


def _discrepancy_of(at: AtMinimum, rows: StepRows) -> tuple[ModelDiscrepancy, StepSystem, Runs | None]:
    """Return what the model leaves out, wider where residuals run together over the speed, and the rows with it."""
    problem, values = at.problem, at.settings["fixed"] | dict(zip(at.problem.names, at.values.tolist(), strict=True))
    mass = float(at.found.stated.measurement.cantilever.mass_ng)
    discrepancy = ModelDiscrepancy(problem, values, speed_range(at.speeds), mass)
    if problem.model == "contact":
        held = tuple(Held(*one) for one in at.settings.get("held", ()))
        effects = effects_of_held(held, values, problem.effects, mass, discrepancy.speeds)
        discrepancy = replace(discrepancy, held=effects)
    system = system_of(rows, discrepancy, at.free)
    if not problem.lasting:
        return discrepancy, system, None
    before = beside = longest_run(rows, system)
    residual = system.step().residual.reshape(rows.measurement_error.shape)
    discrepancy = with_runs(discrepancy, before)
    if discrepancy.short:
        system = system_of(rows, discrepancy, at.free)
        beside = longest_run(rows, system)
    return discrepancy, system, Runs(before, beside, residual)


def _compare_tables(at: AtMinimum, system: StepSystem) -> list[Pull] | None:
    """Return the pulls of several tables on the law; None of one table."""
    measurement = at.found.objective.measurement
    joint, table = measurement.joint, measurement.rows.table
    if joint is None or table is None:
        return None
    return pulls_of(parts_of(system, table, joint.place, len(at.problem.own)))


def _after_step(
    estimate: FitEstimate, part: Descended, discrepancy: ModelDiscrepancy, system: StepSystem
) -> FitEstimate:
    """Return the estimate with law, values, errors and predictions after the part of a step that lowers chi2."""
    at, step, count = estimate.at, part.step, estimate.at.table.rows
    member = _closest_member(at, step, discrepancy)
    if member is None:
        names = len(at.values)
        member = ClosestMember(step.values[:names], step.covariance[:names, :names])
    misfit: Any = part.predicted.misfit[0]
    chi2 = system.chi2(step, misfit.ravel())
    if at.found.objective.robust:
        chi2 = float(np.sum(soft_square(np.append(misfit, system.rest(step)), ROBUST)))
    used = np.isfinite(at.rows.residual)
    prediction: Any = jax.tree.map(lambda leaf: np.asarray(leaf)[0, :count], part.predicted.prediction)
    exists = prediction.orbits > 0
    readings = np.where(exists[:, None], prediction.amplitude_nm, np.nan)
    rows = replace(
        at.rows,
        residual=np.where(used, misfit[:count], np.nan),
        predicted_nm=readings[:, :2],
        predicted_phase_deg=None if at.rows.predicted_phase_deg is None else readings[:, 2],
        approach_speed_nm_per_us=np.where(exists, prediction.approach_speed_nm_per_us, np.nan),
        orbits=np.where(exists, at.rows.orbits, 0),
    )
    independent = system.alone(misfit.ravel()).reshape(misfit.shape)[:count]
    return estimate._replace(
        values=member.values,
        covariance=member.covariance,
        chi2=chi2,
        rows=rows,
        independent_residual=np.where(used, independent, np.nan),
        after=(step, discrepancy),
        stuck=part.stuck,
    )


def _closest_member(at: AtMinimum, step: LinearStep, discrepancy: ModelDiscrepancy) -> ClosestMember | None:
    speeds = at.speeds[np.isfinite(at.speeds)]
    return member_after(step, discrepancy, at.objective.measurement, at.values, speeds, at.free)


def _predicted_after(at: AtMinimum, parts: list[LinearStep], discrepancy: ModelDiscrepancy) -> Predicted:
    """Return what the laws after parts of the step predict, with the instrument after it."""
    measurement, problem = at.objective.measurement, at.problem
    values = np.array([part.values[: len(problem.names)] for part in parts])
    laws = [_tabulated_after(at, part, discrepancy) for part in parts]
    speeds: Any = at.linear.prediction.approach_speed_nm_per_us[0]
    exists = (np.asarray(at.linear.prediction.orbits)[0] > 0) & np.isfinite(speeds)
    safe = jnp.asarray(np.where(exists, speeds, 100.0))
    near = [np.where(exists, np.asarray(coordinates(law, safe)), np.nan) for law in laws]
    stacked = jax.tree.map(lambda *leaves: np.stack(leaves), *laws)
    return predict(values, stacked, measurement, problem, np.array(near))


def programs_of_laws(
    values: Float[np.ndarray, " p"], measurement: Measurement, problem: Problem
) -> list[Callable[[], object]]:
    """Return what compiles the programs that make and compare laws after a search, or reads them from the cache.

    Args:
        values: some values of the parameters.
        measurement: what the laws will be compared with.
        problem: the model.
    """
    speeds = np.geomspace(20.0, 200.0, LAW_POINTS)
    known: dict[str, Any] = {"capture_speed_nm_per_us": 10.0, "delay": None}
    late = -1.0 / speeds if problem.lasting else None
    if problem.lasting and problem.model != "contact":
        known["delay"] = problem.law(jnp.asarray(values), measurement.fixed).delay

    def predicted() -> None:
        law = table_of_law(speeds, 0.9 * speeds, late, **known)
        laws = jax.tree.map(lambda leaf: np.stack([leaf] * PARTS_AT_ONCE), law)
        nowhere = np.full((PARTS_AT_ONCE, len(measurement.rows.order)), np.nan)
        predict(np.tile(values, (PARTS_AT_ONCE, 1)), laws, measurement, problem, nowhere)

    def with_errors() -> None:
        errors = np.zeros((LAW_POINTS, 2, 1)), np.zeros(1)
        table_of_law(speeds, 0.9 * speeds, late, **known, errors=errors).to_dict()

    programs: list[Callable[[], object]] = [with_errors]
    if problem.lasting:
        programs.insert(0, predicted)
    if problem.model != "contact":
        # that of a contact takes its table, which takes long to compute
        programs.append(lambda: law_before(problem, measurement, values, speeds))
    return programs


def _tabulated_after(at: AtMinimum, step: LinearStep, discrepancy: ModelDiscrepancy) -> TabulatedLaw:
    """Return the law after a step as the table that predictions are made of."""
    speeds, points = points_of_law(at.law(at.covariance, (step, discrepancy)).at, at.speeds)
    delay = None
    if at.problem.model != "contact":
        member = _closest_member(at, step, discrepancy)
        values = step.values[: len(at.values)] if member is None else member.values
        delay = at.problem.law(jnp.asarray(values), at.objective.measurement.fixed).delay
    return table_of_law(speeds, *points.law, capture_speed_nm_per_us=points.capture, delay=delay)


_KINDS = (("peak amplitude", ""), ("lock-in amplitude", ""), ("phase", "degrees"))
"""What is read, and its unit if it does not drift by a share."""
_FOLLOWING = 4.0
"""Slope of the residuals along the rows, in its standard errors, beyond which it is not taken to be chance."""


def courses_along_rows(at: AtMinimum) -> dict[str, list[str]]:
    """Return which readings of a table follow its rows, and by how much from the first to the last, by its label.

    Only tables that say nothing of the order of their rows are looked at.
    """
    rows, courses = at.found.objective.measurement.rows, {}
    count, kinds = at.residual.shape
    predicted = np.asarray(at.linear.prediction.amplitude_nm)[0]
    scale, first = np.sqrt(max(1.0, at.chi2 / max(at.freedom, 1))), 0
    for table, label in zip(at.table.tables, at.table.labels, strict=True):
        mine, first = np.arange(first, first + table.rows), first + table.rows
        if table.rows_in_order_of_time:
            continue
        for kind, (name, unit) in zip(range(kinds), _KINDS, strict=False):
            size = 1.0 if unit else np.abs(predicted[mine, kind])
            course = np.linspace(-0.5, 0.5, table.rows) * size / np.asarray(rows.error_nm)[mine, kind]
            along = np.zeros((count, kinds))
            along[mine, kind] = np.where(np.asarray(rows.measured)[mine, kind], course, 0.0)
            slope, sigmas = _slope_along(at, along.ravel())
            if abs(sigmas) > _FOLLOWING * scale:
                drift = f"{slope:+.2g} {unit}" if unit else f"{100.0 * slope:+.2g} %"
                courses.setdefault(label, []).append(f"{name} {drift}")
    return courses


def _slope_along(at: AtMinimum, along: Float[np.ndarray, " n"]) -> tuple[float, float]:
    """Return the size of a course in the readings that the parameters cannot explain, and its size in standard errors.

    Least squares: a is the course less its projection on the residuals' Jacobian, and the size is -a.r/(a.a) with the
    standard error (a.a)^(-1/2), r being (predicted - measured)/error; 0 where the parameters explain the course.

    Args:
        at: the minimum.
        along: the course in errors of the readings, row by row, of size 1 from the first row to the last.
    """
    residual = np.nan_to_num(np.asarray(at.linear.residual)[0])
    column = np.append(along, np.zeros(residual.size - along.size))
    slopes = np.nan_to_num(np.asarray(at.linear.jacobian)[0])
    slopes = slopes / np.maximum(np.linalg.norm(slopes, axis=0), 1e-300)
    basis, size, _ = np.linalg.svd(slopes, full_matrices=False)
    basis = basis[:, size > 1e-10 * max(size[0], 1e-300)]
    apart = column - basis @ (basis.T @ column)
    length = float(apart @ apart)
    if length <= 1e-6 * float(column @ column):
        return 0.0, 0.0
    slope = -float(apart @ residual) / length
    return slope, slope * np.sqrt(length)


@compiled_quickly(level=0)
def coordinates(law: Law, speeds: Float[Array, " n"]) -> Float[Array, " n"]:
    """Return the coordinates of orbits at approach speeds in nm/us."""
    return law.coordinate(speeds)
