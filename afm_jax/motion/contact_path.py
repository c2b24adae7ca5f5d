"""The path of a tip through its contacts, step by step: what a simulation does not keep, integrated once more."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from afm_jax.contact.driven import Driven, Place
from afm_jax.contact.phases import Phase
from afm_jax.contact.step import Touch, advance, eighth_order_step, fresh_touch

_BLOCK = 128
"""Trials computed in one call."""
_FINENESS = 4.5
_NEWTON_STEPS = 6


class Steps(NamedTuple):
    """Steps of contacts in the order of time, arrays of shape (steps,); each is of one phase."""

    begin_us: np.ndarray
    end_us: np.ndarray
    phase: np.ndarray
    x: np.ndarray
    """At the beginning: the gap in nm, s = sqrt(A) in the junction."""
    rate: np.ndarray
    """Gap rate in nm/us at the beginning."""


def contact_steps(driven: Driven, begin: Place, phase: Int[np.ndarray, " contacts"], until_us: float) -> Steps:
    """Return the steps of contacts from their beginnings to their ends, or to a time.

    Args:
        driven: the equation of motion.
        begin: where each contact begins; arrays of shape (contacts,).
        phase: phase at the beginning.
        until_us: end of the last one at the latest.
    """
    # filled up with tips in no contact to a power of two: few shapes, so that few programs are compiled
    spare = (1 << max(len(phase) - 1, 0).bit_length()) - len(phase)
    place = Place(*(jnp.concatenate([jnp.asarray(part), jnp.ones(spare)]) for part in begin))
    phases = np.concatenate([phase, np.full(spare, int(Phase.DRY))])
    touch = fresh_touch(place, jnp.asarray(phases, jnp.int32))
    until = jnp.asarray(until_us, touch.place.x.dtype)
    parts = []
    while np.any((np.asarray(touch.phase) != Phase.DRY) & (np.asarray(touch.place.time_us) < until_us)):
        touch, record = _some_trials(driven, touch, until)
        taken, *columns = (np.asarray(part) for part in jax.tree.leaves(record))
        parts.append([column[taken] for column in columns])
    joined = [np.concatenate(columns) for columns in zip(*parts, strict=True)] if parts else [np.zeros(0)] * 6
    order = np.argsort(joined[2], kind="stable")
    x, rate, time, _, kinds, ends = (column[order] for column in joined)
    return Steps(time, ends, kinds.astype(int), x, rate)


@jax.jit
def _some_trials(driven: Driven, touch: Touch, until: Float[Array, ""]) -> tuple[Touch, tuple]:
    def once(touch, _):
        going = (touch.phase != Phase.DRY) & (touch.place.time_us < until)
        after = advance(driven, touch, until, _FINENESS)
        taken = going & (after.trial == 0.0)
        kept = jax.tree.map(lambda new, old: jnp.where(going, new, old), after, touch)
        return kept, (taken, *touch.place, touch.phase, after.place.time_us)

    return lax.scan(once, touch, None, length=_BLOCK)


@jax.jit
def places_at(
    driven: Driven, start: Place, phase: Int[Array, " times"], time_us: Float[Array, " times"]
) -> tuple[Float[Array, " times"], Float[Array, " times"]]:
    """Return gap in nm and its rate in nm/us at times within steps, by one step of order 8 from where each began.

    Args:
        driven: the equation of motion.
        start: where the step that holds a time began.
        phase: its phase.
        time_us: the times.
    """
    solid = phase == Phase.JUNCTION

    def stepped(length):
        return eighth_order_step(lambda place: driven.rates(place, solid), start, length)

    # in the junction the variable is fictitious time: its value at a time is a root
    rate = driven.rates(start, solid).time_us

    def newton(_, length):
        end = stepped(length)
        return length + (time_us - end.time_us) / driven.rates(end, solid).time_us

    first = (time_us - start.time_us) / jnp.where(solid, jnp.maximum(rate, 1e-3), 1.0)
    length = lax.fori_loop(0, _NEWTON_STEPS, newton, first)
    end = stepped(length)
    return driven.gap(end.x, phase), end.gap_rate
