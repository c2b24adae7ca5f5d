"""Scene files: the loop is exact, and every mistake is one line that names file, table and key."""

import tomllib
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from afm_jax import Cantilever, CollisionDelay, ImpactLaw, Platform, Scene, SceneError, load_scene, save_scene
from afm_jax.scenefile.scenefile import Start, load_scene_and_start

CANTILEVER = "[cantilever]\nfrequency_khz = 90\n"
PLATFORM = "[platform]\namplitude_nm = 4\nfrequency_khz = 181.8\n"
LAW = '[interaction]\nmodel = "law"\nr = 0.998\n'
DELAY = "[interaction.delay]\nhertz = 0.206\nlead_nm = 5.64\noffset_nm = 0.726\n"
START = "[start]\nphase_deg = 270\nheight_above_platform_nm = 5\nvelocity_nm_per_us = 80\n"


@pytest.fixture
def written(tmp_path: Path):
    """Write a scene file and return its path."""

    def write(text: str | bytes) -> Path:
        path = tmp_path / "scene.toml"
        path.write_bytes(text if isinstance(text, bytes) else text.encode("utf-8"))
        return path

    return write


def complaint(path: Path) -> str:
    """Return the one line that loading a file ends with, without the folder."""
    with pytest.raises(SceneError) as caught:
        load_scene(path)
    line = str(caught.value)
    assert line.isprintable()
    return line.replace(f"{path.parent}{'/'}", "")


def test_reads_every_key(written):
    scene = load_scene(
        written(
            "[cantilever]\nfrequency_khz = 90\nquality_factor = 40\nmass_ng = 1.5\n"
            "[platform]\namplitude_nm = 4\nfrequency_khz = 181.8\noffset_nm = -1\noffset_rate_nm_per_us = 1e-3\n"
            '[interaction]\nmodel = "law"\nr = 0.998\nepsilon = 122\nviscous_loss = 0.5\n' + DELAY
        )
    )
    law = ImpactLaw(r=0.998, epsilon=122.0, viscous_loss=0.5, delay=CollisionDelay(0.206, 5.64, 0.726))
    assert eqx.tree_equal(scene, Scene(Cantilever(90.0, 40.0, 1.5), Platform(4.0, 181.8, -1.0, 1e-3), law))


@pytest.mark.parametrize(
    ("line", "corrected"), [("", True), ("corrections = true\n", True), ("corrections = false\n", False)]
)
def test_a_delay_has_its_corrections_unless_they_are_left_out(written, tmp_path, line, corrected):
    scene = load_scene(written(CANTILEVER + PLATFORM + LAW + DELAY + line))
    assert scene.interaction.delay.corrections is corrected
    save_scene(scene, tmp_path / "again.toml")
    assert load_scene(tmp_path / "again.toml").interaction.delay.corrections is corrected


def test_what_is_left_out_is_absent(written):
    scene = load_scene(written(CANTILEVER + PLATFORM + LAW))
    assert eqx.tree_equal(scene, Scene(Cantilever(90.0), Platform(4.0, 181.8), ImpactLaw(r=0.998)))
    assert scene.cantilever.quality_factor is None


def test_reduced_frequency_counts_in_twice_the_free_frequency(written):
    scene = load_scene(written(CANTILEVER + "[platform]\namplitude_nm = 4\nreduced_frequency = 5.277\n" + LAW))
    # one rounding of the product is all that may differ
    np.testing.assert_allclose(scene.platform.frequency_khz, 949.86, rtol=3e-16, atol=0.0)


def test_byte_order_mark_and_windows_lines_are_no_mistake(written):
    plain = load_scene(written(CANTILEVER + PLATFORM + LAW))
    text = (CANTILEVER + PLATFORM + LAW).replace("\n", "\r\n")
    assert eqx.tree_equal(load_scene(written(b"\xef\xbb\xbf" + text.encode())), plain)


def test_start_is_kept_beside_the_scene(written):
    path = written(CANTILEVER + PLATFORM + LAW + START)
    scene, start = load_scene_and_start(path)
    assert start == Start(phase_deg=270.0, height_above_platform_nm=5.0, velocity_nm_per_us=80.0)
    save_scene(scene, path, start=start)
    assert load_scene_and_start(path)[1] == start
    save_scene(scene, path)
    assert load_scene_and_start(path)[1] is None


positive = st.floats(min_value=1e-30, max_value=1e30)
# no drive is more than 1e4 times as fast as the tip
frequencies = st.floats(min_value=1e-3, max_value=10.0)
finite = st.floats(min_value=-1e30, max_value=1e30)
not_negative = st.floats(min_value=0.0, max_value=1e30)
scenes = st.builds(
    Scene,
    st.builds(Cantilever, frequencies, st.none() | st.floats(min_value=0.5, exclude_min=True), positive),
    st.builds(Platform, not_negative, frequencies, finite, finite),
    st.builds(
        ImpactLaw,
        st.floats(min_value=0.0, max_value=1.0, exclude_min=True, allow_subnormal=False),
        not_negative,
        not_negative,
        st.none() | st.builds(CollisionDelay, finite, finite, finite, st.booleans()),
    ),
)


