"""The fitted impact law over the speeds that were measured, with the band that its parameters' errors leave."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from fitting.models import Problem
from fitting.result import FittedLaw

_POINTS = 121
_TWO_SIDED_95 = 1.959963984540054


def law_with_band(
    problem: Problem,
    values: Float[np.ndarray, " p"],
    covariance: Float[np.ndarray, "p p"],
    approach_speeds: Float[np.ndarray, " rows"],
) -> FittedLaw:
    """Return the law from 0.8 times the slowest to 1.2 times the fastest approach, with its linearised 95 % band.

    Args:
        problem: the model.
        values: fitted values.
        covariance: of the values; infinite entries give an open band (NaN).
        approach_speeds: of the rows' orbits in nm/us, NaN where a row has none.
    """
    known = approach_speeds[np.isfinite(approach_speeds)]
    slow, fast = (0.8 * known.min(), 1.2 * known.max()) if known.size else (1.0, 100.0)
    speeds = np.geomspace(slow, fast, _POINTS)

    rebound, slope = (np.asarray(array) for array in _law_and_slope(jnp.asarray(values), jnp.asarray(speeds), problem))
    if np.all(np.isfinite(covariance)):
        width = _TWO_SIDED_95 * np.sqrt(np.einsum("np,pq,nq->n", slope, covariance, slope))
    else:
        width = np.full_like(rebound, np.nan)
    return FittedLaw(speeds, rebound, np.maximum(rebound - width, 0.0), rebound + width)


@partial(jax.jit, static_argnames=("problem",))
def _law_and_slope(
    values: Float[Array, " p"], speeds: Float[Array, " n"], problem: Problem
) -> tuple[Float[Array, " n"], Float[Array, "n p"]]:
    """Return the rebound speeds and their derivatives by the parameters."""

    def law(v):
        return problem.law(v).rebound_speed(speeds)

    return law(values), jax.jacfwd(law)(values)
