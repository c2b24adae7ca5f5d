"""The fitted impact law over the speeds that were measured, with the band that its parameters' errors leave."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from afm_jax.impact.lasting_impact import LawImpact
from fitting.measurement import Measurement
from fitting.models import Problem
from fitting.result import FittedLaw
from fitting.row_orbits import impact_of

_POINTS = 121
_TWO_SIDED_95 = 1.959963984540054


def law_with_band(
    problem: Problem,
    measurement: Measurement,
    values: Float[np.ndarray, " p"],
    covariance: Float[np.ndarray, "p p"],
    approach_speeds: Float[np.ndarray, " rows"],
) -> FittedLaw:
    """Return the law from 0.8 times the slowest to 1.2 times the fastest approach, with its linearised 95 % band.

    Args:
        problem: the model.
        measurement: gives the contact's fixed parameters.
        values: fitted values.
        covariance: of the values; infinite entries give an open band (NaN).
        approach_speeds: of the rows' orbits in nm/us, NaN where a row has none.
    """
    known = approach_speeds[np.isfinite(approach_speeds)]
    slow, fast = (0.8 * known.min(), 1.2 * known.max()) if known.size else (1.0, 100.0)
    speeds = np.geomspace(slow, fast, _POINTS)
    law, slope = law_and_slope(jnp.asarray(values), jnp.asarray(speeds), measurement, problem)
    rebound, delay = np.asarray(law)
    if np.all(np.isfinite(covariance)):
        width = _TWO_SIDED_95 * np.sqrt(np.einsum("lnp,pq,lnq->ln", np.asarray(slope), covariance, np.asarray(slope)))
    else:
        width = np.full((2, _POINTS), np.nan)
    return FittedLaw(
        approach_speed_nm_per_us=speeds,
        rebound_speed_nm_per_us=rebound,
        rebound_low_nm_per_us=np.maximum(rebound - width[0], 0.0),
        rebound_high_nm_per_us=rebound + width[0],
        collision_delay_us=delay,
        delay_low_us=delay - width[1],
        delay_high_us=delay + width[1],
    )


@partial(jax.jit, static_argnames=("problem",))
def law_and_slope(
    values: Float[Array, " p"], speeds: Float[Array, " n"], measurement: Measurement, problem: Problem
) -> tuple[Float[Array, "2 n"], Float[Array, "2 n p"]]:
    """Return rebound speeds and delays at approach speeds, and their derivatives by the parameters."""

    def law(v):
        impact = impact_of(v, measurement, problem)
        if isinstance(impact, LawImpact):
            return jnp.stack([impact.law.rebound_speed(speeds), impact.law.collision_delay(speeds)])
        found = jax.vmap(impact.speeds)(speeds)
        # below the table the contact captures
        free = speeds > impact.lowest
        return jnp.stack([jnp.where(free, found.rebound, 0.0), jnp.where(free, found.delay, 0.0)])

    return law(values), jax.jacfwd(law)(values)
