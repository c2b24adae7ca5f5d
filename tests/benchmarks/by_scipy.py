"""The same impacts, collisions and driven contacts by SciPy's `solve_ivp` with events, in plain Python numbers."""

import math
import statistics
import time
from collections.abc import Iterator
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp

import afm_jax as afm
from tests.benchmarks.tasks import contact_scene, starts_above
from tests.reference_driven_contact import DrivenContact, follow
from tests.reference_driven_motion import Motion

TOLERANCE = 1e-9


def scipy_rows() -> Iterator[tuple[str, float]]:
    """Give what SciPy does, and the median of its seconds."""
    yield f"SciPy DOP853, {TOLERANCE:g}: impact of the map", statistics.median(_impact() for _ in range(7))
    # hardly a spring: a tip of a microhertz
    free = DrivenContact(amplitude_nm=0.0, drive_frequency_khz=90.0, frequency_khz=1e-9, quality_factor=None)
    told = f"SciPy DOP853, {TOLERANCE:g}: collision"
    yield told, statistics.median(_contact(free, 0.0, speed) for speed in (12.0, 30.0, 100.0) * 3)
    for reduced in (1.01, 5.277):
        scene = contact_scene(reduced)
        start = afm.State(*(part[0] for part in starts_above(scene, 1, 0.0)))
        found = afm.simulate(scene, start, 60.0 * float(scene.platform.period_us)).contacts
        met = np.flatnonzero(np.asarray(found.kind) == 1)[:9]
        columns = np.asarray(found.arrival_time_us)[met], np.asarray(found.approach_speed_nm_per_us)[met]
        driven = DrivenContact(amplitude_nm=4.0, drive_frequency_khz=180.0 * reduced)
        told = f"SciPy DOP853, {TOLERANCE:g}: driven contact alone, n = {reduced:g}"
        yield told, statistics.median(_contact(driven, *map(float, each)) for each in zip(*columns, strict=True))


def _impact() -> float:
    """Return the seconds of one impact of figure 2's scene: the flight, and where it meets the platform."""
    free, omega, beta, sigma = 2e-3 * math.pi * 90.0, 2e-3 * math.pi * 180.0, 2.0, -1.0

    def gap(now: float, state: Any) -> float:
        # the start itself is no event, whatever rounding makes of its gap of 0
        return state[0] - sigma - beta * math.cos(omega * now) if now > 0.5 else 1.0

    vars(gap).update(terminal=True)
    start = [sigma + beta * math.cos(0.5 * omega), 30.0]
    options: dict[str, Any] = {"max_step": 2.0 * math.pi / omega / 3.0, "rtol": TOLERANCE, "atol": 1e-3 * TOLERANCE}
    began = time.perf_counter()
    path = solve_ivp(lambda _, y: (y[1], -free * free * y[0]), (0.5, 50.0), start, "DOP853", events=gap, **options)
    assert path.status == 1
    return time.perf_counter() - began


def _contact(system: DrivenContact, arrival_us: float, approach_speed: float) -> float:
    """Return the seconds of a contact, from the bridge's formation to its end."""
    height, speed, _ = Motion(system).platform(arrival_us)
    began = time.perf_counter()
    start = height + system.contact.bridge_forms_nm, speed - approach_speed
    (contact,) = follow(system, arrival_us, *start, contacts=1, rtol=TOLERANCE).contacts
    assert math.isfinite(contact.departure_time_us)
    return time.perf_counter() - began
