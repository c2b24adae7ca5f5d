"""The reference of driven contacts against published numbers, mpmath, closed forms and itself."""

from math import acos, asin, cos, pi, sqrt
from typing import Any

import numpy as np
import pytest
from scipy.integrate import RK45

from tests.reference_contact import PUBLISHED, ContactParameters, collision, junction
from tests.reference_driven_contact import BRIDGE, DRY, JUNCTION, ContactRecord, Course, DrivenContact, follow
from tests.reference_driven_motion import Motion
from tests.reference_driven_steps import Mark, Steps, follow_to_mark

PAPER = ContactParameters()
SOFT = ContactParameters(modulus_gpa=1)  # its junction reaches beyond the bridge
FAST = DrivenContact(amplitude_nm=4.0, drive_frequency_khz=2 * 5.277 * 90.0)  # figure 8


def bounce(system: DrivenContact, velocity: float, contacts: int, **how: Any) -> Course:
    """Follow the tip from drive phase 270 degrees, 5 nm above the platform."""
    start = system.start(phase_deg=270.0, height_nm=5.0, velocity_nm_per_us=velocity)
    return follow(system, *start, contacts=contacts, until_us=1e3, **how)


def free_collision(speed: float, parameters: ContactParameters = PAPER) -> tuple[ContactRecord, float]:
    """Return the contact of an all but free tip with a sample at rest, and its delay."""
    system = DrivenContact(
        amplitude_nm=0.0, drive_frequency_khz=1.0, frequency_khz=1e-3, quality_factor=None, contact=parameters
    )
    course = follow(system, 0.0, 5.0, -speed, contacts=1)
    contact = course.contacts[0]
    lead = course.changes[0].gap_nm / contact.approach_speed_nm_per_us
    lag = course.changes[-1].gap_nm / contact.rebound_speed_nm_per_us
    return contact, contact.departure_time_us - contact.arrival_time_us - lead - lag


@pytest.mark.parametrize("speed", PUBLISHED)
def test_a_free_tip_collides_as_published(speed: int):
    contact, delay = free_collision(speed)
    # half a unit of the last digit printed, and a hair for rounded halves
    assert [contact.rebound_speed_nm_per_us, delay] == pytest.approx(PUBLISHED[speed], rel=0, abs=5.1e-5)


@pytest.mark.parametrize(("speed", "parameters"), [(12, PAPER), (60, PAPER), (60, SOFT)])
def test_a_free_tip_collides_as_in_mpmath(speed: int, parameters: ContactParameters):
    contact, delay = free_collision(speed, parameters)
    right = collision(parameters, speed, digits=20)
    # the spring of 4e-11 nN/nm left over moves the speed by 1e-10 nm/us
    assert contact.rebound_speed_nm_per_us == pytest.approx(float(right.rebound_speed_nm_per_us), abs=1e-9)
    assert delay == pytest.approx(float(right.delay_us), abs=1e-10)
    assert contact.deepest_gap_nm == pytest.approx(float(right.deepest_gap_nm), abs=1e-10)
    assert contact.viscous_loss_aj == pytest.approx(float(right.viscous_loss_aj), abs=1e-9)


@pytest.mark.parametrize("viscous", [True, False])
def test_contacts_take_hysteresis_and_viscous_loss_only(viscous: bool):  # noqa: FBT001
    system = DrivenContact(amplitude_nm=0.0, drive_frequency_khz=1.0, quality_factor=None, viscous=viscous)
    course = follow(system, 0.0, 60.0, 0.0, contacts=3)
    stiffness = (2e-3 * pi * 90.0) ** 2
    energies = {
        change.time_us: change.velocity_nm_per_us**2 / 2 + stiffness * change.position_nm**2 / 2
        for change in course.changes
    }
    assert len(course.contacts) == 3
    for contact in course.contacts:
        lost = energies[contact.arrival_time_us] - energies[contact.departure_time_us]
        # two energies of some 500 aJ, each to rtol 1e-12
        assert lost == pytest.approx(float(junction(PAPER).hysteresis_aj) + contact.viscous_loss_aj, abs=1e-8)
        assert (contact.viscous_loss_aj > 1.0) == viscous


OTHER_STEPS = {"rtol": {"rtol": 1e-10}, "longest step": {"longest_step_us": 2e-4}, "method": {"method": RK45}}


@pytest.mark.parametrize("how", OTHER_STEPS.values(), ids=OTHER_STEPS)
def test_ten_contacts_do_not_depend_on_the_steps(how: dict[str, Any]):
    mine, other = bounce(FAST, 60.0, 10), bounce(FAST, 60.0, 10, **how)
    assert len(mine.contacts) == 10
    assert [c.junctions for c in mine.contacts] == [c.junctions for c in other.contacts]
    assert mine.arrival_times_us == pytest.approx(other.arrival_times_us, rel=0, abs=1e-9)
    assert mine.velocity_nm_per_us == pytest.approx(other.velocity_nm_per_us, rel=0, abs=1e-6)  # 1e-9 us of 200 nm/us^2


