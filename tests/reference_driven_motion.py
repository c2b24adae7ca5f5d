"""The tip over a moving sample (eq. 16): its equations of motion in each phase of contact, with NumPy and SciPy.

Written from the equations alone and sharing nothing with the package. Units are the program's: nm, us, ng, nN, aJ.

- DRY: the flight is a closed form; its first arrival at a gap is approached from before by steps that cannot reach
  beyond it, because the gap's acceleration is bounded.
- BRIDGE: time is the variable of gap, gap rate, time and viscous loss.
- JUNCTION: the force's slope is infinite at the fold. With s = sqrt(A), the root of the contact radius, in the gap's
  place and dt = (d delta/ds) d theta everything is a polynomial in s, and the fold is a plain mark.
"""

from dataclasses import dataclass, field, replace
from functools import lru_cache
from math import cos, exp, hypot, inf, pi, radians, sin, sqrt

import numpy as np

from tests.reference_contact_forces import Constants, ContactParameters, constants, fold, mp
from tests.reference_contact_junction import Junction, junction

RAD_PER_US_PER_KHZ = 2e-3 * pi
SHORTEST = 2 * float(np.finfo(float).eps)
ROOT6 = sqrt(6.0)
FOLD = float(fold())

DRY, BRIDGE, JUNCTION = "dry", "bridge", "junction"
# components of the state in contact; in the junction s stands in the gap's place
GAP, RATE, TIME, LOSS = range(4)


@dataclass(frozen=True, kw_only=True)
class DrivenContact:
    """A cantilever over a platform at offset + rate t + amplitude cos(omega t), and their contact.

    `contact` holds the contact's parameters with the paper's defaults; its mass is not used. `viscous` and `structural`
    leave these effects out where False.
    """

    amplitude_nm: float
    drive_frequency_khz: float
    offset_nm: float = 0.0
    offset_rate_nm_per_us: float = 0.0
    frequency_khz: float = 90.0
    quality_factor: float | None = 40.0
    mass_ng: float = 1.0
    contact: ContactParameters = field(default_factory=ContactParameters)
    viscous: bool = True
    structural: bool = True

    def start(self, *, phase_deg: float, height_nm: float, velocity_nm_per_us: float) -> tuple[float, float, float]:
        """Return time, position and velocity in the lab of a start at a drive phase and a height above the platform."""
        time = radians(phase_deg) / (RAD_PER_US_PER_KHZ * self.drive_frequency_khz)
        return time, Motion(self).platform(time)[0] + height_nm, velocity_nm_per_us


@lru_cache
def _contact_numbers(parameters: ContactParameters) -> tuple[Constants, Junction]:
    """Return the contact's constants and its junction as floats, from 20 digits."""
    with mp.workdps(30):
        solved = Junction(*(float(value) for value in junction(parameters, digits=20)))
        return Constants(*(float(value) for value in constants(parameters))), solved


class Motion:
    """The motion of one system, by phase."""

    def __init__(self, system: DrivenContact) -> None:
        """Take the system's numbers."""
        kept = {"viscous": system.viscous, "structural": system.structural}
        effects = tuple(name for name in system.contact.effects if kept.get(name, True))
        self.numbers, self.solid = _contact_numbers(replace(system.contact, effects=effects))
        self.mass = system.mass_ng
        self.omega = RAD_PER_US_PER_KHZ * system.frequency_khz
        # 1/us
        self.damping = 0.0 if system.quality_factor is None else self.omega / system.quality_factor
        self.drive = RAD_PER_US_PER_KHZ * system.drive_frequency_khz
        self.amplitude, self.offset, self.ramp = system.amplitude_nm, system.offset_nm, system.offset_rate_nm_per_us

    def platform(self, time: float) -> tuple[float, float, float]:
        """Return position (nm), velocity (nm/us) and acceleration (nm/us^2) of the platform at a time in us."""
        value, rate = self.amplitude * cos(self.drive * time), -self.amplitude * self.drive * sin(self.drive * time)
        return self.offset + self.ramp * time + value, self.ramp + rate, -(self.drive**2) * value

    def flight(self, position: float, velocity: float, duration: float) -> tuple[float, float]:
        """Return position (nm) and velocity (nm/us) after a free flight of a duration in us."""
        half = self.damping / 2
        ringing = sqrt(self.omega**2 - half**2)
        swing, reach = cos(ringing * duration), sin(ringing * duration) / ringing
        decay = exp(-half * duration)
        return (
            decay * (position * (swing + half * reach) + velocity * reach),
            decay * (velocity * (swing - half * reach) - position * self.omega**2 * reach),
        )

    def arrival(self, time: float, position: float, velocity: float, gap: float, limit: float) -> float | None:
        """Return after how many us, limit at most, a free flight first comes down to a gap in nm; None if not by then.

        While the gap's acceleration is at least -bound, gap + rate h - bound h^2/2 is below the true gap, so that a
        step to its zero cannot pass the first arrival; close to it the step is Newton's.
        """
        # |Omega^2 z + (Omega/Q) z'| <= Omega |(Omega z, z')| |(1, 1/Q)|, and |(Omega z, z')| never grows in free flight
        bound = self.omega * hypot(self.omega * position, velocity) * hypot(1.0, self.damping / self.omega)
        bound += abs(self.amplitude) * self.drive**2
        duration = 0.0
        while duration < limit:
            now, speed = self.flight(position, velocity, duration)
            base, base_rate, _ = self.platform(time + duration)
            above, rate = now - base - gap, speed - base_rate
            ahead = sqrt(rate**2 + 2 * bound * max(above, 0.0))
            if rate < 0.0:
                step = 2 * max(above, 0.0) / (ahead - rate)
                if step <= SHORTEST * duration:
                    return duration
            else:
                step = (rate + ahead) / bound if bound else inf
            duration += step
        return None

    def acceleration(self, force: float, gap: float, rate: float, time: float) -> float:
        """Return the gap's second derivative in nm/us^2 under a force of the contact in nN."""
        base, base_rate, base_acceleration = self.platform(time)
        free = -(self.omega**2) * (base + gap) - self.damping * (base_rate + rate)
        return force / self.mass + free - base_acceleration

    def bridge_rates(self, start: float, state: np.ndarray) -> list[float]:
        """Return the time derivatives of gap, its rate, time since `start` and viscous loss in the bridge."""
        k = self.numbers
        gap, rate, time, _ = state.tolist()
        drag = k.viscous * rate / gap
        force = k.structural * exp(-gap / k.decay) - k.capillary / (1 + gap / k.reach) + k.core / gap**8 - drag
        return [rate, self.acceleration(force, gap, rate, start + time), 1.0, drag * rate]

    def junction_rates(self, start: float, state: np.ndarray) -> list[float]:
        """Return the derivatives of s, gap rate, time since `start` and loss by theta in the junction."""
        s, rate, time, _ = state.tolist()
        force = self.numbers.junction_force * (s**6 - ROOT6 * s**3)
        slope = self.depth_slope(s)
        return [-rate, slope * self.acceleration(force, self.junction_gap(s), rate, start + time), slope, 0.0]

    def depth_slope(self, s: float) -> float:
        """Return d delta/ds of the junction in nm: the time in us that theta passes in one of its units."""
        return self.numbers.junction_length * (4 * s**3 - 2 * ROOT6 / 3)

    def junction_gap(self, s: float) -> float:
        """Return the gap in nm at which the junction has a root s of its contact radius."""
        return self.solid.shift_nm - self.numbers.junction_length * (s**4 - 2 * ROOT6 / 3 * s)
