"""Many single-impact orbits at once: stability against long iteration, determinants, masks, batches and loops."""

import jax
import numpy as np
import pytest

from afm_jax.apparatus.scene import Scene
from afm_jax.impact.map import iterate_map
from afm_jax.impact.orbits import SingleImpactOrbits, single_impact_orbits
from afm_jax.outcomes import Outcome
from tests.package_scenes import bouncing, stacked
from tests.test_orbits import NUMBERS


@pytest.fixture(scope="module")
def many_scenes() -> tuple[Scene, np.ndarray, SingleImpactOrbits]:
    """160 damped scenes from a wide box, their orders, and their orbits."""
    random = np.random.default_rng(11)
    orders = random.integers(1, 6, 160)

    def values(order: int) -> dict[str, float]:
        law = {"r": random.uniform(0.4, 0.9), "epsilon": random.choice([0.0, 1.0, 30.0])}
        law |= {"reduced": order * random.uniform(0.85, 1.2), "viscous_loss": random.choice([0.0, 0.5])}
        return law | {"offset_nm": random.uniform(-4, 4), "quality_factor": random.uniform(10, 400)}

    made = stacked([bouncing(**values(order), delay=None) for order in orders])
    orbits = jax.jit(jax.vmap(single_impact_orbits))(made, orders)
    return jax.tree.map(np.asarray, (made, orders, orbits))


def test_orbits_are_stable_where_the_map_converges(many_scenes):
    made, orders, orbits = many_scenes
    rows, slots = np.nonzero(orbits.admissible)
    trace, determinant = orbits.trace[rows, slots], orbits.determinant[rows, slots]
    root = np.sqrt((trace / 2) ** 2 - determinant + 0j)
    growth = np.maximum(np.abs(trace / 2 + root), np.abs(trace / 2 - root))
    clear = (growth < 0.9) | (growth > 1.1)
    rows, slots, growth = rows[clear], slots[clear], growth[clear]
    some = jax.tree.map(lambda leaf: leaf[rows], made)
    drive = 2e-3 * np.pi * some.platform.frequency_khz
    start = orbits.phase_rad[rows, slots] / drive
    velocity = orbits.velocity_after_nm_per_us[rows, slots]
    iterate = jax.jit(jax.vmap(lambda one, t, v: iterate_map(one, t, v, 200)))
    run = jax.tree.map(np.asarray, iterate(some, start, velocity * (1 + 1e-6)))
    drift = np.abs(run.velocity_after_nm_per_us - velocity[:, None]) / np.abs(velocity)[:, None]
    flying = run.outcome == Outcome.IMPACT
    stable = orbits.stable[rows, slots]
    np.testing.assert_array_equal(stable, growth < 1)
    assert min(np.sum(stable), np.sum(~stable)) >= 20
    # 0.9^200 = 7e-10 times 1e-6, and rounding.
    assert np.all(flying[stable])
    assert np.all(drift[stable, -1] < 1e-10)
    late = start + 200 * orders[rows] * 2 * np.pi / drive
    np.testing.assert_allclose(run.time_us[stable, -1], late[stable], rtol=1e-9)
    # 1.1^200 = 2e8 times 1e-6: it has left the orbit, or ended on the sample.
    away = np.where(flying, drift, np.inf)[~stable]
    assert np.all(away.max(axis=1) > 1e-2)


def test_empty_slots_are_marked_and_empty(many_scenes):
    *_, orbits = many_scenes
    assert orbits.exists.shape == (160, 4)
    assert 0 < np.sum(orbits.exists) < orbits.exists.size
    for field in (*NUMBERS, "phase_rad", "lockin_phase_deg"):
        np.testing.assert_array_equal(np.isfinite(getattr(orbits, field)), orbits.exists)
    for field in ("admissible", "stable", "near_double"):
        assert not np.any(getattr(orbits, field) & ~orbits.exists)
    for row in orbits.approach_speed_nm_per_us:
        assert np.all(np.diff(row[np.isfinite(row)]) > 0)
