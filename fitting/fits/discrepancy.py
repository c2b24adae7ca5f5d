"""The model discrepancy (Kennedy and O'Hagan): a step after the fit that gives parameters, law, band and chi2.

A law of a few numbers is itself an approximation. Size and character of what it lacks are known, and enter as unknowns
b ~ N(0, 1) beside the parameters. To first order the readings' residuals in errors are r + J d + U b + noise; with
V = noise covariance + U U^T the step of the parameters is d = -(J^T V^-1 J)^-1 J^T V^-1 r, their covariance is
(J^T V^-1 J)^-1, and the most likely unknowns are b = -U^T V^-1 (r + J d) (`step_of`). With the approach speed u and the
rebound speed u_out the unknowns are:

- the shape of the loss: the bridge's drag acts on a speed that its pull has raised, u_out^2 = u^2 - c sqrt(u^2 + q) -
  epsilon with q = 110 +- 60 nm^2/us^2; and a smooth function of ln u (a Gaussian process);
- terms of the loss that the model has no parameter for;
- of the resolved contact, the parameters that are held: each known within its error, said or assumed;
- the shape of the delay: f (1/u_out^2 - 1/u^2), and a smooth path over ln u;
- where residuals run together over ln u more than chance lets them: a function of ln u of shorter range, of the loss
  and of the path, the larger the less chance explains it;
- the corrections of impacts that last: the leading remainder of each, of either sign;
- what slow impacts lack in any picture of impacts: common to peak and lock-in of a row.

All of it is small: a step from the fit's own linearisation, of which as much is taken as lowers chi2 with the readings
computed from the law after it, not linearised. Readings of slow impacts bend with the law: the step is taken again with
what was computed in place of its linearisation, until chi2 falls no more (`settled_step`). Remainders and what slow
impacts lack are no part of that law: they are in the covariance of the rows.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Bool, Float

from afm_jax.contact.contact import Contact
from afm_jax.contact.law_of_contact import tabulated
from afm_jax.contact.parameters import PAPER
from afm_jax.least_squares import covariance_of
from afm_jax.units import TWO_SIDED_95
from fitting.fits.minimum import ModelErrors, padding
from fitting.fits.objective import MOST_OUTLIERS, OUTLIER, ROBUST, Objective
from fitting.forward import ImpactSlopes, Predicted, free_impacts, impact_at, impact_slopes
from fitting.models import Held, Problem
from fitting.parameters import DELAY_NAMES, DELAY_SHAPE, LOSS_SHAPE, PARAMETERS, parameter_called

LOSS_SPEED_SQUARED = 110.0, 60.0
"""q in nm^2/us^2 of a tip of 1 ng and its standard error: free fits of contacts' laws give 96 to 125, a wet one 234."""
_LOSS_SHARE = 0.07
"""Standard deviation of the smooth part of the loss, relative."""
_MISSING_SHARE = 0.3
"""That of a term that the model lacks, over the loss at the middle of the speeds."""
_PATH_NM = 0.03
"""That of the path that the delay stands for."""
_SQUARE_PER_LEAD, _LEAST_SQUARE = 2.0, 2.0
"""f over the lead b in nm/us, and its standard error; the least that this is, in nm^2/us."""
_SMOOTH, _KNOTS = 0.8, 0.4
"""Correlation length of the smooth functions, and distance of their knots, in ln u."""
_SHORT, _SHORT_KNOTS, _SHORT_PATH_NM = 0.25, 0.15, 0.1
"""Correlation length and distance of the knots in ln u of the functions of shorter range; and the standard deviation of
their path in nm where that of their share of the loss is 1."""
_RUN, _RUN_STEP = 0.2, 0.1
"""Width of the bumps in ln u that a run of residuals is looked for with (standard deviation), and their distance."""
_RUN_BY_CHANCE, _SHARE_PER_RUN, _LARGEST_SHARE = 2.2, 0.25, 1.0
"""Standard deviations of a run that mean nothing (one honest table in five has more), the share of the loss for each
one beyond, and the largest: bumps of 40 % and losses of other powers of the speed need that much."""
_CORRECTIONS = 1.5
"""Standard deviation of a correction's remainder over what was seen."""
_TOGETHER, _APART = 2.0, 1.0 / 16.0
"""Variance of the mean and of the difference of peak and lock-in of a slow row (times root 2), over that of each."""


class HeldEffect(NamedTuple):
    """What one standard error of a held parameter does to the squared rebound speed and to the delay.

    In nm^2/us^2 and us, at logarithms of approach speeds in nm/us. ``readings``: what it does to the readings'
    residuals; None: as the law says.
    """

    held: Held
    log_speed: Float[np.ndarray, " n"]
    square: Float[np.ndarray, " n"]
    late: Float[np.ndarray, " n"]
    readings: Float[np.ndarray, " readings"] | None = None

    def at(self, speeds: Float[np.ndarray, " n"]) -> Float[np.ndarray, "2 n"]:
        """Return both at approach speeds in nm/us."""
        place = np.log(speeds)
        return np.stack([np.interp(place, self.log_speed, part) for part in (self.square, self.late)])


