"""The posterior of many parameters by the no-U-turn sampler of blackjax, an optional package."""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from fitting.forward import impacts_of, linearise_pairs, located
from fitting.optimise import ROBUST
from fitting.row_orbits import branch_near
from fitting.sampling.posterior_result import Posterior, PosteriorChains, posterior_of_chains
from fitting.sampling.posterior_space import Space, space_around
from fitting.sampling.refit import Refit, standard_covariance

CHAINS = 4
WARM_UP = 300
_SPREAD = 1.0
"""Chains start this many standard deviations apart: R-hat can then tell whether they came together."""


def nuts_posterior(refit: Refit, log_uniform: tuple[str, ...], samples: int, seed: int) -> Posterior:
    """Return samples of the posterior of all parameters, nuisances included.

    Args:
        refit: the fit, from `fitting.sampling.refit.objective_of`; its orbits are followed.
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
        drawn, divergent = _chains(blackjax, log_density_of(refit, space), len(problem.names), samples, seed)
        values = np.asarray(jax.jit(jax.vmap(jax.vmap(lambda z: space.values_and_log_prior(z)[0])))(drawn))
        r_hat, effective = diagnose(blackjax, values)
    chains = PosteriorChains(values, r_hat, effective, int(np.sum(divergent)), seed)
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
        branch = located(values[None], impacts, lanes, measurement, problem) if near is None else branch_near(near)
        block = linearise_pairs(values[None], impacts, lanes, measurement, problem, branch)
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
    """Return draws and divergences of one chain that warms up for itself."""
    start, warm, draw = jax.random.split(key, 3)
    place = _SPREAD * jax.random.normal(start, (count,))
    adaptation = blackjax.window_adaptation(blackjax.nuts, log_density, is_mass_matrix_diagonal=False)
    (state, parameters), _ = adaptation.run(warm, place, WARM_UP)
    kernel = blackjax.nuts(log_density, **parameters)

    def one(state, key):
        state, info = kernel.step(key, state)
        return state, (state.position, info.is_divergent)

    return jax.lax.scan(one, state, jax.random.split(draw, samples))[1]


def _chains(blackjax, log_density, count: int, samples: int, seed: int):
    """Return draws (chains, draws, p) and divergences (chains, draws)."""
    keys = jax.random.split(jax.random.key(seed), CHAINS)
    return jax.jit(jax.vmap(lambda key: _sampled(blackjax, log_density, count, samples, key)))(keys)


def diagnose(blackjax: Any, values: Float[np.ndarray, "chains draws p"]):
    """Return R-hat of the split chains and the number of independent samples, each of shape (p,)."""
    chains, draws, count = values.shape
    halves = values[:, : draws // 2 * 2].reshape(2 * chains, draws // 2, count)
    r_hat = blackjax.diagnostics.potential_scale_reduction(jnp.asarray(halves))
    effective = blackjax.diagnostics.effective_sample_size(jnp.asarray(halves))
    return np.asarray(r_hat), np.asarray(effective)


__all__ = ["CHAINS", "log_density_of", "nuts_posterior", "require_blackjax"]