def test_a_soft_junction_breaks_straight_into_the_dry_state():
    system = DrivenContact(amplitude_nm=4.0, drive_frequency_khz=180.0, contact=SOFT)
    course = bounce(system, 100.0, 1)
    assert [change.after for change in course.changes] == [BRIDGE, JUNCTION, DRY]
    assert course.changes[-1].gap_nm == pytest.approx(float(junction(SOFT).snap_off_gap_nm), rel=1e-15)


def test_structural_force_moves_the_junction():
    course = bounce(DrivenContact(amplitude_nm=4.0, drive_frequency_khz=180.0, structural=False), 100.0, 1)
    gaps = [change.gap_nm for change in course.changes]
    # physics.md's numbers to the digits printed
    assert gaps == pytest.approx([3.5, 0.12466, 0.4261, 4.7], rel=0, abs=5e-5)


def test_samples_lie_on_the_course():
    course = bounce(FAST, 40.0, 3)
    ends = np.array([(c.time_us, c.position_nm, c.velocity_nm_per_us) for c in course.changes]).T
    positions, velocities = course.sample(ends[0])
    # just after a change, its own state: 1e-14 us of rounding in time at up to 100 nm/us and 1000 nm/us^2
    assert positions == pytest.approx(ends[1], rel=0, abs=1e-11)
    assert velocities == pytest.approx(ends[2], rel=0, abs=1e-10)
    start = FAST.start(phase_deg=270.0, height_nm=5.0, velocity_nm_per_us=40.0)
    for leg in course.legs[:5]:
        middle = (leg.start.time_us + leg.end.time_us) / 2
        stopped = follow(FAST, *start, until_us=middle)
        sampled = [float(values[0]) for values in course.sample([middle])]
        assert stopped.phase == leg.phase
        # two ways to the same state, each to rtol 1e-12 of up to 100 nm/us
        assert sampled == pytest.approx([stopped.position_nm, stopped.velocity_nm_per_us], rel=0, abs=1e-9)


def test_a_captured_tip_stays_in_contact():
    system = DrivenContact(amplitude_nm=0.0, drive_frequency_khz=1.0)
    course = follow(system, 0.0, 4.0, -5.0, until_us=5.0)
    assert course.phase == JUNCTION
    assert len(course.contacts) == 1
    assert np.isnan(course.contacts[0].departure_time_us)
    assert course.time_us == 5.0


@pytest.mark.parametrize("depth", [-1e-6, 1e-6, 1e-10])
def test_a_grazing_flight_arrives_where_it_should(depth: float):
    # z = 10 cos(Omega t) over a platform at rest comes down to 3.5 nm above it, and `depth` further
    system = DrivenContact(amplitude_nm=0.0, drive_frequency_khz=1.0, quality_factor=None, offset_nm=depth - 13.5)
    motion = Motion(system)
    arrival = motion.arrival(0.0, 10.0, 0.0, 3.5, 20.0)
    if depth < 0.0:
        assert arrival is None
        return
    assert arrival is not None
    # near the turn a rounding of the gap, 2e-15 nm, weighs as much as this
    slope = 10.0 * motion.omega * sqrt(2 * depth / 10.0)
    assert arrival == pytest.approx(acos(depth / 10.0 - 1.0) / motion.omega, rel=0, abs=1e-14 / slope)


@pytest.mark.parametrize("beyond", [-1e-9, 1e-9])
def test_no_mark_is_missed_within_a_step(beyond: float):
    # y = sin t passes 1 - 1e-9 and comes back at once; 1 + 1e-9 it never reaches, and goes on to -1/2
    steps = Steps(rtol=1e-12, atol=np.full(2, 1e-14))
    marks = [Mark("top", 0, 1.0 + beyond, 1), Mark("low", 0, -0.5, -1)]
    way = follow_to_mark(lambda _, y: [y[1], -y[0]], np.array([0.0, 1.0]), marks, 1, steps)
    assert way.met.name == ("top" if beyond < 0.0 else "low")
    assert way.end[0] == pytest.approx(way.met.value, rel=0, abs=1e-14)
    time = asin(1.0 + beyond) if beyond < 0.0 else pi - asin(-0.5)
    # 1e-12 of y is 1e-12/cos t = 2e-8 of time where y turns
    within = 3e-8 if beyond < 0.0 else 2e-12
    assert way.end[1] == pytest.approx(cos(time), rel=0, abs=within)
    assert sum(way.lengths) == pytest.approx(time, rel=0, abs=within)
