"""The posterior of a fit: on a grid for one or two parameters, by NUTS for more."""

from collections.abc import Sequence
from typing import Literal

from fitting.result import FitResult
from fitting.sampling.parametric_bootstrap import require_valid
from fitting.sampling.posterior_result import Posterior
from fitting.sampling.refit import compact, objective_of

FEWEST_SAMPLES = 100


def posterior(
    result: FitResult,
    *,
    method: Literal["auto", "grid", "nuts"] = "auto",
    log_uniform: Sequence[str] = (),
    samples: int = 1000,
    seed: int = 0,
) -> Posterior:
    """Return what is believed of the parameters after the data, with priors flat in their values.

    Constraints of the fit (the quality factor's, calibrations) are Gaussian priors.

    Args:
        result: from `fitting.fit`; it must be valid.
        method: "grid" for models with one or two parameters of their own, nuisances integrated out by Laplace's method;
            "nuts" for any, with the optional package blackjax; "auto": the grid where it can.
        log_uniform: losses whose prior is flat in their logarithm instead.
        samples: for NUTS: draws of each of four chains.
        seed: for NUTS.

    Raises:
        ValueError: if the fit is not valid, an option is impossible, or the data do not determine every parameter.
        ImportError: if NUTS is asked for and blackjax is not installed.
    """
    require_valid(result)
    # the packages of the methods are loaded when they are needed
    from fitting.sampling.posterior_grid import grid_posterior  # noqa: PLC0415
    from fitting.sampling.posterior_nuts import nuts_posterior, require_blackjax  # noqa: PLC0415

    refit = compact(objective_of(result))
    problem = refit.objective.problem
    if method not in {"auto", "grid", "nuts"}:
        raise ValueError(f"`method` must be 'auto', 'grid' or 'nuts', but is {method!r}")
    for name in log_uniform:
        if name not in problem.own or not any(p.name == name and not p.width for p in problem.parameters):
            raise ValueError(f"`log_uniform` must name losses of the model {result.model!r}, but one is {name!r}")
    if method == "grid" or (method == "auto" and len(problem.own) <= 2):
        return grid_posterior(refit, tuple(log_uniform))
    if samples < FEWEST_SAMPLES:
        raise ValueError(f"`samples` must be at least {FEWEST_SAMPLES}, but is {samples}")
    require_blackjax()
    return nuts_posterior(refit, tuple(log_uniform), samples, seed)
