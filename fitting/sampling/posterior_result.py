"""The posterior of a fit's parameters: samples, their means and intervals, and whether they are enough."""

import importlib
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from afm_jax.results import Result, public_result
from afm_jax.saved import as_json
from afm_jax.strict_json import plain


@dataclass(frozen=True, eq=False)
class PosteriorChains:
    """Samples and their diagnostics, by parameter in the order of the names.

    Attributes:
        samples: of shape (chains, draws, p), after warming up.
        r_hat: ratio of the spread of split chains to that within them, 1 if converged; NaN of a Gaussian.
        effective_samples: number of independent samples worth as much; of a Gaussian what 120 draws are worth once they
            are weighted to chi2 itself.
        divergences: transitions that lost the energy.
        seed: of the sampler.
    """

    samples: Float[np.ndarray, "chains draws p"]
    r_hat: Float[np.ndarray, " p"]
    effective_samples: Float[np.ndarray, " p"]
    divergences: int
    seed: int


@public_result(home="fitting.report.report")
@dataclass(frozen=True, eq=False)
class Posterior(Result):
    """The posterior of a fit's parameters.

    Attributes:
        mean: by parameter.
        standard_deviation: by parameter.
        interval95: equal-tailed credible interval by parameter.
        converged: whether to trust it; `reasons` say why not.
        reasons: a sentence each.
        chains: the samples and their diagnostics.
        method: "nuts", the no-U-turn sampler, or "gaussian" around the fit where impacts last.
    """

    mean: dict[str, float]
    standard_deviation: dict[str, float]
    interval95: dict[str, tuple[float, float]]
    converged: bool
    reasons: list[str]
    chains: PosteriorChains
    method: str

    def to_arviz(self) -> Any:
        """Return the samples as ArviZ's data, for its pictures and summaries.

        Raises:
            ModuleNotFoundError: if ArviZ is not installed.
        """
        try:
            arviz = importlib.import_module("arviz")
        except ModuleNotFoundError as error:
            raise ModuleNotFoundError("ArviZ is not installed: pip install arviz", name="arviz") from error
        columns = np.moveaxis(self.chains.samples, -1, 0)
        groups: dict[str, Any] = {"posterior": dict(zip(self.mean, columns, strict=True))}
        # from 1.0 on it takes the groups as one mapping
        return arviz.from_dict(**groups) if arviz.__version__.startswith("0.") else arviz.from_dict(groups)


@as_json.register
def _(drawn: Posterior) -> dict[str, Any]:
    # without the single samples
    chains, kinds = drawn.chains, ("mean", "standard_deviation", "interval95")
    diagnostics = {
        name: dict(zip(drawn.mean, plain(getattr(chains, name)), strict=True))
        for name in ("r_hat", "effective_samples")
    }
    count, draws, _ = chains.samples.shape
    sizes = {"chains": count, "draws": draws, "seed": chains.seed, "divergences": chains.divergences}
    return {
        "method": drawn.method,
        "converged": drawn.converged,
        "reasons": drawn.reasons,
        "parameters": {name: {kind: getattr(drawn, kind)[name] for kind in kinds} for name in drawn.mean},
        "chains": sizes | diagnostics,
    }


def posterior_of_chains(chains: PosteriorChains, names: tuple[str, ...], method: str) -> Posterior:
    """Return means and intervals of samples, and whether the chains agree."""
    flat = chains.samples.reshape(-1, len(names))
    low, high = np.quantile(flat, [0.025, 0.975], axis=0)
    reasons = _complaints(chains, names) if method == "nuts" else []
    return Posterior(
        mean=dict(zip(names, flat.mean(axis=0).tolist(), strict=True)),
        standard_deviation=dict(zip(names, flat.std(axis=0, ddof=1).tolist(), strict=True)),
        interval95={name: (float(a), float(b)) for name, a, b in zip(names, low, high, strict=True)},
        converged=not reasons,
        reasons=reasons,
        chains=chains,
        method=method,
    )


def _complaints(chains: PosteriorChains, names: tuple[str, ...]) -> list[str]:
    """Return why samples are not enough: a 95 % interval needs about a hundred independent ones of one distribution."""
    reasons = []
    for name, r_hat, effective in zip(names, chains.r_hat, chains.effective_samples, strict=True):
        if not r_hat <= 1.02:
            reasons.append(f"{name}: not converged, R-hat is {r_hat:.3f} (at most 1.02); draw more samples")
        elif not effective >= 100.0:
            reasons.append(f"{name}: only {effective:.0f} independent samples; draw more")
    transitions = chains.samples.shape[0] * chains.samples.shape[1]
    if chains.divergences > 0.01 * transitions:
        reasons.append(
            f"{chains.divergences} of {transitions} transitions diverged: part of the posterior may be missing, such "
            "as the edge where an orbit is lost"
        )
    return reasons
