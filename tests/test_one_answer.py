"""One impact with a delay, one answer: orbits, map, simulation and the fit's prediction of 200 scenes agree."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from afm_jax import Cantilever, CollisionDelay, ImpactLaw, Platform, Scene, simulate, single_impact_orbits
from afm_jax.impact.map import next_impact
from afm_jax.motion.observe import observe
from afm_jax.motion.record import MotionOutcome, State
from fitting.infer.fit import model_of
from fitting.infer.search import orbits_at
from fitting.models import task_of
from fitting.parameters import DELAY_NAMES
from tests.fit_tables import table_of

LAWS, DRIVES = 8, 25
SCENES = LAWS * DRIVES
PERIODS = 100
NAMES = ("r", "epsilon", *DELAY_NAMES)


def made(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return random laws (laws, 5) and drives (drives, 4): order, frequency, amplitude, offset."""
    random = np.random.default_rng(7)
    low, high = np.array([0.9, 50.0, 0.1, -2.0, 0.0]), np.array([1.0, 130.0, 0.25, 9.0, 2.0])
    laws = random.uniform(low, high, (LAWS, 5))
    order = random.integers(1, 5, count)
    drives = [order, 180.0 * order * (1.0 + random.uniform(-0.03, 0.03, count))]
    return laws, np.stack([*drives, random.uniform(2.0, 8.0, count), random.uniform(-1.5, 1.5, count)], axis=1)


@pytest.fixture(scope="module")
def orbits() -> SimpleNamespace:
    """The scenes, what `single_impact_orbits` finds, and of each scene the fastest stable orbit and where it starts."""
    laws, drives = made(DRIVES)
    r, epsilon, hertz, lead, offset = np.repeat(laws, DRIVES, axis=0).T
    order, frequency, amplitude, height = np.tile(drives, (LAWS, 1)).T
    nothing, ones = np.zeros(SCENES), np.ones(SCENES)
    scenes = Scene(
        Cantilever(90.0 * ones, 40.0 * ones, ones),
        Platform(amplitude, frequency, height, nothing),
        ImpactLaw(r, epsilon, nothing, CollisionDelay(hertz, lead, offset)),
    )
    found = jax.jit(jax.vmap(single_impact_orbits))(scenes, order)
    stable = np.asarray(found.exists & found.admissible & found.stable)
    slot = np.argmax(np.where(stable, np.asarray(found.approach_speed_nm_per_us), -np.inf), axis=1)
    one = jax.tree.map(lambda part: np.asarray(part)[np.arange(SCENES), slot] if part.ndim > 1 else part, found)
    there = np.any(stable, axis=1)
    assert there.sum() > 0.8 * SCENES
    # impacts that last longer than the straight paths, and shorter
    assert np.any(one.delay_us[there] < 0.0)
    time = np.where(there, one.phase_rad / np.asarray(scenes.platform.angular_frequency), 0.0)
    velocity = np.where(there, one.velocity_after_nm_per_us, 100.0)
    start = State(*(jnp.asarray(part) for part in (time, scenes.platform.position(time), velocity)))
    return SimpleNamespace(scenes=scenes, order=order, there=there, found=found, start=start, one=one)


@pytest.mark.slow
def test_the_map_leads_back_to_where_an_orbit_begins(orbits):
    start, period = orbits.start, orbits.order * np.asarray(orbits.scenes.platform.period_us)
    impact = jax.jit(jax.vmap(next_impact))(orbits.scenes, start.time_us, start.velocity_nm_per_us)
    approach = orbits.scenes.platform.velocity(impact.arrival_time_us) - impact.velocity_before_nm_per_us
    for name, found, expected in (
        ("time", impact.time_us - start.time_us - period, np.zeros(SCENES)),
        ("velocity", impact.velocity_after_nm_per_us, start.velocity_nm_per_us),
        ("approach", approach, orbits.one.approach_speed_nm_per_us),
    ):
        there = np.asarray(found)[orbits.there], np.asarray(expected)[orbits.there]
        np.testing.assert_allclose(*there, rtol=1e-11, atol=1e-11 if name == "time" else 0.0, err_msg=name)


