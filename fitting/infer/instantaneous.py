"""The fit where impacts are instantaneous: chi2 is one JAX function, minimised by Optax from the best of many starts.

Losses are squares of the optimiser's coordinates, so that a law without one of them is an interior minimum like any
other; damped steps between bounds then go to the last digit. What another start ends at is kept: it may explain the
readings as well.
"""

from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from afm_jax.impact.law import ImpactLaw
from afm_jax.impact.law_table import coordinate_of
from afm_jax.least_squares import Box, Searches, descended
from afm_jax.solve.lanes import compiled_quickly, filled
from fitting.infer.explain import MOST_OUTLIERS, OUTLIER, Explained
from fitting.infer.optimiser import Minimised, minimised
from fitting.infer.rows import OUTLIER_LEFT_OUT, Weights
from fitting.infer.search import CENSORED, Descent, Found, starts
from fitting.infer.unknowns import Model
from fitting.parameters import LAW
from fitting.predict.instantaneous import Seen, read_at, searched
from fitting.predict.orbit import COUNT, Local, Orbits, Row

STARTS, _POLISHED, _PADDED = 64, 8, 32
"""Starts that are screened and polished; rows are padded to multiples of the last, so that programs have few shapes."""
_SOFT = 5.0
"""Residual of a reading from which it counts linearly in the screening."""
_FINE = 1e-10
"""Estimated distance of chi2 to its minimum at the end."""
_APART, _HARDLY_WORSE = 5.0, 4.0
"""Errors by which another minimum differs, and the rise of chi2 up to which it may be the true one."""
_LAW = tuple(parameter.name for parameter in LAW)


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
    return Local(*jnp.zeros(COUNT - instrument.shape[0]), *instrument)


class _Rows(NamedTuple):
    """What programs take of a model, padded, for one kind of drive: which rows, and their columns."""

    some: np.ndarray
    drive: str
    row: Row
    read: np.ndarray
    error: np.ndarray


def _groups(model: Model) -> list[_Rows]:
    data, groups = model.data, []
    for drive, some in data.groups:
        padded = filled(some, some.size + -some.size % _PADDED)
        groups.append(_Rows(some, drive, data.row.take(padded), data.read[padded], np.nan_to_num(data.error[padded], nan=1.0)))
    return groups


def evaluated(
    model: Model, theta: Float[np.ndarray, " k"], *, slopes: bool = True
) -> tuple[Seen, Float[np.ndarray, "rows 3 k"]]:
    """Return what rows read at unknowns, and the derivatives by these.

    Args:
        model: what is fitted.
        theta: its unknowns.
        slopes: derivatives are wanted; else they are 0.
    """
    law: Any = model.law
    values, count, own = law.values(theta[: len(law.names)]), model.data.time.size, len(law.names)
    numbers = np.array([values[name] for name in _LAW])
    instrument = np.stack(model.instrument_columns(theta), axis=1)
    parts, along = [], np.zeros((count, 3, theta.size))
    orbits_slopes = np.zeros((count, 3, COUNT))
    for group in _groups(model):
        padded = filled(group.some, group.row.order.size)
        there = numbers, instrument[padded], group.row
        seen = jax.tree.map(np.asarray, _seen(*there, group.read, group.error, group.drive))
        parts.append((group.some, seen))
        if not slopes:
            continue
        exists = (seen.orbits > 0)[: group.some.size, None, None]
        by_numbers = np.asarray(_slopes(*there, seen.coordinate, group.drive))[: group.some.size]
        by_numbers = np.where(exists, by_numbers, 0.0)
        for i, name in enumerate(law.names):
            along[group.some, :, i] = by_numbers[:, :, _LAW.index(name)] * law.slope_of(name, theta[i])
        orbits_slopes[group.some, :, COUNT - 6 :] = by_numbers[:, :, 3:]
    whole = jax.tree.map(lambda *columns: np.zeros((count, *columns[0].shape[1:]), columns[0].dtype), *[p for _, p in parts])
    for some, part in parts:
        for column, values_of in zip(whole, part, strict=True):
            column[some] = values_of[: some.size]
    if slopes:
        along[:, :, own:] = model.slopes_by_instrument(theta, orbits_slopes)
    return whole, along


