"""The fit where impacts are instantaneous: every orbit is a root of a quartic, and Optax minimises chi2.

Losses are squares of the optimiser's coordinates, so that a law without one of them is an interior minimum like any
other; damped steps between bounds then go to the last digit. What another start ends at is kept: it may explain the
readings as well.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from afm_jax.solve.least_squares import Lowest, Sum, levenberg_marquardt
from fitting.infer.explain import MOST_OUTLIERS, OUTLIER, ROBUST, Explained
from fitting.infer.optimiser import Minimised, minimised
from fitting.infer.rows import Weights, plain_weights
from fitting.infer.search import CENSORED, Descent, Found, orbits_at, starts
from fitting.infer.unknowns import Model

STARTS, _POLISHED = 32, 8
"""Starts that are screened, and polished at most."""
_BY_OPTAX, _SAME = 2, 1e-3
"""Of these by Optax, the others by damped steps, and by Optax where one of those ends at a lower chi2."""
_SOFT = 5.0
"""Residual of a row from which it counts linearly in the screening."""
_FINE, _NEAR, _STEPS = 1e-16, 1e-4, 60
"""Estimated distance of chi2 to its minimum at the end, and where only chi2 is compared; damped steps at most."""
_APART, _HARDLY_WORSE = 5.0, 4.0
"""Errors by which another minimum differs, and the rise of chi2 up to which it may be the true one."""
_OUTLIER_ROUNDS = 3


class Chi2(NamedTuple):
    """Residuals and chi2 of a model's rows, priors included, as functions of its unknowns."""

    model: Model
    weights: Weights
    soft: float = np.inf
    """Residual of a row from which it counts linearly."""

    def at(self, theta: Float[np.ndarray, " k"]) -> tuple[Found, Float[np.ndarray, " n"], Float[np.ndarray, "n k"]]:
        """Return the orbits, the residuals and their Jacobian.

        A row without an orbit reads no amplitude, and the phase that is farthest off.
        """
        (mean, strength), data = self.model.prior, self.model.data
        found = orbits_at(self.model, theta)
        exists, nothing = found.exists[:, None], np.zeros((data.time.size, 3))
        nothing[:, 2] = data.row.phase_deg + 180.0 / data.row.order
        seen = found.orbits._replace(readings=np.where(exists, found.orbits.readings, nothing))
        with np.errstate(all="ignore"):
            along = np.where(exists[:, :, None], self.model.slopes(theta, seen), 0.0)
        off = np.where(self.weights.used, seen.readings - data.read, 0.0)
        white = np.einsum("nij,nj->ni", self.weights.whitening, off)
        slope = np.einsum("nij,njk->nik", self.weights.whitening, np.nan_to_num(along))
        # rows count 2 s^2 (sqrt(1 + x^2/s^2) - 1), of which these residuals are the roots
        bent = np.sqrt(1.0 + np.sum(white**2, axis=1) / self.soft**2)[:, None]
        part = white / (2.0 * self.soft**2 * bent * (1.0 + bent))
        slope = slope - part[:, :, None] * np.einsum("ni,nik->nk", white, slope)[:, None]
        share = np.sqrt(2.0 / (1.0 + bent))
        white, slope = (share * white).ravel(), (share[:, :, None] * slope).reshape(white.size, -1)
        unseen = np.where(data.no_orbit & (found.number > 0), CENSORED, 0.0)
        residual = np.concatenate([white, unseen, strength * (theta - mean)])
        jacobian = np.concatenate([slope, np.zeros((unseen.size, theta.size)), np.diag(strength)])
        return Found(seen, found.number), residual, jacobian

    def minimised(self, start: Float[np.ndarray, " k"]) -> Minimised:
        """Return where Optax's L-BFGS goes in coordinates whose squares are the losses."""
        own = np.arange(start.size) < len(self.model.law.own)

        def evaluate(y: Float[np.ndarray, " k"]) -> Sum:
            with np.errstate(all="ignore"):
                _, residual, jacobian = self.at(np.where(own, y**2, y))
            jacobian = jacobian * np.where(own, 2.0 * y, 1.0)
            sound = np.isfinite(residual @ jacobian).all()
            return Sum(float(residual @ residual) if sound else np.inf, residual, jacobian)

        end = minimised(evaluate, np.where(own, np.sqrt(np.maximum(start, 0.0)), start), settled=1e-8)
        return end._replace(place=np.where(own, end.place**2, end.place))

    def descended(
        self, theta: Float[np.ndarray, " k"], fixed: Bool[np.ndarray, " k"] | None = None, settled: float = _FINE
    ) -> Lowest:
        """Return where damped steps go: no loss is negative, and some unknowns may be held."""
        lowest, highest = np.full(theta.size, -np.inf), np.full(theta.size, np.inf)
        lowest[: len(self.model.law.own)] = 0.0
        if "r" in self.model.law.own:
            highest[self.model.law.own.index("r")] = 1.0 - 1e-4

        def evaluate(place: Float[np.ndarray, " k"]) -> Sum:
            _, residual, jacobian = self.at(place)
            chi2 = float(residual @ residual) if np.isfinite(residual).all() else np.inf
            return Sum(chi2, np.nan_to_num(residual), np.nan_to_num(jacobian))

        how = {"fixed": fixed, "lowest": lowest, "highest": highest}
        return levenberg_marquardt(evaluate, np.clip(theta, lowest, highest), settled=settled, most=_STEPS, **how)

    def explained(self, end: Lowest) -> Explained:
        """Return the rows as the law at an end explains them."""
        found, residual, jacobian = self.at(end.place)
        descent = Descent(end.place, found.orbits, end.sum.value, residual, jacobian)
        return Explained(self.model, descent, self.weights, found, 0.0, settled=True)


