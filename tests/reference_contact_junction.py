"""Where the solid junction forms and breaks, in mpmath."""

from typing import NamedTuple

from tests.reference_contact_forces import (
    DIGITS,
    GUARD_DIGITS,
    Constants,
    ContactParameters,
    Number,
    constants,
    fold,
    jkr_depth,
    jkr_force,
    jkr_potential,
    jkr_stiffness,
    mp,
    static_force,
    static_potential,
    static_slope,
)

SMALLEST_GAP_NM = 0.005
# of the scan for the tangency; two of them closer than this are taken for none
GAP_RATIO = 0.98


class Junction(NamedTuple):
    """The solid junction on the gap axis: delta = shift - D."""

    snap_on_gap_nm: Number  # D_on
    shift_nm: Number
    snap_off_gap_nm: Number  # D_off
    snap_on_s: Number  # root of the normalized contact radius at D_on
    snap_on_force_nn: Number
    snap_on_stiffness_n_per_m: Number
    bridge_hysteresis_aj: Number
    junction_hysteresis_aj: Number

    @property
    def hysteresis_aj(self) -> Number:
        """Return the static loss of one collision."""
        return self.bridge_hysteresis_aj + self.junction_hysteresis_aj


def stable_s(k: Constants, force: Number, branch: int) -> Number | None:
    """Return s on the stable JKR branch at a force, above (1) or below (-1) the force minimum, or None."""
    root = 6 + 4 * force / k.junction_force
    if root < 0:
        return None
    cube = (mp.sqrt(6) + branch * mp.sqrt(root)) / 2
    return mp.cbrt(cube) if cube * mp.sqrt(6) > 1 else None


def stiffness_excess(k: Constants, gap: Number, branch: int) -> Number | None:
    """Return how much stiffer than the JKR curve at the same force the bridge is, nN/nm."""
    s = stable_s(k, static_force(k, gap), branch)
    return None if s is None else -static_slope(k, gap) - jkr_stiffness(k, s)


def tangencies(k: Constants) -> list[tuple[Number, int]]:
    """Return brackets (outer, inner) with their branch, outermost first, where the bridge gets stiffer inwards.

    There the bridge's force stays above the JKR curve on both sides of the tangency, so that the tip snaps on. Where it
    gets softer inwards the curves touch the other way round.
    """
    found = []
    with mp.workdps(15):
        last: dict[int, Number | None] = {1: None, -1: None}
        gap, outer = k.forms, k.forms
        while gap > SMALLEST_GAP_NM:
            for branch in (1, -1):
                excess, before = stiffness_excess(k, gap, branch), last[branch]
                if excess is not None and before is not None and before < 0 <= excess:
                    found.append(((outer, gap), branch))
                last[branch] = excess
            gap, outer = gap * GAP_RATIO, gap
    return found


def junction(p: ContactParameters, *, digits: int = DIGITS) -> Junction:
    """Return where the junction forms and breaks, with `digits` right digits.

    Force and stiffness of the bridge's static forces and of the stable JKR branch are equal at D_on; this fixes the
    shift of the JKR curve along the gap axis as well. Of several tangencies the outermost counts: the tip meets it
    first.

    Raises:
        ValueError: if no tangency exists, as without the core repulsion.
    """
    with mp.workdps(digits + GUARD_DIGITS):
        k = constants(p)
        found = tangencies(k)
        if not found:
            raise ValueError("bridge and JKR curve have no tangency, so no junction forms: raise the adhesion energy")
        bracket, branch = found[0]
        on = mp.findroot(lambda gap: stiffness_excess(k, gap, branch), bracket, solver="anderson", verify=False)
        on = mp.findroot(lambda gap: stiffness_excess(k, gap, branch), (on, on * (1 + mp.mpf(10) ** -9)))
        s = stable_s(k, static_force(k, on), branch)
        shift = on + jkr_depth(k, s)
        off = shift - jkr_depth(k, fold())
        # A junction that outlives the bridge's reach breaks into the dry state: its work counts up to there.
        end = min(off, k.breaks)
        pull = jkr_potential(k, fold()) - jkr_potential(k, s)
        return Junction(
            snap_on_gap_nm=on,
            shift_nm=shift,
            snap_off_gap_nm=off,
            snap_on_s=s,
            snap_on_force_nn=jkr_force(k, s),
            snap_on_stiffness_n_per_m=jkr_stiffness(k, s),
            bridge_hysteresis_aj=static_potential(k, k.breaks) - static_potential(k, k.forms),
            junction_hysteresis_aj=pull - static_potential(k, end) + static_potential(k, on),
        )
