"""Sweeps for real: against the functions they record, over processes, and points without a result."""

import json
import os
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
import xarray
from click.testing import CliRunner

import afm_jax
from afm_jax.cli.main import main
from afm_jax.dynamics.exponents import lyapunov_spectrum
from afm_jax.scenefile.parameter_paths import scene_batch
from afm_jax.scenefile.scenefile import Start, load_scene, scene_tables
from afm_jax.solve.lanes import LANES, filled
from afm_jax.studies.sweep import STORE, plan_of, run_plan, sweep

FREQUENCY, AMPLITUDE = "platform.reduced_frequency", "platform.amplitude_nm"
PLANE = [{"parameter": AMPLITUDE, "linear": [1.0, 8.0, 9]}, {"parameter": FREQUENCY, "linear": [0.8, 2.2, 15]}]


@pytest.fixture(autouse=True)
def same_flags_after(monkeypatch: pytest.MonkeyPatch):
    """Take back what the command tells JAX before it starts."""
    monkeypatch.setenv("XLA_FLAGS", os.environ.get("XLA_FLAGS", ""))


@pytest.mark.slow
def test_orbits_are_those_of_single_impact_orbits():
    scene = load_scene("figure2")
    found = sweep(scene, PLANE, {"what": "orbits", "orders": [1, 2]})
    places = {AMPLITUDE: "platform_amplitude_nm", FREQUENCY: "platform_reduced_frequency"}
    found = found.stack(point=list(places.values())).isel(point=slice(None, None, 5))
    scenes = scene_batch(scene, {parameter: found[name].values for parameter, name in places.items()})
    seen = 0
    for order in (1, 2):
        there = found.sel(order=float(order))
        orbits = jax.vmap(lambda each, order=order: afm_jax.single_impact_orbits(each, order))(scenes)
        admissible, good = np.asarray(orbits.admissible), np.asarray(orbits.admissible & orbits.stable)
        np.testing.assert_array_equal(there["stable_orbits"], good.sum(axis=1))
        np.testing.assert_array_equal(there["admissible_orbits"], admissible.sum(axis=1))
        slot = np.argmax(np.where(good, orbits.peak_amplitude_nm, -np.inf), axis=1)[:, None]
        for name in ("peak_amplitude_nm", "lockin_amplitude_nm", "approach_speed_nm_per_us", "phase_rad"):
            highest = np.take_along_axis(np.asarray(getattr(orbits, name)), slot, axis=1)[:, 0]
            # rounding, enlarged where the orbit is close to a fold
            np.testing.assert_allclose(there[name], np.where(good.any(axis=1), highest, np.nan), rtol=1e-8)
        seen += good.any(axis=1).sum()
    assert seen > 10


@pytest.mark.slow
def test_collisions_and_exponents_are_those_of_their_functions():
    axes = [
        {"parameter": "approach_speed_nm_per_us", "list": [12.0, 30.0, 100.0]},
        {"parameter": "interaction.relative_humidity", "linear": [0.3, 0.5, 2]},
    ]
    found = sweep(load_scene("figure8"), axes, "collide")
    alone = afm_jax.collide(afm_jax.Contact.paper(relative_humidity=0.5), np.array([12.0, 30.0, 100.0]))
    for name in ("rebound_speed_nm_per_us", "collision_delay_us", "viscous_loss_aj"):
        np.testing.assert_allclose(found[name].values[:, 1], getattr(alone, name), rtol=1e-9)
    assert not found["captured"].any()
    scene, frequency = load_scene("figure2"), {"parameter": FREQUENCY, "linear": [1.2, 1.6, 3]}
    found = sweep(scene, [frequency], {"what": "lyapunov", "impacts": 100, "transient": 50})
    # one of them is chaotic: a program of another width ends elsewhere, by rounding
    many = filled(np.array([1.2, 1.4, 1.6]), LANES)
    alone = lyapunov_spectrum(scene_batch(scene, {FREQUENCY: many}), impacts=100, transient=50)
    np.testing.assert_allclose(found["exponents_per_impact"], alone.exponents_per_impact[:3], rtol=1e-9)
    np.testing.assert_array_equal(found["kind"], alone.verdicts.kind[:3])


@pytest.mark.slow
def test_workers_give_what_one_process_does(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    # as JAX leaves it behind
    monkeypatch.setenv("TF_CPP_MIN_LOG_LEVEL", "1")
    axes = [{"parameter": AMPLITUDE, "linear": [1.0, 8.0, 200]}]
    scene = scene_tables(load_scene("figure2"))
    wanted = plan_of({"scene": scene, "axes": axes, "record": {"what": "orbits"}, "chunk": 30})
    for folder, workers in (("one", 1), ("two", 2)):
        assert run_plan(wanted, tmp_path / folder, workers=workers) == (0, 7)
    one, two = (xarray.open_zarr(str(tmp_path / folder / STORE)).load() for folder in ("one", "two"))
    # last digits may differ: programs share the cores otherwise
    xarray.testing.assert_allclose(one, two, rtol=1e-9)


def test_the_command_says_why_points_have_no_result(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    def follow(scene: afm_jax.Scene, *_: Any, **__: Any) -> None:
        raise ValueError("too wide" if scene.platform.amplitude_nm > 1.8 else "it will not go")

    monkeypatch.setattr("afm_jax.studies.sweep.follow_long", follow)
    afm_jax.save_scene(load_scene("figure2"), tmp_path / "scene.toml", start=Start(0.0, 1.0, 0.0))
    (tmp_path / "sweep.toml").write_text(
        'scene = "scene.toml"\nchunk = 2\n[record]\nwhat = "simulation"\n'
        f'[[axes]]\nparameter = "{AMPLITUDE}"\nlinear = [1, 2, 3]\n'
    )
    line = ["sweep", str(tmp_path / "sweep.toml"), "--out", str(tmp_path), "--workers", "1"]
    assert "\n  2: it will not go\n  1: too wide\n" in CliRunner().invoke(main, line).stdout
    told = json.loads(CliRunner().invoke(main, [*line, "--json"]).stdout)
    assert (told["without_result"], told["messages"]) == (3, {"it will not go": 2, "too wide": 1})
    found = xarray.open_zarr(str(tmp_path / "sweep.zarr")).load()
    assert found["message"].values.tolist() == ["it will not go"] * 2 + ["too wide"]
    assert found["outcome"].values.tolist() == [-1] * 3
