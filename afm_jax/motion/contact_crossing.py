"""The quick way through a driven contact: in through the bridge, through the junction, and out again, leg by leg.

The gap is the variable in the bridge, s = sqrt(A) in the junction, so that thresholds are met without a search, and the
speed follows from the energy: the static forces, which vary most, need no integration. A leg holds for a tip that goes
straight on. One that turns in the bridge, or is slow somewhere, stays where the last leg that held has left it. It goes
on from there in time, until it is where a leg begins again.
"""

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool

from afm_jax.contact.bridge_leg import go_in, go_out
from afm_jax.contact.driven import Driven, Place
from afm_jax.contact.junction_leg import go_through_junction
from afm_jax.contact.leg import Leg
from afm_jax.contact.phases import Phase
from afm_jax.contact.settings import DrivenSetting, QuickSetting
from afm_jax.contact.step import Touch, junction_pace


def cross(driven: Driven, place: Place, setting: QuickSetting) -> Leg:
    """Return a tip beyond the contact that it has just begun.

    Args:
        driven: the equation of motion.
        place: where the bridge forms; the gap closes.
        setting: how finely.
    """
    inward = go_in(driven, place, setting)
    solid = go_through_junction(driven, inward.place, setting)
    outward = go_out(driven, solid.place, setting)
    return outward._replace(deepest_gap_nm=solid.deepest_gap_nm, holds=inward.holds & solid.holds & outward.holds)


def at_junction(driven: Driven, touch: Touch) -> Bool[Array, "..."]:
    """Say whether a tip has just formed the junction, so that the quick way may go on from there."""
    return (touch.phase == Phase.JUNCTION) & (touch.place.x == driven.junction.forms_root) & (touch.trial == 0.0)


def go_quickly(
    driven: Driven, touch: Touch, arrived: Array, active: Array, until_us: Array, setting: DrivenSetting
) -> Touch:
    """Return a tip as far on its way through the contact as legs hold that end before a time.

    Args:
        driven: the equation of motion.
        touch: the tip.
        arrived: it has just begun the contact.
        active: it moves.
        until_us: the time.
        setting: how finely.
    """
    quick = setting.quick
    if quick is None:
        raise ValueError("`setting` has no quick way")

    def taken(leg, wanted):
        return wanted & leg.holds & (leg.place.time_us < until_us)

    leg = go_in(driven, touch.place, quick)
    formed = taken(leg, arrived)
    touch = _moved(touch, leg, formed, Phase.JUNCTION)
    touch = touch._replace(
        junctions=touch.junctions + formed.astype(touch.junctions.dtype),
        junction_forms_us=jnp.where(formed, touch.place.time_us, touch.junction_forms_us),
    )
    leg = go_through_junction(driven, touch.place, quick)
    wet = driven.junction.breaks_gap_nm < driven.breaks_nm
    waits = at_junction(driven, touch) & active
    broken = taken(leg, waits & wet)
    # one for which it does not hold is told how far to go in time, and waits no longer
    there = lax.stop_gradient(touch.place._replace(x=driven.junction.forms_root))
    step = lax.stop_gradient(1.0 / (setting.fineness * junction_pace(driven, there)))
    touch = touch._replace(trial=jnp.where(waits & ~broken, step, touch.trial))
    passed = touch.time_in_junction_us + leg.place.time_us - touch.place.time_us
    touch = _moved(touch, leg, broken, Phase.BRIDGE)
    touch = touch._replace(
        junction_breaks_us=jnp.where(broken, touch.place.time_us, touch.junction_breaks_us),
        time_in_junction_us=jnp.where(broken, passed, touch.time_in_junction_us),
    )
    leg = go_out(driven, touch.place, quick)
    return _moved(touch, leg, taken(leg, broken), Phase.DRY)


def _moved(touch: Touch, leg: Leg, moves: Array, phase: Phase) -> Touch:
    """Return a tip at the end of a leg, where it takes it."""
    return touch._replace(
        place=jax.tree.map(lambda new, old: jnp.where(moves, new, old), leg.place, touch.place),
        phase=jnp.where(moves, phase, touch.phase).astype(touch.phase.dtype),
        trial=jnp.where(moves, 0.0, touch.trial),
        deepest_gap_nm=jnp.where(moves, jnp.minimum(touch.deepest_gap_nm, leg.deepest_gap_nm), touch.deepest_gap_nm),
    )
