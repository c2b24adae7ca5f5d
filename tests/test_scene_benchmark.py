"""The benchmark of driven scenes: its contacts one by one, its reference, SciPy's baseline, its judgement. No times."""

from pathlib import Path
from types import SimpleNamespace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from afm_jax.bench.problems import batch_run, bouncing_starts, single_contacts, spread_starts
from afm_jax.bench.scenes import REFERENCE, contact_errors
from afm_jax.bench.scipy_contacts import diffrax_driven_contact, scipy_driven_contact
from afm_jax.motion.record import ContactKind, MotionOutcome
from afm_jax.scenefile.presets import contact_scene
from afm_jax.studies import timing as own_process
from tests.answers import answer
from tests.reference_driven_contact import DrivenContact, follow

SYSTEM = DrivenContact(amplitude_nm=4.0, drive_frequency_khz=180.0 * 5.277)


@pytest.fixture(scope="module")
def scene():
    return contact_scene(5.277, 4.0, 0.0)


@pytest.fixture(scope="module")
def course():
    """Contacts of an independent integration to 12 digits; from this start some of the first twenty-five turn."""
    return follow(SYSTEM, *SYSTEM.start(phase_deg=270.0, height_nm=5.0, velocity_nm_per_us=60.0), contacts=25)


@pytest.fixture(scope="module")
def followed(scene):
    """A few tips with every contact in time, as the benchmark's reference is."""
    starts = spread_starts(scene, 6)
    run = jax.jit(batch_run(REFERENCE, 6))
    found = run(scene, starts, starts.time_us + 30.0 * scene.platform.period_us)
    single = single_contacts(scene, found, 6)
    return starts, found, single, run(scene, single.starts, single.until_us)


@pytest.mark.slow
def test_the_reference_is_that_of_an_independent_integration(followed):
    starts, found, *_ = followed
    for tip in (0, 5):
        for row, contact in enumerate(follow(SYSTEM, *[float(part[tip]) for part in starts], contacts=2).contacts):
            names = ("arrival_time_us", "rebound_speed_nm_per_us")
            arrival, rebound = (float(getattr(found.contacts, name)[tip, row]) for name in names)
            # two contacts multiply rounding and step errors by less than a thousand
            assert arrival == pytest.approx(contact.arrival_time_us, abs=1e-8)
            assert rebound == pytest.approx(contact.rebound_speed_nm_per_us, rel=1e-8)


@pytest.mark.slow
def test_a_single_contact_is_that_of_the_motion(followed):
    _, found, _, alone = followed
    assert np.all(np.asarray(alone.count) == 1)
    assert np.all(np.asarray(alone.outcome) == MotionOutcome.FINISHED)
    every, single = (jax.tree.map(np.asarray, one.contacts) for one in (found, alone))
    for tip in range(6):
        arrival = single.arrival_time_us[tip, 0]
        place = np.unravel_index(np.argmin(np.abs(every.arrival_time_us - arrival)), every.arrival_time_us.shape)
        # taken up 1e-4 us before it, the contact begins where and as it did: rounding of 30 us
        assert every.arrival_time_us[place] == pytest.approx(arrival, abs=1e-12)
        for column in ("departure_time_us", "rebound_speed_nm_per_us"):
            assert getattr(single, column)[tip, 0] == pytest.approx(getattr(every, column)[place], rel=1e-9)


@pytest.mark.parametrize(
    "follow_contact", [scipy_driven_contact, pytest.param(diffrax_driven_contact, marks=pytest.mark.slow)]
)
def test_baselines_follow_straight_and_turning_contacts(scene, course, follow_contact):
    straight = next(contact for contact in course.contacts if contact.junctions == 1)
    turning = next(contact for contact in course.contacts if contact.junctions != 1)
    for contact in (straight, turning):
        found = follow_contact(scene, contact.arrival_time_us, contact.approach_speed_nm_per_us, rtol=1e-9)
        assert found.junctions == contact.junctions
        # their tolerance, times some tens of steps and the slow parts of a turning contact
        assert found.rebound_speed_nm_per_us == pytest.approx(contact.rebound_speed_nm_per_us, rel=1e-6)
        assert found.departure_time_us == pytest.approx(contact.departure_time_us, abs=1e-7)
        assert follow_contact is diffrax_driven_contact or found.evaluations > 100


def test_scipy_says_that_a_tip_is_held():
    with pytest.raises(ValueError, match=r"it is held|without an event"):
        scipy_driven_contact(contact_scene(1e-3, 1e-3, 0.0), 0.0, 1.0, rtol=1e-6)


