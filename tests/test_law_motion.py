"""Law scenes in time: against the impact map, SciPy's integration, and the balance of energy."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import quad

from afm_jax.apparatus.cantilever import Cantilever
from afm_jax.apparatus.drives import BaseDrive, ForceDrive, Tone
from afm_jax.apparatus.platform import Platform
from afm_jax.apparatus.scene import Scene
from afm_jax.contact.junction import Phase
from afm_jax.impact.law import ImpactLaw
from afm_jax.impact.map import iterate_map
from afm_jax.motion.record import ContactKind, MotionOutcome, Simulation, State
from afm_jax.motion.simulate import simulate
from afm_jax.outcomes import Outcome
from tests.package_scenes import bouncing
from tests.reference_law_motion import Cosines, LawCourse, LawSystem, follow

PRESSING = LawSystem(Cosines(4.0, 0.0, ((5.0, 20.0, 0.0),)), r=0.3, quality_factor=40.0)
"""A slow platform that presses the tip up most of the time, and lets it go near its lowest point."""
PRESSING_START, PRESSING_DURATION = (3.0, 12.0, -4.0), 72.0
ROWS = 24
"""One number for most tests: it shapes the program, and programs are shared."""
DRIVEN = LawSystem(
    Cosines(-1.0, 2e-3, ((3.0, 170.0, 0.0), (0.7, 33.0, 50.0))),
    r=0.98,
    epsilon=40.0,
    viscous_loss=0.2,
    quality_factor=40.0,
    base=Cosines(parts=((1.5, 88.0, 30.0),)),
    force=Cosines(parts=((0.6, 93.0, 200.0), (0.9, 40.0, 10.0))),
)


def scene_of(system: LawSystem) -> Scene:
    """Return the package's scene for the reference's system."""
    quality = None if np.isinf(system.quality_factor) else system.quality_factor
    first, *more = system.platform.parts
    second = Tone(*more[0]) if more else None
    platform = Platform(first[0], first[1], system.platform.offset, system.platform.rate, second)
    bases, forces = ([Tone(*part) for part in motion.parts] for motion in (system.base, system.force))
    base = BaseDrive(bases[0].amplitude, bases[0].frequency_khz, bases[0].phase_deg) if bases else None
    force = (
        ForceDrive(forces[0].amplitude, forces[0].frequency_khz, forces[0].phase_deg, *forces[1:]) if forces else None
    )
    law = ImpactLaw(system.r, system.epsilon, system.viscous_loss)
    return Scene(Cantilever(system.frequency_khz, quality), platform, law, base, force)


def simulated(
    scene: Scene, start: tuple[float, float, float], duration: float, rows: int = ROWS, **options: Any
) -> Simulation:
    return simulate(scene, State(*(jnp.asarray(value) for value in start)), duration, max_contacts=rows, **options)


def assert_same_rows(simulation: Simulation, course: LawCourse, rows: int) -> None:
    """Check the first rows and what they say of arrival and departure."""
    contacts, exact = simulation.contacts, np.array(course.rows[:rows])
    pairs = (
        (contacts.arrival_time_us, 1e-8),
        (contacts.arrival_velocity_nm_per_us, 1e-6),
        (contacts.departure_time_us, 1e-8),
        (contacts.departure_velocity_nm_per_us, 1e-6),
    )
    for column, (values, atol) in enumerate(pairs):
        # DOP853 at 1e-12 over some periods, stretched by about 2 an impact
        np.testing.assert_allclose(np.asarray(values)[:rows], exact[:, column], rtol=0.0, atol=atol)


@pytest.mark.parametrize(
    "changes", [{}, {"delay": None}, {"delay": None, "epsilon": 900.0}], ids=["delayed", "instant", "captured"]
)
def test_flights_and_impacts_are_those_of_the_map(changes):
    scene, time = bouncing(**changes), 4.0
    rows = iterate_map(scene, time, 60.0, 14)
    result = simulated(scene, (time, float(scene.platform.position(time)), 60.0), 100.0)
    contacts, count = result.contacts, int(result.count)
    assert count >= 12
    assert np.all(np.asarray(contacts.kind)[count:] == ContactKind.NONE)
    captured = int(rows.outcome[count - 1]) == Outcome.CAPTURED
    assert captured == (changes.get("epsilon") == 900.0)
    impacts = slice(0, count - 1 if captured else min(count, 14))
    arrivals = slice(0, min(count, 14))
    # the same functions, compiled once more
    for ours, maps, which in (
        (contacts.arrival_time_us, rows.arrival_time_us, arrivals),
        (contacts.arrival_velocity_nm_per_us, rows.velocity_before_nm_per_us, arrivals),
        (contacts.departure_time_us, rows.time_us, impacts),
        (contacts.departure_velocity_nm_per_us, rows.velocity_after_nm_per_us, impacts),
    ):
        np.testing.assert_allclose(np.asarray(ours)[which], np.asarray(maps)[which], rtol=1e-12, atol=1e-12)
    if not captured:
        assert int(result.outcome) == MotionOutcome.FINISHED
        assert int(result.phase) == Phase.DRY
        return
    assert int(result.outcome) == MotionOutcome.HELD
    assert bool(result.held)
    assert int(result.phase) == Phase.JUNCTION
    assert int(contacts.kind[count - 1]) == ContactKind.HELD
    assert float(contacts.departure_time_us[count - 1]) == np.inf
    approach = float(contacts.approach_speed_nm_per_us[count - 1])
    assert float(contacts.energy_lost_aj[count - 1]) == pytest.approx(0.5 * approach**2, rel=1e-14)  # 1 ng
    # 4 nm at 1.01 times 180 kHz around -1 nm
    angle = 2e-3 * np.pi * 181.8 * 104.0
    assert float(result.final.position_nm) == pytest.approx(-1.0 + 4.0 * np.cos(angle), abs=1e-12)
    assert float(result.final.velocity_nm_per_us) == pytest.approx(-4e-3 * 2 * np.pi * 181.8 * np.sin(angle), abs=1e-11)


@pytest.mark.parametrize(
    ("system", "start"),
    [
        (LawSystem(Cosines(-1.0, 0.0, ((4.0, 181.8, 0.0),)), 0.99, 50.0, quality_factor=40.0), (1.3, 25.0, -7.0)),
        (DRIVEN, (0.4, 18.0, 3.0)),
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


def test_a_series_of_impacts_ends_at_rest_until_the_platform_lets_go():
    until = PRESSING_START[0] + PRESSING_DURATION
    course = follow(PRESSING, *PRESSING_START, until)
    result = simulated(scene_of(PRESSING), PRESSING_START, PRESSING_DURATION)
    assert int(result.outcome) == MotionOutcome.FINISHED
    kind = np.asarray(result.contacts.kind)
    rests = np.flatnonzero(kind == ContactKind.CHATTER)
    assert rests.size >= 2
    last = int(rests[0])
    assert last > 4
    # up to the rest impact by impact, as SciPy has them
    assert_same_rows(result, course, last)
    released = float(result.contacts.departure_time_us[last])
    arrived = float(result.contacts.arrival_time_us[last])
    exact = PRESSING.turns(released - 0.5, released + 0.5)
    # both roots to about 1e-13
    assert released == pytest.approx(exact, abs=1e-11)
    assert min(PRESSING.push(t) for t in np.linspace(arrived, released - 1e-6, 2000)) > 0.0
    assert float(result.contacts.rebound_speed_nm_per_us[last]) == 0.0
    assert float(result.contacts.departure_position_nm[last]) == pytest.approx(
        PRESSING.platform.derivative(0, exact), abs=1e-10
    )
    # after it, SciPy once more from the release
    onward = follow(
        PRESSING, exact, PRESSING.platform.derivative(0, exact), PRESSING.platform.derivative(1, exact), until
    )
    some = int(rests[1]) - last - 1
    assert some > 2
    for shift in range(some):
        here = onward.rows[shift]
        row = last + 1 + shift
        # a flight that begins with gap ~ t^3: SciPy's 1e-13 nm is not seen in its impact
        assert float(result.contacts.arrival_time_us[row]) == pytest.approx(here[0], abs=1e-8)
        assert float(result.contacts.departure_velocity_nm_per_us[row]) == pytest.approx(here[3], abs=1e-7)


def test_a_rest_at_the_end_is_held():
    result = simulated(scene_of(PRESSING), PRESSING_START, 40.0)
    last = int(result.count) - 1
    assert int(result.outcome) == MotionOutcome.HELD
    assert int(result.contacts.kind[last]) == ContactKind.HELD
    assert float(result.contacts.departure_time_us[last]) == np.inf
    for order, value in enumerate((result.final.position_nm, result.final.velocity_nm_per_us)):
        assert float(value) == pytest.approx(PRESSING.platform.derivative(order, 43.0), abs=1e-11)


def test_a_tip_captured_without_adhesion_is_let_go_too():
    system = LawSystem(PRESSING.platform, r=0.5, viscous_loss=1.5, quality_factor=40.0)
    course = follow(system, *PRESSING_START, 75.0)
    result = simulated(scene_of(system), PRESSING_START, PRESSING_DURATION)
    assert int(result.count) == len(course.rows)
    assert_same_rows(result, course, len(course.rows))
    rebound = np.asarray(result.contacts.rebound_speed_nm_per_us)[: len(course.rows)]
    rested = np.asarray(result.contacts.departure_time_us - result.contacts.arrival_time_us)[: len(course.rows)] > 0.0
    assert rested.sum() >= 2
    np.testing.assert_array_equal(rebound == 0.0, rested)
    assert ContactKind.CHATTER not in result.contacts.kind


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


def test_a_tip_that_the_platform_never_presses_leaves_at_once():
    # far below its rest position the platform pulls: a captured tip has nothing that holds it
    system = LawSystem(Cosines(-6.0, 0.05, ((2.0, 37.0, 0.0),)), r=0.5, viscous_loss=30.0)
    start = (0.0, -3.0, -9.0)
    course = follow(system, *start, 60.0)
    result = simulated(scene_of(system), start, 60.0)
    assert int(result.count) == len(course.rows) > 1
    assert_same_rows(result, course, len(course.rows))
    contacts = result.contacts
    assert np.all(np.asarray(contacts.departure_time_us) == np.asarray(contacts.arrival_time_us))
    assert np.all(np.asarray(contacts.rebound_speed_nm_per_us) == 0.0)


@pytest.mark.parametrize(
    ("system", "time"),
    [
        # at the top of a fast platform, which leaves the tip behind at once
        (LawSystem(Cosines(0.0, 0.0, ((4.0, 181.8, 0.0),)), 0.9, quality_factor=40.0), 0.0),
        # pressed by a slow one, which lets it go near its lowest point
        (PRESSING, 0.0),
    ],
    ids=["let go at once", "rides"],
)
def test_a_start_at_rest_on_the_platform_rides_until_it_lets_go(system, time):
    start = (time, system.platform.derivative(0, time), system.platform.derivative(1, time))
    result = simulated(scene_of(system), start, 60.0)
    release = system.release(time, time + 60.0)
    assert float(result.contacts.departure_time_us[0]) == pytest.approx(release, abs=1e-11)
    assert float(result.contacts.arrival_time_us[0]) == time
    assert float(result.contacts.energy_lost_aj[0]) == 0.0
    let_go = (release, system.platform.derivative(0, release), system.platform.derivative(1, release))
    course = follow(system, *let_go, time + 60.0)
    assert len(course.rows) > 1
    for row, exact in enumerate(course.rows[:2], start=1):
        # SciPy's 1e-13 nm in a flight that begins with gap ~ t^2 or t^3
        assert float(result.contacts.arrival_time_us[row]) == pytest.approx(exact[0], abs=1e-8)
    sticky = simulated(scene_of(LawSystem(system.platform, 0.9, 40.0, quality_factor=40.0)), start, 60.0)
    assert int(sticky.outcome) == MotionOutcome.HELD
    assert int(sticky.count) == 1


def test_a_platform_that_stays_where_the_tip_rests_holds_it():
    # N = 0 throughout: no push, no pull
    scene = Scene(Cantilever(90.0, 40.0), Platform(0.0, 180.0), ImpactLaw(r=0.5, viscous_loss=0.5))
    result = simulated(scene, (0.0, 3.0, 0.0), 400.0)
    assert int(result.outcome) == MotionOutcome.HELD
    assert float(result.final.position_nm) == 0.0


def test_full_rows_end_a_simulation_where_another_can_begin():
    scene = bouncing(delay=None)
    start = (4.0, float(scene.platform.position(4.0)), 60.0)
    whole = simulated(scene, start, 80.0)
    part = simulated(scene, start, 80.0, 5)
    assert int(whole.count) > 5
    assert int(part.outcome) == MotionOutcome.CONTACT_LIMIT
    assert int(part.count) == 5
    assert float(part.final.time_us) == float(part.contacts.departure_time_us[4])
    rest = simulate(scene, part.final, 84.0 - part.final.time_us, max_contacts=ROWS)
    # the state is handed on to rounding; the map stretches by about 2 an impact
    assert int(rest.count) == int(whole.count) - 5
    assert float(rest.final.position_nm) == pytest.approx(float(whole.final.position_nm), rel=1e-10)
    # as many rows as contacts are enough
    between = 0.5 * float(whole.contacts.departure_time_us[4] + whole.contacts.arrival_time_us[5])
    enough = simulated(scene, start, between - 4.0, 5)
    assert int(enough.outcome) == MotionOutcome.FINISHED
    assert int(enough.count) == 5


@pytest.mark.parametrize(
    ("start", "outcome"),
    [
        ((4.0, -9.0, 60.0), MotionOutcome.INVALID_START),
        ((4.0, np.nan, 60.0), MotionOutcome.INVALID_START),
        ((np.nan, 9.0, 60.0), MotionOutcome.INVALID_START),
        ((0.0, 3.0, -1.0), MotionOutcome.INVALID_START),  # on the platform, into it
        ((0.0, 3.0, 1.0), MotionOutcome.FINISHED),
    ],
)
def test_a_start_that_is_none_is_said(start, outcome):
    result = simulated(bouncing(delay=None), start, 0.5)
    assert int(result.outcome) == outcome
    assert int(result.count) == 0


def test_an_end_within_the_collision_delay_is_on_the_platform():
    scene = bouncing()
    start = (4.0, float(scene.platform.position(4.0)), 60.0)
    contacts = simulated(scene, start, 80.0).contacts
    row = int(np.argmax(np.asarray(contacts.departure_time_us - contacts.arrival_time_us)))
    middle = 0.5 * float(contacts.arrival_time_us[row] + contacts.departure_time_us[row])
    cut = simulated(scene, start, middle - 4.0)
    assert int(cut.count) == row + 1
    assert int(cut.contacts.kind[row]) == ContactKind.HELD
    assert int(cut.outcome) == MotionOutcome.HELD
    assert float(cut.final.position_nm) == pytest.approx(float(scene.platform.position(cut.final.time_us)), abs=1e-12)


def end_of_a_rest(offset: Any, r: Any, *, reverse: bool = False) -> Any:
    """Return position and velocity after a rest, a function of what comes before it only through the release."""
    platform = Platform(5.0, 20.0, offset)
    scene = Scene(Cantilever(90.0, 40.0), platform, ImpactLaw(r))
    final = simulated(scene, PRESSING_START, 28.8, reverse=reverse).final
    return jnp.stack([final.position_nm, final.velocity_nm_per_us])


def end_of_flights(offset: Any, r: Any, *, reverse: bool = False) -> Any:
    """Return position and velocity after some impacts under a drive of the base."""
    scene = Scene(Cantilever(90.0, 40.0), Platform(3.0, 170.0, offset), ImpactLaw(r, 40.0), BaseDrive(1.5, 88.0))
    final = simulated(scene, (0.4, 18.0, 3.0), 30.0, reverse=reverse).final
    return jnp.stack([final.position_nm, final.velocity_nm_per_us])


AT_REST, IN_FLIGHT = (4.0, 0.3), (-1.0, 0.98)
value_and_slopes = jax.jit(lambda end, *at: (end(*at), jax.jacfwd(end, argnums=(0, 1))(*at)), static_argnums=0)


@pytest.mark.parametrize(("end", "at"), [(end_of_a_rest, AT_REST), (end_of_flights, IN_FLIGHT)])
def test_derivatives_are_differences(end, at):
    value, slopes = value_and_slopes(end, *at)
    np.testing.assert_allclose(value, end(*at), rtol=1e-10)  # the same numbers, compiled otherwise
    for place, slope in enumerate(slopes):
        step = 1e-5 * np.eye(2)[place]
        difference = np.asarray(end(*(at + step)) - end(*(at - step))) / 2e-5
        assert np.all(np.abs(difference) > 1e-3)
        # second order in the step, rounding 1e-12/1e-5
        np.testing.assert_allclose(slope, difference, rtol=1e-5, atol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("within", [lambda slope: slope, jax.jit])
def test_reverse_that_was_not_asked_for_is_one_clear_error(within):
    with pytest.raises(ValueError, match=r"`simulate` is differentiable in reverse mode .* with `reverse=True` only"):
        within(jax.grad(lambda offset: end_of_flights(offset, 0.9).sum()))(-1.0)


@pytest.mark.slow
def test_reverse_is_forward():
    weights = jnp.array([0.3, -0.7])
    _, forward = value_and_slopes(end_of_a_rest, *AT_REST)
    backward = jax.jit(jax.grad(lambda *at: weights @ end_of_a_rest(*at, reverse=True), argnums=(0, 1)))(*AT_REST)
    for slope, gradient in zip(forward, backward, strict=True):
        # sums in another order
        np.testing.assert_allclose(gradient, weights @ slope, rtol=1e-9)


def test_a_batch_is_its_members():
    offsets, laws = np.array([4.0, -2.0, 0.5, 3.0]), np.array([0.3, 0.9, 0.5, 1.0])

    def one(offset, r):
        scene = Scene(Cantilever(90.0, 40.0), Platform(5.0, 20.0, offset), ImpactLaw(r))
        return simulated(scene, PRESSING_START, 40.0)

    batch = jax.vmap(one)(offsets, laws)
    assert len(np.unique(batch.outcome)) > 1
    for index in range(4):
        alone = one(offsets[index], laws[index])
        for ours, single in zip(jax.tree.leaves(batch), jax.tree.leaves(alone), strict=True):
            # the same program, vectorised
            np.testing.assert_allclose(np.asarray(ours)[index], np.asarray(single), rtol=1e-9, atol=1e-9)
