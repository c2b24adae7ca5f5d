"""A way through the bridge by Diffrax: a fixed number of steps of Dormand and Prince's method of order 8 in the gap."""

import diffrax
import jax.numpy as jnp
import numpy as np
from jax import lax

from afm_jax.contact.passage import Passage, Way

GRADING = 1.6
"""Steps towards the inner end shrink on the way in, where the core repulsion rises as the 8th power."""


def pass_in_steps(way: Way, steps: int, solver: diffrax.AbstractERK | None = None) -> Passage:
    """Return the passage after a fixed number of Runge-Kutta steps in p; differentiable forward and reverse.

    Args:
        way: the way.
        steps: number of steps.
        solver: a Diffrax solver; Dopri8 if None. Its `scan_kind` must be "bounded" to be differentiable both ways.
    """
    chosen = diffrax.Dopri8(scan_kind="bounded") if solver is None else solver
    length = way.length

    # The share of p is the time of the solver, one for all tips: a batch is an axis of the state, which costs less than
    # a batch of solvers.
    def field(share, state, args):
        del args
        y, gap = way.place(length * share)
        loss, time = way.rates(y, gap, way.available_aj(gap) - state[0])
        return length * loss, length * time

    term = diffrax.ODETerm(field)

    def step(carried, ends):
        state, memory = carried
        after, _, _, memory, _ = chosen.step(term, ends[0], ends[1], state, None, memory, made_jump=False)
        return (after, memory), None

    fractions = np.linspace(0.0, 1.0, steps + 1)
    if way.inward:
        fractions = 1.0 - (1.0 - fractions) ** GRADING
    ends = jnp.asarray(np.stack([fractions[:-1], fractions[1:]], axis=1), length.dtype)
    nothing = (jnp.zeros_like(length), jnp.zeros_like(length))
    memory = chosen.init(term, ends[0, 0], ends[0, 1], nothing, None)
    ((loss, time), _), _ = lax.scan(step, (nothing, memory), ends)
    return way.end(loss, time)