class _Chi2(NamedTuple):
    """Residuals, their Jacobian and chi2 at unknowns, priors included."""

    model: Model
    weights: Weights

    def at(self, theta: Float[np.ndarray, " k"], *, slopes: bool = True) -> tuple[Seen, np.ndarray, np.ndarray]:
        """Return what is seen, residuals and Jacobian."""
        seen, along = evaluated(self.model, theta, slopes=slopes)
        mean, strength = self.model.prior
        data = self.model.data
        off = np.where(self.weights.used, seen.readings - data.read, 0.0)
        white = np.einsum("nij,nj->ni", self.weights.whitening, off).ravel()
        unseen = np.where(data.no_orbit & (seen.orbits > 0), CENSORED, 0.0)
        residual = np.concatenate([white, unseen, strength * (theta - mean)])
        slope = np.einsum("nij,njk->nik", self.weights.whitening, np.nan_to_num(along)).reshape(white.size, -1)
        return seen, residual, np.concatenate([slope, np.zeros((unseen.size, theta.size)), np.diag(strength)])

    def optax(self, start: Float[np.ndarray, " k"]) -> Minimised:
        """Return where L-BFGS goes in coordinates whose squares are the losses."""
        own = len(self.model.law.names)

        def split(y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            theta, turn = y.copy(), np.ones_like(y)
            theta[:own], turn[:own] = y[:own] ** 2, 2.0 * y[:own]
            return theta, turn

        def evaluate(y: np.ndarray) -> tuple[float, np.ndarray]:
            theta, turn = split(y)
            with np.errstate(all="ignore"):
                _, residual, jacobian = self.at(theta)
            value = float(residual @ residual)
            gradient = 2.0 * (residual @ jacobian) * turn
            return (value, gradient) if np.isfinite(gradient).all() else (np.inf, np.zeros_like(y))

        y = start.copy()
        y[:own] = np.sqrt(np.maximum(start[:own], 0.0))
        theta, turn = split(y)
        jacobian = self.at(theta)[2] * turn
        end = minimised(evaluate, y, jacobian.T @ jacobian, settled=1e-8)
        return end._replace(place=split(end.place)[0])

    def box(self, fixed: Bool[np.ndarray, " k"]) -> Box:
        """Return where unknowns may lie: no loss is negative."""
        lowest, highest = np.full(fixed.size, -np.inf), np.full(fixed.size, np.inf)
        lowest[: len(self.model.law.names)] = 0.0
        if "r" in self.model.law.names:
            highest[self.model.law.names.index("r")] = 1.0 - 1e-4
        return Box(lowest, highest, fixed[None])

    def descended(self, theta: Float[np.ndarray, " k"], fixed: Bool[np.ndarray, " k"] | None = None) -> Searches:
        """Return where damped steps between the bounds go."""
        box = self.box(np.zeros(theta.size, bool) if fixed is None else fixed)

        def evaluate(places: np.ndarray, _: object) -> Searches:
            _, residual, jacobian = self.at(places[0])
            sound = np.isfinite(residual).all()
            chi2 = float(residual @ residual) if sound else np.inf
            return Searches(places, np.nan_to_num(residual)[None], np.nan_to_num(jacobian)[None], np.array([chi2]))

        start = evaluate(np.clip(theta, box.lowest, box.highest)[None], None)
        return descended(evaluate, start, box, settled=_FINE, most=60)


def fit_instantaneous(model: Model, *, robust: bool = False) -> tuple[Explained, Minimised, Explained | None]:
    """Return what explains the rows best, how Optax got there, and another minimum that may be the true one.

    Args:
        model: a formula without a delay, and the rows.
        robust: find outliers, and leave them out.
    """
    weights = plain(model, np.zeros(model.data.time.size, bool))
    chi2 = _Chi2(model, weights)
    points = starts(model, STARTS)
    with np.errstate(all="ignore"):
        cost = [float(_softened(chi2.at(point, slopes=False)[1])) for point in points]
    ends = [chi2.optax(points[i]) for i in np.argsort(np.nan_to_num(cost, nan=np.inf), kind="stable")[:_POLISHED]]
    best = min(ends, key=lambda end: end.value)
    explained = explained_at(chi2, chi2.descended(best.place))
    if robust:
        far = np.nan_to_num(np.abs(explained.residual)).max(axis=1) > OUTLIER
        for _ in range(3):
            if not far.any() or far.sum() > max(1.0, MOST_OUTLIERS * weights.used.any(axis=1).sum()):
                break
            chi2 = _Chi2(model, plain(model, far))
            explained = explained_at(chi2, chi2.descended(explained.end.theta))
            again = np.nan_to_num(np.abs(explained_residual(chi2, explained))).max(axis=1) > OUTLIER
            if (again == far).all():
                break
            far = again
    errors = np.sqrt(np.diag(explained.covariance))
    errors = np.where(np.isfinite(errors) & (errors > 0.0), errors, np.inf)
    other = None
    for end in sorted(ends, key=lambda end: end.value):
        if np.max(np.abs(end.place - explained.end.theta) / errors) > _APART:
            there = explained_at(chi2, chi2.descended(end.place))
            apart = np.max(np.abs(there.end.theta - explained.end.theta) / errors) > _APART
            if apart and there.end.chi2 < explained.end.chi2 + _HARDLY_WORSE:
                other = there
            break
    return explained, best, other


def explained_residual(chi2: _Chi2, explained: Explained) -> Float[np.ndarray, "rows 3"]:
    """Return residuals of all readings, of those that were left out too."""
    data = chi2.model.data
    with np.errstate(invalid="ignore"):
        return (explained.end.orbits.readings - data.read) / data.error


def plain(model: Model, out: Bool[np.ndarray, " rows"]) -> Weights:
    """Return weights by the measured errors, without outliers."""
    used = model.data.measured & ~out[:, None]
    whitening = np.where(used[:, :, None], np.eye(3) / np.where(used, model.data.error, 1.0)[:, None], 0.0)
    reasons = np.where(out, OUTLIER_LEFT_OUT, "").astype(object)
    return Weights(whitening, used, np.zeros(out.size), reasons)


def _softened(residual: Float[np.ndarray, " n"]) -> float:
    return float(np.sum(2.0 * _SOFT**2 * (np.sqrt(1.0 + (residual / _SOFT) ** 2) - 1.0)))


def explained_at(chi2: _Chi2, end: Searches) -> Explained:
    """Return the rows as a law explains them."""
    model, theta = chi2.model, end.place[0]
    seen, residual, jacobian = chi2.at(theta)
    orbits = orbits_of(model, theta, seen)
    descent = Descent(theta, orbits, float(end.chi2[0]), residual, jacobian)
    return Explained(model, descent, chi2.weights, Found(orbits, seen.orbits), 0.0, settled=True)


def orbits_of(model: Model, theta: Float[np.ndarray, " k"], seen: Seen) -> Orbits:
    """Return the orbits of rows as of impacts that last; of their slopes nothing."""
    count, exists = model.data.time.size, seen.orbits > 0
    capture = model.law.capture(model.of_law(theta))
    x = np.full((count, 3), np.nan)
    x[exists, 0] = np.nan_to_num(coordinate_of(seen.approach[exists], capture))
    x[exists, 1:] = np.stack([seen.phase[exists], np.zeros(exists.sum())], axis=1)
    nothing = np.zeros(count)
    law = model.law.at(model.of_law(theta), np.where(exists, np.nan_to_num(seen.approach, nan=1.0), 1.0))
    return Orbits(
        x, exists, exists, seen.readings, np.zeros((count, 3, COUNT)), seen.approach,
        np.sqrt(np.maximum(law.square, 0.0)), nothing, nothing, np.where(seen.near_fold, 0.0, 1.0),
    )  # fmt: skip


def profile_instantaneous(explained: Explained):
    """Return chi2 with one unknown held at a value, the others following."""
    chi2 = _Chi2(explained.model, explained.weights)

    def at(place: int, value: float) -> float:
        theta, fixed = explained.end.theta.copy(), np.zeros(explained.end.theta.size, bool)
        fixed[place] = True
        covariance = explained.covariance
        if np.isfinite(covariance).all() and covariance[place, place] > 0.0:
            theta = theta + covariance[place] / covariance[place, place] * (value - theta[place])
        theta[place] = value
        return float(chi2.descended(theta, fixed).chi2[0])

    return at


def with_scaled_errors(model: Model, factor: float) -> Model:
    """Return the model with all errors times a factor."""
    return replace(model, data=model.data.scaled(factor))
