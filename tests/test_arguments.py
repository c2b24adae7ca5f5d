"""Arguments of another kind than a public function takes: one line of ours each; paths where scenes and tables go."""

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import afm_jax as afm
import fitting
from afm_jax.checks import check_kind
from afm_jax.contact.forces import Dmt, Hertz, VanDerWaals
from afm_jax.scenefile.parameter_paths import ParameterRange
from afm_jax.scenefile.scenefile import load_scene
from tests.fresh_python import python

# in a program of its own: here annotations are checked by the tests' own means first
PROGRAM = """
import inspect, re, warnings
import jax; jax.config.update("jax_enable_x64", True)
import numpy as np, afm_jax as afm, fitting
from afm_jax.scenefile.scenefile import load_scene
from fitting.examples import __path__ as examples
warnings.simplefilter("error")
scene, contact, values = load_scene("figure3"), afm.Contact.paper(), np.array([3.0, 4.0])
good = dict(scene=scene, cantilever=scene.cantilever, platform=scene.platform, interaction=scene.interaction)
good |= dict(contact=contact, table=fitting.read_table(examples[0] + "/amplitudes_law.csv"), model="law", path="none")
good |= dict(order=1, impacts=2, time_us=0.0, velocity_nm_per_us=30.0, start=afm.State(0.0, 5.0, 80.0), last_order=1)
good |= dict(amplitude_nm=4.0, amplitude_nn=1.0, frequency_khz=180.0, free_frequency_khz=90.0, r=0.9, hertz=1.0)
good |= dict(lead_nm=1.0, offset_nm=1.0, approach_speed_nm_per_us=30.0, parameter="platform.amplitude_nm")
good |= dict(duration_us=50.0, values=values, x_values=values, y_values=values, heights_nm=values)
good |= dict(axes=[{}], record="orbits")
kinds = [afm.Cantilever, afm.Platform, afm.ForceDrive, afm.ImpactLaw, afm.CollisionDelay, afm.Contact, afm.Scene]
public = [getattr(package, name) for package in (afm, fitting) for name in dir(package)]
count = 0
for function in [*kinds, *filter(inspect.isfunction, public)]:
    parameters = inspect.signature(function).parameters.values()
    parameters = [each for each in parameters if each.kind not in (each.VAR_POSITIONAL, each.VAR_KEYWORD)]
    needed = {each.name: good.get(each.name) for each in parameters if each.default is each.empty}
    if function is fitting.amplitude_gradients:
        needed |= {"values": {}}
    # a contact looks at range_nm together with its forces
    parameters = [each for each in parameters if each.name != "range_nm"]
    for parameter in parameters:
        for bad in (True, 1j, object(), contact.junction):
            switch = bad is True and isinstance(parameter.default, bool)
            if switch or (bad is contact.junction and parameter.name in ("junction", "interaction", "corrections")):
                continue
            count += 1
            try:
                function(**{**needed, parameter.name: bad})
                told = "accepted"
            except BaseException as error:
                told = f"{type(error).__name__} {error}"
            names = "|".join([parameter.name, *(name for name in needed if name not in good)])
            if not re.fullmatch(rf"TypeError (the scene's )?`({names})` must be .*, but is .*", told):
                print(f"{function.__name__}({parameter.name}={bad!r}): {told}")
print(count)
"""


SCENE = load_scene("figure3")
START = afm.State(jnp.asarray(0.0), jnp.asarray(5.0), jnp.asarray(80.0))
TWO = np.array([1.0, 2.0])
PAPER, NO_JUNCTION = afm.Contact.paper(), afm.Contact.paper(adhesion_energy_j_per_m2=0.05)
WET = afm.Scene(afm.Cantilever(90.0, 40.0), afm.Platform(4.0, 181.8), PAPER)
RAMP = afm.Platform(amplitude_nm=2.0, frequency_khz=180.0, offset_rate_nm_per_us=1e-3)
RANGE = ParameterRange("platform.amplitude_nm", 1.0, 2.0)


def with_platform(platform: afm.Platform) -> afm.Scene:
    return afm.Scene(SCENE.cantilever, platform, SCENE.interaction)


