"""Every public function where JAX computes in 32 bits: what is left of its digits, or a refusal that says what to add.

Hard: 32 bits are what JAX has until it is told otherwise, nothing warns, and a chaotic or an ill-conditioned answer
looks like any other.

Right answers: the same call in 64 bits, which is compared with independent ones elsewhere.
"""

from collections.abc import Callable
from typing import Any

import jax
import numpy as np
import pytest

import afm_jax as afm
import fitting
from afm_jax.motion.start import state
from afm_jax.saved import as_json
from afm_jax.scenefile.parameter_paths import ParameterRange
from fitting.simulated.experiment import drives_of
from tests.package_scenes import bouncing
from tests.test_imports import ROOT

EXAMPLES = ROOT / "fitting" / "examples"
TABLE = EXAMPLES / "amplitudes_law.csv"


def _contact() -> Any:
    return afm.Scene(afm.Cantilever(90.0, 40.0), afm.Platform(4.0, 181.8), afm.Contact.paper())


REFUSED: dict[str, Callable[[], object]] = {
    "basins_of_attraction": lambda: afm.basins_of_attraction(bouncing(), columns=2, rows=2),
    "bifurcation_diagram": lambda: afm.bifurcation_diagram(bouncing(), "platform.amplitude_nm", np.array([1.0, 2.0])),
    "contact_orbits": lambda: afm.contact_orbits(_contact(), 1, 1),
    "continue_orbits": lambda: afm.continue_orbits(bouncing(), 1, ParameterRange("platform.amplitude_nm", 1.0, 2.0)),
    "delay_of_contact": lambda: fitting.delay_of_contact(afm.Contact.paper()),
    "law_of_contact": lambda: fitting.law_of_contact(afm.Contact.paper()),
    "iterate_batch": lambda: afm.iterate_batch(bouncing(), np.array([4.0]), np.array([60.0]), 2),
    "iterate_map": lambda: afm.iterate_map(bouncing(), 4.0, 60.0, 2),
    "lyapunov_spectrum": lambda: afm.lyapunov_spectrum(bouncing()),
    "many_impact_orbits": lambda: afm.many_impact_orbits(bouncing(), 1, 2),
    "make_law": lambda: afm.make_law(afm.Contact.paper()),
    "map_jacobian": lambda: afm.map_jacobian(bouncing(), 4.0, 60.0),
    "next_impact": lambda: afm.next_impact(bouncing(), 4.0, 60.0),
    "simulate": lambda: afm.simulate(_contact(), state(0.0, 10.0, 0.0), 10.0),
    "simulate_experiment": lambda: fitting.simulate_experiment(
        afm.Contact.paper(), afm.Cantilever(90.0, 40.0), drives_of([(1, 180.0, 4.0, 0.0)])
    ),
    "single_impact_orbits": lambda: afm.single_impact_orbits(bouncing(), 1),
    "stability_chart": lambda: afm.stability_chart(
        afm.scene_family(bouncing(), "platform.reduced_frequency", "platform.amplitude_nm"),
        x_values=np.array([1.0, 1.1]),
        y_values=np.array([1.0, 2.0]),
        last_order=1,
    ),
    "sweep": lambda: afm.sweep(bouncing(), [{"parameter": "platform.amplitude_nm", "linear": [1, 2, 2]}], "orbits"),
    "approach_curve": lambda: afm.approach_curve(bouncing(), [10.0]),
}
"""What says that it needs 64 bits."""

LEFT: dict[str, Callable[[Any], Any]] = {
    "capture_speed": afm.capture_speed,
    "collide": lambda contact: afm.collide(contact, 30.0)[1:3],
    "find_junction": lambda contact: afm.find_junction(contact)[1:],
    "time_course": lambda contact: jax.tree.leaves(afm.time_course(contact, 30.0))[1:3],
}
"""What computes all the same, from the contact of the paper."""

SAME: dict[str, Callable[[], dict[str, Any]]] = {
    "amplitude_gradients": lambda: vars(fitting.amplitude_gradients(TABLE, "law", {"r": 0.9, "epsilon": 60.0})),
    "compare": lambda: as_json(fitting.compare(TABLE, ("law", "restitution"))),
    "fit": lambda: as_json(fitting.fit(TABLE)),
    "invert": lambda: as_json(fitting.invert(TABLE)),
    "tapping": lambda: as_json(fitting.tapping(EXAMPLES / "tapping_contact.csv")),
}
"""What computes in 64 bits by itself."""

NO_NUMBERS = {
    # read, write, remember; NumPy alone; or what one of the above hands to them
    *("dimensionless_scene", "load", "load_law", "load_scene", "save_law", "save_scene", "scene_family"),
    *("use_cache", "trajectory"),
    *("prior_of_values", "design", "drive_grid", "calibrate", "lockin", "posterior", "read_curve"),
    *("read_curves", "read_resonance", "read_table", "read_trace", "sader", "tapping_map"),
    *("tapping_together", "table_of_curve", "write_table"),
}


def test_every_public_function_is_here():
    functions = {
        name
        for package in (afm, fitting)
        for name in dir(package)
        if callable(getattr(package, name)) and not isinstance(getattr(package, name), type)
    }
    assert functions == {*REFUSED, *LEFT, *SAME, *NO_NUMBERS}


@pytest.mark.parametrize("name", REFUSED)
def test_refusals(name: str):
    with jax.enable_x64(new_val=False), pytest.raises(RuntimeError, match=r"64-bit floats: add .*x64', True") as error:
        REFUSED[name]()
    assert "\n" not in str(error.value)


@pytest.mark.slow
@pytest.mark.parametrize("name", SAME)
def test_digits_that_all_are_there(name: str):
    wide = SAME[name]()
    with jax.enable_x64(new_val=False):
        narrow = SAME[name]()
    np.testing.assert_equal(narrow, wide)


@pytest.mark.slow
@pytest.mark.parametrize("name", LEFT)
def test_digits_that_are_left(name: str):
    wide = LEFT[name](afm.Contact.paper())
    with jax.enable_x64(new_val=False), jax.numpy_dtype_promotion("standard"):
        narrow = LEFT[name](afm.Contact.paper())
    for ours, right in zip(jax.tree.leaves(narrow), jax.tree.leaves(wide), strict=True):
        # six and a half digits of lengths and forces; where the tip turns, half of the digits of its speed
        turning = 3e-4 if name == "time_course" else 1e-5
        np.testing.assert_allclose(ours, right, rtol=1e-4, atol=turning * float(np.max(np.abs(right))))
