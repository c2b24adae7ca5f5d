"""One step of Dormand and Prince's method of order 8, without its error estimate: Diffrax's, or a leaner one.

The lean one takes Diffrax's coefficients; its stages are one small loop over one array, which costs less than half of a
general solver's step and hardly grows with the number of tips up to a few dozen.
"""

from collections.abc import Callable
from functools import cache

import diffrax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from afm_jax.motion.driven import Place


def eighth_order_step(rates: Callable[[Place], Place], begin: Place, length: Float[Array, "..."]) -> Place:
    """Return the place after a step.

    Args:
        rates: rates of a place, which do not depend on time but by the place.
        begin: the place at the beginning; arrays of one shape.
        length: of the step.
    """
    rows, weights = (jnp.asarray(part, begin.x.dtype) for part in _coefficients())
    start = jnp.stack(begin)

    def stage(number, slopes):
        row = lax.dynamic_index_in_dim(rows, number, keepdims=False)
        place = start + length * jnp.tensordot(row, slopes, axes=1)
        return slopes.at[number].set(jnp.stack(rates(Place(*place))))

    slopes = lax.fori_loop(0, len(weights), stage, jnp.zeros((len(weights), *start.shape), start.dtype))
    return Place(*(start + length * jnp.tensordot(weights, slopes, axes=1)))


def diffrax_step(rates: Callable[[Place], Place], begin: Place, length: Float[Array, "..."]) -> Place:
    """Return the place after a step of Diffrax's own solver; arguments as of `eighth_order_step`."""
    solver = diffrax.Dopri8(scan_kind="lax")

    def field(share, place, args):
        del share, args
        return Place(*(length * rate for rate in rates(place)))

    term = diffrax.ODETerm(field)
    zero, one = jnp.zeros((), begin.x.dtype), jnp.ones((), begin.x.dtype)
    memory = solver.init(term, zero, one, begin, None)
    return solver.step(term, zero, one, begin, None, memory, made_jump=False)[0]


@cache
def _coefficients() -> tuple[np.ndarray, np.ndarray]:
    """Return the matrix of the stages, and the weights; the tableau's last stage is the next step's first."""
    tableau = diffrax.Dopri8.tableau
    weights = np.asarray(tableau.b_sol)[:-1]
    rows = np.zeros((len(weights), len(weights)))
    for number, row in enumerate(tableau.a_lower[:-1]):
        rows[number + 1, : number + 1] = row
    return rows, weights
