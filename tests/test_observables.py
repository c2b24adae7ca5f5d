"""Settling and observables, compared with closed forms, with orbits of the impact law, and with made-up sequences."""

import numpy as np
import pytest

from afm_jax import Cantilever, CollisionDelay, ImpactLaw, Platform, Scene, single_impact_orbits
from afm_jax.apparatus.drives import BaseDrive
from afm_jax.motion.follow import LongRun, follow_long
from afm_jax.motion.observe import (
    MotionWindow,
    Observables,
    observe,
    poincare_section,
)
from afm_jax.motion.settle import find_repetitions
from afm_jax.motion.simulate import simulate
from afm_jax.motion.start import default_start, start_of, state
from afm_jax.motion.trajectory import DensePath
from afm_jax.scenefile.presets import contact_scene

TABULATED = ImpactLaw(1.0, 113.6, 0.5, CollisionDelay(0.206, 5.64, 0.726))
# physics.md, full contact, Q = 40: n, beta, sigma, peak height
PEAKS = [(1.0001, 2.0, 0.0, 65.9), (1.01, 4.0, -2.0, 50.6), (1.01, 4.0, 2.0, 149.7)]


def law_scene(law: ImpactLaw = TABULATED, reduced: float = 1.01) -> Scene:
    return Scene(Cantilever(90.0, 40.0), Platform(4.0, 180.0 * reduced), law)


def seen_of(scene: Scene, periods: float, start=None) -> tuple[LongRun, Observables]:
    begin = default_start(scene) if start is None else start
    run = follow_long(scene, begin, periods * float(scene.platform.period_us))
    return run, observe(scene, run.simulation, harmonics=(1, 2), verdict=run.verdict)


def repetition(times: np.ndarray, velocities: np.ndarray, *, tolerance: float) -> tuple[int, int, float]:
    """Return m, N and the remaining distance of departures under a drive of 2 us; m = 0 where nothing repeats."""
    found = find_repetitions(times[None] / 2.0, velocities[None], tolerance=tolerance)
    return int(found.contacts[0]), int(found.periods[0]), float(found.remaining[0])


