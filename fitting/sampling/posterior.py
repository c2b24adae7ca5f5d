"""Samples of the posterior of a fit: of its one residual, with all its unknowns and what is known of them beforehand.

Instantaneous laws: the no-U-turn sampler of blackjax, an optional package, on exp(-chi2/2) with the fit's chi2, times
priors flat in the law's parameters. It moves in coordinates without ends: a loss is its end plus or minus
e log(1 + exp(y)), with e its standard error: linear where the end is errors away, exponential close to it. A posterior
that is Gaussian but for the end stays nearly so in y.

Impacts that last have dozens of unknowns, which the fit's Gaussian N(theta, C) describes: samples are drawn from that.
"""

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from afm_jax.checks import check_count, checked, in_float64
from afm_jax.impact.law import ImpactLaw
from afm_jax.solve.derivatives import value_and_slopes
from fitting.infer.closest import closest_parameters, covariance_of_unknowns
from fitting.infer.explain import Explained
from fitting.infer.fit import explained_of
from fitting.infer.law import root_of
from fitting.infer.result import FitResult
from fitting.infer.search import CENSORED, Followed
from fitting.parameters import PARAMETERS, Parameter, parameter_called
from fitting.predict.instantaneous import read_at, searched
from fitting.predict.orbit import COUNT, Local
from fitting.sampling.posterior_result import Posterior, PosteriorChains, posterior_of_chains
from fitting.tables.several import SeveralTables

CHAINS = 4


@checked
@in_float64
def posterior(result: FitResult, *, samples: int = 1000, seed: int = 0) -> Posterior:
    """Return samples of the posterior of all parameters, nuisances included.

    Of an instantaneous law by the no-U-turn sampler, with priors flat in the law's parameters. Where impacts last they
    are draws of the Gaussian around the fit, which contains what the formula leaves out; values beyond the end of a
    parameter's range are put there. Constraints of the fit (the quality factor's, calibrations) are Gaussian priors.

    Args:
        result: from `fitting.fit`; it must be valid.
        samples: draws of each of four chains.
        seed: of the sampler.

    Raises:
        ValueError: if the fit is not valid or of several tables, an option is impossible, or the data do not determine
            every parameter.
        ModuleNotFoundError: if blackjax is needed and not installed (extra `nuts`).
    """
    if not result.valid:
        raise ValueError(f"the fit of the model {result.model!r} is not valid ({result.reasons[0]}); mend it first")
    if isinstance(result.table, SeveralTables):
        raise ValueError(  # noqa: TRY004 (a fit of several tables is no wrong type)
            "a posterior is about one table; the intervals of a joint fit are its own"
        )
    check_count("samples", samples, 100)
    lasting = sampled_by_gaussian(result.model)
    if not lasting:
        require_blackjax()
    explained, names = explained_of(result), tuple(result.parameters)
    chains = _gaussian(explained, result, samples, seed) if lasting else _nuts(log_density_of(explained), samples, seed)
    return posterior_of_chains(chains, names, "gaussian" if lasting else "nuts")


def sampled_by_gaussian(model: str) -> bool:
    """Say whether the samples of a model are those of a Gaussian: where impacts last."""
    return model == "contact" or model.endswith("+delay")


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


def _gaussian(explained: Explained, result: FitResult, samples: int, seed: int) -> PosteriorChains:
    """Return draws of the Gaussian around a fit whose impacts last, and what some are worth once weighted to chi2."""
    names, end = tuple(result.parameters), explained.end
    closest = closest_parameters(explained, tuple(result.settings["free"]), result.settings["fixed"])
    root = root_of(covariance_of_unknowns(explained))
    drawn = np.random.default_rng(seed).normal(size=(CHAINS, samples, root.shape[1]))
    ends = np.array([(parameter.lowest, parameter.highest) for parameter in map(parameter_called, names)])
    values = np.clip(closest.values + drawn @ closest.factor.T, *ends.T)
    some = drawn.reshape(-1, root.shape[1])[:120]
    rows = Followed(explained.model, end.theta, end.orbits, explained.weights, np.inf)
    chi2 = np.array([rows.sum(end.theta + root @ z).value for z in some])
    raw = -0.5 * (chi2 - np.sum(some**2, axis=1))
    weight = np.exp(raw - raw.max(initial=-1e9))
    worth = weight.sum() ** 2 / max(np.sum(weight**2), 1e-300)
    return PosteriorChains(values, np.full(len(names), np.nan), np.full(len(names), worth), 0, seed)


