"""All single-impact orbits of one order by brute force: scan the closing condition, refine each root to 50 digits.

The unknown is the approach speed, for which closing is linear in the cosine and sine of the phase. What an orbit looks
like is then worked out by dense sampling and quadrature.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from tests.brute_force import Floats, first_impact
from tests.reference_flight import (
    Constants,
    Number,
    Parameters,
    capture_limit,
    collision_delay,
    constants,
    high_precision,
    mp,
    outgoing,
    platform,
    propagator,
)
from tests.reference_map import flights_of, map_jacobian
from tests.reference_observables import lockin, peak
from tests.root_scan import refined, sign_changes

SPEEDS = 20000


@dataclass(frozen=True, kw_only=True)
class Orbit:
    """One single-impact orbit; times and phase belong to the moment the tip leaves the platform.

    The lock-in phase lies in [0, 360/order) degrees; `admissible`: the tip stays above the platform in flight.
    """

    phase_rad: Number
    velocity_after_nm_per_us: Number
    velocity_before_nm_per_us: Number
    approach_speed_nm_per_us: Number
    rebound_speed_nm_per_us: Number
    delay_us: Number
    flight_time_us: Number
    trace: Number
    determinant: Number
    admissible: bool
    stable: bool
    peak_amplitude_nm: float
    lockin_amplitude_nm: float
    lockin_phase_deg: float


@high_precision
def single_impact_orbits(p: Parameters, order: int) -> list[Orbit]:
    """Return all (1, order) orbits, admissible or not, by rising approach speed.

    A |delay| of half a drive period and more is not looked at: the delay law diverges at the capture speed and has
    meaningless orbits without number there.

    Args:
        p: tip, platform and law.
        order: drive periods of a response period.
    """
    k = constants(p)
    orbits = [_orbit(p, k, order, phase, approach) for phase, approach in phases_and_speeds(p, order)]
    return sorted(orbits, key=lambda orbit: orbit.approach_speed_nm_per_us)


@high_precision
def phases_and_speeds(p: Parameters, order: int) -> list[tuple[Number, Number]]:
    """Return (phase, approach speed) of all orbits by scanning the approach speed."""
    k, rough = constants(p), constants(p, np)
    limit, fastest = capture_limit(rough, np), rough.amplitude * rough.drive + np.sqrt(rough.epsilon) + rough.viscous
    speeds = limit + fastest * np.geomspace(1e-7, 1e6, SPEEDS)

    def closing(approach: Floats) -> Floats:
        with np.errstate(all="ignore"):
            delay = collision_delay(rough, approach, np)
            cosine, sine, scale = _closing_by_speed(rough, order, approach, np)
            value = (cosine**2 + sine**2 - scale**2) / (cosine**2 + sine**2 + scale**2)
        return np.where(
            (np.abs(delay) < 0.5 * rough.drive_period) & (delay < order * rough.drive_period), value, np.nan
        )

    def exact(approach: Number) -> Number:
        cosine, sine, scale = _closing_by_speed(k, order, approach, mp)
        return (cosine**2 + sine**2 - scale**2) / (cosine**2 + sine**2 + scale**2)

    pairs = []
    for low, high in sign_changes(closing, speeds):
        approach = refined(exact, low, high)
        if approach is None:
            continue
        cosine, sine, scale = _closing_by_speed(k, order, approach, mp)
        pairs.append((mp.atan2(sine / scale, cosine / scale) % (2 * mp.pi), approach))
    return pairs


def _closing_by_speed(k: Constants, order: int, approach: Number, lib: Any) -> tuple[Number, Number, Number]:
    """Return cosine and sine of the phase, both times the third number, from the two linear closing equations."""
    rebound, delay = outgoing(k, approach, lib), collision_delay(k, approach, lib)
    p11, p12, p21, p22 = propagator(k, order * k.drive_period - delay, lib)
    C, S = lib.cos(k.drive * delay), lib.sin(k.drive * delay)
    a1, b1 = k.amplitude * (C - p11), k.amplitude * (S + k.drive * p12)
    a2, b2 = k.amplitude * (k.drive * S - p21), -k.amplitude * k.drive * (C - p22)
    c1 = (p11 - 1) * k.offset + p12 * rebound
    c2 = p21 * k.offset + p22 * rebound + approach
    return c1 * b2 - c2 * b1, a1 * c2 - a2 * c1, a1 * b2 - a2 * b1


def _orbit(p: Parameters, k: Constants, order: int, phase: Number, approach: Number) -> Orbit:
    """Return everything about one orbit."""
    delay, rebound = collision_delay(k, approach), outgoing(k, approach)
    leaving = phase / k.drive
    flight = order * k.drive_period - delay
    after = platform(k, leaving)[1] + rebound
    before = platform(k, leaving - delay)[1] - approach
    jacobian = map_jacobian(p, leaving, after, leaving + flight)
    trace, determinant = jacobian[0, 0] + jacobian[1, 1], mp.det(jacobian)
    shape = (float(leaving), float(after), float(flight))
    signal = lockin(constants(p, np), order, *shape)
    return Orbit(
        phase_rad=phase,
        velocity_after_nm_per_us=after,
        velocity_before_nm_per_us=before,
        approach_speed_nm_per_us=approach,
        rebound_speed_nm_per_us=rebound,
        delay_us=delay,
        flight_time_us=flight,
        trace=trace,
        determinant=determinant,
        admissible=_stays_above(p, k, leaving, after, flight, delay),
        stable=bool(abs(trace) < abs(1 + determinant) and abs(determinant) < 1),
        peak_amplitude_nm=peak(constants(p, np), order, *shape),
        lockin_amplitude_nm=float(abs(signal)),
        lockin_phase_deg=float(np.degrees(np.angle(signal)) % (360 / order)),
    )


def _stays_above(p: Parameters, k: Constants, leaving: Number, after: Number, flight: Number, delay: Number) -> bool:
    """Check by brute force that the first impact after both t_in and t_out is the orbit's own."""
    if delay >= 0:
        first = first_impact(flights_of(p, leaving, after), duration_us=float(flight) + 1e-6)
        return bool(abs(first.flight_time_us[0] - float(flight)) < 1e-7)
    p11, p12, p21, p22 = propagator(k, -delay)
    z0 = platform(k, leaving)[0]
    height, speed = p11 * z0 + p12 * after, p21 * z0 + p22 * after
    if height <= platform(k, leaving - delay)[0]:
        return False
    first = first_impact(
        flights_of(p, leaving - delay, speed),
        duration_us=float(flight + delay) + 1e-6,
        position_nm=np.array([float(height)]),
    )
    return bool(abs(first.flight_time_us[0] - float(flight + delay)) < 1e-7)
