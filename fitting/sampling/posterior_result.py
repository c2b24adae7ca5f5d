"""The posterior of a fit's parameters: samples, their means and intervals, and whether they are enough."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from afm_jax.results import Result, public_result
from afm_jax.strict_json import plain

HIGHEST_R_HAT = 1.02
"""Samples with a larger ratio between and within chains do not describe one distribution."""
FEWEST_EFFECTIVE = 100.0
"""Independent samples that a 95 % interval needs at least."""
MOST_DIVERGENCES = 0.01
"""Share of divergent transitions beyond which part of the posterior may be missing."""


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


@public_result()
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

    def to_dict(self) -> dict[str, Any]:
        """Return everything but the single samples as plain lists, numbers and strings."""
        chains, draws, _ = self.chains.samples.shape
        return {
            "method": self.method,
            "converged": self.converged,
            "reasons": self.reasons,
            "parameters": {
                name: {
                    "mean": self.mean[name],
                    "standard_deviation": self.standard_deviation[name],
                    "interval95": list(self.interval95[name]),
                }
                for name in self.mean
            },
            "chains": {
                "chains": chains,
                "draws": draws,
                "seed": self.chains.seed,
                "divergences": self.chains.divergences,
                "r_hat": dict(zip(self.mean, plain(self.chains.r_hat), strict=True)),
                "effective_samples": dict(zip(self.mean, plain(self.chains.effective_samples), strict=True)),
            },
        }

    def to_arviz(self) -> Any:
        """Return the samples as ArviZ's data, for its pictures and summaries.

        Raises:
            ModuleNotFoundError: if ArviZ is not installed.
        """
        try:
            import arviz  # noqa: PLC0415
        except ModuleNotFoundError as error:
            raise ModuleNotFoundError("ArviZ is not installed: pip install arviz", name="arviz") from error
        columns = np.moveaxis(self.chains.samples, -1, 0)
        groups: dict[str, Any] = {"posterior": dict(zip(self.mean, columns, strict=True))}
        # from 1.0 on it takes the groups as one mapping
        return arviz.from_dict(**groups) if arviz.__version__.startswith("0.") else arviz.from_dict(groups)


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
    reasons = []
    for name, r_hat, effective in zip(names, chains.r_hat, chains.effective_samples, strict=True):
        if not r_hat <= HIGHEST_R_HAT:
            reasons.append(f"{name}: not converged, R-hat is {r_hat:.3f} (at most {HIGHEST_R_HAT}); draw more samples")
        elif not effective >= FEWEST_EFFECTIVE:
            reasons.append(f"{name}: only {effective:.0f} independent samples; draw more")
    transitions = chains.samples.shape[0] * chains.samples.shape[1]
    if chains.divergences > MOST_DIVERGENCES * transitions:
        reasons.append(
            f"{chains.divergences} of {transitions} transitions diverged: part of the posterior may be missing, such "
            "as the edge where an orbit is lost"
        )
    return reasons
