"""Impacts that last, in NumPy: the closing condition with its corrections, written out over the approach speed.

For an assumed approach speed the law gives rebound speed and delay; air, spring and the platform's motion during the
contact change both by a little, which needs the phase and therefore a few passes (`afm_jax.impact.lasting_impact`). The
orbits are where cosine and sine of the phase, from two linear equations, lie on the unit circle.
"""

from typing import NamedTuple

import numpy as np
from scipy.special import beta

from tests.brute_force import Floats
from tests.reference_flight import Parameters, constants, outgoing, propagator
from tests.reference_hertz import DEEPEST, HERTZ_TIME, rational

BRIDGE_NM = 4.7
SPEEDS = 40_000
PULLS = (-3.0, 4.0)
SERIES = rational(6, *PULLS)
"""Duration and indentation of a Hertz contact under a pull in this range."""


class Impacts(NamedTuple):
    """Approach and rebound speeds in nm/us and delays in us of corrected impacts, and cosine and sine of the phase."""

    approach: Floats
    rebound: Floats
    delay: Floats
    cosine: Floats
    sine: Floats


def closing_impacts(p: Parameters, order: int, approach: Floats) -> Impacts:
    """Return what the two linear closing conditions ask of the phase at every approach speed."""
    assert p.delay is not None
    k = constants(p, np)
    hertz, lead, offset = p.delay
    free = outgoing(k, approach, np)
    straight = hertz * approach**-0.2 - lead * (1.0 / free - 1.0 / approach) - offset / approach
    rebound, delay = free, straight
    for _ in range(12):
        cosine, sine = _phase(p, order, approach, rebound, delay)
        # only the direction counts before the orbit is closed
        middle = np.arctan2(sine, cosine) - k.drive * delay / 2.0
        height, speed = p.offset_nm + k.amplitude * np.cos(middle), -k.amplitude * k.drive * np.sin(middle)
        pull = -(k.free**2) * height - 2.0 * k.decay * speed + k.amplitude * k.drive**2 * np.cos(middle)
        bend = -k.amplitude * k.drive**2 * np.cos(middle)
        jerk = (k.drive**2 - k.free**2) * speed - 2.0 * k.decay * bend
        # the surface is half the offset above gap 0
        hit = np.sqrt(np.maximum(approach**2 + pull * offset, (0.1 * approach) ** 2))
        lasting = hertz * hit**-0.2
        g, j = pull * lasting / hit, jerk * lasting**2 / hit
        kappa = np.clip(g, *PULLS)
        slope, deep, over = (np.polynomial.polynomial.polyval(kappa, row) for row in SERIES)
        longer, depth = 1.0 + kappa * slope / over, deep / over
        # a bridge, as its lead tells of it, makes the tip faster: in its own length, and in the solid
        energy = 2.0 * 0.81 * lead / BRIDGE_NM * (approach**2 - free**2) / approach**2
        air = 2.0 * (longer - 1.2 * kappa * depth) / 1.8 * (1.0 + energy)
        gain = 2.0 * depth * j - 2.0 * air * k.decay * lasting
        # the flights' own drag between gap 0 and the surface does not count twice
        drag = 0.87 * lead * (approach - free) - 0.5 * offset * (approach + free)
        rebound = np.sqrt(np.maximum(free**2 + gain * hit**2 - 4.0 * k.decay * drag, 0.01 * free**2))
        # to first order in a spring a period is shorter by the energy's slope of its share of the action
        longer = longer - 1.0 - 0.7 * beta(1.2, 0.5) / beta(0.4, 0.5) * (DEEPEST / HERTZ_TIME * k.free * lasting) ** 2
        held = _later(free, BRIDGE_NM, pull) - _later(approach, BRIDGE_NM, pull)
        above = _later(approach, 0.5 * offset, pull) + _later(free, 0.5 * offset, pull)
        delay = straight + (1.0 + longer) * lasting - hertz * approach**-0.2 - above - lead / (1.3 * BRIDGE_NM) * held
    return Impacts(approach, rebound, delay, *_phase(p, order, approach, rebound, delay))


def _later(speed: Floats, way: float, pull: Floats) -> Floats:
    """Return by how much later a way is covered with a constant acceleration than without."""
    end = np.sqrt(np.maximum(speed**2 + 2.0 * pull * way, (0.1 * speed) ** 2))
    return 2.0 * way / (speed + end) - way / speed


def _phase(p: Parameters, order: int, approach: Floats, rebound: Floats, delay: Floats) -> tuple[Floats, Floats]:
    """Solve (z_in, V_in) = propagator (z_out, V_out) for cosine and sine of the phase at which the tip leaves."""
    k = constants(p, np)
    flight = np.moveaxis(np.array(propagator(k, order * k.drive_period - delay, np)).reshape(2, 2, -1), -1, 0)
    turn, zero = k.drive * delay, np.zeros_like(approach)
    cos, sin = np.cos(turn), np.sin(turn)
    # (z, V) of the platform at t_out and t_in as matrices that act on (cosine, sine)
    out = np.broadcast_to(k.amplitude * np.array([[1.0, 0.0], [0.0, -k.drive]]), flight.shape)
    back = np.array([[cos, sin], [k.drive * sin, -k.drive * cos]])
    back = k.amplitude * np.moveaxis(back, -1, 0)
    rest = np.full_like(approach, p.offset_nm)
    start, end = np.stack([rest, rebound], axis=-1), np.stack([rest + zero, -approach], axis=-1)
    right = np.einsum("nij,nj->ni", flight, start) - end
    solved = np.linalg.solve(back - np.einsum("nij,njk->nik", flight, out), right[..., None])[..., 0]
    return solved[:, 0], solved[:, 1]


def closing_speeds(p: Parameters, order: int, slowest: float, fastest: float) -> Floats:
    """Return the approach speeds of all orbits between two speeds, by a scan that no pair of roots slips through."""
    speeds = np.linspace(slowest, fastest, SPEEDS)
    found = closing_impacts(p, order, speeds)
    value = found.cosine**2 + found.sine**2 - 1.0
    at = np.flatnonzero(value[:-1] * value[1:] < 0.0)
    low, high = speeds[at], speeds[at + 1]
    for _ in range(60):
        middle = 0.5 * (low + high)
        impact = closing_impacts(p, order, middle)
        same = np.sign(impact.cosine**2 + impact.sine**2 - 1.0) == np.sign(value[at])
        low, high = np.where(same, middle, low), np.where(same, high, middle)
    return 0.5 * (low + high)