@pytest.mark.slow
def test_simulations_stay_on_the_orbit_and_read_its_amplitudes(orbits):
    def follow(scene, start, duration):
        return simulate(scene, start, duration, max_contacts=PERIODS + 2)

    period = orbits.order * np.asarray(orbits.scenes.platform.period_us)
    runs = jax.jit(jax.vmap(follow))(orbits.scenes, orbits.start, (PERIODS + 0.4) * period)
    here = orbits.there
    assert np.all(np.asarray(runs.outcome)[here] == MotionOutcome.FINISHED)
    np.testing.assert_array_equal(np.asarray(runs.count)[here], PERIODS)
    for name in ("approach_speed_nm_per_us", "rebound_speed_nm_per_us"):
        last = np.asarray(getattr(runs.contacts, name))[here, PERIODS - 1]
        np.testing.assert_allclose(last, getattr(orbits.one, name)[here], rtol=1e-9)
    late = np.flatnonzero(here & (orbits.one.delay_us > 0.0))[::20]
    early = np.flatnonzero(here & (orbits.one.delay_us < 0.0))[:3]
    assert early.size
    for lane in (*late, *early):
        scene, run = (jax.tree.map(lambda part, lane=lane: part[lane], tree) for tree in (orbits.scenes, runs))
        seen = observe(scene, run)
        assert seen.settled.settled
        assert seen.peak_amplitude_nm == pytest.approx(orbits.one.peak_amplitude_nm[lane], rel=1e-9)
        assert seen.lockin_amplitude_nm == pytest.approx(orbits.one.lockin_amplitude_nm[lane], rel=1e-9)
        turn = seen.lockin_phase_deg - orbits.one.lockin_phase_deg[lane]
        assert np.sin(np.deg2rad(turn * orbits.order[lane] / 2.0)) == pytest.approx(0.0, abs=1e-9)


@pytest.mark.slow
def test_the_fit_predicts_the_orbits_amplitudes(orbits):
    laws, drives = made(DRIVES)
    known = np.stack([orbits.one.peak_amplitude_nm, orbits.one.lockin_amplitude_nm], axis=-1)[:DRIVES]
    measured = np.where(np.isfinite(known), known, 1.0)
    table = table_of(drives.T, measured, 0.01 * measured)
    model = model_of(table, task_of(table, "law+delay"), {"fixed": {"viscous_loss": 0.0}, "held": ()})
    unknowns = [[model.law.unknown_of(*pair) for pair in zip(NAMES, law, strict=True)] for law in laws]
    every = [orbits_at(model, np.append(theta, 0.0)) for theta in unknowns]
    predicted = np.concatenate([found.orbits.readings[:, :2] for found in every])
    there = np.concatenate([found.number > 0 for found in every])
    np.testing.assert_array_equal(there, orbits.there)
    found = orbits.found
    stable = np.asarray(found.exists & found.admissible & found.stable)
    amplitude = np.stack([found.peak_amplitude_nm, found.lockin_amplitude_nm], axis=-1)
    apart = np.where(stable[..., None], amplitude, np.inf)[there] / predicted[there, None] - 1.0
    # the fit's law is a table: splines between knots 10 % apart
    assert np.max(np.abs(apart).max(axis=-1).min(axis=-1)) < 1e-6


@pytest.mark.parametrize(
    ("reduced", "amplitude", "offset", "height"),
    [(1.0001, 2.0, 0.0, 67.5), (1.01, 4.0, -2.0, 51.0), (1.01, 4.0, 0.0, 99.0), (1.01, 4.0, 2.0, 150.2)],
)
def test_without_corrections_the_peaks_are_the_known_ones(reduced, amplitude, offset, height):
    """physics.md, eq. 6 with the tabulated delay; the delay law is 0.001 us off, 1 % of the amplitude at most."""
    heights = []
    for corrections in (False, True):
        law = ImpactLaw(0.9981, 122.0, delay=CollisionDelay(0.206, 5.64, 0.726, corrections=corrections))
        found = single_impact_orbits(
            Scene(Cantilever(90.0, 40.0), Platform(amplitude, 180.0 * reduced, offset), law), 1
        )
        stable = np.asarray(found.exists & found.admissible & found.stable)
        heights.append(np.max(np.asarray(found.peak_amplitude_nm)[stable]))
    assert heights[0] == pytest.approx(height, rel=0.01)
    # what acts on the tip meanwhile brings it closer to the contact's 65.9, 50.6, 98.6 and 149.7
    assert 0.99 * heights[0] < heights[1] < heights[0]
