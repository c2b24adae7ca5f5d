"""The fit of an impact law to amplitude tables: screen, polish, check, and say whether to trust what was found.

A minimum amounts to values with errors and intervals, the law over the measured speeds with the band that its
parameters' errors leave, checks, and a verdict.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from afm_jax.checks import checked, require_float64
from afm_jax.contact.parameters import EFFECTS
from afm_jax.impact.lasting_impact import PulledImpact
from afm_jax.impact.law import ImpactLaw, Law, TabulatedLaw
from afm_jax.least_squares import chi2_tail
from afm_jax.version import version_of
from fitting.fits.discrepancy import (
    ClosestMember,
    Held,
    LawAfter,
    LawBefore,
    LinearStep,
    ModelDiscrepancy,
    StepRows,
    StepSystem,
    closest_member,
    containing,
    descending_part,
    effects_of_held,
    held_of,
    held_values,
    law_after,
    longest_run,
    root_of,
    rows_of_fit,
    seen_in_taps,
    settled_step,
    split_held,
    step_of,
    system_of,
    with_runs,
)
from fitting.fits.intervals import (
    END_OF_RANGE,
    Convergence,
    Interval,
    at_bound,
    check_minimum,
    covariance,
    profile_intervals,
    within_range,
)
from fitting.fits.loss import (
    EV_PER_AJ,
    NO_MASS,
    Loss,
    WithInterval,
    energy_lost,
    interval_of,
    nearness,
    rebound_by_formula,
    scaled,
)
from fitting.fits.minimum import (
    ATTRACTED,
    Minimum,
    ModelErrors,
    lost_rows,
    minimise,
    model_errors_of,
    rescale_errors,
    settle,
    starts,
    untabulated,
    with_inflated_errors,
)
from fitting.fits.objective import BATCH, ROBUST, SOFT, Objective, lowest, soft_square
from fitting.fits.result import FitResult, FittedLaw, FittedParameter, FittedRows, FittedTable, Scatter, table_of_law
from fitting.fits.several import Between, Pull, departures_of, parts_of, pulls_of, scatter_between
from fitting.fits.verdict import ASSUMED_ERROR_OF_Q, IMPROBABLE, Evidence, judge_fit, misfits
from fitting.forward import AnyImpact, Predicted, impact_at, predict, warm_up
from fitting.models import (
    Joint,
    Measurement,
    Problem,
    constraints_of,
    joint_measurement,
    measurement_of,
    readings_of,
)
from fitting.parameters import (
    DRIFT_NAMES,
    NUISANCE_NAMES,
    is_of_one_table,
    model_parameters,
    name_of_table,
    parameter_called,
)
from fitting.tables.several import SeveralTables
from fitting.tables.table import AmplitudeTable, as_table, in_other_units

_POINTS, _FEWEST_POINTS = 121, 4


def law_with_band(  # noqa: PLR0913
    problem: Problem,
    measurement: Measurement,
    values: Float[np.ndarray, " p"],
    covariance: Float[np.ndarray, "k k"],
    approach_speeds: Float[np.ndarray, " rows"],
    after: tuple[LinearStep, ModelDiscrepancy] | None = None,
    *,
    formula: ImpactLaw | None = None,
    mass_ng: float | None = None,
    origin: str = "",
    beside: Callable[[Float[np.ndarray, " n"]], LawAfter] | None = None,
) -> FittedLaw:
    """Return the law from 0.8 times the slowest to 1.2 times the fastest approach, with its linearised 95 % band.

    Args:
        problem: the model.
        measurement: gives the contact's fixed parameters.
        values: fitted values.
        covariance: of the values, or of those after the step; infinite entries give an open band (NaN).
        approach_speeds: of the rows' orbits in nm/us, NaN where a row has none.
        after: the step from these values with what the model leaves out; None: the model is taken at its word.
        formula: the model's that is closest after the step.
        mass_ng: of the tip; None: not known.
        origin: what the law comes from, in words.
        beside: another law at approach speeds in nm/us that may as well be the true one: the band holds its band too.
    """
    if after is None and problem.model != "contact":
        formula = problem.law(jnp.asarray(values), measurement.fixed)

    def law(speeds: Float[np.ndarray, " n"]) -> LawAfter:
        own = law_at(problem, measurement, values, covariance, speeds, after)
        return own if beside is None else containing(own, beside(speeds))

    speeds, found = points_of_law(law, approach_speeds)
    return FittedLaw(
        speeds,
        *found.law,
        capture_speed_nm_per_us=found.capture,
        delay=None if formula is None else formula.delay,
        lasting=problem.lasting,
        errors=(np.moveaxis(found.factor, 0, 1), found.capture_factor),
        mass_ng=mass_ng,
        origin=origin,
    )


def points_of_law(
    found: Callable[[Float[np.ndarray, " n"]], LawAfter], approach_speeds: Float[np.ndarray, " rows"]
) -> tuple[Float[np.ndarray, " points"], LawAfter]:
    """Return a law from 0.8 times the slowest to 1.2 times the fastest approach in nm/us, and beyond its capture.

    Args:
        found: the law at approach speeds.
        approach_speeds: of the rows, NaN where a row has none.
    """
    slow, fast = speed_range(approach_speeds)
    speeds = np.geomspace(0.8 * slow, 1.2 * fast, _POINTS)
    law = found(speeds)
    if np.count_nonzero(law.law[0] > 0.0) < _FEWEST_POINTS:
        # a law that captures nearly all of these tips
        speeds = np.geomspace(0.8 * slow, 3.0 * max(law.capture, fast), _POINTS)
        law = found(speeds)
    return speeds, law


def law_at(
    problem: Problem,
    measurement: Measurement,
    values: Float[np.ndarray, " p"],
    covariance: Float[np.ndarray, "k k"],
    speeds: Float[np.ndarray, " n"],
    after: tuple[LinearStep, ModelDiscrepancy] | None = None,
) -> LawAfter:
    """Return the law at approach speeds in nm/us; the other arguments as of `law_with_band`."""
    before = law_before(problem, measurement, values, speeds)
    if after is None:
        root = root_of(covariance)[: before.slope.shape[2]]
        return LawAfter(before.law, before.slope @ root, before.capture, before.capture_slope @ root)
    step, discrepancy = after
    moved = law_before(problem, measurement, step.values[: len(problem.names)], speeds)
    found = law_after(step, discrepancy, speeds, before, moved)
    if not np.all(np.isfinite(covariance)):
        unknown = [np.full_like(part, np.nan) for part in (found.factor, found.capture_factor)]
        return LawAfter(found.law, unknown[0], found.capture, unknown[1])
    return found


def law_before(
    problem: Problem, measurement: Measurement, values: Float[np.ndarray, " p"], speeds: Float[np.ndarray, " n"]
) -> LawBefore:
    """Return the law of fitted values at approach speeds in nm/us; the other arguments as of `law_with_band`."""
    impact, slopes = impact_at(values, measurement, problem)
    law, slope = jax.tree.map(np.asarray, law_and_slope(impact, slopes, speeds))
    count = speeds.size
    return LawBefore(law[:, :count], slope[:, :count], float(law[0, count]), slope[0, count])


def member_after(
    step: LinearStep,
    discrepancy: ModelDiscrepancy,
    measurement: Measurement,
    values: Float[np.ndarray, " p"],
    speeds: Float[np.ndarray, " n"],
    free: Bool[np.ndarray, " p"],
    *,
    computed: bool = True,
) -> ClosestMember | None:
    """Return the model's law that is closest to the law after a step; None where the step is all there is.

    Args:
        step: the step.
        discrepancy: by the model.
        measurement: gives the contact's fixed parameters.
        values: from which the step was taken.
        speeds: approach speeds in nm/us of the rows that are used.
        free: which of the values are not at their bound.
        computed: the law after the step is computed; False: to first order.
    """
    problem = discrepancy.problem
    if problem.model == "contact" or not problem.lasting:
        return None
    # one program for rows of any number up to that of a law's points
    filled = np.append(speeds, np.full(-speeds.size % _POINTS, speeds[-1]))
    before = law_before(problem, measurement, values, filled)
    there = before._replace(law=before.law[:, : speeds.size], slope=before.slope[:, : speeds.size])
    moved = None
    if computed:
        whole = law_before(problem, measurement, step.values[: len(problem.names)], filled)
        moved = whole._replace(law=whole.law[:, : speeds.size], slope=whole.slope[:, : speeds.size])
    return closest_member(step, discrepancy, speeds, there, free, moved)


def loss_of(
    found: Callable[[Float[np.ndarray, " n"]], LawAfter],
    measured: tuple[float, float],
    mass_ng: float | None,
    parameters: Mapping[str, FittedParameter],
    formula: Mapping[str, float] | None,
) -> Loss:
    """Return what impacts take: energies at measured speeds, and what the printed parameters say.

    Args:
        found: the law at approach speeds in nm/us.
        measured: slowest and fastest approach in nm/us.
        mass_ng: of the tip; None: not known.
        parameters: of the fit.
        formula: values of the model's formula, those that are held included; None: it has none.
    """
    three = np.geomspace(*measured, 3)
    # two digits, and within what was measured
    three = np.clip([float(f"{speed:.2g}") for speed in three], *measured)
    there = found(np.resize(three, _POINTS))
    error = np.linalg.norm(there.factor[0], axis=1)
    energies = [
        energy_lost(float(u), float(w), float(e), mass_ng)
        for u, w, e in zip(three, there.law[0, :3], error[:3], strict=True)
    ]
    r, epsilon = (
        WithInterval(one.value, one.interval95) if one is not None else None
        for one in (parameters.get("r"), parameters.get("epsilon"))
    )
    delta = None if epsilon is None or mass_ng is None else scaled(epsilon, 0.5 * mass_ng)
    off = None
    if formula is not None:
        speeds = np.geomspace(*measured, _POINTS)
        off = nearness(speeds, found(speeds).law[0], rebound_by_formula(formula, speeds))
    return Loss(
        energies=tuple(dict.fromkeys(energies)),
        energies_reason=NO_MASS if mass_ng is None else None,
        r=r,
        epsilon_nm2_per_us2=epsilon,
        delta_aj=delta,
        delta_ev=None if delta is None else scaled(delta, EV_PER_AJ),
        formula_off=None if off is None else off.off,
        formula_off_at_nm_per_us=None if off is None else off.at_nm_per_us,
        capture_speed_nm_per_us=interval_of(there.capture, float(np.linalg.norm(there.capture_factor)), lowest=0.0),
    )


def speed_range(approach_speeds: Float[np.ndarray, " rows"]) -> tuple[float, float]:
    """Return slowest and fastest of the known speeds; 1.25 and 83 nm/us where there is none."""
    known = approach_speeds[np.isfinite(approach_speeds)]
    return (float(known.min()), float(known.max())) if known.size else (1.25, 250.0 / 3.0)


@jax.jit
def law_and_slope(
    impact: AnyImpact, slopes: AnyImpact, speeds: Float[Array, " n"]
) -> tuple[Float[Array, "2 n+1"], Float[Array, "2 n+1 p"]]:
    """Return rebound speeds and delays at approach speeds, and their derivatives by the parameters.

    The last column is that of the capture speed, twice.

    Args:
        impact: what is fitted.
        slopes: its derivatives by the parameters, along a first axis.
        speeds: in nm/us.
    """

    def law(impact):
        if isinstance(impact, Law):
            capture = jnp.full((2, 1), impact.capture_speed_nm_per_us)
            found = jnp.stack([impact.rebound_speed(speeds), impact.collision_delay(speeds)])
            return jnp.concatenate([found, capture], axis=1)
        impact = impact.free if isinstance(impact, PulledImpact) else impact
        found = jax.vmap(impact.speeds)(speeds)
        # below the table the contact captures
        free = speeds > impact.lowest
        there = jnp.stack([jnp.where(free, found.rebound, 0.0), jnp.where(free, found.delay, 0.0)])
        return jnp.concatenate([there, jnp.full((2, 1), impact.lowest)], axis=1)

    return law(impact), jax.vmap(lambda turn: jax.jvp(law, (impact,), (turn,))[1], out_axes=-1)(slopes)


@jax.jit
def coordinates(law: Law, speeds: Float[Array, " n"]) -> Float[Array, " n"]:
    """Return the coordinates of orbits at approach speeds in nm/us."""
    return law.coordinate(speeds)


def _untold_drifts(parameters: Mapping[str, FittedParameter]) -> list[str]:
    """Return a sentence where drifts along the rows are hardly told by anything but what is assumed of them."""
    untold = []
    for name, known in parameters.items():
        drift = parameter_called(name).name in DRIFT_NAMES
        if drift and known.constraint is not None and (known.standard_error or np.inf) > 0.5 * known.constraint[1]:
            untold.append(f"{name} = {known.constraint[0]:g} +- {known.constraint[1]:g}")
    if not untold:
        return []
    said = (
        f"Hardly told by the rows, which stand in order of time, only assumed: {', '.join(untold)}. Rows of the free "
        "tip before and after the others tell drifts; `--constrain` takes what is known of them."
    )
    return [said]


_PACKAGES = ("afm-jax", "jax", "optax", "numpy")
_KINDS = (("peak amplitude", ""), ("lock-in amplitude", ""), ("phase", "degrees"))
"""What is read, and its unit if it does not drift by a share."""
_FOLLOWING = 4.0
"""Standard errors of a course of the residuals along the rows beyond which it is no chance."""


@dataclass(frozen=True)
class Found:
    """A minimum before it is summarised: the objective with the errors as stated and as used, and the settings.

    ``refused``: hardly a row of the table is one that a law of impacts can be read off.
    """

    stated: Objective
    objective: Objective
    minimum: Minimum
    model_errors: ModelErrors
    settings: dict[str, Any]
    refused: bool = False


def summarise(table: AmplitudeTable | SeveralTables, found: Found) -> FitResult:
    """Return errors, intervals, checks and verdict of a minimum."""
    return _Summary(table, found).result()


_GROSS = 10.0
"""chi2 over degrees of freedom from which on other units are tried."""
_GRID = np.array([[r, epsilon] for r in (0.5, 0.7, 0.85, 0.93, 0.97, 0.99) for epsilon in (0.0, 30.0, 300.0, 3000.0)])
"""Values of r and epsilon over which the law of eq. 6 is looked at."""
_BETTER = 0.5
_TRIED = 6
"""Tables of several that are tried in other units: each takes a fit."""


def summarise_in_units(table: AmplitudeTable | SeveralTables, found: Found) -> FitResult:
    """Return the summary of a minimum; a table far from the model is tried in other units, and one that fits is named.

    Amplitudes in micrometres, peak to peak or rms, frequencies in Hz. The law of eq. 6 on a coarse grid says which of
    them is nearest; the model is fitted to that. Several tables are tried one by one, the first of them.
    """
    result = summarise(table, found)
    far = found.refused or not result.chi2 < _GROSS * max(result.degrees_of_freedom, 1)
    if result.valid or not far:
        return result
    reasons = []
    for one, label in zip(table.tables[:_TRIED], table.labels, strict=False):
        said = _other_units(one, label, found)
        if said:
            reasons.append(f"{said} Check the units." if one is table else f"{label}: {said} Check its units.")
    return replace(result, reasons=[*result.reasons, *reasons])


def _other_units(table: AmplitudeTable, label: str, found: Found) -> str:
    """Return in which other units a table fits the model of a fit by itself; nothing where it fits in none."""
    nearest, meant = min(
        ((_distance_from_law(one), (words, one)) for words, one in in_other_units(table)), key=lambda pair: pair[0]
    )
    if not nearest < _BETTER * _distance_from_law(table):
        return ""
    words, other = meant
    asked = {name: found.settings[name] for name in ("free", "fixed")}
    known = {
        parameter_called(name).name: pair
        for name, pair in found.settings["constraints"].items()
        if not is_of_one_table(name) or name == name_of_table(parameter_called(name).name, label)
    }
    model, effects = found.settings["model"], found.settings["effects"] or EFFECTS
    try:
        again = summarise(other, find_fit(other, model, effects=effects, constraints=known, **asked))
    except ValueError:
        return ""
    if not again.p_value >= IMPROBABLE:
        return ""
    return f"With {words} the model explains the table (chi2/dof = {again.chi2:.1f}/{again.degrees_of_freedom})."


def _distance_from_law(table: AmplitudeTable) -> float:
    """Return the soft objective of the law of eq. 6 at the best of a coarse grid of its parameters."""
    problem = Problem("law", ("r", "epsilon"), drive=table.drive)
    known = {} if table.quality_factor is None else {"quality_factor": (table.quality_factor, 1.0)}
    objective = Objective(measurement_of(table, problem, known), problem)
    return float(np.min(objective.screen(_GRID)))


_MUCH = 0.25
"""Share of a parameter's variance that comes of a held one from which it is said to hang on that."""
_HARDLY_TOLD, _LOOKED_AT = 4.0, 30.0
"""Rise of chi2 up to which another minimum may as well be the true one; and from where it is followed to find that."""