_HELD_POINTS, _HELD_NEAREST = 96, 1.1
"""Speeds at which the effects are computed, and the slowest of them in terms of the capture speed."""
_PARTS = (0.5, 0.1)
"""Parts of the standard error that a parameter is moved by to both sides; the smaller where no contact is left then."""
_NO_CONTACT = 1e5
"""Lowest speed in nm/us from which there is none."""


def effects_of_held(
    held: tuple[Held, ...],
    values: Mapping[str, float],
    effects: tuple[str, ...],
    mass_ng: float,
    speeds: tuple[float, float],
) -> tuple[HeldEffect, ...]:
    """Return what the errors of held parameters do to the law of a contact.

    Args:
        held: the parameters.
        values: of the contact's parameters, by name: what is not named is the paper's.
        effects: that the contact has.
        mass_ng: of the tip.
        speeds: slowest and fastest approach in nm/us.
    """
    u = np.geomspace(0.5 * speeds[0], 1.3 * speeds[1], _HELD_POINTS)
    here = PAPER | dict(values)
    sets = [here]
    for one in held:
        ends = PARAMETERS[one.name].lowest, PARAMETERS[one.name].highest
        for part in _PARTS:
            sets += [here | {one.name: float(np.clip(one.value + side * part * one.error, *ends))} for side in (-1, 1)]
    columns = {name: np.array([float(one[name]) for one in sets]) for name in PAPER}
    square, late, lowest = (np.asarray(part) for part in _varied(columns, np.asarray(mass_ng), u, effects))
    found = []
    for number, one in enumerate(held):
        for part in range(len(_PARTS)):
            low = 1 + 2 * (len(_PARTS) * number + part)
            pair = np.array([low, low + 1])
            moved = float(np.ptp(columns[one.name][pair]))
            sound = np.isfinite(square[pair]).all() and np.isfinite(late[pair]).all()
            if moved == 0.0 or not sound or lowest[pair].max() > _NO_CONTACT:
                continue
            there = u > _HELD_NEAREST * max(lowest[pair].max(), lowest[0])
            change = np.stack([square[low + 1] - square[low], late[low + 1] - late[low]]) * one.error / moved
            if there.sum() > 1:
                found.append(HeldEffect(one, np.log(u[there]), change[0, there], change[1, there]))
                break
    return tuple(found)


def seen_in_taps(
    effects: tuple[HeldEffect, ...], objective: Objective, values: Float[np.ndarray, " p"]
) -> tuple[HeldEffect, ...]:
    """Return the effects of held parameters with what they do to the readings of taps, which no law of speeds says.

    Args:
        effects: of the parameters on the law.
        objective: the fit's, following its orbits.
        values: the fitted ones.
    """

    def misfit(fixed: Mapping[str, Any]) -> tuple[Float[np.ndarray, "rows k"], Bool[np.ndarray, " rows"]]:
        there = Objective(objective.measurement._replace(fixed=dict(fixed)), objective.problem, near=objective.near)
        linear = there.at_values(values[None])
        return there.misfit(linear), np.asarray(linear.prediction.orbits)[0] > 0

    known = objective.measurement.fixed
    (here, found), seen = misfit(known), []
    for one in effects:
        low, high = PARAMETERS[one.held.name].lowest, PARAMETERS[one.held.name].highest
        for part in (_PARTS[1], -_PARTS[1]):
            moved = float(np.clip(one.held.value + part * one.held.error, low, high)) - one.held.value
            if moved == 0.0:
                continue
            there, left = misfit(known | {one.held.name: np.asarray(one.held.value + moved)})
            # a row whose orbit is lost on the way says nothing
            change = np.where((found & left)[:, None], (there - here) * one.held.error / moved, 0.0)
            if np.isfinite(change).all():
                seen.append(one._replace(readings=change.ravel()))
                break
    return tuple(seen)


@partial(jax.jit, static_argnames="effects")
def _varied(
    parameters: dict[str, Float[Array, " k"]], mass_ng: Float[Array, ""], speeds: Float[Array, " n"], effects: tuple
) -> tuple[Float[Array, "k n"], Float[Array, "k n"], Float[Array, " k"]]:
    """Return squared rebound speeds, delays and capture speeds of several contacts."""

    def one(known):
        impact = tabulated(Contact.paper(effects=effects, **known), mass_ng)
        found = impact.speeds(speeds)
        return found.rebound**2, found.delay, impact.lowest

    return jax.vmap(one)(parameters)


_NO_WEIGHT = 1e-3
"""Weight of the rows that a robust fit finds to be outliers."""


class StepRows(NamedTuple):
    """The rows of a fit as the step sees them: everything in the objective's errors.

    Attributes:
        residual: of the readings, then of what else there is.
        jacobian: by the parameters.
        slopes: of the amplitudes' residuals by what impacts do.
        measurement_error: of each amplitude, over the objective's.
        slow_error: that slow impacts have in any picture, over the objective's error.
        approach, rebound: of the free tip, in nm/us.
        pull, change: acceleration at mid contact in nm/us^2 and its change in nm/us^3.
        hertz_time: in us.
    """

    residual: Float[np.ndarray, " n"]
    jacobian: Float[np.ndarray, "n p"]
    slopes: ImpactSlopes
    measurement_error: Float[np.ndarray, "rows k"]
    slow_error: Float[np.ndarray, "rows k"]
    approach: Float[np.ndarray, " rows"]
    rebound: Float[np.ndarray, " rows"]
    pull: Float[np.ndarray, " rows"]
    change: Float[np.ndarray, " rows"]
    hertz_time: Float[np.ndarray, " rows"]


