"""The driven contact once more, as plainly as can be: a check of the reference itself, to some 10 digits.

Position and velocity in the lab with time as the only variable, the forces of the mpmath reference, the junction's
radius by a root search, and `solve_ivp` with its own events.
"""

from collections.abc import Callable
from dataclasses import replace
from math import pi

import numpy as np
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from tests.reference_contact_forces import (
    constants,
    fold,
    jkr_depth,
    jkr_force,
    static_force,
    viscous_force,
)
from tests.reference_contact_junction import junction
from tests.reference_driven_motion import BRIDGE, DRY, JUNCTION, DrivenContact

Gap = Callable[[float, np.ndarray], float]


def plain_course(
    system: DrivenContact, time_us: float, position_nm: float, velocity_nm_per_us: float, *, until_us: float
) -> tuple[list[float], list[float]]:
    """Return the times of the changes of phase in us, and position and velocity at the end; the tip starts dry."""
    solid = junction(system.contact, digits=20)
    exits = {
        DRY: [(system.contact.bridge_forms_nm, -1, BRIDGE)],
        BRIDGE: [(float(solid.snap_on_gap_nm), -1, JUNCTION), (system.contact.bridge_breaks_nm, 1, DRY)],
        JUNCTION: [(float(solid.snap_off_gap_nm), 1, BRIDGE)],
    }
    acceleration = _acceleration(system, float(solid.shift_nm))
    phase, time, state, times = DRY, time_us, [position_nm, velocity_nm_per_us], []
    while True:
        events = [_passes(system, gap, direction) for gap, direction, _ in exits[phase]]
        run = solve_ivp(
            lambda t, y, phase=phase: [y[1], acceleration(phase, t, y[0], y[1])],
            (time, until_us),
            state,
            method="DOP853",
            rtol=1e-12,
            atol=1e-12,
            events=events,
        )
        time, state = float(run.t[-1]), [float(value) for value in run.y[:, -1]]
        if run.status == 0:
            return times, state
        times.append(time)
        phase = next(each[2] for each, met in zip(exits[phase], run.t_events, strict=True) if met.size)


def _platform(system: DrivenContact, time: float) -> tuple[float, float]:
    """Return the platform's position in nm and velocity in nm/us."""
    omega = 2e-3 * pi * system.drive_frequency_khz
    wave = system.amplitude_nm * np.exp(1j * omega * time)
    rate = system.offset_rate_nm_per_us
    return float(system.offset_nm + rate * time + wave.real), float(rate - omega * wave.imag)


def _passes(system: DrivenContact, gap: float, direction: int) -> Gap:
    """Return a terminal event: the gap passes a value in a direction."""

    def excess(time: float, state: np.ndarray) -> float:
        return state[0] - _platform(system, time)[0] - gap

    excess.terminal, excess.direction = True, direction  # pyright: ignore[reportFunctionMemberAccess]
    return excess


def _acceleration(system: DrivenContact, shift: float) -> Callable[[str, float, float, float], float]:
    """Return z'' of eq. 16 as a function of phase, time, position and velocity."""
    k = constants(replace(system.contact, mass_ng=system.mass_ng))
    least = float(fold())
    omega = 2e-3 * pi * system.frequency_khz
    damping = omega / system.quality_factor if system.quality_factor else 0.0

    def root(depth: float) -> float:
        if depth <= jkr_depth(k, least):
            return least
        return brentq(lambda s: float(jkr_depth(k, s)) - depth, least, 10.0, xtol=1e-15)  # pyright: ignore[reportReturnType]

    def acceleration(phase: str, time: float, position: float, velocity: float) -> float:
        base, base_rate = _platform(system, time)
        gap, force = position - base, 0.0
        if phase == BRIDGE:
            force = static_force(k, gap) + viscous_force(k, gap, velocity - base_rate)
        elif phase == JUNCTION:
            force = jkr_force(k, root(shift - gap))
        return float(force / k.mass) - omega**2 * position - damping * velocity

    return acceleration
