"""The parameters that a fit prints: those of the model's own formula that is closest to the law it has found.

Of instantaneous laws and of contacts they are the unknowns themselves.
"""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from afm_jax.solve.least_squares import covariance_of
from fitting.infer.explain import Explained
from fitting.infer.law import DELAY_TERMS, bounded, closest_loss, delay_by_formula, rebound_by_formula, root_of
from fitting.parameters import LAW, PARAMETERS
from fitting.predict.law import FormulaLaw

_AT_BOUND = 0.01
"""Loss over its error below which it is taken to vanish."""
_LOSSES = {parameter.name: parameter.reference for parameter in LAW}
"""Parameters of losses, and the value of each without one."""
_SAME, _SHARED = 1e-8, 1e-3
"""What is left of a combination of parameters that does nothing, and the part in it from which one is undetermined."""


class Closest(NamedTuple):
    """Parameters of the model and of the instrument, and how they change with independent unknowns of unit variance.

    ``vanishes``: which of them are losses that are not there.
    """

    names: tuple[str, ...]
    values: Float[np.ndarray, " p"]
    factor: Float[np.ndarray, "p m"]
    vanishes: tuple[bool, ...]

    @property
    def errors(self) -> Float[np.ndarray, " p"]:
        """Standard errors; NaN where nothing determines one."""
        return np.linalg.norm(self.factor, axis=1)


def held_at_bound(explained: Explained) -> Bool[np.ndarray, " k"]:
    """Say which unknowns are losses of an instantaneous law that vanish."""
    theta, law = explained.end.theta, explained.model.law
    if law.lasting:
        return np.zeros(theta.size, bool)
    strength = np.sqrt(np.maximum(np.sum(explained.end.jacobian**2, axis=0), 1e-300))
    return (np.arange(theta.size) < len(law.own)) & (theta <= _AT_BOUND / strength)


def covariance_of_unknowns(explained: Explained) -> Float[np.ndarray, "k k"]:
    """Return the covariance of the unknowns; what vanishes is held, with the variance it would have if it were free."""
    held, full = held_at_bound(explained), explained.covariance
    if not held.any():
        return full
    free, found = explained.end.jacobian[:, ~held], np.zeros_like(full)
    found[np.ix_(~held, ~held)] = covariance_of(free.T @ free)
    found[held, held] = np.diag(full)[held]
    return found


def closest_parameters(explained: Explained, own: tuple[str, ...], fixed: Mapping[str, float]) -> Closest:
    """Return the parameters of the model's own formula closest to the law, and the instrument's quantities.

    Where impacts last, least squares in the rebound speed, then in the delay, each weighted by the law's variance,
    within the parameters' bounds: errors contain what the formula leaves out.

    Args:
        explained: the fit.
        own: the model's parameters.
        fixed: values of others of them.
    """
    model, theta, law = explained.model, explained.end.theta, explained.model.law
    root = root_of(covariance_of_unknowns(explained))
    if law.lasting and isinstance(law, FormulaLaw):
        values, factor, vanishing = _projected(explained, own, fixed)
    else:
        places = [model.names.index(name) for name in own]
        values = np.array([float(law.value_of(name, theta[i])) for name, i in zip(own, places, strict=True)])
        slope = np.array([law.slope_of(name, theta[i]) for name, i in zip(own, places, strict=True)])
        factor, held = slope[:, None] * root[places], held_at_bound(explained)
        vanishing = {name for name, place in zip(own, places, strict=True) if held[place]}
    first = len(model.names) - len(model.instrument)
    pairs = [(q.at(float(y)), q.slope(float(y))) for q, y in zip(model.instrument, theta[first:], strict=True)]
    of_instrument = np.reshape([slope for _, slope in pairs], (-1, 1)) * root[first:]
    return Closest(
        names=(*own, *(quantity.name for quantity in model.instrument)),
        values=np.append(values, [value for value, _ in pairs]),
        factor=np.concatenate([factor, of_instrument]),
        vanishes=(*(name in vanishing for name in own), *(False for _ in pairs)),
    )


def _projected(
    explained: Explained, own: tuple[str, ...], fixed: Mapping[str, float]
) -> tuple[Float[np.ndarray, " p"], Float[np.ndarray, "p m"], set[str]]:
    """Return the formula closest to the law: values, their change with independent unknowns, which losses vanish."""
    used = explained.weights.used.any(axis=1) & ~explained.model.data.row.free
    speeds = explained.end.orbits.approach[used & np.isfinite(explained.end.orbits.approach)]
    law = explained.law_at(speeds)
    there = law.law[0] > 0.0
    u, (rebound, delay), factor = speeds[there], law.law[:, there], law.factor[:, there]
    if u.size < len(own) or not np.isfinite(factor).all():
        values = explained.model.law.values(explained.model.of_law(explained.end.theta))
        return np.array([values[name] for name in own]), np.full((len(own), factor.shape[2]), np.nan), set()
    weight = 1.0 / np.maximum(np.linalg.norm(factor, axis=2), 1e-300)
    losses, late = ([name for name in own if name in kind] for kind in (_LOSSES, DELAY_TERMS))
    values = dict(fixed) | closest_loss(losses, u, rebound, weight[0], fixed)
    vanishing = {name for name in losses if values[name] == _LOSSES[name]}
    w = rebound_by_formula(values, u)
    # where the formula captures it says nothing more
    weight = np.where(w > 0.0, weight, 0.0)
    w = np.maximum(w, 0.1 * rebound)
    by_loss = {"r": values.get("r", 1.0) * u**2 / w, "epsilon": -0.5 / w, "viscous_loss": -0.5 * u / w}
    moving = [name for name in losses if name not in vanishing]
    slope = np.reshape([by_loss[name] for name in moving], (-1, u.size)).T
    changes = dict(zip(moving, _solved(slope, factor[0], weight[0]), strict=True))
    along = slope @ np.reshape([changes[name] for name in moving], (len(moving), factor.shape[2]))
    for name in vanishing:
        # as if it were free, for its limit
        changes[name] = _solved(np.column_stack([slope, by_loss[name]]), factor[0], weight[0])[-1]
    columns = np.reshape([DELAY_TERMS[name](u, w) for name in late], (-1, u.size)).T
    ends = np.reshape([(PARAMETERS[name].lowest, PARAMETERS[name].highest) for name in late], (-1, 2))
    off = weight[1] * (delay_by_formula(fixed, u, w) - delay)
    values |= dict(zip(late, bounded(off, weight[1][:, None] * columns, ends).tolist(), strict=True))
    # the formula's delay changes with its rebound speed
    beside = factor[1] - values.get("delay_lead_nm", 0.0) / w[:, None] ** 2 * along
    changes |= dict(zip(late, _solved(columns, beside, weight[1]), strict=True))
    return np.array([values[name] for name in own]), np.array([changes[name] for name in own]), vanishing


def _solved(
    slope: Float[np.ndarray, "n p"], change: Float[np.ndarray, "n m"], weight: Float[np.ndarray, " n"]
) -> Float[np.ndarray, "p m"]:
    """Return how parameters follow changes of a law; NaN of those that do the same."""
    columns = weight[:, None] * slope
    found = np.linalg.lstsq(columns, weight[:, None] * change, rcond=None)[0]
    unit = np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
    _, strength, axes = np.linalg.svd(columns / unit, full_matrices=False)
    found[np.any(np.abs(axes[strength < _SAME]) > _SHARED, axis=0)] = np.nan
    return found