class _Summary:
    """Turns a minimum into a `FitResult`: the step with what the model leaves out, errors, intervals, checks, verdict.

    ``values``, ``covariance``, ``free`` and ``minimum_chi2`` are those of the minimum; ``ends``, ``spread`` and
    ``chi2``, of the ``parameters``, those after the step: of the model's law that is closest to the law after it.
    """

    def __init__(self, table: AmplitudeTable | SeveralTables, found: Found):
        objective, minimum, self.found = found.objective, found.minimum, found
        self.searching, self.table, self.minimum, self.model_errors = objective, table, minimum, found.model_errors
        self.settings, self.problem, self.stated = found.settings, objective.problem, found.stated
        self.refused = found.refused
        self.values = self.problem.values(minimum.coordinates)
        # orbits are followed from here on: only their places change a little
        self.objective = objective.following(self.values)
        self.free = ~at_bound(self.objective, self.values)
        self.convergence: Convergence = check_minimum(self.objective, minimum.coordinates, self.free)
        linear = self.searching.at_values(self.values[None])
        self.residual = np.asarray(linear.residual)[0]
        self.amplitude_residual = self.searching.misfit(linear)
        self.prediction = linear.prediction
        self.jacobian = np.asarray(linear.jacobian)[0]
        self.minimum_chi2 = float(np.sum(self.residual**2))
        self.constraints = dict(self.settings["constraints"])
        used = int(np.asarray(objective.measurement.rows.measured).sum())
        self.data = used + int(np.asarray(objective.measurement.rows.no_orbit).sum()) + len(self.constraints)
        self.freedom = self.data - len(self.values)
        self.covariance = covariance(self.objective, self.values, self.free)
        self.rows = self._rows()
        self.used_speeds = np.where(self.rows.used, self.rows.approach_speed_nm_per_us, np.nan)
        self.names, self.ends, self.spread = self.problem.names, self.values, self.covariance
        self.chi2, self.contact_share, self.run = self.minimum_chi2, 0.0, (0.0, 0.0)
        self.pulls: list[Pull] = []
        self.between: tuple[Between, Float[np.ndarray, "tables l"]] | None = None
        self.alone, self.system = self.rows.residual, None
        self.stuck: tuple[float, float] | None = None
        self.departing: Float[np.ndarray, "readings m"] | None = None
        self.step_rows: StepRows | None = None
        self.unbent: Float[np.ndarray, "rows k"] | None = None
        self.after = self._step()
        if self.after is not None:
            self._take(*self.after)

    def _step(self) -> tuple[LinearStep, ModelDiscrepancy] | None:
        """Return the step with what the model leaves out, and the scatter between tables; None where there is neither.

        Nor is there one without slopes.
        """
        joint, scattering = self.searching.measurement.joint, bool(self.settings.get("hierarchical"))
        if not (self.problem.lasting or joint) or self.refused or not np.isfinite(self.used_speeds).any():
            return None
        scale = self.settings["error_scale"] or 1.0
        rows = rows_of_fit(self.stated, self.objective, self.values, self.model_errors, scale)
        if not all(np.isfinite(part).all() for part in (rows.residual, rows.jacobian, *rows.slopes)):
            return None
        self.step_rows = rows
        used = np.flatnonzero(np.isfinite(self.used_speeds))
        # of the Hertz time, in us and kHz
        shares = 1e-3 * rows.hertz_time[used] * self.table.drive_frequency_khz[used]
        self.contact_share = float(shares.max())
        values = self.settings["fixed"] | dict(zip(self.problem.names, self.values.tolist(), strict=True))
        mass = float(self.stated.measurement.cantilever.mass_ng)
        discrepancy = ModelDiscrepancy(self.problem, values, speed_range(self.used_speeds), mass)
        if self.problem.model == "contact":
            held = tuple(Held(*one) for one in self.settings.get("held", ()))
            effects = effects_of_held(held, values, self.problem.effects, mass, discrepancy.speeds)
            if self.problem.pulled:
                effects = seen_in_taps(effects, self.objective, self.values)
            discrepancy = replace(discrepancy, held=effects)
        if self.problem.lasting and not self.problem.pulled and not scattering:
            run = longest_run(rows, discrepancy, self.free)
            self.unbent = step_of(rows, discrepancy, self.free).residual
            discrepancy = with_runs(discrepancy, run)
            self.run = run, longest_run(rows, discrepancy, self.free) if discrepancy.short else run
        self.system = system_of(rows, discrepancy)
        if joint is None:
            return step_of(rows, discrepancy, self.free), discrepancy
        departing = self._tables_compared(self.system, joint, scattering=scattering)
        if not (self.problem.lasting or departing):
            return None
        self.departing = departing[0] if departing else None
        self.system = self.system.with_unknowns(self.departing)
        step, *cautious = (step_of(rows, discrepancy, self.free, one) for one in departing or [None])
        return step._replace(covariance=(*cautious, step)[0].covariance), discrepancy

    def _tables_compared(
        self, system: StepSystem, joint: Joint, *, scattering: bool
    ) -> list[Float[np.ndarray, "readings m"]]:
        """Note the tables' pulls and scatter; return what departures of their laws do, most likely and cautious ones.

        There are none without scatter.
        """
        table: Any = self.searching.measurement.rows.table
        free = np.append(self.free, np.ones(system.jacobian.shape[1] - self.free.size, dtype=bool))
        own, departing = len(self.problem.own), []
        parts = parts_of(system, table, joint.place, free, own)
        if scattering:
            unit = departures_of(system, table, parts.law, np.ones(parts.law.size))
            between = scatter_between(parts_of(system, table, joint.place, free, own, unit))
            if np.isfinite(between.value).all():
                departing = [
                    departures_of(system, table, parts.law, size) for size in (between.value, between.cautious)
                ]
                parts = parts_of(system, table, joint.place, free, own, departing[0])
                departed = parts.solved()[1][-departing[0].shape[1] :].reshape(len(joint.drives), -1)
                self.between = between, departed * between.value
        self.pulls = pulls_of(parts)
        return departing

    def _take(self, step: LinearStep, discrepancy: ModelDiscrepancy) -> None:
        """Go on with the law, values, errors and predictions after the step, or after a part of it that lowers chi2."""
        assert self.system is not None  # noqa: S101
        system = self.system

        def look(parts: list[LinearStep]) -> Predicted:
            return self._predicted(parts, discrepancy)

        def again(beyond: Float[np.ndarray, " readings"]) -> LinearStep:
            assert self.step_rows is not None  # noqa: S101
            residual = self.step_rows.residual.copy()
            residual[: beyond.size] += beyond
            rows = self.step_rows._replace(residual=residual)
            return step_of(rows, discrepancy, self.free, self.departing)._replace(covariance=step.covariance)

        found = descending_part(step, system, look)
        if self.problem.lasting and not self.problem.pulled:
            found = settled_step(found, system, look, again)
        step, predicted, self.stuck = found
        self.after = step, discrepancy
        count = len(self.names)
        self.ends, self.spread = step.values[:count], step.covariance[:count, :count]
        member = self._closest_member(step, discrepancy)
        if member is not None:
            self.ends, self.spread = member.values, member.covariance
        rows, used = self.table.rows, np.isfinite(self.rows.residual)
        residual, there = predicted.misfit[0], predicted.prediction.orbits[0][:rows] > 0
        self.chi2 = system.chi2(step, residual.ravel())
        self.alone = np.where(used, system.alone(residual.ravel())[0].reshape(residual.shape)[:rows], np.nan)
        if self.searching.robust:
            self.chi2 = float(np.sum(soft_square(np.append(residual, system.rest(step)), ROBUST)))
        readings = np.where(there[:, None], predicted.prediction.amplitude_nm[0][:rows], np.nan)
        self.rows = replace(
            self.rows,
            residual=np.where(used, residual[:rows], np.nan),
            predicted_nm=readings[:, :2],
            predicted_phase_deg=None if self.rows.predicted_phase_deg is None else readings[:, 2],
            approach_speed_nm_per_us=np.where(there, predicted.prediction.approach_speed_nm_per_us[0][:rows], np.nan),
            orbits=np.where(there, self.rows.orbits, 0),
        )

    def _predicted(self, parts: list[LinearStep], discrepancy: ModelDiscrepancy) -> Predicted:
        """Return what the laws after parts of the step predict, with the instrument after it."""
        measurement, problem = self.objective.measurement, self.problem
        values = np.array([part.values[: len(problem.names)] for part in parts])
        if problem.pulled or not problem.lasting:
            # taps are no law of the free tip's speed, and instantaneous laws have no discrepancy
            size = measurement.rows.measured.shape
            found = []
            for one, part in zip(values, parts, strict=True):
                there = measurement._replace(fixed=discrepancy.fixed_after(part, measurement.fixed))
                plain = Objective(there, problem, near=self.objective.near).at_values(one[None])
                found.append(Predicted(plain.residual[:, : size[0] * size[1]].reshape(1, *size), plain.prediction))
            return jax.tree.map(lambda *leaves: np.concatenate(leaves), *found)
        laws = [self._law_after(part, discrepancy) for part in parts]
        speeds = self.prediction.approach_speed_nm_per_us[0]
        exists = (self.prediction.orbits[0] > 0) & np.isfinite(speeds)
        safe = jnp.asarray(np.where(exists, speeds, 100.0))
        near = [np.where(exists, np.asarray(coordinates(law, safe)), np.nan) for law in laws]
        both = jax.tree.map(lambda *leaves: np.stack(leaves), *laws)
        return predict(values, both, measurement, problem, np.array(near))

    def _law_after(self, step: LinearStep, discrepancy: ModelDiscrepancy) -> TabulatedLaw:
        """Return the law after a step as the table that predictions are made of."""

        def law(speeds: Float[np.ndarray, " n"]) -> LawAfter:
            measurement = self.objective.measurement
            return law_at(self.problem, measurement, self.values, self.covariance, speeds, (step, discrepancy))

        speeds, found = points_of_law(law, self.used_speeds)
        formula = self._formula(step, discrepancy)
        delay = None if formula is None else formula.delay
        return table_of_law(speeds, *found.law, capture_speed_nm_per_us=found.capture, delay=delay)

    def _formula(self, step: LinearStep, discrepancy: ModelDiscrepancy) -> ImpactLaw | None:
        """Return the formula that is closest to the law after a step; None of a contact, which has none."""
        if self.problem.model == "contact":
            return None
        member = self._closest_member(step, discrepancy)
        values = step.values[: len(self.problem.names)] if member is None else member.values
        return self.problem.law(jnp.asarray(values), self.objective.measurement.fixed)

    def result(self) -> FitResult:
        judged = self.freedom > 0 and self.settings["error_scale"] is None and not self.searching.robust
        p_value = chi2_tail(self.chi2, self.freedom) if judged else float("nan")
        errors = np.sqrt(np.diag(self.covariance))
        moved = ~self.free | ~np.isfinite(errors) | (np.abs(self.values - self.minimum.start) > 1e-3 * errors)
        moved = np.append(moved, np.ones(len(self.names) - len(moved), dtype=bool))
        unknown, rows = np.full(len(self.names), np.inf), self.rows
        missed = untabulated(self.objective, self.values, self.used_speeds)
        beside = self._beside(errors)
        evidence = Evidence(
            table=self.table,
            parameters=self._parameters(unknown, "the model does not explain the data", moved),
            convergence=self.convergence,
            rows=rows,
            chi2=self.chi2,
            freedom=self.freedom,
            p_value=p_value,
            autocorrelation=_autocorrelation(self.alone),
            other_minimum=None if beside is None else (dict(zip(beside.names, beside.ends, strict=True)), beside.chi2),
            error_scale=self.settings["error_scale"],
            lasting=self.problem.lasting,
            robust=self.searching.robust,
            correlations=_correlations(self.spread),
            untabulated=tuple(np.flatnonzero(missed).tolist()),
            contact_share=self.contact_share,
            refused=self.refused,
            contact=self.problem.model == "contact",
            tapped=self.problem.pulled,
            pulls=tuple(pull.p_value for pull in self.pulls),
            scattering=self.between is not None,
            run=self.run,
            short=0.0 if self.after is None else self.after[1].short,
            held=tuple(one.held for one in self.after[1].held) if self.after is not None else (),
            hanging=self._hanging(),
            unbent=None
            if self.unbent is None
            else np.where(np.isfinite(rows.residual), self.unbent[: self.table.rows], np.nan),
            independent_residual=self.alone,
            stuck=self.stuck,
        )
        # Errors that assume the model would be confident numbers about a law that is not there.
        explained = not misfits(evidence)
        shown_covariance = self.spread if explained else np.full_like(self.spread, np.inf)
        if explained:
            parameters = self._explained_parameters(moved)
            if beside is not None:
                other = beside._explained_parameters(moved)  # noqa: SLF001
                parameters = {name: one.containing(other[name]) for name, one in parameters.items()}
            evidence = replace(evidence, parameters=parameters)
        reasons, warnings = judge_fit(evidence)
        warnings += self._follow_rows() + _untold_drifts(evidence.parameters)
        common = [i for i, name in enumerate(self.names) if not is_of_one_table(name)]
        return FitResult(
            model=self.problem.model,
            parameters={name: one for name, one in evidence.parameters.items() if not is_of_one_table(name)},
            correlations=_correlations(shown_covariance)[np.ix_(common, common)],
            chi2=self.chi2,
            degrees_of_freedom=self.freedom,
            p_value=evidence.p_value,
            aic=self.minimum_chi2 + 2.0 * len(self.values),
            bic=self.minimum_chi2 + len(self.values) * float(np.log(self.data)),
            valid=not reasons,
            reasons=reasons,
            warnings=warnings,
            law=law_with_band(
                self.problem,
                self.objective.measurement,
                self.values,
                shown_covariance,
                self.used_speeds,
                self.after,
                formula=None if self.after is None else self._formula(*self.after),
                mass_ng=self.table.mass_ng,
                origin=f"{self.problem.model} fitted to {self.table.source}",
                beside=None if beside is None else beside.law_at,
            ),
            loss=self._loss(shown_covariance, evidence.parameters, beside),
            rows=rows,
            residual_autocorrelation=evidence.autocorrelation,
            convergence=self.convergence,
            table=self.table,
            settings=self.settings,
            versions={name: version_of(name) for name in _PACKAGES},
            tables=self._fitted_tables(evidence.parameters),
            scatter=self._scatter() if explained else {},
        )

    def _hanging(self) -> dict[str, tuple[str, ...]]:
        """Return which held parameters' errors are much of each fitted one's."""
        found: dict[str, tuple[str, ...]] = {}
        if self.after is None or not self.after[1].held or self.step_rows is None:
            return found
        discrepancy, whole = self.after[1], np.diag(self.spread)
        for one in discrepancy.held:
            rest = replace(discrepancy, held=tuple(other for other in discrepancy.held if other is not one))
            without = np.diag(step_of(self.step_rows, rest, self.free).covariance)
            for i, name in enumerate(self.problem.own):
                if np.isfinite(whole[i]) and whole[i] - without[i] > _MUCH * whole[i]:
                    found[name] = (*found.get(name, ()), one.held.name)
        return found

    def _follow_rows(self) -> list[str]:
        """Return a sentence for each table whose residuals follow its rows, though it says nothing of their order."""
        count, kinds = self.amplitude_residual.shape
        said, first = [], 0
        scale = np.sqrt(max(1.0, self.minimum_chi2 / max(self.freedom, 1)))
        for table, label in zip(self.table.tables, self.table.labels, strict=True):
            rows, first = np.arange(first, first + table.rows), first + table.rows
            found = []
            for kind, (name, unit) in zip(range(kinds), _KINDS, strict=False):
                along = np.zeros((count, kinds))
                size = 1.0 if unit else np.abs(np.asarray(self.prediction.amplitude_nm)[0, rows, kind])
                error = np.asarray(self.searching.measurement.rows.error_nm)[rows, kind]
                seen = np.asarray(self.searching.measurement.rows.measured)[rows, kind]
                along[rows, kind] = np.where(seen, np.linspace(-0.5, 0.5, table.rows) * size / error, 0.0)
                slope, sigmas = self._slope_along(along.ravel())
                if abs(sigmas) > _FOLLOWING * scale:
                    found.append(f"{name} {f'{slope:+.2g} {unit}' if unit else f'{100.0 * slope:+.2g} %'}")
            if found and not table.rows_in_order_of_time:
                several = f"{label}: " if len(self.table.labels) > 1 else ""
                said.append(
                    f"{several}Residuals follow the rows ({', '.join(found)} from the first to the last), as drifts "
                    "do. If the rows stand as they were measured, say `# rows = in order of time`: drifts are then "
                    "fitted along."
                )
        return said

    def _slope_along(self, along: Float[np.ndarray, " n"]) -> tuple[float, float]:
        """Return how far readings follow a course that the fit leaves them, and that in standard errors."""
        column = np.append(along, np.zeros(self.residual.size - along.size))
        slopes = np.nan_to_num(self.jacobian)
        slopes = slopes / np.maximum(np.linalg.norm(slopes, axis=0), 1e-300)
        basis, size, _ = np.linalg.svd(slopes, full_matrices=False)
        basis = basis[:, size > 1e-10 * max(size[0], 1e-300)]
        left = column - basis @ (basis.T @ column)
        length = float(left @ left)
        if length <= 1e-6 * float(column @ column):
            return 0.0, 0.0
        slope = -float(left @ np.nan_to_num(self.residual)) / length
        return slope, slope * np.sqrt(length)

    @property
    def _free_own(self) -> list[str]:
        """The law's parameters that are not at their bound."""
        return [name for name, free in zip(self.problem.own, self.free, strict=False) if free]

    def _scatter(self) -> dict[str, Scatter]:
        if self.between is None:
            return {}
        found = self.between[0]
        return {
            name: Scatter(float(value), (float(low), _or_none(high)), parameter_called(name).unit)
            for name, value, low, high in zip(self._free_own, *found[:3], strict=True)
        }

    def _fitted_tables(self, parameters: dict[str, FittedParameter]) -> tuple[FittedTable, ...]:
        """Return what there is to say of each of several tables; nothing of one."""
        if not isinstance(self.table, SeveralTables):
            return ()
        own = self._free_own
        nothing = Pull(np.nan, np.nan, np.full(len(own), np.nan), np.nan)
        told = []
        for t, (table, label) in enumerate(zip(self.table.tables, self.table.labels, strict=True)):
            mine, pull = self.table.number == t, self.pulls[t] if self.pulls else nothing
            named = {name: name_of_table(name, label) for name in NUISANCE_NAMES}
            told.append(
                FittedTable(
                    source=table.source,
                    name=label,
                    rows=table.rows,
                    used=int(self.rows.used[mine].sum()),
                    chi2=pull.chi2,
                    readings=int(np.isfinite(self.rows.residual[mine]).sum()),
                    pull=_or_none(pull.pull),
                    p_value=_or_none(pull.p_value),
                    pulls={name: _or_none(one) for name, one in zip(own, pull.pulls, strict=True)},
                    nuisances={name: parameters[key] for name, key in named.items() if key in parameters},
                    departures={} if self.between is None else dict(zip(own, self.between[1][t].tolist(), strict=True)),
                )
            )
        return tuple(told)

    def law_at(self, speeds: Float[np.ndarray, " n"]) -> LawAfter:
        """Return the law at approach speeds in nm/us."""
        return law_at(self.problem, self.objective.measurement, self.values, self.spread, speeds, self.after)

    def _loss(
        self,
        shown: Float[np.ndarray, "k k"],
        parameters: Mapping[str, FittedParameter],
        beside: "_Summary | None" = None,
    ) -> Loss | None:
        """Return what impacts take, at another minimum too; None where no row has a speed."""
        if not np.isfinite(self.used_speeds).any():
            return None
        measurement = self.objective.measurement

        def found(speeds: Float[np.ndarray, " n"]) -> LawAfter:
            own = law_at(self.problem, measurement, self.values, shown, speeds, self.after)
            return own if beside is None else containing(own, beside.law_at(speeds))

        formula = None
        if self.problem.model != "contact":
            formula = self.settings["fixed"] | {name: one.value for name, one in parameters.items()}
        reached = self.rows.approach_speed_nm_per_us[self.rows.used]
        return loss_of(found, speed_range(reached), self.table.mass_ng, parameters, formula)

    def _closest_member(self, step: LinearStep, discrepancy: ModelDiscrepancy) -> ClosestMember | None:
        """Return the model's law that is closest to the law after the step; None where the step is all there is."""
        speeds = self.used_speeds[np.isfinite(self.used_speeds)]
        return member_after(step, discrepancy, self.objective.measurement, self.values, speeds, self.free)

    def _explained_parameters(self, moved: Bool[np.ndarray, " k"]) -> dict[str, FittedParameter]:
        """Return the parameters with their errors and, where all are determined, their intervals."""
        errors = np.sqrt(np.diag(self.spread))
        if not np.all(np.isfinite(errors)) or not np.all(np.isfinite(self.covariance)):
            # With one parameter adrift there is no minimum to follow for the others.
            return self._parameters(errors, "the data do not determine the parameters", moved)
        intervals = profile_intervals(self.objective, self.values, self.covariance, self.minimum_chi2)
        if self.after is not None:
            intervals = self._widened(intervals, errors)
        return self._parameters(errors, intervals, moved)

    def _widened(self, profiles: list[Interval], errors: Float[np.ndarray, " k"]) -> list[Interval]:
        """Return profile intervals that have moved with their values and grown with their errors."""
        intervals = []
        before = np.sqrt(np.diag(self.covariance))
        for i, name in enumerate(self.names):
            ends, reason = (profiles[i].low, profiles[i].high), profiles[i].reason
            # at a bound the closest formula has no error of its own
            growth = errors[i] / before[i] if self.free[i] and before[i] > 0.0 else 1.0
            low, high = (None if e is None else self.ends[i] + growth * (e - self.values[i]) for e in ends)
            intervals.append(within_range(parameter_called(name), Interval(low, high, reason)))
        return intervals

    def _parameters(
        self, errors: Float[np.ndarray, " k"], intervals: list[Interval] | str, moved: Bool[np.ndarray, " k"]
    ) -> dict[str, FittedParameter]:
        """Return the parameters with errors and intervals; for these a text says why there are none."""
        if isinstance(intervals, str):
            intervals = [Interval(None, None, intervals)] * len(errors)
        free = np.append(self.free, np.ones(len(errors) - len(self.free), dtype=bool))
        open_ = np.array([self._is_open(name, one) for name, one in zip(self.names, intervals, strict=True)])
        return {
            name: FittedParameter(
                value=float(self.ends[i]),
                unit=parameter_called(name).unit,
                standard_error=float(errors[i]) if free[i] and not open_[i] and np.isfinite(errors[i]) else None,
                interval95=(intervals[i].low, intervals[i].high),
                interval_reason=intervals[i].reason,
                undetermined=bool(open_[i]) or not np.isfinite(self.spread[i, i]),
                at_bound=not bool(free[i]),
                did_not_move=not (moved[i] or open_[i] or name in self.constraints),
                constraint=self.constraints.get(name),
            )
            for i, name in enumerate(self.names)
        }

    def _is_open(self, name: str, interval: Interval) -> bool:
        """Say whether a parameter of a contact under a bent lever may be anything within its range."""
        searched = (interval.reason or "").count(END_OF_RANGE) == 2
        return self.problem.pulled and name in self.problem.own and searched

    def _rows(self) -> FittedRows:
        count = self.table.rows
        rows = self.searching.measurement.rows
        used = np.asarray(rows.measured)[:count]
        prediction: Any = self.prediction
        exists = prediction.orbits[0][:count] > 0
        predicted = np.where(exists[:, None], prediction.amplitude_nm[0][:count], np.nan)
        error = np.where(used, np.asarray(rows.error_nm)[:count], np.nan)
        reasons = self.model_errors.reasons[:count].copy()
        read = readings_of(self.table)[0]
        stated = np.asarray(self.stated.measurement.rows.measured)[:count]
        reasons[np.isfinite(read).any(axis=1) & ~stated.any(axis=1)] = ATTRACTED
        measured = np.where(used | (reasons != "")[:, None], read, np.nan)
        phases = {}
        if measured.shape[1] > 2:
            columns = {"predicted_phase_deg": predicted, "measured_phase_deg": measured, "phase_error_deg": error}
            phases = {name: column[:, 2] for name, column in columns.items()}
        return FittedRows(
            predicted_nm=predicted[:, :2],
            measured_nm=measured[:, :2],
            residual=np.where(used, self.amplitude_residual[:count], np.nan),
            error_nm=error[:, :2],
            model_error=self.model_errors.model_error[:count],
            used=np.any(used, axis=1, keepdims=False).astype(bool),
            set_aside=(reasons != "").astype(bool),
            approach_speed_nm_per_us=np.where(exists, prediction.approach_speed_nm_per_us[0][:count], np.nan),
            orbits=prediction.orbits[0][:count],
            near_fold=prediction.near_fold[0][:count],
            reasons=tuple(reasons.tolist()),
            **phases,
        )

    def _beside(self, errors: Float[np.ndarray, " p"]) -> "_Summary | None":
        """Return another minimum that the data hardly tell from the best one, if there is one."""
        known = np.where(np.isfinite(errors) & (errors > 0.0), errors, np.inf)

        def apart(values: Float[np.ndarray, "n p"]) -> Bool[np.ndarray, " n"]:
            return np.max(np.abs(values - self.values) / known, axis=1) > 5.0

        ends = self.minimum.ends[apart(self.minimum.ends)]
        if not ends.size:
            return None
        # of impacts that last they were found with the errors as stated and outliers counting less
        chi2 = np.sum(self.searching.residual(ends) ** 2, axis=1)
        place = lowest(chi2)
        if not chi2[place] < self.minimum_chi2 + (_LOOKED_AT if self.problem.lasting else _HARDLY_TOLD):
            return None
        here = self.problem.coordinates(ends[place])
        minimum = replace(self.minimum, coordinates=here, ends=ends[place][None], chi2=chi2[place][None])
        if self.problem.lasting:
            minimum = settle(self.searching, minimum)
        if not apart(self.problem.values(minimum.coordinates)[None]).any():
            return None
        other = _Summary(self.table, replace(self.found, minimum=minimum))
        above = min(other.minimum_chi2 - self.minimum_chi2, other.chi2 - self.chi2)
        return other if above < _HARDLY_TOLD else None


