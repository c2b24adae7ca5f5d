"""The course of a tip over a moving sample with the contact of section IV (eq. 16), to some 12 digits.

Phase by phase: DRY -> BRIDGE where the gap falls to `bridge_forms_nm`, BRIDGE -> JUNCTION where it falls to D_on,
JUNCTION -> BRIDGE at D_off (straight to DRY where that lies beyond the bridge), BRIDGE -> DRY at `bridge_breaks_nm`. A
tip that turns in the bridge may leave without a junction or form it again. Shares nothing with the package; equations
are those of `reference_driven_motion`, steps SciPy's.

A run with other steps shows the error of a course (rtol or method); chaotic motion multiplies it from contact to
contact.
"""

from bisect import bisect_right
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from math import inf, nan
from typing import Any, NamedTuple

import numpy as np
from scipy.integrate import DOP853, solve_ivp
from scipy.optimize import brentq

from tests.reference_driven_motion import BRIDGE, DRY, FOLD, GAP, JUNCTION, LOSS, RATE, TIME, DrivenContact, Motion

__all__ = ["DrivenContact", "follow"]
# gap (nm) or s, rate (nm/us), time (us), loss (aJ): what errors count by
SCALES = np.array([0.1, 1.0, 0.01, 1.0])
# what follows a leg that the end of the course cuts off; a component that turns ends a step
END, TURN = "end", "turn"


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


class Mark(NamedTuple):
    """A value that a component of the state passes rising (sign 1) or falling (-1), and what follows."""

    after: str
    component: int
    value: float
    sign: int

    def miss(self, state: np.ndarray) -> float:
        """Return how far the component is beyond the mark; negative before it."""
        return self.sign * (state[self.component] - self.value)

    def event(self) -> Callable[[float, np.ndarray], float]:
        """Return it as SciPy takes an event: one that lies at the start is met only after the state was before it."""

        def miss(_: float, state: np.ndarray) -> float:
            return self.miss(state)

        vars(miss).update(terminal=True, direction=1.0)
        return miss


class Steps(NamedTuple):
    """SciPy's adaptive steps of one phase, which end exactly on marks.

    Interpolants are of lower order than steps and only say where to look: the last step is taken again, its length
    found by Newton's method, so that the state at a mark is as good as every other.
    """

    rates: Callable[[float, np.ndarray], list[float]]
    options: dict[str, Any]

    def by(self, state: np.ndarray, length: float) -> np.ndarray:
        """Return the state after a length that one step, or a few, can take."""
        if length <= 0.0:
            return state
        return solve_ivp(self.rates, (0.0, length), state, first_step=length, **self.options).y[:, -1]

    def miss(self, length: float, state: np.ndarray, mark: Mark) -> float:
        """Return how far beyond a mark the state is after a length."""
        return mark.miss(self.by(state, length))

    def land(self, state: np.ndarray, length: float, component: int, value: float) -> np.ndarray:
        """Return the state, about a length later, in which a component has a value."""
        for _ in range(2):
            end = self.by(state, length)
            length -= (end[component] - value) / self.rates(0.0, end)[component]
        return self.by(state, length)

    def to_mark(self, state: np.ndarray, marks: list[Mark]) -> tuple[list[np.ndarray], str]:
        """Return the states after all steps up to the first mark, and what follows.

        Each turn of the gap ends a step as well: between turns it moves one way and cannot come back from a mark.
        """
        states, outward = [state], -1 if state[RATE] < 0.0 else 1
        while True:
            turn = Mark(TURN, RATE, 0.0, -outward)
            events = [mark.event() for mark in (*marks, turn)]
            run = solve_ivp(self.rates, (0.0, inf), states[-1], events=events, **self.options)
            assert run.status == 1, f"no step is accurate to {self.options['rtol']:g}"
            states += list(run.y[:, 1:-1].T)
            length = float(run.t[-1] - run.t[-2])
            met = next(mark for mark, times in zip((*marks, turn), run.t_events, strict=True) if len(times))
            end = self.land(states[-1], length, met.component, met.value)
            missed = [mark for mark in marks if mark.miss(states[-1]) < 0.0 <= mark.miss(end)] if met is turn else []
            if missed:
                met = missed[0]
                length: Any = brentq(self.miss, 0.0, length, args=(states[-1], met))
                end = self.land(states[-1], length, met.component, met.value)
            states.append(end)
            if met is not turn:
                return states, met.after
            end[RATE], outward = 0.0, -outward


