"""The contact model in mpmath: collisions of a free tip with a sample at rest, with a chosen number of right digits.

Written from section IV alone and sharing nothing with the package, so that agreement with it means something. Phases:
DRY -> BRIDGE at 3.5 nm inwards, BRIDGE -> JUNCTION at D_on, JUNCTION -> BRIDGE at D_off, BRIDGE -> DRY at 4.7 nm; a
junction that reaches beyond 4.7 nm breaks straight into DRY. The cantilever's spring is left out.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

from tests.reference_contact_bridge import cross_bridge, junction_time, turning_s
from tests.reference_contact_forces import (
    DIGITS,
    GUARD_DIGITS,
    Constants,
    ContactParameters,
    Number,
    constants,
    fold,
    jkr_depth,
    jkr_potential,
    mp,
    static_force,
)
from tests.reference_contact_junction import Junction, junction

PUBLISHED = {
    12: (4.8899, -0.5148),
    15: (10.1805, -0.0999),
    20: (16.6251, 0.0167),
    30: (27.7774, 0.0650),
    40: (38.2958, 0.0750),
    60: (58.7902, 0.0778),
    100: (99.1735, 0.0746),
    200: (199.4561, 0.0674),
}
"""Rebound speed (nm/us) and delay (us) of the paper's contact by an independent program, to the digits it printed."""


class Collision(NamedTuple):
    """One collision, in the program's units; rebound speed and delay are nan where the tip is captured."""

    captured: bool
    rebound_speed_nm_per_us: Number
    delay_us: Number
    time_in_junction_us: Number
    deepest_gap_nm: Number
    viscous_loss_aj: Number


class Differences(NamedTuple):
    """Derivatives of rebound speed and delay with respect to one parameter."""

    rebound_speed: Number
    delay: Number


def collision(p: ContactParameters, approach_speed: Number, *, digits: int = DIGITS) -> Collision:
    """Return what becomes of a free tip that approaches a sample at rest.

    The delay is the time between the crossings of gap 0 by the straight paths before and after. Captured is a tip that
    stops on its way out.

    Args:
        p: the parameters.
        approach_speed: u_in in nm/us, positive.
        digits: how many digits are to be right.

    Raises:
        ValueError: if the tip turns round before the junction, for which there is no rule.
    """
    with mp.workdps(digits + GUARD_DIGITS):
        k, solid, speed = constants(p), junction(p, digits=digits + GUARD_DIGITS), mp.mpf(approach_speed)
        way_in = cross_bridge(k, k.forms, -speed, solid.snap_on_gap_nm)
        if not way_in.reached:
            raise ValueError(f"at {approach_speed} nm/us the tip turns round before the junction; take a higher speed")
        energy = k.mass * way_in.velocity_nm_per_us**2 / 2 + jkr_potential(k, solid.snap_on_s)
        turn = turning_s(k, energy)
        way_out = leave(k, solid, turn, energy - jkr_potential(k, fold()))
        delay = way_in.time_us + way_out.time_us - k.forms / speed - way_out.gap_nm / way_out.speed_nm_per_us
        return Collision(
            captured=mp.isnan(way_out.speed_nm_per_us),
            rebound_speed_nm_per_us=way_out.speed_nm_per_us,
            delay_us=delay,
            time_in_junction_us=way_out.time_in_junction_us,
            deepest_gap_nm=solid.shift_nm - jkr_depth(k, turn),
            viscous_loss_aj=way_in.viscous_loss_aj + way_out.viscous_loss_aj,
        )


class WayOut(NamedTuple):
    """The way out from D_on; speed and times are nan where they do not exist."""

    time_us: Number  # from D_on on the way in to the end of contact
    time_in_junction_us: Number
    gap_nm: Number  # at the end of contact
    speed_nm_per_us: Number
    viscous_loss_aj: Number


