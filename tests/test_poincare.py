"""The impact map: against 50 digits, its limits, and how a sequence of impacts ends."""

from typing import Any

import numpy as np
import pytest
from scipy.optimize import brentq

from afm_jax.impact.map import NEAR_GRAZING, iterate_map, next_impact
from afm_jax.outcomes import Outcome
from tests import brute_force, reference_map
from tests.flight_families import random_flights
from tests.package_scenes import bouncing, next_impacts, scene_of, scenes_of
from tests.reference_examples import SCENES


@pytest.mark.parametrize("name", SCENES)
def test_ten_impacts_in_a_row_agree_with_fifty_digits(name):
    p = SCENES[name]
    exact = reference_map.iterate(p, 4.0, 60.0, 10)
    rows = iterate_map(scene_of(p), 4.0, 60.0, 10)
    for i, impact in enumerate(exact):
        assert int(rows.outcome[i]) == (Outcome.CAPTURED if impact.captured else Outcome.IMPACT)
        # The map stretches by about 2 an impact: rounding of 1e-15 becomes 1e-12.
        compared = {"arrival_time_us": 1e-12, "velocity_before_nm_per_us": 1e-11}
        if not impact.captured:
            compared |= {"time_us": 1e-12, "velocity_after_nm_per_us": 1e-11}
        for column, tolerance in compared.items():
            assert float(getattr(rows, column)[i]) == pytest.approx(float(getattr(impact, column)), rel=tolerance)
        if impact.captured:
            break
        assert float(rows.time_us[i] - rows.arrival_time_us[i]) == pytest.approx(float(impact.delay_us), abs=1e-12)


def test_after_a_capture_the_rows_say_so():
    made = bouncing(delay=None, epsilon=900.0)
    rows = iterate_map(made, 4.0, 40.0, 30)
    ends = np.flatnonzero(rows.outcome != Outcome.IMPACT)
    last = int(ends[0])
    rest = slice(last + 1, None)
    assert int(rows.outcome[last]) == Outcome.CAPTURED
    assert np.all(rows.outcome[rest] == Outcome.NOT_REACHED)
    assert np.all(np.isinf(rows.time_us[rest]))
    assert np.all(np.isnan(rows.velocity_after_nm_per_us[rest]))
    assert not np.any(rows.near_grazing[rest])
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
