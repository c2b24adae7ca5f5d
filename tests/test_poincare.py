"""The impact map: against 50 digits, its limits and symmetries, and how a sequence of impacts ends."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import brentq

from afm_jax.apparatus.cantilever import Cantilever
from afm_jax.apparatus.platform import Platform
from afm_jax.apparatus.scene import Scene
from afm_jax.impact.law import ImpactLaw, impact_law_of
from afm_jax.impact.map import NEAR_GRAZING, iterate_map, next_impact
from afm_jax.outcomes import Outcome
from tests import brute_force, reference_map
from tests.flight_families import random_flights
from tests.package_scenes import bouncing, next_impacts, scene_of, scenes_of, stacked
from tests.reference_examples import SCENES, scene


@pytest.mark.parametrize("name", SCENES)
def test_ten_impacts_in_a_row_agree_with_fifty_digits(name):
    p = SCENES[name]
    exact = reference_map.iterate(p, 4.0, 60.0, 10)
    rows = iterate_map(scene_of(p), 4.0, 60.0, 10)
    for i, impact in enumerate(exact):
        assert int(rows.outcome[i]) == (Outcome.CAPTURED if impact.captured else Outcome.IMPACT)
        # The map stretches by about 2 an impact: rounding of 1e-15 becomes 1e-12.
        assert float(rows.arrival_time_us[i]) == pytest.approx(float(impact.arrival_time_us), rel=1e-12)
        assert float(rows.velocity_before_nm_per_us[i]) == pytest.approx(
            float(impact.velocity_before_nm_per_us), rel=1e-11
        )
        if impact.captured:
            break
        assert float(rows.time_us[i]) == pytest.approx(float(impact.time_us), rel=1e-12)
        assert float(rows.velocity_after_nm_per_us[i]) == pytest.approx(
            float(impact.velocity_after_nm_per_us), rel=1e-11
        )
        assert float(rows.time_us[i] - rows.arrival_time_us[i]) == pytest.approx(float(impact.delay_us), abs=1e-12)


@settings(deadline=None, max_examples=40)
@given(
    phase=st.floats(0.0, 1.0),
    rebound=st.floats(5.0, 200.0),
    periods=st.integers(-30, 30),
    reduced=st.floats(0.4, 6.0),
    offset=st.floats(-4.0, 4.0),
)
def test_a_shift_by_whole_drive_periods_changes_nothing(phase, rebound, periods, reduced, offset):
    made = bouncing(reduced, offset_nm=offset)
    period = float(made.platform.period_us)
    velocity = rebound + float(made.platform.velocity(phase * period))
    times = np.array([phase, phase + periods]) * period
    here, there = (next_impact(made, time, velocity) for time in times)
    assert int(here.outcome) == int(there.outcome)
    if here.outcome != Outcome.IMPACT or bool(here.near_grazing):
        return
    approach = float(made.platform.velocity(here.arrival_time_us) - here.velocity_before_nm_per_us)
    # The phase is rounded to 1e-13, the gap to 1e-12 nm; close to capture d u_out/d u_in grows as u_in/u_out.
    slope = max(1.0, float(impact_law_of(made).rebound_slope(approach)))
    allowed = 1e-11 * (1.0 + 100.0 / approach) * (1.0 + slope)
    assert float(there.arrival_time_us - here.arrival_time_us) == pytest.approx(periods * period, abs=allowed)
    for name in ("velocity_before_nm_per_us", "velocity_after_nm_per_us"):
        assert float(getattr(there, name)) == pytest.approx(float(getattr(here, name)), rel=allowed, abs=10 * allowed)


@settings(deadline=None, max_examples=60)
@given(
    r=st.floats(0.2, 1.0),
    epsilon=st.floats(0.0, 300.0),
    viscous_loss=st.floats(0.0, 2.0),
    rebound=st.floats(1.0, 250.0),
    time=st.floats(0.0, 6.0),
)
def test_energy_never_grows_at_an_impact(r, epsilon, viscous_loss, rebound, time):
    made = bouncing(r=r, epsilon=epsilon, viscous_loss=viscous_loss, delay=None)
    impact = next_impact(made, time, rebound + float(made.platform.velocity(time)))
    assert int(impact.outcome) in {Outcome.IMPACT, Outcome.CAPTURED}
    platform = float(made.platform.velocity(impact.time_us))
    approach = platform - float(impact.velocity_before_nm_per_us)
    leaving = float(impact.velocity_after_nm_per_us) - platform
    # In the platform's frame: u_out^2 = r^2 u_in^2 - c u_in - epsilon where positive; rounding of u_in^2.
    kept = max(0.0, (r * approach) ** 2 - viscous_loss * approach - epsilon)
    assert leaving**2 <= approach**2 * (1.0 + 1e-12)
    assert leaving**2 == pytest.approx(kept, rel=1e-9, abs=1e-11 * (1.0 + approach**2))
    rounding = 1e-15 * (1.0 + abs(platform) + approach)
    if impact.outcome == Outcome.CAPTURED:
        # the tip moves with the platform; `leaving` is the difference of two velocities
        assert abs(leaving) <= rounding
        assert kept <= 1e-11 * (1.0 + approach**2)
    else:
        assert leaving > -rounding


def test_limits_of_the_law_and_of_damping():
    start = (4.0, 60.0)
    cases = [
        # epsilon -> 0 is eq. 1: V' = -r V + (1 + r) v_p
        (scene(r=0.8, epsilon=1e-9), scene(r=0.8, epsilon=0.0)),
        # r -> 1
        (scene(r=1.0 - 1e-13, epsilon=0.0), scene(r=1.0, epsilon=0.0)),
    ]
    for nearly, exactly in cases:
        left, right = next_impact(scene_of(nearly), *start), next_impact(scene_of(exactly), *start)
        # epsilon/(2 r u) of 1e-11 nm/us
        assert float(left.velocity_after_nm_per_us) == pytest.approx(float(right.velocity_after_nm_per_us), rel=1e-11)
    for p in (cases[0][1], cases[1][1]):
        made, impact = scene_of(p), next_impact(scene_of(p), *start)
        wall = float(made.platform.velocity(impact.time_us))
        eq1 = -p.r * float(impact.velocity_before_nm_per_us) + (1.0 + p.r) * wall
        assert float(impact.velocity_after_nm_per_us) == pytest.approx(eq1, rel=1e-13)  # a square and its root


@pytest.mark.parametrize("r", [0.3, 0.8, 0.95])
def test_at_resonance_the_map_settles_on_the_closed_form(r):
    # omega = 2 Omega, sigma = 0: V' = W (1 + r)/(1 - r) with W = beta omega, at omega t = 3 pi/2.
    made = Scene(Cantilever(90.0), Platform(2.0, 180.0), ImpactLaw(r=r))
    top = 2.0 * 2e-3 * np.pi * 180.0
    rows = iterate_map(made, 4.2, 1.02 * top * (1 + r) / (1 - r), 400)
    assert np.all(rows.outcome == Outcome.IMPACT)
    # Settles as r^n at least and as half-turns of phase; 1e-9 remains to rounding after 400 impacts.
    assert float(rows.velocity_after_nm_per_us[-1]) == pytest.approx(top * (1 + r) / (1 - r), rel=1e-9)
    turns = float(rows.time_us[-1]) * 0.18
    assert turns % 1.0 == pytest.approx(0.75, abs=1e-9)


def test_a_sequence_is_the_map_applied_again_and_again():
    made, state = bouncing(), (4.0, 60.0)
    rows = iterate_map(made, *state, 12)
    for i in range(12):
        one = next_impact(made, *state)
        for name in ("time_us", "arrival_time_us", "velocity_before_nm_per_us", "velocity_after_nm_per_us"):
            # Compiled as part of a loop, rounded differently; the map stretches by about 2 an impact.
            assert float(getattr(rows, name)[i]) == pytest.approx(float(getattr(one, name)), rel=1e-12)
        assert int(rows.outcome[i]) == int(one.outcome)
        state = (rows.time_us[i], rows.velocity_after_nm_per_us[i])


def test_after_a_capture_the_rows_say_so():
    made = bouncing(delay=None, epsilon=900.0)
    rows = iterate_map(made, 4.0, 40.0, 30)
    ends = np.flatnonzero(rows.outcome != Outcome.IMPACT)
    last = int(ends[0])
    assert int(rows.outcome[last]) == Outcome.CAPTURED
    assert np.all(rows.outcome[last + 1 :] == Outcome.NOT_REACHED)
    assert np.all(np.isinf(rows.time_us[last + 1 :]))
    assert np.all(np.isnan(rows.velocity_after_nm_per_us[last + 1 :]))
    assert not np.any(rows.near_grazing[last + 1 :])
    # A captured tip moves with the platform.
    wall = float(made.platform.velocity(rows.time_us[last]))
    assert float(rows.velocity_after_nm_per_us[last]) == pytest.approx(wall, rel=1e-12)
    approach = wall - float(rows.velocity_before_nm_per_us[last])
    assert approach <= (0.3 + np.sqrt(0.09 + 4 * 0.9981**2 * 900)) / (2 * 0.9981**2)


def test_every_end_of_a_flight_is_said():
    made = bouncing(delay=None)
    far = bouncing(delay=None, offset_nm=-40.0, quality_factor=5.0)
    # A delay of -d/u, so long that the flight counts from 0.3 us after its impact on, inside the platform.
    flown = float(next_impact(made, 4.0, 60.0).time_us) - 4.0
    approach = (60.0 - float(made.platform.velocity(4.0))) / 0.9981
    late = bouncing(delay=(0.0, 0.0, (flown + 0.3) * approach), epsilon=0.0, viscous_loss=0.0)
    below = float(made.platform.velocity(1.0)) - 1.0
    for case, start, options, outcome in [
        (made, (4.0, 60.0), {}, Outcome.IMPACT),
        (made, (0.0, 2.0), {}, Outcome.CAPTURED),
        (far, (0.0, 8.0), {}, Outcome.NO_FURTHER_IMPACT),
        (made, (4.0, 60.0), {"max_steps": 3}, Outcome.STEP_LIMIT),
        (made, (1.0, below), {}, Outcome.INVALID_START),
        (made, (np.nan, 60.0), {}, Outcome.INVALID_START),
        (made, (4.0, np.nan), {}, Outcome.INVALID_START),
        (made, (np.inf, 60.0), {}, Outcome.INVALID_START),
        (late, (4.0, 60.0), {}, Outcome.DELAY_EXCEEDS_FLIGHT),
    ]:
        impact = next_impact(case, *start, **options)
        assert Outcome(int(impact.outcome)) is outcome
        assert Outcome(int(impact.outcome)).sentence.endswith(".")
        landed = outcome in {Outcome.IMPACT, Outcome.CAPTURED}
        assert np.isfinite(impact.time_us) == landed
        assert np.isinf(impact.time_us) == (not landed)
        assert np.isnan(impact.velocity_before_nm_per_us) == (not landed)
        assert np.isnan(impact.velocity_after_nm_per_us) == (not landed)


def test_a_tip_that_would_leave_a_quarter_period_early_is_captured():
    # at rest on the platform's top the tip meets it with the speed it left with, hardly above the capture speed
    made = bouncing(epsilon=100.0, viscous_loss=0.0, r=1.0, quality_factor=None, offset_nm=0.0, amplitude_nm=0.0)
    lead, quarter = made.interaction.delay.lead_nm, 1e3 / 90.0 / 4.0
    # b (1/w - 1/u) is a quarter of the free period at
    bound: Any = brentq(lambda w: float(lead) * (1.0 / w - 1.0 / np.hypot(w, 10.0)) - quarter, 0.1, 9.0, xtol=1e-14)
    assert 0.5 < bound < 3.0
    for share, outcome in [(1e-8, Outcome.CAPTURED), (0.9999, Outcome.CAPTURED), (1.0001, Outcome.IMPACT)]:
        impact = next_impact(made, 0.0, float(np.hypot(share * bound, 10.0)))
        assert Outcome(int(impact.outcome)) is outcome
        # half a free period after it left; the delay is no longer than the lead allows
        assert 0.0 <= float(impact.arrival_time_us - impact.time_us) * (outcome is Outcome.IMPACT) < quarter
        if outcome is Outcome.CAPTURED:
            assert float(impact.velocity_after_nm_per_us) == 0.0
            assert float(impact.time_us) == float(impact.arrival_time_us)


@pytest.mark.parametrize("delayed", [False, True])
def test_nothing_is_silently_not_a_number(delayed):
    random = np.random.default_rng(8)
    delay = {} if delayed else {"delay": None}
    scenes = [
        bouncing(random.uniform(0.3, 6), offset_nm=random.uniform(-60, 4), epsilon=random.uniform(0, 400), **delay)
        for _ in range(400)
    ]
    times, velocities = random.uniform(-10, 10, 400), random.uniform(-30, 120, 400)
    impacts = next_impacts(stacked(scenes), times, velocities)
    landed = np.isin(impacts.outcome, [Outcome.IMPACT, Outcome.CAPTURED])
    assert len(np.unique(impacts.outcome)) >= 4
    for name in ("time_us", "arrival_time_us", "velocity_before_nm_per_us", "velocity_after_nm_per_us"):
        np.testing.assert_array_equal(np.isfinite(getattr(impacts, name)), landed)
    assert np.all(impacts.arrival_time_us[landed] > times[landed])


def test_near_grazing_impacts_are_flagged():
    flights = random_flights(4, 512, "grazing")
    exact = brute_force.first_impact(flights, duration_us=60.0)
    impacts = next_impacts(scenes_of(flights), flights.time_us, flights.velocity_nm_per_us)
    drive = 2e-3 * np.pi * flights.drive_frequency_khz
    top = flights.amplitude_nm * drive
    with np.errstate(invalid="ignore"):
        approach = -top * np.sin(drive * exact.arrival_time_us) - exact.velocity_before_nm_per_us
    sure = exact.found & ~exact.near_grazing
    assert NEAR_GRAZING == 1e-3
    np.testing.assert_array_equal(impacts.near_grazing[sure], (approach < 1e-3 * top)[sure])
    assert 10 < np.sum(impacts.near_grazing[sure]) < np.sum(sure) - 10
    assert not np.any(impacts.near_grazing[impacts.outcome == Outcome.NO_FURTHER_IMPACT])
