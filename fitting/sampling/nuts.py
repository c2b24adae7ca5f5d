"""The posterior of many parameters by the no-U-turn sampler of blackjax, an optional package.

Coordinates without ends for a sampler: each parameter's range on the whole line, with its prior.

A value with an end, such as a loss, is its end plus or minus e log(1 + exp(y)), with e its standard error: linear where
the end is errors away, exponential close to it. A posterior that is Gaussian but for the end stays nearly so in y.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from fitting.fits.objective import ROBUST
from fitting.forward import branch_near, impacts_of, linearise_pairs, located
from fitting.models import Problem
from fitting.parameters import Parameter
from fitting.sampling.bootstrap import Refit, standard_covariance
from fitting.sampling.posterior_result import Posterior, PosteriorChains, posterior_of_chains


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


CHAINS = 4
WARM_UP = 300
_SPREAD = 1.0
"""Chains start this many standard deviations apart: R-hat can then tell whether they came together."""


def nuts_posterior(refit: Refit, log_uniform: tuple[str, ...], samples: int, seed: int) -> Posterior:
    """Return samples of the posterior of all parameters, nuisances included.

    Args:
        refit: the fit, from `fitting.sampling.bootstrap.objective_of`; its orbits are followed.
        log_uniform: parameters whose prior is flat in the logarithm of their loss, not in their value.
        samples: draws of every one of the `CHAINS` chains.
        seed: of the sampler.

    Raises:
        ImportError: if blackjax is not installed.
        ValueError: if the data do not determine every parameter.
    """
    blackjax = require_blackjax()
    problem = refit.objective.problem
    space = space_around(problem, refit.values, standard_covariance(refit), log_uniform)
    # blackjax mixes integers of 32 and 64 bits, which strict promotion would refuse
    with jax.numpy_dtype_promotion("standard"):
        drawn, statistics = _chains(blackjax, log_density_of(refit, space), len(problem.names), samples, seed)
        values = np.asarray(jax.jit(jax.vmap(jax.vmap(lambda z: space.values_and_log_prior(z)[0])))(drawn))
        r_hat, effective = diagnose(blackjax, values)
    statistics = {name: np.asarray(each) for name, each in statistics.items()}
    chains = PosteriorChains(values, r_hat, effective, int(statistics["diverging"].sum()), seed, statistics)
    return posterior_of_chains(chains, problem.names, log_uniform)


def require_blackjax() -> Any:
    """Return the sampler's package.

    Raises:
        ImportError: if it is not installed, with what to do.
    """
    try:
        import blackjax  # noqa: PLC0415
        import blackjax.diagnostics  # noqa: PLC0415
    except ImportError as error:
        raise ImportError("sampling three parameters and more needs blackjax: pip install blackjax") from error
    return blackjax


def log_density_of(refit: Refit, space: Space):
    """Return the log density by the coordinates of a space, with its gradient by forward mode.

    Args:
        refit: the fit; its orbits are followed.
        space: of the sampler.
    """
    measurement, problem = refit.objective.measurement, refit.objective.problem
    near = None if refit.objective.near is None else jnp.asarray(refit.objective.near)
    lanes = jnp.zeros(measurement.rows.order.shape[0], dtype=int)
    robust = refit.objective.robust

    def evaluate(values: Float[Array, " p"]) -> tuple[Float[Array, ""], Float[Array, " p"]]:
        impacts = impacts_of(values[None], measurement, problem)
        points = jnp.broadcast_to(values, (lanes.size, values.size))
        branch = located(points, impacts, lanes, measurement, problem) if near is None else branch_near(near)
        block = linearise_pairs(points, impacts, lanes, measurement, problem, branch)
        pull = (values - measurement.constraint_value) / measurement.constraint_error
        residual = jnp.concatenate([block.misfit.ravel(), block.unseen, pull])
        half, weight = _half_loss(residual, robust=robust)
        count = block.misfit.size
        slope = block.slope.reshape(count, -1).T @ weight[:count]
        return -jnp.sum(half), -(slope + weight[-pull.size :] / measurement.constraint_error)

    # The orbits' slopes come by forward mode: nothing of the search is differentiated backward.
    @jax.custom_jvp
    def log_likelihood(values):
        return evaluate(values)[0]

    @log_likelihood.defjvp
    def _(primals, tangents):
        value, gradient = evaluate(*primals)
        return value, gradient @ tangents[0]

    def log_density(z: Float[Array, " p"]) -> Float[Array, ""]:
        values, log_prior = space.values_and_log_prior(z)
        lowest = jnp.asarray([p.lowest for p in problem.parameters])
        highest = jnp.asarray([p.highest for p in problem.parameters])
        inside = jnp.all((values >= lowest) & (values <= highest))
        return jnp.where(inside, log_likelihood(jnp.clip(values, lowest, highest)) + log_prior, -jnp.inf)

    return log_density


def _half_loss(residual: Float[Array, " n"], *, robust: bool) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
    """Return half the loss of every residual, and its derivative."""
    if not robust:
        return 0.5 * residual**2, residual
    root = jnp.sqrt(1.0 + (residual / ROBUST) ** 2)
    return residual**2 / (1.0 + root), residual / root


@partial(jax.jit, static_argnames=("blackjax", "log_density", "count", "samples"))
def _sampled(blackjax, log_density, count: int, samples: int, key):
    """Return draws of one chain that warms up for itself, and what ArviZ knows of the steps, by its names."""
    start, warm, draw = jax.random.split(key, 3)
    place = _SPREAD * jax.random.normal(start, (count,))
    adaptation = blackjax.window_adaptation(blackjax.nuts, log_density, is_mass_matrix_diagonal=False)
    (state, parameters), _ = adaptation.run(warm, place, WARM_UP)
    kernel = blackjax.nuts(log_density, **parameters)

    def one(state, key):
        state, info = kernel.step(key, state)
        told = {
            "diverging": info.is_divergent,
            "energy": info.energy,
            "acceptance_rate": info.acceptance_rate,
            "n_steps": info.num_integration_steps,
        }
        return state, (state.position, told)

    return jax.lax.scan(one, state, jax.random.split(draw, samples))[1]


def _chains(blackjax, log_density, count: int, samples: int, seed: int):
    """Return draws (chains, draws, p) and statistics (chains, draws)."""
    keys = jax.random.split(jax.random.key(seed), CHAINS)
    return jax.jit(jax.vmap(lambda key: _sampled(blackjax, log_density, count, samples, key)))(keys)


def diagnose(blackjax: Any, values: Float[np.ndarray, "chains draws p"]):
    """Return R-hat of the split chains and the number of independent samples, each of shape (p,)."""
    chains, draws, count = values.shape
    halves = values[:, : draws // 2 * 2].reshape(2 * chains, draws // 2, count)
    r_hat = blackjax.diagnostics.potential_scale_reduction(jnp.asarray(halves))
    effective = blackjax.diagnostics.effective_sample_size(jnp.asarray(halves))
    return np.asarray(r_hat), np.asarray(effective)