def _or_none(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def _correlations(covariance_matrix: Float[np.ndarray, "p p"]) -> Float[np.ndarray, "p p"]:
    error = np.sqrt(np.diag(covariance_matrix))
    known = np.isfinite(error) & (error > 0.0)
    safe = np.where(known, error, 1.0)
    matrix = np.where(np.isfinite(covariance_matrix), covariance_matrix, 0.0) / np.outer(safe, safe)
    return np.where(np.outer(known, known), matrix, np.nan)


def _autocorrelation(residual: Float[np.ndarray, "rows k"]) -> float:
    """Return the lag-1 correlation of residuals of neighbouring rows, all readings together; NaN for few rows."""
    before, after = residual[:-1], residual[1:]
    both = np.isfinite(before) & np.isfinite(after)
    total = np.nansum(residual**2)
    if both.sum() < 8 or total == 0.0:
        return float("nan")
    return float(np.sum(before[both] * after[both]) / both.sum() / (total / np.isfinite(residual).sum()))


_MODEL_ERROR_ROUNDS = 3
_FEWEST_LEFT, _LEAST_LEFT = 4, 0.2
"""Rows of a driven tip, and their share, of which at least a law of impacts is read off."""


@checked
def fit(  # noqa: PLR0913
    table: AmplitudeTable | Sequence[AmplitudeTable] | Any,
    model: str = "law",
    *,
    share: Sequence[str] = (),
    hierarchical: bool = False,
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
            each instantaneous or with "+delay", the collision delay; or "contact", physical parameters through the
            resolved contact, which a tapping curve gives on resonance too.
        share: nuisances that several tables have in common, by name; "all": every one.
        hierarchical: let the laws of several tables scatter around a mean, each parameter by a standard deviation that
            is fitted too: the values are then means.
        scale_errors: take the amplitudes' errors as relative only and scale them until chi2 equals its degrees of
            freedom (the error of Q stays); the result is valid only if the scale is believable and what is left of the
            amplitudes random (see `verdict`).
        free: the parameters that are fitted; None: all of a law and its delay, of "contact" (keywords of
            `Contact.paper`) relative humidity, adhesion energy, viscosity and modulus, without those fixed.
        fixed: values at which other parameters of the model are held; of "contact" what is not named is the paper's.
        constraints: value and standard error of what else is known, by parameter: a nuisance (`quality_factor`,
            `tip_calibration`, `drive_calibration`, `offset_origin_nm`), which then is fitted along, or one of the
            model's parameters. Of several tables every one's nuisance is known that well. What a fit of the contact
            holds is held at the value then, and known that well; of the others an error is assumed, and named.
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
    options: dict[str, Any] = {"free": free, "fixed": fixed, "constraints": constraints, "effects": effects}
    options |= {
        "scale_errors": scale_errors,
        "robust": robust,
        "share": share,
        "hierarchical": hierarchical,
    }
    whole = tables_of(table)
    return summarise_in_units(whole, find_fit(whole, model, **options))


def _one_table(given: Any) -> AmplitudeTable:
    return AmplitudeTable.from_dataframe(given) if hasattr(given, "columns") else as_table(given)


def tables_of(given: Any) -> AmplitudeTable | SeveralTables:
    """Return what was given as a table, or as several."""
    if isinstance(given, SeveralTables):
        return given
    if isinstance(given, str) or not isinstance(given, Sequence):
        return _one_table(given)
    if not given:
        raise ValueError("there is no table: give one, or the path of one")
    tables = [_one_table(one) for one in given]
    return tables[0] if len(tables) == 1 else SeveralTables(tuple(tables))


def find_fit(  # noqa: PLR0913
    table: AmplitudeTable | SeveralTables,
    model: str,
    *,
    share: Sequence[str] = (),
    hierarchical: bool = False,
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
    if isinstance(table, AmplitudeTable):
        for name, asked in (("share", share), ("hierarchical", hierarchical)):
            if asked:
                raise ValueError(f"`{name}` is about several tables: leave it out, or give more than one")
        known = _known_of(table, model, constraints)
        problem = problem_of(table, model, free=free, fixed=fixed, constraints=known, effects=effects)
        measurement = measurement_of(table, problem, known, held_values(problem, fixed))
    else:
        known, problem, measurement = _joint(table, model, share, constraints, free=free, fixed=fixed, effects=effects)
    amplitudes = int(np.asarray(measurement.rows.measured).sum())
    if amplitudes < len(problem.own):
        raise ValueError(
            f"{table.source}: {amplitudes} measured amplitude{'s' if amplitudes != 1 else ''} cannot determine the "
            f"{len(problem.own)} parameters of the model {model!r}; measure at other drives, orders or offsets too"
        )
    warm_up(starts(problem, measurement)[0], measurement, problem)
    stated = Objective(measurement, problem, robust=robust)
    objective, minimum, model_errors, refused = minimum_with_model_errors(stated)
    scale = None
    if scale_errors:
        objective, minimum, scale = rescale_errors(objective, minimum, len(problem.own))
    settings = {
        "model": model,
        "error_scale": scale,
        "starts": BATCH,
        "soft": SOFT,
        "robust": ROBUST if robust else None,
        "constraints": known,
        "free": list(problem.own),
        "fixed": dict(fixed or {}),
        "effects": list(effects) if model == "contact" else None,
        "held": held_of(problem.own, tuple(effects), fixed or {}, errors) if model == "contact" else (),
    }
    if isinstance(table, SeveralTables):
        settings |= {"share": list(share), "hierarchical": hierarchical}
    return Found(stated, objective, minimum, model_errors, settings, refused)


def _known_of(
    table: AmplitudeTable, model: str, constraints: dict[str, tuple[float, float]] | None
) -> dict[str, tuple[float, float]]:
    """Return everything that is known beforehand of a table's fit, the quality factor's assumed error included."""
    known = constraints_of(table, constraints)
    if table.quality_factor is not None and (model.endswith("+delay") or model == "contact"):
        known = {"quality_factor": (table.quality_factor, ASSUMED_ERROR_OF_Q * table.quality_factor)} | known
    return known


def _joint(
    tables: SeveralTables,
    model: str,
    share: Sequence[str],
    constraints: dict[str, tuple[float, float]] | None,
    **options: Any,
) -> tuple[dict[str, tuple[float, float]], Problem, Measurement]:
    """Return what is known beforehand of several tables, what is fitted, and what it is compared with.

    Raises:
        ValueError: if there is no such nuisance to share, or the tables contradict each other on it.
    """
    _check_levers(tables, model)
    each = [_known_of(table, model, constraints) for table in tables.tables]
    there = [name for name in NUISANCE_NAMES if any(name in known for known in each)]
    shared = there if "all" in share else [name for name in there if name in share]
    for name in share:
        if name not in (*NUISANCE_NAMES, "all"):
            raise ValueError(f"`share` must be chosen from {', '.join(NUISANCE_NAMES)} and all, but one is {name!r}")
        if name not in (*there, "all"):
            raise ValueError(f"`share` names {name}, but no table gives it with an error; state it, or leave it out")
    _check_shared(tables, each, shared)
    several = {name: pair for name, pair in each[0].items() if name in shared}
    # what is each table's own may differ by what a delay takes up in common
    own = problem_of(tables.tables[0], model, constraints=several, **options).own
    for table, known in zip(tables.tables, each, strict=True):
        checked = {name: pair for name, pair in known.items() if name != "offset_origin_nm"}
        problem_of(replace(table, calibration={}), model, constraints=checked, **options)
    tables.check_different()
    labels, names = tables.labels, [*own, *shared]
    known = {name: pair for name, pair in each[0].items() if name in (*own, *shared)}
    heads = {"free_frequency_khz", "quality_factor"}
    differing = {name for name in heads if len({getattr(table, name) for table in tables.tables}) > 1}
    local = (*own, *(name for name in NUISANCE_NAMES if name in (*there, *differing)))
    place, held = np.full((len(labels), len(local)), -1), np.zeros((len(labels), len(local)))
    for t, (table, label) in enumerate(zip(tables.tables, labels, strict=True)):
        for i, name in enumerate(local):
            if name in names:
                place[t, i] = names.index(name)
            elif name in each[t]:
                place[t, i] = len(names)
                names.append(name_of_table(name, label))
                known[names[-1]] = each[t][name]
            else:
                held[t, i] = getattr(table, name) if name in heads else _NEUTRAL[name]
    drives = tuple(table.drive for table in tables.tables)
    problem = Problem(model, tuple(names), tuple(options["effects"]), tables.drive)
    one = replace(problem, names=local, drive=drives[0])
    parts = [measurement_of(table, one, known, held_values(one, options["fixed"])) for table in tables.tables]
    joint = Joint(one, tuple(part.cantilever for part in parts), drives, place, held)
    return known, problem, joint_measurement(tables, parts, problem, joint, known)


_ONE_LEVER = 0.01
"""Share by which the frequencies of levers may differ that taps of one are those of the others."""


def _check_levers(tables: SeveralTables, model: str) -> None:
    """Check that one table of taps serves all tables, where the model asks for it.

    Raises:
        ValueError: if it does not.
    """
    if model != "contact" or not any(table.tapping for table in tables.tables):
        return
    if not tables.tapping:
        raise ValueError(
            "the model 'contact' takes tables of a driven cantilever (# drive = force or base) or of a driven sample, "
            "not both at a time: fit each kind by itself"
        )
    frequencies = [table.free_frequency_khz for table in tables.tables]
    if max(frequencies) > (1.0 + _ONE_LEVER) * min(frequencies):
        raise ValueError(
            "the model 'contact' takes tables of driven cantilevers of one free frequency at a time, but there are "
            f"{min(frequencies):g} and {max(frequencies):g} kHz: fit each cantilever by itself"
        )


_NEUTRAL = {"tip_calibration": 1.0, "drive_calibration": 1.0} | dict.fromkeys(
    ("offset_origin_nm", "phase_zero_deg", "phase_drift_deg", "free_amplitude_drift"), 0.0
)
"""What stands for the absence of a nuisance."""


def _check_shared(tables: SeveralTables, each: Sequence[dict[str, tuple[float, float]]], shared: Sequence[str]) -> None:
    """Check that tables say the same of what they share.

    Raises:
        ValueError: if they do not.
    """
    for name in shared:
        for known, label in zip(each, tables.labels, strict=True):
            if known.get(name) != each[0].get(name):
                said = [
                    f"{where} {'says nothing of it' if pair is None else 'says {:g} +- {:g}'.format(*pair)}"
                    for where, pair in ((tables.labels[0], each[0].get(name)), (label, known.get(name)))
                ]
                raise ValueError(
                    f"{name} is shared, but {', and '.join(said)}; say it once (`constraints`), or do not share it"
                )


def problem_of(
    table: AmplitudeTable,
    model: str,
    *,
    free: Sequence[str] | None = None,
    fixed: dict[str, float] | None = None,
    constraints: dict[str, tuple[float, float]] | None = None,
    effects: Sequence[str] = EFFECTS,
) -> Problem:
    """Return what is fitted for a table: the model's parameters, and the nuisances that are constrained.

    Raises:
        ValueError: if there is no such model or parameter, or a constraint is impossible.
    """
    own = model_parameters(model, None if free is None else tuple(free), fixed)
    known = constraints_of(table, constraints)
    for name, (value, error) in known.items():
        if name not in (*own, *NUISANCE_NAMES):
            raise ValueError(
                f"the constraint on {name!r} is on no parameter: choose from {', '.join((*own, *NUISANCE_NAMES))}"
            )
        if not (np.isfinite(value) and 0.0 < error < np.inf):
            raise ValueError(
                f"the constraint on {name} must be a value and a positive error, but is {value} +- {error}"
            )
    if "offset_origin_nm" in known and model.endswith("+delay") and not table.tapping:
        raise ValueError(
            "offset_origin_nm and delay_offset_nm shift the same thing: with a delay leave the constraint on "
            "offset_origin_nm out (delay_offset_nm takes it up), or fit the model 'contact'"
        )
    nuisances = tuple(name for name in NUISANCE_NAMES if name in known)
    return Problem(model, own + nuisances, tuple(effects), table.drive)


def minimum_with_model_errors(stated: Objective) -> tuple[Objective, Minimum, ModelErrors, bool]:
    """Return the minimum with the model's own error in the weights and inaccurate rows set aside, until both settle.

    The last is True if hardly a row of a driven tip is left then: they are not set aside, and the law is refused.
    """
    minimum = minimise(stated)
    model_errors = model_errors_of(stated, stated.problem.values(minimum.coordinates))
    if not stated.problem.lasting:
        return stated, minimum, model_errors, False
    if _few_left(stated, model_errors, minimum):
        return stated, minimum, model_errors, True
    objective = with_inflated_errors(stated, model_errors)
    for _ in range(_MODEL_ERROR_ROUNDS):
        minimum = settle(objective, minimum)
        again = model_errors_of(stated, stated.problem.values(minimum.coordinates))
        same = np.array_equal(again.set_aside, model_errors.set_aside)
        close = np.allclose(again.model_error, model_errors.model_error, rtol=0.02)
        if _few_left(stated, again, minimum):
            return stated, minimum, again, True
        if same and close:
            return objective, minimum, model_errors, False
        objective, model_errors = with_inflated_errors(stated, again), again
    return objective, settle(objective, minimum), model_errors, False


def _few_left(stated: Objective, model_errors: ModelErrors, minimum: Minimum) -> bool:
    """Say whether the law has an orbit on fewer than four accurate rows of a driven tip, or on fewer than a fifth."""
    if not stated.problem.tapping:
        return False
    rows = stated.measurement.rows
    hits = np.asarray(rows.measured).any(axis=1) & ~np.asarray(rows.free)
    lost = lost_rows(stated, stated.problem.values(minimum.coordinates))
    left = int((hits & ~lost & ~model_errors.set_aside).sum())
    return bool(left < max(_FEWEST_LEFT, _LEAST_LEFT * hits.sum()))