def spiral(m: int, n: int, rate: float, turns: float, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return departures of an (m, n) motion in periods of 2 us, that spirals in by `rate` a repetition."""
    index = np.arange(count)
    decay = 0.3 * rate ** (index / m)
    angle = 2.0 * np.pi * turns * index / m
    times = 2.0 * n * (index // m) + (2.0 * n / m * 0.9) * (index % m) + 0.1 * decay * np.cos(angle)
    return times, 50.0 + 7.0 * (index % m) + 10.0 * decay * np.sin(angle)


@pytest.mark.parametrize(("m", "n"), [(1, 5), (2, 3)])
def test_a_repetition_is_found_with_its_smallest_period(m: int, n: int):
    times, velocities = spiral(m, n, 0.8, 0.13, 90 * m)
    assert repetition(times, velocities, tolerance=1e-4)[:2] == (m, n)


@pytest.mark.parametrize(("m", "n", "turns"), [(2, 3, 0.25), (1, 1, 0.331), (2, 3, 0.5)])
def test_a_slow_approach_that_turns_is_no_longer_repetition(m: int, n: int, turns: float):
    # a quarter of a turn a repetition: every fourth comes close long before neighbours do
    every = [spiral(m, n, 0.98, turns, count) for count in range(60 * m, 1000 * m, 40 * m)]
    found = (repetition(*one, tolerance=1e-4)[:2] for one in every)
    assert next(filter(any, found)) == (m, n)


def test_a_slow_approach_has_not_arrived():
    # each repetition moves by 1e-5 of the scale, but 1/(1 - rate) = 1000 of them are to come
    times, velocities = spiral(1, 1, 0.999, 0.0, 3000)
    moved = 2.0 * np.pi * abs(times[-1] - times[-2] - 2.0) / 2.0
    assert moved < 1e-4
    assert repetition(times, velocities, tolerance=1e-4)[0] == 0
    contacts, _, remaining = repetition(times, velocities, tolerance=1.0)
    assert contacts == 1
    exact = 2.0 * np.pi * (times[-1] - 2.0 * (len(times) - 1)) / 2.0
    # the series is geometric; the block's maximum is at most six repetitions old
    np.testing.assert_allclose(remaining, exact, rtol=0.01)


def test_a_law_settles_on_its_orbit():
    scene = law_scene()
    orbits = single_impact_orbits(scene, 1)
    wanted = np.asarray(orbits.admissible) & np.asarray(orbits.stable)
    assert wanted.sum() == 1
    slot = int(np.argmax(wanted))
    velocity, phase = float(orbits.velocity_after_nm_per_us[slot]), float(orbits.phase_rad[slot])
    time = phase / float(scene.platform.angular_frequency)
    # a little off the orbit: the motion has to find it
    run, seen = seen_of(scene, 400.0, state(time, float(scene.platform.position(time)), 1.02 * velocity))
    assert (run.verdict.settled, run.verdict.contacts, run.verdict.periods) == (True, 1, 1)
    # the transient has decayed to rounding, which the impact map's times carry as 1e-12 us
    for name in ("peak_amplitude_nm", "lockin_amplitude_nm", "lockin_phase_deg"):
        np.testing.assert_allclose(getattr(seen, name), float(getattr(orbits, name)[slot]), rtol=1e-7, err_msg=name)
    phases, rows = poincare_section(scene, run.simulation)
    speed = float(orbits.approach_speed_nm_per_us[slot])
    last = [phases[-1], rows.approach_speed_nm_per_us[-1]]
    np.testing.assert_allclose(last, [np.degrees(phase), speed], rtol=1e-7)


def test_the_platform_gives_what_air_and_impacts_take():
    # without delay the work of an impact is the platform's speed times the momentum it gives
    scene = law_scene(ImpactLaw(0.9, 20.0))
    run, seen = seen_of(scene, 300.0)
    assert run.verdict.settled
    assert run.verdict.periods == 1
    rows = run.simulation.contacts
    speed = float(scene.platform.velocity(rows.departure_time_us[-1]))
    kick = float(rows.departure_velocity_nm_per_us[-1] - rows.arrival_velocity_nm_per_us[-1])
    # the window is another repetition of a motion settled to rounding; its integrals are exact to 1e-9
    np.testing.assert_allclose(seen.given_by_drives_aj, speed * kick, rtol=1e-6)
    taken = seen.dissipated_in_air_aj + seen.dissipated_in_contact_aj
    np.testing.assert_allclose(seen.given_by_drives_aj, taken, rtol=1e-6)


def test_a_platform_at_rest_gives_nothing_to_a_tip_that_it_stops():
    # every impact before the capture counts, and the capture: what the tip had is in the air and in the sample
    scene = Scene(Cantilever(90.0, 40.0), Platform(0.0, 180.0), ImpactLaw(0.9, 200.0))
    start, end = state(0.0, 60.0, 0.0), 60.0
    simulation = simulate(scene, start, end, max_contacts=20)
    assert bool(simulation.held)
    assert int(simulation.count) > 2
    energy = MotionWindow(DensePath(scene, simulation), 0.0, end).energy
    # the Gauss sums over each flight are exact to 1e-12
    np.testing.assert_allclose(energy.given_aj, 0.0, atol=1e-9 * energy.contact_aj)
    np.testing.assert_allclose(energy.air_aj + energy.contact_aj, -energy.stored_aj, rtol=1e-9)


def test_a_free_cantilever_responds_as_it_must():
    free, driven, quality, mass = 90.0, 85.0, 40.0, 1.7
    scene = Scene(Cantilever(free, quality, mass), Platform(0.0, driven), None, BaseDrive(1.3, driven, 25.0))
    run, seen = seen_of(scene, 400.0)
    assert (run.verdict.settled, run.verdict.contacts, run.verdict.periods) == (True, 0, 1)
    base, ratio = 1.3 * np.exp(1j * np.radians(25.0)), driven / free
    response = base / (1.0 - ratio**2 + 1j * ratio / quality)
    deflection = response - base
    # what is left of the transient after 400 periods is 1e-14; the maximum is found to the square of a grid's step
    np.testing.assert_allclose(seen.peak_amplitude_nm, abs(response), rtol=1e-8)
    assert seen.peak_deflection_nm is not None
    assert seen.deflection_harmonics is not None
    np.testing.assert_allclose(seen.peak_deflection_nm, abs(deflection), rtol=1e-8)
    for harmonic, exact in ((seen.harmonics[0], response), (seen.deflection_harmonics[0], deflection)):
        np.testing.assert_allclose(harmonic.amplitude_nm, abs(exact), rtol=1e-9)
        np.testing.assert_allclose(harmonic.phase_deg, np.degrees(np.angle(exact)) % 360.0, rtol=1e-9)
    assert seen.harmonics[1].amplitude_nm < 1e-9 * abs(response)
    # air takes (m Omega/Q) omega^2 a^2/2 a second
    omega = 2e-3 * np.pi * driven
    loss = mass * (2e-3 * np.pi * free / quality) * 0.5 * (omega * abs(response)) ** 2 * 2.0 * np.pi / omega
    np.testing.assert_allclose(seen.dissipated_in_air_aj, loss, rtol=1e-9)
    np.testing.assert_allclose(seen.given_by_drives_aj, loss, rtol=1e-9)


def test_a_vibration_that_dies_away_settles_when_it_has():
    scene = Scene(Cantilever(90.0, 40.0), Platform(1.0, 180.0), None)
    short = follow_long(scene, state(0.0, 50.0, 0.0), 100.0)
    assert not short.verdict.settled
    assert "transient" in short.verdict.reason
    # exp(-Omega t/2Q) = 1e-6 after 1955 us, and the velocity scale is the platform's 1.1 nm/us
    assert follow_long(scene, state(0.0, 50.0, 0.0), 2500.0).verdict.settled


def test_a_start_has_the_phase_it_was_told():
    scene = law_scene()
    begin = start_of(scene, (450.0, 5.0, 80.0))
    assert float(begin.time_us) == pytest.approx(0.25 * float(scene.platform.period_us), rel=1e-14)
    # a quarter of a period after its highest point the platform is at its mean, 0
    assert [float(begin.position_nm), float(begin.velocity_nm_per_us)] == pytest.approx([5.0, 80.0], rel=1e-12)
    # of many scenes one each, at their own times; the platform at its mean may rest at another height
    frequencies, offsets = np.array([150.0, 180.0, 200.0]), np.array([0.0, 1.0, -2.0])
    many = start_of(Scene(Cantilever(90.0, 40.0), Platform(4.0, frequencies, offsets), TABULATED), (450.0, 5.0, 80.0))
    np.testing.assert_allclose(many.time_us, 250.0 / frequencies, rtol=1e-14)
    np.testing.assert_allclose(many.position_nm, 5.0 + offsets, rtol=1e-12)
    np.testing.assert_array_equal(many.velocity_nm_per_us, [80.0] * 3)


@pytest.mark.slow
@pytest.mark.parametrize(("reduced", "amplitude", "offset", "peak"), PEAKS)
def test_the_contact_reaches_the_heights_of_the_paper(reduced: float, amplitude: float, offset: float, peak: float):
    scene = contact_scene(reduced, amplitude, offset)
    run, seen = seen_of(scene, 300.0)
    assert (run.verdict.settled, run.verdict.contacts, run.verdict.periods) == (True, 1, 1)
    # physics.md gives three digits
    np.testing.assert_allclose(seen.peak_amplitude_nm, peak, rtol=2e-3)
    # an integral of the drive's work, another of air, and the ledger of the contact: settled to 1e-8, exact to 1e-9
    assert seen.energy_imbalance is not None
    assert abs(seen.energy_imbalance) < 1e-6
    assert seen.most_attractive_force_nn is not None
    # the JKR contact pulls with 3/2 pi w R at most: 141.37 nN for w = 0.3 J/m^2, R = 100 nm
    np.testing.assert_allclose(seen.most_attractive_force_nn, -1.5 * np.pi * 0.3 * 100.0, rtol=1e-5)
