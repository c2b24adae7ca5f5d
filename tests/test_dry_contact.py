"""Dry contacts (Hertz, DMT): closed form, an independent integration, ledger, derivatives, scenes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import cumulative_trapezoid, quad, solve_ivp

from afm_jax import Cantilever, Platform, Scene, capture_speed, collide, find_junction, make_law, simulate, trajectory
from afm_jax.contact.contact import Contact
from afm_jax.contact.forces import Dmt, Hertz, VanDerWaals, Viscous
from afm_jax.motion.record import MotionOutcome
from afm_jax.motion.start import default_start
from afm_jax.outcomes import CollisionOutcome
from fitting import law_of_contact

DRY = {"hamaker_constant_aj": 0.1, "contact_distance_nm": 0.165, "range_nm": 20.0, "modulus_gpa": 100.0}
DRY |= {"tip_radius_nm": 100.0, "viscosity_pa_s": 1.005e-3}
SPEEDS = np.array([2.0, 8.0, 30.0, 120.0])


def integrated(speed, *, mass=1.0, viscous=False, **changed):
    """Return rebound speed, delay, deepest gap and viscous loss by SciPy, from the forces as the issue writes them."""
    value = DRY | changed
    h, a0, reach, modulus, radius, eta = (value[name] for name in DRY)
    drag = 1.5 * np.pi * eta * 1e-3 * radius**2 if viscous else 0.0

    def rates(_, y):
        gap, rate, _ = y
        if gap > a0:
            lost = drag * rate / gap
            return [rate, (-h * radius / (6.0 * gap**2) - lost) / mass, lost * rate]
        force = modulus * np.sqrt(radius) * max(a0 - gap, 0.0) ** 1.5 - h * radius / (6.0 * a0**2)
        return [rate, force / mass, 0.0]

    def leg(y, event, direction, from_us):
        event.terminal, event.direction = True, direction
        way = solve_ivp(rates, (from_us, from_us + 1e3), y, "DOP853", events=event, rtol=1e-13, atol=1e-13)
        return way.y_events[0][0], way.t_events[0][0]

    at_a0, at_end, past = (lambda _, y: y[0] - a0), (lambda _, y: y[0] - reach), np.array([1e-15, 0.0, 0.0])
    state, time = leg([reach, -speed, 0.0], at_a0, -1.0, 0.0)
    turn, _ = leg(state - past, lambda _, y: y[1], 1.0, time)
    state, time = leg(state - past, at_a0, 1.0, time)
    state, time = leg(state + past, at_end, 1.0, time)
    return state[1], time - reach / speed - reach / state[1], turn[0], state[2]


@pytest.mark.parametrize("speed", [0.5, 20.0])
def test_hertz_collision_time_is_the_closed_form(speed):
    contact = Contact(forces=(), junction=Hertz(modulus_gpa=3.0, tip_radius_nm=20.0))
    result = collide(contact, speed, 2.0)
    # m u^2/2 = (2/5) K sqrt(R) delta^(5/2); T = 2 delta/u int_0^1 dx/sqrt(1 - x^(5/2)), x = 1 - y^2
    deepest = (1.25 * 2.0 * speed**2 / (3.0 * np.sqrt(20.0))) ** 0.4
    integral = quad(lambda y: 2.0 * y / np.sqrt(1.0 - (1.0 - y * y) ** 2.5) if y else 0.0, 0.0, 1.0, epsabs=1e-13)[0]
    assert integral == pytest.approx(2.943275 / 2.0, rel=1e-6)
    assert float(result.deepest_gap_nm) == pytest.approx(-deepest, rel=1e-12)
    assert float(result.collision_delay_us) == pytest.approx(2.0 * integral * deepest / speed, rel=1e-9)
    assert float(result.time_in_contact_us) == float(result.time_in_junction_us) == float(result.collision_delay_us)
    assert float(result.rebound_speed_nm_per_us) == pytest.approx(speed, rel=1e-14)


@pytest.mark.parametrize(
    ("changed", "viscous"),
    [
        ({"hamaker_constant_aj": 1.0, "range_nm": 50.0}, False),
        ({"contact_distance_nm": 0.4}, True),
    ],
)
def test_collisions_are_those_of_an_independent_integration(changed, viscous):
    effects = ["van_der_waals", "dmt"] + ["viscous"] * viscous
    result = collide(Contact.of(effects, **(DRY | changed)), SPEEDS)
    leaves = np.asarray(result.outcome) == CollisionOutcome.REBOUND
    assert leaves.sum() >= 3
    expected = np.array([integrated(speed, viscous=viscous, **changed) for speed in SPEEDS[leaves]]).T
    np.testing.assert_allclose(result.rebound_speed_nm_per_us[leaves], expected[0], rtol=1e-9)
    np.testing.assert_allclose(result.collision_delay_us[leaves], expected[1], rtol=1e-8, atol=1e-8)
    np.testing.assert_allclose(result.deepest_gap_nm[leaves], expected[2], rtol=1e-9)
    np.testing.assert_allclose(result.viscous_loss_aj[leaves], expected[3], rtol=1e-7, atol=1e-9)


def test_without_damping_nothing_is_lost_and_no_tip_is_captured():
    contact = Contact(forces=(VanDerWaals(),), junction=Dmt())
    result = collide(contact, np.geomspace(0.01, 500.0, 12))
    np.testing.assert_allclose(result.rebound_speed_nm_per_us, result.approach_speed_nm_per_us, rtol=1e-11)
    assert not result.captured.any()
    assert float(capture_speed(contact)) == 0.0
    junction = find_junction(contact)
    assert float(junction.hysteresis_aj) == 0.0
    # the force is continuous where the solids meet, -H R/(6 a0^2) there
    assert float(junction.force_nn) == pytest.approx(-0.1 * 100.0 / (6.0 * 0.165**2), rel=1e-12)
    assert float(contact.solid.force(0.0)) == pytest.approx(float(junction.force_nn), rel=1e-12)


def test_the_ledger_closes_with_drag_alone_and_the_slowest_tip_is_captured():
    contact = Contact(forces=VanDerWaals() + Viscous(), junction=Dmt())
    threshold = float(capture_speed(contact))
    result = collide(contact, threshold * np.array([0.999, 1.001, 2.0, 20.0]))
    assert result.captured.tolist() == [True, False, False, False]
    # there is no liquid bridge that could hold it
    assert "a dry contact's attraction" in CollisionOutcome(int(result.outcome[0])).sentence
    lost = 0.5 * (result.approach_speed_nm_per_us**2 - result.rebound_speed_nm_per_us**2)
    np.testing.assert_allclose(result.viscous_loss_aj[1:], lost[1:], rtol=1e-9)


@pytest.mark.slow
def test_derivatives_forward_and_reverse_are_central_differences():
    names, effects = list(DRY), ["van_der_waals", "viscous", "dmt"]
    start = jnp.array([DRY[name] for name in names] + [25.0])

    def outputs(values):
        contact = Contact.of(effects, **dict(zip(names, values[:-1], strict=True)))
        result = collide(contact, values[-1], accuracy=1e-11)
        return jnp.stack([result.rebound_speed_nm_per_us, result.collision_delay_us, result.deepest_gap_nm])

    forward, reverse = jax.jit(jax.jacfwd(outputs))(start), jax.jit(jax.jacrev(outputs))(start)
    np.testing.assert_allclose(reverse, forward, rtol=1e-9, atol=1e-12)
    for place, value in enumerate(np.asarray(start)):
        step = 1e-4 * value
        high, low = (jax.jit(outputs)(start.at[place].add(sign * step)) for sign in (1.0, -1.0))
        expected = (high - low) / (2.0 * step)
        # error of the difference: step^2 times the third derivative, and rounding over the step
        np.testing.assert_allclose(forward[:, place], expected, rtol=2e-6, atol=1e-9 / value)


def test_law_of_a_dry_contact_gives_back_the_speed():
    contact = Contact(forces=(VanDerWaals(),), junction=Dmt())
    table = make_law(contact)
    assert float(table.capture_speed_nm_per_us) == 0.0
    np.testing.assert_allclose(table.rebound_speed(SPEEDS), SPEEDS, rtol=1e-6)
    law = law_of_contact(contact)
    assert law.epsilon == pytest.approx(0.0, abs=1e-6)
    assert law.r == pytest.approx(1.0, abs=1e-9)


@pytest.mark.slow
def test_the_trajectory_follows_simulated_contacts():
    contact = Contact(VanDerWaals() + Viscous(), Dmt())
    scene = Scene(Cantilever(90.0, 40.0, 1.0), Platform(4.0, 180.0, 0.0), contact)
    simulation = simulate(scene, default_start(scene), 4.5 * float(scene.platform.period_us), max_contacts=16)
    assert int(simulation.outcome) == MotionOutcome.FINISHED
    rows = simulation.contacts
    assert rows.detail is not None
    assert int(rows.detail.junctions[1]) == 1
    times = np.linspace(float(rows.arrival_time_us[1]), float(rows.departure_time_us[1]), 513)
    path = trajectory(scene, simulation, times)
    assert path.gap_nm.min() == pytest.approx(float(rows.detail.deepest_gap_nm[1]), rel=1e-3)
    assert path.gap_nm[-1] == pytest.approx(float(contact.bridge_breaks_nm), abs=1e-6)
    moved = cumulative_trapezoid(path.gap_rate_nm_per_us, times, initial=0.0)
    # the trapezoidal rule's error, from the acceleration's jump where the solids meet
    np.testing.assert_allclose(path.gap_nm, path.gap_nm[0] + moved, atol=2e-3)
