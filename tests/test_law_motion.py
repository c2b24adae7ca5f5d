"""Law scenes in time: against the impact map, SciPy's integration, and the balance of energy."""

import numpy as np
import pytest
from scipy.integrate import quad

from afm_jax.contact.junction import ContactPhase
from afm_jax.impact.map import iterate_map
from afm_jax.motion.record import ContactKind, MotionOutcome
from afm_jax.outcomes import Outcome
from tests.law_systems import (
    PRESSING,
    PRESSING_DURATION,
    PRESSING_START,
    assert_same_rows,
    scene_of,
    simulated,
)
from tests.package_scenes import bouncing
from tests.reference_law_motion import Cosines, LawSystem, follow

DRIVEN = LawSystem(
    Cosines(-1.0, 2e-3, ((3.0, 170.0, 0.0), (0.7, 33.0, 50.0))),
    r=0.98,
    epsilon=40.0,
    viscous_loss=0.2,
    quality_factor=40.0,
    base=Cosines(parts=((1.5, 88.0, 30.0),)),
    force=Cosines(parts=((0.6, 93.0, 200.0), (0.9, 40.0, 10.0))),
)


@pytest.mark.parametrize("changes", [{}, {"delay": None, "epsilon": 900.0}], ids=["delayed", "captured"])
def test_flights_and_impacts_are_those_of_the_map(changes):
    scene, time = bouncing(**changes), 4.0
    rows = iterate_map(scene, time, 60.0, 14)
    result = simulated(scene, (time, float(scene.platform.position(time)), 60.0), 100.0)
    contacts, count = result.contacts, int(result.count)
    assert count >= 12
    assert np.all(np.asarray(contacts.kind)[count:] == ContactKind.NONE)
    captured = int(rows.outcome[count - 1]) == Outcome.CAPTURED
    assert captured == bool(changes)
    arrivals = slice(0, min(count, 14))
    impacts = slice(0, count - 1) if captured else arrivals
    # the same functions, compiled once more
    for ours, maps, which in (
        (contacts.arrival_time_us, rows.arrival_time_us, arrivals),
        (contacts.arrival_velocity_nm_per_us, rows.velocity_before_nm_per_us, arrivals),
        (contacts.departure_time_us, rows.time_us, impacts),
        (contacts.departure_velocity_nm_per_us, rows.velocity_after_nm_per_us, impacts),
    ):
        np.testing.assert_allclose(np.asarray(ours)[which], np.asarray(maps)[which], rtol=1e-12, atol=1e-12)
    if not captured:
        assert (int(result.outcome), int(result.phase)) == (MotionOutcome.FINISHED, ContactPhase.DRY)
        return
    assert (int(result.outcome), int(result.phase)) == (MotionOutcome.HELD, ContactPhase.JUNCTION)
    approach = float(contacts.approach_speed_nm_per_us[count - 1])
    assert float(contacts.energy_lost_aj[count - 1]) == pytest.approx(0.5 * approach**2, rel=1e-14)  # 1 ng


@pytest.mark.parametrize(
    ("system", "start"),
    [
        (LawSystem(Cosines(-1.0, 0.0, ((4.0, 181.8, 0.0),)), 0.99, 50.0, quality_factor=40.0), (1.3, 25.0, -7.0)),
        pytest.param(DRIVEN, (0.4, 18.0, 3.0), marks=pytest.mark.slow),
    ],
    ids=["platform", "every drive"],
)
def test_a_start_in_the_air_is_that_of_scipy(system, start):
    course = follow(system, start[0], start[1], start[2], 50.0)
    result = simulated(scene_of(system), start, 50.0 - start[0])
    assert int(result.outcome) == MotionOutcome.FINISHED
    assert int(result.count) == len(course.rows) > 4
    assert_same_rows(result, course, len(course.rows))
    assert float(result.final.time_us) == pytest.approx(50.0, abs=1e-13)  # t + (50 - t)
    # as in `assert_same_rows`
    assert float(result.final.position_nm) == pytest.approx(course.position, abs=1e-6)
    assert float(result.final.velocity_nm_per_us) == pytest.approx(course.velocity, abs=1e-6)


def test_the_ledger_of_energy_closes():
    system = LawSystem(PRESSING.platform, r=0.3)
    result = simulated(scene_of(system), PRESSING_START, PRESSING_DURATION)
    contacts, count = result.contacts, int(result.count)
    wall, omega = system.platform.derivative, 2e-3 * np.pi * 90.0

    def energy(position, velocity):
        return 0.5 * float(velocity) ** 2 + 0.5 * omega**2 * float(position) ** 2

    gained = 0.0
    for row in range(count):
        arrival, departure = float(contacts.arrival_time_us[row]), float(contacts.departure_time_us[row])
        jump = float(contacts.approach_speed_nm_per_us[row] + contacts.rebound_speed_nm_per_us[row])
        # the platform's impulse, 1 ng times the jump, and its force during a rest work at the platform's speed
        gained += jump * wall(1, arrival) - float(contacts.energy_lost_aj[row])
        if departure > arrival:
            gained += quad(lambda t: system.push(t) * wall(1, t), arrival, departure, epsabs=1e-11, limit=400)[0]
    assert ContactKind.CHATTER in np.asarray(contacts.kind)
    change = energy(result.final.position_nm, result.final.velocity_nm_per_us) - energy(*PRESSING_START[1:])
    assert abs(change) > 1.0
    # a series that is summed up leaves a speed of some 1e-6 nm/us and its square out
    assert gained == pytest.approx(change, abs=1e-5)


def test_a_start_that_is_none_is_said():
    scene = bouncing(delay=None)
    # the last one is on the platform, into it; out of it, it is one
    for start in ((4.0, -9.0, 60.0), (np.nan, 9.0, 60.0), (4.0, np.nan, 60.0), (0.0, 3.0, -1.0)):
        result = simulated(scene, start, 0.5)
        assert (int(result.outcome), int(result.count)) == (MotionOutcome.INVALID_START, 0)
    assert int(simulated(scene, (0.0, 3.0, 1.0), 0.5).outcome) == MotionOutcome.FINISHED
