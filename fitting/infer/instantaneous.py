"""The fit where impacts are instantaneous: chi2 is one JAX function, minimised by Optax from the best of many starts.

Losses are squares of the optimiser's coordinates, so that a law without one of them is an interior minimum like any
other; damped steps between bounds then go to the last digit. What another start ends at is kept: it may explain the
readings as well.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from afm_jax.impact.law import ImpactLaw
from afm_jax.impact.law_table import coordinate_of
from afm_jax.least_squares import Box, Searches, descended
from afm_jax.solve.lanes import compiled_quickly, filled
from fitting.infer.explain import MOST_OUTLIERS, OUTLIER, ROBUST, Explained
from fitting.infer.optimiser import Minimised, minimised
from fitting.infer.rows import Weights, plain_weights
from fitting.infer.search import CENSORED, Descent, Found, starts
from fitting.infer.unknowns import Model
from fitting.parameters import LAW
from fitting.predict.instantaneous import Seen, read_at, searched
from fitting.predict.orbit import COUNT, Local, Orbits, Row

STARTS, _POLISHED, _PADDED = 64, 8, 32
"""Starts that are screened and polished; rows are padded to multiples of the last, so that programs have few shapes."""
_SOFT = 5.0
"""Residual of a reading from which it counts linearly in the screening."""
_FINE, _STEPS = 1e-16, 60
"""Estimated distance of chi2 to its minimum at the end, and damped steps to it at most."""
_APART, _HARDLY_WORSE = 5.0, 4.0
"""Errors by which another minimum differs, and the rise of chi2 up to which it may be the true one."""
_OUTLIER_ROUNDS = 3
_LAW = tuple(parameter.name for parameter in LAW)
_INSTRUMENT = 6
"""Columns of `Local` that are of the instrument."""


@compiled_quickly(static_argnames="drive")
def _seen(
    law: Float[Array, " 3"], instrument: Float[Array, "rows 6"], row: Row, read: Array, error: Array, drive: str
) -> Seen:
    """Return what rows read at r, epsilon and viscous loss."""
    known = ImpactLaw(*law)

    def one(instrument, row, read, error):
        return searched(known, _local(instrument), row, read, error, drive)

    return jax.vmap(one)(instrument, row, read, error)


@compiled_quickly(static_argnames="drive")
def _slopes(
    law: Float[Array, " 3"], instrument: Float[Array, "rows 6"], row: Row, coordinate: Float[Array, " rows"], drive: str
) -> Float[Array, "rows 3 9"]:
    """Return the derivatives of the readings by the law and by the instrument of each row."""

    def one(instrument, row, coordinate):
        def of_both(both):
            return read_at(coordinate, ImpactLaw(*both[:3]), _local(both[3:]), row, drive)

        return jax.jacfwd(of_both)(jnp.concatenate([law, instrument]))

    return jax.vmap(one)(instrument, row, coordinate)


def _local(instrument: Float[Array, " 6"]) -> Local:
    return Local(*jnp.zeros(COUNT - _INSTRUMENT), *instrument)


def evaluated(
    model: Model, theta: Float[np.ndarray, " k"], *, slopes: bool = True
) -> tuple[Any, Float[np.ndarray, "rows 3 k"]]:
    """Return what rows read at unknowns, a `Seen` of arrays of NumPy, and the derivatives by these.

    Args:
        model: what is fitted.
        theta: its unknowns.
        slopes: derivatives are wanted; else they are 0.
    """
    data, law = model.data, model.law
    values, count = law.values(model.of_law(theta)), data.time.size
    numbers = np.array([values[name] for name in _LAW])
    instrument = np.stack(model.instrument_columns(theta), axis=1)
    along, by_local, parts = np.zeros((count, 3, theta.size)), np.zeros((count, 3, COUNT)), []
    for drive, some in data.groups:
        rows = filled(some, some.size + -some.size % _PADDED)
        there = numbers, instrument[rows], data.row.take(rows)
        error = np.nan_to_num(data.error[rows], nan=1.0)
        seen: Any = jax.tree.map(np.asarray, _seen(*there, data.read[rows], error, drive))
        parts.append((some, seen))
        if not slopes:
            continue
        exists = (seen.orbits > 0)[: some.size, None, None]
        by_both = np.where(exists, np.asarray(_slopes(*there, seen.coordinate, drive))[: some.size], 0.0)
        for i, name in enumerate(law.own):
            along[some, :, i] = by_both[:, :, _LAW.index(name)] * law.slope_of(name, theta[i])
        by_local[some, :, COUNT - _INSTRUMENT :] = by_both[:, :, 3:]
    whole = jax.tree.map(lambda column: np.zeros((count, *column.shape[1:]), column.dtype), parts[0][1])
    for some, part in parts:
        for column, found in zip(whole, part, strict=True):
            column[some] = found[: some.size]
    along[:, :, len(law.own) :] = model.slopes_by_instrument(theta, by_local)
    return whole, along


class Chi2(NamedTuple):
    """Residuals and chi2 of a model's rows, priors included, as functions of its unknowns."""

    model: Model
    weights: Weights
    soft: float = np.inf
    """Residual of a row from which it counts linearly."""

    def at(
        self, theta: Float[np.ndarray, " k"], *, slopes: bool = True
    ) -> tuple[Any, Float[np.ndarray, " n"], Float[np.ndarray, "n k"]]:
        """Return what is seen, the residuals and their Jacobian."""
        (mean, strength), data = self.model.prior, self.model.data
        seen, along = evaluated(self.model, theta, slopes=slopes)
        off = np.where(self.weights.used, seen.readings - data.read, 0.0)
        white = np.einsum("nij,nj->ni", self.weights.whitening, off)
        slope = np.einsum("nij,njk->nik", self.weights.whitening, np.nan_to_num(along))
        # rows count 2 s^2 (sqrt(1 + x^2/s^2) - 1), of which these residuals are the roots
        bent = np.sqrt(1.0 + np.sum(white**2, axis=1) / self.soft**2)[:, None]
        part = white / (2.0 * self.soft**2 * bent * (1.0 + bent))
        slope = slope - part[:, :, None] * np.einsum("ni,nik->nk", white, slope)[:, None]
        share = np.sqrt(2.0 / (1.0 + bent))
        white, slope = (share * white).ravel(), (share[:, :, None] * slope).reshape(white.size, -1)
        unseen = np.where(data.no_orbit & (seen.orbits > 0), CENSORED, 0.0)
        residual = np.concatenate([white, unseen, strength * (theta - mean)])
        return seen, residual, np.concatenate([slope, np.zeros((unseen.size, theta.size)), np.diag(strength)])

    def minimised(self, start: Float[np.ndarray, " k"]) -> Minimised:
        """Return where Optax's L-BFGS goes in coordinates whose squares are the losses."""
        own = np.arange(start.size) < len(self.model.law.own)

        def evaluate(y: Float[np.ndarray, " k"]) -> tuple[float, Float[np.ndarray, " k"]]:
            with np.errstate(all="ignore"):
                _, residual, jacobian = self.at(np.where(own, y**2, y))
                value, gradient = float(residual @ residual), 2.0 * (residual @ jacobian) * np.where(own, 2.0 * y, 1.0)
            return (value, gradient) if np.isfinite(gradient).all() else (np.inf, np.zeros_like(y))

        y = np.where(own, np.sqrt(np.maximum(start, 0.0)), start)
        jacobian = self.at(start)[2] * np.where(own, 2.0 * y, 1.0)
        end = minimised(evaluate, y, jacobian.T @ jacobian, settled=1e-8)
        return end._replace(place=np.where(own, end.place**2, end.place))

    def descended(self, theta: Float[np.ndarray, " k"], fixed: Bool[np.ndarray, " k"] | None = None) -> Searches:
        """Return where damped steps go: no loss is negative, and some unknowns may be held."""
        lowest, highest = np.full(theta.size, -np.inf), np.full(theta.size, np.inf)
        lowest[: len(self.model.law.own)] = 0.0
        if "r" in self.model.law.own:
            highest[self.model.law.own.index("r")] = 1.0 - 1e-4

        def evaluate(places: Float[np.ndarray, "1 k"], _: object) -> Searches:
            _, residual, jacobian = self.at(places[0])
            chi2 = float(residual @ residual) if np.isfinite(residual).all() else np.inf
            return Searches(places, np.nan_to_num(residual)[None], np.nan_to_num(jacobian)[None], np.array([chi2]))

        held = np.zeros((1, theta.size), bool) if fixed is None else fixed[None]
        start = evaluate(np.clip(theta, lowest, highest)[None], None)
        return descended(evaluate, start, Box(lowest, highest, held), settled=_FINE, most=_STEPS)

    def explained(self, end: Searches) -> Explained:
        """Return the rows as the law at an end explains them."""
        model, theta = self.model, end.place[0]
        seen, residual, jacobian = self.at(theta)
        orbits = orbits_of(model, theta, seen)
        descent = Descent(theta, orbits, float(end.chi2[0]), residual, jacobian)
        return Explained(model, descent, self.weights, Found(orbits, seen.orbits), 0.0, settled=True)