@given(scene=scenes)
def test_loop_is_exact(scene: Scene, tmp_path_factory: pytest.TempPathFactory):
    path = tmp_path_factory.getbasetemp() / "loop.toml"
    save_scene(scene, path)
    assert eqx.tree_equal(load_scene(path), scene)


def test_saved_file_has_the_keys_of_the_format(tmp_path: Path):
    save_scene(Scene(Cantilever(90.0), Platform(4.0, 180.0), ImpactLaw(r=0.5)), tmp_path / "scene.toml")
    assert tomllib.loads((tmp_path / "scene.toml").read_text("utf-8")) == {
        "cantilever": {"frequency_khz": 90.0, "mass_ng": 1.0},
        "platform": {"amplitude_nm": 4.0, "frequency_khz": 180.0, "offset_nm": 0.0, "offset_rate_nm_per_us": 0.0},
        "interaction": {"model": "law", "r": 0.5, "epsilon": 0.0, "viscous_loss": 0.0},
    }


def test_a_batch_of_scenes_is_not_saved(tmp_path: Path):
    scenes = jax.vmap(lambda f: Scene(Cantilever(90.0), Platform(4.0, f), ImpactLaw(r=0.5)))(jnp.array([1.0, 2.0]))
    with pytest.raises(ValueError, match=r"has shape \(2,\), but a scene file holds one scene"):
        save_scene(scenes, tmp_path / "scene.toml")
    assert not (tmp_path / "scene.toml").exists()


WRONG_KEYS = [
    ("platform", "frequency_hz = 180", "[platform] frequency_hz: unknown key; use frequency_khz"),
    ("platform", "frequency = 180", "[platform] frequency: the unit is missing; use frequency_khz"),
    ("platform", "offset_rate = 0", "[platform] offset_rate: the unit is missing; use offset_rate_nm_per_us"),
    ("platform", "offset_um = 0", "[platform] offset_um: unknown key; use offset_nm"),
    ("platform", "Offset_nm = 0", "[platform] Offset_nm: unknown key; use offset_nm"),
    ("platform", "amplitud_nm = 0", "[platform] amplitud_nm: unknown key; use amplitude_nm"),
    ("platform", "mass_ng = 1", "[platform] mass_ng: unknown key; it belongs in [cantilever]"),
    ("platform", "reduced_frequency = 1", "[platform] has both frequency_khz and reduced_frequency; give one of them"),
    ("cantilever", "mass = 1", "[cantilever] mass: the unit is missing; use mass_ng"),
    ("cantilever", "qualty_factor = 1", "[cantilever] qualty_factor: unknown key; use quality_factor"),
    (
        "cantilever",
        "xyz = 1",
        "[cantilever] xyz: unknown key; use one of frequency_khz, quality_factor, mass_ng",
    ),
    (
        "cantilever",
        '"a\\nb" = 1',
        "[cantilever] 'a\\nb': unknown key; use one of frequency_khz, quality_factor, mass_ng",
    ),
    ("interaction", "epsilon_uj_per_kg = 1", "[interaction] epsilon_uj_per_kg: unknown key; use epsilon"),
    ("interaction", "hertz = 1", "[interaction] hertz: unknown key; it belongs in [interaction.delay]"),
    (
        "interaction",
        'effects = ["jkr"]',
        '[interaction] effects: unknown key of a law; it belongs to model = "contact"',
    ),
    ("interaction", "restitution = 1", "[interaction] restitution: unknown key; use one of model, r, epsilon"),
    ("interaction.delay", "lead = 1", "[interaction.delay] lead: the unit is missing; use lead_nm"),
    ("start", "phase_rad = 1", "[start] phase_rad: unknown key; use phase_deg"),
]

WRONG_VALUES = [
    ("cantilever", "mass_ng = 0", "[cantilever] `mass_ng` must be positive, but is 0"),
    ("cantilever", "mass_ng = nan", "[cantilever] `mass_ng` must be positive, but is nan"),
    ("cantilever", "mass_ng = inf", "[cantilever] `mass_ng` must be positive, but is inf"),
    ("cantilever", "mass_ng = true", "[cantilever] mass_ng: must be a number, but is true"),
    (
        "cantilever",
        'mass_ng = "1"',
        "[cantilever] mass_ng: must be a number, but is the text '1'; leave out the quotes",
    ),
    ("cantilever", "mass_ng = [1]", "[cantilever] mass_ng: must be a number, but is a list"),
    ("cantilever", "mass_ng = 1979-05-27", "[cantilever] mass_ng: must be a number, but is a date or time"),
    ("cantilever", f"mass_ng = 1{'0' * 400}", "[cantilever] mass_ng: is too large a number"),
    ("cantilever", "quality_factor = 0.5", "[cantilever] `quality_factor` must be above 0.5, but is 0.5"),
    ("platform", "offset_nm = nan", "[platform] `offset_nm` must be a finite number, but is nan"),
    ("interaction", "epsilon = -1", "[interaction] `epsilon` must not be negative, but is -1"),
    ("interaction", "viscous_loss = -1e-9", "[interaction] `viscous_loss` must not be negative, but is -1e-09"),
    ("interaction", "delay = 3", "interaction.delay must be a table, [interaction.delay], but is a number"),
]