def leave(k: Constants, solid: Junction, turn: Number, energy: Number) -> WayOut:
    """Follow the tip from D_on on its way in, given its turning point and its energy at the fold in aJ."""
    off, nothing = solid.snap_off_gap_nm, mp.mpf(0)
    if energy <= 0:
        return WayOut(mp.nan, mp.nan, off, mp.nan, nothing)
    duration = junction_time(k, solid.snap_on_s, turn) + junction_time(k, fold(), turn)
    speed = mp.sqrt(2 * energy / k.mass)
    if off >= k.breaks:
        return WayOut(duration, duration, off, speed, nothing)
    bridge = cross_bridge(k, off, speed, k.breaks)
    if not bridge.reached:
        return WayOut(mp.nan, duration, bridge.gap_nm, mp.nan, bridge.viscous_loss_aj)
    time, speed = duration + bridge.time_us, bridge.velocity_nm_per_us
    return WayOut(time, duration, bridge.gap_nm, speed, bridge.viscous_loss_aj)


def capture_speed(p: ContactParameters, *, digits: int = DIGITS) -> Number:
    """Return the approach speed in nm/us up to which the tip is captured.

    The collision is followed back in time from rest at the end of contact, or at the fold if the bridge beyond pushes
    only, so that nothing is searched for.

    Raises:
        ValueError: if the bridge pulls here and pushes there on the way out: a barely escaping tip would then creep
            over a summit of its potential; or if no speed is captured.
    """
    with mp.workdps(digits + GUARD_DIGITS):
        k, solid = constants(p), junction(p, digits=digits + GUARD_DIGITS)
        off, speed = solid.snap_off_gap_nm, mp.mpf(0)
        signs = {mp.sign(static_force(k, gap)) for gap in mp.linspace(off, k.breaks, 50)}
        if off < k.breaks and len(signs) > 1:
            raise ValueError("no capture speed where the bridge pulls and pushes on the way out: choose other effects")
        if off < k.breaks and signs == {-1}:
            speed = cross_bridge(k, k.breaks, speed, off, backwards=True).velocity_nm_per_us
        energy = k.mass * speed**2 / 2 + jkr_potential(k, fold()) - jkr_potential(k, solid.snap_on_s)
        if energy < 0:
            raise ValueError("no capture speed: the junction gives more energy than it takes")
        inwards = -mp.sqrt(2 * energy / k.mass)
        start = cross_bridge(k, solid.snap_on_gap_nm, inwards, k.forms, backwards=True)
        if not start.reached:
            raise ValueError("no capture speed: even a tip that starts from rest leaves again")
        return -start.velocity_nm_per_us


def differences(
    p: ContactParameters, approach_speed: Number, name: str, *, step: Number = "1e-8", digits: int = DIGITS
) -> Differences:
    """Return the derivatives of rebound speed and delay by central differences.

    With the relative step 1e-8 they carry some 14 digits, fewer (relative step over distance to capture, squared) close
    to capture.

    Args:
        p: the parameters.
        approach_speed: u_in in nm/us.
        name: a number among the parameters, or "approach_speed".
        step: relative to the parameter.
        digits: of the collisions.
    """

    def ends(value: Number) -> Number:
        changed, speed = (p, value) if name == "approach_speed" else (replace(p, **{name: value}), approach_speed)
        found = collision(changed, speed, digits=digits)
        return mp.matrix([found.rebound_speed_nm_per_us, found.delay_us])

    with mp.workdps(digits + GUARD_DIGITS):
        return Differences(*slope(ends, approach_speed if name == "approach_speed" else getattr(p, name), step))


def capture_difference(p: ContactParameters, name: str, *, step: Number = "1e-8", digits: int = DIGITS) -> Number:
    """Return the derivative of the capture speed with respect to a parameter by central differences."""
    with mp.workdps(digits + GUARD_DIGITS):
        return slope(lambda x: capture_speed(replace(p, **{name: x}), digits=digits), getattr(p, name), step)


def slope(function: Callable[[Number], Number], value: Number, step: Number) -> Number:
    """Return a central difference; the step is relative."""
    centre = mp.mpf(value)
    width = mp.mpf(step) * centre
    return (function(centre + width) - function(centre - width)) / (2 * width)
