"""Flights that touch the platform, or miss it, by 1e-3 to 1e-12 nm.

Hard: a gap with a double zero has one root more or two fewer for a change of nothing; next to it the time of arrival is
the square root of the depth, its slope one over that root, and a search by steps passes the dip or stops short of it.

Right answer: flights with a double zero are solved for with 50 digits (gap and its rate are linear in offset and start
velocity), lifted or lowered, and rounded; how deep the dip of the rounded flight is, and where its root lies, again
with 50 digits.
"""

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import pytest

from afm_jax.outcomes import Outcome
from tests.hard_cases.maps import EPS, both
from tests.package_scenes import scene_of
from tests.reference_flight import Parameters, constants, high_precision, mp, platform, propagator

pytestmark = pytest.mark.slow

LIFTS_NM = (1e-3, 1e-8, 1e-12)


class Touch(NamedTuple):
    """A flight next to one that touches; times in us, `dip_nm` the gap at its minimum."""

    p: Parameters
    start_us: float
    velocity: float
    lowest_us: Any
    dip_nm: Any
    curvature: Any


class _Gap:
    """Gap, rate and acceleration of a flight at a time, with 50 digits."""

    def __init__(self, p: Parameters, start: float, velocity: float) -> None:
        self.k, self.start, self.velocity = constants(p), mp.mpf(start), mp.mpf(velocity)
        self.height = platform(self.k, self.start)[0]

    def __call__(self, time: Any, order: int = 0) -> Any:
        p11, p12, p21, p22 = propagator(self.k, time - self.start)
        z, v = p11 * self.height + p12 * self.velocity, p21 * self.height + p22 * self.velocity
        tip = (z, v, -(self.k.free**2) * z - 2 * self.k.decay * v)[order]
        return tip - platform(self.k, time)[order]


@high_precision
def touching(drive_khz: float, turns: float, flown: float, lift_nm: float) -> Touch:
    """Return a flight whose gap has its minimum about `lift_nm` above 0, `flown` free periods after the start."""
    made = Parameters(
        frequency_khz=90.0,
        quality_factor=60.0,
        amplitude_nm=3.0,
        drive_frequency_khz=drive_khz,
        offset_nm=0.0,
        r=0.9,
        epsilon=0.0,
    )
    k = constants(made)
    start = float(2 * mp.pi * turns / k.drive)
    touch = mp.mpf(start) + flown * 2 * mp.pi / k.free
    p11, p12, p21, p22 = propagator(k, touch - start)
    here, (there, fall, _) = platform(k, mp.mpf(start))[0], platform(k, touch)
    offset, velocity = mp.lu_solve(
        mp.matrix([[p11 - 1, p12], [p21, p22]]), mp.matrix([there - p11 * here + lift_nm, fall - p21 * here])
    )
    p = replace(made, offset_nm=float(offset))
    gap = _Gap(p, start, float(velocity))
    lowest = mp.findroot(lambda t: gap(t, 1), touch)
    return Touch(p, start, float(velocity), lowest, gap(lowest), gap(lowest, 2))


@high_precision
def next_arrival(case: Touch) -> Any:
    """Return the first root of the gap: beside the dip where it is below 0, else where samples turn negative."""
    gap = _Gap(case.p, case.start_us, case.velocity)
    if case.dip_nm < 0:
        side = mp.sqrt(-2 * case.dip_nm / case.curvature)
        # the flight is above the platform until it comes to the dip (below), so that its near side is the first root
        return mp.findroot(gap, (case.lowest_us - 2 * side, case.lowest_us), solver="anderson")
    after = float(case.lowest_us) + np.arange(1e-2, 12.0, 5e-3)
    below = int(np.flatnonzero([gap(t) < 0 for t in after])[0])
    return mp.findroot(gap, (after[below - 1], after[below]), solver="anderson")


SHAPES = [(181.8, 0.80, 0.70), (300.0, 0.32, 0.52), (949.86, 0.91, 0.69)]
"""Drive in kHz, turns of it at the start, free periods until the dip."""


@pytest.mark.parametrize("lift_nm", [side * lift for lift in LIFTS_NM for side in (1.0, -1.0)])
@pytest.mark.parametrize("shape", SHAPES, ids=str)
def test_the_dip_is_met_or_passed_as_its_depth_says(shape: tuple[float, float, float], lift_nm: float):
    case = touching(*shape, lift_nm)
    gap = _Gap(case.p, case.start_us, case.velocity)
    # the case is one: rounding has not turned it round, and nothing is met before the dip
    assert 0.5 < float(case.dip_nm) / lift_nm < 1.5
    assert case.curvature > 0
    before = np.linspace(
        case.start_us, float(case.lowest_us - 2 * mp.sqrt(2 * abs(case.dip_nm) / case.curvature)), 400
    )[1:]
    assert min(gap(mp.mpf(t)) for t in before) > 0

    arrival = next_arrival(case)
    mine, jacobian = both(scene_of(case.p), case.start_us, case.velocity)
    closing, pull = -float(gap(arrival, 1)), abs(float(gap(arrival, 2)))
    # rounding of the gap over the speed at which it closes
    size = 3.0 + abs(case.p.offset_nm) + abs(case.velocity) / 0.5655
    late = 1e-13 + 8 * EPS * size / closing + 8 * EPS * float(arrival)
    assert int(mine.outcome) == Outcome.IMPACT
    assert abs(float(mine.arrival_time_us) - float(arrival)) <= late
    # d(arrival)/d(velocity) = -p12/gap', and gap' is off by gap'' times the time
    slope = float(propagator(constants(case.p), arrival - mp.mpf(case.start_us))[1]) / closing
    assert float(jacobian[0, 1]) == pytest.approx(slope, rel=1e-9 + 2.0 * pull * late / closing)