def profile(explained: Explained, place: int, value: float) -> float:
    """Return chi2 with one unknown held at a value, the others following."""
    fixed = np.zeros(explained.end.theta.size, bool)
    fixed[place] = True
    chi2 = Chi2(explained.model, explained.weights)
    return chi2.descended(explained.beside(place, value), fixed, _NEAR).sum.value


def fit_instantaneous(model: Model, *, robust: bool = False) -> tuple[Explained, Minimised, Explained | None]:
    """Return what explains the rows best, how Optax got there, and another minimum that may be the true one.

    Args:
        model: a formula without a delay, and the rows.
        robust: find outliers, and leave them out.
    """
    out = np.zeros(model.data.time.size, bool)
    chi2 = Chi2(model, plain_weights(model.data, 0.0, out), ROBUST if robust else np.inf)
    points = starts(model, STARTS)
    with np.errstate(all="ignore"):
        cost = [float(np.sum(chi2._replace(soft=_SOFT).at(point)[1] ** 2)) for point in points]
    order = np.argsort(np.nan_to_num(cost, nan=np.inf), kind="stable")[:_POLISHED]
    ends = [chi2.minimised(points[i]) for i in order[:_BY_OPTAX]]
    others = [chi2.descended(points[i], settled=_NEAR) for i in order[_BY_OPTAX:]]
    elsewhere = [(end.sum.value, end.place) for end in others]
    least, place = min(elsewhere, key=lambda end: end[0], default=(np.inf, points[0]))
    best = min(ends, key=lambda end: end.value)
    if least < best.value - _SAME:
        best = chi2.minimised(place)
    explained = chi2.explained(chi2.descended(best.place))
    for _ in range(_OUTLIER_ROUNDS if robust else 0):
        with np.errstate(invalid="ignore"):
            off = (explained.end.orbits.readings - model.data.read) / model.data.error
        far = np.nan_to_num(np.abs(off)).max(axis=1) > OUTLIER
        same = np.isinf(chi2.soft) and (far == out).all()
        if same or far.sum() > max(1.0, MOST_OUTLIERS * model.data.measured.any(axis=1).sum()):
            break
        chi2, out = Chi2(model, plain_weights(model.data, 0.0, far)), far
        explained = chi2.explained(chi2.descended(explained.end.theta))
    return explained, best, _other_minimum(chi2, explained, [(end.value, end.place) for end in ends] + elsewhere)


def _other_minimum(
    chi2: Chi2, explained: Explained, ends: list[tuple[float, Float[np.ndarray, " k"]]]
) -> Explained | None:
    """Return another minimum that the data hardly tell from the best one, None if there is none."""
    errors = np.sqrt(np.diag(explained.covariance))
    errors = np.where(np.isfinite(errors) & (errors > 0.0), errors, np.inf)

    def apart(theta: Float[np.ndarray, " k"]) -> bool:
        return bool(np.max(np.abs(theta - explained.end.theta) / errors) > _APART)

    for _, place in sorted(ends, key=lambda end: end[0]):
        if apart(place):
            there = chi2.explained(chi2.descended(place))
            hardly_worse = there.end.chi2 < explained.end.chi2 + _HARDLY_WORSE
            return there if hardly_worse and apart(there.end.theta) else None
    return None