class Columns(NamedTuple):
    """Discrepancy at n speeds: of the squared rebound speed in nm^2/us^2 (first entry) and of the delay in us (second).

    ``known``: its mean; ``drag``: its derivative by the viscous loss; ``shape``: its derivatives by q of the loss and f
    of the delay (`priors`); ``unknown``: its derivatives by unknowns of unit variance. A new term of the discrepancy of
    the law is a column of ``unknown`` (`ModelDiscrepancy.columns`).
    """

    known: Float[np.ndarray, "2 n"]
    drag: Float[np.ndarray, "2 n"]
    shape: Float[np.ndarray, "2 n s"]
    unknown: Float[np.ndarray, "2 n m"]


@dataclass(frozen=True)
class ModelDiscrepancy:
    """What a model with fitted values leaves out.

    Attributes:
        problem: the model; of the resolved contact corrections, slow impacts and what is held are uncertain.
        values: of its parameters, by name, fitted and fixed.
        speeds: slowest and fastest approach of the rows in nm/us.
        mass_ng: of the tip: what a bridge does to speeds goes with its inverse square root.
        short: standard deviation of the loss's part of short range, relative; 0: there is none.
        held: what the errors of parameters that a contact's fit holds do to the law.
    """

    problem: Problem
    values: dict[str, float]
    speeds: tuple[float, float]
    mass_ng: float = 1.0
    short: float = 0.0
    held: tuple[HeldEffect, ...] = ()

    @property
    def priors(self) -> dict[str, tuple[float, float]]:
        """Mean and standard error of the shapes' numbers, by name; only those that the model has use for."""
        priors = {}
        if not self.problem.lasting:
            return priors
        if "viscous_loss" in self.values:
            mean, error = LOSS_SPEED_SQUARED
            priors[LOSS_SHAPE] = mean / self.mass_ng, error / self.mass_ng
        if "delay_lead_nm" in self.values:
            slower = self.mass_ng**-0.5
            mean = slower * _SQUARE_PER_LEAD * self.values["delay_lead_nm"]
            priors[DELAY_SHAPE] = mean, max(abs(mean), slower * _LEAST_SQUARE)
        return priors

    def columns(self, u: Float[np.ndarray, " n"], w: Float[np.ndarray, " n"]) -> Columns:
        """Return what is left out at approach and rebound speeds in nm/us."""
        shape = (2, u.size)
        known, drag, priors = np.zeros(shape), np.zeros(shape), self.priors
        square, late = [], []
        if LOSS_SHAPE in priors:
            loss, raised = self.values["viscous_loss"], np.sqrt(u**2 + priors[LOSS_SHAPE][0])
            drag[0] = u - raised
            known[0] = loss * drag[0]
            square = [-0.5 * loss / raised]
        if DELAY_SHAPE in priors:
            lag = 1.0 / np.maximum(w, 1.0) ** 2 - 1.0 / u**2
            known[1] = priors[DELAY_SHAPE][0] * lag
            late = [lag]
        unknown = _stacked(*self._unknown(u, w), u.size)
        if self.held:
            unknown = np.concatenate([unknown, np.stack([one.at(u) for one in self.held], axis=2)], axis=2)
        return Columns(known, drag, _stacked(square, late, u.size), unknown)

    def fixed_after(self, step: "LinearStep", fixed: Mapping[str, Any]) -> dict[str, Any]:
        """Return the values of a contact's parameters after a step of a fit of taps that holds them at others."""
        moved = {}
        # of taps there are no other unknowns of the law
        for one, unknown in zip(self.held, step.unknown, strict=False):
            ends = PARAMETERS[one.held.name].lowest, PARAMETERS[one.held.name].highest
            moved[one.held.name] = np.asarray(np.clip(one.held.value + one.held.error * unknown, *ends))
        return dict(fixed) | moved

    def _unknown(self, u: Float[np.ndarray, " n"], w: Float[np.ndarray, " n"]):
        """Return columns of the squared speed and of the delay, for unknowns of unit variance."""
        square, late = [], []
        if self.short > 0.0:
            bumps = self._smooth(u, _SHORT, _SHORT_KNOTS).T
            square = [*(-self.short * (u**2 - w**2) * bumps)]
            late = [*(-self.short * _SHORT_PATH_NM / u * bumps)]
        if self.problem.model == "contact" or not self.problem.lasting:
            return square, late
        middle = float(np.sqrt(self.speeds[0] * self.speeds[1]))
        loss = self.values.get("epsilon", 0.0) + self.values.get("viscous_loss", 0.0) * middle
        loss += (1.0 - self.values.get("r", 1.0) ** 2) * middle**2
        terms = {"epsilon": np.ones_like(u), "viscous_loss": u / middle}
        missing = [-_MISSING_SHARE * loss * term for name, term in terms.items() if name not in self.values]
        smooth = self._smooth(u, _SMOOTH, _KNOTS).T
        return [*square, *missing, *(-_LOSS_SHARE * (u**2 - w**2) * smooth)], [*late, *(-_PATH_NM / u * smooth)]

    def _smooth(self, u: Float[np.ndarray, " n"], length: float, apart: float) -> Float[np.ndarray, "n knots"]:
        """Return a random function of unit variance at speeds, as columns of unit variance each.

        Args:
            u: the speeds in nm/us.
            length: over which it is correlated, in ln u.
            apart: distance of its knots.
        """
        low, high = np.log(0.5 * self.speeds[0]), np.log(1.2 * self.speeds[1])
        knots = low + apart * np.arange(int(np.ceil((high - low) / apart)) + 1)

        def related(one, other):
            return np.exp(-0.5 * ((one[:, None] - other) / length) ** 2)

        root = np.linalg.cholesky(related(knots, knots) + 1e-8 * np.eye(knots.size))
        return np.linalg.solve(root, related(knots, np.log(u))).T


