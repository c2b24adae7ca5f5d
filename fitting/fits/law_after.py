"""The law that a fit finds: the model's formula, or its contact, with the discrepancy of the step after the fit.

`ModelLaw.at` gives it at approach speeds with its errors, as changes with unknowns of unit variance (`LawAfter`);
`closest_member` gives the parameters of the model's formula that comes closest to it: those that are printed.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from afm_jax.impact.law import Law
from afm_jax.solve.lanes import compiled_quickly, filled
from afm_jax.units import TWO_SIDED_95
from fitting.fits.discrepancy import Columns, ModelDiscrepancy
from fitting.fits.step import LinearStep, bounded
from fitting.forward import AnyImpact, impact_at
from fitting.models import Measurement, Problem
from fitting.parameters import DELAY_SHAPE, LOSS_SHAPE, PARAMETERS


class LawAfter(NamedTuple):
    """Rebound speeds in nm/us and delays in us, capture speed, and how they change with unknowns of unit variance."""

    law: Float[np.ndarray, "2 n"]
    factor: Float[np.ndarray, "2 n m"]
    capture: float
    capture_factor: Float[np.ndarray, " m"]


class LawBefore(NamedTuple):
    """The fitted law at approach speeds in nm/us, with its derivatives by the parameters.

    Rebound speeds in nm/us and delays in us, and the capture speed in nm/us.
    """

    law: Float[np.ndarray, "2 n"]
    slope: Float[np.ndarray, "2 n p"]
    capture: float
    capture_slope: Float[np.ndarray, " p"]


AtSpeeds = Callable[[Float[np.ndarray, " n"]], LawAfter]
"""A law with its errors, of approach speeds in nm/us."""


class ModelLaw(NamedTuple):
    """The law of a model at fitted values, after the step to the model discrepancy if there is one.

    Attributes:
        problem: the model.
        measurement: gives the contact's fixed parameters.
        values: fitted values.
        covariance: of the values, or of those after the step; infinite entries give an open band (NaN).
        after: the step from these values, and the discrepancy; None: the model is assumed to be exact.
    """

    problem: Problem
    measurement: Measurement
    values: Float[np.ndarray, " p"]
    covariance: Float[np.ndarray, "k k"]
    after: tuple[LinearStep, ModelDiscrepancy] | None = None

    def at(self, speeds: Float[np.ndarray, " n"]) -> LawAfter:
        """Return the law at approach speeds in nm/us."""
        before = law_before(self.problem, self.measurement, self.values, speeds)
        if self.after is None:
            root = root_of(self.covariance)[: before.slope.shape[2]]
            return LawAfter(before.law, before.slope @ root, before.capture, before.capture_slope @ root)
        step, discrepancy = self.after
        moved = law_before(self.problem, self.measurement, step.values[: len(self.problem.names)], speeds)
        law = law_after(step, discrepancy, speeds, before, moved)
        if np.all(np.isfinite(self.covariance)):
            return law
        return law._replace(
            factor=np.full_like(law.factor, np.nan), capture_factor=np.full_like(law.capture_factor, np.nan)
        )


def holding(law: ModelLaw, other: ModelLaw | None) -> AtSpeeds:
    """Return a law whose band holds that of another one too, which may as well be the true one."""
    return law.at if other is None else lambda speeds: containing(law.at(speeds), other.at(speeds))


LAW_POINTS, _FEWEST_POINTS = 121, 4


def points_of_law(
    law: AtSpeeds, approach_speeds: Float[np.ndarray, " rows"]
) -> tuple[Float[np.ndarray, " points"], LawAfter]:
    """Return a law from 0.8 times the slowest to 1.2 times the fastest approach in nm/us, and beyond its capture.

    Args:
        law: with its errors.
        approach_speeds: of the rows, NaN where a row has none.
    """
    slow, fast = speed_range(approach_speeds)
    speeds = np.geomspace(0.8 * slow, 1.2 * fast, LAW_POINTS)
    points = law(speeds)
    if np.count_nonzero(points.law[0] > 0.0) < _FEWEST_POINTS:
        # a law that captures nearly all of these tips
        speeds = np.geomspace(0.8 * slow, 3.0 * max(points.capture, fast), LAW_POINTS)
        points = law(speeds)
    return speeds, points


def speed_range(approach_speeds: Float[np.ndarray, " rows"]) -> tuple[float, float]:
    """Return slowest and fastest of the known speeds; 1.25 and 83 nm/us where there is none."""
    known = approach_speeds[np.isfinite(approach_speeds)]
    return (float(known.min()), float(known.max())) if known.size else (1.25, 250.0 / 3.0)


def law_before(
    problem: Problem, measurement: Measurement, values: Float[np.ndarray, " p"], speeds: Float[np.ndarray, " n"]
) -> LawBefore:
    """Return the law of a model's values at approach speeds in nm/us, with its slopes by the values."""
    impact, slopes = impact_at(values, measurement, problem)
    law, slope = jax.tree.map(np.asarray, law_and_slope(impact, slopes, speeds))
    count = speeds.size
    return LawBefore(law[:, :count], slope[:, :count], float(law[0, count]), slope[0, count])