@dataclass(kw_only=True)
class Course:
    """What happened: contacts, and the final state; when each leg starts, with height and velocity in the lab in it."""

    motion: Motion
    time_us: float
    gap_nm: float
    gap_rate_nm_per_us: float
    phase: str
    contacts: list[ContactRecord] = field(default_factory=list)
    legs: list[tuple[float, Callable[[float], tuple[float, float]]]] = field(default_factory=list)

    @property
    def position_nm(self) -> float:
        """Height in the lab."""
        return self.motion.platform(self.time_us)[0] + self.gap_nm

    @property
    def velocity_nm_per_us(self) -> float:
        """Velocity in the lab."""
        return self.motion.platform(self.time_us)[1] + self.gap_rate_nm_per_us

    def sample(self, times_us: Iterable[float]) -> tuple[np.ndarray, np.ndarray]:
        """Return positions (nm) and velocities (nm/us) in the lab at times in us, as accurate as the course itself."""
        begins = [start for start, _ in self.legs]
        position, velocity = np.array([self.legs[bisect_right(begins, t) - 1][1](float(t)) for t in times_us]).T
        return position, velocity

    def fly(self, until_us: float) -> str:
        """Follow the free flight to the next bridge, or to the end; return what follows."""
        motion, start, before = self.motion, self.time_us, (self.position_nm, self.velocity_nm_per_us)
        self.legs.append((start, lambda time: motion.flight(*before, time - start)))
        duration = motion.arrival(start, *before, motion.numbers.forms, until_us - start)
        self.time_us = until_us if duration is None else start + duration
        position, velocity = motion.flight(*before, self.time_us - start)
        base, base_rate, _ = motion.platform(self.time_us)
        self.gap_nm, self.gap_rate_nm_per_us = position - base, velocity - base_rate
        if duration is None:
            return END
        self.gap_nm = motion.numbers.forms
        self.begin_contact()
        return BRIDGE

    def begin_contact(self) -> None:
        """Enter a contact that begins now."""
        self.contacts.append(
            ContactRecord(arrival_time_us=self.time_us, approach_speed_nm_per_us=-self.gap_rate_nm_per_us)
        )

    def touch(self, until_us: float, options: dict[str, Any]) -> str:
        """Follow the motion in bridge or junction until the phase changes or the end comes; return what follows."""
        motion, start, inside = self.motion, self.time_us, self.phase == JUNCTION
        k, solid = motion.numbers, motion.solid
        marks = [Mark(END, TIME, until_us - start, 1)] if until_us < inf else []
        if inside:
            marks.append(Mark(DRY if solid.snap_off_gap_nm >= k.breaks else BRIDGE, GAP, FOLD, -1))
        else:
            marks += [Mark(JUNCTION, GAP, solid.snap_on_gap_nm, -1), Mark(DRY, GAP, k.breaks, 1)]
        rates = motion.junction_rates if inside else motion.bridge_rates
        steps = Steps(lambda _, state: rates(start, state), options)
        first = solid.snap_on_s if inside else self.gap_nm
        states, after = steps.to_mark(np.array([first, self.gap_rate_nm_per_us, 0.0, 0.0]), marks)

        def gap_of(state: np.ndarray) -> float:
            return motion.junction_gap(float(state[GAP])) if inside else float(state[GAP])

        def in_lab(time: float) -> tuple[float, float]:
            place = max(bisect_right(states, time - start, key=lambda state: state[TIME]) - 1, 0)
            ahead = (time - start - states[place][TIME]) / steps.rates(0.0, states[place])[TIME]
            state = steps.land(states[place], ahead, TIME, time - start)
            base, base_rate, _ = motion.platform(time)
            return base + gap_of(state), base_rate + float(state[RATE])

        self.legs.append((start, in_lab))
        contact, end = self.contacts[-1], states[-1]
        contact.viscous_loss_aj += float(end[LOSS])
        contact.deepest_gap_nm = min(contact.deepest_gap_nm, *map(gap_of, states))
        self.time_us = until_us if after == END else start + float(end[TIME])
        self.gap_rate_nm_per_us = float(end[RATE])
        # the thresholds themselves, so that the next phase begins on its side of them
        ends = {JUNCTION: solid.snap_on_gap_nm, DRY: k.breaks, END: gap_of(end)}
        self.gap_nm = solid.snap_off_gap_nm if inside and after != END else ends[after]
        contact.junctions += after == JUNCTION
        if after == DRY:
            contact.departure_time_us, contact.rebound_speed_nm_per_us = self.time_us, self.gap_rate_nm_per_us
        return after


def follow(
    system: DrivenContact,
    time_us: float,
    position_nm: float,
    velocity_nm_per_us: float,
    *,
    until_us: float = inf,
    contacts: int | None = None,
    rtol: float = 1e-12,
    method: type = DOP853,
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
    motion, options = Motion(system), {"rtol": rtol, "atol": rtol * SCALES, "method": method}
    base, base_rate, _ = motion.platform(time_us)
    gap = float(position_nm) - base
    assert gap > motion.solid.snap_on_gap_nm
    phase = DRY if gap > motion.numbers.forms else BRIDGE
    course = Course(
        motion=motion,
        time_us=float(time_us),
        gap_nm=gap,
        gap_rate_nm_per_us=float(velocity_nm_per_us) - base_rate,
        phase=phase,
    )
    if phase == BRIDGE:
        course.begin_contact()
    while course.time_us < until_us and not (course.phase == DRY and len(course.contacts) == contacts):
        after = course.fly(until_us) if course.phase == DRY else course.touch(until_us, options)
        course.phase = course.phase if after == END else after
    return course
