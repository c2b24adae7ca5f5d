"""Scene files with drives of base and tip and second frequencies: every key and exact loops."""

from pathlib import Path
from typing import Any

import equinox as eqx
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from afm_jax import Cantilever, CollisionDelay, ImpactLaw, Platform, Scene, load_scene, save_scene
from afm_jax.apparatus.drives import BaseDrive, ForceDrive, Tone

CANTILEVER = "[cantilever]\nfrequency_khz = 90\nquality_factor = 40\n"
PLATFORM = "[platform]\namplitude_nm = 4\nfrequency_khz = 181.8\n"
RESTING = "[platform]\noffset_nm = 7\n"
SECOND = "[platform.second]\namplitude_nm = 1.5\nfrequency_khz = 33\nphase_deg = -20\n"
BASE = "[base]\namplitude_nm = 0.25\nfrequency_khz = 88\nphase_deg = 30\n"
BASE_SECOND = "[base.second]\namplitude_nm = 0.5\nreduced_frequency = 2\n"
FORCE = "[force]\namplitude_nn = 0.75\nreduced_frequency = 0.5\n"
FORCE_SECOND = "[force.second]\namplitude_nn = 0.125\nfrequency_khz = 450\nphase_deg = 90\n"
LAW = '[interaction]\nmodel = "law"\nr = 0.9\n'
NONE = '[interaction]\nmodel = "none"\n'
FULL = (CANTILEVER, PLATFORM, SECOND, BASE, BASE_SECOND, FORCE, FORCE_SECOND, NONE)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "scene.toml"


def loaded(path: Path, *parts: str) -> Scene:
    path.write_text("".join(parts), encoding="utf-8")
    return load_scene(path)


def test_reads_every_key(path: Path):
    scene = Scene(
        Cantilever(90.0, 40.0),
        Platform(4.0, 181.8, second=Tone(1.5, 33.0, -20.0)),
        None,
        BaseDrive(0.25, 88.0, 30.0, Tone(0.5, 360.0)),
        ForceDrive(0.75, 90.0, 0.0, Tone(0.125, 450.0, 90.0)),
    )
    assert eqx.tree_equal(loaded(path, *FULL), scene)


@pytest.mark.parametrize(("drive", "frequency"), [(BASE, 88.0), (FORCE, 90.0)])
@pytest.mark.parametrize("interaction", [NONE, LAW])
def test_a_platform_under_another_drive_may_rest(path: Path, drive: str, frequency: float, interaction: str):
    for text, khz in (("amplitude_nm = 0\n", frequency), ("frequency_khz = 10\n", 10.0), ("", frequency)):
        scene = loaded(path, CANTILEVER, RESTING, text, drive, interaction)
        assert eqx.tree_equal(scene.platform, Platform(0.0, khz, 7.0))
    save_scene(scene, path)
    assert eqx.tree_equal(load_scene(path), scene)


positive = st.floats(min_value=1e-30, max_value=1e30)
# no drive is more than 1e4 times as fast as the tip
frequencies = st.floats(min_value=1e-3, max_value=10.0)
finite = st.floats(min_value=-1e30, max_value=1e30)
not_negative = st.floats(min_value=0.0, max_value=1e30)
tones = st.none() | st.builds(Tone, not_negative, frequencies, finite)
cantilevers = st.builds(Cantilever, frequencies, st.floats(0.5, 1e9, exclude_min=True), positive)
laws = st.builds(
    ImpactLaw,
    st.floats(min_value=0.0, max_value=1.0, exclude_min=True, allow_subnormal=False),
    not_negative,
    not_negative,
    st.none() | st.builds(CollisionDelay, finite, finite, finite, st.booleans()),
)


@settings(max_examples=40)
@given(
    cantilever=cantilevers,
    platform=st.builds(Platform, not_negative, frequencies, finite, finite, tones),
    base=st.none() | st.builds(BaseDrive, not_negative, frequencies, finite, tones),
    force=st.none() | st.builds(ForceDrive, not_negative, frequencies, finite, tones),
    interaction=st.none() | laws,
)
def test_loop_is_exact(cantilever: Any, platform: Any, base: Any, force: Any, interaction: Any, tmp_path_factory: Any):
    path = tmp_path_factory.getbasetemp() / "drives.toml"
    scene = Scene(cantilever, platform, interaction, base, force)
    save_scene(scene, path)
    assert eqx.tree_equal(load_scene(path), scene)


@pytest.mark.parametrize("ratio", [0.5, 0.515])
def test_a_drive_is_as_strong_as_the_free_tips_amplitude_says(path: Path, ratio: float):
    # z = a/(k gamma), gamma = 1 - s^2 + i s/Q, of a force a; of a base a/gamma
    size = 40.0 * abs(1.0 - (2.0 * ratio) ** 2 + 2.0j * ratio / 40.0)
    lines = f"free_amplitude_nm = 40\nreduced_frequency = {ratio}\n"
    base: Any = loaded(path, CANTILEVER, RESTING, "[base]\n", lines, LAW).base
    force: Any = loaded(path, CANTILEVER, RESTING, "[force]\n", lines, LAW).force
    assert float(base.amplitude_nm) == pytest.approx(size, rel=1e-12)
    assert float(force.amplitude_nn) == pytest.approx(size * (2e-3 * np.pi * 90.0) ** 2, rel=1e-12)