@compiled_quickly(level=0)
def law_and_slope(
    impact: AnyImpact, slopes: AnyImpact, speeds: Float[Array, " n"]
) -> tuple[Float[Array, "2 n+1"], Float[Array, "2 n+1 p"]]:
    """Return rebound speeds in nm/us and delays in us at approach speeds, and their derivatives by the parameters.

    The two rows are speed and delay; behind the approach speeds there is one more column, with the capture speed in
    nm/us in both rows.

    Args:
        impact: what is fitted.
        slopes: its derivatives by the parameters, along a first axis.
        speeds: in nm/us.
    """

    def law(impact):
        if isinstance(impact, Law):
            capture = jnp.full((2, 1), impact.capture_speed_nm_per_us)
            leaving = jnp.stack([impact.rebound_speed(speeds), impact.collision_delay(speeds)])
            return jnp.concatenate([leaving, capture], axis=1)
        leaving = jax.vmap(impact.speeds)(speeds)
        # below the table the contact captures
        free = speeds > impact.lowest
        there = jnp.stack([jnp.where(free, leaving.rebound, 0.0), jnp.where(free, leaving.delay, 0.0)])
        return jnp.concatenate([there, jnp.full((2, 1), impact.lowest)], axis=1)

    return law(impact), jax.vmap(lambda turn: jax.jvp(law, (impact,), (turn,))[1], out_axes=-1)(slopes)


def law_after(
    step: LinearStep,
    discrepancy: ModelDiscrepancy,
    speeds: Float[np.ndarray, " n"],
    before: LawBefore,
    moved: LawBefore | None = None,
) -> LawAfter:
    """Return the law after the step.

    u_out^2 is that of the formula with the parameters after the step, less c (sqrt(u^2 + q) - u), and the discrepancy;
    the delay that of the formula for this u_out, f (1/u_out^2 - 1/u^2), and its discrepancy.

    Args:
        step: the step.
        discrepancy: by the fitted model.
        speeds: approach speeds in nm/us.
        before: the fitted law there.
        moved: the model's law with the parameters after the step; None: to first order.
    """
    law, slope = before.law, before.slope
    leaves = law[0] > 0.0
    w = np.where(leaves, law[0], 1.0)
    # what changes the speed changes the delay along with it
    lead = discrepancy.values.get("delay_lead_nm", 0.0) / (2.0 * w**3)

    def seen(change):
        """Return changes of speed and delay for changes of squared speed and delay."""
        square, late = change
        along = (slice(None), *(None,) * (square.ndim - 1))
        return np.stack([square / (2.0 * w)[along], late + lead[along] * square])

    columns = discrepancy.columns(speeds, w)
    found, factor = _moved(step, slope, Columns(*(seen(part) for part in columns)))
    found = np.where(leaves, law + found, law)
    found[0] = np.maximum(found[0], 0.0)
    if moved is not None:
        found = _with_discrepancy(step, discrepancy, speeds, columns, moved)
    whole = LawAfter(found, np.where(leaves[:, None], factor, 0.0), before.capture, np.full(factor.shape[2], np.nan))
    if not before.capture > 0.0:
        # without adhesion nothing is captured: what is left out cannot be told from there
        return whole
    # where the squared rebound speed vanishes
    edge = discrepancy.columns(np.array([before.capture]), np.zeros(1))
    rising = 2.0 * discrepancy.values.get("r", 1.0) ** 2 * before.capture - discrepancy.values.get("viscous_loss", 0.0)
    at_capture = Columns(*(-part[:1, :1] / max(rising, 1e-9) for part in edge))
    shift, capture_factor = _moved(step, before.capture_slope[None, None], at_capture)
    capture = before.capture + float(shift[0, 0])
    if moved is not None:
        values = discrepancy.values | dict(zip(step.names, step.values, strict=True))
        edge_u = np.array([moved.capture])
        square = _discrepancy(step, values, edge_u, discrepancy.columns(edge_u, np.zeros(1)))[0, 0]
        capture = moved.capture - float(square) / max(rising, 1e-9)
    capture = max(capture, 0.0)
    return whole._replace(capture=capture, capture_factor=capture_factor[0, 0])


