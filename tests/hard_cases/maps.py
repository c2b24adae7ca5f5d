"""One impact of the map beside 50 digits: what the families of law scenes share, one compiled program for all."""

import jax
import numpy as np

from afm_jax.impact.jacobian import map_jacobian
from afm_jax.impact.map import next_impact
from afm_jax.outcomes import Outcome
from tests import brute_force, reference_flight, reference_map
from tests.package_scenes import scene_of
from tests.reference_flight import Parameters

EPS = float(np.finfo(float).eps)
USUAL = Parameters(
    frequency_khz=90.0,
    quality_factor=40.0,
    amplitude_nm=4.0,
    drive_frequency_khz=181.8,
    offset_nm=-1.0,
    r=0.95,
    epsilon=60.0,
)
both = jax.jit(lambda scene, time, velocity: (next_impact(scene, time, velocity), map_jacobian(scene, time, velocity)))


def leaving(p: Parameters, phase_turns: float, rebound: float) -> tuple[float, float]:
    """Return time and velocity of a tip that leaves the platform at a phase with a speed of its top speed's."""
    drive = 2e-3 * np.pi * p.drive_frequency_khz
    speed = p.amplitude_nm * drive
    return 2.0 * np.pi * phase_turns / drive, speed * float(rebound - np.sin(2.0 * np.pi * phase_turns))


def compare(p: Parameters, time_us: float, velocity: float, *, periods: float = 40.0, slopes: float = 1e-9) -> None:
    """Compare the next impact and its derivative with 50 digits, from where brute force finds it.

    Args:
        p: damped, without delay.
        time_us: when the tip leaves the platform.
        velocity: its velocity then in nm/us.
        periods: of the slower motion, how long to look for the impact.
        slopes: tolerance of the derivative, relative to its largest entry in units of drive and top speed.
    """
    slower = min(p.frequency_khz, p.drive_frequency_khz)
    found = brute_force.first_impact(reference_map.flights_of(p, time_us, velocity), duration_us=periods * 1e3 / slower)
    assert found.found[0], "there is no impact to compare"
    guess = float(time_us + found.flight_time_us[0])
    exact = reference_map.next_impact(p, time_us, velocity, guess)
    mine, jacobian = both(scene_of(p), time_us, velocity)
    drive, free = (2e-3 * np.pi * khz for khz in (p.drive_frequency_khz, p.frequency_khz))
    size = p.amplitude_nm + abs(p.offset_nm) + abs(velocity) / free
    approach = float(-p.amplitude_nm * drive * np.sin(drive * guess) - float(exact.velocity_before_nm_per_us))
    # the search stops at 1e-13 us; roundings of the gap over the approach speed, of the phase, and of the time
    late = 1e-13 + 32 * EPS * size / approach + 16 * EPS * abs(guess)
    assert abs(float(mine.arrival_time_us) - float(exact.arrival_time_us)) <= late
    if exact.captured:
        assert int(mine.outcome) == Outcome.CAPTURED
        return
    assert int(mine.outcome) == Outcome.IMPACT
    fastest = max(drive, free)
    # a change of the approach speed near capture is a larger one of the rebound speed
    gain = max(1.0, float(reference_flight.rebound_slope(p, approach)))
    allowed = gain * size * fastest * (fastest * late + 64 * EPS)
    assert abs(float(mine.velocity_after_nm_per_us) - float(exact.velocity_after_nm_per_us)) <= allowed
    scale = np.array([1.0 / drive, p.amplitude_nm * drive])
    want = np.array(reference_map.map_jacobian(p, time_us, velocity, guess).tolist(), float) / scale[:, None] * scale
    have = np.asarray(jacobian) / scale[:, None] * scale
    np.testing.assert_allclose(have, want, rtol=0.0, atol=slopes * np.abs(want).max())
