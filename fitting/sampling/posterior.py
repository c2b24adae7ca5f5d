"""The posterior of a fit, by the no-U-turn sampler of blackjax, an optional package.

The density is exp(-chi2/2) with the objective's chi2, constraints of the fit included, times priors flat in the values.
The sampler moves in coordinates without ends: each parameter's range on the whole line, with its prior. A value with an
end, such as a loss, is its end plus or minus e log(1 + exp(y)), with e its standard error: linear where the end is
errors away, exponential close to it. A posterior that is Gaussian but for the end stays nearly so in y.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from afm_jax.checks import checked
from fitting.infer.rows import ROBUST
from fitting.infer.result import FitResult
from fitting.forward import Lanes, impacts_of, linearised
from fitting.models import Measurement, Problem
from fitting.parameters import Parameter
from fitting.sampling.posterior_result import Posterior, PosteriorChains, posterior_of_chains
from fitting.sampling.refit import Refit, compact, objective_of, require_valid, standard_covariance

FEWEST_SAMPLES = 100
CHAINS = 4
WARM_UP = 300
_SPREAD = 1.0
"""Chains start this many standard deviations apart: R-hat can then tell whether they came together."""


@checked
def posterior(
    result: FitResult,
    *,
    samples: int = 1000,
    seed: int = 0,
) -> Posterior:
    """Return samples of the posterior of all parameters, nuisances included, with priors flat in their values.

    Constraints of the fit (the quality factor's, calibrations) are Gaussian priors. The model's formula is taken as
    exact: where impacts last, the fit's values and intervals contain its error, and those of samples may contradict
    them.

    Args:
        result: from `fitting.fit`; it must be valid.
        samples: draws of each of four chains.
        seed: of the sampler.

    Raises:
        ValueError: if the fit is not valid, an option is impossible, or the data do not determine every parameter.
        ModuleNotFoundError: if blackjax is not installed (extra `nuts`).
    """
    require_valid(result)
    refit = compact(objective_of(result))
    if samples < FEWEST_SAMPLES:
        raise ValueError(f"`samples` must be at least {FEWEST_SAMPLES}, but is {samples}")
    blackjax = require_blackjax()
    covariance = standard_covariance(refit)
    density = log_density_of(refit, covariance)
    # blackjax mixes integers of 32 and 64 bits, which strict promotion would refuse
    with jax.numpy_dtype_promotion("standard"):
        drawn, diverging = _chains(density, jax.random.split(jax.random.key(seed), CHAINS), samples)
        values = np.asarray(_values_of(density.space, drawn))
        halves = jnp.asarray(values[:, : samples // 2 * 2].reshape(2 * CHAINS, samples // 2, -1))
        # of one parameter they have no axis
        r_hat = np.atleast_1d(blackjax.diagnostics.potential_scale_reduction(halves))
        effective = np.atleast_1d(blackjax.diagnostics.effective_sample_size(halves))
    chains = PosteriorChains(values, r_hat, effective, int(diverging.sum()), seed)
    return posterior_of_chains(chains, refit.objective.problem.names)


def require_blackjax() -> Any:
    """Return the sampler's package.

    Raises:
        ModuleNotFoundError: if it is not installed, with what to do.
    """
    try:
        import blackjax  # noqa: PLC0415
        import blackjax.diagnostics  # noqa: PLC0415
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(
            "sampling a posterior needs the package blackjax: pip install 'afm-jax[nuts]'", name="blackjax"
        ) from error
    return blackjax


class Space(eqx.Module):
    """Where the sampler moves: the parameters' coordinates are `middle` + `axes` z, with z about standard normal.

    Attributes:
        problem: the model.
        errors: standard errors e of the values, shape (p,).
        middle: coordinates of the fit, shape (p,).
        axes: its columns are steps of about one standard deviation each, shape (p, p).
    """

    problem: Problem = eqx.field(static=True)
    errors: Float[Array, " p"]
    middle: Float[Array, " p"]
    axes: Float[Array, "p p"]

    def values_and_log_prior(self, z: Float[Array, " p"]) -> tuple[Float[Array, " p"], Float[Array, ""]]:
        """Return the parameters' values at z, and the logarithm of the prior's density by z."""
        coordinates = self.middle + self.axes @ z
        values, logs = [], jnp.zeros(())
        for i, parameter in enumerate(self.problem.parameters):
            y = coordinates[i]
            if parameter.width:
                values.append(parameter.reference + parameter.width * y)
                continue
            distance = jax.nn.softplus(y)
            values.append(parameter.reference + (parameter.sign or 1) * self.errors[i] * distance)
            # d value/d y, up to a constant
            logs = logs + jax.nn.log_sigmoid(y)
        return jnp.stack(values), logs


def space_around(
    problem: Problem,
    values: Float[np.ndarray, " p"],
    covariance: Float[np.ndarray, "p p"],
) -> Space:
    """Return the space in which a posterior is about standard normal.

    A loss at its bound is taken to be half a standard error away from it: that is where its posterior lies.

    Args:
        problem: the model.
        values: of the fit.
        covariance: its, finite.

    Raises:
        ValueError: if the data hardly tell parameters apart.
    """
    errors = np.sqrt(np.diag(covariance))
    triples = zip(problem.parameters, values, errors, strict=True)
    middle, slope = np.array([_coordinate_and_slope(*triple) for triple in triples]).T
    scaled = covariance / np.outer(slope, slope)
    if not np.all(np.isfinite(scaled)) or np.linalg.eigvalsh(scaled / np.trace(scaled))[0] < 1e-15:
        raise ValueError(f"the data hardly tell {', '.join(problem.names)} apart: hold one fixed, or constrain it")
    axes = np.linalg.cholesky(scaled)
    return Space(problem, jnp.asarray(errors), jnp.asarray(middle), jnp.asarray(axes))


def _coordinate_and_slope(parameter: Parameter, value: float, error: float) -> tuple[float, float]:
    """Return the coordinate y of a value, and d value/d y there."""
    if parameter.width:
        return (value - parameter.reference) / parameter.width, parameter.width
    distance = max(abs(value - parameter.reference) / error, 0.5)
    share = -float(np.expm1(-distance))
    return distance + float(np.log(share)), (parameter.sign or 1) * error * share


class LogDensity(eqx.Module):
    """The logarithm of the posterior's density at coordinates z of a space, with its gradient by forward mode.

    All numbers are traced: one program serves all tables with as many rows.

    Attributes:
        space: of the sampler.
        measurement: the rows, and what is known of parameters.
        near: approach speeds of the orbits to follow; None: they are searched for.
        robust: whether outliers count linearly.
    """

    space: Space
    measurement: Measurement
    near: Float[Array, " rows"] | None
    robust: bool = eqx.field(static=True)

    def __call__(self, z: Float[Array, " p"]) -> Float[Array, ""]:
        """Return the logarithm of the density by z, but for a constant; minus infinity outside the ranges."""
        # the orbits' slopes come by forward mode: nothing of the search is differentiated backward
        log_likelihood = jax.custom_jvp(lambda values: self._log_likelihood_and_gradient(values)[0])

        @log_likelihood.defjvp
        def _(primals, tangents):
            value, gradient = self._log_likelihood_and_gradient(*primals)
            return value, gradient @ tangents[0]

        values, log_prior = self.space.values_and_log_prior(z)
        lowest, highest = jnp.asarray(self.space.problem.ends)
        inside = jnp.all((values >= lowest) & (values <= highest))
        return jnp.where(inside, log_likelihood(jnp.clip(values, lowest, highest)) + log_prior, -jnp.inf)

    def _log_likelihood_and_gradient(self, values: Float[Array, " p"]) -> tuple[Float[Array, ""], Float[Array, " p"]]:
        measurement, problem = self.measurement, self.space.problem
        lanes = jnp.zeros(measurement.rows.order.shape[0], dtype=int)
        impacts = impacts_of(values[None], measurement, problem)
        points = jnp.broadcast_to(values, (lanes.size, values.size))
        block = linearised(Lanes(points, impacts, lanes, measurement), problem, self.near)
        constraint = (values - measurement.constraint_value) / measurement.constraint_error
        residual = jnp.concatenate([block.misfit.ravel(), block.unseen, constraint])
        root = jnp.sqrt(1.0 + (residual / ROBUST) ** 2) if self.robust else jnp.ones_like(residual)
        # half the loss: r^2/2, or s^2 (sqrt(1 + r^2/s^2) - 1) with the softness s; its derivative is r/root
        half, weight = residual**2 / (1.0 + root), residual / root
        count = block.misfit.size
        slope = block.slope.reshape(count, -1).T @ weight[:count]
        return -jnp.sum(half), -(slope + weight[-constraint.size :] / measurement.constraint_error)


def log_density_of(refit: Refit, covariance: Float[np.ndarray, "p p"]) -> LogDensity:
    """Return the log density of a fit's posterior, in the space that is scaled by its covariance.

    Args:
        refit: the fit, from `fitting.sampling.refit.objective_of`; its orbits are followed.
        covariance: of its values.

    Raises:
        ValueError: if the data hardly tell parameters apart.
    """
    objective = refit.objective
    space = space_around(objective.problem, refit.values, covariance)
    near = None if objective.near is None else jnp.asarray(objective.near)
    measurement = jax.tree.map(jnp.asarray, objective.measurement)
    return LogDensity(space, measurement, near, robust=objective.robust)


@eqx.filter_jit
def _chains(density: LogDensity, keys, samples: int):
    """Return draws (chains, draws, p), and of shape (chains, draws) which steps diverged."""
    blackjax = require_blackjax()

    def chain(key):
        start, warm, draw = jax.random.split(key, 3)
        place = _SPREAD * jax.random.normal(start, density.space.middle.shape)
        adaptation = blackjax.window_adaptation(blackjax.nuts, density, is_mass_matrix_diagonal=False)
        (state, parameters), _ = adaptation.run(warm, place, WARM_UP)
        kernel = blackjax.nuts(density, **parameters)

        def step(state, key):
            state, info = kernel.step(key, state)
            return state, (state.position, info.is_divergent)

        return jax.lax.scan(step, state, jax.random.split(draw, samples))[1]

    return jax.vmap(chain)(keys)


@eqx.filter_jit
def _values_of(space: Space, drawn: Float[Array, "chains draws p"]) -> Float[Array, "chains draws p"]:
    return jax.vmap(jax.vmap(lambda z: space.values_and_log_prior(z)[0]))(drawn)