@dataclass(frozen=True, eq=False)
class LogDensity:
    """The logarithm of the posterior's density of an instantaneous law, at coordinates z about standard normal.

    Attributes:
        explained: the fit.
        law: parameters of the law.
        errors: their standard errors e.
        middle: the fit in coordinates y, of law and instrument, whose unknowns are those of the fit.
        axes: its columns are steps of about one standard deviation each.
    """

    explained: Explained
    law: tuple[Parameter, ...]
    errors: Float[np.ndarray, " l"]
    middle: Float[np.ndarray, " k"]
    axes: Float[np.ndarray, "k k"]

    def place(self, z: Float[Array, " k"]) -> tuple[dict[str, Any], Any, Float[Array, ""]]:
        """Return the law's parameters, the instrument's unknowns, and the logarithm of the prior's density by z."""
        y, count = self.middle + self.axes @ z, len(self.law)
        distance = self.errors * jax.nn.softplus(y[:count])
        values = {known.name: known.reference + known.sign * off for known, off in zip(self.law, distance, strict=True)}
        # d value/d y, up to a constant
        return values, y[count:], jnp.sum(jax.nn.log_sigmoid(y[:count]))

    def values(self, z: Float[Array, " k"]) -> Float[Array, " p"]:
        """Return the parameters as the fit prints them."""
        values, instrument, _ = self.place(z)
        quantities = zip(self.explained.model.instrument, instrument, strict=True)
        return jnp.stack([*values.values(), *(quantity.at(y, jnp) for quantity, y in quantities)])

    def residual(self, z: Float[Array, " k"]) -> Float[Array, " n"]:
        """Return the fit's residuals, what is known beforehand included; differentiable forward."""
        model, weights = self.explained.model, self.explained.weights
        law: Any = model.law
        values, instrument, _ = self.place(z)
        known: dict[str, Any] = {"r": 1.0, "epsilon": 0.0} | dict(law.fixed) | values
        impact = ImpactLaw(**known)
        unknowns = [law.unknown_of(name, value) for name, value in values.items()]
        data, theta = model.data, jnp.stack([*unknowns, *instrument])

        def one(instrument, row, read, error):
            local = Local(*jnp.zeros(COUNT - instrument.size), *instrument)
            seen = searched(*lax.stop_gradient((impact, local)), row, read, error, data.drives[0])
            there = read_at(seen.coordinate, impact, local, row, data.drives[0])
            return jnp.where(seen.orbits > 0, there, seen.readings), seen.orbits

        columns = jnp.stack(model.instrument_columns(theta, jnp), axis=1)
        readings, orbits = jax.vmap(one)(columns, data.row, data.read, np.nan_to_num(data.error, nan=1.0))
        off = jnp.where(weights.used, readings - np.nan_to_num(data.read), 0.0)
        white = jnp.einsum("nij,nj->ni", weights.whitening, off).ravel()
        unseen = jnp.where(data.no_orbit & (orbits > 0), CENSORED, 0.0)
        mean, strength = model.prior
        return jnp.concatenate([white, unseen, strength * (theta - mean)])

    def __call__(self, z: Float[Array, " k"]) -> Float[Array, ""]:
        """Return the logarithm of the density by z, but for a constant; minus infinity outside the ranges."""
        # the orbits' slopes come by forward mode: nothing of the search is differentiated backward
        still = lax.stop_gradient(z)
        residual, slope = lax.stop_gradient(value_and_slopes(self.residual, still))
        log_likelihood = -0.5 * residual @ residual - residual @ slope @ (z - still)
        values, _, log_prior = self.place(z)
        inside = jnp.isfinite(log_likelihood)
        for known in self.law:
            inside &= (values[known.name] >= known.lowest) & (values[known.name] <= known.highest)
        return jnp.where(inside, log_likelihood + log_prior, -jnp.inf)


def log_density_of(explained: Explained) -> LogDensity:
    """Return the log density of a fit's posterior.

    A loss at its bound is taken to be half a standard error away from it: that is where its posterior lies.

    Args:
        explained: the fit, of an instantaneous law.

    Raises:
        ValueError: if the data hardly tell parameters apart.
    """
    model, middle = explained.model, explained.end.theta.copy()
    law: Any = model.law
    parameters = tuple(PARAMETERS[name] for name in law.names)
    covariance, slope = covariance_of_unknowns(explained), np.ones(middle.size)
    errors = np.sqrt(np.diag(covariance))[: len(parameters)]
    for i, known in enumerate(parameters):
        by_unknown = law.slope_of(known.name, middle[i])
        off = law.value_of(known.name, middle[i]) - known.reference
        errors[i] *= abs(by_unknown)
        distance = max(abs(off) / errors[i], 0.5)
        share = -np.expm1(-distance)
        middle[i], slope[i] = distance + np.log(share), by_unknown / (known.sign * errors[i] * share)
    with np.errstate(invalid="ignore"):
        # what is not determined has no covariance
        covariance = covariance * np.outer(slope, slope)
    if not np.isfinite(covariance).all() or np.linalg.eigvalsh(covariance / np.trace(covariance))[0] < 1e-15:
        raise ValueError(f"the data hardly distinguish {', '.join(model.names)}: hold one fixed, or constrain it")
    return LogDensity(explained, parameters, errors, middle, np.linalg.cholesky(covariance))


def _nuts(density: LogDensity, samples: int, seed: int) -> PosteriorChains:
    """Return chains of the no-U-turn sampler, each started from a place of its own about an error away."""
    blackjax = require_blackjax()
    log_density = jax.jit(density.__call__)
    size = density.middle.size

    def chain(key):
        start, warm, draw = jax.random.split(key, 3)
        adaptation = blackjax.window_adaptation(blackjax.nuts, log_density, is_mass_matrix_diagonal=False)
        (state, found), _ = adaptation.run(warm, jax.random.normal(start, (size,)), 300)
        kernel = blackjax.nuts(log_density, **found)

        def step(state, key):
            state, info = kernel.step(key, state)
            return state, (density.values(state.position), info.is_divergent)

        return lax.scan(step, state, jax.random.split(draw, samples))[1]

    # blackjax mixes integers of 32 and 64 bits, which strict promotion would refuse
    with jax.numpy_dtype_promotion("standard"):
        drawn, diverging = jax.jit(jax.vmap(chain))(jax.random.split(jax.random.key(seed), CHAINS))
        values = np.asarray(drawn)
        halves = jnp.asarray(values[:, : samples // 2 * 2].reshape(2 * CHAINS, samples // 2, -1))
        # of one parameter they have no axis
        r_hat = np.atleast_1d(blackjax.diagnostics.potential_scale_reduction(halves))
        effective = np.atleast_1d(blackjax.diagnostics.effective_sample_size(halves))
    return PosteriorChains(values, r_hat, effective, int(diverging.sum()), seed)
