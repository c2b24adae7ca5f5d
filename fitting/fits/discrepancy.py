"""The model discrepancy (Kennedy and O'Hagan): what a law of a few numbers leaves out, as unknowns with priors.

Size and character of what such a law lacks are known, and enter as unknowns b ~ N(0, 1) beside the parameters, in a
step after the fit (`fitting.fits.step`). With the approach speed u and the rebound speed u_out they are:

- the shape of the loss: the bridge's drag acts on a speed that its pull has raised, u_out^2 = u^2 - c sqrt(u^2 + q) -
  epsilon with q = 110 +- 60 nm^2/us^2; and a smooth function of ln u (a Gaussian process);
- terms of the loss that the model has no parameter for;
- of the resolved contact, the parameters that are held: each known within its error, said or assumed;
- the shape of the delay: f (1/u_out^2 - 1/u^2), and a smooth path over ln u;
- where residuals run together over ln u more than chance lets them: a function of ln u of shorter range, of the loss
  and of the path, the larger the less chance explains it (`with_runs`);
- the corrections of impacts that last: the leading remainder of each, of either sign (`remainders`).
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Float

from afm_jax.contact.contact import Contact
from afm_jax.contact.law_of_contact import tabulated
from afm_jax.contact.parameters import PAPER
from afm_jax.solve.lanes import compiled_quickly
from fitting.models import Held, Problem
from fitting.parameters import DELAY_SHAPE, LOSS_SHAPE, PARAMETERS

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
_RUN_BY_CHANCE, _SHARE_PER_RUN, _LARGEST_SHARE = 2.2, 0.25, 1.0
"""Standard deviations of a run of residuals that mean nothing (one honest table in five has more), the share of the
loss for each one beyond, and the largest: bumps of 40 % and losses of other powers of the speed need that much."""
_CORRECTIONS = 1.5
"""Standard deviation of a correction's remainder over what was seen."""


class HeldEffect(NamedTuple):
    """What one standard error of a held parameter does to the squared rebound speed and to the delay.

    In nm^2/us^2 and us, at logarithms of approach speeds in nm/us.
    """

    held: Held
    log_speed: Float[np.ndarray, " n"]
    square: Float[np.ndarray, " n"]
    late: Float[np.ndarray, " n"]

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


@compiled_quickly(static_argnames="effects")
def _varied(
    parameters: dict[str, Float[Array, " k"]], mass_ng: Float[Array, ""], speeds: Float[Array, " n"], effects: tuple
) -> tuple[Float[Array, "k n"], Float[Array, "k n"], Float[Array, " k"]]:
    """Return squared rebound speeds, delays and capture speeds of several contacts."""

    def one(known):
        impact = tabulated(Contact.paper(effects=effects, **known), mass_ng)
        found = impact.speeds(speeds)
        return found.rebound**2, found.delay, impact.lowest

    return jax.vmap(one)(parameters)


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


def with_runs(discrepancy: ModelDiscrepancy, run: float) -> ModelDiscrepancy:
    """Return what a model leaves out, wider where residuals run together: never narrower.

    Args:
        discrepancy: by the model, without it.
        run: standard deviations by which they do (`fitting.fits.step.longest_run`).
    """
    return replace(discrepancy, short=float(np.clip(_SHARE_PER_RUN * (run - _RUN_BY_CHANCE), 0.0, _LARGEST_SHARE)))


def remainders(
    u: Float[np.ndarray, " rows"],
    w: Float[np.ndarray, " rows"],
    pull: Float[np.ndarray, " rows"],
    change: Float[np.ndarray, " rows"],
    time: Float[np.ndarray, " rows"],
    *,
    tapping: bool,
) -> Float[np.ndarray, "2 rows m"]:
    """Return the leading remainders of the corrections, of the squared rebound speed and of the delay, for each row.

    Args:
        u: approach speed in nm/us.
        w: rebound speed in nm/us.
        pull: acceleration at mid contact in nm/us^2.
        change: its derivative by time in nm/us^3.
        time: Hertz time in us.
        tapping: the cantilever is driven itself.
    """
    # slope in nm/us of the loss u^2 - w^2 over the speed, by regression; 0 where all rows have one speed
    apart = u - u.mean()
    slope = max(float(apart @ (u**2 - w**2)) / max(float(apart @ apart), 1e-9), 0.0)
    nothing = np.zeros_like(u)
    # where the lever's own pull is most of it, it hardly changes during the contact: full contacts say so
    by_square = 0.02 if tapping else 5.0
    late = (0.5 * pull / w**3, 0.008 * pull * time**2 / u, 8.0 * change / w**4)
    gained = (
        15.0 * slope * change / w**2,
        2.0 * slope * pull / u,
        0.06 * change * time**2 * u,
        by_square * pull**2 / w**2,
    )
    columns = [(nothing, one) for one in late] + [(one, nothing) for one in gained]
    return _CORRECTIONS * np.moveaxis(np.array(columns), 0, 2)
