"""A law with everything free: formula, smooth functions beside it, remainders of corrections, instrument.

`fit_lasting` reads as the fit runs: the formula's minimum is searched for; smooth functions beside the formula, what
the corrections of impacts leave out and the instrument are freed with it, rows are weighed and their orbits searched
for anew until chi2 stays; outliers are left out on request; residuals that are correlated over the speed widen the
smooth functions. The covariance of everything, (J^T J)^-1, is where the law's band, intervals and
correlations come from.
"""

from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Bool, Float

from afm_jax.solve.least_squares import covariance_of
from fitting.infer.law import LawWithErrors, root_of
from fitting.infer.rows import Weights, few_left, remainders_of, weights_of
from fitting.infer.search import (
    CENSORED,
    LOST_COST,
    Descent,
    Found,
    begun,
    descend,
    lost_rows,
    orbits_at,
    recovered,
)
from fitting.infer.unknowns import REMAINDERS, Model
from fitting.predict.law import SMOOTH, FormulaLaw, Process, of_short_range
from fitting.predict.orbit import Orbits

_ROUNDS, _SETTLED = 12, 0.02
"""Rounds of orbits, weights and descent at most, and the change of chi2 at which they have settled."""
_PROFILE_SETTLED = 1e-2
"""The same for the descent of a profile."""
_PART, _PARTS = 3.0, 20
"""Longest part of a profile's way in standard errors, and how many of them at most."""
_RECOVERIES = 2
"""How often laws around one that lacks measured orbits are looked at."""
_DECIDED = 3
"""Round after which rows are no longer excluded or taken in."""
ROBUST, OUTLIER, MOST_OUTLIERS = 2.0, 4.0, 0.1
"""Residual of a row from which a robust fit counts it linearly, that of an outlier, and their share at most."""
_RUN_BY_CHANCE, _SHARE_PER_RUN, LARGEST_SHARE = 2.2, 0.25, 1.0
"""Standard deviations of a run of residuals that mean nothing, share of the loss for each beyond, and the largest: a
law that needs that much is not believed."""
_BUMP, _BUMP_STEP, _LEAST_LEFT = 0.2, 0.1, 1e-3
"""Width of the bumps in ln u that runs are looked for with, their distance, and what is left beside the unknowns."""


