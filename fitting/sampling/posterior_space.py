"""Coordinates without ends for a sampler: each parameter's range on the whole line, with its prior.

A value with an end, such as a loss, is its end plus or minus e log(1 + exp(y)), with e its standard error: linear where
the end is errors away, exponential close to it. A posterior that is Gaussian but for the end stays nearly so in y.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from fitting.models import Problem
from fitting.parameters import Parameter


class Space(NamedTuple):
    """Where a sampler moves: values = those of `middle` + `axes` z, with z about standard normal.

    Attributes:
        problem: the model.
        log_uniform: parameters whose prior is flat in the logarithm of their loss.
        errors: standard errors e of the values, shape (p,).
        middle: coordinates of the fit, shape (p,).
        axes: its columns are steps of about one standard deviation each, shape (p, p).
    """

    problem: Problem
    log_uniform: tuple[str, ...]
    errors: Float[np.ndarray, " p"]
    middle: Float[np.ndarray, " p"]
    axes: Float[np.ndarray, "p p"]

    def values_and_log_prior(self, z: Float[Array, " p"]) -> tuple[Float[Array, " p"], Float[Array, ""]]:
        """Return the parameters' values at z, and the logarithm of the prior's density by z."""
        coordinates = jnp.asarray(self.middle) + jnp.asarray(self.axes) @ z
        values, logs = [], jnp.zeros(())
        for parameter, y, error in zip(self.problem.parameters, coordinates, self.errors, strict=True):
            distance = jax.nn.softplus(y)
            values.append(_value(parameter, y, distance, error))
            if parameter.width == 0.0:
                # d value/d y, up to a constant; a prior flat in the logarithm is divided by the distance to the end
                logs = logs + jax.nn.log_sigmoid(y)
                logs = logs - (jnp.log(distance) if parameter.name in self.log_uniform else 0.0)
        return jnp.stack(values), logs


def space_around(
    problem: Problem,
    values: Float[np.ndarray, " p"],
    covariance: Float[np.ndarray, "p p"],
    log_uniform: tuple[str, ...],
) -> Space:
    """Return the space in which a posterior is about standard normal.

    A loss at its bound is taken to be half a standard error away from it: that is where its posterior lies.

    Args:
        problem: the model.
        values: of the fit.
        covariance: its, finite.
        log_uniform: parameters whose prior is flat in the logarithm of their loss.

    Raises:
        ValueError: if the data hardly tell parameters apart.
    """
    errors = np.sqrt(np.diag(covariance))
    pairs = list(zip(problem.parameters, values, errors, strict=True))
    middle = np.array([_coordinate(p, value, error) for p, value, error in pairs])
    slope = np.array([_slope(p, value, error) for p, value, error in pairs])
    scaled = covariance / np.outer(slope, slope)
    if not np.all(np.isfinite(scaled)) or np.linalg.eigvalsh(scaled / np.trace(scaled))[0] < 1e-15:
        raise ValueError(f"the data hardly tell {', '.join(problem.names)} apart: hold one fixed, or constrain it")
    axes = np.linalg.cholesky(scaled)
    return Space(problem, log_uniform, errors, middle, axes)


def _value(parameter: Parameter, y: Float[Array, ""], distance: Float[Array, ""], error: float) -> Float[Array, ""]:
    """Return the value at a coordinate."""
    if parameter.width:
        return parameter.reference + parameter.width * y
    return parameter.reference + (parameter.sign or 1) * error * distance


def _distance(parameter: Parameter, value: float, error: float) -> float:
    """Return the distance to the end of the range in errors; at an end, half an error."""
    return max(abs(value - parameter.reference) / error, 0.5)


def _slope(parameter: Parameter, value: float, error: float) -> float:
    """Return d value/d y."""
    if parameter.width:
        return parameter.width
    return -(parameter.sign or 1) * error * float(np.expm1(-_distance(parameter, value, error)))


def _coordinate(parameter: Parameter, value: float, error: float) -> float:
    if parameter.width:
        return (value - parameter.reference) / parameter.width
    distance = _distance(parameter, value, error)
    return distance + float(np.log(-np.expm1(-distance)))


__all__ = ["Space", "space_around"]
