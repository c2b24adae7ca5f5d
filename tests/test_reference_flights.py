"""Brute-force first impacts against SciPy, closed forms and 200,000 samples."""

from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from tests.brute_force import Flights, first_impact
from tests.flight_families import FAMILIES, random_flights
from tests.reference_flight import Parameters, constants, propagator


@pytest.mark.parametrize("family", [name for name in FAMILIES if name != "grazing"])
def test_brute_force_finds_the_impacts_of_scipy(family: str):
    flights = random_flights(3, 5, family)
    mine = first_impact(flights, duration_us=15.0)
    for row in range(5):
        impact = scipy_impact(flights, row, duration_us=15.0)
        assert mine.found[row] == (impact is not None)
        if impact is None:
            continue
        # rtol 1e-12 of DOP853 leaves about 1e-10 of the amplitude; slow contacts (low_speed) turn it into time.
        slow = max(1.0, 20.0 / approach_speed(flights, mine, row))
        assert mine.arrival_time_us[row] == pytest.approx(impact[0], abs=1e-10 * slow)
        assert mine.velocity_before_nm_per_us[row] == pytest.approx(impact[1], rel=1e-8, abs=1e-8 * slow)


def approach_speed(flights: Flights, impacts: Any, row: int) -> float:
    """Return the approach speed of one impact."""
    drive = 2e-3 * np.pi * flights.drive_frequency_khz[row]
    fall = -flights.amplitude_nm[row] * drive * np.sin(drive * impacts.arrival_time_us[row])
    return float(fall - impacts.velocity_before_nm_per_us[row])


def scipy_impact(flights: Flights, row: int, *, duration_us: float) -> tuple[float, float] | None:
    """Return time and velocity of the first impact by DOP853 with an event, or None."""
    frequency, quality, amplitude, drive, offset, time, velocity = (float(field[row]) for field in flights)
    free, drive = 2e-3 * np.pi * frequency, 2e-3 * np.pi * drive

    def gap(t: float, state: Any) -> float:
        return state[0] - offset - amplitude * np.cos(drive * t)

    gap.terminal, gap.direction = True, -1  # type: ignore[attr-defined]
    # Leave the surface first, so that the event does not see the start.
    start = taylor_step(free, quality, offset + amplitude * np.cos(drive * time), velocity, 1e-9)
    run = solve_ivp(
        lambda _, state: [state[1], -(free**2) * state[0] - free / quality * state[1]],
        (time + 1e-9, time + duration_us),
        start,
        method="DOP853",
        rtol=1e-12,
        atol=1e-13,
        events=gap,
        max_step=2 * np.pi / max(free, drive) / 100,
    )
    return (float(run.t_events[0][0]), float(run.y_events[0][0][1])) if len(run.t_events[0]) else None


def taylor_step(free: float, quality: float, z: float, v: float, step: float) -> list[float]:
    """Return the state a tiny step later by a Taylor step of second order (the third is below 1e-23)."""
    pull = -(free**2) * z - free / quality * v
    return [z + v * step + 0.5 * pull * step**2, v + pull * step]


def test_brute_force_misses_no_dip_of_grazing_flights():
    flights = random_flights(5, 60, "grazing")
    impacts = first_impact(flights, duration_us=60.0)
    assert impacts.near_grazing.any()
    assert (~impacts.near_grazing).any()
    for row in np.flatnonzero(impacts.found):
        frequency, quality, amplitude, drive, offset, time, velocity = (float(field[row]) for field in flights)
        q = None if np.isinf(quality) else quality
        p = Parameters(
            frequency_khz=frequency,
            quality_factor=q,
            amplitude_nm=amplitude,
            drive_frequency_khz=drive,
            offset_nm=offset,
            r=1.0,
            epsilon=0.0,
        )
        k = constants(p, np)
        s = np.linspace(0, impacts.flight_time_us[row], 200001)[1:-1]
        p11, p12, _, _ = propagator(k, s, np)
        swing = amplitude * np.cos(k.drive * (time + s))
        gap = p11 * (offset + amplitude * np.cos(k.drive * time)) + p12 * velocity - offset - swing
        assert gap.min() > -1e-12  # rounding of numbers up to some 100 nm


@pytest.mark.parametrize("shift", [1e-4, 1e-7, -1e-7, -1e-4])
def test_brute_force_decides_a_touch_by_the_sign_of_the_shift(shift: float):
    # A tip at rest (z = 0) above a platform whose top is at -shift: touched or not, exactly, in closed form.
    flights = Flights(*(np.array([x]) for x in (90.0, np.inf, 1.0, 540.0, -1.0 - shift, 0.3, 0.0)))
    impact = first_impact(flights, duration_us=20.0, position_nm=np.zeros(1))
    assert impact.found[0] == (shift < 0)
    if shift < 0:
        # The platform is at its top after 1/0.54 us; it passes z = 0 before, where cos = 1 + shift.
        exact = 1 / 0.54 - np.arccos(1 + shift) / (2e-3 * np.pi * 540)
        # arccos near 1 loses half the digits of the shift
        assert impact.arrival_time_us[0] == pytest.approx(exact, abs=1e-8)
