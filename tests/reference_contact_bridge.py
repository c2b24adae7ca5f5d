"""The tip's way through the liquid bridge and through the junction, in mpmath.

The bridge is crossed by Taylor series in time of some 50 terms: time is the variable in which even a tip that all but
stops moves analytically. The junction loses no energy, so that its duration is an integral over s.
"""

from typing import NamedTuple

from tests.reference_contact_forces import (
    Constants,
    Number,
    derivative,
    jkr_depth_slope,
    jkr_potential,
    jkr_potential_coefficients,
    mp,
    polynomial,
)

TERMS_PER_DIGIT = 1.3
MAX_STEPS = 400


class Crossing(NamedTuple):
    """How the tip crossed the bridge, or where it stopped in it."""

    reached: bool
    time_us: Number
    gap_nm: Number
    velocity_nm_per_us: Number
    viscous_loss_aj: Number


class Series(NamedTuple):
    """Taylor coefficients in time, lowest order first."""

    gap: list[Number]
    velocity: list[Number]
    loss: list[Number]


def motion_series(k: Constants, gap: Number, velocity: Number, terms: int) -> Series:
    """Return the Taylor series of m D'' = F(D) - c D'/D, and of the viscous loss, the integral of c D'^2/D.

    Each force is a series of its own: exp(-D/tau)' = -D' exp(-D/tau)/tau, (1 + D/2r_K)(its inverse) = 1,
    D (D^-8)' = -8 D' D^-8 and D (D'/D) = D'.
    """
    d, v, loss = [gap], [velocity], [mp.mpf(0)]
    capillary = [-k.capillary / (1 + gap / k.reach)]
    structural = [k.structural * mp.exp(-gap / k.decay)]
    core = [k.core / gap**8]
    strain = [velocity / gap]  # D'/D
    for n in range(terms):
        if n:
            tail, rates = d[1:], v[:n]
            capillary.append(-mp.fdot(tail, capillary[::-1]) / (k.reach + gap))
            structural.append(-mp.fdot(rates, structural[::-1]) / (k.decay * n))
            core.append(-(n * mp.fdot(tail, core[::-1]) + 7 * mp.fdot(rates, core[::-1])) / (n * gap))
            strain.append((v[n] - mp.fdot(tail, strain[::-1])) / gap)
        force = capillary[n] + structural[n] + core[n] - k.viscous * strain[n]
        loss.append(k.viscous * mp.fdot(strain, v[::-1]) / (n + 1))
        d.append(v[n] / (n + 1))
        v.append(force / (k.mass * (n + 1)))
    return Series(d, v, loss)


def safe_step(d: list[Number]) -> Number:
    """Return the step in us at which the last terms of the gap's series drop below the working precision."""
    top = len(d) - 1
    steps = [(mp.eps * d[0] / abs(d[n])) ** (mp.mpf(1) / n) for n in (top - 1, top) if d[n]]
    return min(steps)


def crossing_time(series: list[Number], target: Number, end: Number) -> Number:
    """Return when a series that is monotone between times 0 and `end` passes a target there."""

    def miss(time: Number) -> Number:
        return polynomial(series, time) - target

    near = mp.findroot(miss, (0, end), solver="anderson", verify=False)
    slope = polynomial(derivative(series), near)
    return near - miss(near) / slope if slope else near


def cross_bridge(k: Constants, gap: Number, velocity: Number, target: Number, *, backwards: bool = False) -> Crossing:
    """Follow the tip through the bridge until its gap is `target` or it stops on the way there.

    Args:
        k: the constants.
        gap: at the start, nm.
        velocity: dD/dt at the start, nm/us; 0 only where the force pulls towards the target.
        target: the gap to reach, nm.
        backwards: whether to follow the motion back in time (the viscous loss then comes out negative).

    Returns:
        The crossing, with time and loss counted from the start.

    Raises:
        ArithmeticError: after MAX_STEPS.
    """
    arrow = -1 if backwards else 1
    way = mp.sign(target - gap)
    time = loss = mp.mpf(0)
    for _ in range(MAX_STEPS):
        series = motion_series(k, gap, velocity, int(TERMS_PER_DIGIT * mp.dps))
        step = arrow * safe_step(series.gap)
        stopped = polynomial(series.velocity, step) * arrow * way <= 0
        if stopped:
            step = crossing_time(series.velocity, mp.mpf(0), step)
        reached = (polynomial(series.gap, step) - target) * way >= 0
        if reached:
            step = crossing_time(series.gap, target, step)
        time, loss = time + step, loss + polynomial(series.loss, step)
        gap, velocity = polynomial(series.gap, step), polynomial(series.velocity, step)
        if reached or stopped:
            return Crossing(reached, time, gap, velocity, loss)
    raise ArithmeticError(f"the bridge was not crossed in {MAX_STEPS} Taylor steps; the tip is at {gap} nm")


def turning_s(k: Constants, energy: Number) -> Number:
    """Return the largest s the tip reaches at an energy in aJ (kinetic and JKR potential): Newton's method.

    Above s = 6^(1/6), where P > 0, the potential is convex, so that the iteration from its right falls to the root.
    """
    s = mp.mpf(6) ** (mp.mpf(1) / 6)
    while jkr_potential(k, s) <= energy:
        s *= 2
    slope = derivative(jkr_potential_coefficients(k))
    lack, rate = (lambda at: jkr_potential(k, at) - energy), (lambda at: polynomial(slope, at))
    return mp.findroot(lack, s, df=rate, solver="newton", maxsteps=4 * mp.prec, verify=False)


def junction_time(k: Constants, s: Number, turn: Number) -> Number:
    """Return the time in us between s and the turning point.

    dt = |dD|/sqrt(2 (E - U)/m), and E - U = (s_turn - s) q(s) with a polynomial q; s = s_turn - y^2 takes the root's
    singularity away. Towards the fold of a tip that all but sticks, q nearly vanishes: the interval is graded there.
    """
    # synthetic division, from the highest power
    quotient = [mp.mpf(0)]
    for coefficient in jkr_potential_coefficients(k)[:0:-1]:
        quotient.insert(0, quotient[0] * turn + coefficient)

    def rate(y: Number) -> Number:
        at = turn - y**2
        return 2 * jkr_depth_slope(k, at) * mp.sqrt(k.mass / (2 * polynomial(quotient, at)))

    end = mp.sqrt(turn - s)
    excess = polynomial(quotient, s) / polynomial(quotient, (s + turn) / 2)
    marks = [mp.mpf(0), end]
    distance = mp.mpf(1) / 2
    while distance**2 > excess:
        marks.insert(-1, end * (1 - distance))
        distance /= 4
    return mp.quad(rate, marks, method="gauss-legendre")