def _stacked(square: list, late: list, count: int) -> Float[np.ndarray, "2 n m"]:
    """Return columns of the squared speed, then columns of the delay."""
    found = np.zeros((2, count, len(square) + len(late)))
    found[0, :, : len(square)] = np.reshape(square, (-1, count)).T
    found[1, :, len(square) :] = np.reshape(late, (-1, count)).T
    return found


class LinearStep(NamedTuple):
    """The fit after the step, to first order: parameters, shapes, and unknowns b of the model discrepancy.

    Attributes:
        names: of the parameters, then of the shapes.
        values: of parameters and shapes.
        change: d, by which these values have moved in the step.
        covariance: of these values; infinite where a direction is not determined.
        chi2: r^T V^-1 r of the readings, with the constraints and priors.
        residual: of the readings, in the objective's errors, at the most likely b.
        unknown: the most likely b; the prior of each is N(0, 1).
        unknown_covariance: of b, for given parameters.
        follow: derivatives of the most likely b by the parameters and shapes.
    """

    names: tuple[str, ...]
    values: Float[np.ndarray, " k"]
    change: Float[np.ndarray, " k"]
    covariance: Float[np.ndarray, "k k"]
    chi2: float
    residual: Float[np.ndarray, "rows k"]
    unknown: Float[np.ndarray, " m"]
    unknown_covariance: Float[np.ndarray, "m m"]
    follow: Float[np.ndarray, "m k"]

    def partly(self, share: float) -> "LinearStep":
        """Return what a part of the step leads to; covariances, chi2 and residuals are those of the whole one."""
        return self._replace(
            values=self.values - (1.0 - share) * self.change, change=share * self.change, unknown=share * self.unknown
        )

    def towards(self, other: "LinearStep") -> "LinearStep":
        """Return the step half way to another one; covariances, chi2 and residuals are those of this one."""
        middle = {name: 0.5 * (getattr(self, name) + getattr(other, name)) for name in ("values", "change", "unknown")}
        return self._replace(**middle)


class StepSystem(NamedTuple):
    """A fit's rows, linearised, with all that is left out.

    Attributes:
        residual: of the readings, then of what else there is, the shapes' priors last.
        jacobian: by the parameters, then by the shapes.
        unknown: how the readings' residuals change with unknowns of unit variance, those of the law first.
        noise: covariance of the readings' residuals, of each row by itself.
        of_law: how many of the unknowns are coefficients of the law's discrepancy; the others belong to the rows.
    """

    residual: Float[np.ndarray, " n"]
    jacobian: Float[np.ndarray, "n k"]
    unknown: Float[np.ndarray, "readings m"]
    noise: Float[np.ndarray, "readings readings"]
    of_law: int = 0

    def with_unknowns(self, more: Float[np.ndarray, "readings m"] | None) -> "StepSystem":
        """Return the system with further unknowns of unit variance, which belong to the rows."""
        return self if more is None else self._replace(unknown=np.concatenate([self.unknown, more], axis=1))

    def chi2(self, step: LinearStep, misfit: Float[np.ndarray, " readings"]) -> float:
        """Return chi2 of a law's readings: r^T V^-1 r, with what is known of parameters, shapes and discrepancy.

        V is the covariance of the rows: noise, errors of slow impacts, remainders of corrections.

        Args:
            step: that has led to the law.
            misfit: (predicted - measured)/error of the readings.
        """
        rest, coefficients = self.rest(step), step.unknown[: self.of_law]
        return float(misfit @ self.alone(misfit)[1] + rest @ rest + coefficients @ coefficients)

    def misfit(self, step: LinearStep) -> Float[np.ndarray, " readings"]:
        """Return (predicted - measured)/error of the readings by the law after a step, to first order."""
        size = self.noise.shape[0]
        by_law = self.unknown[:, : self.of_law] @ step.unknown[: self.of_law]
        return self.residual[:size] + self.jacobian[:size] @ step.change + by_law

    def rest(self, step: LinearStep) -> Float[np.ndarray, " n"]:
        """Return the residuals besides the readings' after a step: of rows without orbit, and of what is known."""
        size = self.noise.shape[0]
        return self.residual[size:] + self.jacobian[size:] @ step.change

    def alone(self, misfit: Float[np.ndarray, " readings"]) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
        """Return residuals without the rows' most likely remainders, and V^-1 r."""
        of_rows = self.unknown[:, self.of_law :]
        weighted = np.linalg.solve(self.noise + of_rows @ of_rows.T, misfit)
        return self.noise @ weighted, weighted


