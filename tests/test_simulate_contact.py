"""`simulate` of contact scenes against an independent integration phase by phase (SciPy's DOP853, rtol 1e-12)."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from afm_jax.apparatus.cantilever import Cantilever
from afm_jax.apparatus.platform import Platform
from afm_jax.apparatus.scene import Scene
from afm_jax.contact.contact import Contact
from afm_jax.contact.junction import ContactPhase
from afm_jax.contact.parameters import EFFECTS
from afm_jax.motion.record import MotionOutcome, State
from afm_jax.motion.simulate import simulate
from afm_jax.motion.trajectory import DensePath, trajectory
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


def began(system: DrivenContact, speed: float) -> tuple[float, float, float]:
    """Return a start of physics.md: drive phase 270 degrees, 5 nm above the platform."""
    return system.start(phase_deg=270, height_nm=5, velocity_nm_per_us=speed)


def column(contacts, name: str) -> np.ndarray:
    return np.array([getattr(contact, name) for contact in contacts])


# At n = 5.277 two of the first ten contacts form the junction twice; ten contacts are before chaos has made of 1e-9
# more than 1e-7.
def test_tenth_crossing_agrees_with_an_independent_integration():
    system = reference(5.277, 4.0)
    start = began(system, 60.0)
    contacts = follow(system, *start, until_us=1000.0, contacts=11).contacts
    times, ten = column(contacts, "arrival_time_us"), contacts[:10]
    found = simulate(scene_of(system), state(start), times[-1] - start[0] + 1e-3).contacts
    # 1e-7 us is what is promised of the tenth; the junctions are whole numbers
    np.testing.assert_allclose(found.arrival_time_us[:10], times[:10], rtol=0.0, atol=1e-7)
    assert found.detail is not None
    np.testing.assert_array_equal(found.detail.junctions[:10], column(ten, "junctions"))
    assert (column(ten, "junctions") > 1).sum() == 2
    # the smallest gap is that of a cubic through the steps: some 1e-5 nm
    deepest = column(ten, "deepest_gap_nm")
    np.testing.assert_allclose(found.detail.deepest_gap_nm[:10], deepest, rtol=0.0, atol=1e-4)
    np.testing.assert_allclose(found.detail.viscous_loss_aj[:10], column(ten, "viscous_loss_aj"), rtol=1e-5)


@pytest.mark.slow
def test_diffrax_in_time_goes_the_same_way():
    system = reference(5.277, 4.0)
    start = began(system, 60.0)
    times = column(follow(system, *start, until_us=1000.0, contacts=5).contacts, "arrival_time_us")
    found = simulate(scene_of(system), state(start), times[-1] - start[0] + 1e-3, method="diffrax")
    np.testing.assert_allclose(found.contacts.arrival_time_us[:4], times[:4], rtol=0.0, atol=1e-8)


@pytest.mark.slow
def test_other_scenes_agree_too():
    few = [name for name in EFFECTS if name not in ("structural", "viscous")]
    fewer = reference(1.3, 2.5, 1.5, quality_factor=None, mass_ng=2.5, structural=False, viscous=False)
    # the junction outlives the bridge and breaks straight into free flight
    soft = reference(1.01, 4.0, contact=ContactParameters(modulus_gpa=1.0))
    for system, contact in (
        (reference(0.97, 2.0, -0.5, offset_rate_nm_per_us=0.02), Contact.paper()),
        (fewer, Contact.paper(effects=few)),
        (soft, Contact.paper(modulus_gpa=1.0)),
    ):
        start = began(system, 90.0)
        times = column(follow(system, *start, until_us=1000.0, contacts=4).contacts, "arrival_time_us")
        found = simulate(scene_of(system, contact), state(start), times[-1] - start[0] + 1e-3)
        # the accuracy of a contact is 1e-10 us, and it grows a little with each
        np.testing.assert_allclose(found.contacts.arrival_time_us[:4], times, rtol=0.0, atol=2e-8)


def test_the_end_may_lie_within_a_contact():
    system = reference(1.01, 4.0)
    start = began(system, 150.0)
    first = follow(system, *start, until_us=100.0, contacts=2).contacts[0]
    for share in (0.1, 0.35, 0.5, 0.9):
        end = first.arrival_time_us + share * (first.departure_time_us - first.arrival_time_us)
        course = follow(system, *start, until_us=end)
        simulation = simulate(scene_of(system), state(start), end - start[0])
        np.testing.assert_allclose(float(simulation.final.position_nm), course.position_nm, rtol=0.0, atol=1e-7)
        assert ContactPhase(int(simulation.phase)).name.lower() == course.phase


@pytest.mark.slow
def test_dense_output_agrees_with_an_independent_integration():
    system = reference(5.277, 4.0)
    start = began(system, 40.0)
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
    when, weights = DensePath(scene, simulation).nodes(start[0], start[0] + 25.0)
    assert weights.sum() == pytest.approx(25.0, abs=1e-8)
    dense = trajectory(scene, simulation, when)
    # work of the contact force on the gap is what the finished contacts dissipated
    work = -float(np.sum(weights * dense.force_nn * dense.gap_rate_nm_per_us))
    assert int(simulation.outcome) == MotionOutcome.FINISHED
    assert work == pytest.approx(float(np.sum(simulation.contacts.energy_lost_aj)), rel=1e-6)


@pytest.mark.slow
def test_derivatives_forward_and_reverse_alone_and_in_a_batch():
    at, speeds = jnp.array([0.1, 1.005e-3, 40.0]), jnp.array([40.0, 60.0])
    start = began(reference(5.277, 4.0), 60.0)

    def second_arrival(parameters, speed, *, reverse=False):
        offset, viscosity, quality = parameters
        contact = Contact.paper(viscosity_pa_s=viscosity)
        scene = Scene(Cantilever(90.0, quality, 1.0), Platform(4.0, 180.0 * 5.277, offset), contact)
        begin = State(jnp.asarray(start[0]), jnp.asarray(start[1]), start[2] + speed - 60.0)
        found = simulate(scene, begin, 14.0, max_contacts=4, reverse=reverse, max_rounds=8)
        return found.contacts.arrival_time_us[1]

    def independent(parameters, speed):
        offset, viscosity, quality = (float(value) for value in parameters)
        contact = ContactParameters(viscosity_pa_s=viscosity)
        moved = reference(5.277, 4.0, offset, quality_factor=quality, contact=contact)
        begin = (*start[:2], start[2] + float(speed) - 60.0)
        return follow(moved, *begin, until_us=100.0, contacts=2).contacts[1].arrival_time_us

    forward = np.asarray(jax.jit(jax.vmap(jax.jacfwd(second_arrival), in_axes=(None, 0)))(at, speeds))
    backward = jax.grad(lambda parameters: second_arrival(parameters, speeds[1], reverse=True))(at)
    # the two go different ways through a contact, to 1e-9 each
    np.testing.assert_allclose(forward[1], backward, rtol=1e-5)
    for row, speed in enumerate(speeds):
        for place, step in enumerate((1e-4, 1e-6, 1e-2)):
            shift = step * np.eye(3)[place]
            slope = (independent(at + shift, speed) - independent(at - shift, speed)) / (2.0 * step)
            # rounding of the differences: 1e-12 us over the steps
            np.testing.assert_allclose(forward[row, place], slope, rtol=1e-5, atol=1e-9)
