"""Collisions of any number of tips are compiled in time: steps that Python writes out take compilers hours."""

import pytest

from tests.fresh_python import outputs

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