def system_of(rows: StepRows, discrepancy: ModelDiscrepancy) -> StepSystem:
    """Return the rows of a fit, linearised, with what its model leaves out."""
    size, names = rows.measurement_error.size, discrepancy.problem.names
    columns = discrepancy.columns(rows.approach, rows.rebound)
    slopes = np.stack([rows.slopes.by_square, rows.slopes.by_delay])

    def amplitudes(change):
        """Return changes of the amplitudes' residuals that changes of the impacts make."""
        return np.einsum("krc,kr...->rc...", slopes, change).reshape(size, *change.shape[2:])

    known, priors = len(names), discrepancy.priors
    residual = rows.residual.copy()
    residual[:size] += amplitudes(columns.known)
    jacobian = np.zeros((residual.size + len(priors), known + len(priors)))
    jacobian[: residual.size, :known] = rows.jacobian
    # the last rows of residual and Jacobian are the parameters' constraints; a parameter that may stay open and has
    # none gets a prior as wide as its range, centred where the fit ended
    place = residual.size - known + np.arange(known), np.arange(known)
    ranges = np.sqrt(discrepancy.problem.known_by_range(np.array([discrepancy.values[name] for name in names])))
    jacobian[place] = np.where(jacobian[place] == 0.0, ranges, jacobian[place])
    if "viscous_loss" in names:
        jacobian[:size, names.index("viscous_loss")] += amplitudes(columns.drag)
    jacobian[:size, known:] = amplitudes(columns.shape)
    jacobian[residual.size :, known:] = np.diag([1.0 / error for _, error in priors.values()])
    residual = np.append(residual, np.zeros(len(priors)))
    of_law = amplitudes(columns.unknown)
    for place, one in enumerate(discrepancy.held, start=of_law.shape[1] - len(discrepancy.held)):
        if one.readings is not None:
            of_law[:, place] = one.readings
    unknown = [of_law]
    if discrepancy.problem.lasting:
        unknown.append(amplitudes(_remainders(rows, discrepancy.problem)))
    return StepSystem(residual, jacobian, np.concatenate(unknown, axis=1), _noise(rows), unknown[0].shape[1])


def step_of(
    rows: StepRows,
    discrepancy: ModelDiscrepancy,
    free: Bool[np.ndarray, " p"],
    more: Float[np.ndarray, "readings m"] | None = None,
) -> LinearStep:
    """Return the generalised least-squares step from a fit, with the model discrepancy in the covariance V of the rows.

    Args:
        rows: of the fit.
        discrepancy: by the fitted model.
        free: which of its parameters are not at their bound.
        more: how the readings' residuals change with further unknowns of unit variance, which the law does not have.
    """
    size, names, priors = rows.measurement_error.size, discrepancy.problem.names, discrepancy.priors
    values = np.array([discrepancy.values[name] for name in names])
    residual, jacobian, unknown, noise, _ = system_of(rows, discrepancy).with_unknowns(more)
    variance = noise + unknown @ unknown.T
    root = np.linalg.cholesky(variance)

    def whitened(matrix):
        return np.concatenate([np.linalg.solve(root, matrix[:size]), matrix[size:]])

    white, slope = whitened(residual), whitened(jacobian)
    moving = np.append(free, np.ones(len(priors), bool))
    full = covariance_of(slope.T @ slope)
    covariance = np.zeros_like(full)
    covariance[np.ix_(moving, moving)] = covariance_of(slope[:, moving].T @ slope[:, moving])
    held = np.flatnonzero(~moving)
    covariance[held, held] = full[held, held]
    begin = np.append(values, [mean for mean, _ in priors.values()])
    ends = np.array([(p.lowest, p.highest) for p in map(parameter_called, (*names, *priors))])
    change = _bounded(white, slope, begin, ends, moving & np.isfinite(np.diag(covariance)))
    left = residual + jacobian @ change
    gain = np.linalg.solve(variance, unknown).T
    likely = -gain @ left[:size]
    return LinearStep(
        names=(*names, *priors),
        values=begin + change,
        change=change,
        covariance=covariance,
        chi2=float(np.sum((white + slope @ change) ** 2)),
        residual=(left[:size] + unknown @ likely).reshape(rows.measurement_error.shape),
        unknown=likely,
        unknown_covariance=np.eye(unknown.shape[1]) - gain @ unknown,
        follow=-gain @ jacobian[:size],
    )