def _with_discrepancy(
    step: LinearStep, discrepancy: ModelDiscrepancy, u: Float[np.ndarray, " n"], columns: Columns, moved: LawBefore
) -> Float[np.ndarray, "2 n"]:
    """Return rebound speed and delay of the formula after the step with the most likely discrepancy."""
    values = discrepancy.values | dict(zip(step.names, step.values, strict=True))
    formula, delay = moved.law
    square, late = _discrepancy(step, values, u, columns)
    rebound = np.sqrt(np.maximum(formula**2 + square, 0.0))
    leaves = (formula > 0.0) & (rebound > 0.0)
    w, by_formula = (np.where(leaves, speed, 1.0) for speed in (rebound, formula))
    late = late - values.get("delay_lead_nm", 0.0) * (1.0 / w - 1.0 / by_formula)
    if DELAY_SHAPE in values:
        late = late + values[DELAY_SHAPE] * (1.0 / np.maximum(w, 1.0) ** 2 - 1.0 / u**2)
    return np.where(leaves, np.stack([rebound, delay + late]), 0.0)


def _discrepancy(
    step: LinearStep, values: dict[str, float], u: Float[np.ndarray, " n"], columns: Columns
) -> Float[np.ndarray, "2 n"]:
    """Return what the discrepancy adds to the squared rebound speed, with the drag's shape, and to the delay."""
    square, late = columns.unknown @ step.unknown[: columns.unknown.shape[2]]
    if LOSS_SHAPE in values:
        square = square - values["viscous_loss"] * (np.sqrt(u**2 + values[LOSS_SHAPE]) - u)
    return np.stack([square, late])


def _moved(
    step: LinearStep, slope: Float[np.ndarray, "k n p"], columns: Columns
) -> tuple[Float[np.ndarray, "k n"], Float[np.ndarray, "k n m"]]:
    """Return by how much quantities move in the step, and how they change with unknowns of unit variance.

    Args:
        step: the step.
        slope: of the quantities by the model's parameters.
        columns: changes of the quantities with what is left out.
    """
    by_value = np.concatenate([slope, columns.shape], axis=2)
    if "viscous_loss" in step.names:
        by_value[:, :, step.names.index("viscous_loss")] += columns.drag
    count = columns.unknown.shape[2]
    moved = columns.known + by_value @ step.change + columns.unknown @ step.unknown[:count]
    total = by_value + columns.unknown @ step.follow[:count]
    own = columns.unknown @ root_of(step.unknown_covariance[:count, :count])
    return moved, np.concatenate([total @ root_of(step.covariance), own], axis=2)


def containing(one: LawAfter, other: LawAfter) -> LawAfter:
    """Return a law with errors so large that its 95 % band holds that of another law too."""

    def widened(value, factor, far, spread):
        """Return a factor that reaches as far as the other one's."""
        own, theirs = np.linalg.norm(factor, axis=-1), np.linalg.norm(spread, axis=-1)
        wanted = np.abs(far - value) / TWO_SIDED_95 + theirs
        grown = np.where(own > 0.0, np.maximum(wanted / np.where(own > 0.0, own, 1.0), 1.0), 1.0)
        return factor * grown[..., None]

    return one._replace(
        factor=widened(one.law, one.factor, other.law, other.factor),
        capture_factor=widened(one.capture, one.capture_factor, other.capture, other.capture_factor),
    )


