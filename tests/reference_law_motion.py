"""A tip with an impact law, integrated by SciPy in the lab: eq. 16 with all its drives, events at the sample, rests.

Shares no code with the package: motions are sums of cosines in NumPy, flights are DOP853 at 1e-12, the end of a rest is
where the force that holds the tip on the platform changes sign.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

PER_KHZ = 2e-3 * np.pi
_STEP_US = 0.05
_AT_REST = 1e-6
"""Rebound speed in nm/us from which on a tip that falls back is taken to rest."""


@dataclass(frozen=True)
class Cosines:
    """Offset, rate, and (amplitude, frequency in kHz, phase in degrees) of each cosine."""

    offset: float = 0.0
    rate: float = 0.0
    parts: tuple[tuple[float, float, float], ...] = ()

    def derivative(self, order: int, time: float) -> float:
        """Return a derivative of any order; order 0 is the value."""
        total = self.offset + self.rate * time if order == 0 else (self.rate if order == 1 else 0.0)
        for amplitude, frequency, phase in self.parts:
            omega = PER_KHZ * frequency
            angle = omega * time + np.deg2rad(phase) + order * np.pi / 2
            total += amplitude * omega**order * np.cos(angle)
        return float(total)


@dataclass(frozen=True)
class LawSystem:
    """A tip of 1 ng, its drives and its law, without collision delay."""

    platform: Cosines
    r: float
    epsilon: float = 0.0
    viscous_loss: float = 0.0
    frequency_khz: float = 90.0
    quality_factor: float = np.inf
    base: Cosines = Cosines()
    force: Cosines = Cosines()

    def acceleration(self, time: float, z: float, v: float) -> float:
        """Return z'' in flight."""
        omega = PER_KHZ * self.frequency_khz
        drive = self.force.derivative(0, time) + omega**2 * self.base.derivative(0, time)
        return drive - omega**2 * z - omega / self.quality_factor * v

    def push(self, time: float) -> float:
        """Return the platform's force on a tip that moves with it."""
        height, speed, acceleration = (self.platform.derivative(order, time) for order in range(3))
        return acceleration - self.acceleration(time, height, speed)

    def rise(self, time: float, rebound: float) -> float:
        """Return for how long after leaving the platform the tip surely goes up: at most 0.02 us."""
        push = self.push(time)
        return 0.02 if push * 0.02 <= rebound else rebound / push

    def release(self, time: float, until: float) -> float:
        """Return when a tip at rest is let go; infinite if not before the end."""
        times = np.arange(time, until, 0.01)
        lifted = np.flatnonzero([self.push(t) < 0.0 for t in times])
        if not lifted.size:
            return np.inf
        first = int(lifted[0])
        return time if first == 0 else self.turns(float(times[first - 1]), float(times[first]))

    def turns(self, low: float, high: float) -> float:
        """Return when the push changes sign between two times."""
        root: Any = brentq(self.push, low, high, xtol=1e-14)
        return float(root)

    def fly(self, time: float, z: float, v: float, until: float, *, clear: float) -> tuple[bool, float, float, float]:
        """Return whether the tip meets the platform, when, height and velocity; it cannot before `clear` is over."""

        def motion(t, y):
            return [y[1], self.acceleration(t, y[0], y[1])]

        def gap(t, y):
            return y[0] - self.platform.derivative(0, t)

        vars(gap).update(terminal=True, direction=-1.0)
        options: dict[str, Any] = {"method": "DOP853", "rtol": 1e-12, "atol": 1e-13, "max_step": _STEP_US}
        middle = min(time + clear, until)
        first = solve_ivp(motion, (time, middle), [z, v], **options)
        state = first.y[:, -1]
        if middle >= until:
            return False, until, *state
        rest = solve_ivp(motion, (middle, until), state, events=gap, **options)
        return rest.status == 1, float(rest.t[-1]), *rest.y[:, -1]


@dataclass
class LawCourse:
    """What happened: rows of arrival time, velocity before, departure time, velocity after; and the last state."""

    rows: list[tuple[float, float, float, float]]
    position: float
    velocity: float
    held: bool


def follow(system: LawSystem, time: float, z: float, v: float, until: float) -> LawCourse:
    """Return a tip followed to the end; every impact of a series is a row until the tip rests, which is the last's."""
    rows, wall = [], system.platform.derivative
    clear = 0.0 if z - wall(0, time) > 1e-9 else system.rise(time, v - wall(1, time))
    while True:
        hit, time, z, v = system.fly(time, z, v, until, clear=clear)
        if not hit:
            return LawCourse(rows, z, v, held=False)
        approach = wall(1, time) - v
        square = (system.r * approach) ** 2 - system.viscous_loss * approach - system.epsilon
        rebound = np.sqrt(max(square, 0.0))
        if rebound > _AT_REST:
            leaving = time
        else:
            leaving, rebound = system.release(time, until) if system.epsilon == 0.0 else np.inf, 0.0
        if leaving >= until:
            rows.append((time, v, np.inf, 0.0))
            return LawCourse(rows, wall(0, until), wall(1, until), held=True)
        after, clear = wall(1, leaving) + rebound, system.rise(leaving, rebound)
        rows.append((time, v, leaving, after))
        time, z, v = leaving, wall(0, leaving), after