@dataclass(frozen=True, eq=False)
class Explained:
    """A law with everything free, and the rows as it explains them.

    Attributes:
        model: what was fitted.
        end: unknowns, orbits, chi2 and Jacobian at the minimum.
        weights: of the rows.
        found: the orbits, searched for at the minimum.
        run: standard deviations by which residuals run together over the speed.
        settled: whether rounds stopped changing chi2.
    """

    model: Model
    end: Descent
    weights: Weights
    found: Found
    run: float
    settled: bool
    refused: bool = False
    """Hardly a row of a driven tip is left that a law of impacts can be read off."""
    short: float = 0.0
    """Share of the loss by which a smooth function of short range was added for runs of residuals."""
    stops: dict[int, list[Descent]] = field(default_factory=dict)
    """Where profiles have been, by the place of what was held: the next one begins at the nearest."""

    @property
    def residual(self) -> Float[np.ndarray, "rows 3"]:
        """Predicted less read, in the errors as used; NaN where nothing counts."""
        off = self.end.orbits.readings - self.model.data.read
        white = np.einsum("nij,nj->ni", self.weights.whitening, np.where(self.weights.used, off, 0.0))
        return np.where(self.weights.used, white, np.nan)

    @property
    def covariance(self) -> Float[np.ndarray, "k k"]:
        """Of all unknowns, infinite where the readings and priors determine nothing."""
        return covariance_of(self.end.jacobian.T @ self.end.jacobian)

    def by_law_alone(self) -> Orbits:
        """Return the rows' orbits without the remainders of corrections: those of a scene with the law."""
        model, first = self.model, len(self.model.law.names)
        if model.remainders is None:
            return self.end.orbits
        theta = np.delete(self.end.theta, np.arange(first, first + REMAINDERS))
        return replace(model, remainders=None).follow(theta, self.end.orbits.x)

    def beside(self, place: int, value: float, begin: Descent | None = None) -> Float[np.ndarray, " k"]:
        """Return the unknowns with one held at a value, the others following to first order, from the end or another.

        Args:
            place: of the unknown.
            value: of it.
            begin: from where; None: from the minimum.
        """
        begin = self.end if begin is None else begin
        theta = begin.theta.copy()
        covariance = covariance_of(begin.jacobian.T @ begin.jacobian)
        if np.isfinite(covariance).all() and covariance[place, place] > 0.0:
            theta = theta + covariance[place] / covariance[place, place] * (value - theta[place])
        theta[place] = value
        return theta

    def profile(self, place: int, value: float) -> float:
        """Return chi2 with one unknown held at a value, the others following, weights as they are.

        The way there is gone in parts, shorter ones where an orbit is lost; infinite where there is none.
        """
        fixed = np.zeros(self.end.theta.size, bool)
        stops = self.stops.setdefault(place, [self.end])
        fixed[place] = True
        begin = min(stops, key=lambda stop: abs(stop.theta[place] - value))
        longest = _PART * float(np.sqrt(self.covariance[place, place]))
        for _ in range(_PARTS):
            left = value - begin.theta[place]
            part = float(np.clip(left, -longest, longest))
            theta = self.beside(place, begin.theta[place] + part, begin)
            end = descend(self.model, theta, begin.orbits, self.weights, settled=_PROFILE_SETTLED, fixed=fixed)
            if not np.isfinite(end.chi2):
                longest = 0.5 * abs(part)
                continue
            stops.append(end)
            begin = end
            if part == left:
                return end.chi2
        return np.inf

    def law_at(self, speeds: Float[np.ndarray, " n"]) -> LawWithErrors:
        """Return rebound speeds and delays at approach speeds in nm/us, with their change by independent unknowns."""
        law, count = self.model.law, len(self.model.law.names)
        theta = self.model.of_law(self.end.theta)
        found, (coefficients, by_unknown) = law.at(theta, speeds), law.coefficients(theta)
        _, lead, _, twice = coefficients
        leaves = found.square > 0.0
        w = np.sqrt(np.where(leaves, found.square, 1.0))
        late = found.time - lead * (1.0 / w - 1.0 / speeds) + twice * (1.0 / w**2 - 1.0 / speeds**2)
        by_rebound = found.square_slope / (2.0 * w[:, None])
        by_delay = found.time_slope + (lead / w**2 - 2.0 * twice / w**3)[:, None] * by_rebound
        by_delay += np.outer(1.0 / speeds - 1.0 / w, by_unknown[1]) + np.outer(
            1.0 / w**2 - 1.0 / speeds**2, by_unknown[3]
        )
        root = root_of(self.covariance)[:count]
        capture = law.capture(theta)
        factor = np.stack([by_rebound, by_delay]) @ root
        return LawWithErrors(
            np.where(leaves, np.stack([w, late]), 0.0),
            np.where(leaves[:, None], factor, 0.0),
            capture,
            law.capture_slope(theta) @ root,
        )


def fit_lasting(model: Model, *, robust: bool = False) -> tuple[Explained, Explained]:
    """Return what explains the rows best, and before what was added for runs of residuals.

    Args:
        model: a formula, without smooth functions, and the rows.
        robust: find outliers, and leave them out.
    """
    out = np.zeros(model.data.time.size, bool)
    formula = begun(model)
    whole = freed(model, formula, out, (SMOOTH,), soft=ROBUST if robust else np.inf)
    if whole.refused:
        return whole, whole
    if robust:
        far = np.nan_to_num(np.abs(whole.residual)).max(axis=1) > OUTLIER
        if far.sum() <= max(1.0, MOST_OUTLIERS * whole.weights.used.any(axis=1).sum()):
            out = far
        whole = freed(model, whole.end, out, (SMOOTH,), before=whole.model)
    share = min(_SHARE_PER_RUN * (whole.run - _RUN_BY_CHANCE), LARGEST_SHARE)
    if share <= 0.0:
        return whole, whole
    wider = freed(model, whole.end, out, (SMOOTH, of_short_range(share)), before=whole.model)
    return replace(wider, short=share), whole


