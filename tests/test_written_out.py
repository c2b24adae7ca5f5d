"""Chains of steps are loops of the program: what compilers do with written-out ones depends on the number of tips."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import pytest

from afm_jax import (
    CollisionDelay,
    Contact,
    ImpactLaw,
    capture_speed,
    collide,
    iterate_map,
    simulate,
)
from afm_jax.contact.collide import batch_of
from afm_jax.contact.law_of_contact import tabulated
from afm_jax.contact.settings import METHODS, SETTINGS, Setting
from afm_jax.motion.simulate import State
from afm_jax.scenefile.presets import preset
from tests.fresh_python import outputs
from tests.written_out import MOST, written_out

SPEEDS = jnp.array([20.0, 30.0])


def newton(steps: int) -> Callable[[Any], Any]:
    """Return Newton's method to the cube root of two, written out."""

    def root(x: Any) -> Any:
        for _ in range(steps):
            x = x - (x**3 - 2.0) / (3.0 * x * x)
        return x

    return root


def horner(x: Any) -> Any:
    value = x
    for factor in range(9):
        value = value * x + factor
    return value


def clenshaw(x: Any) -> Any:
    ahead, further = x, x
    for factor in range(9):
        ahead, further = factor + 2.0 * x * ahead - further, ahead
    return ahead


def of_three(function: Callable[[Any], Any]) -> Callable[[Any], Any]:
    return lambda x: jax.vmap(jax.jit(function))(x * jnp.ones(3))


@pytest.mark.parametrize("around", [lambda function: function, jax.jit, of_three])
def test_chains_are_found(around: Callable[..., Any]):
    assert written_out(around(newton(MOST)), 1.0) == []
    found = written_out(around(newton(MOST + 1)), 1.0)
    assert max(chain.ways for chain in found) >= 3**MOST
    assert any(Path(__file__).name in chain.line for chain in found)


def test_chains_with_one_way_through_them_are_none():
    assert written_out(horner, 1.0) == []
    # Fibonacci's numbers of ways: each step takes its predecessor and the one before
    assert max(chain.ways for chain in written_out(clenshaw, 1.0)) == 34


def contact() -> Contact:
    """Return a contact that spends energy: without, the bridge is one quadrature."""
    return Contact.paper(viscosity_pa_s=1e-3)


@pytest.mark.parametrize("setting", [own for level in SETTINGS.values() for own in level.values()], ids=str)
def test_collisions_are_loops(setting: Setting):
    assert written_out(lambda own, speeds: batch_of(own, 1.0, speeds, setting), contact(), SPEEDS) == []


@pytest.mark.slow
def test_what_is_made_of_contacts_is_loops():
    assert written_out(lambda own: collide(own, SPEEDS), contact()) == []
    assert written_out(capture_speed, contact()) == []
    assert written_out(lambda own: tabulated(own, jnp.ones(())).speeds(SPEEDS), contact()) == []


@pytest.mark.parametrize("method", METHODS)
def test_driven_contacts_are_loops(method: str):
    scene = preset("figure8")

    def motion(velocity: Any) -> Any:
        return simulate(scene, State(0.0, 10.0, velocity), 40.0, max_contacts=8, method=method)

    assert written_out(motion, 50.0) == []


def test_impacts_of_laws_are_loops():
    scene = preset("figure2")
    assert isinstance(scene.interaction, ImpactLaw)
    lasting = replace(scene, interaction=replace(scene.interaction, delay=CollisionDelay(0.05, 0.1, 0.1)))
    for own in (scene, lasting):
        assert written_out(lambda scene: iterate_map(scene, 0.0, 50.0, 3), own) == []


LIMIT_S = 120
"""Of one process; some 10 s on an idle core. What a compiler does not remember takes it hours."""
PROGRAM = """
import jax
jax.config.update("jax_enable_x64", True)
import jax.numpy as jnp
from afm_jax import Contact
from afm_jax.contact import collide

# the first speed is so close to capture that it takes many steps
speeds = jnp.linspace({slowest}, 60.0, {tips})
for accuracy in {accuracies}:
    found = collide.collide(Contact.paper(viscosity_pa_s=1e-3), speeds, accuracy=accuracy, method={method!r})
    assert jnp.isfinite(found.rebound_speed_nm_per_us).all()
print(collide._quick._cache_size(), collide._careful._cache_size())
"""


@pytest.mark.slow
@pytest.mark.parametrize("tips", [1, 2, 3, 4, 8])
@pytest.mark.parametrize(
    ("method", "slowest", "accuracies", "compiled"),
    [("diffrax", 11.0, [1e-9], "1 1"), ("collocation", 20.0, [1e-9, 1e-11], "2 0")],
    ids=["diffrax and many steps", "collocation"],
)
def test_collisions_of_any_number_of_tips_are_compiled_in_time(
    tips: int, method: str, slowest: float, accuracies: list[float], compiled: str
):
    # as users do: optimised, and none of it found in a cache
    program = PROGRAM.format(tips=tips, method=method, slowest=slowest, accuracies=accuracies)
    unset: dict[str, str | None] = {"XLA_FLAGS": None, "JAX_COMPILATION_CACHE_DIR": None}
    assert outputs(program, unset, limit_s=LIMIT_S)[0].splitlines()[-1] == compiled
