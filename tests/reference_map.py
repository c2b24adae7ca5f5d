"""One impact to the next with 50 digits: the map, and its derivative."""

from typing import NamedTuple

import numpy as np

from tests.brute_force import Flights, first_impact
from tests.reference_flight import (
    Constants,
    Matrix,
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


class Impact(NamedTuple):
    """One impact, in us and nm/us; `time_us` is when the next flight starts. After a capture the last two are NaN."""

    time_us: Number
    arrival_time_us: Number
    velocity_before_nm_per_us: Number
    velocity_after_nm_per_us: Number
    delay_us: Number
    captured: bool


def _arrival(k: Constants, t1: Number, v1: Number, guess: Number) -> Number:
    """Return the root of the gap next to a guess (Newton's method)."""
    z0 = platform(k, t1)[0]

    def gap(t: Number) -> Number:
        p11, p12, _, _ = propagator(k, t - t1)
        return p11 * z0 + p12 * v1 - platform(k, t)[0]

    def slope(t: Number) -> Number:
        _, _, p21, p22 = propagator(k, t - t1)
        return p21 * z0 + p22 * v1 - platform(k, t)[1]

    return mp.findroot(gap, guess, solver="newton", df=slope)


def _impact(k: Constants, t1: Number, v1: Number, guess: Number) -> Impact:
    """Return the impact whose arrival lies next to a guess."""
    arrival = _arrival(k, t1, v1, guess)
    _, _, p21, p22 = propagator(k, arrival - t1)
    before = p21 * platform(k, t1)[0] + p22 * v1
    approach = platform(k, arrival)[1] - before
    if approach <= capture_limit(k):
        return Impact(arrival, arrival, before, mp.nan, mp.nan, captured=True)
    delay = collision_delay(k, approach)
    leaving = arrival + delay
    after = platform(k, leaving)[1] + outgoing(k, approach)
    return Impact(leaving, arrival, before, after, delay, captured=False)


@high_precision
def next_impact(p: Parameters, t1: Number, v1: Number, guess: Number) -> Impact:
    """Return the impact next to a guessed arrival time.

    Args:
        p: tip, platform and law.
        t1: time in us at which the tip leaves the platform.
        v1: its velocity then, nm/us.
        guess: arrival time in us, right to about 1e-6.
    """
    impact = _impact(constants(p), mp.mpf(t1), mp.mpf(v1), mp.mpf(guess))
    assert abs(impact.arrival_time_us - guess) < 1e-5, "the guess led to another root"
    return impact


def flights_of(p: Parameters, time_us: Number, velocity_nm_per_us: Number) -> Flights:
    """Return one flight of these parameters for the brute-force search."""
    quality = np.inf if p.quality_factor is None else p.quality_factor
    fields = (p.frequency_khz, quality, p.amplitude_nm, p.drive_frequency_khz, p.offset_nm)
    return Flights(*(np.array([float(field)]) for field in (*fields, time_us, velocity_nm_per_us)))


@high_precision
def iterate(p: Parameters, t1: Number, v1: Number, impacts: int, *, duration_us: float = 1000.0) -> list[Impact]:
    """Return up to `impacts` impacts in a row: fewer after a capture or a flight longer than `duration_us`.

    Each root is first found by brute force in float64, so it is the first one, and then refined.
    """
    history: list[Impact] = []
    for _ in range(impacts):
        # Reduced by whole drive periods, in which the map is periodic: late times keep their digits in float64.
        shift = constants(p).drive_period * mp.floor(t1 / constants(p).drive_period)
        search = first_impact(flights_of(p, t1 - shift, v1), duration_us=duration_us)
        if not search.found[0]:
            break
        history.append(next_impact(p, t1, v1, shift + search.arrival_time_us[0]))
        if history[-1].captured:
            break
        t1, v1 = history[-1].time_us, history[-1].velocity_after_nm_per_us
    return history


@high_precision
def map_jacobian(p: Parameters, t1: Number, v1: Number, guess: Number) -> Matrix:
    """Return d(time_us, velocity_after)/d(t1, v1) by central differences, right to 40 digits, 2 x 2."""
    jacobian, step = mp.matrix(2, 2), mp.mpf("1e-20")
    for column, (later, faster) in enumerate(((step, 0), (0, step))):
        ends = [next_impact(p, t1 + sign * later, v1 + sign * faster, guess) for sign in (1, -1)]
        for row, name in enumerate(("time_us", "velocity_after_nm_per_us")):
            jacobian[row, column] = (getattr(ends[0], name) - getattr(ends[1], name)) / (2 * step)
    return jacobian