def freed(
    model: Model,
    begin: Descent,
    out: Bool[np.ndarray, " rows"],
    processes: tuple[Process, ...],
    *,
    before: Model | None = None,
    soft: float = np.inf,
) -> Explained:
    """Return the minimum with everything free, from one that had some of it.

    Args:
        model: the formula and the rows.
        begin: where to begin.
        out: rows that are left out.
        processes: smooth functions beside the formula.
        before: what `begin` are unknowns of; None: the model.
        soft: see `descend`.
    """
    law = model.law
    if few_left(model.data, weights_of(model, begin.theta, begin.orbits, out)):
        weights = weights_of(model, begin.theta, begin.orbits, out)
        return Explained(model, begin, weights, orbits_at(model, begin.theta), 0.0, settled=True, refused=True)
    if isinstance(law, FormulaLaw):
        approach = begin.orbits.approach[np.isfinite(begin.orbits.approach) & ~model.data.row.free]
        law = law.beside((float(approach.min()), float(approach.max())), *processes)
    whole = replace(model, law=law, remainders=np.zeros((2, len(out), 7)))
    theta = whole.prior[0].copy()
    for name, value in zip((before or model).names, begin.theta, strict=True):
        if name in whole.names and not name.startswith(("loss_", "path_")):
            theta[whole.names.index(name)] = value
    best = _settled(whole, theta, out, soft)
    for _ in range(_RECOVERIES):
        lost = lost_rows(whole.data, best.found) & (best.weights.reasons == "")
        other = recovered(best.model, best.end.theta, best.end.jacobian, lost) if lost.any() else None
        if other is None:
            break
        again = _settled(whole, other, out, soft)
        if not _cost(again) < _cost(best):
            break
        best = again
    unseen = whole.data.no_orbit & best.found.exists
    end = best.end._replace(chi2=best.end.chi2 + CENSORED**2 * float(unseen.sum()))
    return replace(best, end=end, run=run_of_residuals(best))


def _cost(explained: Explained) -> float:
    """Return chi2 with what rows without an orbit add to it."""
    lost = lost_rows(explained.model.data, explained.found) & (explained.weights.reasons == "")
    return explained.end.chi2 + LOST_COST * float(lost.sum())


def _settled(model: Model, theta: Float[np.ndarray, " k"], out: Bool[np.ndarray, " rows"], soft: float) -> Explained:
    """Return the minimum after rounds of orbits, remainders, weights and descent."""
    last, settled, kept, rounds = np.inf, False, None, []
    for number in range(_ROUNDS):
        found = orbits_at(model, theta)
        model = replace(model, remainders=remainders_of(model, theta, found.orbits))
        weights = weights_of(model, theta, found.orbits, out, kept)
        end = descend(model, theta, found.orbits, weights, soft=soft)
        explained = Explained(model, end, weights, orbits_at(model, end.theta), 0.0, settled)
        theta, settled = end.theta, abs(end.chi2 - last) < _SETTLED
        if settled or number == _ROUNDS - 1:
            return replace(explained, settled=settled)
        last = end.chi2
        if kept is None:
            lost = int((lost_rows(model.data, explained.found) & (weights.reasons == "")).sum())
            rounds.append((lost, -int(weights.used.sum()), number, weights.reasons, theta))
        if number == _DECIDED:
            # which rows are excluded hangs on the law, and the law on them: as where the fewest were lost
            *_, kept, theta = min(rounds[1:], key=lambda one: one[:3])
    raise AssertionError


def run_of_residuals(explained: Explained) -> float:
    """Return by how many standard deviations residuals run together over the approach speed, at the worst place.

    A bump of the loss, or of the path that the delay stands for, is fitted at every speed beside everything else: what
    counts is its size over its standard error (the score statistic).
    """
    orbits, end, weights = explained.end.orbits, explained.end, explained.weights
    seen = weights.used.any(axis=1) & np.isfinite(orbits.approach) & ~explained.model.data.row.free
    if not (seen.any() and np.isfinite(end.chi2)):
        return 0.0
    u = np.where(seen, orbits.approach, 1.0)
    place = np.log(u)
    middles = np.arange(place[seen].min(), place[seen].max() + _BUMP_STEP, _BUMP_STEP)
    bumps = np.exp(-0.5 * ((place[:, None] - middles) / _BUMP) ** 2) * seen[:, None]
    slopes = np.einsum("nij,njk->nik", weights.whitening, np.nan_to_num(orbits.slopes[:, :, :2]))
    lost = np.where(seen, u**2 - orbits.rebound**2, 0.0)
    tried = np.concatenate(
        [
            slopes[:, :, 0, None] * (bumps * lost[:, None])[:, None],
            slopes[:, :, 1, None] * (bumps / u[:, None])[:, None],
        ],
        axis=2,
    ).reshape(3 * len(u), -1)
    tried = np.concatenate([tried, np.zeros((end.residual.size - len(tried), tried.shape[1]))])
    basis, _ = np.linalg.qr(end.jacobian)
    apart = tried - basis @ (basis.T @ tried)
    residual = end.residual - basis @ (basis.T @ end.residual)
    whole, left = np.linalg.norm(tried, axis=0), np.linalg.norm(apart, axis=0)
    told = left > _LEAST_LEFT * np.maximum(whole, 1e-300)
    return float(np.max(np.abs(apart.T @ residual)[told] / left[told], initial=0.0))