FULL = {"cantilever": CANTILEVER, "platform": PLATFORM, "interaction": LAW, "interaction.delay": DELAY, "start": START}


@pytest.mark.parametrize(("table", "line", "expected"), WRONG_KEYS + WRONG_VALUES)
def test_a_wrong_line_is_named(written, table: str, line: str, expected: str):
    without = {"interaction.delay"} if line.startswith("delay") else set()
    text = "".join(part + (f"{line}\n" if name == table else "") for name, part in FULL.items() if name not in without)
    assert complaint(written(text)).startswith(f"scene.toml: {expected}")


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ("frequency_khz = 90", "frequency_khz = -90", "[cantilever] `frequency_khz` must be positive, but is -90"),
        ("frequency_khz = 90", "", "[cantilever] frequency_khz: missing; add it"),
        ("frequency_khz = 90", "frequency = 90", "[cantilever] frequency: the unit is missing; use frequency_khz"),
        ("amplitude_nm = 4", "amplitude_nm = -4", "[platform] `amplitude_nm` must not be negative, but is -4"),
        (
            "frequency_khz = 181.8",
            "",
            "[platform] the drive frequency is missing; add frequency_khz or reduced_frequency",
        ),
        (
            "frequency_khz = 181.8",
            "reduced_frequency = -1.01",
            "[platform] `reduced_frequency` must be positive, but is -1.01",
        ),
        ("r = 0.998", "r = -0.1", "[interaction] `r` must be in [0, 1], but is -0.1"),
        ("r = 0.998", "r = 1.001", "[interaction] `r` must be in [0, 1], but is 1.001"),
        ("r = 0.998", "", "[interaction] r: missing; add it"),
        ('model = "law"', "", '[interaction] model: missing; add model = "law" or model = "contact"'),
        ('model = "law"', 'model = "lw"', '[interaction] model: must be "law" or "contact"'),
        ('model = "law"', 'model = ["law"]', '[interaction] model: must be "law" or "contact"'),
        (
            'model = "law"',
            'model = "contact"',
            '[interaction] r: unknown key of a contact; it belongs to model = "law"',
        ),
        ("hertz = 0.206", "hertz = inf", "[interaction.delay] `hertz` must be a finite number, but is inf"),
        ("hertz = 0.206", "", "[interaction.delay] hertz: missing; add it"),
        (
            "hertz = 0.206",
            "hertz = 1\ncorrections = 0",
            "[interaction.delay] corrections: must be true or false, but is a number",
        ),
        (
            "height_above_platform_nm = 5",
            "height_above_platform_nm = -5",
            "[start] `height_above_platform_nm` must not be negative, but is -5",
        ),
        ("velocity_nm_per_us = 80", "velocity_nm_per_us = nan", "[start] `velocity_nm_per_us` must be a finite number"),
        ("phase_deg = 270", "", "[start] phase_deg: missing; add it"),
        ("[platform]", "[plattform]", "plattform: unknown table; use [platform]"),
        ("[interaction.delay]", "[delay]", "delay: unknown table; use [interaction.delay]"),
        ("[cantilever]", "", "frequency_khz: stands outside any table; write it below [cantilever] or [platform]"),
        ("[platform]", "[[platform]]", "platform must be a table, [platform], but is a list"),
        ("amplitude_nm = 4", "amplitude_nm = ", "not TOML: Invalid value (at line 4, column 16)"),
        ("amplitude_nm = 4", "amplitude_nm = 4\namplitude_nm = 4", "not TOML: Cannot overwrite a value (at line 5"),
    ],
)
def test_a_wrong_scene_is_named(written, old: str, new: str, expected: str):
    text = "".join(FULL.values())
    assert old in text
    assert complaint(written(text.replace(old, new))).startswith(f"scene.toml: {expected}")


def test_a_missing_table_is_named(written):
    assert complaint(written(CANTILEVER + LAW)).startswith(
        "scene.toml: [platform] is missing; add it with amplitude_nm"
    )


def test_files_that_are_no_text_are_named(written, tmp_path: Path):
    assert complaint(written(b"[cantilever]\nx = '\xff'")) == (
        "scene.toml: line 2 is not UTF-8 text; save the file as UTF-8"
    )
    assert complaint(written("a = " + "[" * 100_000)).startswith("scene.toml: not TOML")
    assert complaint(tmp_path / "none.toml") == "none.toml: there is no such file"
    assert "cannot be read" in complaint(tmp_path)


def test_library_files_load_in_32_bits_too(written):
    path = written(CANTILEVER + PLATFORM + LAW)
    with jax.enable_x64(False):  # noqa: FBT003
        scene = load_scene(path)
        save_scene(scene, path)
        assert scene.platform.frequency_khz.dtype == jnp.float32
        assert eqx.tree_equal(load_scene(path), scene)
