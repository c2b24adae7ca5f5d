"""What every public object promises: jit and vmap, one compilation, and a clear word on needs."""

from collections.abc import Callable
from functools import cache
from time import perf_counter
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from afm_jax.apparatus.cantilever import Cantilever
from afm_jax.apparatus.platform import Platform
from afm_jax.apparatus.scene import Scene
from afm_jax.contact.collide import collide
from afm_jax.contact.contact import Contact
from afm_jax.impact.jacobian import map_jacobian
from afm_jax.impact.law import CollisionDelay, ImpactLaw, impact_law_of
from afm_jax.impact.map import iterate_map, next_impact
from afm_jax.impact.orbits import single_impact_orbits
from afm_jax.motion.simulate import simulate
from afm_jax.motion.start import state
from tests.package_scenes import bouncing, stacked

TIME, VELOCITY = 4.0, 60.0


def impact_law(scene: Scene) -> Any:
    law = impact_law_of(scene)
    return jnp.stack([law.rebound_speed(40.0), law.rebound_slope(40.0), law.approach_speed(30.0)])


def next_state(scene: Scene) -> Any:
    impact = next_impact(scene, TIME, VELOCITY)
    return jnp.stack([impact.time_us, impact.velocity_before_nm_per_us, impact.velocity_after_nm_per_us])


def three_impacts(scene: Scene) -> Any:
    rows = iterate_map(scene, TIME, VELOCITY, 3)
    return jnp.stack([rows.time_us, rows.velocity_after_nm_per_us])


def jacobian(scene: Scene) -> Any:
    return map_jacobian(scene, TIME, VELOCITY)


def orbits(scene: Scene) -> Any:
    found = single_impact_orbits(scene, 1)
    return jnp.where(found.exists, found.peak_amplitude_nm + found.trace, 0.0)


OBJECTS = [impact_law, next_state, three_impacts, jacobian, orbits]


@cache
def scenes() -> list[Scene]:
    """Return three scenes with a law, made when a test asks: listing tests computes nothing."""
    return [
        bouncing(reduced, frequency_khz=frequency, offset_nm=offset, r=r, delay=(hertz, 5.64, 0.726))
        for reduced, frequency, offset, r, hertz in (
            (1.01, 90.0, -1.0, 0.9981, 0.206),
            (1.03, 91.0, 0.5, 0.99, 0.21),
            (0.99, 89.5, -1.5, 0.98, 0.19),
        )
    ]


@pytest.mark.parametrize("function", OBJECTS)
def test_compiled_batched_and_plain_agree(function: Callable[[Scene], Any]):
    batch = np.asarray(jax.jit(jax.vmap(function))(stacked(scenes())))
    assert np.all(np.isfinite(batch))
    for row, scene in zip(batch, scenes(), strict=True):
        # Compiled code fuses multiply and add; the condition of an impact is below 1e3, of a trace near capture 1e4.
        np.testing.assert_allclose(function(scene), row, rtol=1e-11)
    assert not np.allclose(batch[0], batch[1])


def built_in_many_ways() -> list[tuple[Scene, Any, Any]]:
    """Return scenes of one structure, their numbers given as Python, NumPy and JAX numbers, with a start."""
    ways: list[tuple[Scene, Any, Any]] = []
    for number in (float, int, np.float64, np.asarray, jnp.asarray, lambda x: jnp.asarray(float(x))):
        delay = CollisionDelay(number(1), number(6), number(2), corrections=False)
        law = ImpactLaw(r=number(1), epsilon=number(100), viscous_loss=number(1), delay=delay)
        scene = Scene(Cantilever(number(90), number(40)), Platform(number(4), number(181), number(-1)), law)
        ways += [(scene, 4, 60), (scenes()[len(ways) % 3], number(4), number(60))]
    return ways


def traces(function: Callable[..., Any], calls: list[tuple[Any, ...]]) -> int:
    """Return how often a function is traced that is called with several arguments."""
    traced = []

    @jax.jit
    def counted(*given):
        traced.append(given)
        return function(*given)

    for given in calls:
        jax.block_until_ready(counted(*given))
    return len(traced)


def test_one_compilation_serves_all_values():
    ways = [(scene, jnp.asarray(t, float), jnp.asarray(v, float)) for scene, t, v in built_in_many_ways()]
    for function in (next_impact, map_jacobian):
        assert traces(function, ways) == 1


@pytest.mark.slow
def test_one_compilation_serves_all_contacts_and_speeds():
    calls = [(Contact.paper(), jnp.array([12.0, 40.0]))]
    calls += [(Contact.paper(relative_humidity=0.6, modulus_gpa=50.0), jnp.array([13.0, 41.0]))]
    assert traces(collide, calls) == 1


def test_row_sums_of_large_batches_are_right():
    # Wrong above 16,384 rows in jax 0.10.2 on a CPU (jax issue 39103), silently, in the last row.
    rows = np.random.default_rng(2).normal(size=(16_384 + 77, 5))
    # Five terms in any order.
    np.testing.assert_allclose(jax.jit(jax.vmap(jnp.sum))(rows), rows.sum(axis=1), rtol=0, atol=1e-14)
    # where the sum is of something made of the row: 0.8 % off
    numbers = np.arange(16_385.0)[:, None] * [1.0, 0.0, 0.0]
    squares = jax.jit(jax.vmap(lambda row: jnp.sum((jnp.eye(3) @ row) ** 2)))(numbers)
    np.testing.assert_array_equal(squares, numbers[:, 0] ** 2)


def test_writes_in_loops_do_not_copy_the_array():
    # 110 ms and more with jax 0.11.1 on a CPU (jax issue 40101), which copies 1.3 MB at every write; else 1 ms
    count = 20_000

    @jax.jit
    def filled(array):
        return lax.fori_loop(1, count, lambda row, rows: rows.at[row].set(rows[row - 1] + 1.0), array)

    array = jnp.zeros((count, 8))
    assert filled(array)[-1, 0] == count - 1.0
    seconds = []
    for _ in range(5):
        begin = perf_counter()
        filled(array).block_until_ready()
        seconds.append(perf_counter() - begin)
    assert min(seconds) < 0.04


# all others ask in the same way (tests/hard_cases/test_single_precision.py)
ASKING: list[Callable[[Any], Any]] = [
    jax.jit(next_state),
    lambda scene: collide(scene.interaction, 20.0),
    lambda scene: simulate(scene, state(0.0, 100.0, 0.0), 10.0),
]


@pytest.mark.parametrize("call", ASKING)
def test_what_was_built_before_64_bits_were_asked_for_is_refused(call: Callable[[Any], Any]):
    with jax.enable_x64(False):  # noqa: FBT003
        early, contact = bouncing(), Contact.paper()
    late = scenes()[0]
    law = Scene(late.cantilever, early.platform, late.interaction)
    for scene in (early, law) if call is ASKING[0] else (Scene(late.cantilever, late.platform, contact),):
        with pytest.raises(
            RuntimeError, match=r"is a 32-bit float: build the (contact|scene) after .*x64', T"
        ) as error:
            call(scene)
        assert "\n" not in str(error.value)


@pytest.mark.parametrize("call", [next_state, three_impacts, jacobian, orbits])
def test_entry_points_ask_for_an_impact_law(call: Callable[[Scene], Any]):
    with pytest.raises(TypeError, match="whose interaction is a law, an ImpactLaw or a TabulatedLaw, not Contact"):
        call(Scene(Cantilever(90.0), Platform(1.0, 180.0), Contact.paper()))