def square_by_formula(values: Mapping[str, float], speeds: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Return u_out^2 of the formula of a law's parameters at approach speeds in nm/us; not positive: captured."""
    square = (values.get("r", 1.0) * speeds) ** 2 - values.get("viscous_loss", 0.0) * speeds
    return square - values.get("epsilon", 0.0)


def rebound_by_formula(values: Mapping[str, float], speeds: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Return u_out of the formula of a law's parameters at approach speeds in nm/us; 0 where the tip is captured."""
    return np.sqrt(np.maximum(square_by_formula(values, speeds), 0.0))


DELAY_TERMS: Mapping[str, Callable[[np.ndarray, np.ndarray], np.ndarray]] = {
    "delay_hertz": lambda u, w: u**-0.2,  # noqa: ARG005
    "delay_lead_nm": lambda u, w: 1.0 / u - 1.0 / w,
    "delay_offset_nm": lambda u, w: -1.0 / u,  # noqa: ARG005
}
"""What the parameters of a delay stand before, by approach and rebound speed in nm/us."""


def delay_by_formula(
    values: Mapping[str, float], speeds: Float[np.ndarray, " n"], rebound: Float[np.ndarray, " n"]
) -> Float[np.ndarray, " n"]:
    """Return the delay in us of the formula of a law's parameters at approach and rebound speeds in nm/us."""
    return np.sum([values.get(name, 0.0) * term(speeds, rebound) for name, term in DELAY_TERMS.items()], axis=0)


_POWERS = {"r": 2, "viscous_loss": 1, "epsilon": 0}
"""Powers of the speed: u_in^2 - u_out^2 = (1 - r^2) u^2 + c u + epsilon, each term a loss."""


def closest_loss(
    family: Sequence[str],
    speeds: Float[np.ndarray, " n"],
    rebound: Float[np.ndarray, " n"],
    weight: Float[np.ndarray, " n"],
    known: Mapping[str, float],
    rounds: int = 1,
) -> dict[str, float]:
    """Return the parameters of the formula closest to a law, as u_out is to be close; no loss is negative.

    Least squares in u_out by Gauss-Newton steps from the law itself: about speeds w, u_out of the formula is
    (u_out^2 + w^2)/(2 w) to first order, which is linear in the terms of the loss. One round is a problem without other
    minima.

    Args:
        family: of r, viscous_loss and epsilon those that are looked for.
        speeds: approach speeds in nm/us.
        rebound: of the law, all positive.
        weight: of each.
        known: values of others of them.
        rounds: how many steps.
    """
    if not family:
        return {}
    columns = np.stack([speeds ** _POWERS[name] for name in family], axis=1)
    lossless = square_by_formula({name: value for name, value in known.items() if name not in family}, speeds)
    w, terms = rebound, np.zeros(len(family))
    for _ in range(rounds):
        steep = 0.5 * weight / w
        scale = np.linalg.norm(steep[:, None] * columns, axis=0)
        target = lossless + w**2 - 2.0 * w * rebound
        ends = np.stack([np.zeros(scale.size), np.full(scale.size, np.inf)], axis=1)
        matrix, moving = steep[:, None] * columns / scale, np.ones(scale.size, dtype=bool)
        terms = bounded(-steep * target, matrix, np.zeros(scale.size), ends, moving) / scale
        w = np.sqrt(np.maximum(lossless - columns @ terms, (_SLOWEST * rebound) ** 2))
    found = zip(family, terms.tolist(), strict=True)
    return {name: max(1.0 - term, 0.0) ** 0.5 if name == "r" else term for name, term in found}


_SLOWEST = 0.1
"""Rebound speed of a formula over that of the law that it is compared with at which it is held: it may capture."""


class ClosestMember(NamedTuple):
    """The parameters of the law of a model's family that is closest to the law after the step, and their covariance."""

    values: Float[np.ndarray, " p"]
    covariance: Float[np.ndarray, "p p"]


_ROUNDS = 8
"""Steps to the closest formula: squared rebound speeds are nearly linear in what is fitted."""


def closest_member(
    step: LinearStep,
    discrepancy: ModelDiscrepancy,
    speeds: Float[np.ndarray, " n"],
    before: LawBefore,
    free: Bool[np.ndarray, " p"],
    moved: LawBefore | None = None,
) -> ClosestMember | None:
    """Return the parameters of the model's own formula that comes closest to the law after the step.

    Least squares in the rebound speed, then in the delay, each weighted by the law's variance, within the parameters'
    bounds. The covariance is that of this projection of the law, and so contains all that the model leaves out.

    Args:
        step: the step.
        discrepancy: by the fitted model.
        speeds: approach speeds in nm/us at which the formula is compared: those of the rows that were used.
        before: the fitted law there.
        free: which of the parameters are not at their bound.
        moved: as of `law_after`.

    Returns:
        None where the parameters are not determined.
    """
    after, problem = law_after(step, discrepancy, speeds, before, moved), discrepancy.problem
    if not (np.isfinite(step.covariance).all() and np.isfinite(after.factor).all()):
        return None
    there = (before.law[0] > 0.0) & (after.law[0] > 0.0)
    u, (rebound, delay), factor = speeds[there], after.law[:, there], after.factor[:, there]
    weight = 1.0 / np.maximum(np.linalg.norm(factor, axis=2), 1e-300)
    names, changing = problem.names, [name for name, moves in zip(problem.names, free, strict=True) if moves]
    values = discrepancy.values | dict(zip(names, step.values.tolist(), strict=False))
    spread = np.zeros((len(names), factor.shape[2]))
    spread[:, : len(step.names)] = root_of(step.covariance)[: len(names)]
    spread[: len(problem.own)] = 0.0

    def projected(some: list[str], slope: np.ndarray, change: np.ndarray, kind: int) -> None:
        """Put in how some of the parameters follow a change of the law."""
        by_weight = np.linalg.lstsq(weight[kind][:, None] * slope, weight[kind][:, None] * change, rcond=None)[0]
        spread[[names.index(name) for name in some]] = by_weight

    loss = [name for name in changing if name in _POWERS]
    values |= closest_loss(loss, u, rebound, weight[0], values, _ROUNDS)
    w = np.maximum(rebound_by_formula(values, u), _SLOWEST * rebound)
    by_loss = {"r": values.get("r", 1.0) * u**2 / w, "epsilon": -0.5 / w, "viscous_loss": -0.5 * u / w}
    slope = np.reshape([by_loss[name] for name in loss], (-1, u.size)).T
    projected(loss, slope, factor[0], 0)
    late = [name for name in changing if name in DELAY_TERMS]
    columns = np.reshape([DELAY_TERMS[name](u, w) for name in late], (-1, u.size)).T
    begin, moving = np.array([values[name] for name in late]), np.ones(len(late), dtype=bool)
    ends = np.reshape([(PARAMETERS[name].lowest, PARAMETERS[name].highest) for name in late], (-1, 2))
    change = bounded(
        weight[1] * (delay_by_formula(values, u, w) - delay), weight[1][:, None] * columns, begin, ends, moving
    )
    values |= dict(zip(late, (begin + change).tolist(), strict=True))
    # the formula's delay changes with its rebound speed
    along = values.get("delay_lead_nm", 0.0) / w[:, None] ** 2 * (slope @ spread[[names.index(name) for name in loss]])
    projected(late, columns, factor[1] - along, 1)
    return ClosestMember(np.array([values[name] for name in names]), spread @ spread.T)


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
    whole_speeds = filled(speeds, speeds.size + -speeds.size % LAW_POINTS)

    def law_at(point: Float[np.ndarray, " p"]) -> LawBefore:
        whole = law_before(problem, measurement, point, whole_speeds)
        return whole._replace(law=whole.law[:, : speeds.size], slope=whole.slope[:, : speeds.size])

    moved = law_at(step.values[: len(problem.names)]) if computed else None
    return closest_member(step, discrepancy, speeds, law_at(values), free, moved)


def root_of(covariance: Float[np.ndarray, "k k"]) -> Float[np.ndarray, "k k"]:
    """Return a matrix whose product with its transpose is the covariance; NaN where that is not finite."""
    if not np.all(np.isfinite(covariance)):
        return np.full_like(covariance, np.nan)
    error = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    safe = np.where(error > 0.0, error, 1.0)
    variance, axes = np.linalg.eigh(covariance / np.outer(safe, safe))
    return error[:, None] * axes * np.sqrt(np.maximum(variance, 0.0))