@pytest.mark.slow
def test_errors_are_shown_apart_for_contacts_that_turn(followed):
    *_, single, alone = followed
    turning = np.arange(6) < 2
    speeds = alone.contacts.rebound_speed_nm_per_us * (1.0 + jnp.where(turning, 1e-3, 1e-6)[:, None])
    left = alone.contacts.departure_time_us + jnp.linspace(0.0, 1e-5, 6)[:, None]
    wrong = changed(alone, rebound_speed_nm_per_us=speeds, departure_time_us=left)
    row = contact_errors(wrong, alone, single._replace(turning=turning))
    assert row["turning_share"] == pytest.approx(1.0 / 3.0, rel=1e-12)
    assert row["turning_rebound_error_median"] == pytest.approx(1e-3, rel=1e-9)
    wanted = {"straight_rebound_error_worst": 1e-6}
    wanted |= {"straight_time_error_us_worst": 1e-5, "turning_time_error_us_worst": 2e-6}
    assert {name: row[name] for name in wanted} == pytest.approx(wanted, rel=1e-6)
    assert row["different"] == 0
    # a contact that does not end has no error: it is counted
    lost = changed(wrong, kind=alone.contacts.kind.at[3, 0].set(int(ContactKind.HELD)))
    assert contact_errors(lost, alone, single)["different"] == 1


def changed(found, **columns):
    """Return a simulation with other columns of its contacts."""
    return eqx.tree_at(lambda each: [getattr(each.contacts, name) for name in columns], found, list(columns.values()))


@pytest.mark.slow
def test_starts_are_those_of_tips_that_keep_bouncing(scene):
    def held_above(fastest: float):
        def run(_, starts, until):
            assert np.all(np.asarray(until > starts.time_us))
            held = np.asarray(starts.velocity_nm_per_us) > fastest
            return SimpleNamespace(outcome=np.where(held, MotionOutcome.HELD, MotionOutcome.FINISHED))

        return run

    starts, share = bouncing_starts(scene, held_above(90.0), 20, 10.0)
    velocities = np.asarray(starts.velocity_nm_per_us)
    assert (len(np.unique(velocities)), velocities.shape, velocities.max() <= 90.0) == (20, (20,), True)
    # of 38 to 120 nm/us a share of 30/82
    assert share == pytest.approx(30.0 / 82.0, abs=0.05)
    with pytest.raises(ValueError, match="only 0 keep bouncing"):
        bouncing_starts(scene, held_above(0.0), 20, 10.0)


BATCH = {"what": "bouncing tips, accuracy 1e-06", "scene": "n = 5.277", "batch": 1000, "periods": 150}
BATCH |= {"contacts": 30_000, "microseconds_per_contact": 11.0, "seconds": 0.33, "compile_s": 20.0}
BATCH |= {"held_share": 0.0, "failed": 0, "turning_share": 0.13, "different": 0}
BATCH |= {"straight_rebound_error_99": 2e-7, "straight_time_error_us_99": 3e-8}
BATCH |= {"turning_rebound_error_99": 2e-6, "turning_time_error_us_99": 3e-8}
ROWS = [BATCH, {"what": "one tip, 1000 drive periods", "scene": "n = 5.277", "periods": 1000, "seconds": 1.5}]


def test_command_writes_its_table_and_judges(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    def measured(task, settings, *, cores):
        assert (task, cores, settings["batch"]) == ("afm_jax.bench.scenes:scenes_one_core", 1, 20)
        return {"rows": ROWS, "reference_error": 1e-11, "reference_error_us": 1e-12}

    monkeypatch.setattr(own_process, "run_in_own_process", measured)
    payload = answer(tmp_path, "bench", "--only", "scenes", "--quick")
    assert (tmp_path / "bench_scenes.csv").exists()
    assert (payload["scene_rows"], payload["scene_reference_error_us"]) == (ROWS, 1e-12)
    assert [aim["met"] for aim in payload["aims"]] == [True, True, True, False, True, False]
    reached = {aim["aim"]: (aim["reached"], aim["at_most"]) for aim in payload["aims"]}
    assert reached["driven contact, n = 5.277, us at 1e-6"] == (11.0, 12.0)
    assert reached["driven contact, n = 5.277, turning, 99 % of rebound errors at 1e-6"] == (2e-6, 1e-6)
    assert reached["driven contact, n = 5.277, straight, 99 % of time errors, us"][0] == 3e-8