# what scene files can hold, too, is refused by tests/malformed.jsonl
IMPOSSIBLE: list[tuple[Any, str]] = [
    (lambda: afm.Cantilever(TWO[:0]), "`frequency_khz` must be a number or an array .*, but holds none"),
    (lambda: afm.simulate(SCENE, START, TWO), r"`duration_us` must be one number, but has the shape \(2,"),
    (lambda: afm.next_impact(SCENE, TWO, 30.0), r"`time_us` must be one number.*: `iterate_batch` and"),
    (lambda: afm.map_jacobian(SCENE, np.nan, 30.0), "`time_us` must be a finite number, but is nan"),
    (
        lambda: afm.stability_chart(lambda *_: SCENE, x_values=TWO[:0], y_values=TWO, last_order=1),
        "`x_values` must be rising numbers, one at least",
    ),
    (lambda: afm.scene_family(SCENE, *["interaction.r"] * 2), "named twice: interaction.r, interaction.r"),
    # a cantilever, platforms and laws
    (lambda: afm.Platform(np.array([1.0, -2.0, 3.0]), 180.0), "`amplitude_nm` must not be negative, but is -2"),
    # its square is no number
    (lambda: afm.Platform(np.array([1.0, 1e40]), 180.0), r"at most 1e\+30"),
    (lambda: afm.iterate_batch(SCENE, np.zeros((2, 1)), TWO, 1), "must have one shape"),
    # forces and contacts
    (lambda: afm.Contact((VanDerWaals(),), Hertz()), r"Hertz\(\) is a contact without other forces; VanDerWaals\(\)"),
    (lambda: afm.Contact((VanDerWaals(),), Dmt(), range_nm=0.1), "must be larger than `contact_distance_nm` of 0.165"),
    (
        lambda: afm.collide(afm.Contact.paper(viscosity_pa_s=np.full(3, 1e-3)), TWO),
        r"speeds' shape \(2,\), but one has \(3,\)",
    ),
    (lambda: afm.time_course(afm.Contact.paper(tip_radius_nm=5.0), 3.0), "turns the tip round"),
    # contacts in time
    (lambda: afm.simulate(WET, afm.State(0.0, 3.95, 60.0), 20.0), "inside the sample"),
    (lambda: afm.simulate(afm.Scene(WET.cantilever, WET.platform, NO_JUNCTION), START, 20.0), "no junction"),
    # motions that do not repeat
    (
        lambda: afm.lyapunov_spectrum(with_platform(afm.Platform(0.0, 180.0))),
        "`amplitude_nm` of the platform must be positive",
    ),
    (lambda: afm.continue_orbits(with_platform(RAMP), 1, RANGE), "ramps"),
]


@pytest.mark.parametrize(("call", "message"), IMPOSSIBLE, ids=[message for _, message in IMPOSSIBLE])
def test_impossible_sizes_numbers_and_words_are_one_line(call: Any, message: str):
    with pytest.raises(ValueError, match=message) as told:
        call()
    assert "\n" not in str(told.value)


def test_a_sweep_into_a_file_is_refused(tmp_path: Path):
    (tmp_path / "file").touch()
    with pytest.raises(NotADirectoryError, match="is no folder, or lies in none; choose another `out`"):
        afm.sweep(SCENE, [{"parameter": "platform.amplitude_nm", "list": [1.0, 2.0]}], "orbits", out=tmp_path / "file")


@pytest.mark.slow
def test_arguments_of_another_kind_are_named():
    *otherwise, count = python(PROGRAM).splitlines()
    assert otherwise == []
    assert int(count) > 960


def test_scenes_are_loaded_from_paths_and_presets_and_tables_read_from_paths(tmp_path: Path):
    path = tmp_path / "scene.toml"
    afm.save_scene(SCENE, path)
    for given in ("figure3", path, str(path)):
        assert jax.tree.leaves(afm.load_scene(given)) == jax.tree.leaves(SCENE)
        # as functions check their arguments; here annotations are checked by the tests' own means first
        with pytest.raises(TypeError, match=r"`scene` must be a Scene, but is .*: `afm_jax\.load_scene` makes one"):
            check_kind("scene", given, afm.Scene)
    with pytest.raises(ValueError, match="nothing: there is no such file or preset; presets are figure2, figure3"):
        afm.load_scene("nothing")
    for function in (fitting.fit, fitting.calibrate, fitting.read_trace):
        with pytest.raises(fitting.TableError, match="there is no such file"):
            function(tmp_path / "none.csv")
