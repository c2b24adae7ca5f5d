"""The course of a tip over a moving sample with the contact of section IV (eq. 16), to some 12 digits.

Phase by phase: DRY -> BRIDGE where the gap falls to `bridge_forms_nm`, BRIDGE -> JUNCTION where it falls to D_on,
JUNCTION -> BRIDGE at D_off (straight to DRY where that lies beyond the bridge), BRIDGE -> DRY at `bridge_breaks_nm`. A
tip that turns in the bridge may leave without a junction or form it again. Shares nothing with the package.

A run with other steps shows the error of a course (rtol or method); chaotic motion multiplies it from contact to
contact.
"""

from bisect import bisect_right
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from math import inf, nan

import numpy as np
from scipy.integrate import DOP853, OdeSolver

from tests.reference_driven_legs import END, Leg, Moment, fly, touch
from tests.reference_driven_motion import BRIDGE, DRY, JUNCTION, DrivenContact, Motion
from tests.reference_driven_steps import Steps

SCALES = np.array([0.1, 1.0, 0.01, 1.0])  # gap (nm) or s, rate (nm/us), time (us), loss (aJ): what errors count by


@dataclass(kw_only=True)
class ContactRecord:
    """One contact, from the bridge's forming to the dry state; departure and rebound are nan until it ends.

    `deepest_gap_nm` is the smallest gap, `junctions` counts how often the junction formed.
    """

    arrival_time_us: float
    approach_speed_nm_per_us: float
    departure_time_us: float = nan
    rebound_speed_nm_per_us: float = nan
    viscous_loss_aj: float = 0.0
    deepest_gap_nm: float = inf
    junctions: int = 0


@dataclass(kw_only=True)
class Course:
    """What happened: contacts, and the final state."""

    motion: Motion
    contacts: list[ContactRecord] = field(default_factory=list)
    legs: list[Leg] = field(default_factory=list)
    phase: str = DRY
    time_us: float = nan
    position_nm: float = nan
    velocity_nm_per_us: float = nan

    def sample(self, times_us: Iterable[float]) -> tuple[np.ndarray, np.ndarray]:
        """Return positions (nm) and velocities (nm/us) in the lab at times in us, as accurate as the course itself."""
        rows = []
        for time in times_us:
            leg = self.legs[bisect_right(self.legs, time, key=lambda each: each.start.time_us) - 1]
            rows.append(leg.in_lab(self.motion, float(time)))
        return np.array([row[0] for row in rows]), np.array([row[1] for row in rows])

    def enter(self, leg: Leg) -> None:
        """Enter a leg: what it means for the contact, and the state at its end."""
        time, _, rate = leg.end
        self.legs.append(leg)
        self.phase, self.time_us = leg.phase if leg.after == END else leg.after, time
        self.position_nm, self.velocity_nm_per_us = leg.end.in_lab(self.motion)
        if leg.touch is not None:
            contact = self.contacts[-1]
            contact.viscous_loss_aj += leg.touch.loss_aj
            contact.deepest_gap_nm = min(contact.deepest_gap_nm, leg.touch.deepest_gap_nm)
        if leg.after == END:
            return
        if leg.phase == DRY:
            self.contacts.append(ContactRecord(arrival_time_us=time, approach_speed_nm_per_us=-rate))
        elif leg.after == DRY:
            self.contacts[-1].departure_time_us, self.contacts[-1].rebound_speed_nm_per_us = time, rate
        elif leg.after == JUNCTION:
            self.contacts[-1].junctions += 1


def follow(
    system: DrivenContact,
    time_us: float,
    position_nm: float,
    velocity_nm_per_us: float,
    *,
    until_us: float = inf,
    contacts: int | None = None,
    rtol: float = 1e-12,
    method: Callable[..., OdeSolver] = DOP853,
) -> Course:
    """Follow the tip from a start above the sample, dry or, at `bridge_forms_nm` and below, in the bridge.

    Args:
        system: cantilever, platform and contact.
        time_us: when the motion starts.
        position_nm: the tip's position in the lab.
        velocity_nm_per_us: its velocity in the lab.
        until_us: when to stop.
        contacts: at the end of which contact to stop, if that is earlier; a captured tip never gets there.
        rtol: relative tolerance of the steps; the absolute ones follow.
        method: SciPy's method for the steps.
    """
    motion = Motion(system)
    steps = Steps(rtol=rtol, atol=rtol * SCALES, method=method)
    base, base_rate, _ = motion.platform(time_us)
    here = Moment(float(time_us), float(position_nm) - base, float(velocity_nm_per_us) - base_rate)
    assert here.gap_nm > motion.solid.snap_on_gap_nm
    phase = DRY if here.gap_nm > motion.numbers.forms else BRIDGE
    course = Course(motion=motion)
    if phase == BRIDGE:
        course.contacts.append(
            ContactRecord(arrival_time_us=here.time_us, approach_speed_nm_per_us=-here.gap_rate_nm_per_us)
        )
    while phase != END and here.time_us < until_us and not (phase == DRY and len(course.contacts) == contacts):
        leg = fly(motion, here, until_us) if phase == DRY else touch(motion, phase, here, until_us, steps)
        course.enter(leg)
        here, phase = leg.end, leg.after
    return course
