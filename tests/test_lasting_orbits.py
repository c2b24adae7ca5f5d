"""Orbits of impacts that last: limits, a dense scan in NumPy, close pairs."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import afm_jax as afm
from afm_jax.impact.closure import COARSE, OrbitProblem, find_roots
from afm_jax.impact.law import CollisionDelay, ImpactLaw
from afm_jax.impact.orbits import orbit_state, steady_orbits
from tests.package_scenes import scene_of
from tests.reference_examples import DELAY, scene
from tests.reference_flight import Parameters
from tests.reference_lasting import closing_impacts, closing_speeds

DRIVES = [(1, 0.97, 4.0, -1.0), (1, 1.01, 4.0, 1.0), (2, 2.0, 6.0, 0.0), (3, 3.03, 8.0, -0.5), (4, 3.9, 8.0, 1.0)]
find = jax.jit(lambda problem: find_roots(problem, COARSE))
steady = jax.jit(steady_orbits)


def problem_of(p: Parameters, order: int, *, delay: CollisionDelay | None = None) -> OrbitProblem:
    """Return the package's problem of a reference's system."""
    law = ImpactLaw(p.r, p.epsilon, p.viscous_loss, CollisionDelay(*p.delay) if p.delay else delay)
    platform = afm.Platform(p.amplitude_nm, p.drive_frequency_khz, p.offset_nm)
    cantilever = afm.Cantilever(p.frequency_khz, p.quality_factor)
    return OrbitProblem(cantilever, platform, law, jnp.asarray(float(order)))


def delayed(order: int, reduced: float, amplitude_nm: float, offset_nm: float) -> tuple[Parameters, int]:
    law = {"r": 0.9999, "epsilon": 114.0, "viscous_loss": 0.48, "delay": DELAY}
    return scene(reduced, amplitude_nm=amplitude_nm, offset_nm=offset_nm, **law), order


def speeds_found(problem: OrbitProblem) -> np.ndarray:
    """Return the approach speeds of all roots, ascending."""
    roots = find(problem)
    speeds = jax.vmap(problem.impact.speeds)(roots.place.coordinate).approach
    return np.sort(np.asarray(speeds)[np.asarray(roots.found)])


@pytest.mark.slow
def test_without_a_duration_they_are_the_instantaneous_laws():
    count, laws = 0, itertools.cycle([(0.9, 60.0, 0.0), (0.95, 0.0, 0.0), (1.0, 60.0, 2.0)])
    for (order, reduced, amplitude, offset), (r, epsilon, loss) in zip(DRIVES[:3], laws, strict=False):
        p = scene(reduced, amplitude_nm=amplitude, offset_nm=offset, r=r, epsilon=epsilon, viscous_loss=loss)
        found = steady(problem_of(p, order, delay=CollisionDelay(0.0, 0.0, 0.0)))
        orbits = afm.single_impact_orbits(scene_of(p), order)
        there = np.asarray(orbits.stable & orbits.admissible)
        expected = np.stack([orbits.peak_amplitude_nm, orbits.lockin_amplitude_nm], axis=-1)[there]
        # the closing conditions are written differently: rounding near resonance
        np.testing.assert_allclose(np.asarray(found.amplitude_nm)[np.asarray(found.steady), :2], expected, rtol=1e-9)
        count += len(expected)
    assert count > 1


@pytest.mark.parametrize("drive", DRIVES[::2])
def test_roots_are_those_of_a_dense_scan(drive):
    p, order = delayed(*drive)
    # slower ones are about to be captured: no law holds there, and the search leaves some out
    slowest, fastest = 14.0, 3000.0
    expected = closing_speeds(p, order, slowest, fastest)
    found = speeds_found(problem_of(p, order))
    found = found[(found > slowest) & (found < fastest)]
    np.testing.assert_allclose(found, expected, rtol=1e-9)
    assert len(expected) >= 1


def test_state_is_the_phase_and_the_impact_of_the_dense_scan():
    p, order = delayed(*DRIVES[0])
    problem = problem_of(p, order)
    orbits = steady(problem)
    (slot,) = np.flatnonzero(orbits.steady)
    state = orbit_state(jax.tree.map(lambda leaf: leaf[slot], orbits.place), problem)
    impact = closing_impacts(p, order, np.asarray(state.speeds.approach)[None])
    assert float(state.speeds.rebound) == pytest.approx(impact.rebound[0], rel=1e-9)
    assert float(state.speeds.delay) == pytest.approx(impact.delay[0], rel=1e-8)
    leaving = np.arctan2(impact.sine[0], impact.cosine[0]) / float(problem.platform.angular_frequency)
    period = float(problem.platform.period_us)
    assert float(state.flight.start_us) % period == pytest.approx(leaving % period, rel=1e-8)


@pytest.mark.parametrize(("order", "reduced", "amplitude"), [(2, 1.96, 1.0307), (1, 0.97, 2.17717)])
def test_a_close_pair_is_found(order, reduced, amplitude):
    """The drive is so low that two roots are about to meet: between neighbours of the search's own scan."""
    slowest, fastest = 14.0, 3000.0
    p, _ = delayed(order, reduced, amplitude, 0.0)
    first, second = closing_speeds(p, order, slowest, fastest)
    # the search has 70 points to the decade, 3 % apart
    assert second / first < 1.03
    found = speeds_found(problem_of(p, order))
    found = found[(found > slowest) & (found < fastest)]
    # close to a fold a root is known to the rounding over the distance of the two
    np.testing.assert_allclose(found, [first, second], rtol=1e-9)
    # without the second look at turning points nothing would be there
    assert len(found) == 2