def longest_run(
    rows: StepRows,
    discrepancy: ModelDiscrepancy,
    free: Bool[np.ndarray, " p"],
    more: Float[np.ndarray, "readings m"] | None = None,
) -> float:
    """Return by how many standard deviations residuals run together over the approach speed, at the worst place.

    A bump of the loss, or of the path that the delay stands for, is fitted at every speed beside everything else: what
    counts is its size over its standard error (the score statistic). Of 20 honest tables 19 stay below 3.

    Args:
        rows: of the fit.
        discrepancy: by the fitted model.
        free: which of its parameters are not at their bound.
        more: as of `step_of`.
    """
    size = rows.measurement_error.size
    system = system_of(rows, discrepancy)
    residual, jacobian = system.residual, system.jacobian
    unknown = system.unknown if more is None else np.concatenate([system.unknown, more], axis=1)
    root = np.linalg.cholesky(system.noise + unknown @ unknown.T)
    moving = np.append(free, np.ones(jacobian.shape[1] - free.size, dtype=bool))
    seen = np.any(rows.slopes.by_square != 0.0, axis=1) | np.any(rows.slopes.by_delay != 0.0, axis=1)
    if not seen.any():
        return 0.0
    place = np.log(rows.approach)
    middles = np.arange(place[seen].min(), place[seen].max() + _RUN_STEP, _RUN_STEP)
    bumps = np.exp(-0.5 * ((place[:, None] - middles) / _RUN) ** 2)
    by_square = rows.slopes.by_square[:, :, None] * (bumps * (rows.approach**2 - rows.rebound**2)[:, None])[:, None]
    by_delay = rows.slopes.by_delay[:, :, None] * (bumps / rows.approach[:, None])[:, None]
    tried = np.concatenate([by_square, by_delay], axis=2).reshape(size, -1)
    tried = np.concatenate([tried, np.zeros((residual.size - size, tried.shape[1]))])
    white = np.concatenate([residual[:, None], jacobian[:, moving], tried], axis=1)
    white = np.concatenate([np.linalg.solve(root, white[:size]), white[size:]])
    known, others = white[:, 1 : 1 + int(moving.sum())], np.delete(white, np.s_[1 : 1 + int(moving.sum())], axis=1)
    others = others - known @ np.linalg.lstsq(known, others, rcond=None)[0]
    before, after = np.linalg.norm(white[:, 1 + int(moving.sum()) :], axis=0), np.linalg.norm(others[:, 1:], axis=0)
    told = after > 1e-6 * np.maximum(before, 1e-300)
    return float(np.max(np.abs(others[:, 1:].T @ others[:, 0])[told] / after[told], initial=0.0))


def with_runs(discrepancy: ModelDiscrepancy, run: float) -> ModelDiscrepancy:
    """Return what a model leaves out, wider where residuals run together: never narrower.

    Args:
        discrepancy: by the model, without it.
        run: as `longest_run` says.
    """
    return replace(discrepancy, short=float(np.clip(_SHARE_PER_RUN * (run - _RUN_BY_CHANCE), 0.0, _LARGEST_SHARE)))


_STEP_PARTS = (1.0, 0.0), (0.5, 0.25), (0.125, 0.0625)
"""Parts of a step that are looked at, two at a time."""
_NOTHING = 1e-3
"""What a step takes off chi2 at least, to first order, for it to count."""


class Descended(NamedTuple):
    """The part of a step that lowers chi2, and what the law after it predicts.

    ``stuck``: chi2 that no part lowers, and what the whole step takes it to to first order; None: one does, or there is
    nothing to gain.
    """

    step: LinearStep
    predicted: Predicted
    stuck: tuple[float, float] | None


def descending_part(
    step: LinearStep, system: StepSystem, predicted: Callable[[list[LinearStep]], Predicted]
) -> Descended:
    """Return the first of a whole step, its half, its quarter... that lowers chi2, computed; else none of it.

    Args:
        step: from a fit to its law with the model discrepancy.
        system: of the fit.
        predicted: what the laws after parts of the step predict.
    """
    begin, stay = np.inf, None
    for shares in _STEP_PARTS:
        looked, chi2 = _computed([step.partly(share) for share in shares], system, predicted)
        if stay is None:
            begin, stay = chi2.pop(), looked.pop()
        for one, here in zip(looked, chi2, strict=True):
            if here < begin:
                return one
    assert stay is not None  # noqa: S101
    return stay._replace(stuck=(begin, step.chi2) if begin - step.chi2 > _NOTHING else None)


def _computed(
    steps: list[LinearStep], system: StepSystem, predicted: Callable[[list[LinearStep]], Predicted]
) -> tuple[list[Descended], list[float]]:
    """Return the laws after steps with what they predict, and chi2 of each."""
    found = predicted(steps)
    looked = [
        Descended(one, jax.tree.map(lambda leaf, i=i: leaf[i : i + 1], found), None) for i, one in enumerate(steps)
    ]
    return looked, [system.chi2(one.step, one.predicted.misfit.ravel()) for one in looked]


_ROUNDS = 6
"""Steps at most that follow the first one."""
_SETTLED = 1e-2
"""Fall of chi2 from which another one is taken."""


def settled_step(
    begun: Descended,
    system: StepSystem,
    predicted: Callable[[list[LinearStep]], Predicted],
    again: Callable[[Float[np.ndarray, " readings"]], LinearStep],
) -> Descended:
    """Return the step taken again and again, by the slopes at the fit, with what readings do beyond first order.

    Where the fitted law is far off for slow impacts, readings are not linear in it: one step leaves the law off by some
    of its errors there, too slow on the average. Each further step starts at the fit too, with the readings as computed
    after the last one in place of their linearisation: Newton's method with slopes kept (a chord), which ends at the
    law that explains the computed readings. It stops when chi2 falls no more.

    Args:
        begun: the part of the first step that lowers chi2.
        system: of the fit.
        predicted: what the laws after two steps predict.
        again: the step for readings' residuals that are this much larger at the fit.
    """
    best, chi2 = begun, system.chi2(begun.step, begun.predicted.misfit.ravel())
    for _ in range(_ROUNDS):
        whole = again(best.predicted.misfit.ravel() - system.misfit(best.step))
        looked, each = _computed([whole, whole.towards(best.step)], system, predicted)
        lowest = int(np.argmin(each))
        fall = chi2 - each[lowest]
        if not fall > 0.0:
            break
        best, chi2 = looked[lowest], each[lowest]
        if fall < _SETTLED:
            break
    return best