def orbits_of(model: Model, theta: Float[np.ndarray, " k"], seen: Any) -> Orbits:
    """Return the orbits that were seen as those of impacts that last; without slopes."""
    exists, law = seen.orbits > 0, model.of_law(theta)
    approach = np.where(np.isfinite(seen.approach), seen.approach, 1.0)
    x = np.stack([coordinate_of(approach, model.law.capture(law)), seen.phase, np.zeros(exists.size)], axis=1)
    return Orbits(
        x=np.where(exists[:, None], x, np.nan),
        closes=exists,
        steady=exists,
        growing=np.zeros(exists.size, bool),
        determinant=np.zeros(exists.size),
        readings=seen.readings,
        slopes=np.zeros((exists.size, 3, COUNT)),
        approach=seen.approach,
        rebound=np.sqrt(np.maximum(model.law.at(law, approach).square, 0.0)),
        pull=np.zeros(exists.size),
        change=np.zeros(exists.size),
        fold=np.where(seen.near_fold, 0.0, 1.0),
    )


def profile(explained: Explained, place: int, value: float) -> float:
    """Return chi2 with one unknown held at a value, the others following."""
    fixed = np.zeros(explained.end.theta.size, bool)
    fixed[place] = True
    chi2 = Chi2(explained.model, explained.weights)
    return float(chi2.descended(explained.beside(place, value), fixed).chi2[0])


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
        cost = [_softened(chi2.at(point, slopes=False)[1]) for point in points]
    ends = [chi2.minimised(points[i]) for i in np.argsort(np.nan_to_num(cost, nan=np.inf), kind="stable")[:_POLISHED]]
    best = min(ends, key=lambda end: end.value)
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
    return explained, best, _other_minimum(chi2, explained, ends)


def _other_minimum(chi2: Chi2, explained: Explained, ends: list[Minimised]) -> Explained | None:
    """Return another minimum that the data hardly tell from the best one, None if there is none."""
    errors = np.sqrt(np.diag(explained.covariance))
    errors = np.where(np.isfinite(errors) & (errors > 0.0), errors, np.inf)

    def apart(theta: Float[np.ndarray, " k"]) -> bool:
        return bool(np.max(np.abs(theta - explained.end.theta) / errors) > _APART)

    for end in sorted(ends, key=lambda end: end.value):
        if apart(end.place):
            there = chi2.explained(chi2.descended(end.place))
            hardly_worse = there.end.chi2 < explained.end.chi2 + _HARDLY_WORSE
            return there if hardly_worse and apart(there.end.theta) else None
    return None


def _softened(residual: Float[np.ndarray, " n"]) -> float:
    return float(np.sum(2.0 * _SOFT**2 * (np.sqrt(1.0 + (residual / _SOFT) ** 2) - 1.0)))
