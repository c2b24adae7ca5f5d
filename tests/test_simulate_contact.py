"""`simulate` of contact scenes against an independent integration phase by phase (SciPy's DOP853, rtol 1e-12)."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from afm_jax.apparatus.cantilever import Cantilever
from afm_jax.apparatus.platform import Platform
from afm_jax.apparatus.scene import Scene
from afm_jax.contact.contact import Contact
from afm_jax.contact.junction import Phase
from afm_jax.contact.parameters import EFFECTS
from afm_jax.motion.record import ContactDetail, MotionOutcome, Simulation, State
from afm_jax.motion.simulate import simulate
from afm_jax.motion.trajectory import dense_path, trajectory
from afm_jax.scenefile.presets import contact_scene
from tests.reference_contact_forces import ContactParameters
from tests.reference_driven_contact import DrivenContact, follow

ROOM = 64  # what short motions are given unasked: the same programs


def reference(n: float, beta: float, offset: float = 0.0, **others) -> DrivenContact:
    return DrivenContact(amplitude_nm=beta, drive_frequency_khz=180.0 * n, offset_nm=offset, **others)


def scene_of(system: DrivenContact, contact: Contact | None = None) -> Scene:
    platform = Platform(system.amplitude_nm, system.drive_frequency_khz, system.offset_nm, system.offset_rate_nm_per_us)
    cantilever = Cantilever(system.frequency_khz, system.quality_factor, system.mass_ng)
    return Scene(cantilever, platform, Contact.paper() if contact is None else contact)


def state(start) -> State:
    return State(*(jnp.asarray(value, float) for value in start))


def detail_of(simulation: Simulation) -> ContactDetail:
    assert simulation.contacts.detail is not None
    return simulation.contacts.detail


def arrivals(simulation, count):
    return np.asarray(simulation.contacts.arrival_time_us)[:count]


# Starts of physics.md: drive phase 270 degrees, 5 nm above the platform. From 40, 60 and 80 nm/us at n = 5.277 some
# of the first ten contacts form the junction twice; ten contacts are before chaos has made of 1e-9 more than 1e-7.
@pytest.mark.parametrize(
    ("n", "speed", "double"), [(1.01, 150.0, 0), (5.277, 40.0, 1), (5.277, 60.0, 2), (5.277, 80.0, 1)]
)
def test_tenth_crossing_agrees_with_an_independent_integration(n, speed, double):
    system = reference(n, 4.0)
    start = system.start(phase_deg=270, height_nm=5, velocity_nm_per_us=speed)
    course = follow(system, *start, until_us=1000.0, contacts=11)
    times = np.array([contact.arrival_time_us for contact in course.contacts])
    simulation = simulate(scene_of(system), state(start), times[-1] - start[0] + 1e-3)
    # 1e-7 us is what is promised of the tenth; the junctions are whole numbers
    np.testing.assert_allclose(arrivals(simulation, 10), times[:10], rtol=0.0, atol=1e-7)
    detail = detail_of(simulation)
    formed = np.array([contact.junctions for contact in course.contacts[:10]])
    assert np.array_equal(np.asarray(detail.junctions)[:10], formed)
    assert int((formed > 1).sum()) == double
    deepest = [contact.deepest_gap_nm for contact in course.contacts[:10]]
    # the smallest gap is that of a cubic through the steps: some 1e-5 nm
    np.testing.assert_allclose(np.asarray(detail.deepest_gap_nm)[:10], deepest, rtol=0.0, atol=1e-4)
    lost = [contact.viscous_loss_aj for contact in course.contacts[:10]]
    np.testing.assert_allclose(np.asarray(detail.viscous_loss_aj)[:10], lost, rtol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize(("n", "speed"), [(1.01, 150.0), (5.277, 60.0)])
def test_diffrax_in_time_goes_the_same_way(n, speed):
    system = reference(n, 4.0)
    start = system.start(phase_deg=270, height_nm=5, velocity_nm_per_us=speed)
    times = [contact.arrival_time_us for contact in follow(system, *start, until_us=1000.0, contacts=5).contacts]
    found = simulate(scene_of(system), state(start), times[-1] - start[0] + 1e-3, method="diffrax")
    np.testing.assert_allclose(arrivals(found, 4), times[:4], rtol=0.0, atol=1e-8)


@pytest.mark.slow
def test_derivatives_of_a_batch_are_slopes_of_diffrax_in_time():
    system = reference(5.277, 4.0)
    begin = [state(system.start(phase_deg=270, height_nm=5, velocity_nm_per_us=speed)) for speed in (40.0, 60.0, 80.0)]
    speeds = jnp.asarray([float(one.velocity_nm_per_us) for one in begin])

    def arrivals_of(speed, method):
        start = State(begin[0].time_us, begin[0].position_nm, speed)
        return simulate(scene_of(system), start, 40.0, max_contacts=6, method=method).contacts.arrival_time_us[:4]

    def slope(speed):
        return jax.jvp(lambda v: arrivals_of(v, "collocation"), (speed,), (jnp.ones_like(speed),))[1]

    step = 1e-5
    apart = jax.jit(jax.vmap(lambda v: arrivals_of(v + step, "diffrax") - arrivals_of(v - step, "diffrax")))(speeds)
    # central differences lose half the digits, and each contact makes their error larger
    np.testing.assert_allclose(jax.jit(jax.vmap(slope))(speeds), apart / (2.0 * step), rtol=1e-4, atol=1e-5)


@pytest.mark.slow
def test_other_scenes_agree_too():
    cases = [
        (reference(0.97, 2.0, -0.5, offset_rate_nm_per_us=0.02), Contact.paper()),
        (
            reference(1.3, 2.5, 1.5, quality_factor=None, mass_ng=2.5, structural=False, viscous=False),
            Contact.paper(effects=[name for name in EFFECTS if name not in ("structural", "viscous")]),
        ),
        (
            # soft: the junction outlives the bridge and breaks straight into free flight
            reference(1.01, 4.0, contact=ContactParameters(modulus_gpa=1.0)),
            Contact.paper(modulus_gpa=1.0),
        ),
    ]
    for system, contact in cases:
        start = system.start(phase_deg=270, height_nm=5, velocity_nm_per_us=90.0)
        course = follow(system, *start, until_us=1000.0, contacts=4)
        times = np.array([one.arrival_time_us for one in course.contacts])
        simulation = simulate(scene_of(system, contact), state(start), times[-1] - start[0] + 1e-3)
        # the accuracy of a contact is 1e-10 us, and it grows a little with each
        np.testing.assert_allclose(arrivals(simulation, 4), times, rtol=0.0, atol=2e-8)


def test_the_end_may_lie_within_a_contact():
    system = reference(1.01, 4.0)
    start = system.start(phase_deg=270, height_nm=5, velocity_nm_per_us=150.0)
    first = follow(system, *start, until_us=100.0, contacts=2).contacts[0]
    for share in (0.1, 0.35, 0.5, 0.9):
        end = first.arrival_time_us + share * (first.departure_time_us - first.arrival_time_us)
        course = follow(system, *start, until_us=end)
        simulation = simulate(scene_of(system), state(start), end - start[0])
        np.testing.assert_allclose(float(simulation.final.position_nm), course.position_nm, rtol=0.0, atol=1e-7)
        assert Phase(int(simulation.phase)).name.lower() == course.phase


@pytest.mark.slow
def test_energy_of_a_contact_is_what_the_tip_loses():
    # no air, a resting sample: spring and kinetic energy change in contacts only
    scene = Scene(Cantilever(90.0, mass_ng=1.5), Platform(0.0, 180.0, -2.0), Contact.paper())
    simulation = simulate(scene, state((0.0, 40.0, 0.0)), 60.0)
    rows, count = simulation.contacts, int(simulation.count)
    assert count >= 5
    stiffness = float(scene.cantilever.stiffness_n_per_m)

    def energy(position, velocity):
        return 0.5 * 1.5 * np.asarray(velocity) ** 2 + 0.5 * stiffness * np.asarray(position) ** 2

    before = energy(rows.arrival_position_nm, rows.arrival_velocity_nm_per_us)[: count - 1]
    after = energy(rows.departure_position_nm, rows.departure_velocity_nm_per_us)[: count - 1]
    # the ledger closes to the accuracy of one contact, 1e-9 of the kinetic energy
    np.testing.assert_allclose(
        np.asarray(rows.energy_lost_aj)[: count - 1], before - after, rtol=0.0, atol=3e-8 * before[0]
    )


@pytest.mark.slow
def test_dense_output_agrees_with_an_independent_integration():
    system = reference(5.277, 4.0)
    start = system.start(phase_deg=270, height_nm=5, velocity_nm_per_us=40.0)
    course = follow(system, *start, until_us=start[0] + 25.0)
    scene = scene_of(system)
    simulation = simulate(scene, state(start), 25.0)
    times = np.linspace(start[0], start[0] + 25.0, 2000)
    seen = trajectory(scene, simulation, times)
    position, velocity = course.sample(times)
    assert set(seen.phase) == {0, 1, 2}
    # 1e-9 us times up to 100 nm/us, and times accelerations of 1e3 nm/us^2
    np.testing.assert_allclose(seen.position_nm, position, rtol=0.0, atol=1e-6)
    np.testing.assert_allclose(seen.velocity_nm_per_us, velocity, rtol=0.0, atol=1e-4)
    when, weights = dense_path(scene, simulation, start[0], start[0] + 25.0).nodes(start[0], start[0] + 25.0)
    assert weights.sum() == pytest.approx(25.0, abs=1e-8)
    dense = trajectory(scene, simulation, when)
    # work of the contact force on the gap is what the finished contacts dissipated
    work = -float(np.sum(weights * dense.force_nn * dense.gap_rate_nm_per_us))
    assert int(simulation.outcome) == MotionOutcome.FINISHED
    assert work == pytest.approx(float(np.sum(simulation.contacts.energy_lost_aj)), rel=1e-6)


@pytest.mark.slow
def test_batches_agree_with_single_scenes_and_say_which_has_no_junction():
    speeds = np.array([40.0, 60.0, 150.0])
    scene = contact_scene(5.277, 4.0, 0.0)
    system = reference(5.277, 4.0)
    starts = [system.start(phase_deg=270, height_nm=5, velocity_nm_per_us=speed) for speed in speeds]
    columns = State(*(jnp.asarray(column) for column in zip(*starts, strict=True)))

    def one_of_many(start, adhesion):
        contact = Contact.paper(adhesion_energy_j_per_m2=adhesion)
        return simulate(Scene(scene.cantilever, scene.platform, contact), start, 20.0, max_contacts=ROOM)

    # the last has no junction
    columns = jax.tree.map(lambda column: jnp.append(column, column[0]), columns)
    many = jax.jit(jax.vmap(one_of_many))(columns, jnp.array([0.3, 0.3, 0.3, 0.05]))
    assert [MotionOutcome(one) for one in many.outcome.tolist()] == [MotionOutcome.FINISHED] * 3 + [
        MotionOutcome.NO_JUNCTION
    ]
    for place, start in enumerate(starts):
        one = simulate(scene, state(start), 20.0, max_contacts=ROOM)
        assert int(one.count) == int(many.count[place])
        # the same steps, summed in another order
        np.testing.assert_allclose(
            many.contacts.arrival_time_us[place], one.contacts.arrival_time_us, rtol=0.0, atol=1e-10
        )


@pytest.mark.slow
def test_derivatives_forward_and_reverse():
    system = reference(5.277, 4.0)
    start = system.start(phase_deg=270, height_nm=5, velocity_nm_per_us=60.0)

    def last_arrival(parameters, *, reverse):
        offset, viscosity, quality = parameters
        scene = Scene(
            Cantilever(90.0, quality, 1.0),
            Platform(4.0, 180.0 * 5.277, offset),
            Contact.paper(viscosity_pa_s=viscosity),
        )
        simulation = simulate(scene, state(start), 14.0, max_contacts=4, reverse=reverse, max_rounds=8)
        return simulation.contacts.arrival_time_us[1]

    at = jnp.array([0.1, 1.005e-3, 40.0])
    forward = jax.jacfwd(lambda p: last_arrival(p, reverse=False))(at)
    backward = jax.grad(lambda p: last_arrival(p, reverse=True))(at)
    # the two go different ways through a contact, to 1e-9 each
    np.testing.assert_allclose(forward, backward, rtol=1e-5)

    def independent(parameters):
        offset, viscosity, quality = (float(value) for value in parameters)
        moved = reference(
            5.277, 4.0, offset, quality_factor=quality, contact=ContactParameters(viscosity_pa_s=viscosity)
        )
        return follow(moved, *start, until_us=100.0, contacts=2).contacts[1].arrival_time_us

    for place, step in enumerate((1e-4, 1e-6, 1e-2)):
        shift = np.zeros(3)
        shift[place] = step
        base = np.asarray(at)
        slope = (independent(base + shift) - independent(base - shift)) / (2.0 * step)
        # rounding of the differences: 1e-12 us over the steps
        np.testing.assert_allclose(float(forward[place]), slope, rtol=1e-5, atol=1e-9)


def test_too_little_room_is_an_outcome():
    simulation = simulate(contact_scene(1.01, 4.0, 0.0), state((0.0, 10.0, 60.0)), 600.0, max_contacts=ROOM)
    assert int(simulation.outcome) == MotionOutcome.CONTACT_LIMIT
    assert int(simulation.count) == ROOM