def _bounded(residual, slope, begin, ends, moving) -> Float[np.ndarray, " k"]:
    """Return the least-squares step between bounds: what would leave its range is held at the end."""
    change = np.zeros_like(begin)
    moving = moving.copy()
    for _ in range(begin.size):
        change[moving] = np.linalg.lstsq(
            slope[:, moving], -(residual + slope[:, ~moving] @ change[~moving]), rcond=None
        )[0]
        out = moving & ((begin + change < ends[:, 0]) | (begin + change > ends[:, 1]))
        if not out.any():
            break
        change[out] = np.clip(begin + change, ends[:, 0], ends[:, 1])[out] - begin[out]
        moving &= ~out
    return change


def _noise(rows: StepRows) -> Float[np.ndarray, "n n"]:
    """Return the covariance of the readings' residuals: measured errors, and what slow impacts lack.

    Noise of a lock-in is as large along the measured phasor as across it, and independent: errors of amplitude and
    phase are not correlated. What slow impacts lack is common to peak and lock-in, and to the phase its own.
    """
    count, kinds = rows.measurement_error.shape
    variance = np.zeros((count, kinds, count, kinds))
    one = np.arange(count)
    together, apart = 0.5 * (_TOGETHER + _APART), 0.5 * (_TOGETHER - _APART)
    shares = np.eye(kinds)
    shares[:2, :2] = [[together, apart], [apart, together]]
    for i in range(kinds):
        for j in range(kinds):
            shared = shares[i, j] * rows.slow_error[:, i] * rows.slow_error[:, j]
            variance[one, i, one, j] = shared + (rows.measurement_error[:, i] ** 2 if i == j else 0.0)
    return variance.reshape(count * kinds, count * kinds)


def _remainders(rows: StepRows, problem: Problem) -> Float[np.ndarray, "2 rows m"]:
    """Return the leading remainders of the corrections, of the squared rebound speed and of the delay.

    Taps have none: they have been through the pull, and what they lack of its change is in the rows' errors.
    """
    if problem.pulled:
        return np.zeros((2, rows.approach.size, 0))
    u, w, g, j, time = rows.approach, rows.rebound, rows.pull, rows.change, rows.hertz_time
    # slope in nm/us of the loss u^2 - w^2 over the speed, by regression; 0 where all rows have one speed
    apart = u - u.mean()
    slope = max(float(apart @ (u**2 - w**2)) / max(float(apart @ apart), 1e-9), 0.0)
    nothing = np.zeros_like(u)
    # where the lever's own pull is most of it, it hardly changes during the contact: full contacts say so
    by_square = 0.02 if problem.tapping else 5.0
    late = (0.5 * g / w**3, 0.008 * g * time**2 / u, 8.0 * j / w**4)
    gained = (15.0 * slope * j / w**2, 2.0 * slope * g / u, 0.06 * j * time**2 * u, by_square * g**2 / w**2)
    columns = [(nothing, one) for one in late] + [(one, nothing) for one in gained]
    return _CORRECTIONS * np.moveaxis(np.array(columns), 0, 2)


def rows_of_fit(
    stated: Objective, objective: Objective, values: Float[np.ndarray, " p"], model_errors: ModelErrors, scale: float
) -> StepRows:
    """Return the rows of a fit as the step sees them.

    Args:
        stated: the objective with the errors as measured.
        objective: the fit's, following its orbits.
        values: the fitted ones.
        model_errors: of the rows.
        scale: of the errors.
    """
    problem, rows = objective.problem, jax.tree.map(np.asarray, objective.measurement.rows)
    plain = Objective(objective.measurement, problem, near=objective.near)
    linear = plain.at_values(values[None])
    prediction = jax.tree.map(lambda leaf: np.asarray(leaf)[0], linear.prediction)
    impact = impact_at(values, objective.measurement, problem).impact
    tips = jax.tree.map(np.asarray, free_impacts(impact, prediction.coordinate))
    speeds = tips.speeds
    measured = np.asarray(objective.measurement.rows.measured)
    error = np.where(measured, rows.error_nm, 1.0)
    if objective.robust:
        # the squares' weights, at which least squares have the same minimum; outliers pull no more
        misfit = plain.misfit(linear)
        error = error * (1.0 + (misfit / ROBUST) ** 2) ** -0.25
        far = np.any(np.abs(misfit) > OUTLIER, axis=1, keepdims=True)
        if far.sum() <= max(1.0, MOST_OUTLIERS * measured.any(axis=1).sum()):
            error = np.where(far, _NO_WEIGHT * error, error)
    there = (prediction.orbits > 0) & ~rows.free
    return StepRows(
        residual=np.asarray(linear.residual)[0],
        jacobian=np.asarray(linear.jacobian)[0],
        slopes=impact_slopes(values, objective.measurement, problem, objective.near),
        measurement_error=np.where(measured, scale * np.asarray(stated.measurement.rows.error_nm) / error, 1.0),
        slow_error=np.where(measured, scale * padding(model_errors.slow_error, rows.amplitude_nm) / error, 0.0),
        approach=np.where(there, speeds.approach, 100.0),
        rebound=np.where(there, speeds.rebound, 99.0),
        pull=np.where(there, prediction.pull_nm_per_us2, 0.0),
        change=np.where(there, prediction.change_nm_per_us3, 0.0),
        hertz_time=tips.hertz_time,
    )


