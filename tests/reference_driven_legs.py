"""The legs of a driven tip's course: the motion within one phase of contact, from its start to the next change."""

from bisect import bisect_right
from functools import partial
from math import inf
from typing import NamedTuple

import numpy as np

from tests.reference_driven_motion import BRIDGE, DRY, FOLD, GAP, JUNCTION, LOSS, RATE, TIME, Motion
from tests.reference_driven_steps import Mark, Rates, Steps, follow_to_mark, land

END = "end"  # what follows a leg that the end of the course cuts off


class Moment(NamedTuple):
    """A time in us, the gap in nm and its rate in nm/us."""

    time_us: float
    gap_nm: float
    gap_rate_nm_per_us: float

    def in_lab(self, motion: Motion) -> tuple[float, float]:
        """Return the tip's position in nm and velocity in nm/us."""
        base, base_rate, _ = motion.platform(self.time_us)
        return base + self.gap_nm, base_rate + self.gap_rate_nm_per_us


class Touch(NamedTuple):
    """The steps of a leg in contact."""

    rates: Rates
    steps: Steps
    starts: list[np.ndarray]
    lengths: list[float]
    loss_aj: float
    deepest_gap_nm: float


class Leg(NamedTuple):
    """The motion in one phase, what follows it, and its steps in contact."""

    phase: str
    start: Moment
    end: Moment
    after: str
    touch: Touch | None = None

    def in_lab(self, motion: Motion, time_us: float) -> tuple[float, float]:
        """Return the tip's position in nm and velocity in nm/us at a time in us within the leg."""
        elapsed = time_us - self.start.time_us
        if self.touch is None:
            return motion.flight(*self.start.in_lab(motion), elapsed)
        step = max(bisect_right(self.touch.starts, elapsed, key=lambda state: state[TIME]) - 1, 0)
        state = self.touch.starts[step]
        if elapsed > state[TIME]:
            now = Mark("now", TIME, elapsed, 1)
            _, state = land(self.touch.rates, state, self.touch.lengths[step], now, self.touch.steps)
        return moment_of(motion, self.phase, time_us, state).in_lab(motion)


def moment_of(motion: Motion, phase: str, time: float, state: np.ndarray) -> Moment:
    """Return the moment of a state in contact at a time in us."""
    gap = motion.junction_gap(float(state[GAP])) if phase == JUNCTION else float(state[GAP])
    return Moment(time, gap, float(state[RATE]))


def fly(motion: Motion, start: Moment, until: float) -> Leg:
    """Return the free flight to the next bridge, or to the end in us."""
    before = start.in_lab(motion)
    limit, forms = until - start.time_us, motion.numbers.forms
    duration = motion.arrival(start.time_us, *before, forms, limit)
    time = until if duration is None else start.time_us + duration
    position, velocity = motion.flight(*before, limit if duration is None else duration)
    base, base_rate, _ = motion.platform(time)
    gap = position - base if duration is None else forms
    return Leg(DRY, start, Moment(time, gap, velocity - base_rate), END if duration is None else BRIDGE)


def touch(motion: Motion, phase: str, start: Moment, until: float, steps: Steps) -> Leg:
    """Return the motion in bridge or junction until the phase changes or the end in us comes."""
    k, solid = motion.numbers, motion.solid
    marks = [Mark(END, TIME, until - start.time_us, 1)] if until < inf else []
    if phase == BRIDGE:
        rates = partial(motion.bridge_rates, start.time_us)
        marks += [Mark(JUNCTION, GAP, solid.snap_on_gap_nm, -1), Mark(DRY, GAP, k.breaks, 1)]
        first = start.gap_nm
    else:
        rates = partial(motion.junction_rates, start.time_us)
        marks += [Mark(DRY if solid.snap_off_gap_nm >= k.breaks else BRIDGE, GAP, FOLD, -1)]
        first = solid.snap_on_s
    way = follow_to_mark(rates, np.array([first, start.gap_rate_nm_per_us, 0.0, 0.0]), marks, RATE, steps)
    time = start.time_us + float(way.end[TIME])
    gaps = [moment_of(motion, phase, time, state).gap_nm for state in (*way.starts, way.end)]
    end = moment_of(motion, phase, until if way.met.name == END else time, way.end)
    if way.met.name != END:
        # the thresholds themselves, so that the next phase begins on its side of them
        at = solid.snap_off_gap_nm if phase == JUNCTION else way.met.value
        end = end._replace(gap_nm=at)
    steps_taken = Touch(rates, steps, way.starts, way.lengths, float(way.end[LOSS]), min(gaps))
    return Leg(phase, start, end, way.met.name, steps_taken)
