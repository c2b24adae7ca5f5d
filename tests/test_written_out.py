"""Chains of steps are loops of the program: what compilers do with written-out ones depends on the number of tips."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import pytest

from afm_jax import CollisionDelay, Contact, ImpactLaw, Scene, capture_speed, collide, iterate_map, simulate
from afm_jax.contact.collide import batch_of
from afm_jax.contact.law_of_contact import tabulated
from afm_jax.contact.settings import METHODS, SETTINGS
from afm_jax.motion.simulate import State
from afm_jax.scenefile.scenefile import load_scene
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


def motion(method: str) -> Callable[[Any], Any]:
    scene = load_scene("figure8")
    return lambda velocity: simulate(scene, State(0.0, 10.0, velocity), 40.0, max_contacts=8, method=method)


def impacts(scene: Scene) -> Any:
    return iterate_map(scene, 0.0, 50.0, 3)


# a contact that spends energy: without, the bridge is one quadrature
CONTACT, LAW = Contact.paper(viscosity_pa_s=1e-3), load_scene("figure2")
LASTING = eqx.tree_at(lambda scene: scene.interaction, LAW, ImpactLaw(0.5, delay=CollisionDelay(0.05, 0.1, 0.1)))
PROGRAMS: dict[str, tuple[Callable[[Any], Any], Any]] = {
    "a law": (impacts, LAW),
    "a law that lasts": (impacts, LASTING),
    "collisions": (lambda contact: collide(contact, SPEEDS), CONTACT),
    "capture": (capture_speed, CONTACT),
    "a contact's table": (lambda contact: tabulated(contact, jnp.ones(())).speeds(SPEEDS), CONTACT),
}
PROGRAMS |= {f"motion, {method}": (motion(method), 50.0) for method in METHODS}
for method, settings in SETTINGS.items():
    for level, setting in settings.items():
        PROGRAMS[f"{method}, {level:g}"] = (lambda contact, one=setting: batch_of(contact, 1.0, SPEEDS, one), CONTACT)


@pytest.mark.parametrize("name", PROGRAMS)
def test_steps_are_loops(name: str):
    function, argument = PROGRAMS[name]
    assert written_out(function, argument) == []


LIMIT_S = 120
"""Of one process; some 30 s on an idle core. What a compiler does not remember takes it hours."""
PROGRAM = """
import jax
jax.config.update("jax_enable_x64", True)
import jax.numpy as jnp
from afm_jax import Contact
from afm_jax.contact import collide

for tips in (1, 2, 3, 4, 8):
    # the first speed is so close to capture that it takes many steps
    speeds = jnp.linspace({slowest}, 60.0, tips)
    for accuracy in {accuracies}:
        found = collide.collide(Contact.paper(viscosity_pa_s=1e-3), speeds, accuracy=accuracy, method={method!r})
        assert jnp.isfinite(found.rebound_speed_nm_per_us).all()
print(collide._quick._cache_size(), collide._careful.outside()._cache_size())
"""


@pytest.mark.slow
@pytest.mark.long
@pytest.mark.parametrize(
    ("method", "slowest", "accuracies", "compiled"),
    [("diffrax", 11.0, [1e-9], "5 1"), ("collocation", 20.0, [1e-9, 1e-11], "10 0")],
    ids=["diffrax and many steps", "collocation"],
)
def test_collisions_of_any_number_of_tips_are_compiled_in_time(
    method: str, slowest: float, accuracies: list[float], compiled: str
):
    # as users do: optimised, and none of it found in a cache
    program = PROGRAM.format(method=method, slowest=slowest, accuracies=accuracies)
    unset: dict[str, str | None] = {"XLA_FLAGS": None, "JAX_COMPILATION_CACHE_DIR": None}
    assert outputs(program, unset, limit_s=LIMIT_S)[0].splitlines()[-1] == compiled