class LawAfter(NamedTuple):
    """Rebound speeds in nm/us and delays in us, capture speed, and how they change with unknowns of unit variance."""

    law: Float[np.ndarray, "2 n"]
    factor: Float[np.ndarray, "2 n m"]
    capture: float
    capture_factor: Float[np.ndarray, " m"]


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


class LawBefore(NamedTuple):
    """The fitted law at approach speeds in nm/us, with its derivatives by the parameters.

    Rebound speeds in nm/us and delays in us, and the capture speed in nm/us.
    """

    law: Float[np.ndarray, "2 n"]
    slope: Float[np.ndarray, "2 n p"]
    capture: float
    capture_slope: Float[np.ndarray, " p"]


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


class ClosestMember(NamedTuple):
    """The parameters of the law of a model's family that is closest to the law after the step, and their covariance."""

    values: Float[np.ndarray, " p"]
    covariance: Float[np.ndarray, "p p"]


_TURNS = 8
"""Gauss-Newton steps to the closest member: squared rebound speeds are nearly linear in what is fitted."""


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
    after, names = law_after(step, discrepancy, speeds, before, moved), discrepancy.problem.names
    if not (np.isfinite(step.covariance).all() and np.isfinite(after.factor).all()):
        return None
    there = (before.law[0] > 0.0) & (after.law[0] > 0.0)
    u, (rebound, delay), factor = speeds[there], after.law[:, there], after.factor[:, there]
    weight = 1.0 / np.maximum(np.linalg.norm(factor, axis=2), 1e-300)
    values, ends = (
        step.values[: len(names)].copy(),
        np.array([(p.lowest, p.highest) for p in discrepancy.problem.parameters]),
    )
    spread = np.zeros((len(names), factor.shape[2]))
    spread[:, : len(step.names)] = root_of(step.covariance)[: len(names)]
    loss, late = (
        np.array([i for i, name in enumerate(names) if name in some and free[i]], dtype=int)
        for some in (("r", "epsilon", "viscous_loss"), DELAY_NAMES)
    )
    spread[[i for i, name in enumerate(names) if name in discrepancy.problem.own]] = 0.0

    def known(name: str, absent: float) -> float:
        return float(values[names.index(name)]) if name in names else discrepancy.values.get(name, absent)

    def turned(places: np.ndarray, weights: np.ndarray, slope: np.ndarray, miss: np.ndarray) -> None:
        moving = np.ones(places.size, dtype=bool)
        values[places] += _bounded(weights * miss, weights[:, None] * slope, values[places], ends[places], moving)

    def formula() -> tuple[np.ndarray, np.ndarray]:
        r = known("r", 1.0)
        square = (r * u) ** 2 - known("viscous_loss", 0.0) * u - known("epsilon", 0.0)
        w = np.sqrt(np.maximum(square, (0.1 * rebound) ** 2))
        by_name = {"r": r * u**2 / w, "epsilon": -0.5 / w, "viscous_loss": -0.5 * u / w}
        return w, np.array([by_name[names[i]] for i in loss]).reshape(loss.size, u.size).T

    for _ in range(_TURNS):
        w, slope = formula()
        turned(loss, weight[0], slope, w - rebound)
    w, slope = formula()
    spread[loss] = np.linalg.lstsq(weight[0][:, None] * slope, weight[0][:, None] * factor[0], rcond=None)[0]
    columns = {"delay_hertz": u**-0.2, "delay_lead_nm": 1.0 / u - 1.0 / w, "delay_offset_nm": -1.0 / u}
    time = np.sum([known(name, 0.0) * column for name, column in columns.items()], axis=0)
    by_delay = np.array([columns[names[i]] for i in late]).reshape(late.size, u.size).T
    turned(late, weight[1], by_delay, time - delay)
    # the formula's delay changes with its rebound speed
    along = known("delay_lead_nm", 0.0) / w[:, None] ** 2 * (slope @ spread[loss])
    spread[late] = np.linalg.lstsq(weight[1][:, None] * by_delay, weight[1][:, None] * (factor[1] - along), rcond=None)[
        0
    ]
    return ClosestMember(values, spread @ spread.T)


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


def root_of(covariance: Float[np.ndarray, "k k"]) -> Float[np.ndarray, "k k"]:
    """Return a matrix whose product with its transpose is the covariance; NaN where that is not finite."""
    if not np.all(np.isfinite(covariance)):
        return np.full_like(covariance, np.nan)
    error = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    safe = np.where(error > 0.0, error, 1.0)
    variance, axes = np.linalg.eigh(covariance / np.outer(safe, safe))
    return error[:, None] * axes * np.sqrt(np.maximum(variance, 0.0))
